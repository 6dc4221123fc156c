"""`fractus report`: the report of an Application's last flight, from a cluster or from files."""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import click
import yaml
from fractus_core.api import KINDS
from rich.console import Console
from rich.markdown import Markdown

from fractus_sim.command_line import command_errors
from fractus_sim.demo.mission_data import (
    collect_mission_data,
    extract_pictures,
    fetch_audit_logs,
    fetch_recordings,
    mobility_pod,
)
from fractus_sim.errors import ExperimentError
from fractus_sim.report.audit_log_reader import read_audit_logs
from fractus_sim.report.flight_record import AUDIT, OBJECTS, PICTURES, FlightRecord, TimeWindow, last_mission
from fractus_sim.report.html_page import HTML_PAGE
from fractus_sim.report.mission_report import write_mission_report
from fractus_sim.report.report_files import PAGE, remove_report
from fractus_sim.testbeds.kube_commands import Kube, Object
from fractus_sim.testbeds.mission_watch import Mission

_PATH = click.Path(exists=True, path_type=Path)
_KIND_NAMES = frozenset(kind.KIND for kind in KINDS)


@click.command()
@click.argument("application")
@click.option("-n", "--namespace", default="default", show_default=True, help="Namespace of the Application.")
@click.option(
    "--kubeconfig",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="Kubeconfig of the cluster.  [default: KUBECONFIG or ~/.kube/config]",
)
@click.option(
    "-f",
    "--filename",
    "manifests",
    multiple=True,
    type=_PATH,
    help="Without a cluster: manifest file of the Application, its Zones or Policies. May be repeated.",
)
@click.option(
    "--audit",
    multiple=True,
    type=_PATH,
    help="Without a cluster: audit log of the drone's mobility service, or its directory. May be repeated.",
)
@click.option(
    "--recordings",
    multiple=True,
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="Without a cluster: recording of the drone's camera service (.mcap). May be repeated.",
)
@click.option(
    "--out", type=click.Path(path_type=Path, file_okay=False), help="Output folder.  [default: out/APPLICATION]"
)
def report(
    *,
    application: str,
    namespace: str,
    kubeconfig: Path | None,
    manifests: tuple[Path, ...],
    audit: tuple[Path, ...],
    recordings: tuple[Path, ...],
    out: Path | None,
) -> None:
    """Write the report of the last flight of APPLICATION, which may still be running.

    The report has a summary, a map, an altitude plot, the decisions of policies, and pictures if the camera service records.
    The data come from the cluster with kubectl (the user needs `pods/exec` in fractus-system), or from manifests, audit
    logs and recordings. The file report.html contains the whole report.
    """
    folder = out or Path("out") / application
    if audit and not manifests:
        raise click.UsageError("--audit also needs the manifest of the Application (--filename)")
    if (manifests or recordings) and not audit:
        raise click.UsageError("--filename and --recordings also need the audit log of the mobility service (--audit)")
    with command_errors():
        _check_folder(folder, audit)
        folder.mkdir(parents=True, exist_ok=True)
        remove_report(folder, OBJECTS, HTML_PAGE, "events.json")
        shutil.rmtree(folder / PICTURES, ignore_errors=True)
        if audit:
            collect_from_files(application, namespace, manifests, audit, folder)
            files = list(recordings)
        else:
            files = collect_from_cluster(_kube(kubeconfig), application, namespace, folder)
        record = FlightRecord.read(folder)
        extract_pictures(files, record, folder)
        write_mission_report(FlightRecord.read(folder), folder)
    Console().print(Markdown((folder / PAGE).read_text()))
    click.echo(f"report: {folder / HTML_PAGE}")


def _check_folder(folder: Path, audit: Sequence[Path]) -> None:
    """Refuse a folder in which the new report would replace other files than an earlier report.

    Raises:
        ExperimentError: The folder contains files but no report, or contains the audit logs to read.
    """
    if folder.is_dir() and any(folder.iterdir()) and not (folder / OBJECTS).exists():
        raise ExperimentError(f"{folder} contains other files than an earlier report; specify a new folder with --out")
    if any(path.resolve().is_relative_to((folder / AUDIT).resolve()) for path in audit):
        raise ExperimentError(
            f"--audit is inside {folder}, which the report replaces; specify another folder with --out"
        )


def _kube(kubeconfig: Path | None) -> Kube:
    kubectl = shutil.which("kubectl")
    if kubectl is None:
        raise ExperimentError("kubectl is not installed; without a cluster, specify --filename and --audit")
    config = kubeconfig or Path(os.environ.get("KUBECONFIG", "~/.kube/config")).expanduser()
    return Kube(Path(kubectl), Path("helm"), config)


def collect_from_cluster(kube: Kube, application: str, namespace: str, folder: Path) -> list[Path]:
    """Write objects, events, audit logs and recordings of an Application's last flight into a folder.

    Returns:
        The recordings.

    Raises:
        ExperimentError: The Application does not exist or has no drone, or the cluster is not reachable.
    """
    bodies = {body["metadata"]["name"]: body for body in kube.objects("applications", namespace)}
    if application not in bodies:
        existing = ", ".join(sorted(bodies)) or "none"
        raise ExperimentError(f"namespace {namespace} has no Application {application} (existing: {existing})")
    status = bodies[application].get("status") or {}
    if not status.get("drone"):
        raise ExperimentError(
            f"Application {application} has no drone ({status.get('phase')}: {status.get('message')})"
        )
    mission = Mission(application, namespace=namespace, drone=status["drone"])
    selector = f"fractus.dev/application={application}"
    pods = json.loads(kube.run("get", "pods", "-n", namespace, "-l", selector, "-o", "json"))["items"]
    mission.pods = {pod["metadata"]["name"]: pod for pod in pods}
    fetch_audit_logs(kube, mobility_pod(kube, mission.drone), folder / AUDIT)
    window = _last_mission(folder / AUDIT, namespace, application)
    mission.times = _times(window)
    collect_mission_data(kube, mission, folder, folder / "components.log")
    return fetch_recordings(kube, mission.drone, window.begin_s, folder)


def collect_from_files(
    application: str, namespace: str, manifests: Sequence[Path], audit: Sequence[Path], folder: Path
) -> None:
    """Write the objects and audit logs of an application's last flight into a folder.

    Raises:
        ExperimentError: The manifests do not contain the Application, or the audit logs contain no flight of it.
    """
    objects = [body for path in manifests for body in _objects(path)]
    if not any(body["kind"] == "Application" and body["metadata"]["name"] == application for body in objects):
        raise ExperimentError(f"no manifest of --filename contains the Application {application}")
    target = folder / AUDIT
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir()
    for path in audit:
        for log in sorted(path.glob("*.jsonl")) if path.is_dir() else [path]:
            shutil.copy(log, target / log.name)
    window = _last_mission(target, namespace, application)
    logs = list(read_audit_logs([target]))
    kept = sum(window.contains(entry) for log in logs for entry in log.entries)
    problems = [f"{log.path.name}: {log.problem}" for log in logs if log.problem]
    content = {
        "objects": objects,
        "times": _times(window),
        "audit": {"entries": sum(log.length for log in logs), "kept": kept, "problem": "; ".join(problems)},
    }
    (folder / OBJECTS).write_text(json.dumps(content, indent=1) + "\n")


def _objects(path: Path) -> Iterator[Object]:
    """Yield the objects of Fractus kinds in a manifest file."""
    try:
        documents: list[Any] = list(yaml.safe_load_all(path.read_text()))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ExperimentError(f"{path} is not YAML: {' '.join(str(error).split())}") from None
    for body in documents:
        if isinstance(body, dict) and body.get("kind") in _KIND_NAMES and isinstance(body.get("metadata"), dict):
            yield body


def _last_mission(folder: Path, namespace: str, application: str) -> TimeWindow:
    entries = [entry for log in read_audit_logs([folder]) if log.path.stem == "mobility" for entry in log.entries]
    window = last_mission(entries, namespace, application)
    if window is None:
        raise ExperimentError(f"the audit log of the drone contains no mission of {namespace}/{application}")
    return window


def _times(window: TimeWindow) -> dict[str, float]:
    """Return the times of a record. Without `over`, the mission is still running."""
    return {"applied": window.begin_s} | ({"over": window.end_s} if math.isfinite(window.end_s) else {})

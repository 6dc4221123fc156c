"""`fractus audit`: verify the hash chains of audit logs, show their entries, and export them to other formats."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from fractus_runtime.files import read_file
from fractus_services.recording.messages import controller_of, parse_time_ns, sentence

from fractus_cli.audit_logs import Window, entries, find_logs, is_decision, verify_log
from fractus_cli.output import output_option, printable

if TYPE_CHECKING:
    from fractus_core.api import Zone
    from fractus_runtime.audit_checkpoints import Checkpoint

    Shape = tuple[Zone, str, str]
    """A shape, its kind, and its component."""

_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
_PATHS = click.argument("paths", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))


@click.group()
def audit() -> None:
    """Verify, show and export audit logs of a node's services and agent."""


@audit.command("verify")
@_PATHS
@click.option(
    "--since",
    multiple=True,
    help="Checkpoint stored off the node: a copy of the log's .checkpoint file, or LOG:NUMBER:HASH from the node's status."
    " The log must contain this entry and all later entries. May be repeated, once for each log.",
)
@click.option("--ca", type=_FILE, help="CA certificate that must have issued the certificates in checkpoints.")
@output_option
def verify_command(paths: tuple[Path, ...], since: tuple[str, ...], ca: Path | None, output: str) -> None:
    """Verify that no entry of the audit logs in PATHS was changed, removed or inserted.

    PATHS are directories, logs (including their segments) or single segments. The exit code is 1 if a log is not sound. Text output
    stops at the first such log; JSON output lists all logs.
    """
    logs = find_logs(paths)
    checkpoints = _checkpoints(since, ca)
    for missing in checkpoints.keys() - {log.stem for log, files in logs.items() if log in files}:
        raise click.ClickException(
            f"--since: the checkpoint belongs to {missing}.jsonl; add that log or its directory to PATHS"
        )
    for stem in checkpoints:
        matching = [str(log) for log, files in logs.items() if log in files and log.stem == stem]
        if len(matching) > 1:
            raise click.ClickException(
                f"--since: several logs match the checkpoint of {stem}.jsonl: {', '.join(matching)}; verify one at a time"
            )
    if output == "json":
        click.echo(json.dumps([_result(name, files, checkpoints.get(name.stem)) for name, files in logs.items()]))
    for name, files in logs.items():
        summary = _check(name, files, checkpoints.get(name.stem))
        if output == "text":
            click.echo(summary)


def _parse_time(context: click.Context, option: click.Parameter, text: str | None) -> int | None:
    """Parse an RFC 3339 time to Unix nanoseconds."""
    del context, option
    time_ns = parse_time_ns(text)
    if text is not None and time_ns is None:
        raise click.BadParameter(f"{text!r} is not a time with a time zone, such as 2026-06-01T12:00:00Z")
    return time_ns


def _window_options(command: Callable[..., None]) -> Callable[..., None]:
    after = click.option("--after", metavar="TIME", callback=_parse_time, help="Only entries at or after this time.")
    before = click.option("--before", metavar="TIME", callback=_parse_time, help="Only entries before this time.")
    return after(before(command))


def _problems(logs: dict[Path, list[Path]]) -> list[str]:
    """Return the problems of logs whose chains are not sound, and print them to standard error."""
    problems = [problem for name, files in logs.items() if (problem := verify_log(name, files)[1])]
    for problem in problems:
        click.echo(f"warning: not verified: {problem}", err=True)
    return problems


@audit.command()
@_PATHS
@_window_options
@click.option(
    "--all", "all_entries", is_flag=True, help="Also print permitted calls, Grants and positions of the drone."
)
@output_option
def show(paths: tuple[Path, ...], after: int | None, before: int | None, all_entries: bool, output: str) -> None:
    """Print corrected and denied calls, takeovers and changes of control from the audit logs in PATHS.

    PATHS are as for `verify`. If the chain of a log is not sound, a warning is printed to standard error. JSON output has one
    object per line: the entry with the additional fields `node` and `log`.
    """
    logs = find_logs(paths)
    _problems(logs)
    for entry in entries(logs, Window(after, before)):
        if not all_entries and not is_decision(entry):
            continue
        if output == "json":
            fields = {key: value for key, value in entry.items() if key != "time_ns"}
            click.echo(json.dumps(fields, sort_keys=True, ensure_ascii=False))
        else:
            click.echo(printable(f"{entry['time']}  {entry['node']}/{entry['log']}  {_line(entry)}"))


def _line(entry: dict[str, Any]) -> str:
    if entry.get("kind") != "state":
        return f"{entry.get('kind')}: {sentence(entry)}"
    names = ("lat", "lon", "alt", "speed", "mode", "controller", "battery", "in_air")
    shown = entry | {"controller": controller_of(entry)} if "controller" in entry else entry
    return "state: " + ", ".join(f"{name}={shown[name]}" for name in names if name in shown)


@audit.command()
@_PATHS
@click.option(
    "--to", "target", type=click.Choice(["csv", "geojson", "kml", "mcap"]), required=True, help="Output format."
)
@click.option(
    "--file", type=click.Path(dir_okay=False, path_type=Path), help="Output file.  [default: standard output]"
)
@click.option(
    "--zones",
    multiple=True,
    type=click.Path(exists=True, path_type=Path),
    help="Manifests (file or directory) to export with the flight: Zones, the operation areas of DeploymentPlans, and the zones and"
    " areas of Grants. May be repeated.",
)
@click.option(
    "--application",
    metavar="[NAMESPACE/]NAME",
    help="Export the operation area of this Application of the cluster, and the Zones of the cluster, with the flight.",
)
@click.option(
    "--kubeconfig",
    type=click.Path(exists=True, dir_okay=False),
    help="Kubeconfig of the cluster of --application.  [default: KUBECONFIG, then ~/.kube/config]",
)
@_window_options
def export(
    *,
    paths: tuple[Path, ...],
    target: str,
    file: Path | None,
    zones: tuple[Path, ...],
    application: str | None,
    kubeconfig: str | None,
    after: int | None,
    before: int | None,
) -> None:
    """Export flight paths, verdicts, takeovers and zones from the audit logs in PATHS.

    PATHS are as for `verify`, for one or several drones. geojson and kml contain flight paths and decisions. csv has a row for each
    entry. mcap contains all data for Foxglove. After the mission, the operation area is in the DeploymentPlan (--application, or --zones with
    its manifest), because the Grants are deleted. If the chain of a log is not sound, a warning is printed, and written to geojson, kml and mcap.
    """
    from fractus_cli.flight_export import WRITERS, Areas, Export  # noqa: PLC0415 - only this command needs geometry

    logs = find_logs(paths)
    shapes = _manifest_shapes(zones)
    if application is not None:
        shapes += _cluster_shapes(application, kubeconfig)
    data = Export(entries(logs, Window(after, before)), Areas(shapes), _problems(logs))
    if file is None:
        if target == "mcap" and sys.stdout.isatty():
            raise click.ClickException("mcap is a binary format; specify --file or redirect standard output")
        WRITERS[target](data, sys.stdout.buffer)
        return
    with file.open("wb") as out:
        WRITERS[target](data, out)


def _manifest_shapes(paths: Sequence[Path]) -> list[Shape]:
    """Return the zones and areas of manifests."""
    if not paths:
        return []
    from fractus_core.api import DeploymentPlan, Grant, Zone  # noqa: PLC0415
    from fractus_services.recording.map_features import area_of_plan, areas_of, zones_of  # noqa: PLC0415

    from fractus_cli.manifests import BadManifest, read_manifests  # noqa: PLC0415

    try:
        manifests = read_manifests(paths, (Grant, Zone, DeploymentPlan))
    except BadManifest as error:
        raise click.ClickException(str(error)) from None
    specs = [grant.spec for grant in manifests.of(Grant).values()]
    plans = [loaded.resource for loaded in manifests.objects.values() if isinstance(loaded.resource, DeploymentPlan)]
    shapes = _zone_shapes({zone.name: zone for zone in zones_of(specs)} | manifests.of(Zone))
    shapes += [(area, area.name, spec.component) for spec in specs for area in areas_of(spec)]
    shapes += [(area, area.name, "") for plan in plans for area in area_of_plan(plan.spec)]
    if not shapes:
        raise click.ClickException(
            f"--zones {', '.join(map(str, paths))}: the manifests contain no Zone, no Grant and no DeploymentPlan with an"
            " operation area"
        )
    return shapes


def _cluster_shapes(application: str, config: str | None) -> list[Shape]:
    """Return the Zones of a cluster and the operation area of an Application, which may be finished."""
    from fractus_core.api import DeploymentPlan, InvalidObject, Zone  # noqa: PLC0415
    from fractus_services.recording.map_features import area_of_plan  # noqa: PLC0415

    try:
        from fractus_cli.cluster_reader import GROUP, open_cluster  # noqa: PLC0415
    except ImportError as error:
        raise click.ClickException(f"--application requires {error.name}; install fractus-drones[kube]") from None

    namespace, _, name = application.rpartition("/")
    with open_cluster(config) as cluster:
        body = cluster.get(f"{GROUP}/namespaces/{namespace or 'default'}/deploymentplans/{name}")
        bodies = cluster.list(f"{GROUP}/zones")
    if body is None:
        raise click.ClickException(
            f"--application {application}: there is no DeploymentPlan of this name; `kubectl get fplan -A` lists them"
        )
    try:
        plan = DeploymentPlan.from_body(dict(body))
        zones = [Zone.from_body(dict(zone)) for zone in bodies]
    except InvalidObject as error:
        raise click.ClickException(
            f"--application {application}: an object of the cluster is invalid: {error}"
        ) from None
    areas = area_of_plan(plan.spec)
    if not areas:
        raise click.ClickException(
            f"--application {application}: its plan has no operation area, because the application uses no drone"
        )
    return [*_zone_shapes({zone.name: zone for zone in zones}), *((area, area.name, "") for area in areas)]


def _zone_shapes(zones: Mapping[str, Zone]) -> list[Shape]:
    return [(zone, "zone", "") for _, zone in sorted(zones.items())]


def _checkpoints(since: tuple[str, ...], ca: Path | None) -> dict[str, Checkpoint]:
    """Parse the checkpoints of --since. Return them by log name."""
    if not since:
        return {}
    # Imported here, because only checkpoints need cryptography.
    from cryptography import x509  # noqa: PLC0415
    from fractus_runtime.audit_checkpoints import InvalidCheckpoint, parse_status_checkpoint, read_checkpoint  # noqa: PLC0415

    checkpoints: dict[str, Checkpoint] = {}
    try:
        authorities = x509.load_pem_x509_certificates(read_file(ca)) if ca is not None else []
    except OSError as error:
        raise click.ClickException(f"--ca {ca}: {error.strerror or error}") from None
    except ValueError:
        raise click.ClickException(f"--ca {ca}: contains no certificate") from None
    for text in since:
        try:
            checkpoint = parse_status_checkpoint(text) or read_checkpoint(read_file(Path(text)), authorities)
        except (OSError, InvalidCheckpoint) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise click.ClickException(f"--since {text}: {reason}") from None
        if checkpoint.log in checkpoints:
            raise click.ClickException(
                f"--since {text}: second checkpoint of {checkpoint.log}.jsonl; specify one for each log"
            )
        checkpoints[checkpoint.log] = checkpoint
    return checkpoints


def _result(name: Path, files: list[Path], checkpoint: Checkpoint | None) -> dict[str, Any]:
    """Return the JSON result of a verification."""
    finding, problem = verify_log(name, files, checkpoint.entry if checkpoint is not None else None)
    return {
        "log": str(name if name in files else files[0]), "files": [str(file) for file in files], "entries": finding.entries,
        "sound": not problem, "problem": problem, "removed": finding.before, "torn": finding.torn, "whole": name in files,
    }  # fmt: skip


def _check(name: Path, files: list[Path], checkpoint: Checkpoint | None) -> str:
    """Return a summary of a sound log.

    Raises:
        click.ClickException: The log is not sound.
    """
    finding, problem = verify_log(name, files, checkpoint.entry if checkpoint is not None else None)
    if problem:
        raise click.ClickException(problem)
    partial = name not in files
    details = [f"{finding.entries} entries, chain sound"]
    if len(files) > 1:
        details.append(f"{len(files)} files")
    if checkpoint is not None:
        signed = ""
        if checkpoint.node:
            unverified = "" if checkpoint.certified else "; its certificate was not verified (specify --ca)"
            signed = f" (checkpoint signed by {checkpoint.node}{unverified})"
        details.append(f"complete since entry {checkpoint.entry.sequence}{signed}")
    if finding.before:
        details.append(f"the first {finding.before} entries were removed to free space")
    if partial:
        details.append("part of a log: earlier and later entries were not verified")
    if finding.torn:
        details.append("the last line is incomplete (crash, or write in progress)")
    return f"{files[0] if partial else name}: {'; '.join(details)}"

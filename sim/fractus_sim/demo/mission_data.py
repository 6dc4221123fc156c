"""Collection of mission data from the cluster: objects, events, audit logs of the drone, and pictures."""

from __future__ import annotations

import contextlib
import json
import re
from base64 import b64decode
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fractus_runtime.audit_chain import logs, read_lines, verify
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader

from fractus_sim.errors import ExperimentError
from fractus_sim.report.flight_record import AUDIT, OBJECTS, PICTURES, Record, of_mission, taken_s
from fractus_sim.testbeds.kube_commands import NAMESPACE, SYSTEM, Kube, Object
from fractus_sim.testbeds.mission_watch import Mission

_AUDIT = "/var/lib/fractus/audit"
_AUDIT_FILE = re.compile(r"(mobility|camera|links)(\.\d{12})?\.jsonl")
_TRIES = 5
_SHARES = (0.25, 0.5, 0.75)
_KINDS = "applications,deploymentplans,depots,drones,edgenodes,policies,zones"
_KEPT = re.compile(rb"\[pod/[^/]+/data-store\] .* kept ")


def collect(kube: Kube, mission: Mission, folder: Path, log: Path) -> None:
    """Write objects.json, events.json and the audit logs into a folder. `log` is the log of the components.

    Raises:
        ExperimentError: The API server did not respond.
    """
    objects = [body for body in kube.objects(_KINDS) if _concerns(body, mission.application)]
    events = [
        event for event in kube.objects("events") if mission.application in event["involvedObject"].get("name", "")
    ]
    audit = _audit(kube, mission, folder)
    content = {
        "objects": objects,
        "pods": list(mission.pods.values()),
        "times": mission.times,
        "links": mission.links,
        "audit": audit,
        "results": len(_KEPT.findall(log.read_bytes())) if log.exists() else 0,
    }
    (folder / OBJECTS).write_text(json.dumps(content, indent=1) + "\n")
    (folder / "events.json").write_text(json.dumps([_event(e) for e in events], indent=1) + "\n")


def _concerns(body: Object, application: str) -> bool:
    own = body["kind"] not in {"Application", "DeploymentPlan"}
    return own or (body["metadata"]["name"] == application and body["metadata"].get("namespace") == NAMESPACE)


def _audit(kube: Kube, mission: Mission, folder: Path) -> dict[str, Any]:
    """Fetch the audit logs of the drone, verify their chains, and count the entries of this mission."""
    found: dict[str, Any] = {"entries": 0, "kept": 0, "problem": ""}
    if not mission.drone:
        return {}
    try:
        fetch_logs(kube, mobility_pod(kube, mission.drone), folder / AUDIT)
    except ExperimentError as error:
        return {**found, "problem": f"cannot be fetched: {error}"}

    def counted(files: list[Path]) -> Iterator[bytes]:
        for _, _, line in read_lines(files):
            found["kept"] += line.endswith(b"\n") and of_mission(line, mission.times["applied"])
            yield line

    for name, files in logs([folder / AUDIT]).items():
        finding = verify(counted(files))
        found["entries"] += finding.entries
        if finding.problem and not found["problem"]:
            found["problem"] = f"line {finding.line} of {name.name} {finding.problem}"
    return found


def fetch_logs(kube: Kube, pod: str, folder: Path) -> None:
    """Copy the audit logs of a node's services with all segments.

    Raises:
        ExperimentError: The logs cannot be read.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for _ in range(_TRIES):
        listed = _audit_files(kube, pod)
        for name in listed:
            segment = name.count(".") > 1
            if not (segment and (folder / name).exists()):
                kube.fetch(pod, f"{_AUDIT}/{name}", folder / name)
        if _audit_files(kube, pod) == listed:
            return
    raise ExperimentError(f"the audit log of pod {pod} rotates faster than it can be copied")


def _audit_files(kube: Kube, pod: str) -> list[str]:
    names = kube.run("exec", "-n", SYSTEM, pod, "--", "ls", _AUDIT).split()
    return sorted(name for name in names if _AUDIT_FILE.fullmatch(name))


def keep_pictures(recordings: Iterable[Path], record: Record, folder: Path) -> None:
    """Extract a few in-flight pictures, after privacy filters, from the recordings of the camera service.

    The image stores cannot be used because components delete their pictures after retrieval.
    """
    if record.takeoff_s is None:
        return
    taken = {name: jpeg for path in recordings if path.name.startswith("camera-") for name, jpeg in _pictures(path)}
    begin_s = record.samples[0].time_s
    end_s = record.samples[-1].time_s
    (folder / PICTURES).mkdir(parents=True, exist_ok=True)
    for name in spread(list(taken), begin_s, end_s):
        (folder / PICTURES / name).write_bytes(taken[name])


def _pictures(recording: Path) -> Iterator[tuple[str, bytes]]:
    """Yield names (by capture time) and contents of pictures. Stop at the end of an incomplete recording."""
    # A damaged recording must not prevent the report.
    with recording.open("rb") as file, contextlib.suppress(McapError, KeyError, RuntimeError, ValueError):
        for schema, _, message in NonSeekingReader(file).iter_messages(log_time_order=False):
            if schema is not None and schema.name == "foxglove.CompressedImage":
                moment = datetime.fromtimestamp(message.log_time / 1e9, UTC)
                name = f"{moment:%Y%m%d%H%M%S}{moment.microsecond // 1000:03d}-{message.sequence:04d}.jpg"
                yield name, b64decode(json.loads(message.data)["data"])


def spread(names: list[str], begin_s: float, end_s: float) -> list[str]:
    """Return the pictures closest to a quarter, half and three quarters of a time span, oldest first."""
    taken = {name: taken_s(name) for name in names}
    inside = [name for name in names if begin_s <= taken[name] <= end_s]
    if not inside:
        return []

    def nearest(at_s: float) -> str:
        return min(inside, key=lambda name: abs(taken[name] - at_s))

    chosen = {nearest(begin_s + share * (end_s - begin_s)) for share in _SHARES}
    return sorted(chosen, key=lambda name: taken[name])


def mobility_pod(kube: Kube, node: str) -> str:
    """Return the name of the pod of a drone's mobility service.

    Raises:
        ExperimentError: No such pod is running.
    """
    text = kube.run(
        "get", "pods", "-n", SYSTEM, "--field-selector", f"spec.nodeName={node},status.phase=Running", "-o",
        "jsonpath={range .items[*]}{.metadata.name}{\"\\n\"}{end}",
    )  # fmt: skip
    for name in text.split():
        if name.startswith("fractus-mobility"):
            return name
    raise ExperimentError(f"no mobility service is running on {node}")


def _event(event: Object) -> dict[str, Any]:
    return {
        "time": event.get("lastTimestamp") or event.get("eventTime"),
        "object": f"{event['involvedObject']['kind']}/{event['involvedObject'].get('name', '')}",
        "reason": event.get("reason"),
        "message": event.get("message"),
        "count": event.get("count", 1),
    }

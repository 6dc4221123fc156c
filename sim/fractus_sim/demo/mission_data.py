"""Collection of mission data from the cluster: objects, events, audit logs and recordings of the drone, and pictures."""

from __future__ import annotations

import contextlib
import json
import math
import re
from base64 import b64decode
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader

from fractus_sim.errors import ExperimentError
from fractus_sim.report.audit_log_reader import read_audit_logs
from fractus_sim.report.flight_record import AUDIT, OBJECTS, PICTURES, FlightRecord, TimeWindow, picture_time_s
from fractus_sim.testbeds.kube_commands import SYSTEM, Kube, Object
from fractus_sim.testbeds.mission_watch import Mission

RECORDINGS = "recordings"
"""Folder of recordings in the report."""

_NODE_AUDIT_FOLDER = "/var/lib/fractus/audit"
_NODE_RECORDINGS_FOLDER = "/var/lib/fractus/recordings"
_LIST_RECORDINGS = "import sys, pathlib as p; r = p.Path(sys.argv[1]); [print(f.stat().st_mtime, f.relative_to(r)) for f in r.glob('*/*.mcap')]"
_AUDIT_FILE = re.compile(r"(mobility|camera|links)(\.\d{12})?\.jsonl")
_STORED_PICTURE = re.compile(rb"\[pod/[^/]+/data-store\] .* stored ")
_KINDS = "applications,deploymentplans,depots,drones,edgenodes,policies,zones"
_FETCH_ATTEMPTS = 5
_PICTURE_SHARES = (0.25, 0.5, 0.75)
"""Times of the selected pictures in the report, as shares of the flight time."""


def collect_mission_data(kube: Kube, mission: Mission, folder: Path, logs: Path) -> None:
    """Write objects.json, events.json and the audit logs into a folder.

    Args:
        kube: Cluster.
        mission: Observed mission.
        folder: Output folder.
        logs: Logs of the components. They contain one line per stored picture.

    Raises:
        ExperimentError: The API server did not respond.
    """
    objects = [body for body in kube.objects(_KINDS, mission.namespace) if _belongs_to(body, mission)]
    events = [
        event
        for event in kube.objects("events", mission.namespace)
        if mission.application in event["involvedObject"].get("name", "")
    ]
    content = {
        "objects": objects,
        "pods": list(mission.pods.values()),
        "times": mission.times,
        "links": mission.links,
        "audit": _fetch_audit_logs(kube, mission, folder / AUDIT),
        "results": len(_STORED_PICTURE.findall(logs.read_bytes())) if logs.exists() else 0,
    }
    (folder / OBJECTS).write_text(json.dumps(content, indent=1) + "\n")
    (folder / "events.json").write_text(json.dumps([_event(event) for event in events], indent=1) + "\n")


def _belongs_to(body: Object, mission: Mission) -> bool:
    """Return True for the mission's Application and its plan, and for objects that belong to no application."""
    if body["kind"] not in {"Application", "DeploymentPlan"}:
        return True
    metadata = body["metadata"]
    return bool(metadata["name"] == mission.application and metadata.get("namespace") == mission.namespace)


def _fetch_audit_logs(kube: Kube, mission: Mission, folder: Path) -> dict[str, Any]:
    """Fetch the audit logs of the drone, verify their chains, and count the entries of this mission."""
    if not mission.drone:
        return {}
    result: dict[str, Any] = {"entries": 0, "kept": 0, "problem": ""}
    try:
        fetch_audit_logs(kube, mobility_pod(kube, mission.drone), folder)
    except ExperimentError as error:
        return {**result, "problem": f"cannot be fetched: {error}"}
    window = TimeWindow(mission.times["applied"], mission.times.get("over", math.inf))
    for log in read_audit_logs([folder]):
        result["entries"] += log.length
        result["kept"] += sum(map(window.contains, log.entries))
        if log.problem and not result["problem"]:
            result["problem"] = f"{log.path.name}: {log.problem}"
    return result


def fetch_audit_logs(kube: Kube, pod: str, folder: Path) -> None:
    """Copy the audit logs of a node's services with all segments.

    A log may start a new segment during the copy. The copy is therefore repeated until the list of files is unchanged.

    Raises:
        ExperimentError: The logs cannot be read.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for _ in range(_FETCH_ATTEMPTS):
        names = _audit_files(kube, pod)
        for name in names:
            is_closed_segment = name.count(".") > 1
            if not (is_closed_segment and (folder / name).exists()):
                kube.fetch(pod, f"{_NODE_AUDIT_FOLDER}/{name}", folder / name)
        if _audit_files(kube, pod) == names:
            return
    raise ExperimentError(f"the audit log of pod {pod} rotates faster than it can be copied")


def _audit_files(kube: Kube, pod: str) -> list[str]:
    names = kube.run("exec", "-n", SYSTEM, pod, "--", "ls", _NODE_AUDIT_FOLDER).split()
    return sorted(name for name in names if _AUDIT_FILE.fullmatch(name))


def fetch_recordings(kube: Kube, drone: str, since_s: float, folder: Path) -> list[Path]:
    """Copy the recordings that the services of a drone wrote since a time (Unix seconds).

    A recording can begin before this time, because it includes the seconds before arming. The result is empty if the
    services do not record.

    Raises:
        ExperimentError: The recordings cannot be read.
    """
    pod = mobility_pod(kube, drone)
    listing = kube.run("exec", "-n", SYSTEM, pod, "--", "python3", "-c", _LIST_RECORDINGS, _NODE_RECORDINGS_FOLDER)
    recordings: list[Path] = []
    for line in sorted(listing.splitlines()):
        written_s, _, name = line.partition(" ")
        if float(written_s) >= since_s:
            copy = folder / RECORDINGS / name.replace("/", "-")
            copy.parent.mkdir(parents=True, exist_ok=True)
            kube.fetch(pod, f"{_NODE_RECORDINGS_FOLDER}/{name}", copy)
            recordings.append(copy)
    return recordings


def extract_pictures(recordings: Iterable[Path], record: FlightRecord, folder: Path) -> None:
    """Extract a few in-flight pictures, after privacy filters, from the recordings of the camera service.

    The image store of the camera service is not used, because components delete their pictures after retrieval.
    """
    if record.track.takeoff_s is None:
        return
    camera_recordings = [path for path in recordings if path.name.startswith("camera-")]
    pictures = {name: jpeg for path in camera_recordings for name, jpeg in _pictures(path)}
    (folder / PICTURES).mkdir(parents=True, exist_ok=True)
    for name in select_pictures(list(pictures), record.samples[0].time_s, record.samples[-1].time_s):
        (folder / PICTURES / name).write_bytes(pictures[name])


def _pictures(recording: Path) -> Iterator[tuple[str, bytes]]:
    """Yield names and contents of pictures. The names contain the capture time. Stop where a recording is damaged."""
    # The report must also be written if a recording is damaged.
    with recording.open("rb") as file, contextlib.suppress(McapError, KeyError, RuntimeError, ValueError):
        for schema, _, message in NonSeekingReader(file).iter_messages(log_time_order=False):
            if schema is not None and schema.name == "foxglove.CompressedImage":
                captured = datetime.fromtimestamp(message.log_time / 1e9, UTC)
                name = f"{captured:%Y%m%d%H%M%S}{captured.microsecond // 1000:03d}-{message.sequence:04d}.jpg"
                yield name, b64decode(json.loads(message.data)["data"])


def select_pictures(names: list[str], begin_s: float, end_s: float) -> list[str]:
    """Return the names of the pictures nearest to 25, 50 and 75 % of a time span, oldest first."""
    times = {name: picture_time_s(name) for name in names}
    in_span = [name for name in names if begin_s <= times[name] <= end_s]
    if not in_span:
        return []

    def nearest(time_s: float) -> str:
        return min(in_span, key=lambda name: abs(times[name] - time_s))

    selected = {nearest(begin_s + share * (end_s - begin_s)) for share in _PICTURE_SHARES}
    return sorted(selected, key=lambda name: times[name])


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

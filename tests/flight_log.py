"""Audit logs, recordings and flight plans of a recorded flight, for tests of the recording endpoint."""

from __future__ import annotations

import json
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from fractus_core.api.flight_plans import application_name
from fractus_core.api.names import component_identity
from fractus_services.recording import messages
from fractus_services.recording.segment_writer import McapWriter

Body = dict[str, Any]

UID = "0b5c9a3e-1111-4222-8333-444455556666"
NAMESPACE = "team"
APPLICATION = application_name(UID)
DRIVER = component_identity(NAMESPACE, APPLICATION, "Navigator", "navigator")
VIEWER = component_identity(NAMESPACE, APPLICATION, "AerialViewer", "viewer")
FOREIGN = component_identity("other", "flight-x", "Navigator", "navigator")
START = datetime(2026, 6, 1, 12, 0, 0, tzinfo=UTC)


def flight_plan(start: datetime = START, **status: Any) -> Body:
    """Return a plan of drone-1 whose flight has started."""
    window = {"start": start.strftime("%Y-%m-%dT%H:%M:%SZ"), "duration": 15}
    point = {"lat": 39.36, "lon": 22.93, "alt": 20}
    return {
        "apiVersion": "fractus.dev/v1alpha1",
        "kind": "FlightPlan",
        "metadata": {"name": "survey-1", "namespace": NAMESPACE, "uid": UID},
        "spec": {"template": "survey", "waypoints": [point], "window": window},
        "status": {"state": "Activated", "drone": "drone-1", "application": APPLICATION, **status},
    }


def at(second: float, kind: str, start: datetime = START, **content: Any) -> Body:
    """Return an entry of an audit log, some seconds after the start of the window."""
    return {"time": (start + timedelta(seconds=second)).isoformat(timespec="milliseconds"), "kind": kind, **content}


def grant(second: float, identity: str, change: str = "added") -> Body:
    return at(second, "grant", change=change, identity=identity, name="g", key=f"{identity}#m")


def state(second: float, *, lat: float = 39.36, controller: str = "system", in_air: bool = True) -> Body:
    content = {"lat": lat, "lon": 22.93, "alt": 10.0, "amsl": 60.0, "speed": 3.0, "mode": "GUIDED", "battery": 0.9}
    return at(second, "state", controller=controller, in_air=in_air, **content)


def call(second: float, caller: str, action: str = "allow", **more: Any) -> Body:
    content = {"method": "Goto", "action": action, "code": "", "reason": "", "policies": [], **more}
    return at(second, "call", caller=caller, lat=39.36, lon=22.93, alt=10.0, **content)


def write_log(path: Path, entries: Iterable[Body], first: int = 1) -> None:
    """Append entries to an audit log, without hashes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab") as file:
        for sequence, entry in enumerate(entries, first):
            numbered = {**entry, "seq": sequence}
            file.write(json.dumps(numbered, sort_keys=True, separators=(",", ":")).encode() + b"\n")


def write_pictures(path: Path, pictures: Iterable[tuple[float, str, bytes]], start: datetime = START) -> None:
    """Write a recording of pictures: seconds after the start, owner, and JPEG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        writer = McapWriter(file)
        for second, owner, jpeg in pictures:
            time_ns = round((start.timestamp() + second) * 1e9)
            record = messages.picture(time_ns, "drone-1", jpeg, owner)
            writer.write("/drone-1/picture", record.schema, time_ns, record.content)
            writer.flush()
        writer.close()

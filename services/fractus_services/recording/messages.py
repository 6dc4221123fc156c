"""Messages of a recording: Foxglove schemas as JSON, and schemas of Fractus for state, attitude and decisions."""

from __future__ import annotations

import json
import math
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

DEBUG = 1
INFO = 2
WARNING = 3
ERROR = 4
FATAL = 5
"""Levels of foxglove.Log."""

RESTRICTING_ACTIONS = frozenset({"correct", "deny", "takeover"})
"""Actions of verdicts that restricted a call."""

_NUMBER = {"type": "number"}
_TEXT = {"type": "string"}
_FLAG = {"type": "boolean"}
_INTEGER = {"type": "integer"}
_TEXTS = {"type": "array", "items": _TEXT}
_TIME = {"type": "object", "title": "time", "properties": {"sec": _INTEGER, "nsec": _INTEGER}}


def schema(title: str, /, **properties: Mapping[str, Any]) -> tuple[str, bytes]:
    """Return the name and the JSON schema of a message type."""
    return title, json.dumps({"title": title, "type": "object", "properties": properties}).encode()


SCHEMAS = dict(
    (
        schema(
            "foxglove.LocationFix", timestamp=_TIME, frame_id=_TEXT, latitude=_NUMBER, longitude=_NUMBER, altitude=_NUMBER,
            position_covariance={"type": "array", "items": _NUMBER}, position_covariance_type=_INTEGER,
        ),
        schema(
            "foxglove.Log", timestamp=_TIME, level=_INTEGER, message=_TEXT, name=_TEXT, file=_TEXT, line=_INTEGER
        ),
        schema("foxglove.GeoJSON", geojson=_TEXT),
        schema(
            "foxglove.CompressedImage", timestamp=_TIME, frame_id=_TEXT,
            data={"type": "string", "contentEncoding": "base64"}, format=_TEXT, owner=_TEXT,
        ),
        schema("fractus.Attitude", roll_rad=_NUMBER, pitch_rad=_NUMBER, yaw_rad=_NUMBER),
        schema(
            "fractus.State", altitude_m=_NUMBER, amsl_m=_NUMBER, speed_mps=_NUMBER, battery=_NUMBER, mode=_TEXT,
            controller=_TEXT, in_air=_FLAG,
        ),
        schema(
            "fractus.Decision", kind=_TEXT, caller=_TEXT, method=_TEXT, action=_TEXT, code=_TEXT, reason=_TEXT,
            policies=_TEXTS, takeover=_TEXT, controller=_TEXT, latitude=_NUMBER, longitude=_NUMBER, altitude_m=_NUMBER,
        ),
    )
)  # fmt: skip
"""JSON schemas by name. Foxglove recognises its own schemas by name."""


@dataclass(frozen=True, slots=True)
class Record:
    """One message of a recording.

    Attributes:
        topic: Topic without the name of the node.
        schema: Key of `SCHEMAS`.
        time_ns: Unix nanoseconds.
        content: Content that matches the schema.
    """

    topic: str
    schema: str
    time_ns: int
    content: Mapping[str, Any]


def location(time_ns: int, node: str, lat: float, lon: float, amsl_m: float) -> Record:
    """Return a position in degrees and metres above sea level."""
    content = {
        "timestamp": _timestamp(time_ns), "frame_id": node, "latitude": lat, "longitude": lon, "altitude": amsl_m,
        "position_covariance": [0.0] * 9, "position_covariance_type": 0,
    }  # fmt: skip
    return Record("location", "foxglove.LocationFix", time_ns, content)


def attitude(time_ns: int, roll_rad: float, pitch_rad: float, yaw_rad: float) -> Record:
    """Return an attitude. Nose up and right side down are positive, and yaw is measured from north to east."""
    angles = {"roll_rad": roll_rad, "pitch_rad": pitch_rad, "yaw_rad": yaw_rad}
    return Record("attitude", "fractus.Attitude", time_ns, angles)


def text(time_ns: int, topic: str, node: str, level: int, message: str) -> Record:
    """Return a log message."""
    content = {
        "timestamp": _timestamp(time_ns), "level": level, "message": message, "name": node, "file": "", "line": 0,
    }  # fmt: skip
    return Record(topic, "foxglove.Log", time_ns, content)


def zones(time_ns: int, features: Sequence[Mapping[str, Any]]) -> Record:
    """Return zones and areas as a GeoJSON feature collection (longitude before latitude)."""
    collection = {"type": "FeatureCollection", "features": list(features)}
    return Record("zones", "foxglove.GeoJSON", time_ns, {"geojson": json.dumps(collection, separators=(",", ":"))})


def picture(time_ns: int, node: str, jpeg: bytes, owner: str = "") -> Record:
    """Return an image. Its owner is the component instance that took it: uid of the Application, slash, SPIFFE ID."""
    content = {
        "timestamp": _timestamp(time_ns), "frame_id": node, "data": b64encode(jpeg).decode(), "format": "jpeg",
        "owner": owner,
    }  # fmt: skip
    return Record("picture", "foxglove.CompressedImage", time_ns, content)


def audit_records(entry: Mapping[str, Any], node: str) -> Iterable[Record]:
    """Yield the records of an audit log entry, or nothing if the entry is damaged.

    Entries of the kind `state` yield a `state` record. All others yield a `decisions` record and a readable `log` record.
    """
    time_ns = parse_time_ns(entry.get("time"))
    if time_ns is None:
        return
    kind = str(entry.get("kind", ""))
    if kind == "state":
        yield Record("state", "fractus.State", time_ns, _state(entry))
        return
    yield Record("decisions", "fractus.Decision", time_ns, _decision(kind, entry))
    yield text(time_ns, "log", node, level_of(entry), sentence(entry))


def sentence(entry: Mapping[str, Any]) -> str:
    """Return a readable line about an entry of any kind but `state`."""
    parts = (component_of(entry), entry.get("method"), entry.get("action") or entry.get("change"), entry.get("name"))
    head = " ".join(str(part) for part in parts if part) or str(entry.get("kind", ""))
    explanation = ", ".join(str(entry[key]) for key in ("code", "reason") if entry.get(key))
    return f"{head}: {explanation}" if explanation else head


def level_of(entry: Mapping[str, Any]) -> int:
    """Return the level of an entry for foxglove.Log."""
    if entry.get("kind") == "takeover" or entry.get("action") == "takeover":
        return ERROR
    return WARNING if entry.get("action") in RESTRICTING_ACTIONS or entry.get("kind") == "monitor" else INFO


def component_of(entry: Mapping[str, Any]) -> str:
    """Return the component that made the call, or an empty string for an action of the system."""
    return _component(str(entry.get("caller") or ""))


def controller_of(entry: Mapping[str, Any]) -> str:
    """Return the control authority: the component that is the driver, `system` or `pilot`. Empty if the entry has none."""
    controller = str(entry.get("controller") or "")
    return _component(controller) or controller


def _component(identity: str) -> str:
    """Return the component in a SPIFFE ID, or an empty string for any other text."""
    # Not `fractus_core.api.names.component_name`, whose import of pydantic would delay `fractus audit`.
    _, separator, rest = identity.partition("/component/")
    return rest.partition("/")[0] if separator else ""


def parse_time_ns(value: object) -> int | None:
    """Return the Unix nanoseconds of an entry's time, or None if it is invalid."""
    if not isinstance(value, str):
        return None
    try:
        time = datetime.fromisoformat(value)
        return round(time.timestamp() * 1e6) * 1000 if time.tzinfo is not None else None
    except (ValueError, OverflowError):
        return None


def finite_number(value: object) -> float | None:
    """Return a finite number, or None for any other value."""
    if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
        return float(value)
    return None


def _state(entry: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "altitude_m": finite_number(entry.get("alt")), "amsl_m": finite_number(entry.get("amsl")),
        "speed_mps": finite_number(entry.get("speed")), "battery": finite_number(entry.get("battery")),
        "mode": str(entry.get("mode", "")), "controller": str(entry.get("controller", "")),
        "in_air": bool(entry.get("in_air")),
    }  # fmt: skip


def _decision(kind: str, entry: Mapping[str, Any]) -> dict[str, Any]:
    policies = entry.get("policies")
    text_keys = ("caller", "method", "action", "code", "reason", "takeover", "controller")
    return {
        "kind": kind, **{key: str(entry.get(key) or "") for key in text_keys},
        "policies": [str(name) for name in policies] if isinstance(policies, list) else [],
        "latitude": finite_number(entry.get("lat")), "longitude": finite_number(entry.get("lon")),
        "altitude_m": finite_number(entry.get("alt")),
    }  # fmt: skip


def _timestamp(time_ns: int) -> dict[str, int]:
    return {"sec": time_ns // 1_000_000_000, "nsec": time_ns % 1_000_000_000}

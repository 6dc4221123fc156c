"""What a recording says: Foxglove's messages where it has them, as JSON, and ours for the rest."""

from __future__ import annotations

import json
import math
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

DEBUG, INFO, WARNING, ERROR, FATAL = 1, 2, 3, 4, 5
"""Levels of foxglove.Log."""

DECIDED = frozenset({"correct", "deny", "takeover"})
"""Actions of a verdict that changed what was asked."""

_NUMBER, _TEXT, _FLAG, _INTEGER = {"type": "number"}, {"type": "string"}, {"type": "boolean"}, {"type": "integer"}
_TEXTS = {"type": "array", "items": _TEXT}
_TIME = {"type": "object", "title": "time", "properties": {"sec": _INTEGER, "nsec": _INTEGER}}


def schema(title: str, /, **properties: Mapping[str, Any]) -> tuple[str, bytes]:
    """The name and the JSON schema of a kind of messages."""
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
            data={"type": "string", "contentEncoding": "base64"}, format=_TEXT,
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
"""JSON schemas by their names; Foxglove knows its own by these."""


@dataclass(frozen=True, slots=True)
class Record:
    """One message of a recording.

    Attributes:
        topic: below the name of the node.
        schema: a key of `SCHEMAS`.
        time_ns: Unix nanoseconds.
        content: by that schema.
    """

    topic: str
    schema: str
    time_ns: int
    content: Mapping[str, Any]


def location(time_ns: int, node: str, lat: float, lon: float, amsl_m: float) -> Record:
    """Where the drone was; degrees and metres above sea level."""
    content = {
        "timestamp": _stamp(time_ns), "frame_id": node, "latitude": lat, "longitude": lon, "altitude": amsl_m,
        "position_covariance": [0.0] * 9, "position_covariance_type": 0,
    }  # fmt: skip
    return Record("location", "foxglove.LocationFix", time_ns, content)


def attitude(time_ns: int, roll_rad: float, pitch_rad: float, yaw_rad: float) -> Record:
    """How the drone was turned: nose up and right side down are positive, yaw is from north to east."""
    angles = {"roll_rad": roll_rad, "pitch_rad": pitch_rad, "yaw_rad": yaw_rad}
    return Record("attitude", "fractus.Attitude", time_ns, angles)


def text(time_ns: int, topic: str, node: str, level: int, message: str) -> Record:
    """A line of a log."""
    content = {
        "timestamp": _stamp(time_ns), "level": level, "message": message, "name": node, "file": "", "line": 0,
    }  # fmt: skip
    return Record(topic, "foxglove.Log", time_ns, content)


def zones(time_ns: int, features: Sequence[Mapping[str, Any]]) -> Record:
    """Zones and areas on the map, as GeoJSON features (lon before lat)."""
    collection = {"type": "FeatureCollection", "features": list(features)}
    return Record("zones", "foxglove.GeoJSON", time_ns, {"geojson": json.dumps(collection, separators=(",", ":"))})


def picture(time_ns: int, node: str, jpeg: bytes) -> Record:
    """A picture."""
    content = {
        "timestamp": _stamp(time_ns), "frame_id": node, "data": b64encode(jpeg).decode(), "format": "jpeg",
    }  # fmt: skip
    return Record("picture", "foxglove.CompressedImage", time_ns, content)


def of_audit(entry: Mapping[str, Any], node: str) -> Iterable[Record]:
    """What an entry of an audit log says; nothing if it is damaged.

    The flight recorder's entries give `state`, all others `decisions`, and a line of `log` for people.
    """
    time_ns = moment_ns(entry.get("time"))
    if time_ns is None:
        return
    kind = str(entry.get("kind", ""))
    if kind == "state":
        yield Record("state", "fractus.State", time_ns, _state(entry))
        return
    yield Record("decisions", "fractus.Decision", time_ns, _decision(kind, entry))
    yield text(time_ns, "log", node, level_of(entry), sentence(entry))


def sentence(entry: Mapping[str, Any]) -> str:
    """An entry that is no state in one line."""
    parts = (component_of(entry), entry.get("method"), entry.get("action") or entry.get("change"), entry.get("name"))
    head = " ".join(str(part) for part in parts if part) or str(entry.get("kind", ""))
    why = ", ".join(str(entry[key]) for key in ("code", "reason") if entry.get(key))
    return f"{head}: {why}" if why else head


def level_of(entry: Mapping[str, Any]) -> int:
    """How much an entry matters, as a level of foxglove.Log."""
    if entry.get("kind") == "takeover" or entry.get("action") == "takeover":
        return ERROR
    return WARNING if entry.get("action") in DECIDED or entry.get("kind") == "monitor" else INFO


def component_of(entry: Mapping[str, Any]) -> str:
    """The component that called; empty for what the system did."""
    _, found, rest = str(entry.get("caller") or "").partition("/component/")
    return rest.partition("/")[0] if found else ""


def moment_ns(given: object) -> int | None:
    """Unix nanoseconds of an entry's time; None when it is none."""
    try:
        moment = datetime.fromisoformat(given) if isinstance(given, str) else None
        return round(moment.timestamp() * 1e6) * 1000 if moment is not None and moment.tzinfo is not None else None
    except (ValueError, OverflowError):
        return None


def number(given: object) -> float | None:
    """A finite number; None for anything else."""
    if isinstance(given, int | float) and not isinstance(given, bool) and math.isfinite(given):
        return float(given)
    return None


def _state(entry: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "altitude_m": number(entry.get("alt")), "amsl_m": number(entry.get("amsl")),
        "speed_mps": number(entry.get("speed")), "battery": number(entry.get("battery")),
        "mode": str(entry.get("mode", "")), "controller": str(entry.get("controller", "")),
        "in_air": bool(entry.get("in_air")),
    }  # fmt: skip


def _decision(kind: str, entry: Mapping[str, Any]) -> dict[str, Any]:
    policies = entry.get("policies")
    words = ("caller", "method", "action", "code", "reason", "takeover", "controller")
    return {
        "kind": kind, **{key: str(entry.get(key) or "") for key in words},
        "policies": [str(name) for name in policies] if isinstance(policies, list) else [],
        "latitude": number(entry.get("lat")), "longitude": number(entry.get("lon")),
        "altitude_m": number(entry.get("alt")),
    }  # fmt: skip


def _stamp(time_ns: int) -> dict[str, int]:
    return {"sec": time_ns // 1_000_000_000, "nsec": time_ns % 1_000_000_000}

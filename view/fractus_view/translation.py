"""Conversion of recorded messages to events."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from typing import Any

from fractus_view.events import Areas, Event, Fix, Note, Picture, State, Verdict
from fractus_view.mcap_tail import Told

PERIOD_MS = 200
"""Milliseconds between two published positions. They are recorded at 20 Hz and published at 5 Hz; the page draws lines between them."""

STILL_MS = 1_000
"""Milliseconds between two published positions that do not change."""


JUDGED = frozenset({"call", "monitor", "takeover"})
"""Kinds of audit entries that are verdicts. Other entries become log lines."""


class Translation:
    """Converter of one file's messages.

    Args:
        file: how the server knows the file that pictures are in.
    """

    def __init__(self, file: int) -> None:
        self._file = file
        self._heading: dict[str, float] = {}
        self._last: dict[str, Fix] = {}

    def events(self, told: Told) -> Iterator[Event]:
        """Return the events of a message; empty if it is irrelevant or does not match its schema."""
        _, node, topic = told.topic.split("/") if told.topic.count("/") == 2 else ("", "", "")
        content = told.content
        time_ms = told.time_ms
        match told.schema, topic:
            case "foxglove.LocationFix", _:
                yield from self._fix(node, time_ms, content)
            case "fractus.Attitude", _:
                yaw = _number(content.get("yaw_rad"))
                if yaw is not None:
                    self._heading[node] = round(math.degrees(yaw) % 360, 1)
            case "fractus.State", _:
                yield _state(node, time_ms, content)
            case "fractus.Decision", _ if content.get("kind") in JUDGED:
                yield _verdict(node, time_ms, content)
            case "foxglove.GeoJSON", _:
                yield from _areas(node, time_ms, content)
            case "foxglove.CompressedImage", _ if content.get("format") == "jpeg":
                yield Picture(node, time_ms, f"{self._file}-{told.place.offset}-{told.place.index}")
            case "foxglove.Log", _:
                level = content.get("level")
                yield Note(node, time_ms, level if isinstance(level, int) else 2, _text(content.get("message")))

    def _fix(self, node: str, time_ms: int, content: Mapping[str, Any]) -> Iterator[Fix]:
        lat = _number(content.get("latitude"))
        lon = _number(content.get("longitude"))
        if lat is None or lon is None or not (-90 <= lat <= 90 and -180 <= lon <= 180):
            return
        fix = Fix(node, time_ms, lat, lon, _number(content.get("altitude")), self._heading.get(node))
        last = self._last.get(node)
        if last is not None:
            still = (last.lat, last.lon, last.amsl_m, last.heading_deg) == (lat, lon, fix.amsl_m, fix.heading_deg)
            if 0 <= time_ms - last.time_ms < (STILL_MS if still else PERIOD_MS):
                return
        self._last[node] = fix
        yield fix


def _state(node: str, time_ms: int, content: Mapping[str, Any]) -> State:
    return State(
        drone=node,
        time_ms=time_ms,
        altitude_m=_number(content.get("altitude_m")),
        speed_mps=_number(content.get("speed_mps")),
        battery=_number(content.get("battery")),
        mode=_text(content.get("mode")),
        controller=who(content.get("controller")),
        phase="in the air" if content.get("in_air") is True else "on the ground",
    )


def _verdict(node: str, time_ms: int, content: Mapping[str, Any]) -> Verdict:
    policies = content.get("policies")
    return Verdict(
        drone=node,
        time_ms=time_ms,
        kind=_text(content.get("kind")),
        component=who(content.get("caller")) if content.get("caller") else "",
        method=_text(content.get("method")),
        action=_text(content.get("action")),
        code=_text(content.get("code")),
        reason=_text(content.get("reason")),
        policies=[str(name) for name in policies] if isinstance(policies, list) else [],
        lat=_number(content.get("latitude")),
        lon=_number(content.get("longitude")),
    )


def _areas(node: str, time_ms: int, content: Mapping[str, Any]) -> Iterator[Areas]:
    try:
        features = json.loads(content["geojson"])["features"]
    except (ValueError, KeyError, TypeError):
        return
    if isinstance(features, list):
        yield Areas(node, time_ms, [feature for feature in features if isinstance(feature, dict)])


def who(identity: object) -> str:
    """Return a short name of an identity: the component, or the last part."""
    text = _text(identity)
    _, found, rest = text.partition("/component/")
    return rest.partition("/")[0] if found else text.rpartition("/")[2]


def _text(given: object) -> str:
    return given if isinstance(given, str) else ""


def _number(given: object) -> float | None:
    """Return a finite number, or None for other values."""
    if isinstance(given, int | float) and not isinstance(given, bool) and math.isfinite(given):
        return float(given)
    return None

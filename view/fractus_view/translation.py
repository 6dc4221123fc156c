"""Conversion of recorded messages to events."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, cast

from fractus_runtime.files import parse_json
from fractus_runtime.mcap_tail import RecordedMessage

from fractus_view.events import Areas, Event, Feature, Fix, Note, Picture, State, Verdict

FIX_INTERVAL_MS = 200
"""Interval between two published positions of a moving drone. Recordings contain 20 positions per second."""

STILL_FIX_INTERVAL_MS = 1_000
"""Interval between two published positions of a drone that stands still."""

_DEFAULT_LEVEL = 2
"""Level of foxglove.Log of a log line without a level (information)."""

_RETURN_ACTIONS = frozenset({"returnToLaunch", "homeward", "RTL", "SMART_RTL"})
"""Actions of takeovers and changes of control after which the drone flies home."""

_RETURN_MODES = frozenset({"RTL", "SMART_RTL"})
"""Modes in which the autopilot itself flies home."""

ON_THE_GROUND = "on the ground"
"""Phase of a drone with stopped motors."""

VERDICT_KINDS = frozenset({"call", "monitor", "takeover"})
"""Kinds of audit entries that are verdicts. Other entries become log lines."""


class Translator:
    """Converts the messages of one file.

    Args:
        file: Number of the file, which the ids of its pictures contain.
    """

    def __init__(self, file: int) -> None:
        self._file = file
        self._heading: dict[str, float] = {}
        self._last: dict[str, Fix] = {}
        self._returning: set[str] = set()

    def events(self, message: RecordedMessage) -> Iterator[Event]:
        """Yield the events of a message. Messages that are irrelevant or do not match their schema have no events."""
        # Topics have the form /NODE/NAME.
        node = message.topic.split("/")[1] if message.topic.count("/") == 2 else ""
        content = message.content
        time_ms = message.time_ms
        match message.schema:
            case "foxglove.LocationFix":
                yield from self._fix(node, time_ms, content)
            case "fractus.Attitude":
                yaw = _number(content.get("yaw_rad"))
                if yaw is not None:
                    self._heading[node] = round(math.degrees(yaw) % 360, 1)
            case "fractus.State":
                yield _state(node, time_ms, content, returns=node in self._returning)
            case "fractus.Decision":
                self._follow_control(node, content)
                if content.get("kind") in VERDICT_KINDS:
                    yield _verdict(node, time_ms, content)
            case "foxglove.GeoJSON":
                yield from _areas(node, time_ms, content)
            case "foxglove.CompressedImage" if content.get("format") == "jpeg":
                location = message.location
                yield Picture(node, time_ms, f"{self._file}-{location.offset}-{location.index}")
            case "foxglove.Log":
                level = content.get("level")
                text = _text(content.get("message"))
                yield Note(node, time_ms, level if isinstance(level, int) else _DEFAULT_LEVEL, text)

    def _follow_control(self, node: str, content: Mapping[str, Any]) -> None:
        """Note from a change of control if the drone flies home."""
        action = _text(content.get("action"))
        match content.get("kind"):
            case "takeover":
                returns = action in _RETURN_ACTIONS
            # A driver that returns control for the last time gives the outcome of the mission as the reason.
            case "control" if action in {"returned", "granted", "landed", *_RETURN_ACTIONS}:
                returns = action in _RETURN_ACTIONS or (action == "returned" and bool(content.get("reason")))
            case _:
                return
        if returns:
            self._returning.add(node)
        else:
            self._returning.discard(node)

    def _fix(self, node: str, time_ms: int, content: Mapping[str, Any]) -> Iterator[Fix]:
        lat = _number(content.get("latitude"))
        lon = _number(content.get("longitude"))
        if lat is None or lon is None or not (-90 <= lat <= 90 and -180 <= lon <= 180):
            return
        fix = Fix(node, time_ms, lat, lon, _number(content.get("altitude")), self._heading.get(node))
        last = self._last.get(node)
        if last is not None:
            still = (last.lat, last.lon, last.amsl_m, last.heading_deg) == (lat, lon, fix.amsl_m, fix.heading_deg)
            if 0 <= time_ms - last.time_ms < (STILL_FIX_INTERVAL_MS if still else FIX_INTERVAL_MS):
                return
        self._last[node] = fix
        yield fix


def _state(node: str, time_ms: int, content: Mapping[str, Any], *, returns: bool) -> State:
    mode = _text(content.get("mode"))
    phase = ON_THE_GROUND
    if content.get("in_air") is True:
        phase = "returning" if returns or mode in _RETURN_MODES else "in the air"
    return State(
        drone=node,
        time_ms=time_ms,
        altitude_m=_number(content.get("altitude_m")),
        speed_mps=_number(content.get("speed_mps")),
        battery=_number(content.get("battery")),
        mode=mode,
        controller=short_name(content.get("controller")),
        phase=phase,
    )


def _verdict(node: str, time_ms: int, content: Mapping[str, Any]) -> Verdict:
    policies = content.get("policies")
    return Verdict(
        drone=node,
        time_ms=time_ms,
        kind=_text(content.get("kind")),
        component=short_name(content.get("caller")),
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
        features = parse_json(content["geojson"])["features"]
    except (ValueError, KeyError, TypeError):
        return
    if isinstance(features, list):
        yield Areas(node, time_ms, [cast(Feature, feature) for feature in features if isinstance(feature, dict)])


def short_name(identity: object) -> str:
    """Return the component in a SPIFFE id, or the last part of any other identity."""
    text = _text(identity)
    _, separator, rest = text.partition("/component/")
    return rest.partition("/")[0] if separator else text.rpartition("/")[2]


def _text(value: object) -> str:
    return value if isinstance(value, str) else ""


def _number(value: object) -> float | None:
    """Return a finite number, or None for other values."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return None
    try:
        number = float(value)
    except OverflowError:  # an integer above 1e308
        return None
    return number if math.isfinite(number) else None

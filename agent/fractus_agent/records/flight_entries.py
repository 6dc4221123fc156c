"""Entries of an audit log that belong to the flight of a plan. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import datetime
from typing import Any, cast

from fractus_core.api.flight_records import FlightVerdict, TrackPoint, VerdictKind
from fractus_core.api.names import ComponentIdentity, component_name
from fractus_core.control.vehicle_events import MOTORS_STOPPED

from fractus_agent.records.planned_flight import PlannedFlight

FlightRecord = FlightVerdict | TrackPoint

_VEHICLE_KINDS = frozenset({"takeover", "control", "monitor"})
"""Kinds of entries about the vehicle. They name no application."""

_LANDED = frozenset({"landed", MOTORS_STOPPED})
"""Actions of control entries that end a flight."""

_MAX_TEXT = 1000


class FlightEntries:
    """Selects the entries of one log, which must be taken in their order.

    Entries about the vehicle belong to the flight from its first Grant on. The flight ends when it has no Grant, and the drone is
    on the ground or a driver of another application has control. Entries about components of other applications never belong
    to the flight, even if the applications share it.

    Args:
        flight: The flight.
    """

    def __init__(self, flight: PlannedFlight) -> None:
        self._flight = flight
        self._grants: set[str] = set()
        self._in_air = False
        self._flying = False
        self._foreign_driver = False

    def take(self, entry: Mapping[str, Any]) -> FlightRecord | None:
        """Return the record of the next entry, or None if the entry does not belong to the flight."""
        kind = _text(entry.get("kind"))
        foreign_before = self._foreign_driver
        self._follow(kind, entry)
        time = entry_time(entry)
        if time is None or not self._flight.covers(time.timestamp()):
            return None
        if kind == "call":
            return _verdict("call", time, entry) if self._flight.owns(entry.get("caller")) else None
        if not self._flying:
            return None
        if kind == "state":
            return self._track_point(time, entry)
        if kind in _VEHICLE_KINDS and not (foreign_before or self._foreign_driver):
            return _verdict(cast("VerdictKind", kind), time, entry)
        return None

    def _follow(self, kind: str, entry: Mapping[str, Any]) -> None:
        """Follow the Grants of the flight and the state of the drone."""
        if "controller" in entry:
            self._foreign_driver = self._is_foreign(entry["controller"])
        if kind == "state":
            self._in_air = bool(entry.get("in_air"))
        elif kind == "started":
            # The service records all its Grants again after a restart.
            self._grants.clear()
        elif kind == "grant":
            self._follow_grant(entry)
        self._flying = bool(self._grants) or (self._flying and self._in_air and not self._foreign_driver)
        if kind == "control" and _text(entry.get("action")) in _LANDED:
            # The last state entry may be older than the landing. This entry still belongs to the flight.
            self._in_air = False

    def _follow_grant(self, entry: Mapping[str, Any]) -> None:
        identity = entry.get("identity")
        change = _text(entry.get("change"))
        if self._flight.owns(identity):
            if change == "removed":
                self._grants.discard(str(identity))
            elif change in {"added", "changed"}:
                self._grants.add(str(identity))
        elif change == "added" and not self._grants:
            # The drone flies for another application from now on.
            self._flying = False

    def _is_foreign(self, controller: object) -> bool:
        identity = ComponentIdentity.parse(str(controller))
        return identity is not None and not self._flight.owns(controller)

    def _track_point(self, time: datetime, entry: Mapping[str, Any]) -> TrackPoint:
        controller = "other" if self._foreign_driver else component_name(_text(entry.get("controller")))
        return TrackPoint(
            time=time,
            lat=_number(entry.get("lat")),
            lon=_number(entry.get("lon")),
            alt=_number(entry.get("alt")),
            amsl=_number(entry.get("amsl")),
            speed=_number(entry.get("speed")),
            battery=_number(entry.get("battery")),
            mode=_text(entry.get("mode")),
            controller=controller,
            in_air=self._in_air,
        )


def entry_time(entry: Mapping[str, Any]) -> datetime | None:
    """Return the time of an entry, or None if it is invalid."""
    try:
        time = datetime.fromisoformat(str(entry.get("time")))
    except ValueError:
        return None
    return time if time.tzinfo is not None else None


def _verdict(kind: VerdictKind, time: datetime, entry: Mapping[str, Any]) -> FlightVerdict:
    return FlightVerdict(
        time=time,
        kind=kind,
        component=component_name(_text(entry.get("caller"))),
        method=_text(entry.get("method")),
        action=_text(entry.get("action")),
        code=_text(entry.get("code")),
        reason=_text(entry.get("reason")),
        policies=_texts(entry.get("policies")),
        filters=_texts(entry.get("filters")),
        lat=_number(entry.get("lat")),
        lon=_number(entry.get("lon")),
        alt=_number(entry.get("alt")),
    )


def _text(value: object) -> str:
    """Return a value as text.

    The log represents bytes that are not UTF-8, such as those of file names, as lone surrogates. They are escaped, because UTF-8
    cannot encode them.
    """
    return str(value)[:_MAX_TEXT].encode(errors="backslashreplace").decode() if value else ""


def _texts(value: object) -> tuple[str, ...]:
    return tuple(_text(item) for item in value[:100]) if isinstance(value, list) else ()


def _number(value: object) -> float | None:
    """Return a finite number, or None for any other value. The log contains NaN as text."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None

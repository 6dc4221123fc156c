"""Evidence of one run, read from the tlog of the autopilot link and the audit logs of both services."""

from __future__ import annotations

import bisect
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from fractus_core.api.names import component_name
from fractus_runtime.audit_chain import entries
from fractus_runtime.mavlink_codec import Message, Parser, enum_names
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_sim.report.flight_record import JudgedCall
from fractus_sim.report.track import Place, Sample, Track
from fractus_sim.testbeds.ground_station import FLYING_STATES
from fractus_sim.testbeds.tlog import read_tlog

_SAMPLE_S = 0.2
_GROUND_M = 0.5
SYSTEM = "system"


@dataclass(frozen=True)
class Evidence:
    """Evidence of one run.

    Attributes:
        policies: True if policies applied.
        track: Flight, on the clock of the autopilot.
        calls: Calls of the components and actions of the system, in order.
        texts: STATUSTEXT messages of the autopilot.
        position_errors: Horizontal accuracies that the GPS receiver reported: time in seconds, and error in metres.
    """

    name: str
    title: str
    policies: bool
    track: Track
    calls: tuple[JudgedCall, ...]
    texts: tuple[str, ...]
    position_errors: tuple[tuple[float, float], ...] = ()

    def gotos(self) -> list[JudgedCall]:
        """Return all Goto calls, including the calls of the system during transit flights."""
        return [c for c in self.calls if c.method == "Goto" and c.requested is not None]

    def pictures(self, *, taken: bool) -> list[JudgedCall]:
        """Return the executed CaptureImage calls, or with `taken=False` the calls that a policy denied."""
        calls = [c for c in self.calls if c.method == "CaptureImage" and c.position is not None]
        if taken:
            return [c for c in calls if not c.refused]
        return [c for c in calls if c.refused and c.code != "OutsideOperationArea"]

    def takeover(self) -> JudgedCall | None:
        """Return the action by which the system took control permanently. Return None if it never took control."""
        return next(
            (c for c in self.calls if c.caller == SYSTEM and c.method in ("landAt", "revoke", "returnToLaunch")), None
        )


def read_evidence(name: str, title: str, *, policies: bool, tlog: Path, audits: tuple[Path, ...]) -> Evidence:
    """Read a run.

    Raises:
        OSError: A log is missing.
        ValueError: The tlog contains no flight.
    """
    flight = _read_flight(tlog)
    calls = [
        call
        for path in audits
        for entry in entries(path.read_bytes().splitlines())
        if (call := _call(entry, flight.clock)) is not None
    ]
    return Evidence(
        name,
        title,
        policies,
        Track(title, tuple(flight.samples)),
        tuple(sorted(calls, key=lambda c: c.time_s)),
        tuple(flight.texts),
        tuple(flight.position_errors),
    )


class _AutopilotClock:
    """Converts Unix time to the clock of the autopilot. The clock runs faster in an accelerated simulation."""

    def __init__(self) -> None:
        self._unix_s: list[float] = []
        self._boot_s: list[float] = []

    def add(self, unix_s: float, boot_s: float) -> None:
        """Add a pair of corresponding times."""
        if not self._unix_s or unix_s > self._unix_s[-1]:
            self._unix_s.append(unix_s)
            self._boot_s.append(boot_s)

    def boot_s(self, unix_s: float) -> float:
        """Return the autopilot's time for a Unix time, by interpolation or extrapolation."""
        if len(self._unix_s) < 2:
            raise ValueError("the log of the link to the autopilot has no positions")
        index = min(max(bisect.bisect(self._unix_s, unix_s), 1), len(self._unix_s) - 1)
        first = self._unix_s[index - 1]
        last = self._unix_s[index]
        share = (unix_s - first) / (last - first)
        return self._boot_s[index - 1] + share * (self._boot_s[index] - self._boot_s[index - 1])


def _messages(path: Path) -> Iterator[tuple[float, Message]]:
    """Yield the messages of a tlog with their Unix times in seconds."""
    parser = Parser()
    for time_s, frame in read_tlog(path.read_bytes()):
        for message in parser.feed(frame):
            yield time_s, message


class _Flight:
    """Contents of a tlog."""

    def __init__(self) -> None:
        self.samples: list[Sample] = []
        self.clock = _AutopilotClock()
        self.texts: list[str] = []
        self.position_errors: list[tuple[float, float]] = []


def _read_flight(path: Path) -> _Flight:
    """Read the messages of the autopilot in a tlog."""
    flight = _Flight()
    samples = flight.samples
    mode = ""
    armed = False
    landed_state = 0
    battery = 1.0
    for unix_s, message in _messages(path):
        if message.compid != mavlink.MAV_COMP_ID_AUTOPILOT1:
            continue
        if message.name == "HEARTBEAT":
            number = message.integer("custom_mode")
            mode = enum_names("COPTER_MODE").get(number, f"MODE {number}")
            armed = bool(message.integer("base_mode") & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        elif message.name == "EXTENDED_SYS_STATE":
            landed_state = message.integer("landed_state")
        elif message.name == "SYS_STATUS":
            battery = max(message.integer("battery_remaining"), 0) / 100.0
        elif message.name == "STATUSTEXT":
            flight.texts.append(message.text("text"))
        elif message.name == "GPS_RAW_INT" and samples:
            flight.position_errors.append((samples[-1].time_s, message.integer("h_acc") / 1000.0))
        elif message.name == "GLOBAL_POSITION_INT":
            boot_s = message.integer("time_boot_ms") / 1000.0
            flight.clock.add(unix_s, boot_s)
            if samples and boot_s - samples[-1].time_s < _SAMPLE_S:
                continue
            altitude_m = message.integer("relative_alt") / 1000.0
            place = Place(message.integer("lat") / 1e7, message.integer("lon") / 1e7, altitude_m)
            speed_mps = (message.integer("vx") ** 2 + message.integer("vy") ** 2) ** 0.5 / 100.0
            in_air = armed and _is_flying(landed_state, altitude_m)
            samples.append(Sample(boot_s, place, speed_mps, mode, in_air, battery))
    if samples and not armed:
        # The vehicle has disarmed after the last recorded position.
        samples[-1] = replace(samples[-1], in_air=False)
    return flight


def _is_flying(landed_state: int, altitude_m: float) -> bool:
    """Return True if the vehicle is in the air. If the landed state is unknown, compare the altitude with a limit."""
    return landed_state in FLYING_STATES if landed_state else altitude_m > _GROUND_M


def _call(entry: Mapping[str, Any], clock: _AutopilotClock) -> JudgedCall | None:
    """Return the component's call or the system's action in an audit log entry. Return None for other entries."""
    if entry.get("kind") not in ("call", "takeover", "control"):
        return None
    is_call = entry["kind"] == "call"
    caller = str(entry.get("caller", ""))
    return JudgedCall(
        time_s=clock.boot_s(datetime.fromisoformat(entry["time"]).timestamp()),
        caller=component_name(caller) if is_call and caller else SYSTEM,
        method=str(entry["method"] if is_call else entry.get("action", "")),
        action=str(entry.get("action", "")) if is_call else "",
        code=str(entry.get("code", "")),
        reason=str(entry.get("reason", "")),
        policies=tuple(entry.get("policies", ())),
        requested=_place(entry.get("args") or {}),
        flown=_place(entry.get("result") or {}),
        position=_place(entry),
    )


def _place(values: Mapping[str, Any]) -> Place | None:
    if values.get("lat") is None or values.get("lon") is None:
        return None
    return Place(float(values["lat"]), float(values["lon"]), float(values.get("alt") or 0.0))

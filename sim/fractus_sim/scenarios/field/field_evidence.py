"""Evidence of one run, read from the autopilot link log and the audit logs of both services."""

from __future__ import annotations

import bisect
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from fractus_runtime.audit_chain import entries
from fractus_runtime.mavlink_codec import Message, Parser, enum_names
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_sim.report.track import Place, Sample, Track
from fractus_sim.testbeds.ground_station import FLYING_STATES
from fractus_sim.testbeds.tlog import read_tlog

_SAMPLE_S = 0.2
SYSTEM = "system"


@dataclass(frozen=True, slots=True)
class Call:
    """A call with its verdict, or an action of the system.

    Attributes:
        time_s: Time on the autopilot's clock.
        who: Component, or `system`.
        method: Service method. For actions of the system: takeover or type of control.
        action: allow, correct, deny, or takeover (denied, and control revoked). Empty for actions of the system.
        asked: Requested position of a Goto.
        flown: Position that was flown.
        at: Position of the drone.
    """

    time_s: float
    who: str
    method: str
    action: str
    code: str
    reason: str
    policies: tuple[str, ...]
    asked: Place | None
    flown: Place | None
    at: Place | None

    @property
    def refused(self) -> bool:
        """True if no part of the call was executed."""
        return self.action in ("deny", "takeover")


@dataclass(frozen=True)
class Evidence:
    """Evidence of one run."""

    name: str
    title: str
    policies: bool
    track: Track
    calls: tuple[Call, ...]
    texts: tuple[str, ...]

    def gotos(self) -> list[Call]:
        """Goto calls, including those of the system during transit flights."""
        return [c for c in self.calls if c.method == "Goto" and c.asked is not None]

    def pictures(self, *, taken: bool) -> list[Call]:
        """CaptureImage calls that were executed, or denied because of their footprint."""
        asked = [c for c in self.calls if c.method == "CaptureImage" and c.at is not None]
        if taken:
            return [c for c in asked if not c.refused]
        return [c for c in asked if c.refused and c.code != "OutsideOperationArea"]

    def takeover(self) -> Call | None:
        """Time when the system took control permanently."""
        return next((c for c in self.calls if c.who == SYSTEM and c.method in ("revoke", "returnToLaunch")), None)


def read_evidence(name: str, title: str, *, policies: bool, tlog: Path, audits: tuple[Path, ...]) -> Evidence:
    """Read a run.

    Raises:
        OSError: A log is missing.
        ValueError: The tlog contains no flight.
    """
    samples, clock, texts = _flight(tlog)
    calls = [
        call
        for path in audits
        for entry in entries(path.read_bytes().splitlines())
        if (call := _call(entry, clock)) is not None
    ]
    return Evidence(
        name, title, policies, Track(title, samples), tuple(sorted(calls, key=lambda c: c.time_s)), tuple(texts)
    )


class _Clock:
    """Conversion from Unix time to the autopilot's clock, which runs faster in an accelerated simulation."""

    def __init__(self) -> None:
        self._unix: list[float] = []
        self._boot: list[float] = []

    def note(self, unix_s: float, boot_s: float) -> None:
        """Add a pair of corresponding times."""
        if not self._unix or unix_s > self._unix[-1]:
            self._unix.append(unix_s)
            self._boot.append(boot_s)

    def boot_s(self, unix_s: float) -> float:
        """Return the autopilot's time by interpolation or extrapolation."""
        if len(self._unix) < 2:
            raise ValueError("the log of the link to the autopilot has no positions")
        high = min(max(bisect.bisect(self._unix, unix_s), 1), len(self._unix) - 1)
        first = self._unix[high - 1]
        last = self._unix[high]
        share = (unix_s - first) / (last - first)
        return self._boot[high - 1] + share * (self._boot[high] - self._boot[high - 1])


def _frames(path: Path) -> Iterator[tuple[float, Message]]:
    """Yield the messages of a tlog with their Unix times in seconds."""
    parser = Parser()
    for time_s, frame in read_tlog(path.read_bytes()):
        for message in parser.feed(frame):
            yield time_s, message


def _flight(path: Path) -> tuple[tuple[Sample, ...], _Clock, list[str]]:
    clock = _Clock()
    samples = list[Sample]()
    texts = list[str]()
    mode = ""
    armed = False
    landed = 0
    battery = 1.0
    for unix_s, message in _frames(path):
        if message.compid != mavlink.MAV_COMP_ID_AUTOPILOT1:
            continue
        if message.name == "HEARTBEAT":
            number = message.integer("custom_mode")
            mode = enum_names("COPTER_MODE").get(number, f"MODE {number}")
            armed = bool(message.integer("base_mode") & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        elif message.name == "EXTENDED_SYS_STATE":
            landed = message.integer("landed_state")
        elif message.name == "SYS_STATUS":
            battery = max(message.integer("battery_remaining"), 0) / 100.0
        elif message.name == "STATUSTEXT":
            texts.append(message.text("text"))
        elif message.name == "GLOBAL_POSITION_INT":
            boot_s = message.integer("time_boot_ms") / 1000.0
            clock.note(unix_s, boot_s)
            if samples and boot_s - samples[-1].time_s < _SAMPLE_S:
                continue
            height = message.integer("relative_alt") / 1000.0
            place = Place(message.integer("lat") / 1e7, message.integer("lon") / 1e7, height)
            speed = (message.integer("vx") ** 2 + message.integer("vy") ** 2) ** 0.5 / 100.0
            in_air = armed and (landed in FLYING_STATES if landed else height > 0.5)
            samples.append(Sample(boot_s, place, speed, mode, in_air, battery))
    if samples and not armed:
        # The autopilot may have disarmed after the last recorded position.
        samples[-1] = replace(samples[-1], in_air=False)
    return tuple(samples), clock, texts


def _call(entry: Mapping[str, Any], clock: _Clock) -> Call | None:
    if entry.get("kind") not in ("call", "takeover", "control"):
        return None
    mine = entry["kind"] == "call"
    caller = str(entry.get("caller", ""))
    who = caller.split("/component/", 1)[-1].split("/", 1)[0] if mine and caller else SYSTEM
    return Call(
        time_s=clock.boot_s(datetime.fromisoformat(entry["time"]).timestamp()),
        who=who,
        method=str(entry["method"] if mine else entry.get("action", "")),
        action=str(entry.get("action", "")) if mine else "",
        code=str(entry.get("code", "")),
        reason=str(entry.get("reason", "")),
        policies=tuple(entry.get("policies", ())),
        asked=_place(entry.get("args") or {}),
        flown=_place(entry.get("result") or {}),
        at=_place(entry),
    )


def _place(values: Mapping[str, Any]) -> Place | None:
    if values.get("lat") is None or values.get("lon") is None:
        return None
    return Place(float(values["lat"]), float(values["lon"]), float(values.get("alt") or 0.0))

"""The status of the node's Drone or EdgeNode: what it says, and when it is worth a write."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, get_args

from fractus_core.api.names import CONTROL_TAKEN
from fractus_core.api.nodes import (
    DRONE_REPORT_S,
    EDGE_REPORT_S,
    FLIGHT_REPORT_S,
    FlightState,
    is_airborne,
)

from fractus_agent.cluster.store import Object, Store
from fractus_agent.conditions import Condition, timestamp, to_kubernetes
from fractus_agent.supervisor import repeat
from fractus_agent.telemetry.snapshot import Snapshot

LOG = logging.getLogger(__name__)

_FLIGHT_STATES = get_args(FlightState)
_DEGREE_M = 111_320.0
SETTLING_S = 5.0
"""Seconds after its start in which an agent that has heard nothing of the drone yet says nothing of it either."""
STILL_M = 2.0
"""Metres that the position of a drone on the ground wanders by GPS noise: not worth a write."""


@dataclass(frozen=True, slots=True)
class Pace:
    """Seconds between writes of a status."""

    urgent_s: float = 1.0
    """After a change of flight state, controller or a condition."""
    moving_s: float = 10.0
    """After a change of position or battery."""
    idle_s: float = DRONE_REPORT_S
    """When nothing changed: lastSeen only."""


FLIGHT_PACE = Pace(moving_s=FLIGHT_REPORT_S, idle_s=FLIGHT_REPORT_S)
DRONE_PACE = Pace()
EDGE_PACE = Pace(idle_s=EDGE_REPORT_S)


@dataclass(frozen=True, slots=True)
class Observed:
    """All that the agent knows of its node now."""

    kind: str
    has_mobility: bool
    needs_certificate: bool
    certified: Condition
    snapshot: Snapshot | None = None
    problem: str | None = None
    described: Condition | None = None
    handed: Condition | None = None
    audit: Sequence[str] = ()
    unrecorded: Sequence[str] = ()
    """Why services other than mobility record nothing that should."""


def readiness(observed: Observed) -> Condition:
    """Whether components can work on the node, and the first problem otherwise."""

    def unready(reason: str, message: str) -> Condition:
        return Condition("Ready", "False", reason, message)

    seen = observed.snapshot
    if observed.needs_certificate and not observed.certified.is_true:
        return unready("NoCertificate", observed.certified.message)
    if not observed.has_mobility:
        return Condition("Ready", "True", "AgentRunning", "The node's agent runs.")
    if observed.problem is not None or seen is None:
        return unready("MobilityUnreachable", observed.problem or "The mobility service has not answered yet.")
    if not seen.connected:
        return unready("AutopilotDisconnected", "The mobility service has no link to the autopilot.")
    if not (seen.ready or seen.in_air):
        return unready("AutopilotNotReady", f"The autopilot would not arm now (mode {seen.mode or 'unknown'}).")
    return Condition("Ready", "True", "AutopilotReady", "The mobility service answers and the autopilot is ready.")


def node_status(observed: Observed, previous: Object, generation: int | None, now: datetime) -> dict[str, Any]:
    """The status to write.

    What cannot be seen now is unknown, not what it was: the last flight state is kept beside it, and where the drone was.
    """
    conditions = [readiness(observed), observed.certified]
    conditions += [
        more
        for more in (observed.described, observed.handed, _unrecorded(observed), _taken(observed))
        if more is not None
    ]
    status: dict[str, Any] = {
        "lastSeen": timestamp(now),
        "conditions": to_kubernetes(conditions, previous.get("conditions") or (), generation, now),
    }
    if audit := list(observed.audit) or previous.get("audit"):
        status["audit"] = audit
    if observed.kind == "Drone":
        seen = observed.snapshot if observed.problem is None else None
        status |= {key: previous[key] for key in ("position", "battery") if key in previous}
        status |= {"flightState": "unknown"} | (_flight(seen) if seen is not None else {})
        if status["flightState"] != "unknown":
            status["lastFlightState"] = status["flightState"]
        elif (last := _last_known(previous)) is not None:
            status["lastFlightState"] = last
    return status


def _unrecorded(observed: Observed) -> Condition | None:
    """That flights or pictures are not recorded though they should be; nothing is told while they are."""
    flights = observed.snapshot.recording_problem if observed.snapshot is not None else ""
    problem = "; ".join(filter(None, (flights, *observed.unrecorded)))
    return Condition("Recording", "False", "RecordingStopped", problem) if problem else None


def _taken(observed: Observed) -> Condition | None:
    """That the system or a pilot has control in flight, and why; nothing is told while a driver has, or it is not known."""
    seen = observed.snapshot if observed.problem is None else None
    if seen is None or not (seen.connected and seen.in_air and seen.controller_reason):
        return None
    by = {"pilot": "PilotInControl", "system": "SystemInControl"}.get(seen.controller)
    return Condition(CONTROL_TAKEN, "True", by, seen.controller_reason) if by else None


def _last_known(previous: Object) -> str | None:
    now, last = previous.get("flightState", "unknown"), previous.get("lastFlightState")
    return last if now == "unknown" else now


def _flight(seen: Snapshot) -> dict[str, Any]:
    flight: dict[str, Any] = {}
    # Without its autopilot the mobility service knows no more than before.
    if seen.connected and seen.flight_state in _FLIGHT_STATES:
        flight["flightState"] = seen.flight_state
    if seen.controller:
        flight["controller"] = seen.controller
    if seen.position is not None:
        lat, lon, alt, reference = seen.position
        flight["position"] = {
            "lat": round(lat, 7), "lon": round(lon, 7), "alt": round(alt, 2), "altitudeReference": reference,
        }  # fmt: skip
    if seen.connected:
        flight["battery"] = {
            "remaining": round(seen.battery_remaining, 2),
            "voltage": round(seen.battery_voltage_v, 1),
            "current": round(seen.battery_current_a, 1),
        }
    return flight


def pace_of(kind: str, status: Object) -> Pace:
    """How often a status is written: most often that of a drone in the air, so that its silence is noticed soon."""
    if kind != "Drone":
        return EDGE_PACE
    return FLIGHT_PACE if is_airborne(status["flightState"], status.get("lastFlightState")) else DRONE_PACE


def due_s(old: Object | None, new: Object, since_s: float, pace: Pace) -> float:
    """Seconds until the new status is to be written, given the one written since_s ago; 0: now."""
    if old is None:
        return 0.0
    if _urgent(old) != _urgent(new):
        wait_s = pace.urgent_s
    elif _moved(old, new):
        wait_s = pace.moving_s
    else:
        wait_s = pace.idle_s
    return max(0.0, wait_s - since_s)


def _urgent(status: Object) -> tuple[object, ...]:
    facts: Sequence[Object] = status.get("conditions") or ()
    return (
        status.get("flightState"),
        status.get("controller"),
        tuple((c["type"], c["status"], c["reason"], c.get("observedGeneration")) for c in facts),
    )


def _moved(old: Object, new: Object) -> bool:
    messages = [[c.get("message") for c in status.get("conditions") or ()] for status in (old, new)]
    if messages[0] != messages[1]:
        return True
    charge = [(status.get("battery") or {}).get("remaining", 0.0) for status in (old, new)]
    if abs(charge[0] - charge[1]) >= 0.01:
        return True
    before, after = old.get("position"), new.get("position")
    if before is None or after is None:
        return before is not after
    north_m = (after["lat"] - before["lat"]) * _DEGREE_M
    east_m = (after["lon"] - before["lon"]) * _DEGREE_M * math.cos(math.radians(before["lat"]))
    return math.hypot(north_m, east_m, (after.get("alt") or 0.0) - (before.get("alt") or 0.0)) > STILL_M


class StatusReporter:
    """Writes the node's status when it is due.

    Args:
        store: where to.
        body: the Drone or EdgeNode as the API server has it now, None while it is absent.
        observe: what the agent knows now, given that object.
        written: takes the object that a write returned; None when the object is gone.
        wall: the wall clock, for time stamps.
        monotonic: seconds that never jump, for the pace.
    """

    def __init__(
        self,
        store: Store,
        *,
        body: Callable[[], Object | None],
        observe: Callable[[Object], Observed],
        written: Callable[[Object | None], None],
        wall: Callable[[], datetime],
        monotonic: Callable[[], float],
    ) -> None:
        self._store = store
        self._body = body
        self._observe = observe
        self._written = written
        self._wall = wall
        self._monotonic = monotonic
        self._last: Object | None = None
        self._last_uid: str | None = None
        self._last_s = -math.inf
        self._settled_s = monotonic() + SETTLING_S
        self._changed = asyncio.Event()

    @property
    def age_s(self) -> float:
        """Seconds since the API server took a status; infinite before that."""
        return self._monotonic() - self._last_s

    def changed(self) -> None:
        """Something may have changed."""
        self._changed.set()

    async def run(self) -> None:
        """Report until cancelled."""
        await repeat("status", self.step, self._changed)

    async def step(self) -> float:
        """Write the status if it is due; seconds until it will be if nothing happens."""
        body = self._body()
        if body is None:
            return 5.0
        observed = self._observe(body)
        settling_s = self._settled_s - self._monotonic()
        if observed.has_mobility and observed.snapshot is None and settling_s > 0:
            return settling_s
        metadata = body["metadata"]
        if metadata.get("uid") != self._last_uid:
            self._last = None
        previous = self._last or body.get("status") or {}
        status = node_status(observed, previous, metadata.get("generation"), self._wall())
        pace = pace_of(observed.kind, status)
        wait_s = due_s(self._last, status, self._monotonic() - self._last_s, pace)
        if wait_s > 0:
            return wait_s
        result = await self._store.apply_status(observed.kind, metadata["name"], status)
        self._written(result)
        if result is None:
            self._last = None
            return 5.0
        self._last, self._last_uid, self._last_s = status, metadata.get("uid"), self._monotonic()
        return pace.moving_s

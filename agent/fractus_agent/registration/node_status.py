"""Status of the node's Drone or EdgeNode, and the intervals at which it is written."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, get_args

from fractus_core.api.conditions import ConditionUpdate, merge_conditions
from fractus_core.api.model import Condition, timestamp
from fractus_core.api.names import CONTROL_TAKEN, component_name
from fractus_core.api.nodes import (
    DRONE_REPORT_S,
    EDGE_REPORT_S,
    FLIGHT_REPORT_S,
    FlightState,
    is_airborne,
)

from fractus_agent.store import Object, Store
from fractus_agent.supervisor import repeat
from fractus_agent.telemetry import TelemetrySnapshot

log = logging.getLogger(__name__)

_FLIGHT_STATES = get_args(FlightState)
_DEGREE_M = 111_320.0
STARTUP_GRACE_S = 5.0
"""Seconds for which a started agent of a drone waits for the first telemetry before it writes a status without telemetry."""
GPS_NOISE_M = 2.0
"""Movement up to this distance in metres is not reported, because a drone on the ground has GPS noise of this size."""


@dataclass(frozen=True, slots=True)
class ReportIntervals:
    """Minimum seconds between writes of a status, by what has changed.

    Attributes:
        urgent_s: After a change of flight state, controller or a condition.
        moving_s: After a change of position or battery.
        idle_s: Without a change, to update lastSeen.
    """

    urgent_s: float = 1.0
    moving_s: float = 10.0
    idle_s: float = DRONE_REPORT_S


FLIGHT_INTERVALS = ReportIntervals(moving_s=FLIGHT_REPORT_S, idle_s=FLIGHT_REPORT_S)
DRONE_INTERVALS = ReportIntervals()
EDGE_INTERVALS = ReportIntervals(idle_s=EDGE_REPORT_S)


@dataclass(frozen=True, slots=True)
class NodeObservation:
    """Current observations of the agent about its node.

    Attributes:
        kind: Drone or EdgeNode.
        has_mobility: True if the node has a mobility service.
        needs_certificate: True if the node has services.
        certified: Condition Certified.
        snapshot: Latest telemetry, None before the first message.
        telemetry_problem: Reason why telemetry is unavailable, otherwise None.
        described: Condition Described, None if there is no problem.
        camera_described: Condition CameraDescribed, None if there is no problem.
        audit_heads: Heads of the audit logs.
        recording_problems: Reasons why services other than mobility record nothing although they should.
        gateway_problem: Reason why MAVLink programs cannot fly, empty for none.
        records_address: Address of the recording endpoint, empty for none.
    """

    kind: str
    has_mobility: bool
    needs_certificate: bool
    certified: ConditionUpdate
    snapshot: TelemetrySnapshot | None = None
    telemetry_problem: str | None = None
    described: ConditionUpdate | None = None
    camera_described: ConditionUpdate | None = None
    audit_heads: Sequence[str] = ()
    recording_problems: Sequence[str] = ()
    gateway_problem: str = ""
    records_address: str = ""


def ready_condition(observed: NodeObservation) -> ConditionUpdate:
    """Return the condition Ready. It is True if components can work on the node, otherwise it contains the first problem."""

    def unready(reason: str, message: str) -> ConditionUpdate:
        return ConditionUpdate("Ready", "False", reason, message)

    snapshot = observed.snapshot
    if observed.needs_certificate and observed.certified.status != "True":
        return unready("NoCertificate", observed.certified.message)
    if not observed.has_mobility:
        return ConditionUpdate("Ready", "True", "AgentRunning", "The node's agent is running.")
    if observed.telemetry_problem is not None or snapshot is None:
        return unready(
            "MobilityUnreachable", observed.telemetry_problem or "The mobility service has not responded yet."
        )
    if not snapshot.connected:
        return unready("AutopilotDisconnected", "The mobility service has no connection to the autopilot.")
    if not (snapshot.ready or snapshot.in_air):
        return unready("AutopilotNotReady", f"The autopilot would not arm now (mode {snapshot.mode or 'unknown'}).")
    return ConditionUpdate(
        "Ready", "True", "AutopilotReady", "The mobility service is reachable and the autopilot is ready."
    )


def node_status(observed: NodeObservation, previous: Object, generation: int | None, now: datetime) -> dict[str, Any]:
    """Return the status to write.

    Without telemetry the flight state is unknown. The last flight state, position and battery stay in the status.

    Args:
        observed: Current observations.
        previous: Status as last written, empty for none.
        generation: metadata.generation of the object, None if unknown.
        now: Wall clock time.
    """
    conditions = [ready_condition(observed), observed.certified]
    optional = (
        observed.described,
        observed.camera_described,
        _recording_condition(observed),
        _gateway_condition(observed),
        _control_condition(observed),
    )
    conditions += [condition for condition in optional if condition is not None]
    before = [Condition.model_validate(condition) for condition in previous.get("conditions") or ()]
    merged, _ = merge_conditions(before, conditions, generation, now)
    status: dict[str, Any] = {
        "lastSeen": timestamp(now),
        "conditions": [condition.to_dict() for condition in merged],
    }
    audit_heads = list(observed.audit_heads) or previous.get("audit")
    if audit_heads:
        status["audit"] = audit_heads
    if observed.kind == "Drone":
        if observed.records_address:
            status["recordsAddress"] = observed.records_address
        snapshot = observed.snapshot if observed.telemetry_problem is None else None
        status |= {key: previous[key] for key in ("position", "battery") if key in previous}
        status |= {"flightState": "unknown"} | (_flight_status(snapshot) if snapshot is not None else {})
        if status["flightState"] != "unknown":
            status["lastFlightState"] = status["flightState"]
        else:
            last = _last_known_flight_state(previous)
            if last is not None:
                status["lastFlightState"] = last
    return status


def _recording_condition(observed: NodeObservation) -> ConditionUpdate | None:
    """Return the condition Recording if flights or pictures are not recorded although they should be."""
    flights = observed.snapshot.recording_problem if observed.snapshot is not None else ""
    problem = "; ".join(filter(None, (flights, *observed.recording_problems)))
    return ConditionUpdate("Recording", "False", "RecordingStopped", problem) if problem else None


def _gateway_condition(observed: NodeObservation) -> ConditionUpdate | None:
    """Return the condition MavlinkGateway if the node has a gateway with a problem."""
    problem = observed.gateway_problem
    return ConditionUpdate("MavlinkGateway", "False", "NotServing", problem) if problem else None


def _control_condition(observed: NodeObservation) -> ConditionUpdate | None:
    """Return the condition ControlTaken if the system or a pilot has control in flight, with the reason."""
    snapshot = observed.snapshot if observed.telemetry_problem is None else None
    if snapshot is None or not (snapshot.connected and snapshot.in_air and snapshot.controller_reason):
        return None
    reason = {"pilot": "PilotInControl", "system": "SystemInControl"}.get(snapshot.controller)
    return ConditionUpdate(CONTROL_TAKEN, "True", reason, snapshot.controller_reason) if reason else None


def _last_known_flight_state(previous: Object) -> str | None:
    state: str = previous.get("flightState", "unknown")
    return previous.get("lastFlightState") if state == "unknown" else state


def _flight_status(snapshot: TelemetrySnapshot) -> dict[str, Any]:
    flight: dict[str, Any] = {}
    # Without a connection to the autopilot the flight state of the mobility service is outdated.
    if snapshot.connected and snapshot.flight_state in _FLIGHT_STATES:
        flight["flightState"] = snapshot.flight_state
    if snapshot.controller:
        flight["controller"] = component_name(snapshot.controller)
    if snapshot.position is not None:
        lat, lon, alt, reference = snapshot.position
        flight["position"] = {
            "lat": round(lat, 7), "lon": round(lon, 7), "alt": round(alt, 2), "altitudeReference": reference,
        }  # fmt: skip
    if snapshot.connected:
        flight["battery"] = {
            "remaining": round(snapshot.battery_remaining, 2),
            "voltage": round(snapshot.battery_voltage_v, 1),
            "current": round(snapshot.battery_current_a, 1),
        }
    return flight


def report_intervals(kind: str, status: Object) -> ReportIntervals:
    """Return the minimum intervals between writes of a status.

    The intervals are shortest for a drone in flight, so that the operator soon notices if its reports stop.
    """
    if kind != "Drone":
        return EDGE_INTERVALS
    airborne = is_airborne(status["flightState"], status.get("lastFlightState"))
    return FLIGHT_INTERVALS if airborne else DRONE_INTERVALS


def due_s(old: Object | None, new: Object, since_s: float, intervals: ReportIntervals) -> float:
    """Return the seconds until the new status must be written, or 0 if it must be written now.

    Args:
        old: Status as last written, None for none.
        new: Current status.
        since_s: Seconds since the old status was written.
        intervals: Minimum seconds between writes.
    """
    if old is None:
        return 0.0
    if _urgent(old) != _urgent(new):
        wait_s = intervals.urgent_s
    elif _has_changed(old, new):
        wait_s = intervals.moving_s
    else:
        wait_s = intervals.idle_s
    return max(0.0, wait_s - since_s)


def _urgent(status: Object) -> tuple[object, ...]:
    conditions: Sequence[Object] = status.get("conditions") or ()
    return (
        status.get("flightState"),
        status.get("controller"),
        tuple((c["type"], c["status"], c["reason"], c.get("observedGeneration")) for c in conditions),
    )


def _has_changed(old: Object, new: Object) -> bool:
    messages = [[c.get("message") for c in status.get("conditions") or ()] for status in (old, new)]
    if messages[0] != messages[1]:
        return True
    charge = [(status.get("battery") or {}).get("remaining", 0.0) for status in (old, new)]
    if abs(charge[0] - charge[1]) >= 0.01:
        return True
    before = old.get("position")
    after = new.get("position")
    if before is None or after is None:
        return before is not after
    north_m = (after["lat"] - before["lat"]) * _DEGREE_M
    east_m = (after["lon"] - before["lon"]) * _DEGREE_M * math.cos(math.radians(before["lat"]))
    return math.hypot(north_m, east_m, (after.get("alt") or 0.0) - (before.get("alt") or 0.0)) > GPS_NOISE_M


class StatusReporter:
    """Writes the node's status when it is due.

    Args:
        store: The node's objects at the API server.
        body: Returns the current Drone or EdgeNode at the API server, None if it does not exist.
        observe: Returns the current observations for that object.
        on_written: Called with the object that a write returned, None if it does not exist.
        wall: Returns the wall clock time, for timestamps.
        monotonic: Returns seconds of a monotonic clock, for intervals.
    """

    def __init__(
        self,
        store: Store,
        *,
        body: Callable[[], Object | None],
        observe: Callable[[Object], NodeObservation],
        on_written: Callable[[Object | None], None],
        wall: Callable[[], datetime],
        monotonic: Callable[[], float],
    ) -> None:
        self._store = store
        self._body = body
        self._observe = observe
        self._on_written = on_written
        self._wall = wall
        self._monotonic = monotonic
        self._last: Object | None = None
        self._last_uid: str | None = None
        self._last_s = -math.inf
        self._grace_end_s = monotonic() + STARTUP_GRACE_S
        self._changed = asyncio.Event()

    @property
    def age_s(self) -> float:
        """Seconds since the last successful status write, infinite before the first."""
        return self._monotonic() - self._last_s

    def notify(self) -> None:
        """Wake the task that writes the status, so that it checks if the status has changed."""
        self._changed.set()

    async def run(self) -> None:
        """Report until cancelled."""
        await repeat("status", self.step, self._changed)

    async def step(self) -> float:
        """Write the status if it is due. Return the seconds until the next check, if nothing changes before."""
        body = self._body()
        if body is None:
            return 5.0
        observed = self._observe(body)
        grace_s = self._grace_end_s - self._monotonic()
        if observed.has_mobility and observed.snapshot is None and grace_s > 0:
            return grace_s
        metadata = body["metadata"]
        if metadata.get("uid") != self._last_uid:
            self._last = None
        previous = self._last or body.get("status") or {}
        status = node_status(observed, previous, metadata.get("generation"), self._wall())
        intervals = report_intervals(observed.kind, status)
        wait_s = due_s(self._last, status, self._monotonic() - self._last_s, intervals)
        if wait_s > 0:
            return wait_s
        result = await self._store.apply_status(observed.kind, metadata["name"], status)
        self._on_written(result)
        if result is None:
            self._last = None
            return 5.0
        self._last = status
        self._last_uid = metadata.get("uid")
        self._last_s = self._monotonic()
        return intervals.moving_s

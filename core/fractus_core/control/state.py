"""State of the control state machine: authority, lease, missions, system task, motion and deadlines."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum


class Authority(Enum):
    """Party that may command the vehicle now."""

    DRIVER = "driver"
    SYSTEM = "system"
    PILOT = "pilot"


class ModeKind(Enum):
    """Class of a flight mode by its meaning for control.

    COMMANDED: The autopilot follows the companion (GUIDED).
    RETURNING, LANDING: The autopilot brings the vehicle down by itself.
    BRAKING: The autopilot stops and hovers, because a pilot or a failsafe chose the mode.
    OTHER: A human pilot flies.
    """

    COMMANDED = "commanded"
    RETURNING = "returning"
    LANDING = "landing"
    BRAKING = "braking"
    OTHER = "other"


@dataclass(frozen=True, slots=True)
class FlightMode:
    """Flight mode, identified by its name in the autopilot."""

    name: str = "UNKNOWN"
    kind: ModeKind = ModeKind.OTHER

    @property
    def commanded(self) -> bool:
        """True if the autopilot follows the companion in this mode."""
        return self.kind is ModeKind.COMMANDED

    @property
    def comes_down(self) -> bool:
        """True if the autopilot brings the vehicle down by itself in this mode."""
        return self.kind in {ModeKind.RETURNING, ModeKind.LANDING}


@dataclass(frozen=True, slots=True)
class VehicleFacts:
    """State of the vehicle as last reported.

    Attributes:
        connected: True if the autopilot is connected.
        armed: True if the motors are armed.
        in_air: True if the vehicle is airborne, or if that is uncertain.
        mode: Flight mode.
        failsafe: True if the system status reports an active failsafe.
        failsafe_text: Last status text about a failsafe.
        failsafe_text_at: Time of that text, by the clock of the events.
        silent_s: Interval between the last two heartbeats, in seconds of the vehicle's clock.
        stopped_in_air: True if the last report before the motors stopped was from the air.
    """

    connected: bool = False
    armed: bool = False
    in_air: bool = False
    mode: FlightMode = FlightMode()
    failsafe: bool = False
    failsafe_text: str = ""
    failsafe_text_at: float = -math.inf
    silent_s: float = 0.0
    stopped_in_air: bool = False


class OutcomeKind(Enum):
    """Way in which a mission ended."""

    COMPLETE = "complete"
    REVOKED = "revoked"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class WaypointCounts:
    """Numbers of waypoints of a mission over all its control points, or of its points of interest.

    Attributes:
        reached: Waypoints to which the vehicle flew.
        skipped: Waypoints to which the vehicle did not fly, because their legs were refused or the driver omitted them.
        corrected: Reached waypoints whose target or speed a policy corrected.
    """

    reached: int = 0
    skipped: int = 0
    corrected: int = 0

    def __str__(self) -> str:
        if not self.reached and not self.skipped:
            return ""
        corrected = f" ({self.corrected} with corrections by policies)" if self.corrected else ""
        skipped = f", {self.skipped} skipped" if self.skipped else ""
        return f"{self.reached} of {self.reached + self.skipped} waypoints reached{corrected}{skipped}"


@dataclass(frozen=True, slots=True)
class Outcome:
    """Outcome of a mission with its reason. The string form is shown to users.

    Attributes:
        kind: Way in which the mission ended.
        reason: Reason in plain text; empty if the mission is complete.
        waypoints: Counts of waypoints, if they were reported.
    """

    kind: OutcomeKind
    reason: str = ""
    waypoints: WaypointCounts = WaypointCounts()

    def __str__(self) -> str:
        return f"{self.kind.value}: {self.reason}" if self.reason else self.kind.value


COMPLETE = Outcome(OutcomeKind.COMPLETE)
NOTHING_FLOWN = Outcome(OutcomeKind.FAILED, "no part of the path was flown: no leg of the driver was completed")


_ANOTHER_FLIGHT = "another flight needs a Grant with another uid"


def ended_refusal(outcome: Outcome) -> tuple[str, str]:
    """Return the code and reason for refusing a mission that has ended."""
    if outcome.kind is OutcomeKind.COMPLETE:
        return "MissionComplete", f"the mission is complete; {_ANOTHER_FLIGHT}"
    return "MissionEnded", f"the mission has ended ({outcome}); {_ANOTHER_FLIGHT}"


@dataclass(frozen=True, slots=True)
class Mission:
    """Mission of one driver, or mission over points of interest. Missions survive a restart of the service.

    Attributes:
        key: Key of the grant.
        identity: SPIFFE ID of the component instance.
        outcome: Outcome; None until the mission ends.
        points_done: Number of control points that were returned.
        waypoints: Number of waypoints reached in the current control point, or of points of interest visited.
        flown: True if the vehicle has been airborne for this mission.
        home: Latitude, longitude and altitude above sea level at which the vehicle armed for its first takeoff.
        leg_flown: True if a leg of the driver was completed, or the driver flew by velocity setpoints.
        takeover: Cause of the last takeover in flight after which the driver may continue: code and policies.
        takeovers: Number of these takeovers in succession. A further waypoint, or a takeover for another reason, starts
            the count again.
        interruptions: Number of takeovers for any reason, and of lost drivers, in flight since the last waypoint.
        counts: Waypoints of all control points so far.
        legs: Legs that ended since the last completed waypoint.
        corrected_legs: Number of these legs that a policy corrected.
        land_at: Latitude and longitude at which the system lands the drone after the end of the mission; None: at home.
    """

    key: str
    identity: str
    outcome: Outcome | None = None
    points_done: int = 0
    waypoints: int = 0
    flown: bool = False
    home: tuple[float, float, float] | None = None
    leg_flown: bool = False
    takeover: str = ""
    takeovers: int = 0
    interruptions: int = 0
    counts: WaypointCounts = WaypointCounts()
    legs: int = 0
    corrected_legs: int = 0
    land_at: tuple[float, float] | None = None


class StreamState(Enum):
    """State reported on a GetControl stream."""

    WAITING = "waiting"
    GRANTED = "granted"
    PASSENGER = "passenger"
    PING = "ping"
    LOST = "lost"
    COMPLETE = "complete"


@dataclass(frozen=True, slots=True)
class ControlEvent:
    """Event on a GetControl stream.

    Attributes:
        state: Kind of the event.
        control_point: Index of the control point, or of a passenger's next point of interest.
        reason: Reason in plain text.
        waypoints_reached: Number of completed waypoints of the control point, or of visited points of interest.
        code: Code of the verdict with which a policy took the vehicle; empty if no policy did.
        policies: Policies that demanded the takeover.
        ping: Number of a liveness request.
    """

    state: StreamState
    control_point: int = 0
    reason: str = ""
    waypoints_reached: int = 0
    code: str = ""
    policies: tuple[str, ...] = ()
    ping: int = 0

    @property
    def final(self) -> bool:
        """True if the stream ends after this event."""
        return self.state in {StreamState.LOST, StreamState.COMPLETE}


@dataclass(frozen=True, slots=True)
class ControlLease:
    """Right of one driver to command the vehicle, kept alive by its control stream.

    Attributes:
        lease_id: Id of the stream.
        key: Key of the mission.
        identity: SPIFFE ID of the driver.
        granted: True if control is granted, False if the driver still waits.
        transit: True if the system flies, or flew, a transit flight for the waiting driver.
    """

    lease_id: int
    key: str
    identity: str
    granted: bool = False
    transit: bool = False


class TaskKind(Enum):
    """Task of the system. The values appear in the audit log.

    LAND_AT: Fly to the landing place of the mission and land there. Without a legal route, return home.
    """

    HOVER = "hover"
    RETURN = "returnToLaunch"
    LAND = "land"
    LAND_AT = "landAt"
    TOUR = "tour"


@dataclass(frozen=True, slots=True)
class SystemTask:
    """Task of the system that runs until it ends or is stopped.

    Attributes:
        task_id: Unique id.
        kind: Kind of the task.
        key: Key of the mission, for a mission over points of interest.
        begun_by_others: True if the system did not cause the descent of the autopilot, so a pilot may have chosen the
            descent.
    """

    task_id: int
    kind: TaskKind
    key: str = ""
    begun_by_others: bool = False


@dataclass(frozen=True, slots=True)
class ActiveFlight:
    """Flight for an application under the flight constraints of its grant."""

    flight_id: int
    key: str


@dataclass(frozen=True, slots=True)
class ActiveMotion:
    """Motion call in progress.

    Attributes:
        motion_id: Unique id.
        kind: Name of the method.
        hover_at: Time at which the vehicle starts to hover, because the caller cancelled the motion; None otherwise. If the
            driver is lost before that time, the motion continues.
    """

    motion_id: int
    kind: str
    hover_at: float | None = None


DRIVER_LOST_CODE = "DriverLost"
"""Code of the grace period of a lost driver."""

CONTACT_LOST = "ContactLost"
"""Code of the reaction to lost contact with the API server."""


@dataclass(frozen=True, slots=True)
class Grace:
    """Grace period after the loss of the driver or the position.

    If the grace period ends without recovery, the mission has failed.
    """

    until: float
    key: str
    reason: str
    code: str = DRIVER_LOST_CODE


@dataclass(frozen=True, slots=True)
class ControlState:
    """State that determines the control authority over the vehicle and the task of the system.

    Times are monotonic seconds.

    Attributes:
        grace_s: Seconds within which a lost driver may come back.
        vehicle: State of the vehicle as last reported.
        authority: Party that has control authority.
        lease: Lease of the driver that has control or waits for it.
        flight: Flight of the system under the constraints of a grant; None if there is none.
        task: Current task of the system.
        returning: True if the vehicle comes down by the action of the system or the autopilot.
        motion: Current motion.
        motion_began_at: Start time of the latest motion.
        grace: Deadline for a lost driver or position.
        missions: Missions by key, oldest first.
        active: Key of the mission for which the vehicle is armed or in the air.
        removed: Key of the mission whose grant was removed in flight. Its constraints apply on the return flight.
        grants: Keys of the grants in force.
        speed_mps: Speed for legs that specify none, as set by the driver.
        decided: True if the control authority has been determined.
        armed_seen: Armed state at the last heartbeat; None before the first.
        armed_by_others: True if the motors were not started by the system, so that no mission flight was prepared.
        expected_mode: Mode that the vehicle is known to be in, or that the system requested. A different mode was set by
            another party.
        unconfirmed: Mode that the system requested without receiving an answer, and the time until which it may still
            take effect.
        failsafe_seen: True if a failsafe was active at the last heartbeat.
        mode_changes: Number of mode changes by the system in progress.
        own_modes: Modes that may be reported during the changes in progress: the previous and the requested mode of
            each.
        starting_motors: True while the system starts the motors.
        start_unconfirmed_until: Time until which armed motors may result from a start whose acknowledgements were lost.
        preparing: Number of arming attempts in progress, from raising the fence to running motors.
        unattended_since: Time at which the armed vehicle was first found without control authority.
        unattended: Number of times the system took over the unattended vehicle since it last had a driver or was
            disarmed.
        last_task_id: Id of the latest system task.
        contact_lost: True while there is no contact with the API server, and the mission must therefore hover or end.
    """

    grace_s: float = 5.0
    vehicle: VehicleFacts = VehicleFacts()
    authority: Authority = Authority.SYSTEM
    lease: ControlLease | None = None
    flight: ActiveFlight | None = None
    task: SystemTask | None = None
    returning: bool = False
    motion: ActiveMotion | None = None
    motion_began_at: float = -math.inf
    grace: Grace | None = None
    missions: Mapping[str, Mission] = field(default_factory=dict)
    active: str | None = None
    removed: str | None = None
    grants: frozenset[str] = frozenset()
    speed_mps: float | None = None
    decided: bool = False
    armed_seen: bool | None = None
    armed_by_others: bool = False
    expected_mode: FlightMode | None = None
    unconfirmed: tuple[FlightMode, float] | None = None
    failsafe_seen: bool = False
    mode_changes: int = 0
    own_modes: frozenset[FlightMode] = frozenset()
    starting_motors: bool = False
    start_unconfirmed_until: float = -math.inf
    preparing: int = 0
    unattended_since: float | None = None
    unattended: int = 0
    last_task_id: int = 0
    contact_lost: bool = False

    @property
    def mission(self) -> Mission | None:
        """Mission for which the vehicle is armed or in the air."""
        return self.missions.get(self.active) if self.active is not None else None

    @property
    def outcomes(self) -> dict[str, Outcome]:
        """Outcomes of the missions that have ended, with the counts of their waypoints, by key."""
        return {
            mission.key: replace(mission.outcome, waypoints=mission.counts)
            for mission in self.missions.values()
            if mission.outcome is not None
        }

    @property
    def controller(self) -> str:
        """Party that has control authority: the driver's identity, `pilot` or `system`."""
        if self.authority is Authority.DRIVER and self.lease is not None:
            return self.lease.identity
        return "pilot" if self.authority is Authority.PILOT else "system"

    @property
    def touring(self) -> str | None:
        """Key of the mission over points of interest that the system is flying; None if it flies no such mission."""
        return self.task.key if self.task is not None and self.task.kind is TaskKind.TOUR else None

    @property
    def drives(self) -> bool:
        """True if the driver of the lease has control authority."""
        return self.lease is not None and self.lease.granted and self.authority is Authority.DRIVER

    @property
    def granted(self) -> bool:
        """True if a driver has a granted lease."""
        return self.lease is not None and self.lease.granted

    @property
    def home_for_good(self) -> bool:
        """True if the vehicle returns and no driver may stop the return.

        During the grace period of a lost driver, that driver may still reconnect and stop a return that it started.
        """
        waits = self.grace is not None and self.grace.key == self.active
        return self.returning and not waits

    @property
    def grant_in_force(self) -> bool:
        """True if the lease or the active mission has a grant in force, so that the vehicle may fly on."""
        return self.lease is not None or (self.mission is not None and self.mission.key in self.grants)

    @property
    def attended(self) -> bool:
        """True if the vehicle is disarmed, or a driver, pilot, system flight or deadline is responsible for it.

        A hover task does not count, because only the grace deadline ends it.
        """
        if (
            not self.vehicle.armed
            or self.starting_motors
            or self.authority is Authority.PILOT
            or self.grace is not None
        ):
            return True
        driven = self.lease is not None and (self.drives or self.flight is not None)
        return driven or (self.task is not None and (self.returning or self.touring is not None))

    @property
    def in_transit(self) -> bool:
        """True if the system flies a transit for a waiting driver.

        The driver's grace period does not expire meanwhile.
        """
        lease = self.lease
        flight = self.flight
        return lease is not None and flight is not None and not lease.granted and lease.key == flight.key

    @property
    def waits_for_contact(self) -> bool:
        """True if the drone hovers for a mission that continues as soon as contact with the API server returns.

        Only the grace period of a driver that waits for control, or of a tour, is stopped.
        """
        if not self.contact_lost or self.grace is None:
            return False
        waiting = self.lease is not None and not self.lease.granted
        return self.grace.code == CONTACT_LOST or (waiting and self.grace.code == DRIVER_LOST_CODE)

    @property
    def deadline(self) -> float | None:
        """Time from which a Tick has an effect; None if no deadline is set."""
        grace = self.grace if not (self.in_transit or self.waits_for_contact) else None
        deadlines = (grace.until if grace else None, self.motion.hover_at if self.motion else None)
        return min((deadline for deadline in deadlines if deadline is not None), default=None)

    def flies_for(self, key: str) -> bool:
        """Return True if the vehicle is armed for the mission with this key."""
        return self.vehicle.armed and self.active == key

    def armed_for_other(self, key: str) -> bool:
        """Return True if the vehicle is armed for a mission with another key."""
        return self.vehicle.armed and self.mission is not None and self.mission.key != key

    def observed(self, vehicle: VehicleFacts) -> ControlState:
        """Return the state with the present state of the vehicle."""
        return self if vehicle == self.vehicle else replace(self, vehicle=vehicle)

"""What is known of a vehicle's control: authority, lease, missions, system task, motion, deadlines."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum


class Authority(Enum):
    """Who may command the vehicle."""

    DRIVER = "driver"
    SYSTEM = "system"
    PILOT = "pilot"


class ModeKind(Enum):
    """What a flight mode of the autopilot means for control, whatever its number is.

    COMMANDED obeys the companion; RETURNING and LANDING bring the vehicle down by themselves; BRAKING stops it and lets it hover, by a
    pilot's or a failsafe's choice; in any OTHER a human pilot flies.
    """

    COMMANDED = "commanded"
    RETURNING = "returning"
    LANDING = "landing"
    BRAKING = "braking"
    OTHER = "other"


@dataclass(frozen=True, slots=True)
class FlightMode:
    """A flight mode by the autopilot's name of it."""

    name: str = "UNKNOWN"
    kind: ModeKind = ModeKind.OTHER

    @property
    def commanded(self) -> bool:
        """Whether the vehicle obeys the companion in it."""
        return self.kind is ModeKind.COMMANDED

    @property
    def comes_down(self) -> bool:
        """Whether the vehicle comes down by itself in it."""
        return self.kind in {ModeKind.RETURNING, ModeKind.LANDING}


@dataclass(frozen=True, slots=True)
class VehicleFacts:
    """The vehicle as it was last heard.

    Attributes:
        connected: whether it is heard now.
        armed: whether the motors run.
        in_air: whether it flies; in doubt it does.
        mode: its flight mode.
        failsafe: whether its state says that a failsafe acts.
        failsafe_text: what it last said of a failsafe.
        failsafe_text_at: when it said so, in the time of the events.
        silent_s: how long before its last heartbeat came the one before that, in its own seconds.
    """

    connected: bool = False
    armed: bool = False
    in_air: bool = False
    mode: FlightMode = FlightMode()
    failsafe: bool = False
    failsafe_text: str = ""
    failsafe_text_at: float = -math.inf
    silent_s: float = 0.0


class OutcomeKind(Enum):
    """How a mission ended."""

    COMPLETE = "complete"
    REVOKED = "revoked"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a mission ended, and why; its text is what people read."""

    kind: OutcomeKind
    reason: str = ""

    def __str__(self) -> str:
        return f"{self.kind.value}: {self.reason}" if self.reason else self.kind.value


COMPLETE = Outcome(OutcomeKind.COMPLETE)
NOTHING_FLOWN = Outcome(OutcomeKind.FAILED, "nothing of its path was flown: no leg of the driver came to its end")


def ended_refusal(outcome: Outcome) -> tuple[str, str]:
    """Code and reason with which a mission that is over is refused."""
    if outcome.kind is OutcomeKind.COMPLETE:
        return "MissionComplete", "the mission is complete"
    return "MissionEnded", f"the mission has ended ({outcome}); another flight needs a Grant with another uid"


@dataclass(frozen=True, slots=True)
class Mission:
    """One driver's mission, or one tour; it survives a restart of the service.

    Attributes:
        key: the grant's key.
        identity: SPIFFE id of the instance.
        outcome: None while it goes on.
        points_done: control points that were returned.
        waypoints: waypoints of the present control point that were reached, or points of interest that were visited.
        flown: whether the vehicle has been in the air for it.
        home: latitude, longitude and altitude above sea level of where it armed for its first takeoff.
        leg_flown: whether a leg of its driver has ended, or its driver has steered it.
    """

    key: str
    identity: str
    outcome: Outcome | None = None
    points_done: int = 0
    waypoints: int = 0
    flown: bool = False
    home: tuple[float, float, float] | None = None
    leg_flown: bool = False


class StreamState(Enum):
    """States that a stream of GetControl tells of."""

    WAITING = "waiting"
    GRANTED = "granted"
    RIDING = "riding"
    LOST = "lost"
    COMPLETE = "complete"


@dataclass(frozen=True, slots=True)
class ControlEvent:
    """One event on a stream of GetControl."""

    state: StreamState
    control_point: int = 0
    reason: str = ""
    waypoints_reached: int = 0

    @property
    def final(self) -> bool:
        """Whether the stream ends after it."""
        return self.state in {StreamState.LOST, StreamState.COMPLETE}


@dataclass(frozen=True, slots=True)
class ControlLease:
    """The right of one driver to command, kept by its stream.

    Attributes:
        lease_id: of the stream.
        key: the mission.
        identity: SPIFFE id of the driver.
        granted: whether the driver commands, or still waits.
        transit: whether the system flies, or flew, for the waiting driver.
    """

    lease_id: int
    key: str
    identity: str
    granted: bool = False
    transit: bool = False


class TaskKind(Enum):
    """What the system does with the vehicle; the values are those of a policy's takeover."""

    HOVER = "hover"
    RETURN = "returnToLaunch"
    LAND = "land"
    TOUR = "tour"


@dataclass(frozen=True, slots=True)
class SystemTask:
    """Work of the system that goes on beside the events, until it ends or is stopped.

    Attributes:
        task_id: tells it from those before it.
        kind: what it does.
        key: the mission of a tour.
        found: whether the autopilot was found coming down, by no doing of the system: it may be a pilot's choice.
    """

    task_id: int
    kind: TaskKind
    key: str = ""
    found: bool = False


@dataclass(frozen=True, slots=True)
class SystemFlight:
    """A flight for an application, under the flight constraints of its grant."""

    flight_id: int
    key: str


@dataclass(frozen=True, slots=True)
class ActiveMotion:
    """A motion call that is being carried out.

    Attributes:
        motion_id: tells it from those before it.
        kind: what it is called.
        hover_at: its caller gave it up: the vehicle hovers from then on, unless the driver is gone by then.
    """

    motion_id: int
    kind: str
    hover_at: float | None = None


@dataclass(frozen=True, slots=True)
class Grace:
    """The time that a lost driver, or a lost position, has to come back; when it is over, the mission has failed."""

    until: float
    key: str
    reason: str
    code: str = "DriverLost"


@dataclass(frozen=True, slots=True)
class ControlState:
    """Everything that decides who commands the vehicle, and what the system does with it.

    Attributes:
        grace_s: how long a lost driver may take to come back.
        vehicle: as it was last heard.
        authority: who may command it.
        lease: of the driver that has the vehicle or waits for it.
        flight: the system flies an application's vehicle under flight constraints; None while it does not.
        task: what the system does with the vehicle.
        returning: whether the vehicle comes down by the system's or the autopilot's doing.
        motion: the motion under way.
        motion_began_at: when the last motion began.
        grace: a lost driver's deadline.
        missions: by key, the oldest first.
        active: key of the mission that the vehicle is armed or in the air for.
        removed: key of the mission whose grant was removed under the flying vehicle: its fences hold on the way home.
        grants: keys of the grants in force.
        speed_mps: of legs that name none, as the driver set it.
        decided: whether it is settled who has the vehicle.
        armed_seen: whether the motors ran at the last heartbeat; None before the first.
        armed_by_others: whether others started the motors that run: no flight of a mission was prepared.
        expected_mode: the mode that the vehicle is in by the system's doing, or that is known; another one is foreign.
        unconfirmed: a mode that the system asked for without an answer, and until when it may still be obeyed.
        failsafe_seen: whether a failsafe acted at the last heartbeat already.
        mode_changes: how many changes of mode by the system are under way.
        own_modes: those that the vehicle may show meanwhile without anyone else's doing: where each began, and where it leads.
        starting_motors: whether the system starts the motors at this moment.
        start_unconfirmed_until: until when motors that run may do so for a start by the system whose answers were lost.
        preparing: how many attempts to arm are under way, from the fence that is raised first to running motors.
        unattended_since: when the armed vehicle was first found without authority over it.
        unattended: how many times the system took such a vehicle, since it had a driver or stood.
        last_task_id: of the system task that began last.
    """

    grace_s: float = 5.0
    vehicle: VehicleFacts = VehicleFacts()
    authority: Authority = Authority.SYSTEM
    lease: ControlLease | None = None
    flight: SystemFlight | None = None
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

    @property
    def mission(self) -> Mission | None:
        """The mission that the vehicle is armed or in the air for."""
        return self.missions.get(self.active) if self.active is not None else None

    @property
    def outcomes(self) -> dict[str, Outcome]:
        """How missions ended, by key."""
        return {mission.key: mission.outcome for mission in self.missions.values() if mission.outcome is not None}

    @property
    def controller(self) -> str:
        """Who commands: the driver's identity, "pilot" or "system"."""
        if self.authority is Authority.DRIVER and self.lease is not None:
            return self.lease.identity
        return "pilot" if self.authority is Authority.PILOT else "system"

    @property
    def touring(self) -> str | None:
        """Key of the mission without a driver that the system is flying."""
        return self.task.key if self.task is not None and self.task.kind is TaskKind.TOUR else None

    @property
    def drives(self) -> bool:
        """Whether the driver of the lease commands the vehicle."""
        return self.lease is not None and self.lease.granted and self.authority is Authority.DRIVER

    @property
    def granted(self) -> bool:
        """Whether the lease is granted."""
        return self.lease is not None and self.lease.granted

    @property
    def home_for_good(self) -> bool:
        """Whether the vehicle comes home and no driver may stop it: not one that its driver called home, and then was lost."""
        waits = self.grace is not None and self.grace.key == self.active
        return self.returning and not waits

    @property
    def grant_in_force(self) -> bool:
        """Whether there is a grant under which the vehicle may go on: the lease's, or that of the active mission."""
        return self.lease is not None or (self.mission is not None and self.mission.key in self.grants)

    @property
    def attended(self) -> bool:
        """Whether someone answers for the vehicle: its motors stand, or there is a driver, a pilot, a flight, a deadline.

        A task that only hovers does not count: a hovering vehicle is brought home by the deadline of the grace alone.
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
        """Whether the system flies for a driver that waits: its grace does not end meanwhile."""
        lease, flight = self.lease, self.flight
        return lease is not None and flight is not None and not lease.granted and lease.key == flight.key

    @property
    def deadline(self) -> float | None:
        """When the next Tick has something to do."""
        grace = self.grace if not self.in_transit else None
        moments = (grace.until if grace else None, self.motion.hover_at if self.motion else None)
        return min((moment for moment in moments if moment is not None), default=None)

    def flies_for(self, key: str) -> bool:
        """Whether the vehicle is armed for a mission."""
        return self.vehicle.armed and self.active == key

    def taken(self, key: str) -> bool:
        """Whether the vehicle is armed for another mission than this."""
        return self.vehicle.armed and self.mission is not None and self.mission.key != key

    def observed(self, vehicle: VehicleFacts) -> ControlState:
        """The same with the vehicle as it is now."""
        return self if vehicle == self.vehicle else replace(self, vehicle=vehicle)

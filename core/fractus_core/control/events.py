"""What happens to a vehicle's control: events from drivers, the engine, the vehicle, grants, the system and the clock."""

from __future__ import annotations

from dataclasses import dataclass

from fractus_core.control.values import FlightMode, Outcome, VehicleFacts
from fractus_core.policy.decision_types import Takeover

# Drivers


@dataclass(frozen=True, slots=True)
class StreamOpened:
    """A driver asks for control."""

    lease_id: int
    key: str
    identity: str


@dataclass(frozen=True, slots=True)
class StreamClosed:
    """A driver's stream is over; without ControlReturned that means the driver is lost."""

    lease_id: int


@dataclass(frozen=True, slots=True)
class TransitRequested:
    """The system is to bring the vehicle to where a waiting driver takes over."""

    lease_id: int


@dataclass(frozen=True, slots=True)
class TransitFailed:
    """A fault of the service would end the transit again and again."""

    lease_id: int
    reason: str


@dataclass(frozen=True, slots=True)
class GrantControl:
    """All that a waiting driver waits for is there."""

    lease_id: int


@dataclass(frozen=True, slots=True)
class ControlReturned:
    """A driver returns control at the end of a control point.

    Attributes:
        control_points: how many of them its grant names.
        paths: whether one of them has a path.
    """

    key: str
    control_points: int
    paths: bool = False


@dataclass(frozen=True, slots=True)
class WaypointsDone:
    """The driver is done with the first waypoints of its control point's task.

    Attributes:
        waypoints: how many, reached or passed over.
        leg: whether a leg of the driver has ended, there or elsewhere.
    """

    key: str
    waypoints: int
    leg: bool = False


@dataclass(frozen=True, slots=True)
class CruiseSpeedSet:
    """The driver set the speed of legs that name none."""

    speed_mps: float


# Motions


@dataclass(frozen=True, slots=True)
class MotionBegan:
    """A motion begins; the one under way is replaced."""

    motion_id: int
    kind: str


@dataclass(frozen=True, slots=True)
class MotionFinished:
    """A motion is complete, or over."""

    motion_id: int


@dataclass(frozen=True, slots=True)
class MotionFailed:
    """A motion ended with an error, and the autopilot may fly on for it."""

    motion_id: int


@dataclass(frozen=True, slots=True)
class MotionCancelled:
    """The caller of a motion gave it up."""

    motion_id: int


@dataclass(frozen=True, slots=True)
class MotionStopped:
    """Another motion of the same flight takes over from the one under way, for a reason that its caller is told."""

    code: str
    reason: str
    policies: tuple[str, ...] = ()


# Policies and grants


@dataclass(frozen=True, slots=True)
class TakeoverDemanded:
    """A policy or the monitor demands that the system takes the vehicle.

    Attributes:
        takeover: what it does with the vehicle.
    """

    takeover: Takeover
    code: str
    reason: str
    policies: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class BrakeDemanded:
    """A policy or the monitor demands that the present motion stops; authority stays where it is."""

    code: str
    reason: str
    policies: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class GrantRef:
    """A grant as control knows it.

    Attributes:
        key: the mission.
        leads: whether it flies the vehicle: a driver's, or that of a tour.
    """

    key: str
    leads: bool


@dataclass(frozen=True, slots=True)
class PositionLost:
    """The flying vehicle's position is not known, or not in time."""

    reason: str


@dataclass(frozen=True, slots=True)
class PositionFound:
    """The flying vehicle's position is known."""


@dataclass(frozen=True, slots=True)
class GrantChanged:
    """A grant came, changed or went."""

    before: GrantRef | None
    after: GrantRef | None


# The vehicle


@dataclass(frozen=True, slots=True)
class VehicleObserved:
    """The vehicle as it is now; nothing is decided on it alone."""

    vehicle: VehicleFacts


@dataclass(frozen=True, slots=True)
class VehicleFound:
    """The autopilot is heard, for the first time or again after its link broke."""


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """The autopilot told its mode, and whether the motors run."""


@dataclass(frozen=True, slots=True)
class Airborne:
    """The vehicle is in the air."""


@dataclass(frozen=True, slots=True)
class ModeChangeBegan:
    """The system changes the mode."""

    mode: FlightMode


@dataclass(frozen=True, slots=True)
class ModeChangeEnded:
    """The change of mode is over.

    Attributes:
        before: what was expected before it.
        done: whether the autopilot confirmed it.
        refused: whether it said that it does not; neither: its answers may have been lost.
    """

    mode: FlightMode
    before: FlightMode | None
    done: bool
    refused: bool = False


# Arming


@dataclass(frozen=True, slots=True)
class ArmingRequested:
    """The vehicle is to be armed for a mission, whose home is this."""

    key: str
    identity: str
    home: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class ArmingPrepared:
    """Preparing to arm begins, or is over."""

    begins: bool


@dataclass(frozen=True, slots=True)
class MotorStart:
    """Starting the motors begins, or is over.

    Attributes:
        unanswered: whether the autopilot was asked to and has not refused: only its answers may have been lost.
    """

    begins: bool
    unanswered: bool = False


# The system


@dataclass(frozen=True, slots=True)
class TransitBegan:
    """The system flies for an application, and keeps to its fences."""

    flight_id: int
    key: str
    identity: str


@dataclass(frozen=True, slots=True)
class SystemFlightBegan:
    """What is flown from now on keeps to the fences of a grant, as they are at each moment."""

    flight_id: int
    key: str


@dataclass(frozen=True, slots=True)
class SystemFlightEnded:
    """The system has stopped flying under constraints."""

    flight_id: int


@dataclass(frozen=True, slots=True)
class TourBegan:
    """The system begins, or goes on with, a mission that has no driver."""

    key: str


@dataclass(frozen=True, slots=True)
class TourPointVisited:
    """The tour has visited the first `visited` of its points."""

    key: str
    visited: int


@dataclass(frozen=True, slots=True)
class TourInterrupted:
    """The tour cannot go on now, and may in a moment."""

    key: str
    reason: str


@dataclass(frozen=True, slots=True)
class TourEnded:
    """The tour is over."""

    key: str
    outcome: Outcome


@dataclass(frozen=True, slots=True)
class SystemTaskEnded:
    """A system task is over.

    Attributes:
        finished: whether it came to its end; otherwise it broke.
    """

    task_id: int
    finished: bool


@dataclass(frozen=True, slots=True)
class PassengerBoarded:
    """An instance whose mission the system flies asks how far it is."""

    key: str
    identity: str


# The clock


@dataclass(frozen=True, slots=True)
class Tick:
    """Time has passed."""


DriverEvent = (
    StreamOpened | StreamClosed | TransitRequested | TransitFailed | GrantControl | ControlReturned | WaypointsDone
    | CruiseSpeedSet
)  # fmt: skip
MotionEvent = MotionBegan | MotionFinished | MotionFailed | MotionCancelled | MotionStopped
PolicyEvent = TakeoverDemanded | BrakeDemanded | PositionLost | PositionFound | GrantChanged
VehicleEvent = VehicleObserved | VehicleFound | Heartbeat | Airborne | ModeChangeBegan | ModeChangeEnded
ArmingEvent = ArmingRequested | ArmingPrepared | MotorStart
SystemEvent = (
    TransitBegan | SystemFlightBegan | SystemFlightEnded | TourBegan | TourPointVisited | TourInterrupted | TourEnded
    | SystemTaskEnded | PassengerBoarded
)  # fmt: skip
Event = DriverEvent | MotionEvent | PolicyEvent | VehicleEvent | ArmingEvent | SystemEvent | Tick
"""Everything that control is told."""

"""Events of the control state machine: from drivers, the policy engine, the vehicle, grants, the system and the clock."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from fractus_core.control.state import FlightMode, Outcome, VehicleFacts
from fractus_core.policy.decision_types import Takeover

# Drivers


@dataclass(frozen=True, slots=True)
class StreamOpened:
    """A driver opened a control stream."""

    lease_id: int
    key: str
    identity: str


@dataclass(frozen=True, slots=True)
class StreamClosed:
    """A driver's control stream ended. If the driver did not return control before, the driver counts as lost."""

    lease_id: int


@dataclass(frozen=True, slots=True)
class DriverUnresponsive:
    """The program of a driver with control did not answer a liveness request for `waited_s` seconds."""

    lease_id: int
    waited_s: float


@dataclass(frozen=True, slots=True)
class TransitRequested:
    """The system is about to bring the vehicle to the control point of a waiting driver."""

    lease_id: int


@dataclass(frozen=True, slots=True)
class TransitFailed:
    """The transit flight failed because of an internal error. A retry would fail in the same way."""

    lease_id: int
    reason: str


@dataclass(frozen=True, slots=True)
class GrantControl:
    """Control can be granted to a waiting driver, because all preconditions are met."""

    lease_id: int


@dataclass(frozen=True, slots=True)
class ControlReturned:
    """A driver returned control at the end of a control point.

    Attributes:
        key: Key of the mission.
        control_points: Number of control points in the driver's grant.
        paths: True if at least one of the control points has a path.
        waypoints: Number of waypoints in the path of the control point that is returned.
    """

    key: str
    control_points: int
    paths: bool = False
    waypoints: int = 0


@dataclass(frozen=True, slots=True)
class WaypointsDone:
    """The driver reported how many waypoints of its control point are complete.

    Attributes:
        key: Key of the mission.
        waypoints: Number of waypoints of the control point that were reached or skipped so far.
        leg: True if a leg of the driver ended. The end of the leg need not be a waypoint.
        corrected: True if a policy corrected this leg.
    """

    key: str
    waypoints: int
    leg: bool = False
    corrected: bool = False


@dataclass(frozen=True, slots=True)
class CruiseSpeedSet:
    """The driver set the speed for legs that specify no speed."""

    speed_mps: float


# Motions


@dataclass(frozen=True, slots=True)
class MotionBegan:
    """A motion began. It replaces the current motion."""

    motion_id: int
    kind: str


@dataclass(frozen=True, slots=True)
class MotionFinished:
    """A motion completed or ended."""

    motion_id: int


@dataclass(frozen=True, slots=True)
class MotionFailed:
    """A motion ended with an error. The autopilot may still be executing the motion."""

    motion_id: int


@dataclass(frozen=True, slots=True)
class MotionCancelled:
    """The caller of a motion cancelled the motion."""

    motion_id: int


@dataclass(frozen=True, slots=True)
class MotionStopped:
    """Another motion of the same flight replaces the current motion. The caller receives the reason."""

    code: str
    reason: str
    policies: tuple[str, ...] = ()


# Policies and grants


@dataclass(frozen=True, slots=True)
class TakeoverDemanded:
    """A policy or the monitor requires that the system takes over the vehicle.

    Attributes:
        takeover: Task of the system after the takeover.
        code: Code of the verdict.
        reason: Reason of the verdict.
        policies: Names of the policies that require it.
        land_at: Latitude and longitude of the landing place, for the takeover `abort`; None: home.
    """

    takeover: Takeover
    code: str
    reason: str
    policies: tuple[str, ...] = ()
    land_at: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class BrakeDemanded:
    """A policy or the monitor requires that the current motion stops. Control authority does not change."""

    code: str
    reason: str
    policies: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class GrantRef:
    """Reference to a grant.

    Attributes:
        key: Key of the mission.
        commands_vehicle: True if the grant commands the vehicle: the grant of a driver, or of a mission over points of interest.
    """

    key: str
    commands_vehicle: bool


@dataclass(frozen=True, slots=True)
class PositionLost:
    """The position of the flying vehicle is unknown or stale."""

    reason: str


@dataclass(frozen=True, slots=True)
class PositionFound:
    """The position of the flying vehicle is known."""


@dataclass(frozen=True, slots=True)
class ContactLost:
    """There is no contact with the API server for so long that the mission must hover or end. Sent until contact returns.

    Attributes:
        action: `hover` until contact returns, or `abort` the mission.
        reason: Reason in plain text.
        land_at: Latitude and longitude of the landing place for `abort`; None: home.
        tour: True if the mission has no driver.
    """

    action: Literal["hover", "abort"]
    reason: str
    land_at: tuple[float, float] | None = None
    tour: bool = False


@dataclass(frozen=True, slots=True)
class ContactRestored:
    """Contact with the API server is restored, or the mission does not depend on it any more."""


@dataclass(frozen=True, slots=True)
class GrantChanged:
    """A grant was added, changed or removed."""

    before: GrantRef | None
    after: GrantRef | None


# The vehicle


@dataclass(frozen=True, slots=True)
class VehicleObserved:
    """Update of the vehicle's state. The event itself causes no decision, but later decisions use the state."""

    vehicle: VehicleFacts


@dataclass(frozen=True, slots=True)
class VehicleFound:
    """The link to the autopilot was established or restored."""


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """The autopilot reported its mode and armed state."""


@dataclass(frozen=True, slots=True)
class Airborne:
    """The vehicle is in the air."""


@dataclass(frozen=True, slots=True)
class ModeChangeBegan:
    """The system requested a mode change."""

    mode: FlightMode


@dataclass(frozen=True, slots=True)
class ModeChangeEnded:
    """A mode change of the system ended.

    Attributes:
        mode: Requested mode.
        before: Mode that was expected before the request.
        done: True if the autopilot confirmed the change.
        refused: True if the autopilot refused the change. If neither is True, its acknowledgements may have been lost.
    """

    mode: FlightMode
    before: FlightMode | None
    done: bool
    refused: bool = False


# Arming


@dataclass(frozen=True, slots=True)
class ArmingRequested:
    """The vehicle is about to be armed for a mission with this home (latitude, longitude, metres above sea level)."""

    key: str
    identity: str
    home: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class ArmingPrepared:
    """The preparation of arming begins or ends."""

    begins: bool


@dataclass(frozen=True, slots=True)
class MotorStart:
    """The start of the motors begins or ends.

    Attributes:
        begins: True at the beginning.
        unanswered: True if the autopilot received the request and did not refuse. Its acknowledgements may have been lost.
    """

    begins: bool
    unanswered: bool = False


# The system


@dataclass(frozen=True, slots=True)
class TransitBegan:
    """The system began to fly for an application, under the application's flight constraints."""

    flight_id: int
    key: str
    identity: str


@dataclass(frozen=True, slots=True)
class SystemFlightBegan:
    """A flight under the constraints of a grant began. The constraints follow changes of the grant."""

    flight_id: int
    key: str


@dataclass(frozen=True, slots=True)
class SystemFlightEnded:
    """The system ended its flight under constraints."""

    flight_id: int


@dataclass(frozen=True, slots=True)
class TourBegan:
    """The system began or resumed a mission over points of interest, which has no driver."""

    key: str


@dataclass(frozen=True, slots=True)
class TourPointVisited:
    """The mission visited a point of interest. `visited` is the number of points visited so far."""

    key: str
    visited: int


@dataclass(frozen=True, slots=True)
class TourInterrupted:
    """The mission over points of interest cannot continue now, but a retry may succeed soon."""

    key: str
    reason: str


@dataclass(frozen=True, slots=True)
class TourEnded:
    """The mission over points of interest ended."""

    key: str
    outcome: Outcome


@dataclass(frozen=True, slots=True)
class SystemTaskEnded:
    """A system task ended.

    Attributes:
        task_id: Id of the task.
        finished: True if the task completed, False if it failed or was cancelled.
    """

    task_id: int
    finished: bool


@dataclass(frozen=True, slots=True)
class PassengerBoarded:
    """A passenger for whom the system flies a mission opened its control stream."""

    key: str
    identity: str


# The clock


@dataclass(frozen=True, slots=True)
class Tick:
    """Time has passed."""


DriverEvent = (
    StreamOpened | StreamClosed | DriverUnresponsive | TransitRequested | TransitFailed | GrantControl | ControlReturned
    | WaypointsDone | CruiseSpeedSet
)  # fmt: skip
MotionEvent = MotionBegan | MotionFinished | MotionFailed | MotionCancelled | MotionStopped
PolicyEvent = (
    TakeoverDemanded | BrakeDemanded | PositionLost | PositionFound | ContactLost | ContactRestored | GrantChanged
)  # fmt: skip
VehicleEvent = VehicleObserved | VehicleFound | Heartbeat | Airborne | ModeChangeBegan | ModeChangeEnded
ArmingEvent = ArmingRequested | ArmingPrepared | MotorStart
SystemEvent = (
    TransitBegan | SystemFlightBegan | SystemFlightEnded | TourBegan | TourPointVisited | TourInterrupted | TourEnded
    | SystemTaskEnded | PassengerBoarded
)  # fmt: skip
Event = DriverEvent | MotionEvent | PolicyEvent | VehicleEvent | ArmingEvent | SystemEvent | Tick
"""Every event of the state machine."""

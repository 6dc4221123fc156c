"""Interface between the mobility service and an autopilot: vehicle state, commands, failsafes, return limits and fence.

`authority` and `flight` use this module only. `mavlink` implements it.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Protocol

from fractus_core.api.grants import GrantSpec
from fractus_core.control.state import FlightMode, ModeKind, TaskKind
from fractus_core.geo import LocalFrame
from fractus_core.policy.decision_types import STATIONARY_MPS, Airframe, Attitude, Home
from fractus_core.policy.return_route import ReturnBounds
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.grant_files import ActiveGrant

Permit = Callable[[], None]
"""Called before each transmission of a command. Raises an exception if the command must no longer be sent."""

BEING_SET = "they are being set"
"""Problem that is reported for failsafes that have not been read back yet."""

LANDED_MAX_AGE_S = 2.0
"""Maximum age of the landed state relative to the other messages."""

ON_GROUND_ALTITUDE_M = 1.5
"""Altitude above home above which a drone counts as flying although it reports ON_GROUND."""

UNREPORTED_ALTITUDE_M = 0.5
"""Altitude above home above which a drone counts as flying if its landed state is unknown."""

_IN_AIR = frozenset(
    {mavlink.MAV_LANDED_STATE_IN_AIR, mavlink.MAV_LANDED_STATE_TAKEOFF, mavlink.MAV_LANDED_STATE_LANDING}
)
DEFAULT_ERROR_M = 1.5
"""Default 1-sigma position error if the GPS reports none, in metres."""

MAX_POSITION_AGE_S = 1.0
"""Age above which a position counts as unknown, in seconds. In flight, 20 positions are due in this time (20 Hz)."""

WIND_MAX_AGE_S = 10.0
"""Maximum age of the wind estimate."""

READY_MAX_AGE_S = 5.0
"""Maximum age of the reported readiness, in seconds. Five messages are due in this time (1 Hz)."""

CHECKS_TEXT_MAX_AGE_S = 40.0
"""Maximum age of a text that states a failed pre-arm check. ArduCopter repeats these texts every 30 s while a check fails."""

VELOCITY_HISTORY_S = 0.3
"""Period for which velocities are kept to compute the acceleration, in seconds of the vehicle's clock."""

LEG_MPS = 1000.0
"""Placeholder for the horizontal and the vertical speed of a pending leg, of which only the direction is known."""

MIN_COURSE_MPS = 0.1
"""Speed below which the velocity is noise and has no direction."""


@dataclass(frozen=True, slots=True)
class StatusText:
    """A text message of the autopilot.

    Attributes:
        number: Sequence number since the start of the service, from 1.
        at: Time of arrival, in monotonic seconds.
        severity: MAV_SEVERITY.
        text: Text.
    """

    number: int
    at: float
    severity: int
    text: str


@dataclass(slots=True)
class VehicleState:
    """Latest state that the autopilot reported. Times are monotonic seconds.

    Attributes:
        position_at: Time of the position. The delay relative to the fastest recent message is subtracted.
        yaw_deg: Heading from the position message; `heading_deg` is from the attitude message.
        gimbal: Measured attitude of the camera, yaw from true north. It is computed from the attitudes of gimbal and
            vehicle. `gimbal_at` is the time of the older of these two attitudes.
        ground_home: Latest home that was reported while the vehicle did not fly, or the first one after arming.
        ready: True if the pre-arm checks of the current mode pass, reported at `checks_at`.
        estimated: True if the estimator has an absolute position and predicts to keep it, reported at `estimated_at`.
        path_lost: True if the autopilot has stopped recording its path since it was armed.
        satellites: Number of visible satellites; None until it is reported.
        velocity_history: Time on the vehicle's clock, and velocity north and east, of the latest positions.
        texts: Time of arrival and text of recent status texts.
        status_texts: Recent status texts, oldest first.
        identity_problem: Reason why it is uncertain which vehicle on the link is the drone's own; empty if it is certain.
        heartbeat_gap_s: Interval between the last two heartbeats.
        stopped_in_air: True if the last reports before the motors stopped were from a flight, and not from a landing.
        located: True if GPS has an accurate three-dimensional fix. Positions without such a fix are ignored.
        position_problem: Reason why the reported position is not trusted and ignored; empty if it is trusted.
        position_problem_at: Start of the problem with the position. Problems that recur soon count as one.
        position_trusted_at: Time at which the latest problem with the position ended.
        expected_place: Latitude and longitude at which the vehicle is expected while its position is not trusted; None if unknown.
        expected_error_m: Distance from this place that the vehicle may have flown during interruptions.
    """

    lat: float | None = None
    lon: float | None = None
    altitude_m: float = 0.0
    amsl_m: float = 0.0
    north_mps: float = 0.0
    east_mps: float = 0.0
    down_mps: float = 0.0
    yaw_deg: float = 0.0
    position_at: float = -math.inf
    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    heading_deg: float = 0.0
    attitude_at: float = -math.inf
    gimbal: Attitude | None = None
    gimbal_at: float = -math.inf
    home: Home | None = None
    ground_home: Home | None = None
    mode: FlightMode = field(default_factory=FlightMode)
    armed: bool = False
    failsafe: bool = False
    heartbeat_at: float = -math.inf
    landed_state: int = mavlink.MAV_LANDED_STATE_UNDEFINED
    landed_at: float = -math.inf
    battery_remaining: float = math.nan
    battery_v: float = math.nan
    battery_a: float = math.nan
    ready: bool = False
    checks_at: float = -math.inf
    estimated: bool = False
    estimated_at: float = -math.inf
    fix_type: int = mavlink.GPS_FIX_TYPE_NO_GPS
    located: bool = False
    position_error_m: float = DEFAULT_ERROR_M
    velocity_history: deque[tuple[float, float, float]] = field(default_factory=deque)
    satellites: int | None = None
    wind_from_deg: float = 0.0
    wind_mps: float = 0.0
    wind_at: float = -math.inf
    texts: list[tuple[float, str]] = field(default_factory=list)
    status_texts: deque[StatusText] = field(default_factory=lambda: deque(maxlen=50))
    path_lost: bool = False
    failsafe_text: str = ""
    failsafe_text_at: float = -math.inf
    identity_problem: str = ""
    heartbeat_gap_s: float = 0.0
    stopped_in_air: bool = False
    position_problem: str = ""
    position_problem_at: float = -math.inf
    position_trusted_at: float = -math.inf
    expected_place: tuple[float, float] | None = None
    expected_error_m: float = 0.0

    @property
    def reports_on_ground(self) -> bool:
        """True if EXTENDED_SYS_STATE reports ON_GROUND and is as recent as the other messages."""
        recent = max(self.heartbeat_at, self.position_at) - self.landed_at <= LANDED_MAX_AGE_S
        return recent and self.landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND

    @property
    def in_air(self) -> bool:
        """True if the vehicle is airborne, or if its landed state is unknown."""
        if not self.armed:
            return False
        if self.landed_state in _IN_AIR:
            return True
        if self.reports_on_ground:
            return self.altitude_m > ON_GROUND_ALTITUDE_M
        return self.position_at == -math.inf or self.altitude_m > UNREPORTED_ALTITUDE_M

    @property
    def speed_mps(self) -> float:
        """Horizontal ground speed."""
        return math.hypot(self.north_mps, self.east_mps)

    def arming_refusal(self, now: float) -> str:
        """Return the reason why the autopilot would refuse to arm in GUIDED, or an empty string if it would arm.

        The reason is taken from recent messages of the autopilot.
        """
        if now - self.checks_at > READY_MAX_AGE_S:
            return "it does not report its pre-arm checks (SYS_STATUS)"
        if not self.ready:
            recent = [
                text for at, text in self.texts if now - at <= CHECKS_TEXT_MAX_AGE_S and text.startswith("PreArm:")
            ]
            reason = recent[-1] if recent else ""
            return reason or "its pre-arm checks fail"
        if now - self.estimated_at > READY_MAX_AGE_S:
            return "it does not report the state of its position estimate (EKF_STATUS_REPORT)"
        if not self.estimated:
            return "its position estimate is not accurate enough yet (EKF_STATUS_REPORT)"
        if self.position_problem:
            return f"its position is not trusted: {self.position_problem}"
        return self.identity_problem if self.home is not None else "it has no home yet (HOME_POSITION)"

    def position_fresh(self, now: float) -> bool:
        """Return True if the position is trusted and recent enough to judge calls and to fly."""
        return not self.position_problem and now - self.position_at <= MAX_POSITION_AGE_S

    def keeps_place(self, now: float) -> bool:
        """Return True if the position is known and the vehicle does not move horizontally."""
        return self.position_fresh(now) and self.speed_mps < STATIONARY_MPS

    def at_rest(self, now: float) -> bool:
        """Return True if the position is known and the vehicle is stationary, as the policy engine defines it."""
        return self.keeps_place(now) and abs(self.down_mps) < STATIONARY_MPS

    def distance_m(self, lat: float, lon: float) -> float:
        """Return the horizontal distance to a place; infinite while the position is unknown."""
        if self.lat is None or self.lon is None:
            return math.inf
        return math.hypot(*LocalFrame(lat, lon).xy(self.lat, self.lon))

    @property
    def forward_mps2(self) -> float | None:
        """Acceleration in the direction of flight; None while too few velocities are known."""
        if len(self.velocity_history) < 2:
            return None
        first_s, first_north_mps, first_east_mps = self.velocity_history[0]
        period_s = self.velocity_history[-1][0] - first_s
        if period_s < VELOCITY_HISTORY_S / 3:
            return None
        change_north_mps = self.north_mps - first_north_mps
        change_east_mps = self.east_mps - first_east_mps
        projection = change_north_mps * self.north_mps + change_east_mps * self.east_mps
        return projection / max(self.speed_mps, MIN_COURSE_MPS) / period_s

    @property
    def flight_state(self) -> str:
        """Flight state: inactive, takingOff, flying or landing."""
        if not self.in_air:
            return "inactive"
        if self.landed_state == mavlink.MAV_LANDED_STATE_TAKEOFF:
            return "takingOff"
        landing = self.landed_state == mavlink.MAV_LANDED_STATE_LANDING or self.mode.kind is ModeKind.LANDING
        return "landing" if landing else "flying"


@dataclass(frozen=True, slots=True)
class FailsafeStatus:
    """Result of a verification of the failsafes.

    Attributes:
        problem: Reason why arming is refused; empty if every required failsafe was read back.
        missing: Optional settings that the vehicle does not have.
        airframe: Dynamics from the vehicle's parameters. `retraces` is True if its failsafes return along the path.
        speed_mps: Speed of legs.
        records_path: True if the vehicle can return along its path.
        changed: Changed settings as sentences.
        lost: True if the only problem is that the vehicle did not answer.
    """

    problem: str
    missing: tuple[str, ...]
    airframe: Airframe
    speed_mps: float
    records_path: bool = False
    changed: tuple[str, ...] = ()
    lost: bool = False


class Modes(Protocol):
    """Flight modes that the service uses.

    Attributes:
        guided: Mode in which the autopilot follows the companion's commands.
        land: Mode that lands at the current position.
        return_straight: Mode that flies home on a straight line.
        return_retracing: Mode that flies home along the path; equal to `return_straight` if the firmware has none.
    """

    guided: FlightMode
    land: FlightMode
    return_straight: FlightMode
    return_retracing: FlightMode


class Autopilot(Protocol):
    """One vehicle and its commands. Commands raise AutopilotError if the vehicle refuses them or does not answer.

    Attributes:
        starting: Lock held while the start of the motors is being prepared.
    """

    starting: asyncio.Lock

    @property
    def vehicle(self) -> VehicleState:
        """Latest state of the vehicle."""

    @property
    def stack(self) -> Modes:
        """Firmware of the autopilot."""

    @property
    def now(self) -> float:
        """Monotonic seconds."""

    @property
    def pace(self) -> float:
        """Seconds of the vehicle's clock per second of real time; above 1 in an accelerated simulation."""

    @property
    def latency_s(self) -> float:
        """Upper bound of the time from the latest reported state to the effect of a command that is sent now.

        It is in seconds of the vehicle's clock, and infinite if the link is too slow to fly.
        """

    @property
    def downlink_latency_s(self) -> float:
        """Upper bound of the delay of a received message in seconds; infinite while it is unknown."""

    @property
    def pending(self) -> tuple[tuple[float, float, float], ...]:
        """Velocities (north, east, down) of recent setpoints that the reported state may not reflect yet."""

    @property
    def link_problem(self) -> str:
        """Reason why the link's delay forbids arming; empty if there is none."""

    @property
    def at_rest(self) -> bool:
        """True if the vehicle is known to be stationary and no setpoint that moves it is pending."""

    @property
    def found(self) -> bool:
        """True if the vehicle was identified since the connection was opened."""

    @property
    def connected(self) -> bool:
        """True while heartbeats of the vehicle arrive."""

    def send_heartbeat(self) -> None:
        """Send a heartbeat now if this service controls the drone."""

    async def update(self, timeout_s: float) -> bool:
        """Wait for an update of the vehicle's state; return False after the timeout."""

    async def set_mode(self, mode: FlightMode, permit: Permit = ...) -> None:
        """Change the flight mode and wait until the autopilot reports it."""

    async def arm(self, permit: Permit = ...) -> None:
        """Start the motors."""

    async def disarm(self, permit: Permit = ...) -> None:
        """Stop the motors. The autopilot refuses in the air."""

    async def set_home(self, lat: float, lon: float, amsl_m: float) -> None:
        """Set home to a position. If the vehicle later arms at another position, home does not move there."""

    async def request_home(self) -> None:
        """Request the home position now."""

    async def take_off(self, altitude_m: float, permit: Permit = ...) -> None:
        """Start to climb to an altitude above home."""

    async def go_to(
        self, lat: float, lon: float, altitude_m: float, yaw_deg: float | None, permit: Permit = ...
    ) -> None:
        """Start to fly straight to a point. The altitude is above home. Call `set_speed` after each `go_to`."""

    async def set_speed(self, speed_mps: float, permit: Permit = ...) -> None:
        """Set the horizontal ground speed of the current leg. The next leg may start with the default speed."""

    async def turn(self, yaw_deg: float, permit: Permit = ...) -> None:
        """Turn to a heading during the current leg."""

    async def point_gimbal(self, pitch_deg: float, yaw_deg: float, permit: Permit = ...) -> None:
        """Point the camera: pitch above the horizon, yaw clockwise from the vehicle's heading."""

    def stop(self) -> None:
        """Brake and hold the position."""

    def fly(self, north_mps: float, east_mps: float, down_mps: float, yaw_deg: float | None = None) -> None:
        """Fly with a velocity over ground. The autopilot stops the drone if no further setpoint arrives in time."""

    async def set_rates(self, flying: bool) -> None:
        """Request the message rates, which are higher in the air."""


class Failsafes(Protocol):
    """The autopilot's own failsafes for a silent companion or a low battery."""

    async def configure(self, *, flying: bool = False, before: FailsafeStatus | None = None) -> FailsafeStatus:
        """Set the failsafes, read each one back, and return them with the vehicle's dynamics."""

    async def choose_return(self, status: FailsafeStatus, *, retrace: bool) -> FailsafeStatus:
        """Configure the failsafes to return straight, or along the path if the vehicle records it."""

    async def learn_return(self, status: FailsafeStatus) -> FailsafeStatus:
        """Update the altitude of the autopilot's own return flight."""

    def concerns(self, name: str) -> bool:
        """Return True if the failsafes set or read the parameter with this name."""

    def learn(self, status: FailsafeStatus) -> FailsafeStatus:
        """Update the vehicle's dynamics from the parameters known so far."""


class ReturnLimits(Protocol):
    """Flight parameters of the autopilot during a mission, above all altitude and speed of its own return flight."""

    @property
    def limited(self) -> bool:
        """True while the vehicle has parameter values that this service set in place of the owner's values."""

    async def limit(self, bounds: ReturnBounds) -> tuple[str, ...]:
        """Limit the parameters to the bounds, and undo unnecessary limits. Return the changes as sentences."""

    async def lift(self, idle: Callable[[], bool]) -> None:
        """Restore the parameter values of the vehicle's owner."""


class Fence(Protocol):
    """The vehicle's own fence around a mission."""

    @property
    def missing(self) -> str:
        """Reason why the vehicle has no fence; empty if it has one."""

    @property
    def raised(self) -> bool:
        """True while the vehicle has a fence that this service set."""

    async def raise_around(self, spec: GrantSpec, *, retraces: bool) -> None:
        """Load the outer bounds of a grant, enable the fence, and verify everything by reading it back."""

    async def lower(self, idle: Callable[[], bool]) -> None:
        """Restore the owner's fence."""

    async def hold(self) -> tuple[str, ...]:
        """Revert changes that another station made to the mission's fence, and return them as sentences."""


@dataclass(frozen=True, slots=True)
class Safeguards:
    """Protection by the autopilot itself if this service fails in flight.

    Attributes:
        failsafes: Failsafes of the autopilot.
        fence: Fence of the vehicle.
        limit_return: Limits altitude and speed of the autopilot's own return to what a Grant allows, and returns the changes as
            sentences.
    """

    failsafes: Failsafes
    fence: Fence
    limit_return: Callable[[ActiveGrant], Awaitable[tuple[str, ...]]]


Approach = Callable[[TaskKind, Callable[[], bool], int], Awaitable[FlightMode]]
"""Flies to a position from which the autopilot may land or return by itself, and returns the mode for the rest of the flight.

The arguments are the task (land or return), a function that returns True while the system has control, and the number of refusals
by the autopilot.
"""


def always() -> None:
    """Permit a command at any time."""

"""What the mobility service needs of an autopilot: the state of its vehicle, its commands, and what it does by itself.

This is the seam: `authority` and `flight` know an autopilot by this module alone, `mavlink` is what is behind it.
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

Permit = Callable[[], None]
"""Asked before each sending of a command; raises when it must not be sent any more."""

BEING_SET = "they are being set"
"""The problem of failsafes that are not read back yet."""

LANDED_MAX_AGE_S = 2.0
SURELY_M, UNTOLD_M = 1.5, 0.5
"""Above the first a drone flies though it says it stands on the ground; above the second when it does not say."""
_IN_AIR = frozenset(
    {mavlink.MAV_LANDED_STATE_IN_AIR, mavlink.MAV_LANDED_STATE_TAKEOFF, mavlink.MAV_LANDED_STATE_LANDING}
)
DEFAULT_ERROR_M = 1.5
"""Position error, 1 sigma, of a GPS that tells none."""

MAX_POSITION_AGE_S = 1.0
"""A position older than this is no position: at 20 Hz in flight, twenty in a row were lost."""

WIND_MAX_AGE_S = 10.0
"""The wind was estimated longer ago than this by an autopilot that has stopped to tell."""

READY_MAX_AGE_S = 5.0
"""What the autopilot told of its readiness longer ago says nothing: at 1 Hz, four messages in a row were lost."""

COURSE_S = 0.3
"""Velocities this far back, by the vehicle's clock, tell how the drone speeds up."""

LEG_MPS = 1000.0
"""Of a leg that was begun a moment ago only the direction is known: it is pending with this speed, and so vertically."""

SLOW_MPS = 0.1
"""Below this speed a drone has no course: its velocity is noise."""


@dataclass(slots=True)
class VehicleState:
    """What the autopilot last said of the vehicle; times are monotonic seconds.

    Attributes:
        position_at: when the position would have come, had it come as fast as the fastest of late.
        yaw_deg: heading as the position says it; `heading_deg` is the attitude's.
        gimbal: how it turns the camera, yaw from true north, as measured; its time is that of the older of two measurements,
            for its yaw counts from the nose.
        ground_home: home as it was told last while the vehicle did not fly, or first after it was armed; None until then.
        ready: whether its checks before arming pass, in the mode in which it is.
        checks_at: when it told that.
        estimated: whether its estimator has an absolute position, and predicts one.
        estimated_at: when it told that.
        path_lost: whether the autopilot has given up remembering its path since it was armed.
        satellites: that the receiver sees; None until it has told.
        wind_at: when the autopilot told of the wind.
        reports: number, MAV_SEVERITY and text of what the autopilot said of late.
        unclear: why it is not certain which vehicle on the link is the drone's own; empty when it is.
        silent_s: how long before its last heartbeat came the one before that.
        located: whether GPS has a three-dimensional fix of some accuracy; positions without one are not taken.
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
    courses: deque[tuple[float, float, float]] = field(default_factory=deque)
    satellites: int | None = None
    wind_from_deg: float = 0.0
    wind_mps: float = 0.0
    wind_at: float = -math.inf
    texts: list[str] = field(default_factory=list)
    reports: deque[tuple[int, int, str]] = field(default_factory=lambda: deque(maxlen=50))
    path_lost: bool = False
    failsafe_text: str = ""
    failsafe_text_at: float = -math.inf
    unclear: str = ""
    silent_s: float = 0.0

    @property
    def standing(self) -> bool:
        """Whether the autopilot says, as lately as it says the rest, that it stands on the ground."""
        told = max(self.heartbeat_at, self.position_at) - self.landed_at <= LANDED_MAX_AGE_S
        return told and self.landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND

    @property
    def in_air(self) -> bool:
        """Whether it flies, in doubt it does."""
        if not self.armed:
            return False
        if self.landed_state in _IN_AIR:
            return True
        if self.standing:
            return self.altitude_m > SURELY_M
        return self.position_at == -math.inf or self.altitude_m > UNTOLD_M

    @property
    def speed_mps(self) -> float:
        """Horizontal speed over ground."""
        return math.hypot(self.north_mps, self.east_mps)

    def unready(self, now: float) -> str:
        """Why it would not arm in the mode in which it obeys the companion; empty when it would, as far as it has told lately."""
        if now - self.checks_at > READY_MAX_AGE_S:
            return "it does not tell whether its checks pass (SYS_STATUS)"
        if not self.ready:
            told = next((text for text in reversed(self.texts) if text.startswith("PreArm")), "")
            return told or "its checks fail"
        if now - self.estimated_at > READY_MAX_AGE_S:
            return "it does not tell whether it knows its position (EKF_STATUS_REPORT)"
        if not self.estimated:
            return "it does not know its position well enough yet (EKF_STATUS_REPORT)"
        return self.unclear if self.home is not None else "it has no home yet (HOME_POSITION)"

    def position_fresh(self, now: float) -> bool:
        """Whether the position is recent enough to judge and to fly by; `now` is monotonic, as `position_at` is."""
        return now - self.position_at <= MAX_POSITION_AGE_S

    def keeps_place(self, now: float) -> bool:
        """Whether it surely stays above one place."""
        return self.position_fresh(now) and self.speed_mps < STATIONARY_MPS

    def at_rest(self, now: float) -> bool:
        """Whether it surely stands, in the sense of the policy engine."""
        return self.keeps_place(now) and abs(self.down_mps) < STATIONARY_MPS

    def distance_m(self, lat: float, lon: float) -> float:
        """How far away a place is over ground; infinite while the position is unknown."""
        if self.lat is None or self.lon is None:
            return math.inf
        return math.hypot(*LocalFrame(lat, lon).xy(self.lat, self.lon))

    @property
    def forward_mps2(self) -> float | None:
        """How much it speeds up along its course, over the last velocities; None while these are too few."""
        if len(self.courses) < 2:
            return None
        (begun, north, east), (now, *_) = self.courses[0], self.courses[-1]
        if now - begun < COURSE_S / 3:
            return None
        along = (self.north_mps - north) * self.north_mps + (self.east_mps - east) * self.east_mps
        return along / max(self.speed_mps, SLOW_MPS) / (now - begun)

    @property
    def flight_state(self) -> str:
        """inactive, takingOff, flying or landing."""
        if not self.in_air:
            return "inactive"
        if self.landed_state == mavlink.MAV_LANDED_STATE_TAKEOFF:
            return "takingOff"
        landing = self.landed_state == mavlink.MAV_LANDED_STATE_LANDING or self.mode.kind is ModeKind.LANDING
        return "landing" if landing else "flying"


@dataclass(frozen=True, slots=True)
class Checked:
    """What the autopilot will do by itself, and what it will not.

    Attributes:
        problem: why nothing may arm; empty when every needed failsafe was read back.
        missing: optional ones that the vehicle does not offer.
        remembers: whether the vehicle can go back the way it came; `airframe.retraces` says that its failsafes will.
        airframe: how it moves, from its own parameters.
        speed_mps: the speed it flies legs with.
        changed: what was set, in sentences.
        lost: whether the problem is only that the vehicle did not answer.
    """

    problem: str
    missing: tuple[str, ...]
    airframe: Airframe
    speed_mps: float
    remembers: bool = False
    changed: tuple[str, ...] = ()
    lost: bool = False


class Modes(Protocol):
    """The flight modes that the service itself uses.

    Attributes:
        guided: the mode in which the autopilot obeys the companion.
        land: the mode in which it lands where it is.
        return_straight: the mode in which it flies home straight.
        return_retracing: the mode in which it flies home on the path that it came; `return_straight` where there is none.
    """

    guided: FlightMode
    land: FlightMode
    return_straight: FlightMode
    return_retracing: FlightMode


class Autopilot(Protocol):
    """One vehicle, and what it can be told. Commands raise AutopilotError when the vehicle refuses, or is not heard.

    Attributes:
        starting: held by the one who prepares to start the motors.
    """

    starting: asyncio.Lock

    @property
    def vehicle(self) -> VehicleState:
        """The streamed state."""

    @property
    def stack(self) -> Modes:
        """Its firmware."""

    @property
    def now(self) -> float:
        """Monotonic seconds."""

    @property
    def pace(self) -> float:
        """How many of the vehicle's seconds go by in one of ours: more than one in a simulator that runs faster."""

    @property
    def latency_s(self) -> float:
        """The vehicle's seconds from the state that is known to the effect of a command sent now, at most; infinite: too long to fly by."""

    @property
    def downlink_latency_s(self) -> float:
        """Seconds that a message takes here, at most; infinite while that is not known."""

    @property
    def pending(self) -> tuple[tuple[float, float, float], ...]:
        """Velocities north, east and down that commands of late ask for, which the state that is known may not show yet."""

    @property
    def link_problem(self) -> str:
        """Why the link lets nothing arm; empty when nothing is wrong."""

    @property
    def at_rest(self) -> bool:
        """Whether the vehicle surely stands, and was told nothing else."""

    @property
    def found(self) -> bool:
        """Whether the vehicle was heard since the link came up."""

    @property
    def connected(self) -> bool:
        """Whether the vehicle is heard."""

    def send_heartbeat(self) -> None:
        """Send a heartbeat now, if the companion does its duty."""

    async def update(self, timeout_s: float) -> bool:
        """Wait for a message of the vehicle; False when none came in time."""

    async def set_mode(self, mode: FlightMode, permit: Permit = ...) -> None:
        """Change the flight mode and wait until the autopilot flies it."""

    async def arm(self, permit: Permit = ...) -> None:
        """Start the motors."""

    async def disarm(self, permit: Permit = ...) -> None:
        """Stop the motors; the autopilot refuses in the air."""

    async def set_home(self, lat: float, lon: float, amsl_m: float) -> None:
        """Fix home, so that arming elsewhere does not move it."""

    async def request_home(self) -> None:
        """Ask for the home position now."""

    async def take_off(self, altitude_m: float, permit: Permit = ...) -> None:
        """Begin to climb to an altitude above home."""

    async def go_to(
        self, lat: float, lon: float, altitude_m: float, yaw_deg: float | None, permit: Permit = ...
    ) -> None:
        """Begin to fly straight to a point; altitude above home. Its speed is to be set each time, see `set_speed`."""

    async def set_speed(self, speed_mps: float, permit: Permit = ...) -> None:
        """Fly the leg under way with this horizontal speed over ground; the next one may begin with the default again."""

    async def turn(self, yaw_deg: float, permit: Permit = ...) -> None:
        """Point the nose, on the leg under way."""

    async def point_gimbal(self, pitch_deg: float, yaw_deg: float, permit: Permit = ...) -> None:
        """Turn the camera: pitch over the horizon, yaw clockwise from the nose."""

    def stop(self) -> None:
        """Brake and hold."""

    def fly(self, north_mps: float, east_mps: float, down_mps: float, yaw_deg: float | None = None) -> None:
        """Fly with a velocity over ground, until it times out in the autopilot."""

    async def set_rates(self, flying: bool) -> None:
        """Ask for the streams, more often in the air."""


class Failsafes(Protocol):
    """What the autopilot does by itself when the companion falls silent, or the battery runs low."""

    async def configure(self, *, flying: bool = False, before: Checked | None = None) -> Checked:
        """Set them, read each one back, and learn how the vehicle moves."""

    async def choose_return(self, checked: Checked, *, retrace: bool) -> Checked:
        """Let them bring the drone home straight, or, where the vehicle can, on the path that it came."""

    async def learn_return(self, checked: Checked) -> Checked:
        """Learn at which altitude the autopilot flies home by itself."""

    def concerns(self, name: str) -> bool:
        """Whether a parameter is one of those that are set or read here."""

    def learn(self, checked: Checked) -> Checked:
        """How the vehicle moves by what it has told until now."""


class ReturnLimits(Protocol):
    """How the autopilot flies during a mission, and how high and how fast home by itself."""

    @property
    def limited(self) -> bool:
        """Whether the vehicle has values of ours."""

    async def limit(self, bounds: ReturnBounds) -> tuple[str, ...]:
        """Set what is above the bounds, what was lowered more than they ask, and what a mission needs; what changed, in sentences."""

    async def lift(self, idle: Callable[[], bool]) -> None:
        """Put back what the owner had, if anything was changed."""


class Fence(Protocol):
    """The vehicle's own fence around a mission."""

    @property
    def missing(self) -> str:
        """Why there is none; empty when the autopilot offers one."""

    @property
    def raised(self) -> bool:
        """Whether the vehicle has a fence of ours."""

    async def raise_around(self, spec: GrantSpec, *, retraces: bool) -> None:
        """Load the outer bounds of a grant, switch the fence on, and read all of it back."""

    async def lower(self, idle: Callable[[], bool]) -> None:
        """Put back what the owner had, if anything was changed."""

    async def hold(self) -> tuple[str, ...]:
        """Set back what another station changed of the mission's fence; what that was, in sentences."""


Approach = Callable[[TaskKind, Callable[[], bool], int], Awaitable[FlightMode]]
"""Flies to where the autopilot may come down by itself, and says in which mode it does the rest; asked with whether the drone is to
land or to return, whether the system still has it, and how often the autopilot refused."""


def always() -> None:
    """The permit of what may be sent at any time."""

"""Inputs and outputs of the policy engine: calls, situations, verdicts."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from operator import attrgetter
from typing import Literal

from fractus_core.api.geometry import Reference
from fractus_core.api.methods import METHODS_OF, Service
from fractus_core.api.policies import FaceMethod, Fallback, FilterAction

STATIONARY_MPS = 0.5
"""A drone whose horizontal and vertical speed are lower counts as stationary: it turns on the spot, within its tracking
margin."""

Action = Literal["allow", "correct", "deny", "takeover"]
Takeover = Literal["hover", "land", "returnToLaunch", "abort", "revoke"]


@dataclass(frozen=True, slots=True)
class TakeoffArgs:
    """Climb from the ground.

    Attributes:
        altitude_m: Metres above home.
    """

    altitude_m: float


@dataclass(frozen=True, slots=True)
class GotoArgs:
    """Fly straight to a point.

    Attributes:
        lat: Degrees north, WGS 84.
        lon: Degrees east, WGS 84.
        alt: Metres in the datum of `reference`. None keeps the present altitude.
        reference: Datum of `alt`.
        yaw_deg: Heading to hold, degrees clockwise from true north. None leaves the heading to the autopilot.
        speed_mps: Horizontal speed to fly at. None keeps the current speed setpoint.
    """

    lat: float
    lon: float
    alt: float | None = None
    reference: Reference = "home"
    yaw_deg: float | None = None
    speed_mps: float | None = None


@dataclass(frozen=True, slots=True)
class SetSpeedArgs:
    """Change the horizontal speed over ground, in metres per second."""

    speed_mps: float


@dataclass(frozen=True, slots=True)
class VelocityArgs:
    """Fly with a velocity until the next setpoint arrives. If none arrives within the hold time, the drone is stopped.

    Attributes:
        north_mps: Velocity over ground.
        east_mps: Velocity over ground.
        down_mps: Vertical velocity, positive down.
        yaw_deg: Heading to hold, degrees clockwise from true north. None leaves the heading to the autopilot.
        hold_s: Seconds after which the drone is stopped if no other setpoint has arrived.
    """

    north_mps: float
    east_mps: float
    down_mps: float = 0.0
    yaw_deg: float | None = None
    hold_s: float = 0.5


@dataclass(frozen=True, slots=True)
class PointGimbalArgs:
    """Point the camera with the gimbal.

    Attributes:
        pitch_deg: Angle above the horizon: 0 looks ahead, -90 straight down.
        yaw_deg: Degrees clockwise from the nose. The camera follows the nose.
    """

    pitch_deg: float
    yaw_deg: float = 0.0


@dataclass(frozen=True, slots=True)
class CaptureArgs:
    """Take a picture of this size in pixels. 0 means the camera's default."""

    width: int = 0
    height: int = 0


class UncertainTime(float):
    """Unix time of a clock that was stepped. The true time may be any time between the earliest and the latest reading.

    The value of the number is the latest reading. A restriction applies if it is in force at any time between the
    readings. A permission applies only if it is in force at all times between them.
    """

    earliest: float

    def __new__(cls, latest: float, earliest: float) -> UncertainTime:
        """Create the time between the latest and the earliest reading."""
        time_s = super().__new__(cls, latest)
        time_s.earliest = min(earliest, latest)
        return time_s


def earliest_time(time_s: float) -> float:
    """Return the earliest reading of an uncertain time, or the time itself."""
    return time_s.earliest if isinstance(time_s, UncertainTime) else time_s


Args = TakeoffArgs | GotoArgs | SetSpeedArgs | VelocityArgs | PointGimbalArgs | CaptureArgs | None


@dataclass(frozen=True, slots=True)
class Call:
    """A call of a service method by a component."""

    method: str
    args: Args = None

    @property
    def service(self) -> Service:
        """The system service that the method belongs to."""
        return "camera" if self.method in METHODS_OF["camera"] else "mobility"


@dataclass(frozen=True, slots=True)
class Home:
    """Takeoff and return location: degrees, and metres above mean sea level."""

    lat: float
    lon: float
    amsl_m: float


@dataclass(frozen=True, slots=True)
class Airframe:
    """Motion parameters of the autopilot. The defaults are the defaults of ArduCopter.

    Attributes:
        accel_mps2: Horizontal acceleration when braking.
        position_gain: Proportional gain of the position controller, 1/s.
        climb_accel_mps2: Vertical acceleration.
        jerk_mps3: Rate of change of the acceleration.
        return_altitude_m: Altitude above home of return to launch.
        tracking_m: Largest deviation from a straight leg, sideways and in altitude.
        overshoot_share: Largest share by which the ground speed exceeds a fast commanded speed.
        overshoot_mps: Largest excess of a slower commanded speed, m/s. It occurs when a drone that turned with the wind
            ends its climb: the controller still compensates the former headwind.
        slow_overshoot_share: Largest share by which the ground speed exceeds a very slow commanded speed.
        overshoot_m: Largest height by which the drone climbs or sinks past a commanded altitude.
        retraces: True if the autopilot returns along the path it flew (ArduPilot's SmartRTL) instead of in a straight
            line. A target is then legal if any legal route home exists.
    """

    accel_mps2: float = 2.5
    position_gain: float = 1.0
    climb_accel_mps2: float = 1.0
    jerk_mps3: float = 5.0
    return_altitude_m: float = 15.0
    tracking_m: float = 1.0
    overshoot_share: float = 0.05
    overshoot_mps: float = 0.5
    slow_overshoot_share: float = 0.15
    overshoot_m: float = 0.2
    retraces: bool = False

    def highest_command_mps(self, limit_mps: float) -> float:
        """Return the highest speed to command under a speed limit."""
        slow_mps = min(self.overshoot_mps, self.slow_overshoot_share * limit_mps)
        return limit_mps - max(self.overshoot_share * limit_mps, slow_mps)


@dataclass(frozen=True, slots=True)
class Attitude:
    """Rotation of the airframe, or of a camera on a gimbal: yaw, then pitch, then roll.

    Attributes:
        roll_deg: Positive with the right side down.
        pitch_deg: Positive with the nose up.
        yaw_deg: Clockwise from true north.
        tilt_error_deg: Bound of the sum of the errors of roll and pitch.
        yaw_error_deg: Bound of the error of yaw.
    """

    roll_deg: float
    pitch_deg: float
    yaw_deg: float
    tilt_error_deg: float = 5.0
    yaw_error_deg: float = 15.0


@dataclass(frozen=True, slots=True)
class Lens:
    """Field of view of a camera and its orientation relative to the airframe, or to the fixed node.

    Attributes:
        horizontal_deg: Field of view from side to side.
        vertical_deg: Field of view from top to bottom.
        pitch_deg: Pitch of the mount: 0 forward, -90 straight down.
        yaw_deg: Yaw of the mount, clockwise from the nose, or from true north on a fixed node.
        stabilised: True if a gimbal keeps the mount level, so that roll and pitch of the airframe have no effect.
        error_deg: Bound of the error of the mount's direction.
    """

    horizontal_deg: float
    vertical_deg: float
    pitch_deg: float = -90.0
    yaw_deg: float = 0.0
    stabilised: bool = False
    error_deg: float = 2.0


@dataclass(frozen=True, slots=True)
class Situation:
    """State of node and drone at the moment of a decision.

    Attributes:
        time_s: Unix time in seconds. An `UncertainTime` if the clock is in doubt.
        lat: Degrees north. None while the position is unknown.
        lon: Degrees east. None while the position is unknown.
        altitude_m: Metres above home.
        north_mps: Velocity over ground.
        east_mps: Velocity over ground.
        down_mps: Velocity over ground, positive down.
        home: None while it is unknown, and on fixed nodes.
        position_error_m: Bound of the horizontal position error.
        altitude_error_m: Bound of the vertical position error.
        latency_s: Longest time from this state until a decision affects the motion.
        speed_setpoint_mps: Horizontal speed that the autopilot controls to: the speed of legs, or of the current velocity
            setpoint if that is higher.
        forward_mps2: Acceleration along the course, from the last velocities. Negative while slowing down, None if
            unknown.
        pending: Recent velocity setpoints (north, east, down) that velocity and acceleration do not reflect yet. The
            drone may follow any of them at any moment. The latest is last.
        vertical: True if the drone is taking off or landing. Lower altitude limits do not apply then.
        attitude: None if unknown. The camera may then look anywhere, unless a gimbal keeps it level.
        lens: None if the node's camera is not described. It may then see everything around it.
        relief_m: Maximum depth of the surrounding ground below home.
        exposure: Successive states since the capture of a picture began. The picture may show everything seen from each
            of these states and between them.
    """

    time_s: float
    lat: float | None = None
    lon: float | None = None
    altitude_m: float = 0.0
    north_mps: float = 0.0
    east_mps: float = 0.0
    down_mps: float = 0.0
    home: Home | None = None
    armed: bool = False
    in_air: bool = False
    position_error_m: float = 1.5
    altitude_error_m: float = 1.0
    latency_s: float = 0.3
    speed_setpoint_mps: float = 5.0
    forward_mps2: float | None = None
    pending: tuple[tuple[float, float, float], ...] = ()
    vertical: bool = False
    airframe: Airframe = field(default_factory=Airframe)
    attitude: Attitude | None = None
    lens: Lens | None = None
    relief_m: float = 0.0
    exposure: tuple[Situation, ...] = ()

    @property
    def margin_m(self) -> float:
        """Horizontal distance that a leg keeps from fences: position error plus tracking error.

        The stopping distance is not part of the margin, because it applies only in the direction of motion: a leg sweeps the
        triangle of present position, turning point and target.
        """
        return self.position_error_m + self.airframe.tracking_m

    @property
    def height_margin_m(self) -> float:
        """Vertical distance that a leg keeps from floors and ceilings of zones: altitude error plus tracking error."""
        return self.altitude_error_m + self.airframe.tracking_m

    @property
    def is_moving(self) -> bool:
        """True if the drone is too fast to turn on the spot, or may be too fast when a command takes effect."""
        moves = math.hypot(self.north_mps, self.east_mps) >= STATIONARY_MPS or abs(self.down_mps) >= STATIONARY_MPS
        return moves or self.is_pending_motion

    @property
    def is_pending_motion(self) -> bool:
        """True if a pending velocity setpoint is too fast for a turn on the spot."""
        return any(
            math.hypot(north, east) >= STATIONARY_MPS or abs(down) >= STATIONARY_MPS
            for north, east, down in self.pending
        )

    @property
    def is_plausible(self) -> bool:
        """True if every number is finite and of a physically possible size."""
        numbers = (*_SITUATION_NUMBERS(self), *_AIRFRAME_NUMBERS(self.airframe))
        if self.home is not None:
            numbers += (self.home.lat, self.home.lon, self.home.amsl_m)
        if self.attitude is not None:
            numbers += _ATTITUDE_NUMBERS(self.attitude)
        if self.lens is not None:
            numbers += _LENS_NUMBERS(self.lens)
        # The sum is small only if every term is small. If a term is NaN, the comparison is false.
        size: float = sum(abs(number) for number in numbers if number is not None)
        return size < _IMPLAUSIBLE


_IMPLAUSIBLE = 1e12
"""Larger than any number of a Situation, including its time (seconds since 1970)."""

_SITUATION_NUMBERS = attrgetter(
    "time_s", "lat", "lon", "altitude_m", "north_mps", "east_mps", "down_mps", "position_error_m", "altitude_error_m",
    "latency_s", "speed_setpoint_mps", "forward_mps2", "relief_m",
)  # fmt: skip
_AIRFRAME_NUMBERS = attrgetter(*(f.name for f in fields(Airframe)))
_ATTITUDE_NUMBERS = attrgetter(*(f.name for f in fields(Attitude)))
_LENS_NUMBERS = attrgetter(*(f.name for f in fields(Lens)))


@dataclass(frozen=True, slots=True)
class Filter:
    """Step of the processing of a picture before it is returned to a component.

    Attributes:
        action: Black out the picture, blur all of it, hide faces, or keep only moving objects.
        faces: Method of hiding faces. Used by blurFaces only.
        fallback: Processing used if faces cannot be found reliably. Used by blurFaces only.
    """

    action: FilterAction
    faces: FaceMethod = "pixelate"
    fallback: Fallback = "blurAverage"


@dataclass(frozen=True, slots=True)
class Verdict:
    """Decision of the engine on a call, with its reason.

    Attributes:
        action: Allow as requested, correct the arguments, deny, or take over the drone.
        args: Arguments to carry out, after correction.
        code: Stable CamelCase identifier for programs. Empty if allowed.
        reason: One sentence with numbers for people. Empty if allowed.
        policies: Names of the policies that decided, most restrictive first.
        takeover: What the system does with the drone. Set for the action takeover, and for a denial that also stops the
            motion.
        filters: Processing of a picture before it is returned, in this order.
        brake_first: True if the drone must stop before anything else, because it is too fast for the turn that follows.
            With `allow` and `correct`: stop (as Hover does), wait until the drone is slower than `STATIONARY_MPS`,
            judge the requested call again and carry out that verdict. Never send these `args` before that. With
            `takeover`: stop, wait for the same condition, then land or return.
    """

    action: Action
    args: Args = None
    code: str = ""
    reason: str = ""
    policies: tuple[str, ...] = ()
    takeover: Takeover | None = None
    filters: tuple[Filter, ...] = ()
    brake_first: bool = False

    @property
    def permits(self) -> bool:
        """True if the call is carried out, as requested or corrected."""
        return self.action in {"allow", "correct"}


def distinct(names: Iterable[str]) -> tuple[str, ...]:
    """Return the names in their order, without duplicates and empty names."""
    return tuple(dict.fromkeys(name for name in names if name))


def format_distance(distance_m: float) -> str:
    """Format a distance for people. Distances below 0.05 m are not shown as "0.0 m"."""
    return "less than 0.1 m" if distance_m < 0.05 else f"{distance_m:.1f} m"


def deny(code: str, reason: str, policies: tuple[str, ...] = ()) -> Verdict:
    """Return a denial."""
    return Verdict("deny", None, code, reason, policies)


# Reasons do not name the method: clients print it before the reason.
DENY_NO_ARGUMENTS = deny("InvalidArgument", "the arguments are missing")
DENY_POSITION_UNKNOWN = deny(
    "PositionUnknown",
    "the drone's position is unknown: there is no recent fix, the delay of the autopilot link is not measured yet, or"
    " another ground station changed the home position; wait until the drone is ready",
)

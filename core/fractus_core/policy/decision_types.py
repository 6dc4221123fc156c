"""What the policy engine takes and gives: calls, situations, verdicts."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from operator import attrgetter
from typing import Literal

from fractus_core.api.geometry import Reference
from fractus_core.api.methods import METHODS_OF, Service
from fractus_core.api.policies import FaceMethod, Fallback, FilterAction

STATIONARY_MPS = 0.5
"""A drone slower than this, on the ground and vertically, stands: it turns on the spot, within its tracking margin."""

Action = Literal["allow", "correct", "deny", "takeover"]
Takeover = Literal["hover", "land", "returnToLaunch", "revoke"]


@dataclass(frozen=True, slots=True)
class TakeoffArgs:
    """Climb from the ground.

    Attributes:
        altitude_m: metres above home.
    """

    altitude_m: float


@dataclass(frozen=True, slots=True)
class GotoArgs:
    """Fly straight to a point.

    Attributes:
        lat: degrees north, WGS 84.
        lon: degrees east, WGS 84.
        alt: metres in the datum of `reference`; None keeps the present altitude.
        reference: what `alt` is measured from.
        yaw_deg: heading to hold, degrees clockwise from true north; None leaves it to the autopilot.
        speed_mps: horizontal speed to fly at; None keeps the speed in force.
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
    """Fly with a velocity until the next one comes, or until the hold is over and the drone stops by itself.

    Attributes:
        north_mps: velocity over ground.
        east_mps: velocity over ground.
        down_mps: velocity, positive down.
        yaw_deg: heading to hold, degrees clockwise from true north; None leaves it to the autopilot.
        hold_s: seconds after which the drone is stopped when no other setpoint has come.
    """

    north_mps: float
    east_mps: float
    down_mps: float = 0.0
    yaw_deg: float | None = None
    hold_s: float = 0.5


@dataclass(frozen=True, slots=True)
class PointGimbalArgs:
    """Turn the camera by the gimbal.

    Attributes:
        pitch_deg: over the horizon: 0 looks ahead, -90 straight down.
        yaw_deg: clockwise from the nose, which the camera follows.
    """

    pitch_deg: float
    yaw_deg: float = 0.0


@dataclass(frozen=True, slots=True)
class CaptureArgs:
    """Take a picture of this size in pixels; 0 means the camera's default."""

    width: int = 0
    height: int = 0


class UncertainTime(float):
    """Unix time of a clock that was set back: the later reading, and the earlier one that may be right instead.

    Restrictions hold from the earlier to the later reading, permissions only when they hold at both.
    """

    earliest: float

    def __new__(cls, latest: float, earliest: float) -> UncertainTime:
        """A time between two readings."""
        moment = super().__new__(cls, latest)
        moment.earliest = min(earliest, latest)
        return moment


def earliest_time(time_s: float) -> float:
    """The earliest that a time may be."""
    return time_s.earliest if isinstance(time_s, UncertainTime) else time_s


Args = TakeoffArgs | GotoArgs | SetSpeedArgs | VelocityArgs | PointGimbalArgs | CaptureArgs | None


@dataclass(frozen=True, slots=True)
class Call:
    """One service method with its arguments, as a component asked for it."""

    method: str
    args: Args = None

    @property
    def service(self) -> Service:
        """The system service that the method belongs to."""
        return "camera" if self.method in METHODS_OF["camera"] else "mobility"


@dataclass(frozen=True, slots=True)
class Home:
    """Where the drone took off and returns to: degrees, and metres above mean sea level."""

    lat: float
    lon: float
    amsl_m: float


@dataclass(frozen=True, slots=True)
class Airframe:
    """How the autopilot moves the drone; the defaults are ArduCopter's.

    Attributes:
        accel_mps2: horizontal acceleration it brakes with.
        position_gain: proportional gain of the position controller, 1/s.
        climb_accel_mps2: vertical acceleration.
        jerk_mps3: how fast it changes its acceleration.
        return_altitude_m: altitude above home at which it returns to launch.
        tracking_m: how far it strays from a straight leg, sideways and in height.
        retraces: whether it returns to launch on the path that it came (ArduPilot's SmartRTL), not straight; then a
            target is legal when some legal way home exists.
    """

    accel_mps2: float = 2.5
    position_gain: float = 1.0
    climb_accel_mps2: float = 1.0
    jerk_mps3: float = 5.0
    return_altitude_m: float = 15.0
    tracking_m: float = 1.0
    retraces: bool = False


@dataclass(frozen=True, slots=True)
class Attitude:
    """How the airframe is turned, or the camera on a gimbal: yaw, then pitch, then roll.

    Attributes:
        roll_deg: right side down is positive.
        pitch_deg: nose up is positive.
        yaw_deg: clockwise from true north.
        tilt_error_deg: bound of the errors of roll and pitch, added up.
        yaw_error_deg: bound of the error of yaw.
    """

    roll_deg: float
    pitch_deg: float
    yaw_deg: float
    tilt_error_deg: float = 5.0
    yaw_error_deg: float = 15.0


@dataclass(frozen=True, slots=True)
class Lens:
    """What a camera sees of the world around its airframe, or around its fixed node.

    Attributes:
        horizontal_deg: field of view from side to side.
        vertical_deg: field of view from top to bottom.
        pitch_deg: of the mount: 0 forward, -90 straight down.
        yaw_deg: of the mount: clockwise from the nose; on a fixed node from true north.
        stabilised: whether a gimbal keeps the mount level, so that roll and pitch of the airframe do not matter.
        error_deg: bound of the error of the mount's direction.
    """

    horizontal_deg: float
    vertical_deg: float
    pitch_deg: float = -90.0
    yaw_deg: float = 0.0
    stabilised: bool = False
    error_deg: float = 2.0


@dataclass(frozen=True, slots=True)
class Situation:
    """The state of node and drone at the moment of a decision.

    Attributes:
        time_s: Unix time in seconds; a `UncertainTime` when the clock is in doubt.
        lat: degrees north; None while the position is unknown.
        lon: degrees east; None while the position is unknown.
        altitude_m: metres above home.
        north_mps: velocity over ground.
        east_mps: velocity over ground.
        down_mps: velocity over ground.
        home: None while it is unknown, and on fixed nodes.
        position_error_m: bound of the horizontal position error.
        altitude_error_m: bound of the vertical position error.
        latency_s: time from this state to the effect of a decision on the motion, at most.
        speed_setpoint_mps: horizontal speed that the autopilot flies legs with, or that of the velocity it was told to
            hold, when that is higher: the speed that the present motion tends to.
        forward_mps2: how much the drone speeds up along its course (negative: slows down), from the last velocities; None
            while it is unknown.
        pending: velocities north, east and down that it was told to take up a moment ago, which it may do at once or has
            begun to, though neither velocity nor acceleration show it yet; the latest last.
        vertical: whether the drone is taking off or landing, when lower altitude limits do not hold.
        attitude: None while it is unknown; the camera may look anywhere then, unless a gimbal keeps it level.
        lens: None on a node whose camera is not described: it may see everything around it.
        relief_m: how far the ground around may lie below home.
        exposure: states since a picture began to be taken, one after the other: it may show what is seen from each of
            these, and between them.
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
    def is_plausible(self) -> bool:
        """Whether every figure is a number, and one that can be of this world."""
        figures = (*_FIGURES(self), *_MOTION(self.airframe))
        if self.home is not None:
            figures += (self.home.lat, self.home.lon, self.home.amsl_m)
        if self.attitude is not None:
            figures += _TURNS(self.attitude)
        if self.lens is not None:
            figures += _VIEW(self.lens)
        # A sum of sizes is small only if all of them are; with NaN it is not less than anything.
        size: float = sum(abs(figure) for figure in figures if figure is not None)
        return size < _ABSURD


_ABSURD = 1e12
"""More than any figure of a Situation, also its time (s since 1970)."""

_FIGURES = attrgetter(
    "time_s", "lat", "lon", "altitude_m", "north_mps", "east_mps", "down_mps", "position_error_m", "altitude_error_m",
    "latency_s", "speed_setpoint_mps", "forward_mps2", "relief_m",
)  # fmt: skip
_MOTION = attrgetter(*(f.name for f in fields(Airframe)))
_TURNS = attrgetter(*(f.name for f in fields(Attitude)))
_VIEW = attrgetter(*(f.name for f in fields(Lens)))


@dataclass(frozen=True, slots=True)
class Filter:
    """What is done to a picture before it is handed out.

    Attributes:
        action: black it out, blur all of it, hide faces, or keep only what moves.
        faces: how faces are hidden; means something with blurFaces only.
        fallback: what is done where faces cannot be found reliably; means something with blurFaces only.
    """

    action: FilterAction
    faces: FaceMethod = "pixelate"
    fallback: Fallback = "blurAverage"


@dataclass(frozen=True, slots=True)
class Verdict:
    """What becomes of a call, and why.

    Attributes:
        action: allow as asked, correct the arguments, deny, or take the drone over.
        args: the arguments to carry out, after correction.
        code: CamelCase and stable, for programs; empty when allowed.
        reason: one sentence with figures, for people; empty when allowed.
        policies: names of the policies that decided, most restrictive first.
        takeover: what the system does with the drone; set with action takeover, and with a denial after an
            internal error.
        filters: what must be done to a picture before it is handed out, in this order.
        brake_first: the drone must be brought to a stop before anything else, for it is too fast for the turn that
            follows. With `allow` and `correct`: stop (as Hover does), wait until the drone is slower than `STATIONARY_MPS`,
            judge the call as it was asked again, and carry out that verdict; never send these `args` before. With
            `takeover`: stop, wait for the same, then land or return.
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
        """Whether something is carried out."""
        return self.action in {"allow", "correct"}


def distinct(names: Iterable[str]) -> tuple[str, ...]:
    """Names in their order, each once; those that are empty are left out."""
    return tuple(dict.fromkeys(name for name in names if name))


def format_distance(distance_m: float) -> str:
    """A distance for people, who would read "0.0 m" as none at all."""
    return "less than 0.1 m" if distance_m < 0.05 else f"{distance_m:.1f} m"


def deny(code: str, reason: str, policies: tuple[str, ...] = ()) -> Verdict:
    """A refusal."""
    return Verdict("deny", None, code, reason, policies)


POSITION_UNKNOWN = deny(
    "PositionUnknown",
    "the drone's position is unknown: no recent fix, the delay of its link is not measured yet, or another station moved"
    " its home; wait until it is ready",
)

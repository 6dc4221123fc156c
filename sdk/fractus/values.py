"""What the services answer with, as plain frozen values: positions, decisions, progress, pictures."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from datetime import UTC, datetime

from fractus_proto.v1 import camera_pb2, mobility_pb2, types_pb2


class AltitudeReference(enum.Enum):
    """What an altitude is measured from."""

    HOME = types_pb2.ALTITUDE_REFERENCE_HOME
    AMSL = types_pb2.ALTITUDE_REFERENCE_AMSL
    TERRAIN = types_pb2.ALTITUDE_REFERENCE_TERRAIN


@dataclass(frozen=True, slots=True)
class Position:
    """A point in the air: degrees of WGS 84, and metres above `reference`, NaN where a path names no altitude."""

    lat: float
    lon: float
    alt: float = 0.0
    reference: AltitudeReference = AltitudeReference.HOME

    @classmethod
    def from_proto(cls, message: types_pb2.Position) -> Position:
        """Read the wire form."""
        return cls(
            message.latitude_deg,
            message.longitude_deg,
            message.altitude_m,
            AltitudeReference(message.altitude_reference),
        )

    def to_proto(self) -> types_pb2.Position:
        """Write the wire form."""
        return types_pb2.Position(
            latitude_deg=self.lat,
            longitude_deg=self.lon,
            altitude_m=self.alt,
            altitude_reference=self.reference.value,
        )

    def __str__(self) -> str:
        return f"{self.lat:.6f}, {self.lon:.6f}, {self.alt:.1f} m"


@dataclass(frozen=True, slots=True)
class Velocity:
    """Metres per second north, east and down."""

    north: float = 0.0
    east: float = 0.0
    down: float = 0.0

    @classmethod
    def from_proto(cls, message: types_pb2.Velocity) -> Velocity:
        """Read the wire form."""
        return cls(message.north_mps, message.east_mps, message.down_mps)

    def to_proto(self) -> types_pb2.Velocity:
        """Write the wire form."""
        return types_pb2.Velocity(north_mps=self.north, east_mps=self.east, down_mps=self.down)


@dataclass(frozen=True, slots=True)
class Attitude:
    """Orientation of the airframe, or of the camera on a gimbal, in degrees: right side down, nose up, clockwise from true north."""

    roll_deg: float
    pitch_deg: float
    yaw_deg: float

    @classmethod
    def from_proto(cls, message: types_pb2.Attitude) -> Attitude:
        """Read the wire form."""
        return cls(message.roll_deg, message.pitch_deg, message.yaw_deg)


class Action(enum.Enum):
    """What the policy checker did with a call."""

    UNSPECIFIED = types_pb2.Decision.ACTION_UNSPECIFIED
    ALLOW = types_pb2.Decision.ACTION_ALLOW
    CORRECT = types_pb2.Decision.ACTION_CORRECT
    DENY = types_pb2.Decision.ACTION_DENY
    TAKEOVER = types_pb2.Decision.ACTION_TAKEOVER


@dataclass(frozen=True, slots=True)
class Decision:
    """What the policy checker decided on a call, and why.

    Attributes:
        action: allowed, corrected, denied, or taken over.
        reason: one sentence for people; empty when the call was allowed as asked.
        code: CamelCase and stable, for programs: AltitudeAboveLimit, InsideExclusionZone.
        policies: names of the policies that decided, most restrictive first.
    """

    action: Action = Action.ALLOW
    reason: str = ""
    code: str = ""
    policies: tuple[str, ...] = ()

    @classmethod
    def from_proto(cls, message: types_pb2.Decision) -> Decision:
        """Read the wire form."""
        return cls(Action(message.action), message.reason, message.code, tuple(message.policies))


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """The outcome of a call that was carried out."""

    decision: Decision = field(default_factory=Decision)

    @property
    def corrected(self) -> bool:
        """Whether a policy changed what was asked before it was carried out."""
        return self.decision.action is Action.CORRECT


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress(Result):
    """A motion on its way: where it leads, where the drone is, how far it still has to go."""

    target: Position
    position: Position
    distance_m: float
    complete: bool = False

    @classmethod
    def from_proto(cls, message: mobility_pb2.MotionProgress, first: Progress | None) -> Progress:
        """Read the wire form; decision and target come in the first message and hold for all."""
        given = {field.name for field, _ in message.ListFields()}
        return cls(
            decision=Decision.from_proto(message.decision) if first is None or "decision" in given else first.decision,
            target=Position.from_proto(message.target) if first is None or "target" in given else first.target,
            position=Position.from_proto(message.position),
            distance_m=message.distance_m,
            complete=message.complete,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedResult(Result):
    """A speed over ground, in force or measured."""

    speed_mps: float


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionResult(Result):
    """Where the drone is and how it moves."""

    position: Position
    velocity: Velocity


@dataclass(frozen=True, slots=True, kw_only=True)
class VelocityResult(Result):
    """The velocity in force, after correction."""

    velocity: Velocity


@dataclass(frozen=True, slots=True, kw_only=True)
class Check(Result):
    """What would become of a call now. Nothing was done; a moment later the answer may be another.

    Attributes:
        position: where a goto would lead, after correction.
        altitude_m: how high a takeoff would climb, after correction.
        speed_mps: the speed that would be in force, after correction.
        velocity: the velocity that would be in force, after correction.
        takeover: what the system would do with the drone: hover, land, returnToLaunch or revoke; empty: it would not take it.
        brake_first: whether the drone would be stopped first, to turn on the spot.
    """

    position: Position | None = None
    altitude_m: float | None = None
    speed_mps: float | None = None
    velocity: Velocity | None = None
    takeover: str = ""
    brake_first: bool = False

    @property
    def allowed(self) -> bool:
        """Whether the call would be carried out, as asked or corrected."""
        return self.decision.action in {Action.ALLOW, Action.CORRECT}

    def __bool__(self) -> bool:
        return self.allowed

    @classmethod
    def from_proto(cls, message: mobility_pb2.CheckCallResponse) -> Check:
        """Read the wire form."""
        which = message.WhichOneof("result")
        goto = message.goto if which == "goto" else None
        speed = message.set_speed if which == "set_speed" else goto
        return cls(
            decision=Decision.from_proto(message.decision),
            position=Position.from_proto(goto.target) if goto is not None else None,
            altitude_m=message.takeoff.altitude_m if which == "takeoff" else None,
            speed_mps=(speed.speed_mps or None) if speed is not None else None,
            velocity=Velocity.from_proto(message.set_velocity.velocity) if which == "set_velocity" else None,
            takeover=message.takeover,
            brake_first=message.brake_first,
        )


@dataclass(frozen=True, slots=True)
class Ride:
    """How far the system is with the points of interest of a passenger.

    Attributes:
        flying: whether it is on the tour; until then `reason` says what it waits for.
        visited: how many points the drone was at.
        complete: whether that was all of them.
    """

    flying: bool
    visited: int
    complete: bool
    reason: str


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture with what is known of it.

    Attributes:
        info: when, where and how large it was taken, and what policies did to it.
        data: the file, of `info.media_type`, after privacy filters.
    """

    info: ImageInfo
    data: bytes


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageInfo(Result):
    """A picture in the camera's store."""

    name: str
    time: datetime
    width: int
    height: int
    size_bytes: int
    media_type: str
    position: Position | None

    @classmethod
    def from_proto(cls, message: camera_pb2.ImageInfo, decision: types_pb2.Decision) -> ImageInfo:
        """Read the wire form."""
        return cls(
            decision=Decision.from_proto(decision),
            name=message.name,
            time=message.time.ToDatetime(tzinfo=UTC),
            width=message.width,
            height=message.height,
            size_bytes=message.size_bytes,
            media_type=message.media_type,
            position=Position.from_proto(message.position) if message.HasField("position") else None,
        )

"""Frozen values of requests and responses: positions, decisions, progress, pictures."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from datetime import UTC, datetime

from fractus_proto.v1 import camera_pb2, mobility_pb2, types_pb2


class AltitudeReference(enum.Enum):
    """Datum of an altitude."""

    HOME = types_pb2.ALTITUDE_REFERENCE_HOME
    AMSL = types_pb2.ALTITUDE_REFERENCE_AMSL
    TERRAIN = types_pb2.ALTITUDE_REFERENCE_TERRAIN


@dataclass(frozen=True, slots=True)
class Position:
    """Position: WGS 84 degrees, and metres above `reference`. The altitude is NaN in waypoints without an altitude."""

    lat: float
    lon: float
    alt: float = 0.0
    reference: AltitudeReference = AltitudeReference.HOME

    @classmethod
    def from_proto(cls, message: types_pb2.Position) -> Position:
        """Create the value from its protobuf message."""
        return cls(
            message.latitude_deg,
            message.longitude_deg,
            message.altitude_m,
            AltitudeReference(message.altitude_reference),
        )

    def __str__(self) -> str:
        return f"{self.lat:.6f}, {self.lon:.6f}, {self.alt:.1f} m"


@dataclass(frozen=True, slots=True)
class Velocity:
    """Velocity in metres per second: north, east, down."""

    north: float = 0.0
    east: float = 0.0
    down: float = 0.0

    @classmethod
    def from_proto(cls, message: types_pb2.Velocity) -> Velocity:
        """Create the value from its protobuf message."""
        return cls(message.north_mps, message.east_mps, message.down_mps)


@dataclass(frozen=True, slots=True)
class Attitude:
    """Attitude of the airframe or of a gimbal's camera, in degrees.

    Roll is positive right side down, pitch nose up, yaw clockwise from true north.
    """

    roll_deg: float
    pitch_deg: float
    yaw_deg: float

    @classmethod
    def from_proto(cls, message: types_pb2.Attitude) -> Attitude:
        """Create the value from its protobuf message."""
        return cls(message.roll_deg, message.pitch_deg, message.yaw_deg)


class Action(enum.Enum):
    """Action of the policy engine on a call."""

    UNSPECIFIED = types_pb2.Decision.ACTION_UNSPECIFIED
    ALLOW = types_pb2.Decision.ACTION_ALLOW
    CORRECT = types_pb2.Decision.ACTION_CORRECT
    DENY = types_pb2.Decision.ACTION_DENY
    TAKEOVER = types_pb2.Decision.ACTION_TAKEOVER


@dataclass(frozen=True, slots=True)
class Decision:
    """Decision of the policy engine on a call.

    Attributes:
        action: Action on the call.
        reason: Reason in one sentence, for people; empty if the call was allowed unchanged.
        code: Stable reason in CamelCase, for programs, for example AltitudeAboveLimit or InsideExclusionZone.
        policies: Names of the policies that decided, most restrictive first.
    """

    action: Action = Action.ALLOW
    reason: str = ""
    code: str = ""
    policies: tuple[str, ...] = ()

    @classmethod
    def from_proto(cls, message: types_pb2.Decision) -> Decision:
        """Create the value from its protobuf message."""
        return cls(Action(message.action), message.reason, message.code, tuple(message.policies))


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """Result of a call that was carried out."""

    decision: Decision = field(default_factory=Decision)

    @property
    def corrected(self) -> bool:
        """True if a policy changed the request before it was carried out."""
        return self.decision.action is Action.CORRECT


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress(Result):
    """Progress of a motion: target, current position, and remaining distance in metres."""

    target: Position
    position: Position
    distance_m: float
    complete: bool = False

    @classmethod
    def from_proto(cls, message: mobility_pb2.MotionProgress, first: Progress | None) -> Progress:
        """Create the value from its protobuf message.

        Only the first message contains decision and target. They apply to all messages.
        """
        decision = Decision.from_proto(message.decision)
        target = Position.from_proto(message.target)
        if first is not None and not message.HasField("decision"):
            decision = first.decision
        if first is not None and not message.HasField("target"):
            target = first.target
        return cls(
            decision=decision,
            target=target,
            position=Position.from_proto(message.position),
            distance_m=message.distance_m,
            complete=message.complete,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedResult(Result):
    """A ground speed, set or measured."""

    speed_mps: float


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionResult(Result):
    """Position and velocity of the drone."""

    position: Position
    velocity: Velocity


@dataclass(frozen=True, slots=True, kw_only=True)
class VelocityResult(Result):
    """The velocity after correction."""

    velocity: Velocity


@dataclass(frozen=True, slots=True, kw_only=True)
class Check(Result):
    """Result of a dry run: the current verdict on a call that was not carried out. A later verdict may differ.

    Attributes:
        position: Target of a goto, after correction.
        altitude_m: Altitude of a takeoff, after correction.
        speed_mps: Speed, after correction.
        velocity: Velocity, after correction.
        takeover: Action of the system if it took the drone over: hover, land, returnToLaunch, abort or revoke; empty if it would not.
        brake_first: True if the drone would stop before the leg.
    """

    position: Position | None = None
    altitude_m: float | None = None
    speed_mps: float | None = None
    velocity: Velocity | None = None
    takeover: str = ""
    brake_first: bool = False

    @property
    def allowed(self) -> bool:
        """True if the call would be carried out, unchanged or corrected."""
        return self.decision.action in {Action.ALLOW, Action.CORRECT}

    def __bool__(self) -> bool:
        return self.allowed

    @classmethod
    def from_proto(cls, message: mobility_pb2.CheckCallResponse) -> Check:
        """Create the value from its protobuf message."""
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
class TourProgress:
    """Progress of the system's tour through a passenger's points of interest.

    Attributes:
        flying: True during the tour. Before the tour, `reason` contains what the system waits for.
        visited: Number of visited points.
        complete: True if all points were visited.
        reason: Current activity, or the reason of the wait, in one sentence.
    """

    flying: bool
    visited: int
    complete: bool
    reason: str


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture and its metadata.

    Attributes:
        info: Time, position, size, and the decision of the policy engine.
        data: Content of the file, of type `info.media_type`, after privacy filters.
    """

    info: ImageInfo
    data: bytes


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageInfo(Result):
    """Metadata of a stored picture."""

    name: str
    time: datetime
    width: int
    height: int
    size_bytes: int
    media_type: str
    position: Position | None

    @classmethod
    def from_proto(cls, message: camera_pb2.ImageInfo, decision: types_pb2.Decision) -> ImageInfo:
        """Create the value from its protobuf message."""
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

"""What a driver is to do at a control point, as its application declares it: a path, or a region."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fractus_proto.v1 import types_pb2

from fractus.values import AltitudeReference, Position


@dataclass(frozen=True, slots=True)
class Circle:
    """A disc on the ground: its middle, and its radius in metres."""

    center: Position
    radius_m: float


@dataclass(frozen=True, slots=True)
class Polygon:
    """Ground inside a ring of corners, without the holes; rings are not closed."""

    exterior: tuple[Position, ...]
    holes: tuple[tuple[Position, ...], ...] = ()


Region = Circle | Polygon


@dataclass(frozen=True, slots=True)
class ControlPoint:
    """One of the driver's control points, as its application declares it.

    Attributes:
        navigation: `pathBased` (in a corridor around the path) or `regionBased` (anywhere in the region).
        path: waypoints in the order to fly; empty for a region.
        region: the ground to stay above; None for a path.
    """

    navigation: str
    path: tuple[Position, ...] = ()
    region: Region | None = None

    @classmethod
    def from_manifest(cls, value: Mapping[str, Any]) -> ControlPoint:
        """Read a control point as manifests spell it.

        Raises:
            ValueError: something is missing, the message says what.
        """
        try:
            path = tuple(_waypoint(point) for point in value.get("path") or ())
            region = value.get("region")
            return cls(str(value["navigation"]), path, None if region is None else _region(region))
        except KeyError as error:
            raise ValueError(f"a control point lacks {error.args[0]}") from None

    @classmethod
    def from_proto(cls, message: types_pb2.ControlPoint) -> ControlPoint:
        """Read the wire form."""
        path = tuple(map(Position.from_proto, message.path))
        return cls(message.navigation, path, _area(message.region) if message.HasField("region") else None)


def _waypoint(point: Mapping[str, Any]) -> Position:
    reference = AltitudeReference[str(point.get("altitudeReference", "home")).upper()]
    return Position(float(point["lat"]), float(point["lon"]), _altitude(point.get("alt")), reference)


def _altitude(value: Any) -> float:
    # Not zero, which would be a descent to the ground: a call with NaN is refused.
    return math.nan if value is None else float(value)


def _corner(point: Mapping[str, Any]) -> Position:
    return Position(float(point["lat"]), float(point["lon"]))


def _region(value: Mapping[str, Any]) -> Region:
    if (circle := value.get("circle")) is not None:
        return Circle(_corner(circle["center"]), float(circle["radius"]))
    polygon = value["polygon"]
    holes = tuple(tuple(map(_corner, hole)) for hole in polygon.get("holes") or ())
    return Polygon(tuple(map(_corner, polygon["exterior"])), holes)


def _area(message: types_pb2.Area) -> Region:
    if message.WhichOneof("shape") == "circle":
        return Circle(Position.from_proto(message.circle.center), message.circle.radius_m)
    holes = tuple(tuple(map(Position.from_proto, hole.corners)) for hole in message.polygon.holes)
    return Polygon(tuple(map(Position.from_proto, message.polygon.exterior.corners)), holes)

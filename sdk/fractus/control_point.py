"""Control points of a driver, as declared by its application: a path or a region."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fractus_proto.v1 import types_pb2

from fractus.values import AltitudeReference, Position


@dataclass(frozen=True, slots=True)
class Circle:
    """Circular area: centre and radius in metres."""

    center: Position
    radius_m: float


@dataclass(frozen=True, slots=True)
class Polygon:
    """Polygonal area with holes. The first corner of a ring is not repeated at its end."""

    exterior: tuple[Position, ...]
    holes: tuple[tuple[Position, ...], ...] = ()


Region = Circle | Polygon


@dataclass(frozen=True, slots=True)
class ControlPoint:
    """A control point of the driver.

    Attributes:
        navigation: `pathBased` (in a corridor around the path) or `regionBased` (anywhere in the region).
        path: Waypoints in flight order; empty for a region.
        region: Permitted ground area; None for a path.
    """

    navigation: str
    path: tuple[Position, ...] = ()
    region: Region | None = None

    @classmethod
    def from_manifest(cls, value: Mapping[str, Any]) -> ControlPoint:
        """Create a control point from a manifest.

        Raises:
            ValueError: A field is missing; the message names it.
        """
        try:
            path = tuple(_waypoint(point) for point in value.get("path") or ())
            region = value.get("region")
            return cls(str(value["navigation"]), path, None if region is None else _region(region))
        except KeyError as error:
            raise ValueError(f"the control point has no {error.args[0]}") from None

    @classmethod
    def from_proto(cls, message: types_pb2.ControlPoint) -> ControlPoint:
        """Create the value from its protobuf message."""
        path = tuple(map(Position.from_proto, message.path))
        return cls(message.navigation, path, _area(message.region) if message.HasField("region") else None)


def _waypoint(point: Mapping[str, Any]) -> Position:
    reference = AltitudeReference[str(point.get("altitudeReference", "home")).upper()]
    return Position(float(point["lat"]), float(point["lon"]), _altitude(point.get("alt")), reference)


def _altitude(value: Any) -> float:
    # NaN instead of zero: zero would mean a descent to the ground, while a call with NaN is refused.
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

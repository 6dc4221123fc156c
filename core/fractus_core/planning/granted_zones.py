"""Zones as grants have them, looked at once for all grants, and which of them a node is far from."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import lru_cache

import shapely

from fractus_core.api import InvalidObject, Zone
from fractus_core.api.geometry import Area, Point
from fractus_core.api.plans import GrantedZone
from fractus_core.geo import LocalFrame, distance_m, middle, polygon

_GENEROUS = 1.05
"""Room for what the frame of a large zone bends."""


def surely_beyond(zone: Zone | None, base: Point, reach_m: float) -> bool:
    """Whether a zone is out of reach, told in microseconds; False where that needs a closer look."""
    if zone is None or zone.spec.area.polygon is None:
        return zone is not None and _circle_beyond(zone.spec.area, base, reach_m)
    ring = zone.spec.area.polygon.exterior
    # No point of a polygon is further from a corner than half its outline.
    outline_m = sum(distance_m(a, b) for a, b in itertools.pairwise((*ring, ring[0])))
    return distance_m(ring[0], base) > (reach_m + outline_m / 2) * _GENEROUS


def _circle_beyond(area: Area, base: Point, reach_m: float) -> bool:
    """Whether an area is a circle that is surely out of reach."""
    circle = area.circle
    return circle is not None and distance_m(circle.center, base) > (reach_m + circle.radius) * _GENEROUS


@dataclass(frozen=True, slots=True)
class SoundZone:
    """A zone as it is granted, with its outline in a frame of its own."""

    granted: GrantedZone
    frame: LocalFrame
    outline: shapely.Polygon

    def is_within(self, reach_m: float, base: Point) -> bool:
        """Whether some of it is within reach of a place."""
        return not _circle_beyond(self.granted.area, base, reach_m) and self.distance_m(base) <= reach_m

    def distance_m(self, base: Point) -> float:
        """From a place to the nearest point of it."""
        return float(self.outline.distance(shapely.Point(*self.frame.xy(base.lat, base.lon))))


class _Same:
    """A Zone that equals none but itself: to compare and hash all its points takes longer than to look at it."""

    __slots__ = ("zone",)

    def __init__(self, zone: Zone) -> None:
        self.zone = zone

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and other.zone is self.zone

    def __hash__(self) -> int:
        return id(self.zone)


@lru_cache(maxsize=2048)
def _looked_at(same: _Same) -> SoundZone:
    name, spec = same.zone.name, same.zone.spec
    try:
        frame = LocalFrame.at(middle(spec.area))
        outline = polygon(frame, spec.area)
    except InvalidObject as error:
        raise InvalidObject(f"Zone {name} spec.area.{error.field}", error.problem) from None
    granted = GrantedZone(name=name, area=spec.area, altitude=spec.altitude, schedule=spec.schedule)
    return SoundZone(granted, frame, outline)


def sound(zone: Zone) -> SoundZone:
    """A zone as grants have it; of one object it is made once.

    Raises:
        InvalidObject: it is broken.
    """
    return _looked_at(_Same(zone))

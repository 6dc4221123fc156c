"""Zones as grants have them, looked at once for all grants: which of them a node is far from, and how often their edges cross."""

from __future__ import annotations

import itertools
import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import shapely

from fractus_core.api import InvalidObject, Policy, Zone
from fractus_core.api.geometry import Area, Point
from fractus_core.api.plans import GrantedZone
from fractus_core.geo import LocalFrame, area_center, area_polygon, count_crossings, distance_m
from fractus_core.planning.area import MAX_CROSSINGS

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


@dataclass(frozen=True, slots=True, eq=False)
class SoundZone:
    """A zone as it is granted, with its outline in a frame of its own; it equals none but itself."""

    granted: GrantedZone
    frame: LocalFrame
    outline: shapely.Polygon

    def is_within(self, reach_m: float, base: Point) -> bool:
        """Whether some of it is within reach of a place."""
        return not _circle_beyond(self.granted.area, base, reach_m) and self.distance_m(base) <= reach_m

    def distance_m(self, base: Point) -> float:
        """From a place to the nearest point of it."""
        return float(self.outline.distance(shapely.Point(*self.frame.xy(base.lat, base.lon))))


_SOUND: dict[int, SoundZone] = {}
"""Zones that were looked at, by the identity of their objects: to hash and compare all their points takes longer than that."""


def _looked_at(zone: Zone) -> SoundZone:
    name, spec = zone.name, zone.spec
    try:
        frame = LocalFrame.at(area_center(spec.area))
        outline = area_polygon(frame, spec.area)
    except InvalidObject as error:
        raise InvalidObject(f"Zone {name} spec.area.{error.field}", error.problem) from None
    granted = GrantedZone(name=name, area=spec.area, altitude=spec.altitude, schedule=spec.schedule)
    return SoundZone(granted, frame, outline)


def sound(zone: Zone) -> SoundZone:
    """A zone as grants have it; of one object it is made once, and kept as long as that is.

    Raises:
        InvalidObject: it is broken.
    """
    known = _SOUND.get(id(zone))
    if known is None:
        known = _SOUND[id(zone)] = _looked_at(zone)
        weakref.finalize(zone, _SOUND.pop, id(zone), None)
    return known


@lru_cache(maxsize=32)
def zone_crossings(zones: tuple[SoundZone, ...], at_most: int) -> int:
    """How often the edges of several zones cross; no more than `at_most` + 1 are counted."""
    lines = []
    for zone in zones if len(zones) > 1 else ():
        for ring in shapely.get_rings(zone.outline):
            lats, lons = zone.frame.latlon_array(shapely.get_coordinates(ring))
            lines.append(np.column_stack([lons, lats]))
    # Whatever a degree measures, edges cross in degrees or do not; but on one side of the antimeridian.
    middle_lon = float(lines[0][0, 0]) if lines else 0.0
    for line in lines:
        line[:, 0] = (line[:, 0] - middle_lon + 540.0) % 360.0 - 180.0
    return count_crossings(lines, at_most)


def check_united(policy: Policy, zones: Sequence[SoundZone]) -> None:
    """Refuse a policy whose zones are united where it is enforced, and would take too long for that.

    Args:
        policy: to be enforced.
        zones: those of its zones that count.

    Raises:
        InvalidObject: their edges cross too often.
    """
    if policy.spec.kind == "inclusion" and zone_crossings(tuple(zones), MAX_CROSSINGS) > MAX_CROSSINGS:
        raise InvalidObject(
            f"Policy {policy.name} spec.selector.zones",
            f"edges of its zones cross more than {MAX_CROSSINGS} times; make one zone of them, or give them fewer corners",
        )

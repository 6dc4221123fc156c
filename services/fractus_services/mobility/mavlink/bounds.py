"""The outer bounds of a grant, as the vehicle's own fence can hold them."""

from __future__ import annotations

from dataclasses import dataclass

import shapely
from fractus_core.api.grants import GrantSpec
from fractus_core.geo import LocalFrame, area_center, area_polygon
from pymavlink.dialects.v20 import ardupilotmega as mavlink

ROOM_M = 10.0
"""The fence lies so far outside of what is granted: the service's own monitor acts long before it."""

HEADROOM_M = 5.0
MAX_VERTICES = (60, 30, 15, 8, 4)
"""Vertices that are tried one after the other: what an autopilot can hold depends on its board, and on its owner's fence."""

_SIMPLER_M = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)


@dataclass(frozen=True, slots=True)
class Item:
    """One item: a vertex, a circle.

    Attributes:
        command: MAV_CMD.
        param1: the first parameter: vertices in the polygon, or a radius in metres.
        lat_e7: degrees north, times 1e7.
        lon_e7: degrees east, times 1e7.
    """

    command: int
    param1: float
    lat_e7: int
    lon_e7: int


@dataclass(frozen=True, slots=True)
class Bounds:
    """What the vehicle itself must not leave.

    Attributes:
        items: the polygon; empty when the grant names no area.
        altitude_m: above home; None when the grant has no limit.
    """

    items: tuple[Item, ...]
    altitude_m: float | None


def bounds_of(spec: GrantSpec, vertices: int = MAX_VERTICES[0]) -> Bounds | None:
    """The outer bounds of operation area, corridor and airframe, with room; None when the grant has none.

    Vehicles must be inside every inclusion polygon that they know, so that it is one: where the areas do not touch,
    their convex hull.

    Args:
        spec: the grant.
        vertices: how many the polygon may have, 4 at least: with fewer it lies further out, nowhere further in.
    """
    altitude = spec.limits.max_altitude + HEADROOM_M if spec.limits is not None else None
    items: tuple[Item, ...] = ()
    if spec.operation_area:
        frame = LocalFrame.at(area_center(spec.operation_area[0]))
        whole = shapely.union_all([area_polygon(frame, area) for area in (*spec.operation_area, *spec.corridor)])
        corners = [frame.latlon(x, y) for x, y in list(_outline(whole, vertices).exterior.coords)[:-1]]
        count = len(corners)
        items = tuple(
            Item(mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION, float(count), round(lat * 1e7), round(lon * 1e7))
            for lat, lon in corners
        )
    return Bounds(items, altitude) if items or altitude is not None else None


def _outline(whole: shapely.Geometry, vertices: int) -> shapely.Polygon:
    """A polygon around a geometry with the room that it needs, of a number of vertices at most: the smallest of several."""
    found: list[shapely.Geometry] = []
    for simpler_m in _SIMPLER_M:
        # What is simplified comes nearer by about that much, so it is grown by that much before.
        grown = whole.buffer(ROOM_M + simpler_m, join_style="mitre", mitre_limit=2.0).simplify(simpler_m)
        found += [grown, grown.convex_hull]
    box = whole.buffer(ROOM_M + _SIMPLER_M[0]).minimum_rotated_rectangle
    rings = [shapely.Polygon(each.exterior) for each in (*found, box) if isinstance(each, shapely.Polygon)]
    # GEOS may simplify a ring's first corner away as well, and come nearer by more.
    roomy = (ring for ring in rings if ring.exterior.distance(whole) >= ROOM_M)
    return min((ring for ring in roomy if len(ring.exterior.coords) - 1 <= vertices), key=lambda ring: float(ring.area))

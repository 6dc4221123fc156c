"""The outer bounds of a grant, as the vehicle's own fence can hold them."""

from __future__ import annotations

from dataclasses import dataclass

import shapely
from fractus_core.api.plans import GrantSpec
from fractus_core.geo import LocalFrame, middle, polygon
from fractus_mavlink.enums import MAV_CMD

ROOM_M = 10.0
"""The fence lies so far outside of what is granted: the service's own monitor acts long before it."""

HEADROOM_M = 5.0
MAX_VERTICES = 60
_SIMPLER_M = 0.5


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


def bounds_of(spec: GrantSpec) -> Bounds | None:
    """The outer bounds of operation area, corridor and airframe, with room; None when the grant has none.

    Vehicles must be inside every inclusion polygon that they know, so that it is one: where the areas do not touch,
    their convex hull.
    """
    altitude = spec.limits.max_altitude + HEADROOM_M if spec.limits is not None else None
    items: tuple[Item, ...] = ()
    if spec.operation_area:
        frame = LocalFrame.at(middle(spec.operation_area[0]))
        whole = shapely.union_all([polygon(frame, area) for area in (*spec.operation_area, *spec.corridor)])
        grown = whole.buffer(ROOM_M + _SIMPLER_M, join_style="mitre", mitre_limit=2.0).simplify(_SIMPLER_M)
        if not isinstance(grown, shapely.Polygon) or len(grown.exterior.coords) > MAX_VERTICES:
            grown = grown.convex_hull
        if len(grown.exterior.coords) > MAX_VERTICES:
            grown = grown.envelope
        corners = [frame.latlon(x, y) for x, y in list(grown.exterior.coords)[:-1]]
        count = len(corners)
        items = tuple(
            Item(MAV_CMD.NAV_FENCE_POLYGON_VERTEX_INCLUSION, float(count), round(lat * 1e7), round(lon * 1e7))
            for lat, lon in corners
        )
    return Bounds(items, altitude) if items or altitude is not None else None

"""Frames, distances and areas."""

from fractus_core.geo.areas import (
    area_of,
    corridor,
    geojson,
    geojson_line,
    ground,
    middle,
    middle_of,
    points_xy,
    polygon,
)
from fractus_core.geo.frames import LocalFrame, distance_m, geodesic_m

__all__ = [
    "LocalFrame",
    "area_of",
    "corridor",
    "distance_m",
    "geodesic_m",
    "geojson",
    "geojson_line",
    "ground",
    "middle",
    "middle_of",
    "points_xy",
    "polygon",
]

"""Frames, distances and areas."""

from fractus_core.geo.areas import area_of as area_of
from fractus_core.geo.areas import check_extent as check_extent
from fractus_core.geo.areas import corridor as corridor
from fractus_core.geo.areas import geojson as geojson
from fractus_core.geo.areas import geojson_line as geojson_line
from fractus_core.geo.areas import ground as ground
from fractus_core.geo.areas import middle as middle
from fractus_core.geo.areas import middle_of as middle_of
from fractus_core.geo.areas import points_xy as points_xy
from fractus_core.geo.areas import polygon as polygon
from fractus_core.geo.crossings import crossings as crossings
from fractus_core.geo.frames import LocalFrame as LocalFrame
from fractus_core.geo.frames import distance_m as distance_m
from fractus_core.geo.frames import geodesic_m as geodesic_m

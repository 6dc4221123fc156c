"""Local frames, distances and areas on the WGS 84 ellipsoid."""

from fractus_core.geo.antimeridian import cut_path as cut_path
from fractus_core.geo.areas import area_center as area_center
from fractus_core.geo.areas import area_polygon as area_polygon
from fractus_core.geo.areas import areas_of_shape as areas_of_shape
from fractus_core.geo.areas import center_of as center_of
from fractus_core.geo.areas import check_extent as check_extent
from fractus_core.geo.areas import corridor as corridor
from fractus_core.geo.areas import count_crossings as count_crossings
from fractus_core.geo.areas import ground_point as ground_point
from fractus_core.geo.areas import line_geojson as line_geojson
from fractus_core.geo.areas import multipolygon_geojson as multipolygon_geojson
from fractus_core.geo.areas import points_xy as points_xy
from fractus_core.geo.distances import distance_m as distance_m
from fractus_core.geo.distances import geodesic_m as geodesic_m
from fractus_core.local_frame import LocalFrame as LocalFrame

"""4D volumes: a ground area, altitudes above mean sea level, and a time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from fractus_core.api.geometry import Area, Point
from fractus_core.api.model import InvalidObject
from fractus_core.geo import LocalFrame, area_center, area_polygon, areas_of_shape
from fractus_core.local_frame import ecef

MAX_REACH_M = 30_000.0
"""Maximum distance of a corner of a volume from the origin of its frame."""

TOLERANCE_M = 0.3
"""Volumes that are closer than this count as overlapping.

The edge between two corners is straight in the frame of its volume. Within `MAX_REACH_M`, it is up to 0.13 m away from the
geodesic, and from the edge in the frame of another volume. The tolerance covers the error of two volumes, and rounding.
"""

_PIECE_M = 2_000.0
"""Maximum length of a piece of an edge.

A volume is converted to the frame of another volume corner by corner. Between two corners of this distance the error is
about a millimetre.
"""

_ROUNDING_M = 1.0
"""Margin of `Volume4D.reach_m`, with which the search for neighbours includes volumes within the tolerance."""

MAX_TIME_S = 253_402_300_799.0
"""End of the year 9999, the last time that RFC 3339 can represent."""


@dataclass(frozen=True, slots=True)
class Volume4D:
    """Airspace that a flight uses for a time. All bounds belong to the volume.

    Use `of_area` or `of_shape`, which check the values.

    Attributes:
        outline: Polygon or polygons with corners in degrees east and north. shapely's predicates are meaningless on it,
            because degrees are not a plane. `in_frame` converts it to metres.
        lower_m: Lowest altitude above mean sea level; -inf: from the ground.
        upper_m: Highest altitude above mean sea level; inf: unlimited.
        begin_s: First moment in seconds since 1970 UTC.
        end_s: Last moment in seconds since 1970 UTC.
        frame: Frame around the volume.
        center: Earth-centred coordinates of the origin of the frame, in metres.
        reach_m: Upper bound of the distance from `center` to any point of the outline, in metres.
    """

    outline: BaseGeometry
    lower_m: float
    upper_m: float
    begin_s: float
    end_s: float
    frame: LocalFrame = field(compare=False, repr=False)
    center: tuple[float, float, float] = field(compare=False, repr=False)
    reach_m: float = field(compare=False, repr=False)

    @classmethod
    def of_area(cls, area: Area, *, lower_m: float, upper_m: float, begin_s: float, end_s: float) -> Volume4D:
        """Return the volume above an area. A circle is circumscribed, with up to 0.03 % more than its radius.

        Raises:
            InvalidObject: The geometry is invalid or too large, or the bounds are not numbers or not in order.
        """
        frame = LocalFrame.at(area_center(area))
        shape = area_polygon(frame, area)
        return cls.of_shape(frame, shape, lower_m=lower_m, upper_m=upper_m, begin_s=begin_s, end_s=end_s)

    @classmethod
    def of_shape(
        cls, frame: LocalFrame, shape: BaseGeometry, *, lower_m: float, upper_m: float, begin_s: float, end_s: float
    ) -> Volume4D:
        """Return the volume above a shape in metres east and north of the origin of a frame.

        Raises:
            InvalidObject: The shape is empty, not finite or too large, or the bounds are not numbers or not in order.
        """
        corners = shapely.get_coordinates(shape)
        if not len(corners) or not np.isfinite(corners).all():
            raise InvalidObject("area", "the area is empty, or a coordinate is not a number; correct the coordinates")
        if float(np.hypot(*corners.T).max()) > MAX_REACH_M:
            raise InvalidObject(
                "area",
                f"a corner is more than {MAX_REACH_M / 1000:.0f} km from the middle; divide the flight into shorter flights",
            )
        outline = shapely.transform(shapely.segmentize(shape, _PIECE_M), lambda xy: _degrees(frame, xy))
        return cls._of_outline(outline, (lower_m, upper_m), (begin_s, end_s))

    @classmethod
    def of_corners(
        cls, areas: Sequence[Area], *, lower_m: float, upper_m: float, begin_s: float, end_s: float
    ) -> Volume4D:
        """Return the volume that `areas` of a volume describes. Edges are not divided again.

        Raises:
            InvalidObject: There is no area, an area is a circle, or the bounds are not numbers or not in order.
        """
        polygons = [area.polygon for area in areas if area.polygon is not None]
        if not polygons or len(polygons) < len(areas):
            raise InvalidObject("areas", "a volume is stored as polygons; give at least one, and no circle")
        outline = shapely.MultiPolygon([(_lonlat(p.exterior), [_lonlat(hole) for hole in p.holes]) for p in polygons])
        return cls._of_outline(outline, (lower_m, upper_m), (begin_s, end_s))

    @classmethod
    def _of_outline(
        cls, outline: BaseGeometry, altitudes_m: tuple[float, float], times_s: tuple[float, float]
    ) -> Volume4D:
        lower_m, upper_m = altitudes_m
        begin_s, end_s = times_s
        if not lower_m <= upper_m:
            raise InvalidObject(
                "altitudes", f"the lower bound {lower_m:g} m must not be above the upper bound {upper_m:g} m"
            )
        if lower_m == math.inf or upper_m == -math.inf:
            raise InvalidObject("altitudes", "an infinite bound leaves no airspace; omit it or give a number of metres")
        if not 0 <= begin_s <= end_s <= MAX_TIME_S:
            raise InvalidObject("time", "give a start after 1970 and an end that is not before the start")
        frame, center, reach_m = _sphere(outline)
        return cls(outline, lower_m, upper_m, begin_s, end_s, frame, center, reach_m)

    @property
    def vertices(self) -> int:
        """Number of corners of the outline."""
        return int(shapely.get_num_coordinates(self.outline))

    def areas(self) -> tuple[Area, ...]:
        """Return the ground area as areas of the API."""
        return areas_of_shape(self.frame, self.in_frame(self.frame))

    def in_frame(self, frame: LocalFrame) -> BaseGeometry:
        """Return the ground area in metres east and north of the origin of a frame, which must be near the volume."""
        return outlines_in_frame(frame, np.array([self.outline], dtype=object))[0]

    def overlap(self, other: Volume4D) -> Overlap | None:
        """Return the part that two volumes share, or None if they are apart.

        Volumes that only touch each other in a point, an altitude or a moment overlap.
        """
        if not self._may_overlap(other):
            return None
        mine = self.in_frame(self.frame)
        theirs = other.in_frame(self.frame)
        if not shapely.dwithin(mine, theirs, TOLERANCE_M):
            return None
        x, y = shapely.get_coordinates(shapely.shortest_line(mine, theirs))[0].tolist()
        lat, lon = self.frame.latlon(x, y)
        # Within the tolerance, the lower bound of one volume may be above the upper bound of the other volume.
        lower_m, upper_m = sorted((max(self.lower_m, other.lower_m), min(self.upper_m, other.upper_m)))
        return Overlap(lat, lon, lower_m, upper_m, max(self.begin_s, other.begin_s), min(self.end_s, other.end_s))

    def _may_overlap(self, other: Volume4D) -> bool:
        return (
            self.begin_s <= other.end_s
            and other.begin_s <= self.end_s
            and self.lower_m <= other.upper_m + TOLERANCE_M
            and other.lower_m <= self.upper_m + TOLERANCE_M
            and math.dist(self.center, other.center) <= self.reach_m + other.reach_m
        )


@dataclass(frozen=True, slots=True)
class Overlap:
    """Part that two volumes share.

    Attributes:
        lat: Degrees north of a point of the part.
        lon: Degrees east of this point.
        lower_m: Lowest shared altitude above mean sea level; -inf: from the ground.
        upper_m: Highest shared altitude above mean sea level; inf: unlimited.
        begin_s: First shared moment in seconds since 1970 UTC.
        end_s: Last shared moment in seconds since 1970 UTC.
    """

    lat: float
    lon: float
    lower_m: float
    upper_m: float
    begin_s: float
    end_s: float

    def __str__(self) -> str:
        """Place, altitudes and time as a part of a sentence."""
        return f"near {self.lat:.6f}, {self.lon:.6f} {self._altitudes()} from {utc(self.begin_s)} to {utc(self.end_s)}"

    def _altitudes(self) -> str:
        upper = "" if self.upper_m == math.inf else f"{self.upper_m:.1f} m AMSL"
        if self.lower_m == -math.inf:
            return f"up to {upper}" if upper else "at all altitudes"
        return f"between {self.lower_m:.1f} and {upper}" if upper else f"above {self.lower_m:.1f} m AMSL"


def utc(time_s: float) -> str:
    """Return a time in seconds since 1970 UTC as RFC 3339 text, rounded down to a second."""
    return datetime.fromtimestamp(math.floor(time_s), UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def outlines_in_frame(frame: LocalFrame, outlines: NDArray[np.object_]) -> NDArray[np.object_]:
    """Return outlines (degrees east and north) in metres east and north of the origin of a frame."""
    converted: NDArray[np.object_] = shapely.transform(
        outlines, lambda lonlat: frame.xy_array(lonlat[:, 1], lonlat[:, 0])
    )
    return converted


def _lonlat(ring: Sequence[Point]) -> list[tuple[float, float]]:
    return [(corner.lon, corner.lat) for corner in ring]


def _degrees(frame: LocalFrame, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    lats, lons = frame.latlon_array(xy)
    return np.column_stack((lons, lats))


def _sphere(outline: BaseGeometry) -> tuple[LocalFrame, tuple[float, float, float], float]:
    """Return a frame near the middle of an outline, its origin in Earth-centred metres, and a radius around the outline."""
    lons, lats = shapely.get_coordinates(outline).T
    xyz = np.column_stack(ecef(lats, lons, np))
    middle = (xyz.min(axis=0) + xyz.max(axis=0)) / 2
    # The middle lies below the ellipsoid. The latitude of the point above it is accurate enough for an origin.
    lat = math.degrees(math.atan2(middle[2], 0.9933 * math.hypot(middle[0], middle[1])))
    lon = math.degrees(math.atan2(middle[1], middle[0]))
    center = ecef(lat, lon)
    # The part of the ellipsoid within a sphere is convex in the frame, so it contains all points between the corners.
    reach_m = float(np.linalg.norm(xyz - np.array(center), axis=1).max())
    return LocalFrame(lat, lon), center, reach_m + _ROUNDING_M

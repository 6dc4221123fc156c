"""Positions, areas and altitude bands (WGS 84, degrees and metres)."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from fractus_core.api.model import Model
from fractus_core.api.rules import Violation, one_of, rule

Latitude = Annotated[float, Field(ge=-90, le=90, description="Latitude in degrees (WGS 84), -90 to 90.")]
Longitude = Annotated[float, Field(ge=-180, le=180, description="Longitude in degrees (WGS 84), -180 to 180.")]
MIN_ALTITUDE_M = -1000
MAX_ALTITUDE_M = 20_000
Altitude = Annotated[float, Field(ge=MIN_ALTITUDE_M, le=MAX_ALTITUDE_M)]
"""Altitude in metres above any datum. The lower bound of -1000 m is below all terrain relative to a home on a mountain
and to mean sea level (the lowest dry land is at -430 m). Controlled airspace ends at 20 km (flight level 660)."""
Reference = Literal["home", "amsl", "terrain"]


class Point(Model):
    """A position on the ground."""

    lat: Latitude
    lon: Longitude


class VehicleHome(Point):
    """Home position of a vehicle."""

    alt: float = Field(
        default=0, ge=-500, le=9000, description="Ground elevation in metres above mean sea level; default: 0."
    )


class Position(Point):
    """A position in the air."""

    alt: Altitude | None = Field(
        default=None,
        description="Altitude in metres above altitudeReference; unset: keep the current altitude.",
    )
    altitude_reference: Reference = Field(
        default="home",
        description="Datum of alt: home (home position), amsl (mean sea level) or terrain (ground below the drone).",
    )

    # The API server sets the default `home`, so the reference `home` is allowed without alt.
    @rule(
        "has(self.alt) || !has(self.altitudeReference) || self.altitudeReference == 'home'",
        "altitudeReference requires alt; set alt or remove altitudeReference",
    )
    def _datum_of_alt(self) -> Violation:
        return "altitudeReference" if self.alt is None and self.altitude_reference != "home" else None


class Circle(Model):
    """A circular area on the ground."""

    center: Point
    radius: float = Field(gt=0, le=200_000, description="Radius in metres, above 0.")


MAX_RING_POINTS = 10_000
"""Maximum number of points of a ring. The outline of a path with a thousand turns has several points per turn."""

MAX_HOLES = 1000
"""Maximum number of holes of a polygon. The outline of a path that crosses itself has a hole in each loop."""

Ring = Annotated[tuple[Point, ...], Field(min_length=3, max_length=MAX_RING_POINTS)]


class Polygon(Model):
    """A polygon with holes. Rings are closed implicitly and must not cross themselves.

    The edge between two corners is the shorter connection, so a ring may cross the antimeridian.
    """

    exterior: Ring = Field(description="Outer ring: at least three points in order; the first one is not repeated.")
    holes: tuple[Ring, ...] = Field(
        default=(), max_length=MAX_HOLES, description="Rings that are excluded from the area."
    )


class Area(Model):
    """An area on the ground: a polygon or a circle."""

    polygon: Polygon | None = None
    circle: Circle | None = None

    _one_shape = one_of("polygon", "circle")


class AltitudeBand(Model):
    """The airspace between two altitudes."""

    lower: Altitude | None = Field(default=None, description="Lower bound in metres; unset: the ground.")
    upper: Altitude | None = Field(default=None, description="Upper bound in metres; unset: no upper bound.")
    reference: Reference = Field(
        default="home",
        description="Datum of lower and upper: home (home position), amsl (mean sea level) or terrain (ground below).",
    )

    @rule("!has(self.lower) || !has(self.upper) || self.lower < self.upper", "lower must be below upper")
    def _ordered(self) -> Violation:
        return "lower" if self.lower is not None and self.upper is not None and self.lower >= self.upper else None

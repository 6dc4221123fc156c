"""Positions, areas and altitude bands as manifests spell them (WGS 84 degrees, metres)."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from fractus_core.api.model import Model
from fractus_core.api.rules import Broken, one_of, rule

Latitude = Annotated[float, Field(ge=-90, le=90, description="Degrees north, WGS 84, -90 to 90.")]
Longitude = Annotated[float, Field(ge=-180, le=180, description="Degrees east, WGS 84, -180 to 180.")]
Altitude = Annotated[float, Field(ge=-1000, le=20000)]
"""Metres in any datum: no ground lies further below its surroundings, home on a mountain or mean sea level (the lowest dry
land is at -430 m), than 1000 m; controlled airspace, and what flies in it, ends at 20 km (flight level 660)."""
Reference = Literal["home", "amsl", "terrain"]


class Point(Model):
    """A place on the ground."""

    lat: Latitude
    lon: Longitude


class Home(Point):
    """Where a vehicle stands."""

    alt: float = Field(default=0, ge=-500, le=9000, description="Ground height, metres above mean sea level.")


class Position(Point):
    """A place in the air."""

    alt: Altitude | None = Field(
        default=None,
        description="Metres in the datum of altitudeReference; unset keeps the current altitude.",
    )
    altitude_reference: Reference = Field(
        default="home", description="What alt is measured from: the drone's home, mean sea level, or the terrain below."
    )

    # The API server fills in home where nothing is said.
    @rule(
        "has(self.alt) || !has(self.altitudeReference) || self.altitudeReference == 'home'",
        "altitudeReference says what alt is measured from; give alt, or remove it",
    )
    def _datum_of_alt(self) -> Broken:
        return "altitudeReference" if self.alt is None and self.altitude_reference != "home" else None


class Circle(Model):
    """A disc on the ground."""

    center: Point
    radius: float = Field(gt=0, le=200_000, description="Metres, above 0.")


MAX_RING_POINTS = 10_000
"""Points of a ring at most: the outline of a path with a thousand turns has several a turn."""

MAX_HOLES = 1000
"""Holes of a polygon at most: a path that crosses itself leaves one in each of its meshes."""

Ring = Annotated[tuple[Point, ...], Field(min_length=3, max_length=MAX_RING_POINTS)]


class Polygon(Model):
    """A polygon with holes; rings close by themselves and must not cross themselves.

    A ring follows the shorter way between neighbours, so it may cross the antimeridian.
    """

    exterior: Ring = Field(description="The outer ring, three points or more, in order, not closed.")
    holes: tuple[Ring, ...] = Field(default=(), max_length=MAX_HOLES, description="Rings cut out of the exterior.")


class Area(Model):
    """A piece of ground: either a polygon or a circle."""

    polygon: Polygon | None = None
    circle: Circle | None = None

    _one_shape = one_of("polygon", "circle")


class AltitudeBand(Model):
    """A slab of air between two altitudes."""

    lower: Altitude | None = Field(default=None, description="Metres; unset reaches to the ground.")
    upper: Altitude | None = Field(default=None, description="Metres; unset has no ceiling.")
    reference: Reference = Field(default="home", description="What lower and upper are measured from.")

    @rule("!has(self.lower) || !has(self.upper) || self.lower < self.upper", "lower must be below upper")
    def _ordered(self) -> Broken:
        return "lower" if self.lower is not None and self.upper is not None and self.lower >= self.upper else None

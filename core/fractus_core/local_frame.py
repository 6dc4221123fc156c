"""Local metric frames on the WGS 84 ellipsoid.

numpy is imported only by the methods for arrays, because the agent converts single points and does not install numpy.
"""

from __future__ import annotations

import math
from types import ModuleType
from typing import TYPE_CHECKING, TypeVar

from fractus_core.api.geometry import Point

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Coordinates = NDArray[np.float64]

SEMI_MAJOR_AXIS_M = 6_378_137.0
FLATTENING = 1 / 298.257223563
_E2 = FLATTENING * (2 - FLATTENING)
_PER_A2 = SEMI_MAJOR_AXIS_M**-2
_PER_B2 = (SEMI_MAJOR_AXIS_M * (1 - FLATTENING)) ** -2

Metres = TypeVar("Metres", float, "Coordinates")


def ecef(lat: Metres, lon: Metres, of: ModuleType = math) -> tuple[Metres, Metres, Metres]:
    """Return Earth-centred, Earth-fixed coordinates in metres of a point on the ellipsoid in degrees.

    Args:
        lat: Degrees north.
        lon: Degrees east.
        of: Module with the functions to use: `math` for one point, `numpy` for arrays.
    """
    phi = of.radians(lat)
    lam = of.radians(lon)
    sin_phi = of.sin(phi)
    n = SEMI_MAJOR_AXIS_M / of.sqrt(1 - _E2 * sin_phi * sin_phi)
    ground = n * of.cos(phi)
    return ground * of.cos(lam), ground * of.sin(lam), n * (1 - _E2) * sin_phi


class LocalFrame:
    """Orthographic projection of the WGS 84 ellipsoid around an origin: metres east and north.

    Planar distances are shorter than geodesic ones by a factor of about (s/R)^2/6 at a distance s from the origin: 1e-5
    at 50 km, which is negligible for a flight. The antimeridian and the poles need no special treatment. Points beyond
    the horizon (a quarter of the globe away) cannot be represented.
    """

    __slots__ = ("_cos_lat", "_cos_lon", "_origin", "_sin_lat", "_sin_lon", "_up", "lat", "lon")

    def __init__(self, lat: float, lon: float) -> None:
        self.lat = lat
        self.lon = lon
        phi = math.radians(lat)
        lam = math.radians(lon)
        self._sin_lat = math.sin(phi)
        self._cos_lat = math.cos(phi)
        self._sin_lon = math.sin(lam)
        self._cos_lon = math.cos(lam)
        self._origin = ecef(lat, lon)
        self._up = (self._cos_lat * self._cos_lon, self._cos_lat * self._sin_lon, self._sin_lat)

    @classmethod
    def at(cls, point: Point) -> LocalFrame:
        """Return the frame with a point as its origin."""
        return cls(point.lat, point.lon)

    def xy(self, lat: float, lon: float) -> tuple[float, float]:
        """Return the position of a point on the ellipsoid (degrees) in metres east and north of the origin."""
        # This repeats `ecef` inline, because every judgement calls it several times.
        phi = math.radians(lat)
        lam = math.radians(lon)
        sin_phi = math.sin(phi)
        cos_phi = math.cos(phi)
        n = SEMI_MAJOR_AXIS_M / math.sqrt(1 - _E2 * sin_phi * sin_phi)
        dx = n * cos_phi * math.cos(lam) - self._origin[0]
        dy = n * cos_phi * math.sin(lam) - self._origin[1]
        dz = n * (1 - _E2) * sin_phi - self._origin[2]
        east = -self._sin_lon * dx + self._cos_lon * dy
        north = -self._sin_lat * (self._cos_lon * dx + self._sin_lon * dy) + self._cos_lat * dz
        return east, north

    def xy_array(self, lats: Coordinates, lons: Coordinates) -> Coordinates:
        """Return metres east and north, shape (n, 2), of points on the ellipsoid in degrees, shapes (n,)."""
        import numpy as np  # noqa: PLC0415 - see above

        x, y, z = ecef(lats, lons, np)
        dx = x - self._origin[0]
        dy = y - self._origin[1]
        dz = z - self._origin[2]
        east = -self._sin_lon * dx + self._cos_lon * dy
        north = -self._sin_lat * (self._cos_lon * dx + self._sin_lon * dy) + self._cos_lat * dz
        return np.column_stack((east, north))

    def latlon(self, x: float, y: float) -> tuple[float, float]:
        """Return degrees north and east of the point x metres east and y metres north. The inverse of `xy`.

        Raises:
            ValueError: The point lies beyond the horizon of the frame.
        """
        u, v, w = self._up
        p, q, z = self._plane(x, y)
        over, slope, root = self._above(p, q, z)
        if not root >= 0:
            raise self._hidden(x, y)
        up = -over / (slope + math.sqrt(root))
        p = p + up * u
        q = q + up * v
        z = z + up * w
        return math.degrees(math.atan2(z, (1 - _E2) * math.hypot(p, q))), math.degrees(math.atan2(q, p))

    def latlon_array(self, xy: Coordinates) -> tuple[Coordinates, Coordinates]:
        """Return degrees north and degrees east, shapes (n,), of points x metres east and y metres north, shape (n, 2).

        Raises:
            ValueError: A point lies beyond the horizon of the frame.
        """
        import numpy as np  # noqa: PLC0415 - see above

        x = xy[:, 0]
        y = xy[:, 1]
        u, v, w = self._up
        with np.errstate(invalid="ignore", over="ignore"):
            p, q, z = self._plane(x, y)
            over, slope, root = self._above(p, q, z)
        hidden = np.flatnonzero(~(root >= 0))
        if len(hidden):
            raise self._hidden(float(x[hidden[0]]), float(y[hidden[0]]))
        up = -over / (slope + np.sqrt(root))
        p = p + up * u
        q = q + up * v
        z = z + up * w
        return np.degrees(np.arctan2(z, (1 - _E2) * np.hypot(p, q))), np.degrees(np.arctan2(q, p))

    def _above(self, p: Metres, q: Metres, z: Metres) -> tuple[Metres, Metres, Metres]:
        """Return the quadratic equation for the height of a point above the ellipsoid along the frame's vertical.

        Returns:
            Its constant term, half its linear term, and a quarter of its discriminant, which is negative beyond the
            horizon.
        """
        u, v, w = self._up
        curve = (u * u + v * v) * _PER_A2 + w * w * _PER_B2
        slope = (p * u + q * v) * _PER_A2 + z * w * _PER_B2
        over = (p * p + q * q) * _PER_A2 + z * z * _PER_B2 - 1
        return over, slope, slope * slope - curve * over

    def _hidden(self, x: float, y: float) -> ValueError:
        return ValueError(f"({x:.0f}, {y:.0f}) m is beyond the horizon of the frame at {self.lat}, {self.lon}")

    def _plane(self, east: Metres, north: Metres) -> tuple[Metres, Metres, Metres]:
        """Return Earth-centred coordinates of points in the plane that touches the ellipsoid at the origin."""
        return (
            self._origin[0] - self._sin_lon * east - self._sin_lat * self._cos_lon * north,
            self._origin[1] + self._cos_lon * east - self._sin_lat * self._sin_lon * north,
            self._origin[2] + self._cos_lat * north,
        )

"""Conversion between geographic positions (degrees times 1e7) and local metres, with ArduPilot's formulas."""

from __future__ import annotations

import math
from dataclasses import dataclass

from fractus_services.mavlink_server.coordinates import ALTITUDE_MAX_M, valid_coordinates

METRES_PER_UNIT = 0.011131884502145034
UNIT = 1e-7


def _shrink(latitude_e7: float) -> float:
    return max(math.cos(math.radians(latitude_e7 * UNIT)), 0.01)


@dataclass(frozen=True, slots=True)
class Place:
    """Geographic position: latitude and longitude in degrees times 1e7, altitude in metres above mean sea level."""

    lat_e7: int
    lon_e7: int
    alt_m: float

    @classmethod
    def from_degrees(cls, lat_deg: float, lon_deg: float, alt_m: float) -> Place:
        """Create a place from degrees and metres above mean sea level."""
        return cls(round(lat_deg * 1e7), round(lon_deg * 1e7), alt_m)

    def offset(self, north_m: float, east_m: float, down_m: float = 0.0) -> Place:
        """Return the place at an offset in metres (north, east, down)."""
        dlat = north_m / METRES_PER_UNIT
        dlon = east_m / (METRES_PER_UNIT * _shrink(self.lat_e7 + dlat / 2.0))
        lon = (self.lon_e7 + round(dlon) + 1_800_000_000) % 3_600_000_000 - 1_800_000_000
        lat = min(900_000_000, max(-900_000_000, self.lat_e7 + round(dlat)))
        return Place(lat, lon, self.alt_m - down_m)

    def vector_to(self, other: Place) -> tuple[float, float, float]:
        """Return the vector to `other` in metres (north, east, down)."""
        dlon = (other.lon_e7 - self.lon_e7 + 1_800_000_000) % 3_600_000_000 - 1_800_000_000
        shrink = _shrink((self.lat_e7 + other.lat_e7) / 2.0)
        return (
            (other.lat_e7 - self.lat_e7) * METRES_PER_UNIT,
            dlon * METRES_PER_UNIT * shrink,
            self.alt_m - other.alt_m,
        )


def valid_place(lat_e7: int, lon_e7: int, alt_m: float) -> bool:
    """Return True if the coordinates are valid and the altitude is plausible."""
    return valid_coordinates(lat_e7, lon_e7) and abs(alt_m) <= ALTITUDE_MAX_M

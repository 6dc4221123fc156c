"""Altitudes of every datum as metres above home, and altitude bands of zones in those metres.

A terrain altitude is known only if the ground is taken as level with home. An AMSL altitude is known only if home is known.
"""

from __future__ import annotations

import math
from typing import assert_never

from fractus_core.api.geometry import AltitudeBand, Reference
from fractus_core.policy.decision_types import Home


def altitude_above_home_m(value: float, reference: Reference, home: Home | None, flat_terrain: bool) -> float | None:
    """Return an altitude as metres above home, or None if the height of its datum is unknown."""
    match reference:
        case "home":
            return value
        case "amsl":
            return None if home is None else value - home.amsl_m
        case "terrain":
            return value if flat_terrain else None
        case _:
            assert_never(reference)


def band_limits_m(band: AltitudeBand | None, home: Home | None, flat_terrain: bool) -> tuple[float, float]:
    """Return floor and ceiling of a band above home. A missing or unknown limit is infinite."""
    floor_m = -math.inf
    ceiling_m = math.inf
    if band is not None and band.lower is not None:
        lower_m = altitude_above_home_m(band.lower, band.reference, home, flat_terrain)
        floor_m = -math.inf if lower_m is None else lower_m
    if band is not None and band.upper is not None:
        upper_m = altitude_above_home_m(band.upper, band.reference, home, flat_terrain)
        ceiling_m = math.inf if upper_m is None else upper_m
    return floor_m, ceiling_m


def band_may_overlap(
    band: AltitudeBand | None, lower_m: float, upper_m: float, home: Home | None, flat_terrain: bool
) -> bool:
    """Return True if altitudes from `lower_m` to `upper_m` above home may touch a band. A band of unknown datum may."""
    if band is None:
        return True
    floor_m, ceiling_m = band_limits_m(band, home, flat_terrain)
    return not (upper_m < floor_m or lower_m > ceiling_m)


def band_surely_contains(
    band: AltitudeBand | None, lower_m: float, upper_m: float, home: Home | None, flat_terrain: bool
) -> bool:
    """Return True if altitudes from `lower_m` to `upper_m` above home lie inside a band. False if its datum is unknown."""
    if band is None:
        return True
    known = all(
        limit is None or altitude_above_home_m(limit, band.reference, home, flat_terrain) is not None
        for limit in (band.lower, band.upper)
    )
    floor_m, ceiling_m = band_limits_m(band, home, flat_terrain)
    return known and floor_m <= lower_m and upper_m <= ceiling_m


def band_gap_m(
    band: AltitudeBand | None, lower_m: float, upper_m: float, home: Home | None, flat_terrain: bool
) -> float:
    """Return the vertical distance of altitudes from `lower_m` to `upper_m` above home to a band, 0 if they may touch."""
    floor_m, ceiling_m = band_limits_m(band, home, flat_terrain)
    return max(floor_m - upper_m, lower_m - ceiling_m, 0.0)


def band_depth_m(band: AltitudeBand | None, altitude_m: float, home: Home | None, flat_terrain: bool) -> float:
    """Return the distance of an altitude above home to the nearest limit of a band, negative if it is outside the band."""
    floor_m, ceiling_m = band_limits_m(band, home, flat_terrain)
    return min(altitude_m - floor_m, ceiling_m - altitude_m)

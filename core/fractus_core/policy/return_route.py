"""Return flights: their altitudes, limits and descents."""

from __future__ import annotations

import math
from dataclasses import dataclass

import shapely
from shapely.geometry.base import BaseGeometry

from fractus_core.policy.compiled_grant import (
    MAX_FRAME_REACH_M,
    AirVolume,
    CompiledGrant,
    altitude_above_home_m,
    band_may_overlap,
)
from fractus_core.policy.decision_types import Situation
from fractus_core.policy.geofences import find_breaches
from fractus_core.policy.kinematics import XY, Leg, altitude_range_to_stop_m, stop_point, vertical_leg
from fractus_core.policy.limits import (
    altitude_bounds,
    limit_forbids_altitudes,
    limiting_zones,
    lowest_ceiling_m,
    speed_bounds,
)

MIN_RETURN_ALTITUDE_M = 10.0
"""Lowest altitude above home of a return flight below a zone, because the terrain is not known."""

ZONE_FLOOR_CLEARANCE_M = 0.5
"""Distance kept below a zone's floor in addition to the margin, because a drone does not hold its altitude exactly."""

HOVER_DRIFT_M = 0.5
"""Distance by which wind moves a drone that climbs or sinks at one position.

A drone that drifts into the margin of a zone during a climb would have to sink to the altitudes of the zone, and then climb again.
"""

MAX_LOWERED_ALTITUDES = 4
"""Maximum number of altitudes just below a zone at which a return route is searched.

The drone waits during a search, and a search without a result takes a second or two.
"""


def return_altitudes_m(
    now: Situation, grant: CompiledGrant, worthwhile_m: float, goal: XY | None = None
) -> tuple[float, ...]:
    """Return the altitudes above home at which the system flies a drone home or to a landing place, best first.

    The preferred altitude is the return altitude, or the present altitude if that is higher. The first result is this
    altitude limited to the altitude limits along the straight route. The next results are limited to the limits at the
    present position, and to the limits that apply everywhere. Altitudes just below the surrounding zones follow.

    Args:
        now: Position, home and airframe. Position and home are known.
        grant: Permissions and restrictions that apply.
        worthwhile_m: Altitude up to which a climb is worthwhile.
        goal: Landing place in metres of the grant's frame; None: home.
    """
    position = grant.locate(now)
    if position is None or now.home is None:
        return (now.altitude_m,)
    if goal is None:
        goal = grant.frame.xy(now.home.lat, now.home.lon)
    lane = shapely.linestrings((position, goal)) if position != goal else shapely.points(position)
    best = max(now.altitude_m, min(now.airframe.return_altitude_m, worthwhile_m))
    altitudes = []
    for ground in (lane, shapely.points(position), shapely.Point()):
        bounds, unknown = altitude_bounds(grant, now, AirVolume(ground, now.margin_m, -math.inf, math.inf))
        lowest = max((b.lowest for b in bounds if b.lowest is not None), default=-math.inf)
        highest = lowest_ceiling_m(bounds, unknown, now.altitude_m)
        altitudes += [min(max(altitude_m, lowest), highest) for altitude_m in (best, now.altitude_m)]
    below = [lower for lower in _altitudes_below_zones_m(lane, now, grant) if lowest <= lower <= min(highest, best)]
    return (*dict.fromkeys((*altitudes, now.altitude_m, *below[:MAX_LOWERED_ALTITUDES])),)


def _altitudes_below_zones_m(lane: BaseGeometry, now: Situation, grant: CompiledGrant) -> list[float]:
    """Return altitudes above home just below the zones around the straight line to home (`lane`), highest first.

    Only zones are considered whose distance from the line is at most the length of the line.
    """
    room_m = now.height_margin_m + ZONE_FLOOR_CLEARANCE_M
    flat = grant.flat_terrain
    around = grant.exclusions.near(AirVolume(lane, lane.length + now.margin_m, -math.inf, math.inf), now, flat)
    bands = [zone.band for zone in around if zone.band is not None and zone.band.lower is not None]
    floors = {
        altitude_above_home_m(band.lower, band.reference, now.home, flat) for band in bands if band.lower is not None
    }
    return sorted((f - room_m for f in floors if f is not None and f - room_m >= MIN_RETURN_ALTITUDE_M), reverse=True)


@dataclass(frozen=True, slots=True)
class ReturnBounds:
    """Altitude and speed limits of a return by an autopilot that knows neither zones nor policies.

    Attributes:
        height_m: Highest altitude above home to command.
        speed_mps: Highest speed to command.
    """

    height_m: float = math.inf
    speed_mps: float = math.inf


def return_bounds(now: Situation, grant: CompiledGrant) -> ReturnBounds:
    """Return the strictest commands of altitude and speed that the limits between home and the operation area permit.

    If the datum of a limit is unknown, the drone must not climb. The altitude is then 0, with which an autopilot
    returns at its present altitude.
    """
    anywhere = shapely.box(-MAX_FRAME_REACH_M, -MAX_FRAME_REACH_M, MAX_FRAME_REACH_M, MAX_FRAME_REACH_M)
    air = AirVolume(anywhere if grant.flight_area is None else grant.flight_area, now.margin_m, -math.inf, math.inf)
    return ReturnBounds(
        max(lowest_ceiling_m(*altitude_bounds(grant, now, air), present_m=0.0), 0.0),
        min((bound.highest for bound in speed_bounds(grant, now, air) if bound.highest is not None), default=math.inf),
    )


def may_change_altitude(now: Situation, grant: CompiledGrant, altitude_m: float) -> bool:
    """Return True if the drone may climb or sink to an altitude at its position.

    A drone that is too close below or above a zone may move away from it, even next to another zone: a vertical motion
    does not bring it closer to the other zone. A drone that breaks the altitude limit of a zone may move to any altitude.
    Any other drone must not climb or sink into, inside or just beside a zone at altitudes that the zone's altitude limit forbids.
    """
    position = grant.locate(now)
    if position is None:
        return False
    low_m = min(now.altitude_m, altitude_m)
    high_m = max(now.altitude_m, altitude_m)
    around_m = now.margin_m + HOVER_DRIFT_M
    if _limits_forbid(AirVolume(shapely.points(position), around_m, low_m, high_m), now, grant):
        return False
    column = vertical_leg(position, low_m, high_m)
    present = vertical_leg(position, now.altitude_m, now.altitude_m)

    def broken(leg: Leg, room_m: float) -> set[str]:
        # The two legs have the same ground, so a breach of one zone has the same reason for each leg.
        return {breach.reason for breach in find_breaches(leg, now, grant, now.margin_m, room_m)}

    on_the_way = broken(column, now.height_margin_m)
    return not on_the_way or on_the_way <= broken(present, 0.0) < broken(present, now.height_margin_m)


def _limits_forbid(column: AirVolume, now: Situation, grant: CompiledGrant) -> bool:
    """Return True if a vertical motion breaks the altitude limit of a zone that the drone does not break at present."""
    flat = grant.flat_terrain
    zones = limiting_zones(grant.altitude_limits, grant, now, column, now.height_margin_m)
    return any(
        limit_forbids_altitudes(zone, column.lower_m, column.upper_m, now, flat)
        and not (
            limit_forbids_altitudes(zone, now.altitude_m, now.altitude_m, now, flat)
            and band_may_overlap(zone.band, *altitude_range_to_stop_m(now), now.home, flat)
        )
        for zone in zones
    )


def descent_enters_fence(now: Situation, grant: CompiledGrant) -> bool:
    """Return True if a drone that stops without breaking a fence would break a fence in the descent after the stop."""
    position = grant.locate(now)
    if position is None:
        return False
    position = stop_point(now, position)
    room = (now.margin_m, now.height_margin_m)
    present = vertical_leg(position, now.altitude_m, now.altitude_m)
    column = vertical_leg(position, 0.0, now.altitude_m)
    return not find_breaches(present, now, grant, *room) and bool(find_breaches(column, now, grant, *room))


def landing_problem(place: XY, altitude_m: float, now: Situation, grant: CompiledGrant) -> str:
    """Return why a drone must not land at a place, or an empty string if it may.

    The column from the ground to the altitude must be inside the area of the grant and its inclusion zones, and outside
    all exclusion zones, each with the margin of a leg. The ground may be lower than home.

    Args:
        place: Landing place, in metres of `grant.frame`.
        altitude_m: Altitude above home at which the drone arrives.
        now: Time, home and position errors. The position in it is not used.
        grant: Permissions and restrictions that apply. Its flight area includes the corridor.
    """
    ground = shapely.points(place)
    margin_m = now.margin_m
    area = grant.flight_area
    if area is not None and not (area.covers(ground) and area.boundary.distance(ground) >= margin_m):
        return f"it is not inside the area of the Grant with a margin of {margin_m:.1f} m"
    air = AirVolume(ground, margin_m, -math.inf, altitude_m + now.height_margin_m)
    for zone in grant.exclusions.near(air, now, grant.flat_terrain):
        return f"it is inside zone {zone.name} of policy {zone.rule.name}, or within {margin_m:.1f} m of it"
    for fence in grant.inclusions:
        if fence.rule.in_force(now.time_s):
            shape = fence.near_altitudes(0.0, altitude_m, now, grant.flat_terrain)
            if not (shape.covers(ground) and shape.boundary.distance(ground) >= margin_m):
                return f"it is not inside the zones of policy {fence.rule.name} with a margin of {margin_m:.1f} m"
    return ""

"""Return flights: the altitudes at which the system flies them, and the legality of the autopilot's straight return."""

from __future__ import annotations

import math
from dataclasses import dataclass

import shapely
from shapely.geometry.base import BaseGeometry

from fractus_core.policy.altitude import altitude_above_home_m
from fractus_core.policy.compiled_grant import MAX_FRAME_REACH_M, AirVolume, CompiledGrant
from fractus_core.policy.decision_types import Situation, Verdict, deny
from fractus_core.policy.geofences import find_breaches
from fractus_core.policy.kinematics import XY, Leg, height_margin_m, margin_m, stop_point, vertical_leg
from fractus_core.policy.limits import altitude_bounds, lowest_ceiling_m, speed_bounds

MIN_RETURN_ALTITUDE_M = 10.0
"""Lowest altitude above home of a return flight below a zone, because the terrain is not known."""

RTL_CONE_SLOPE = 3.0
"""Slope of the autopilot's return cone: it climbs at most to this multiple of its distance from home, or higher if its
owner configures that (ArduPilot parameter RTL_CONE_SLOPE)."""

ZONE_FLOOR_CLEARANCE_M = 0.5
"""Distance below a zone's floor beyond the margin, because a drone does not hold its altitude exactly."""

MAX_LOWERED_ALTITUDES = 4
"""Maximum number of zones below which a return route is searched. A search without a result takes a second or two, and
the drone waits."""


def return_altitudes_m(now: Situation, grant: CompiledGrant, worth_m: float) -> tuple[float, ...]:
    """Return the altitudes above home at which the system flies a drone home, best first.

    First comes the return altitude, or the present one if that is higher, within the altitude limits of the straight
    route. Then the same within the limits at the present position, and within the limits that hold everywhere. Then
    altitudes just below the surrounding zones.

    Args:
        now: Position, home and airframe. Position and home are known.
        grant: Permissions and restrictions that apply.
        worth_m: Altitude up to which a climb is worthwhile.
    """
    position = grant.locate(now)
    if position is None or now.home is None:
        return (now.altitude_m,)
    home = grant.frame.xy(now.home.lat, now.home.lon)
    lane = shapely.linestrings((position, home)) if position != home else shapely.points(position)
    best = max(now.altitude_m, min(now.airframe.return_altitude_m, worth_m))
    altitudes = []
    for ground in (lane, shapely.points(position), shapely.Point()):
        bounds, unknown = altitude_bounds(grant, now, AirVolume(ground, margin_m(now), -math.inf, math.inf))
        lowest = max((b.lower for b in bounds if b.lower is not None), default=-math.inf)
        highest = lowest_ceiling_m(bounds, unknown, now.altitude_m)
        altitudes += [min(max(altitude_m, lowest), highest) for altitude_m in (best, now.altitude_m)]
    below = [lower for lower in _altitudes_below_zones_m(lane, now, grant) if lowest <= lower <= min(highest, best)]
    return (*dict.fromkeys((*altitudes, now.altitude_m, *below[:MAX_LOWERED_ALTITUDES])),)


def _altitudes_below_zones_m(lane: BaseGeometry, now: Situation, grant: CompiledGrant) -> list[float]:
    """Return altitudes above home just below the zones around a lane, highest first.

    The zones are at most the lane's length away.
    """
    room_m = height_margin_m(now) + ZONE_FLOOR_CLEARANCE_M
    flat = grant.flat_terrain
    around = grant.exclusions.near(AirVolume(lane, lane.length + margin_m(now), -math.inf, math.inf), now, flat)
    bands = [zone.band for zone in around if zone.band is not None and zone.band.lower is not None]
    floors = {
        altitude_above_home_m(band.lower, band.reference, now.home, flat) for band in bands if band.lower is not None
    }
    return sorted((f - room_m for f in floors if f is not None and f - room_m >= MIN_RETURN_ALTITUDE_M), reverse=True)


@dataclass(frozen=True, slots=True)
class ReturnBounds:
    """Altitude and speed limits of a return by an autopilot that knows neither zones nor policies.

    Attributes:
        height_m: Highest altitude above home.
        speed_mps: Highest speed.
    """

    height_m: float = math.inf
    speed_mps: float = math.inf


def return_bounds(now: Situation, grant: CompiledGrant) -> ReturnBounds:
    """Return the strictest limits of altitude and speed in force anywhere between home and the operation area.

    If the datum of a limit is unknown, the drone must not climb. The altitude is then 0, with which an autopilot
    returns at its present altitude.
    """
    anywhere = shapely.box(-MAX_FRAME_REACH_M, -MAX_FRAME_REACH_M, MAX_FRAME_REACH_M, MAX_FRAME_REACH_M)
    air = AirVolume(anywhere if grant.flight_area is None else grant.flight_area, margin_m(now), -math.inf, math.inf)
    return ReturnBounds(
        lowest_ceiling_m(*altitude_bounds(grant, now, air), present_m=0.0),
        min((bound.upper for bound in speed_bounds(grant, now, air) if bound.upper is not None), default=math.inf),
    )


def may_change_altitude(now: Situation, grant: CompiledGrant, altitude_m: float) -> bool:
    """Return True if the drone may climb or sink to an altitude at its position.

    A drone too close below or above a zone may leave that zone first, even beside another zone, because it comes no
    closer to that.
    """
    position = grant.locate(now)
    if position is None:
        return False
    column = vertical_leg(position, min(now.altitude_m, altitude_m), max(now.altitude_m, altitude_m))
    here = vertical_leg(position, now.altitude_m, now.altitude_m)

    def broken(leg: Leg, room_m: float) -> set[str]:
        # The reason of a zone's breach depends on the ground only, which is the same here.
        return {breach.reason for breach in find_breaches(leg, now, grant, margin_m(now), room_m)}

    left = broken(column, height_margin_m(now))
    return not left or left <= broken(here, 0.0) < broken(here, height_margin_m(now))


def descent_enters_fence(now: Situation, grant: CompiledGrant) -> bool:
    """Return True if a drone whose point of rest breaks no fence would break one during its descent from there."""
    position = grant.locate(now)
    if position is None:
        return False
    position = stop_point(now, position)
    room = (margin_m(now), height_margin_m(now))
    here = vertical_leg(position, now.altitude_m, now.altitude_m)
    column = vertical_leg(position, 0.0, now.altitude_m)
    return not find_breaches(here, now, grant, *room) and bool(find_breaches(column, now, grant, *room))


def check_straight_return(
    target: XY, altitude_m: float, now: Situation, grant: CompiledGrant, *, margin: float, slack: float
) -> Verdict | None:
    """Return the denial of a target from which the autopilot's straight return is not legal, or None.

    The autopilot climbs to its return altitude, or to a lower one near home (`RTL_CONE_SLOPE`), flies straight, and
    descends at home.

    Args:
        target: Start of the return, in metres of the grant's frame.
        altitude_m: Altitude of the target above home.
        now: Home, airframe and time.
        grant: Permissions and restrictions that apply.
        margin: Distance to keep from zones in metres.
        slack: Distance to keep from floors and ceilings of zones in metres.
    """
    if now.home is None:
        return deny("HomeUnknown", "home is unknown, so the return cannot be checked; wait for the home position")
    if not grant.exclusions.zones and not grant.inclusions:
        return None
    home = grant.frame.xy(now.home.lat, now.home.lon)
    return_m = max(altitude_m, now.airframe.return_altitude_m)
    least_m = max(altitude_m, min(return_m, RTL_CONE_SLOPE * math.dist(target, home)))
    lane = shapely.linestrings((target, home)) if target != home else shapely.points(home)
    blocking_zones = grant.exclusions.near(AirVolume(lane, margin, -slack, return_m + slack), now, grant.flat_terrain)
    if not grant.inclusions and next(blocking_zones, None) is None:
        return None
    parts = (
        Leg(target, target, target, home, least_m, return_m),
        vertical_leg(target, altitude_m, return_m),
        vertical_leg(home, 0.0, return_m),
    )
    description = f"at {return_m:.1f} m" if least_m == return_m else f"at {least_m:.1f} to {return_m:.1f} m"
    for part in parts:
        air = AirVolume(part.ground, margin, part.lower_m - slack, part.upper_m + slack)
        for zone in grant.exclusions.near(air, now, grant.flat_terrain):
            return _deny_return(
                f"{description}, is blocked by zone {zone.name} of policy {zone.rule.name}", zone.rule.name
            )
    for fence in grant.inclusions:
        if fence.rule.in_force(now.time_s):
            shape, _ = fence.at(least_m, return_m, now, grant.flat_terrain)
            if not shape.covers(lane):
                return _deny_return(f"{description}, leaves the zones of policy {fence.rule.name}", fence.rule.name)
    return None


def _deny_return(description: str, policy: str) -> Verdict:
    return deny("WayHomeBlocked", f"the straight return from the target, {description}", (policy,))

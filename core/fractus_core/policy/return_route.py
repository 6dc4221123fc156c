"""Ways home: the heights that the system flies them at, and whether the autopilot's own straight one is legal."""

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
"""No way home below a zone is looked for lower than this above home, for the terrain is not known."""

RTL_CONE_SLOPE = 3.0
"""An autopilot climbs to its return altitude as far as that is worth it: to three times its distance from home, or higher where its
owner wants that (ArduPilot: RTL_CONE_SLOPE)."""

ZONE_FLOOR_CLEARANCE_M = 0.5
"""How much lower than it must a drone flies home below a zone: it does not hold its height exactly."""

MAX_LOWERED_ALTITUDES = 4
"""Below how many zones a way home is looked for: a search that finds none takes a second or two, and the drone waits."""


def return_altitudes_m(now: Situation, grant: CompiledGrant, worth_m: float) -> tuple[float, ...]:
    """Altitudes above home at which the system flies home, the best one first.

    The return altitude, or the present one if that is higher, as the limits of altitude on the straight way allow it; then
    as those that hold here, or everywhere, do; then just below the zones around it.

    Args:
        now: position, home and airframe; both places are known.
        grant: whose limits.
        worth_m: how high a climb is worth it.
    """
    at = grant.locate(now)
    if at is None or now.home is None:
        return (now.altitude_m,)
    home = grant.frame.xy(now.home.lat, now.home.lon)
    lane = shapely.linestrings((at, home)) if at != home else shapely.points(at)
    best = max(now.altitude_m, min(now.airframe.return_altitude_m, worth_m))
    found = []
    for ground in (lane, shapely.points(at), shapely.Point()):
        bounds, unknown = altitude_bounds(grant, now, AirVolume(ground, margin_m(now), -math.inf, math.inf))
        lowest = max((b.lower for b in bounds if b.lower is not None), default=-math.inf)
        highest = lowest_ceiling_m(bounds, unknown, now.altitude_m)
        found += [min(max(wanted, lowest), highest) for wanted in (best, now.altitude_m)]
    below = [lower for lower in _heights_below_m(lane, now, grant) if lowest <= lower <= min(highest, best)]
    return (*dict.fromkeys((*found, now.altitude_m, *below[:MAX_LOWERED_ALTITUDES])),)


def _heights_below_m(lane: BaseGeometry, now: Situation, grant: CompiledGrant) -> list[float]:
    """Altitudes above home just below the zones no further off a lane than it is long, the highest first."""
    room_m, flat = height_margin_m(now) + ZONE_FLOOR_CLEARANCE_M, grant.flat_terrain
    around = grant.exclusions.near(AirVolume(lane, lane.length + margin_m(now), -math.inf, math.inf), now, flat)
    bands = [zone.band for zone in around if zone.band is not None and zone.band.lower is not None]
    floors = {
        altitude_above_home_m(band.lower, band.reference, now.home, flat) for band in bands if band.lower is not None
    }
    return sorted((f - room_m for f in floors if f is not None and f - room_m >= MIN_RETURN_ALTITUDE_M), reverse=True)


@dataclass(frozen=True, slots=True)
class ReturnBounds:
    """How high, in metres above home, and how fast a drone may come home that knows neither zones nor policies."""

    height_m: float = math.inf
    speed_mps: float = math.inf


def return_bounds(now: Situation, grant: CompiledGrant) -> ReturnBounds:
    """The strictest limits of altitude and speed in force anywhere between home and the operation area.

    Where the datum of a limit is not known, it may not climb at all: then the height is 0, as for an autopilot that returns
    at the altitude it has.
    """
    anywhere = shapely.box(-MAX_FRAME_REACH_M, -MAX_FRAME_REACH_M, MAX_FRAME_REACH_M, MAX_FRAME_REACH_M)
    air = AirVolume(anywhere if grant.flight_area is None else grant.flight_area, margin_m(now), -math.inf, math.inf)
    return ReturnBounds(
        lowest_ceiling_m(*altitude_bounds(grant, now, air), here_m=0.0),
        min((bound.upper for bound in speed_bounds(grant, now, air) if bound.upper is not None), default=math.inf),
    )


def may_change_altitude(now: Situation, grant: CompiledGrant, altitude_m: float) -> bool:
    """Whether the drone may climb or sink to an altitude where it is.

    From too close below or above a zone it leaves that first, also beside another one: it comes no closer to that.
    """
    at = grant.locate(now)
    if at is None:
        return False
    column = vertical_leg(at, min(now.altitude_m, altitude_m), max(now.altitude_m, altitude_m))
    here = vertical_leg(at, now.altitude_m, now.altitude_m)

    def broken(leg: Leg, room_m: float) -> set[str]:
        # What a zone's breach is called depends on the ground alone, which is the same.
        return {breach.reason for breach in find_breaches(leg, now, grant, margin_m(now), room_m)}

    left = broken(column, height_margin_m(now))
    return not left or left <= broken(here, 0.0) < broken(here, height_margin_m(now))


def descent_enters_fence(now: Situation, grant: CompiledGrant) -> bool:
    """Whether a drone that breaks no fence where it comes to rest would break one on its way down from there."""
    at = grant.locate(now)
    if at is None:
        return False
    at, room = stop_point(now, at), (margin_m(now), height_margin_m(now))
    here, column = vertical_leg(at, now.altitude_m, now.altitude_m), vertical_leg(at, 0.0, now.altitude_m)
    return not find_breaches(here, now, grant, *room) and bool(find_breaches(column, now, grant, *room))


def check_straight_return(
    target: XY, altitude_m: float, now: Situation, grant: CompiledGrant, *, margin: float, slack: float
) -> Verdict | None:
    """The denial of a target from which the straight way home is not legal.

    That way is the autopilot's: it climbs to its return altitude, or less high near home (`RTL_CONE_SLOPE`), flies straight, and descends at home.

    Args:
        target: where it begins, in metres of the grant's frame.
        altitude_m: the target's altitude above home.
        now: home, airframe and time.
        grant: whose fences.
        margin: metres to keep from zones.
        slack: metres to keep from their floors and ceilings.
    """
    if now.home is None:
        return deny(
            "HomeUnknown", "home is unknown, so nothing can be said of the way back; wait for the home position"
        )
    if not grant.exclusions.zones and not grant.inclusions:
        return None
    home = grant.frame.xy(now.home.lat, now.home.lon)
    return_m = max(altitude_m, now.airframe.return_altitude_m)
    least_m = max(altitude_m, min(return_m, RTL_CONE_SLOPE * math.dist(target, home)))
    lane = shapely.linestrings((target, home)) if target != home else shapely.points(home)
    anything = grant.exclusions.near(AirVolume(lane, margin, -slack, return_m + slack), now, grant.flat_terrain)
    if not grant.inclusions and next(anything, None) is None:
        return None
    parts = (
        Leg(target, target, target, home, least_m, return_m),
        vertical_leg(target, altitude_m, return_m),
        vertical_leg(home, 0.0, return_m),
    )
    how = f"at {return_m:.1f} m" if least_m == return_m else f"at {least_m:.1f} to {return_m:.1f} m"
    for part in parts:
        air = AirVolume(part.ground, margin, part.lower_m - slack, part.upper_m + slack)
        for zone in grant.exclusions.near(air, now, grant.flat_terrain):
            return _blocked(f"{how}, is blocked by zone {zone.name} of policy {zone.rule.name}", zone.rule.name)
    for fence in grant.inclusions:
        if fence.rule.in_force(now.time_s):
            shape, _ = fence.at(least_m, return_m, now, grant.flat_terrain)
            if not shape.covers(lane):
                return _blocked(f"{how}, leaves the zones of policy {fence.rule.name}", fence.rule.name)
    return None


def _blocked(how: str, policy: str) -> Verdict:
    return deny("WayHomeBlocked", f"from the target the straight way home, {how}", (policy,))

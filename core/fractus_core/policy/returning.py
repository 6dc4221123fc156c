"""The autopilot's own way home: straight, unless it retraces its path."""

from __future__ import annotations

import shapely

from fractus_core.policy.compiled import Air, CompiledGrant
from fractus_core.policy.motion import XY, Leg, standing
from fractus_core.policy.values import Situation, Verdict, deny


def straight_home_blocked(
    target: XY, altitude_m: float, now: Situation, grant: CompiledGrant, *, margin: float, slack: float
) -> Verdict | None:
    """The denial of a target from which the straight way home is not legal.

    That way is the autopilot's: it climbs to its return altitude, flies straight, and descends at home.

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
    height_m = max(altitude_m, now.airframe.return_altitude_m)
    lane = shapely.linestrings((target, home)) if target != home else shapely.points(home)
    anything = grant.exclusions.near(Air(lane, margin, -slack, height_m + slack), now, grant.flat_terrain)
    if not grant.inclusions and next(anything, None) is None:
        return None
    parts = (
        Leg(target, target, target, home, height_m, height_m),
        standing(target, altitude_m, height_m),
        standing(home, 0.0, height_m),
    )
    for part in parts:
        air = Air(part.ground, margin, part.lower_m - slack, part.upper_m + slack)
        for zone in grant.exclusions.near(air, now, grant.flat_terrain):
            return _blocked(
                f"at {height_m:.1f} m, is blocked by zone {zone.name} of policy {zone.rule.name}", zone.rule.name
            )
    for fence in grant.inclusions:
        if fence.rule.in_force(now.time_s):
            shape, _ = fence.at(height_m, height_m, now, grant.flat_terrain)
            if not shape.covers(lane):
                return _blocked(f"at {height_m:.1f} m, leaves the zones of policy {fence.rule.name}", fence.rule.name)
    return None


def _blocked(how: str, policy: str) -> Verdict:
    return deny("WayHomeBlocked", f"from the target the straight way home, {how}", (policy,))

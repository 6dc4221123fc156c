"""Geofences: the fences that a leg breaks, the legal part of a leg, and the legality of a straight return."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import shapely
from shapely.geometry.base import BaseGeometry

from fractus_core.api.geometry import AltitudeBand
from fractus_core.api.policies import GeofenceAction
from fractus_core.exhaustive import exhaustive
from fractus_core.policy.compiled_grant import (
    OPERATION_AREA,
    AirVolume,
    CompiledGrant,
    Inclusion,
    PolicyZone,
    band_gap_m,
    band_may_overlap,
    band_surely_contains,
)
from fractus_core.policy.decision_types import Situation, Takeover, Verdict, deny, distinct, format_distance
from fractus_core.policy.kinematics import XY, Leg, altitude_range_to_stop_m, vertical_leg

SEVERITY: dict[GeofenceAction, int] = exhaustive(
    GeofenceAction,
    {"adjust": 0, "ignore": 1, "hover": 2, "returnToLaunch": 3, "land": 4, "abort": 5, "revoke": 6},
)
"""Severity of each action. A higher value takes more control from the application."""

HOME_RADIUS_M = 5.0
"""A leg that ends within this distance of home counts as a return.

A leg that starts within this distance counts as a departure. Returns and departures are permitted regardless of the
position of the operation area.
"""

STATIONARY_LEG_M = 0.5
"""A leg that covers no more ground than this counts as a pure change of altitude."""

EXTRA_MARGIN_M = 0.25
"""Distance from fences that a corrected target keeps in addition to the margin, so that it never lies on a border."""

ALTITUDE_TOLERANCE_M = 0.5
"""Altitudes that differ by less than this count as equal. Neither a barometer nor a controller is more accurate."""

RTL_CONE_SLOPE = 3.0
"""Slope of the autopilot's return cone: a returning drone climbs at most to this multiple of its distance from home.
The owner of the drone may configure a steeper cone (ArduPilot parameter RTL_CONE_SLOPE)."""

BISECTION_STEPS = 24
"""Number of bisection steps to find the point where a leg is far enough from a fence. The error is below 1 mm."""

_SAMPLES = 24
"""Number of sample points on the part of a leg that is too close to a fence.

The distance to the fence must not shrink from one point to the next.
"""


@dataclass(frozen=True, slots=True)
class Breach:
    """Violation of a fence by a leg.

    Attributes:
        enters: True if the requested motion itself breaks the fence, False if it only comes too close to the fence.
        permits: Returns True if the fence permits a piece of ground (in frame metres) with its margin.
    """

    policy: str
    priority: int
    action: GeofenceAction
    code: str
    reason: str
    enters: bool
    permits: Callable[[BaseGeometry], bool]

    @property
    def severity(self) -> int:
        """Severity of the reaction. If a leg only comes too close to the fence, the strictest reaction is a denial."""
        return SEVERITY[self.action] if self.enters else min(SEVERITY[self.action], SEVERITY["ignore"])


def find_breaches(
    leg: Leg, now: Situation, grant: CompiledGrant, margin_m: float, height_margin_m: float
) -> list[Breach]:
    """Return every fence that a leg breaks, most restrictive first."""
    air = AirVolume(leg.ground, margin_m, leg.lower_m - height_margin_m, leg.upper_m + height_margin_m)
    breaches = list(_check_operation_area(leg, now, grant, margin_m))
    for zone in grant.exclusions.near(air, now, grant.flat_terrain):
        breaches += _check_exclusion(zone, leg, now, grant, air)
    for fence in grant.inclusions:
        if fence.rule.in_force(now.time_s):
            breaches += _check_inclusion(fence, leg, now, grant, air)
    return sorted(breaches, key=lambda b: (-b.severity, -b.priority, b.policy))


def breach_verdict(breaches: list[Breach]) -> Verdict:
    """Return the verdict on a request that breaks fences, given most restrictive first."""
    worst = breaches[0]
    names = distinct(b.policy for b in breaches)
    takeover = TAKEOVERS[worst.action] if worst.enters else None
    if takeover is None:
        return deny(worst.code, worst.reason, names)
    return Verdict("takeover", None, worst.code, f"{worst.reason}; {_EFFECTS[takeover]}", names, takeover)


TAKEOVERS: dict[GeofenceAction, Takeover | None] = exhaustive(
    GeofenceAction,
    {
        "ignore": None,
        "adjust": None,
        "hover": "hover",
        "land": "land",
        "returnToLaunch": "returnToLaunch",
        "abort": "abort",
        "revoke": "revoke",
    },
)
"""Takeover of each action, or None if the application keeps the drone."""

_EFFECTS: dict[Takeover, str] = exhaustive(
    Takeover,
    {
        "hover": "the system takes the drone and hovers",
        "land": "the system takes the drone and lands it",
        "returnToLaunch": "the system takes the drone and flies it home",
        "abort": "access is revoked and the system flies the drone to its landing place",
        "revoke": "access is revoked and the system flies the drone home",
    },
)


def _check_operation_area(leg: Leg, now: Situation, grant: CompiledGrant, margin_m: float) -> Iterator[Breach]:
    """Check the fence of every grant: the drone must fly to the operation area and stay in this area."""
    operation_area = grant.operation_area
    border = grant.operation_area_border
    if operation_area is None or border is None or grant.flight_area is None or grant.flight_area_border is None:
        return
    target = shapely.points(leg.target)
    homeward = False
    outward = False
    if now.home is not None:
        home = grant.frame.xy(now.home.lat, now.home.lon)
        homeward, outward = (math.dist(end, home) <= HOME_RADIUS_M for end in (leg.target, leg.start))
    vertical = leg.start == leg.target
    within = operation_area.covers(target) and not border.dwithin(target, margin_m)
    homeward = homeward or (leg.follows_velocity and _approaches(leg, now, grant, operation_area))
    if not within and not homeward and not vertical:
        inside = operation_area.covers(target)
        away_m = border.distance(target)
        reason = (
            f"the target is {format_distance(away_m)} from the border of the operation area; keep {margin_m:.1f} m inside it"
            if inside
            else f"the target is {format_distance(away_m)} outside the operation area"
        )
        yield _area_breach(reason, not inside)
        return
    working = operation_area.covers(leg.braking_path) and not homeward and not outward and not vertical
    shape = operation_area if working else grant.flight_area
    shape_border = border if working else grant.flight_area_border
    if not _stays_inside(shape, shape_border, leg, now, margin_m):
        reason = f"the leg leaves the {'operation area' if working else 'corridor to the operation area'} or comes within {margin_m:.1f} m of its border"
        yield _area_breach(reason, not shape.covers(leg.ground))


def _approaches(leg: Leg, now: Situation, grant: CompiledGrant, operation_area: BaseGeometry) -> bool:
    """Return True if the drone is outside the operation area, and the leg leads closer to this area or to home."""
    stop = shapely.points(leg.stop)
    end = shapely.points(leg.target)
    if operation_area.covers(stop):
        return False
    if operation_area.distance(end) < operation_area.distance(stop):
        return True
    if now.home is None:
        return False
    home = grant.frame.xy(now.home.lat, now.home.lon)
    return math.dist(leg.target, home) < math.dist(leg.stop, home)


def _area_breach(reason: str, enters: bool) -> Breach:
    return Breach(OPERATION_AREA, 0, "ignore", "OutsideOperationArea", reason, enters, lambda _part: False)


def _check_exclusion(
    zone: PolicyZone, leg: Leg, now: Situation, grant: CompiledGrant, air: AirVolume
) -> Iterator[Breach]:
    """Check a leg that is closer to a zone than the margin. A drone that is already inside or too close may leave the zone."""
    margin_m = air.margin_m
    shape = zone.shape
    certain = _certain_path(leg, now)
    clearance_m = _clearance_outside(shape, leg.braking_path)
    level = _is_level_with(zone, now, grant)
    height_margin_m = leg.lower_m - air.lower_m
    if shape.dwithin(certain, margin_m):
        if not level and _leaves_height(zone, leg, now, grant, height_margin_m):
            return
        if (
            (
                level
                or not comes_level(
                    zone.band,
                    leg.lower_m,
                    leg.upper_m,
                    now,
                    height_margin_m=height_margin_m,
                    flat=grant.flat_terrain,
                )
            )
            and _leads_out(shape, leg, margin_m, clearance_m)
            and _leads_away(shape, leg, certain)
        ):
            return
    # If the drone is already inside, or cannot stop outside, this request does not cause the entry. The request is
    # denied, but the drone is not taken over.
    enters = (clearance_m > 0 or not level) and shape.intersects(air.ground)
    yield _exclusion_breach(zone, leg, margin_m, enters)


def _certain_path(leg: Leg, now: Situation) -> BaseGeometry:
    """Return the part of a leg that the drone certainly flies, even if it is already braking as hard as it can.

    `Leg.braking_path` overestimates the path until the drone stands still. An overestimate must not permit legs past a
    fence.
    """
    braking_s = math.hypot(now.north_mps, now.east_mps) / (2 * now.airframe.accel_mps2)
    end = leg.start[0] + now.east_mps * braking_s, leg.start[1] + now.north_mps * braking_s
    return shapely.points(leg.start) if end == leg.start else shapely.linestrings((leg.start, end))


def _is_level_with(zone: PolicyZone, now: Situation, grant: CompiledGrant) -> bool:
    """Return True if the drone is between the altitudes of a zone, or comes to rest between them."""
    return band_may_overlap(zone.band, *altitude_range_to_stop_m(now), now.home, grant.flat_terrain)


def comes_level(
    band: AltitudeBand | None, lower_m: float, upper_m: float, now: Situation, *, height_margin_m: float, flat: bool
) -> bool:
    """Return True if a leg of a drone below or above a zone comes between the zone's altitudes, or too close to them.

    A drone that is already too close may continue at its altitude. Because altitudes are inaccurate, a leg may come
    closer by at most ALTITUDE_TOLERANCE_M. No number of legs may lead into the nearer half of the margin.

    Args:
        band: Altitudes of the zone.
        lower_m: Lowest altitude of the leg above home.
        upper_m: Highest altitude of the leg above home.
        now: State of the drone.
        height_margin_m: Distance to keep from the zone's altitudes.
        flat: True if the ground is assumed to be level with home.
    """
    gap_m = band_gap_m(band, lower_m, upper_m, now.home, flat)
    present_m = band_gap_m(band, *altitude_range_to_stop_m(now), now.home, flat)
    kept_m = height_margin_m
    if present_m < height_margin_m:
        kept_m = min(present_m, max(present_m - ALTITUDE_TOLERANCE_M, height_margin_m / 2))
    # Altitudes converted between datums differ in their last digits.
    return gap_m <= 0.0 or gap_m < kept_m - 1e-6


def _leaves_height(zone: PolicyZone, leg: Leg, now: Situation, grant: CompiledGrant, height_margin_m: float) -> bool:
    """Return True if a vertical leg of a drone that is too close below or above a zone restores the height margin.

    The result is False for a leg to another place. The autopilot controls the axes independently, so during that leg, a drone beside
    a zone could come over or under the zone before it reaches the altitude of the target.
    """
    west, south, east, north = shapely.bounds(leg.ground)
    if max(east - west, north - south) > STATIONARY_LEG_M:
        return False
    present = altitude_range_to_stop_m(now)

    def gap_m(lower_m: float, upper_m: float) -> float:
        return band_gap_m(zone.band, lower_m, upper_m, now.home, grant.flat_terrain)

    # A leg passes all altitudes at which the drone could come to rest. Its end is its lowest or its highest altitude, whichever
    # is farther from the zone.
    end_m, rest_m = (max(map(gap_m, heights, heights)) for heights in ((leg.lower_m, leg.upper_m), present))
    closest_m = gap_m(leg.lower_m, leg.upper_m)
    return 0.0 < closest_m >= gap_m(*present) - 1e-6 and end_m >= height_margin_m and end_m > rest_m + 1e-6


def _exclusion_breach(zone: PolicyZone, leg: Leg, margin_m: float, enters: bool) -> Breach:
    shape = zone.shape
    name = zone.rule.name
    target = shapely.points(leg.target)
    if shape.intersects(target):
        depth_m = shape.boundary.distance(target)
        code = "InsideExclusionZone"
        reason = f"the target is {format_distance(depth_m)} inside zone {zone.name}"
    elif shape.intersects(leg.ground):
        code = "LegThroughExclusionZone"
        reason = _crossing_reason(zone, leg)
    else:
        away_m = shape.distance(leg.ground)
        code = "TooCloseToExclusionZone"
        reason = f"the leg comes within {max(away_m, 0.1):.1f} m of zone {zone.name}; keep {margin_m:.1f} m away"
    return Breach(
        name,
        zone.rule.spec.priority,
        zone.rule.spec.geofence_action,
        code,
        f"{reason} of policy {name}",
        enters,
        lambda part: not shape.dwithin(part, margin_m + EXTRA_MARGIN_M),
    )


def _crossing_reason(zone: PolicyZone, leg: Leg) -> str:
    inside_m = zone.shape.intersection(leg.line).length
    if inside_m >= 0.05:
        return f"the leg crosses zone {zone.name} for {inside_m:.1f} m"
    # A moving drone sweeps more ground than `leg.line`, which begins at the point where the drone comes to rest.
    return f"the {'leg' if zone.shape.intersects(leg.line) else 'turn onto the leg'} touches zone {zone.name}"


def _check_inclusion(
    fence: Inclusion, leg: Leg, now: Situation, grant: CompiledGrant, air: AirVolume
) -> Iterator[Breach]:
    shape, border = fence.at(air.lower_m, air.upper_m, now, grant.flat_terrain)
    if fence.banded and _returns_by_height(fence, leg, now, grant, air):
        return
    if not _stays_inside(shape, border, leg, now, air.margin_m) or (
        fence.banded and _leaves_by_height(fence, (shape, border), leg, now, grant, air=air)
    ):
        yield _inclusion_breach(fence, shape, border, leg, air.margin_m)


def _leaves_by_height(
    fence: Inclusion,
    permitted: tuple[BaseGeometry, BaseGeometry],
    leg: Leg,
    now: Situation,
    grant: CompiledGrant,
    *,
    air: AirVolume,
) -> bool:
    """Return True if a leg leads away from zones around the drone that do not permit all altitudes of the leg.

    A drone inside such a zone leaves it because of its altitude, even if the leg leads into another zone in the
    horizontal plane. A drone outside such a zone, beside it or within the height margin above or below it, must return
    into it. It must not fly to another zone through air that no zone covers.

    Args:
        fence: Zones to stay in.
        permitted: Ground on which the zones permit all altitudes of the leg, and its border.
        leg: Leg to check.
        now: State of the drone.
        grant: Permissions and restrictions that apply.
        air: Volume of the leg with its margins.
    """
    shape, border = permitted
    if shape.covers(leg.ground):
        return False
    lower_m, upper_m = altitude_range_to_stop_m(now)
    present, _ = fence.at(lower_m, upper_m, now, grant.flat_terrain)
    if present.covers(leg.braking_path):
        return True
    height_margin_m = leg.lower_m - air.lower_m
    near = fence.near_altitudes(lower_m - height_margin_m, upper_m + height_margin_m, now, grant.flat_terrain)
    near_border = near.boundary

    def keeps(part: BaseGeometry) -> bool:
        return bool(shape.covers(part) and not border.dwithin(part, air.margin_m))

    return not _only_gains_distance(leg, keeps, lambda point: signed_depth_m(near, near_border, point))


def _returns_by_height(fence: Inclusion, leg: Leg, now: Situation, grant: CompiledGrant, air: AirVolume) -> bool:
    """Return True if a drone above or below the nearest zone, or too close to its limits, sinks or climbs into it.

    Only a vertical motion counts, because autopilots control the axes independently.
    """
    west, south, east, north = shapely.bounds(leg.ground)
    if max(east - west, north - south) > STATIONARY_LEG_M:
        return False
    lower_m, upper_m = altitude_range_to_stop_m(now)
    flat = grant.flat_terrain
    around = [
        (band_gap_m(zone.band, lower_m, upper_m, now.home, flat), zone)
        for zone in fence.zones
        if zone.shape.covers(leg.ground) and zone.surely_active(now.time_s)
    ]
    least_m = min((gap_m for gap_m, _ in around), default=math.inf)
    height_margin_m = leg.lower_m - air.lower_m
    ends_m = []
    if leg.upper_m <= upper_m + 1e-6:
        ends_m.append(leg.lower_m)
    if leg.lower_m >= lower_m - 1e-6:
        ends_m.append(leg.upper_m)
    return any(
        gap_m <= least_m
        and not zone.shape.boundary.dwithin(leg.ground, air.margin_m)
        and band_surely_contains(zone.band, end_m - height_margin_m, end_m + height_margin_m, now.home, flat)
        for gap_m, zone in around
        for end_m in ends_m
    )


def _inclusion_breach(fence: Inclusion, shape: BaseGeometry, border: BaseGeometry, leg: Leg, margin_m: float) -> Breach:
    name = fence.rule.name
    target = shapely.points(leg.target)
    zones = ", ".join(dict.fromkeys(p.name for p in fence.zones)) or "its zones"
    if shape.is_empty:
        code = "OutsideInclusionZone"
        reason = f"none of {zones} allows this altitude"
    elif not shape.covers(target):
        code = "OutsideInclusionZone"
        reason = f"the target is {format_distance(shape.distance(target))} outside {zones}"
    elif not shape.covers(leg.ground):
        code = "LegOutsideInclusionZone"
        reason = f"the leg leaves {zones}"
    else:
        away_m = border.distance(leg.ground)
        code = "TooCloseToInclusionBorder"
        reason = f"the leg comes within {max(away_m, 0.1):.1f} m of the border of {zones}; keep {margin_m:.1f} m inside"
    enters = shape.covers(leg.braking_path) and not shape.covers(leg.ground)
    return Breach(
        name,
        fence.rule.spec.priority,
        fence.rule.spec.geofence_action,
        code,
        f"{reason} (policy {name})",
        enters,
        lambda part: bool(shape.covers(part)) and not border.dwithin(part, margin_m + EXTRA_MARGIN_M),
    )


def _clearance_outside(shape: BaseGeometry, braking_path: BaseGeometry) -> float:
    return 0.0 if shape.intersects(braking_path) else float(shape.distance(braking_path))


def _stays_inside(shape: BaseGeometry, border: BaseGeometry, leg: Leg, now: Situation, margin_m: float) -> bool:
    """Return True if a leg keeps its margin inside a shape, or leads back into the shape."""
    ground = leg.ground
    if shape.covers(ground) and not border.dwithin(ground, margin_m):
        return True
    certain_path = _certain_path(leg, now)
    if shape.covers(certain_path) and not border.dwithin(certain_path, margin_m):
        return False
    if shape.covers(leg.braking_path) and not shape.covers(ground):
        return False
    if shape.covers(certain_path) and not shape.covers(_path_from_rest(certain_path, leg)):
        return False

    def keeps(part: BaseGeometry) -> bool:
        return bool(shape.covers(part) and not border.dwithin(part, margin_m))

    return _only_gains_distance(leg, keeps, lambda point: signed_depth_m(shape, border, point))


def _leads_out(shape: BaseGeometry, leg: Leg, margin_m: float, clearance_m: float) -> bool:
    """Return True if a leg that starts in or too close to an excluded shape leads away from the shape."""
    if clearance_m > 0 and shape.distance(leg.ground) < clearance_m - 1e-6:
        return False
    border = shape.boundary
    return _only_gains_distance(
        leg,
        lambda part: not shape.dwithin(part, margin_m),
        lambda point: -signed_depth_m(shape, border, point),
    )


def _leads_away(shape: BaseGeometry, leg: Leg, certain: BaseGeometry) -> bool:
    """Return True if a leg leads away from a shape even if the drone comes to rest as early as possible."""
    clearance_m = _clearance_outside(shape, certain)
    if clearance_m == 0:
        return True
    return float(shape.distance(_path_from_rest(certain, leg))) >= clearance_m - 1e-6


def _path_from_rest(certain: BaseGeometry, leg: Leg) -> BaseGeometry:
    """Return the line from the first point at which the drone can stop, the end of `certain`, to the target."""
    return shapely.linestrings((shapely.get_coordinates(certain)[-1], leg.target))


def _only_gains_distance(
    leg: Leg, keeps: Callable[[BaseGeometry], bool], clearance: Callable[[BaseGeometry], float]
) -> bool:
    """Return True if a leg that begins too close to a fence moves away from it, and never comes too close again.

    Distances are measured to the original fence, because growing or shrinking a shape of ten thousand corners takes seconds.
    """
    if keeps(leg.line):
        return True
    x, y = leg.stop
    tx, ty = leg.target
    if keeps(shapely.points(leg.stop)) or not keeps(shapely.points(leg.target)):
        return False
    low = 0.0
    high = 1.0
    for _ in range(BISECTION_STEPS):
        share = (low + high) / 2
        keeps_rest = keeps(shapely.linestrings(((x + (tx - x) * share, y + (ty - y) * share), (tx, ty))))
        low, high = (low, share) if keeps_rest else (share, high)
    largest_m = -math.inf
    for i in range(_SAMPLES + 1):
        share = high * i / _SAMPLES
        distance_m = clearance(shapely.points(x + (tx - x) * share, y + (ty - y) * share))
        if distance_m < largest_m - 1e-6:
            return False
        largest_m = max(largest_m, distance_m)
    return True


def signed_depth_m(shape: BaseGeometry, border: BaseGeometry, point: BaseGeometry) -> float:
    """Return the distance to the border: positive inside the shape, negative outside."""
    distance = float(border.distance(point)) if not border.is_empty else math.inf
    return distance if shape.covers(point) else -distance


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

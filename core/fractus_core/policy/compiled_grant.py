"""Grants compiled for the engine: geometries in metres of a local frame, with spatial indexes for checks in microseconds."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal, assert_never

import shapely
from shapely.geometry.base import BaseGeometry

from fractus_core.api.components import ServiceRequest
from fractus_core.api.geometry import AltitudeBand, Area, Point, Reference
from fractus_core.api.grants import GrantedPolicy, GrantSpec
from fractus_core.api.methods import METHODS_OF, MOBILITY_METHODS, Interface, Service
from fractus_core.api.policies import PolicySpec
from fractus_core.api.schedules import ActiveTime, active_between, active_throughout
from fractus_core.geo import LocalFrame, area_center, area_polygon, check_extent
from fractus_core.policy.decision_types import Home, Situation, earliest_time

MAX_FRAME_REACH_M = 500_000.0
"""Zones farther than this from the origin are left out of the frame, because no drone reaches them."""
MAX_UNINDEXED = 4
"""Number of zones above which a spatial index is used. For fewer zones, testing each zone is faster."""
_PERMITTING_KINDS = frozenset({"inclusion", "grant"})
"""Kinds of policies that permit something inside their zones.

The approximation of a zone of these policies must not exceed the zone.
"""
OPERATION_AREA = "operation-area"
"""Policy name in verdicts of the operation area, which is a fence of every grant."""


@dataclass(frozen=True, slots=True)
class Rule:
    """A policy that applies to the instance, without its zones."""

    name: str
    spec: PolicySpec
    valid_from_s: float
    valid_until_s: float

    @property
    def limited_in_time(self) -> bool:
        """True if the policy has a validity window."""
        return math.isfinite(self.valid_from_s) or math.isfinite(self.valid_until_s)

    def in_force(self, time_s: float) -> bool:
        """Return True if the policy is valid at a time, or at any time between the readings of an uncertain time."""
        return self.valid_from_s <= time_s and earliest_time(time_s) < self.valid_until_s

    def surely_in_force(self, time_s: float) -> bool:
        """Return True if the policy is valid at a time, or at all times between the readings of an uncertain time."""
        return self.valid_from_s <= earliest_time(time_s) and time_s < self.valid_until_s


@dataclass(frozen=True, slots=True)
class PolicyZone:
    """A zone of a policy."""

    rule: Rule
    name: str
    shape: BaseGeometry
    band: AltitudeBand | None
    schedule: tuple[ActiveTime, ...] = ()

    def in_force(self, time_s: float) -> bool:
        """Return True if policy and zone are active at a time, or at any time between the readings of an uncertain time."""
        if not self.rule.in_force(time_s):
            return False
        first_s = max(earliest_time(time_s), self.rule.valid_from_s)
        return active_between(self.schedule, first_s, min(time_s, self.rule.valid_until_s))

    def surely_in_force(self, time_s: float) -> bool:
        """Return True if policy and zone are active at a time, or at all times between the readings of an uncertain time."""
        return self.rule.surely_in_force(time_s) and self.surely_active(time_s)

    def surely_active(self, time_s: float) -> bool:
        """Return True if the zone is active at a time, or at all times between the readings of an uncertain time."""
        return active_throughout(self.schedule, earliest_time(time_s), time_s)


@dataclass(frozen=True, slots=True)
class AirVolume:
    """Search volume of a decision: a ground shape, the margin around it, and an altitude range above home."""

    ground: BaseGeometry
    margin_m: float
    lower_m: float
    upper_m: float

    def extended(self, height_m: float) -> AirVolume:
        """Return the volume extended upward and downward."""
        return replace(self, lower_m=self.lower_m - height_m, upper_m=self.upper_m + height_m)


class PolicyIndex:
    """Spatial index of the zones of policies, and the policies without zones, which apply everywhere."""

    __slots__ = ("_tree", "everywhere", "zones")

    def __init__(self, zones: Iterable[PolicyZone] = (), everywhere: Iterable[Rule] = ()) -> None:
        self.zones = tuple(zones)
        self.everywhere = tuple(everywhere)
        many = len(self.zones) > MAX_UNINDEXED
        self._tree = shapely.STRtree([z.shape for z in self.zones]) if many else None

    def __bool__(self) -> bool:
        return bool(self.zones or self.everywhere)

    def near(self, air: AirVolume, now: Situation, flat: bool) -> Iterator[PolicyZone]:
        """Yield the zones in force within the margin of a volume.

        An altitude limit of unknown datum does not exclude a zone.
        """
        # Use distances instead of bounding boxes, because the box of a long slanted zone would cover much of the map.
        if self._tree is None:
            near = [z for z in self.zones if z.shape.dwithin(air.ground, air.margin_m)]
        else:
            near = [self.zones[i] for i in self._tree.query(air.ground, predicate="dwithin", distance=air.margin_m)]
        for zone in near:
            if zone.in_force(now.time_s) and band_may_overlap(zone.band, air.lower_m, air.upper_m, now.home, flat):
                yield zone


@dataclass(frozen=True, slots=True)
class Inclusion:
    """A policy that keeps the drone inside the union of its zones."""

    rule: Rule
    zones: tuple[PolicyZone, ...]
    shape: BaseGeometry
    border: BaseGeometry
    banded: bool

    def at(self, lower_m: float, upper_m: float, now: Situation, flat: bool) -> tuple[BaseGeometry, BaseGeometry]:
        """Return the allowed ground and its border for a range of altitudes above home."""
        if not self.banded:
            return self.shape, self.border
        kept = [
            p.shape
            for p in self.zones
            if band_surely_contains(p.band, lower_m, upper_m, now.home, flat) and p.surely_active(now.time_s)
        ]
        shape = shapely.union_all(kept) if kept else shapely.Polygon()
        return shape, shape.boundary

    def near_altitudes(self, lower_m: float, upper_m: float, now: Situation, flat: bool) -> BaseGeometry:
        """Return the ground of all zones that a drone may be inside at any altitude of a range above home."""
        return shapely.union_all(
            [
                p.shape
                for p in self.zones
                if band_may_overlap(p.band, lower_m, upper_m, now.home, flat) and p.surely_active(now.time_s)
            ]
        )


@dataclass(frozen=True, slots=True)
class CompiledGrant:
    """Permissions and restrictions of one component instance.

    Attributes:
        methods: Granted methods of all services.
        interfaces: Protocols over which the instance may call each service.
        denials: Per method, the policies that forbid it.
        allowances: Per method, the policies that grant it at certain places and times. A method without an entry is granted
            everywhere.
        operation_area: Area in which services may be used. None means anywhere.
        flight_area: Area in which the instance may fly: operation area and corridor to home, or only the operation area
            under partial control. None means anywhere.
        return_area: Area in which the system flies the drone home: operation area and corridor. None means anywhere.
        timed_zones: Zones of geofences that have a schedule, or whose policy has a validity window.
    """

    identity: str
    frame: LocalFrame
    methods: frozenset[str]
    interfaces: dict[Service, frozenset[Interface]]
    driver: bool
    max_altitude_m: float | None
    max_speed_mps: float | None
    denials: dict[str, PolicyIndex]
    allowances: dict[str, PolicyIndex]
    altitude_limits: PolicyIndex
    speed_limits: PolicyIndex
    exclusions: PolicyIndex
    inclusions: tuple[Inclusion, ...]
    privacy: PolicyIndex
    operation_area: BaseGeometry | None
    operation_area_border: BaseGeometry | None
    flight_area: BaseGeometry | None
    flight_area_border: BaseGeometry | None
    return_area: BaseGeometry | None
    return_area_border: BaseGeometry | None
    flat_terrain: bool
    timed_zones: tuple[PolicyZone, ...]

    def fences_in_force(self, time_s: float) -> tuple[tuple[bool, bool], ...]:
        """Return for each time-limited fence if it may be in force at a Unix time, and if it surely is."""
        return tuple((zone.in_force(time_s), zone.surely_in_force(time_s)) for zone in self.timed_zones)

    def locate(self, now: Situation) -> tuple[float, float] | None:
        """Return the drone's position in metres of the frame, or None while the position is unknown."""
        return None if now.lat is None or now.lon is None else self.frame.xy(now.lat, now.lon)


def compile_grant(spec: GrantSpec, origin: Point | None = None, flat_terrain: bool = False) -> CompiledGrant:
    """Compile a grant for the engine.

    Args:
        spec: Grant as written by the operator.
        origin: Origin of the metric frame, for example the drone's home. Default: the grant's own home, depot or area.
        flat_terrain: Take the ground everywhere as level with home. Otherwise altitudes above terrain are unknown, and
            policies that need them deny.

    Raises:
        InvalidObject: An area of the grant has an invalid geometry.
    """
    frame = LocalFrame.at(origin or _origin(spec))
    policies = [(_rule(policy), policy) for policy in spec.policies]
    methods = frozenset().union(*(spec.methods(service) for service in METHODS_OF))
    operation_area = _union(frame, spec.operation_area)
    return_area = operation_area
    if operation_area is not None and spec.corridor:
        return_area = shapely.union(operation_area, _union(frame, spec.corridor))
    flight_area = operation_area if spec.control == "partial" else return_area
    exclusions = _index(frame, policies, "GeofenceControl", "exclusion")
    inclusions = tuple(_inclusion(frame, r, p) for r, p in policies if p.spec.kind == "inclusion")
    fences = (*exclusions.zones, *(zone for fence in inclusions for zone in fence.zones))
    return CompiledGrant(
        identity=spec.identity,
        frame=frame,
        methods=methods,
        interfaces={service: spec.interfaces(service) for service in METHODS_OF},
        driver=spec.class_ == "driver",
        max_altitude_m=spec.limits.max_altitude if spec.limits else None,
        max_speed_mps=spec.limits.max_speed if spec.limits else None,
        denials=_by_method(frame, policies, "denial", methods),
        allowances=_by_method(frame, policies, "grant", methods),
        altitude_limits=_index(frame, policies, "LimitControl", "altitude"),
        speed_limits=_index(frame, policies, "LimitControl", "speed"),
        exclusions=exclusions,
        inclusions=inclusions,
        privacy=_index(frame, policies, "PrivacyControl", "camera"),
        operation_area=operation_area,
        operation_area_border=_prepared(operation_area.boundary) if operation_area is not None else None,
        flight_area=_prepared(flight_area) if flight_area is not None else None,
        flight_area_border=_prepared(flight_area.boundary) if flight_area is not None else None,
        return_area=_prepared(return_area) if return_area is not None else None,
        return_area_border=_prepared(return_area.boundary) if return_area is not None else None,
        flat_terrain=flat_terrain,
        timed_zones=tuple(zone for zone in fences if zone.schedule or zone.rule.limited_in_time),
    )


def compile_transit_grant(spec: GrantSpec, origin: Point | None = None, flat_terrain: bool = False) -> CompiledGrant:
    """Compile the grant under which the system itself flies an application's drone to control points and home.

    It has the application's fences and limits, every method of the mobility service, and an operation area that
    includes the corridor.
    """
    mobility = ServiceRequest(service="mobility", methods=MOBILITY_METHODS)
    system = spec.model_copy(update={"services": (mobility,), "control": "full"})
    grant = compile_grant(system, origin, flat_terrain)
    return replace(grant, operation_area=grant.flight_area, operation_area_border=grant.flight_area_border)


def _origin(spec: GrantSpec) -> Point:
    if spec.home is not None:
        return Point(lat=spec.home.lat, lon=spec.home.lon)
    if spec.depot is not None:
        return spec.depot
    if spec.operation_area:
        return area_center(spec.operation_area[0])
    for policy in spec.policies:
        if policy.zones:
            return area_center(policy.zones[0].area)
    return Point(lat=0.0, lon=0.0)


def _rule(policy: GrantedPolicy) -> Rule:
    return Rule(policy.name, policy.spec, *policy.spec.window_s)


def _prepared(shape: BaseGeometry) -> BaseGeometry:
    """Build the GEOS index of a shape in place, because the shape is checked thousands of times."""
    shapely.prepare(shape)
    return shape


def _union(frame: LocalFrame, areas: tuple[Area, ...]) -> BaseGeometry | None:
    """Return the union of areas to stay in. Circles are inscribed."""
    if not areas:
        return None
    return _prepared(shapely.union_all([area_polygon(frame, area, within=True) for area in areas]))


def _policy_zones(frame: LocalFrame, rule: Rule, policy: GrantedPolicy) -> list[PolicyZone]:
    within = rule.spec.kind in _PERMITTING_KINDS
    return [
        PolicyZone(
            rule, zone.name, _prepared(area_polygon(frame, zone.area, within=within)), zone.altitude, zone.schedule
        )
        for zone in policy.zones
        if _within_reach(frame, zone.area)
    ]


def _within_reach(frame: LocalFrame, area: Area) -> bool:
    """Return True if part of an area may be so near to the origin that the drone can reach it.

    Raises:
        InvalidObject: The area is not near the origin, and its extent is too large.
    """
    if area.circle is not None:
        center = LocalFrame.at(area.circle.center)
        x, y = center.xy(frame.lat, frame.lon)
        near = abs(frame.lat - area.circle.center.lat) < 60 and abs(x) + abs(y) < MAX_FRAME_REACH_M + area.circle.radius
        return near and _same_side(frame, area.circle.center)
    ring = area.polygon.exterior if area.polygon is not None else ()
    if not all(_same_side(frame, point) for point in ring):
        # The area is far away, unless it is so large that it reaches around the globe. `check_extent` rejects such
        # areas.
        check_extent(area)
        return False
    xy = [frame.xy(p.lat, p.lon) for p in ring]
    (west, east), (south, north) = ((min(a), max(a)) for a in zip(*xy, strict=True))
    return bool(
        west < MAX_FRAME_REACH_M
        and east > -MAX_FRAME_REACH_M
        and south < MAX_FRAME_REACH_M
        and north > -MAX_FRAME_REACH_M
    )


def _same_side(frame: LocalFrame, point: Point) -> bool:
    """Return True if a point lies on the frame's half of the globe."""
    apart = abs((point.lon - frame.lon + 180.0) % 360.0 - 180.0)
    return apart < 80.0 or (abs(frame.lat) > 60.0 and abs(point.lat) > 30.0)


def _index(
    frame: LocalFrame,
    policies: list[tuple[Rule, GrantedPolicy]],
    kind: str,
    policy_kind: str,
    method: str | None = None,
) -> PolicyIndex:
    matching = [
        (rule, policy)
        for rule, policy in policies
        if rule.spec.type == kind and rule.spec.kind == policy_kind and (method is None or method in rule.spec.methods)
    ]
    return PolicyIndex(
        [zone for rule, policy in matching for zone in _policy_zones(frame, rule, policy)],
        [rule for rule, policy in matching if not policy.zones],
    )


def _by_method(
    frame: LocalFrame,
    policies: list[tuple[Rule, GrantedPolicy]],
    policy_kind: Literal["grant", "denial"],
    methods: frozenset[str],
) -> dict[str, PolicyIndex]:
    named = {m for rule, _ in policies if rule.spec.kind == policy_kind for m in rule.spec.methods} & methods
    return {method: _index(frame, policies, "AccessControl", policy_kind, method) for method in sorted(named)}


def _inclusion(frame: LocalFrame, rule: Rule, policy: GrantedPolicy) -> Inclusion:
    zones = tuple(_policy_zones(frame, rule, policy))
    shape = shapely.union_all([p.shape for p in zones]) if zones else shapely.Polygon()
    return Inclusion(
        rule,
        zones,
        _prepared(shape),
        _prepared(shape.boundary),
        any(p.band is not None or p.schedule for p in zones),
    )


# Altitudes: metres above home for every datum, and altitude bands of zones in those metres. The height of terrain is
# known only if the ground is assumed to be level with home. The height of mean sea level is known only if home is
# known.


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
    """Return True if altitudes from `lower_m` to `upper_m` above home may touch a band.

    A band with an unknown datum counts as touched.
    """
    if band is None:
        return True
    floor_m, ceiling_m = band_limits_m(band, home, flat_terrain)
    return not (upper_m < floor_m or lower_m > ceiling_m)


def band_surely_contains(
    band: AltitudeBand | None, lower_m: float, upper_m: float, home: Home | None, flat_terrain: bool
) -> bool:
    """Return True if altitudes from `lower_m` to `upper_m` above home lie inside a band.

    Return False if the band's datum is unknown.
    """
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
    """Return the vertical distance between a band and altitudes from `lower_m` to `upper_m` above home, at least 0."""
    floor_m, ceiling_m = band_limits_m(band, home, flat_terrain)
    return max(floor_m - upper_m, lower_m - ceiling_m, 0.0)


def band_depth_m(band: AltitudeBand | None, altitude_m: float, home: Home | None, flat_terrain: bool) -> float:
    """Return the distance of an altitude above home to the nearest limit of a band, negative outside the band."""
    floor_m, ceiling_m = band_limits_m(band, home, flat_terrain)
    return min(altitude_m - floor_m, ceiling_m - altitude_m)

"""Compilation of a plan and the policies into Grants, with which nodes enforce policies offline (thesis 8.7)."""

from __future__ import annotations

import itertools
import weakref
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from fractus_core.api import Application, Component, Depot, Drone, EdgeNode, InvalidObject, Policy, Zone
from fractus_core.api.components import ServiceRequest
from fractus_core.api.geometry import MAX_HOLES, MAX_RING_POINTS, Area, Circle, Point, Position
from fractus_core.api.grants import GrantedLimits, GrantedPolicy, GrantedZone, GrantSpec
from fractus_core.api.methods import MOBILITY_METHODS
from fractus_core.api.plans import DeploymentPlanSpec, PlannedInstance
from fractus_core.api.policies import PolicyAction, PolicySpec
from fractus_core.geo import (
    LocalFrame,
    area_center,
    area_polygon,
    areas_of_shape,
    count_crossings,
    distance_m,
    ground_point,
)
from fractus_core.planning.inventory import Inventory, Settings
from fractus_core.planning.mission import altitude_limit_m
from fractus_core.planning.operation_area import MAX_CROSSINGS, OperationArea, operation_area
from fractus_core.policy.decision_types import distinct
from fractus_core.policy.engine import PICTURE_METHODS
from fractus_core.policy.footprint import MAX_SIGHT_M
from fractus_core.policy.selectors import application_reference, node_attributes, policy_applies

ROUNDING_M = 0.01
"""Tolerance of the granted area's outline. This tolerance reduces the number of points to a third."""

MAX_ROUNDING_M = 0.16
"""Maximum tolerance for an outline with more points than a ring may have."""

AROUND_CORRIDOR_M = 100.0
"""Zones further than this from the corridor of a drone do not affect its route."""

PERMITTING_KINDS = frozenset({"inclusion", "grant"})
"""Kinds of policies that allow something only in their zones.

Grants therefore also contain their zones out of reach.
"""

_Bounds = tuple[Point, float]
"""A position, and the distance in metres within which a zone may affect the node."""

FIXED_NODE_REACH_M = 1000.0
"""Zones further than this from a fixed node do not affect it, unless the node's camera may see them."""


def compile_grants(
    application: Application,
    plan: DeploymentPlanSpec,
    inventory: Inventory,
    settings: Settings | None = None,
    present: Iterable[GrantSpec] = (),
    *,
    awaits: tuple[str, ...] = (),
) -> tuple[GrantSpec, ...]:
    """Compile a Grant for each planned instance that uses system services or has points of interest, in the plan's order.

    A Grant contains the policies whose node and application selectors match, with their zones resolved. Zones that the node
    can neither reach nor see are omitted.

    Args:
        application: Application of the plan.
        plan: Placements of its instances.
        inventory: Current inventory.
        settings: Settings of the plan.
        present: Existing Grants of the application. An instance with a Grant on the same node keeps its last version of a
            policy that is now invalid.
        awaits: Components for which the mission waits.

    Raises:
        InvalidObject: A policy for a new instance selects a missing or invalid zone, or a policy cannot be read. Then no
            Grant is issued, because a flight without enforceable policies is not allowed.
    """
    settings = settings or Settings()
    before = {(grant.instance, grant.node): grant for grant in present}
    area = operation_area(application.spec, inventory.depots, settings.safety_radius_m)
    aboard: GrantSpec | None = None
    grants = []
    for placed in plan.placements:
        component = application.spec.component(placed.component)
        guides = _guides(component, plan)
        if placed.node is None or not (component.services or guides):
            continue
        last = before.get((placed.instance, placed.node))
        if placed.node not in inventory.drones and placed.node not in inventory.edge_nodes:
            if last is None:
                raise InvalidObject(
                    f"node {placed.node}", "it has no Drone or EdgeNode, so no Grant can be created for it"
                )
            grants.append(refresh(last, inventory, awaits))
            continue
        if placed.placement == "drone" and area is not None:
            # All drone components run on one drone.
            drone = inventory.drones[placed.node]
            aboard = aboard or _drone_grant(
                application, drone, inventory, area, component=component.name, instance=placed.instance
            )
            grant = _granted_aboard(aboard, component, placed, inventory)
            if guides:
                grant = grant.model_copy(update={"tour": area.route})
            if grant.begins_mission:
                grant = grant.model_copy(update={"awaits": awaits})
        else:
            grant = _edge_grant(application, component, placed, inventory)
        if last is None:
            check_policies(inventory)
        actions = application.spec.policy_actions
        policies = _policies(grant, inventory, last.policies if last is not None else None, actions=actions)
        grants.append(grant.model_copy(update={"policies": policies}))
    return tuple(grants)


def check_policies(inventory: Inventory) -> None:
    """Refuse new Grants while a policy cannot be read, because it may apply to any component.

    Raises:
        InvalidObject: A policy cannot be read.
    """
    for name, problem in sorted(inventory.unreadable_policies.items()):
        raise InvalidObject(f"Policy {name}", f"{problem}; correct or delete it")


def refresh(grant: GrantSpec, inventory: Inventory, awaits: tuple[str, ...] | None = None) -> GrantSpec:
    """Return a Grant with updated policies and awaited components (None: no change). Its other fields stay unchanged.

    The update needs neither the application nor its plan, so an invalid application does not prevent the update of a
    Grant in use. If a policy or one of its zones is invalid, the last granted version is kept.
    """
    fields: dict[str, Any] = {"policies": _policies(grant, inventory, grant.policies)}
    if awaits is not None and grant.begins_mission:
        fields["awaits"] = awaits
    return grant.model_copy(update=fields)


def flight_grant(application: Application, drone: Drone, inventory: Inventory, area: OperationArea) -> GrantSpec:
    """Return the Grant with which the route of an application is judged, with all methods of the mobility service.

    It contains the policies for the component that determines the flight, without zones far from the route. Unresolvable
    policies are omitted, because no Grant is issued while they exist.
    """
    leader = application.spec.leader or next(application.spec.on("drone"))
    grant = _drone_grant(application, drone, inventory, area, component=leader.name, instance=leader.name)
    corners = shapely.get_coordinates([area_polygon(area.frame, part) for part in grant.corridor])
    reach_m = float(np.hypot(*corners.T).max()) + AROUND_CORRIDOR_M
    center = Point(lat=area.frame.lat, lon=area.frame.lon)
    actions = application.spec.policy_actions
    policies = _policies(grant, inventory, (), (center, reach_m), actions=actions)
    services = (ServiceRequest(service="mobility", methods=MOBILITY_METHODS),)
    return grant.model_copy(update={"policies": policies, "services": services, "control": "full"})


def _drone_grant(
    application: Application, drone: Drone, inventory: Inventory, area: OperationArea, *, component: str, instance: str
) -> GrantSpec:
    mobility = drone.spec.services.mobility
    depot = inventory.depots.get(drone.spec.depot or "")
    shape = _outlined(area.shape)
    stand = area_polygon(area.frame, stand_of(drone, inventory.depots, area))
    corridor = shapely.union(shape, stand).convex_hull
    limits = None
    if mobility is not None:
        highest_m = altitude_limit_m(application.spec, mobility)
        limits = GrantedLimits(max_altitude=highest_m, max_speed=mobility.max_speed)
    return GrantSpec(
        node=drone.name,
        application=application_reference(application),
        component=component,
        instance=instance,
        operation_area=areas_of_shape(area.frame, shape),
        corridor=areas_of_shape(area.frame, corridor.simplify(ROUNDING_M)),
        depot=depot.spec.location if depot is not None else None,
        home=drone.spec.home,
        limits=limits,
        contact_lost=application.spec.contact_lost,
    )


def stand_of(drone: Drone, depots: Mapping[str, Depot], area: OperationArea) -> Area:
    """Return the area in which a drone is parked: around its home, or else around its depot or the start of the route."""
    depot = depots.get(drone.spec.depot or "")
    home = drone.spec.home
    center = depot.spec.location if depot is not None else area.start
    if home is not None:
        center = ground_point(home)
    return Area(circle=Circle(center=center, radius=depot.spec.radius if depot is not None else 30.0))


def _outlined(shape: BaseGeometry) -> BaseGeometry:
    """Simplify a shape to the maximum number of points and holes of an Area, with the smallest sufficient tolerance.

    Raises:
        InvalidObject: The shape has too many points or holes even with the maximum tolerance.
    """
    tolerance_m = ROUNDING_M
    while tolerance_m <= MAX_ROUNDING_M:
        rounded = shape.simplify(tolerance_m)
        rings = shapely.get_rings(shapely.get_parts(rounded))
        points = int(shapely.get_num_coordinates(rings).max(initial=0)) - 1
        holes = int(shapely.get_num_interior_rings(shapely.get_parts(rounded)).max(initial=0))
        if points <= MAX_RING_POINTS and holes <= MAX_HOLES:
            return rounded
        tolerance_m *= 2
    raise InvalidObject(
        "spec.components",
        f"the area that the drone flies in has {points} corners and {holes} holes, more than {MAX_RING_POINTS} and {MAX_HOLES};"
        " use fewer waypoints, or a region instead of a path",
    )


def _granted_aboard(
    aboard: GrantSpec, component: Component, placed: PlannedInstance, inventory: Inventory
) -> GrantSpec:
    driver = component.class_ == "driver"
    return aboard.model_copy(
        update={
            "component": component.name,
            "instance": placed.instance,
            "class_": component.class_,
            "control": (component.control or "full") if driver else None,
            "control_points": _opened(component, inventory) if driver else (),
            "points_of_interest": component.points_of_interest,
            "services": component.services,
        }
    )


def _guides(component: Component, plan: DeploymentPlanSpec) -> bool:
    """Return True if the system flies a drone to the points of interest of the component."""
    flown = plan.drone is not None and plan.drone.shared_with is None
    return flown and component.points_of_interest is not None


def _opened(component: Component, inventory: Inventory) -> tuple[Any, ...]:
    """Return the control points with depots replaced by positions, because nodes do not know the depots."""
    opened = []
    for point in component.control_points:
        if point.point is not None and point.point.depot is not None:
            location = inventory.depots[point.point.depot].spec.location
            start = point.point.model_copy(
                update={"depot": None, "position": Position(lat=location.lat, lon=location.lon)}
            )
            point = point.model_copy(update={"point": start})  # noqa: PLW2901
        opened.append(point)
    return tuple(opened)


def _edge_grant(
    application: Application, component: Component, placed: PlannedInstance, inventory: Inventory
) -> GrantSpec:
    node = inventory.edge_nodes[placed.node or ""]
    return GrantSpec(
        node=node.name,
        application=application_reference(application),
        component=component.name,
        instance=placed.instance,
        services=component.services,
        home=node.spec.location,
    )


def _policies(
    grant: GrantSpec,
    inventory: Inventory,
    last: Sequence[GrantedPolicy] | None,
    bounds: _Bounds | None = None,
    *,
    actions: Iterable[PolicyAction] | None = None,
) -> tuple[GrantedPolicy, ...]:
    """Return the policies of a Grant, sorted by name.

    Args:
        grant: Grant whose application, component and node select the policies.
        inventory: Current inventory.
        last: Policies of the previous Grant as a fallback, or None for a new Grant.
        bounds: Position and distance up to which zones matter, or None for the range of the node. With bounds, invalid zones
            out of reach are ignored.
        actions: Actions that the application selects. None: use the selected actions of the previous Grant.

    Raises:
        InvalidObject: A policy is invalid, and `last` is None.
    """
    node = inventory.drones.get(grant.node) or inventory.edge_nodes.get(grant.node)
    attributes = node_attributes(node) if node is not None else {"name": grant.node}
    kept = {policy.name: policy for policy in last or ()}
    selected_actions = {each.policy: each for each in (_selections(kept) if actions is None else actions)}
    beyond = bounds
    bounds = bounds or _bounds(grant, node, inventory)
    granted = {name: policy for name, policy in kept.items() if name in inventory.unreadable_policies}
    for name, policy in inventory.policies.items():
        # The attributes of a node without a description are unknown, so its previous policies still apply.
        known = node is not None or name not in kept or not policy.spec.selector.nodes
        if known and not policy_applies(policy.spec, grant.application, grant.component, attributes):
            continue
        try:
            selected = _granted(policy, inventory, bounds, beyond)
        except (ValueError, ArithmeticError, shapely.errors.ShapelyError) as error:
            if last is None:
                if isinstance(error, InvalidObject):
                    raise
                raise InvalidObject(f"Policy {name}", str(error)) from error
            selected = kept.get(name)
        if selected is not None:
            granted[name] = selected if selected is kept.get(name) else _choose(selected, selected_actions.get(name))
    return tuple(granted[name] for name in sorted(granted))


def _selections(granted: Mapping[str, GrantedPolicy]) -> list[PolicyAction]:
    """Return the actions that an application selected for granted policies."""
    return [
        PolicyAction(policy=name, action=policy.spec.action, land_at=policy.selected_land_at)
        for name, policy in granted.items()
        if policy.selected and policy.spec.action is not None
    ]


def _choose(granted: GrantedPolicy, selection: PolicyAction | None) -> GrantedPolicy:
    """Return a policy with the selected action and its landing place, and without choices.

    If the policy does not permit the selected action or landing place any more, its own applies.
    """
    spec = granted.spec
    chosen = selection is not None and selection.action in {spec.action, *spec.choices}
    action = selection.action if selection is not None and chosen else spec.action
    changes: dict[str, Any] = {"action": action, "choices": ()}
    own_place = None
    if selection is not None and chosen and "abort" in spec.choices:
        own_place = selection.land_at
    if action != "abort":
        changes["land_at"] = None
    elif own_place is not None:
        changes["land_at"] = own_place
    if action != "blurFaces":
        changes |= {"faces": None, "fallback": None}
    return granted.model_copy(
        update={"spec": spec.model_copy(update=changes), "selected": chosen, "selected_land_at": own_place}
    )


def check_policy_actions(application: Application, inventory: Inventory) -> None:
    """Refuse an application that selects a missing policy, or an action or landing place that a policy does not permit.

    Raises:
        InvalidObject: A selection is not permitted.
    """
    for i, selection in enumerate(application.spec.policy_actions):
        field = f"spec.policyActions[{i}]"
        policy = inventory.policies.get(selection.policy)
        if policy is None:
            raise InvalidObject(
                f"{field}.policy", f"there is no Policy {selection.policy}; apply it, or remove this entry"
            )
        permitted = distinct(str(action) for action in (policy.spec.action or "", *policy.spec.choices))
        if selection.action not in permitted:
            named = ", ".join(permitted) or "no choice"
            raise InvalidObject(
                f"{field}.action",
                f"policy {selection.policy} does not permit {selection.action}; select one of: {named}",
            )
        if selection.land_at is not None and "abort" not in policy.spec.choices:
            raise InvalidObject(
                f"{field}.landAt",
                f"policy {selection.policy} does not offer abort in spec.choices, so its own landing place applies;"
                " remove landAt",
            )


def _granted(
    policy: Policy, inventory: Inventory, bounds: _Bounds | None, beyond: _Bounds | None = None
) -> GrantedPolicy | None:
    """Return a policy with its zones, or None if all its zones are out of reach.

    Zones that are obviously out of reach of `beyond` are not validated.

    Raises:
        InvalidObject: A zone is missing or invalid, or zones whose union is enforced cross too often.
    """
    named = dict.fromkeys(policy.spec.selector.zones)
    zones = [
        _zone(policy, i, name, inventory)
        for i, name in enumerate(named)
        if beyond is None
        or policy.spec.kind in PERMITTING_KINDS
        or not surely_beyond(inventory.zones.get(name), *beyond)
    ]
    if bounds is None or policy.spec.kind in PERMITTING_KINDS:
        near = zones
    else:
        base, reach_m = bounds
        if beyond is None and _concerns_pictures(policy.spec):
            reach_m += MAX_SIGHT_M
        near = [zone for zone in zones if zone.is_within(reach_m, base)]
    if named and not near:
        return None
    check_united(policy, near)
    # Omitted zones are removed from the selector, so that a node can distinguish them from missing zones.
    granted = tuple(zone.granted for zone in near)
    selector = policy.spec.selector.model_copy(update={"zones": tuple(zone.name for zone in granted)})
    return GrantedPolicy(name=policy.name, spec=policy.spec.model_copy(update={"selector": selector}), zones=granted)


def _concerns_pictures(spec: PolicySpec) -> bool:
    """Return True if a policy also applies to zones that the camera can see from outside."""
    return spec.type == "PrivacyControl" or not PICTURE_METHODS.isdisjoint(spec.methods)


def _bounds(grant: GrantSpec, node: Drone | EdgeNode | None, inventory: Inventory) -> _Bounds | None:
    """Return the position of a node and the distance up to which zones matter, or None if all zones matter.

    The result depends only on data that a Grant keeps, so it is the same when the Grant is issued and when it is refreshed.
    """
    if isinstance(node, EdgeNode):
        return ground_point(node.spec.location), FIXED_NODE_REACH_M
    if node is None:
        return None
    depot = inventory.depots.get(node.spec.depot or "")
    mobility = node.spec.services.mobility
    reach_m = mobility.max_speed * mobility.max_flight_time * 60 if mobility is not None else FIXED_NODE_REACH_M
    if node.spec.home is not None:
        return ground_point(node.spec.home), reach_m
    if depot is not None:
        return depot.spec.location, reach_m
    return (area_center(grant.operation_area[0]), reach_m) if grant.operation_area else None


def _zone(policy: Policy, index: int, name: str, inventory: Inventory) -> ValidatedZone:
    if name in inventory.unreadable_zones:
        raise InvalidObject(f"Zone {name}", inventory.unreadable_zones[name])
    if name not in inventory.zones:
        raise InvalidObject(
            f"Policy {policy.name} spec.selector.zones[{index}]",
            f"there is no Zone {name}; apply it, or correct the policy",
        )
    return validated(inventory.zones[name])


_DISTORTION = 1.05
"""Safety factor for the distortion of the frame of a large zone."""


def surely_beyond(zone: Zone | None, base: Point, reach_m: float) -> bool:
    """Return True if a quick test shows that a zone is out of reach. If the test is inconclusive, return False."""
    if zone is None or zone.spec.area.polygon is None:
        return zone is not None and _circle_beyond(zone.spec.area, base, reach_m)
    ring = zone.spec.area.polygon.exterior
    # No point of a polygon is further from a corner than half the length of its outline.
    outline_m = sum(distance_m(a, b) for a, b in itertools.pairwise((*ring, ring[0])))
    return distance_m(ring[0], base) > (reach_m + outline_m / 2) * _DISTORTION


def _circle_beyond(area: Area, base: Point, reach_m: float) -> bool:
    """Return True if an area is a circle that is certainly out of reach."""
    circle = area.circle
    return circle is not None and distance_m(circle.center, base) > (reach_m + circle.radius) * _DISTORTION


@dataclass(frozen=True, slots=True, eq=False)
class ValidatedZone:
    """A validated zone as in Grants, with its outline in a local frame. Instances are compared by identity."""

    granted: GrantedZone
    frame: LocalFrame
    outline: shapely.Polygon

    def is_within(self, reach_m: float, base: Point) -> bool:
        """Return True if part of the zone is within a distance of a position."""
        return not _circle_beyond(self.granted.area, base, reach_m) and self.distance_m(base) <= reach_m

    def distance_m(self, base: Point) -> float:
        """Return the distance from a position to the zone in metres."""
        return float(self.outline.distance(shapely.Point(*self.frame.xy(base.lat, base.lon))))


_VALIDATED: dict[int, ValidatedZone] = {}
"""Validated zones by the identity of their objects, because hashing all points would take longer than validating them."""


def _validate(zone: Zone) -> ValidatedZone:
    name = zone.name
    spec = zone.spec
    try:
        frame = LocalFrame.at(area_center(spec.area))
        outline = area_polygon(frame, spec.area)
    except InvalidObject as error:
        raise InvalidObject(f"Zone {name} spec.area.{error.field}", error.problem) from None
    granted = GrantedZone(name=name, area=spec.area, altitude=spec.altitude, schedule=spec.schedule)
    return ValidatedZone(granted, frame, outline)


def validated(zone: Zone) -> ValidatedZone:
    """Validate a zone for Grants. The result is cached until the object is deleted.

    Raises:
        InvalidObject: The geometry of the zone is invalid.
    """
    known = _VALIDATED.get(id(zone))
    if known is None:
        known = _VALIDATED[id(zone)] = _validate(zone)
        weakref.finalize(zone, _VALIDATED.pop, id(zone), None)
    return known


@lru_cache(maxsize=32)
def zone_crossings(zones: tuple[ValidatedZone, ...], at_most: int) -> int:
    """Count the crossings of the edges of zones, up to `at_most` + 1."""
    lines = []
    for zone in zones if len(zones) > 1 else ():
        for ring in shapely.get_rings(zone.outline):
            lats, lons = zone.frame.latlon_array(shapely.get_coordinates(ring))
            lines.append(np.column_stack([lons, lats]))
    # Crossings are the same in degrees as in metres, if all longitudes are on one side of the antimeridian.
    middle_lon = float(lines[0][0, 0]) if lines else 0.0
    for line in lines:
        line[:, 0] = (line[:, 0] - middle_lon + 540.0) % 360.0 - 180.0
    return count_crossings(lines, at_most)


def check_united(policy: Policy, zones: Sequence[ValidatedZone]) -> None:
    """Refuse an inclusion policy if computing the union of its zones would take too long.

    Args:
        policy: Policy to enforce.
        zones: Relevant zones of the policy.

    Raises:
        InvalidObject: The edges of the zones cross too often.
    """
    if policy.spec.kind == "inclusion" and zone_crossings(tuple(zones), MAX_CROSSINGS) > MAX_CROSSINGS:
        raise InvalidObject(
            f"Policy {policy.name} spec.selector.zones",
            f"edges of its zones cross more than {MAX_CROSSINGS} times; combine them into one zone, or use fewer corners",
        )

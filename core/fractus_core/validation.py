"""Validation beyond the schema: crossing rings, missing zones and depots."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from fractus_core.api import Application, Depot, InvalidObject, Policy, Zone
from fractus_core.api.components import ControlPoint
from fractus_core.api.geometry import Area, Point
from fractus_core.geo import LocalFrame, area_center, area_polygon, check_extent
from fractus_core.planning.operation_area import check_crossings, route_of
from fractus_core.plausibility import exchanged_coordinates
from fractus_core.policy.selectors import is_attribute

MAX_WAYPOINTS = 2000
"""Maximum number of waypoints of an application. No battery lasts for so many waypoints."""


def check_area(area: Area, field: str) -> None:
    """Refuse rings that cross themselves, holes outside the exterior, and areas of continental size.

    Raises:
        InvalidObject: The area is invalid. The field of the error is below `field`.
    """
    try:
        check_extent(area)
        area_polygon(LocalFrame.at(area_center(area)), area)
    except InvalidObject as error:
        raise InvalidObject(f"{field}.{error.field}", error.problem) from None


def check_zone(zone: Zone) -> None:
    """Refuse a zone with invalid geometry.

    Raises:
        InvalidObject: The geometry is invalid. The error names the ring.
    """
    check_area(zone.spec.area, "spec.area")


def check_policy(policy: Policy, zones: Collection[str]) -> None:
    """Refuse a policy that selects missing zones, or nodes by unknown attributes.

    Raises:
        InvalidObject: A zone is missing or an attribute is unknown. The error names the first one.
    """
    for i, expression in enumerate(policy.spec.selector.nodes):
        if not is_attribute(expression.key):
            selected = "no node" if policy.spec.kind == "grant" else "every node"
            raise InvalidObject(
                f"spec.selector.nodes[{i}].key",
                f"Drones and EdgeNodes have no attribute {expression.key}, so the policy applies to {selected}; correct the name",
            )
    for i, name in enumerate(policy.spec.selector.zones):
        if name not in zones:
            known = ", ".join(sorted(zones)[:10]) or "none"
            raise InvalidObject(
                f"spec.selector.zones[{i}]",
                f"Zone {name} does not exist (existing: {known}); apply it or correct the name",
            )


def check_application(application: Application, depots: Mapping[str, Depot]) -> None:
    """Refuse an application with unknown depots, invalid regions, exchanged coordinates, or paths that cross too often.

    Raises:
        InvalidObject: The application is invalid. The error names the field.
    """
    driver = application.spec.driver
    if driver is not None:
        index = application.spec.components.index(driver)
        count = sum(len(point.path or ()) for point in driver.control_points)
        if count > MAX_WAYPOINTS:
            raise InvalidObject(
                f"spec.components[{index}].controlPoints",
                f"{count} waypoints in all, more than {MAX_WAYPOINTS}; split the mission",
            )
        for i, point in enumerate(driver.control_points):
            field = "path[0]" if point.path else "region"
            if note := exchanged_coordinates(_first_place(point), depots.values()):
                raise InvalidObject(f"spec.components[{index}].controlPoints[{i}].{field}", note)
            if point.region is not None:
                check_area(point.region, f"spec.components[{index}].controlPoints[{i}].region")
    try:
        check_crossings(application.spec, route_of(application.spec, depots))
    except InvalidObject as error:
        raise InvalidObject(f"spec.{error.field}", error.problem) from None


def _first_place(point: ControlPoint) -> Point:
    if point.path:
        return point.path[0]
    assert point.region is not None  # the model requires a path or a region
    return area_center(point.region)

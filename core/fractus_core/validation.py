"""What a schema cannot say: rings that cross, zones and depots that do not exist."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from fractus_core.api import Application, Depot, InvalidObject, Policy, Zone
from fractus_core.api.geometry import Area
from fractus_core.geo import LocalFrame, area_center, area_polygon, check_extent
from fractus_core.planning.operation_area import check_crossings, route_of
from fractus_core.policy.selectors import is_attribute

MAX_WAYPOINTS = 2000
"""Waypoints and points of interest of one application: far more than a battery lasts for."""


def check_area(area: Area, field: str) -> None:
    """Refuse rings that cross themselves, holes outside, and areas of continental size.

    Raises:
        InvalidObject: with the field below `field`.
    """
    try:
        check_extent(area)
        area_polygon(LocalFrame.at(area_center(area)), area)
    except InvalidObject as error:
        raise InvalidObject(f"{field}.{error.field}", error.problem) from None


def check_zone(zone: Zone) -> None:
    """Refuse a zone whose geometry is broken.

    Raises:
        InvalidObject: naming the ring.
    """
    check_area(zone.spec.area, "spec.area")


def check_policy(policy: Policy, zones: Collection[str]) -> None:
    """Refuse a policy that selects zones which do not exist, or nodes by attributes that none can have.

    Raises:
        InvalidObject: naming the first such zone or attribute.
    """
    for i, expression in enumerate(policy.spec.selector.nodes):
        if not is_attribute(expression.key):
            holds_for = "no node" if policy.spec.kind == "grant" else "every node"
            raise InvalidObject(
                f"spec.selector.nodes[{i}].key",
                f"no Drone or EdgeNode has an attribute {expression.key}, so that this selects {holds_for}; correct the name",
            )
    for i, name in enumerate(policy.spec.selector.zones):
        if name not in zones:
            known = ", ".join(sorted(zones)[:10]) or "there is none yet"
            raise InvalidObject(
                f"spec.selector.zones[{i}]", f"there is no Zone {name} ({known}); apply it, or correct the name"
            )


def check_application(application: Application, depots: Mapping[str, Depot]) -> None:
    """Refuse an application that names unknown depots, has broken regions, or ways that cross too often.

    Raises:
        InvalidObject: naming the field.
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
            if point.region is not None:
                check_area(point.region, f"spec.components[{index}].controlPoints[{i}].region")
    try:
        check_crossings(application.spec, route_of(application.spec, depots))
    except InvalidObject as error:
        raise InvalidObject(f"spec.{error.field}", error.problem) from None

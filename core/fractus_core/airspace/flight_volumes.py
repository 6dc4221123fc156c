"""4D volumes of the flight of an application: depot, transit flights, operation area, return flight, landing places."""

from __future__ import annotations

import math
from dataclasses import dataclass

import shapely
from shapely.geometry.base import BaseGeometry

from fractus_core.airspace.volumes import Volume4D
from fractus_core.api.applications import Application
from fractus_core.api.geometry import Area, Circle, Point
from fractus_core.api.model import InvalidObject
from fractus_core.api.nodes import Drone
from fractus_core.geo import area_polygon, ground_point
from fractus_core.planning.grant_compiler import flight_grant, stand_of
from fractus_core.planning.inventory import Inventory, Settings
from fractus_core.planning.landing_places import landing_places
from fractus_core.planning.mission import MissionEstimator, altitude_limit_m
from fractus_core.planning.operation_area import OperationArea, operation_area
from fractus_core.policy.compiled_grant import altitude_above_home_m
from fractus_core.policy.decision_types import Home, Situation

_MARGIN_M = Situation(0.0).margin_m
"""Horizontal distance that the engine keeps from fences: position error plus tracking error."""

HEIGHT_MARGIN_M = Situation(0.0).height_margin_m
"""Vertical distance that the engine keeps from floors and ceilings: altitude error plus tracking error."""

_QUARTER = 8
"""Number of pieces of a quarter of a circle around a corner of an enlarged area."""


def flight_volumes(
    application: Application,
    drone: Drone,
    inventory: Inventory,
    settings: Settings,
    *,
    begin_s: float,
    end_s: float,
    floor_m: float | None = None,
    ceiling_m: float | None = None,
) -> tuple[Volume4D, ...]:
    """Return the volumes of the whole flight of an application.

    The ground area is the corridor of the drone's Grants, because the engine permits transit flights, detours and return
    flights anywhere in it. It is enlarged by the margin that the engine keeps from fences. All volumes last for the whole
    window.

    Above the depot and the landing places, the volumes begin at the ground. Elsewhere they begin at `floor_m`. The
    caller must limit the flight to `floor_m` and `ceiling_m` by its Grants.

    Args:
        application: Application that the drone flies.
        drone: The drone. Its `home` gives the altitude of the depot.
        inventory: Depots, and the policies with landing places.
        settings: Safety radius and speeds.
        begin_s: Start of the window in seconds since 1970 UTC.
        end_s: End of the window, at which the drone is home again.
        floor_m: Lowest altitude above home at a distance from depot and landing places; None: the ground.
        ceiling_m: Highest altitude above home; None: the maximum altitude of application and drone.

    Raises:
        InvalidObject: The application does not fly, an altitude is unknown or outside the limits, the mission takes longer
            than the window, or the geometry is invalid.
    """
    area = operation_area(application.spec, inventory.depots, settings.safety_radius_m)
    if area is None:
        raise InvalidObject("components", "no component runs on a drone; a flight needs one")
    limits = _altitude_limits(application, drone, floor_m, ceiling_m)
    _check_altitudes(area, limits, settings)
    mission = MissionEstimator(application.spec, area, settings).estimate(limits.place, drone)
    _check_duration(mission.needed_min * 60, end_s - begin_s)
    granted = flight_grant(application, drone, inventory, area)
    corridor = shapely.union_all(
        [area_polygon(area.frame, part) for part in (*granted.operation_area, *granted.corridor)]
    )
    upper_m = limits.home.amsl_m + limits.ceiling_m + HEIGHT_MARGIN_M
    lower_m = -math.inf
    columns: list[Area] = []
    if limits.floor_m is not None:
        lower_m = limits.home.amsl_m + limits.floor_m - HEIGHT_MARGIN_M
        columns = [stand_of(drone, inventory.depots, area)]
        columns += [
            Area(circle=Circle(center=at, radius=settings.safety_radius_m)) for _, at in landing_places(granted)
        ]
    shapes = [(corridor, lower_m), *((area_polygon(area.frame, column), -math.inf) for column in columns)]
    return tuple(
        Volume4D.of_shape(area.frame, enlarged(shape), lower_m=bottom_m, upper_m=upper_m, begin_s=begin_s, end_s=end_s)
        for shape, bottom_m in shapes
    )


@dataclass(frozen=True, slots=True)
class _AltitudeLimits:
    """Altitudes above home between which a flight stays. A floor of None is the ground."""

    place: Point
    home: Home
    floor_m: float | None
    ceiling_m: float


def _altitude_limits(
    application: Application, drone: Drone, floor_m: float | None, ceiling_m: float | None
) -> _AltitudeLimits:
    mobility = drone.spec.services.mobility
    home = drone.spec.home
    if mobility is None:
        raise InvalidObject(
            "services.mobility", f"Drone {drone.name} has no mobility service, which every flight requires"
        )
    if home is None or home.alt is None:
        raise InvalidObject(
            "home", f"the ground elevation of the home of Drone {drone.name} is unknown; set spec.home with alt"
        )
    highest_m = altitude_limit_m(application.spec, mobility) if ceiling_m is None else ceiling_m
    lowest_m = 0.0 if floor_m is None else floor_m
    # A negated comparison, so that NaN is refused.
    if not 0 <= lowest_m < highest_m <= mobility.max_altitude:
        raise InvalidObject(
            "altitudes",
            f"{lowest_m:g} to {highest_m:g} m above home is not possible for Drone {drone.name}; give a range within 0 to"
            f" {mobility.max_altitude:g} m",
        )
    return _AltitudeLimits(ground_point(home), Home(home.lat, home.lon, home.alt), floor_m, highest_m)


def _check_altitudes(area: OperationArea, limits: _AltitudeLimits, settings: Settings) -> None:
    """Refuse a route with an altitude above unknown terrain, or outside the limits."""
    for i, position in enumerate(area.route):
        if position.alt is None:
            continue
        height_m = altitude_above_home_m(position.alt, position.altitude_reference, limits.home, settings.flat_terrain)
        if height_m is None:
            raise InvalidObject(
                f"route[{i}].altitudeReference", "terrain is unknown, so no airspace can be reserved; use home or amsl"
            )
        if not (limits.floor_m or 0.0) <= height_m <= limits.ceiling_m:
            raise InvalidObject(
                f"route[{i}].alt",
                f"{height_m:.1f} m above home is outside the altitudes of the flight, {limits.floor_m or 0.0:g} to"
                f" {limits.ceiling_m:g} m",
            )


def _check_duration(needed_s: float, window_s: float) -> None:
    if not needed_s <= window_s:
        raise InvalidObject(
            "window",
            f"the flight takes {needed_s / 60:.1f} min including the way home, but the window has {window_s / 60:.1f} min;"
            " choose a longer window or a shorter route",
        )


def enlarged(shape: BaseGeometry) -> BaseGeometry:
    """Return a shape enlarged by the engine's margin. Arcs are circumscribed."""
    distance_m = _MARGIN_M / math.cos(math.pi / (4 * _QUARTER))
    enlarged: BaseGeometry = shapely.buffer(shape, distance_m, quad_segs=_QUARTER)
    return enlarged

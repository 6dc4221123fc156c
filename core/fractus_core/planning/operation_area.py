"""Operation area and route of an application (thesis Algorithm 5)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import assert_never

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from fractus_core.api.applications import ApplicationSpec
from fractus_core.api.components import ControlPoint
from fractus_core.api.geometry import Area, Circle, Point, Position
from fractus_core.api.model import InvalidObject
from fractus_core.api.nodes import Depot
from fractus_core.geo import (
    LocalFrame,
    area_center,
    area_polygon,
    center_of,
    corridor,
    count_crossings,
    ground_point,
    points_xy,
)

MAX_CROSSINGS = 50_000
"""Maximum number of crossings of paths and region edges. The union of paths and regions with this number takes about a
second, and with a hundred times as many it takes minutes. A survey of 220 lines in each direction has 50,000 crossings
and takes 0.1 s."""


@dataclass(frozen=True, slots=True)
class OperationArea:
    """The area in which an application uses its drone, in metres east and north of the frame's origin.

    Attributes:
        shape: Area above which the application may use the services of the drone.
        route: Visited positions in order, without approach and return.
        parts: Areas whose union is `shape`: one for each control point, or one for the points of interest.
        length_m: Ground distance of the route.
    """

    frame: LocalFrame
    shape: BaseGeometry
    route: tuple[Position, ...]
    parts: tuple[BaseGeometry, ...] = ()
    length_m: float = 0.0

    @property
    def start(self) -> Point:
        """First position of the route."""
        return ground_point(self.route[0])


def operation_area(spec: ApplicationSpec, depots: Mapping[str, Depot], safety_radius_m: float) -> OperationArea | None:
    """Return the operation area of an application, or None if it has no drone components.

    The area is the union of the areas of all control points, or the area of the points of interest. Paths are dilated
    by the safety radius. The area of a leg that starts at a depot includes the whole depot, because the drone may be
    parked anywhere in it. Unordered points of interest are visited on a short tour that starts with the first point.

    Raises:
        InvalidObject: A depot is unknown, a ring crosses itself, or paths and edges cross too often. The field of the
            error is relative to spec.
    """
    route = route_of(spec, depots)
    if not route:
        return None
    check_crossings(spec, route)
    frame = LocalFrame.at(center_of(route))
    parts: list[BaseGeometry] = []
    driver = spec.driver
    poi = spec.points_of_interest
    if driver is not None:
        index = spec.components.index(driver)
        for i, point in enumerate(driver.control_points):
            parts.append(
                _control_area(frame, point, depots, safety_radius_m, f"components[{index}].controlPoints[{i}]")
            )
    elif poi is not None:
        match poi.service_access:
            case "points":
                parts.append(
                    shapely.union_all([corridor(frame, [ground_point(p)], safety_radius_m) for p in poi.points])
                )
            case "path":
                parts.append(corridor(frame, [ground_point(p) for p in route], safety_radius_m))
            case _:
                assert_never(poi.service_access)
    length = length_m(frame, [ground_point(p) for p in route])
    return OperationArea(frame, shapely.union_all(parts), tuple(route), tuple(parts), length)


def check_crossings(spec: ApplicationSpec, route: Sequence[Position]) -> None:
    """Refuse an application whose operation area would take too long to compute.

    Args:
        spec: Specification of the application.
        route: Result of `route_of`.

    Raises:
        InvalidObject: Paths and region edges cross too often. The field is relative to spec.
    """
    if not route:
        return
    frame = LocalFrame.at(center_of(route))
    driver = spec.driver
    poi = spec.points_of_interest
    rings: list[Sequence[Point]] = []
    if driver is not None:
        paths: list[Sequence[Point]] = [point.path for point in driver.control_points if point.path is not None]
        areas = {point.region.polygon for point in driver.control_points if point.region is not None} - {None}
        if not paths and len(areas) < 2:
            return  # The rings of one region do not cross.
        rings = [ring for area in areas if area is not None for ring in (area.exterior, *area.holes)]
        field = f"components[{spec.components.index(driver)}].controlPoints"
    elif poi is not None and poi.service_access == "path":
        paths = [route]
        field = "components"
    else:
        return
    lines = [np.asarray(points_xy(frame, path)) for path in (*paths, *((*ring, ring[0]) for ring in rings))]
    if count_crossings(lines, MAX_CROSSINGS) > MAX_CROSSINGS:
        raise InvalidObject(
            field,
            f"paths and edges of regions cross more than {MAX_CROSSINGS} times; use fewer waypoints, or regions with fewer corners",
        )


def start_of(point: ControlPoint, depots: Mapping[str, Depot]) -> Position | None:
    """Return the start of a control point, or None if the start is open.

    Raises:
        InvalidObject: The depot is unknown.
    """
    if point.point is None:
        return None
    if point.point.position is not None:
        return point.point.position
    name = point.point.depot or ""
    if name not in depots:
        known = ", ".join(sorted(depots)[:10]) or "none"
        raise InvalidObject(
            "point.depot", f"there is no Depot {name} (existing: {known}); apply it or correct the name"
        )
    location = depots[name].spec.location
    return Position(lat=location.lat, lon=location.lon)


def control_routes(points: Sequence[ControlPoint], depots: Mapping[str, Depot]) -> list[list[Position]]:
    """Return the positions visited at each control point: its start, if any, then its path or the centre of its region.

    Raises:
        InvalidObject: A depot is unknown. The field is relative to the list.
    """
    routes = []
    for i, point in enumerate(points):
        try:
            start = start_of(point, depots)
        except InvalidObject as error:
            raise InvalidObject(f"[{i}].{error.field}", error.problem) from None
        route = [start] if start is not None else []
        route += point.path or ()
        if point.region is not None:
            centre = area_center(point.region)
            route.append(Position(lat=centre.lat, lon=centre.lon))
        routes.append(route)
    return routes


def route_of(spec: ApplicationSpec, depots: Mapping[str, Depot]) -> list[Position]:
    """Return the positions that a drone visits for an application, in order.

    Raises:
        InvalidObject: A control point names an unknown depot.
    """
    poi = spec.points_of_interest
    if spec.driver is not None:
        try:
            routes = control_routes(spec.driver.control_points, depots)
        except InvalidObject as error:
            field = f"components[{spec.components.index(spec.driver)}].controlPoints{error.field}"
            raise InvalidObject(field, error.problem) from None
        return [position for route in routes for position in route]
    if poi is None:
        return []
    if poi.ordered:
        return list(poi.points)
    frame = LocalFrame.at(center_of(poi.points))
    return [poi.points[i] for i in short_tour([frame.xy(p.lat, p.lon) for p in poi.points])]


def _control_area(
    frame: LocalFrame, point: ControlPoint, depots: Mapping[str, Depot], radius_m: float, field: str
) -> BaseGeometry:
    if point.region is not None:
        try:
            return area_polygon(frame, point.region)
        except InvalidObject as error:
            raise InvalidObject(f"{field}.region.{error.field}", error.problem) from None
    path = [ground_point(p) for p in point.path or ()]
    area = corridor(frame, path, radius_m)
    start = start_of(point, depots)
    if start is None:
        return area
    if point.point is not None and point.point.depot is not None:
        depot = depots[point.point.depot].spec
        stand = area_polygon(frame, Area(circle=Circle(center=depot.location, radius=depot.radius + radius_m)))
        return area.union(shapely.union(stand, corridor(frame, path[:1], radius_m)).convex_hull)
    return area.union(corridor(frame, [ground_point(start), *path], radius_m))


def length_m(frame: LocalFrame, points: Sequence[Point]) -> float:
    """Return the ground distance of a polyline in metres."""
    xy = [frame.xy(p.lat, p.lon) for p in points]
    return sum(math.dist(a, b) for a, b in itertools.pairwise(xy))


_MAX_EXACT = 9
_MAX_PASSES = 50


def short_tour(xy: Sequence[tuple[float, float]]) -> list[int]:
    """Return an order in which to visit points, starting with the first and ending anywhere.

    The order is optimal for up to nine points (dynamic programming, M. Held and R. Karp 1962). For more points it is a
    nearest-neighbour tour improved by 2-opt, O(n^2) per pass. The same points always give the same order.
    """
    points = np.array(xy, dtype=np.float64).reshape(-1, 2)
    distance = np.hypot(*(points[:, None, :] - points[None, :, :]).transpose(2, 0, 1))
    if len(points) <= 2:
        return list(range(len(points)))
    if len(points) <= _MAX_EXACT:
        return _shortest(distance)
    return _untangled(_greedy(distance), distance)


def _shortest(distance: NDArray[np.float64]) -> list[int]:
    count = len(distance)
    best: dict[tuple[int, int], tuple[float, tuple[int, ...]]] = {(1, 0): (0.0, (0,))}
    for size in range(1, count):
        for chosen in itertools.combinations(range(1, count), size):
            visited = 1 | sum(1 << i for i in chosen)
            for last in chosen:
                before = visited & ~(1 << last)
                best[visited, last] = min(
                    (length + float(distance[i, last]), (*tour, last))
                    for i in range(count)
                    if (before, i) in best
                    for length, tour in (best[before, i],)
                )
    full = (1 << count) - 1
    return list(min(best[full, last] for last in range(1, count))[1])


def _greedy(distance: NDArray[np.float64]) -> list[int]:
    tour = [0]
    left = np.ones(len(distance), dtype=bool)
    left[0] = False
    while left.any():
        nearest = int(np.argmin(np.where(left, distance[tour[-1]], np.inf)))
        tour.append(nearest)
        left[nearest] = False
    return tour


def _untangled(tour: list[int], distance: NDArray[np.float64]) -> list[int]:
    order = np.array(tour)
    for _ in range(_MAX_PASSES):
        improved = False
        for i in range(len(order) - 2):
            # Reverse order[i+1..j]: the edges (i, i+1) and (j, j+1) become (i, j) and (i+1, j+1); the end is open.
            a = order[i]
            b = order[i + 1]
            ends = order[i + 2 :]
            after = order[i + 3 :]
            change = distance[a, ends] - distance[a, b]
            change[:-1] += distance[b, after] - distance[ends[:-1], after]
            j = int(np.argmin(change))
            if change[j] < -1e-9:
                order[i + 1 : i + 3 + j] = order[i + 1 : i + 3 + j][::-1]
                improved = True
        if not improved:
            break
    return [int(i) for i in order]

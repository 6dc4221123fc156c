"""Missions: flight time estimates, legs, transit flights, and shared flights."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fractus_core.api.applications import Application, ApplicationSpec
from fractus_core.api.geometry import Point, Position, Reference
from fractus_core.api.nodes import Depot, Drone, MobilityFeatures
from fractus_core.api.plans import TransitLeg
from fractus_core.exhaustive import exhaustive
from fractus_core.geo import LocalFrame, center_of, distance_m
from fractus_core.planning.inventory import Flight, Settings
from fractus_core.planning.operation_area import OperationArea, control_routes
from fractus_core.policy.decision_types import Airframe


@dataclass(frozen=True, slots=True)
class Estimate:
    """Estimated flight of a mission, from the parking position of the drone and back.

    Attributes:
        distance_m: Ground distance.
        approach_m: Ground distance from the parking position to the first point.
        top_m: Maximum altitude above home.
        needed_min: Flight time in minutes.
        available_min: Available flight time in minutes, without the battery reserve.
    """

    distance_m: float
    approach_m: float
    top_m: float
    needed_min: float
    available_min: float


class MissionEstimator:
    """Estimates the mission of an application for several drones. Results for the same home are computed once."""

    def __init__(self, spec: ApplicationSpec, area: OperationArea, settings: Settings) -> None:
        self._area = area
        self._settings = settings
        self._stay_min = stay_minutes(spec)
        self._distances_by_home: dict[tuple[float, float], tuple[float, float]] = {}
        self._climbs: dict[float | None, tuple[float, float]] = {}

    def estimate(self, home: Point, drone: Drone) -> Estimate:
        """Estimate distance, altitude and time of the mission, including approach and return.

        Legs are straight. Altitude changes at the climb speed take additional time. A region adds the
        distance to its centre, and the duration that its control point declares.
        """
        approach, distance = self._distances(home)
        top, climb = self._climb(drone)
        mobility = drone.spec.services.mobility
        speed = self._settings.cruise_speed_mps
        available = 0.0
        if mobility is not None:
            speed = min(speed, Airframe().highest_command_mps(mobility.max_speed))
            available = remaining_minutes(drone) - self._settings.battery_reserve * mobility.max_flight_time
        needed = (distance / speed + climb / self._settings.climb_speed_mps) / 60 + self._stay_min
        return Estimate(distance, approach, top, needed, available)

    def _distances(self, home: Point) -> tuple[float, float]:
        key = (home.lat, home.lon)
        if key not in self._distances_by_home:
            approach = distance_m(home, self._area.route[0])
            self._distances_by_home[key] = (
                approach,
                approach + self._area.length_m + distance_m(self._area.route[-1], home),
            )
        return self._distances_by_home[key]

    def _climb(self, drone: Drone) -> tuple[float, float]:
        base = drone.spec.home.alt if drone.spec.home is not None else None
        if base not in self._climbs:
            heights = [0.0, *heights_m(self._area.route, base), 0.0]
            self._climbs[base] = (max(heights), sum(abs(b - a) for a, b in itertools.pairwise(heights)))
        return self._climbs[base]


def heights_m(route: Sequence[Position], home_amsl_m: float | None) -> list[float]:
    """Return altitudes in metres above home along a route.

    A position without altitude has the altitude of the position before it. The same applies to a position with an AMSL
    altitude if the elevation of home is unknown.
    """
    base = home_amsl_m
    heights = [0.0]
    for position in route:
        if position.alt is None or (position.altitude_reference == "amsl" and base is None):
            heights.append(heights[-1])
        elif position.altitude_reference == "amsl":
            heights.append(max(position.alt - (base or 0.0), 0.0))
        else:
            heights.append(max(position.alt, 0.0))
    return heights[1:]


def remaining_minutes(drone: Drone) -> float:
    """Return the flight time in minutes with the present charge of the battery."""
    mobility = drone.spec.services.mobility
    if mobility is None:
        return 0.0
    battery = drone.status.battery if drone.status else None
    return mobility.max_flight_time * (battery.remaining if battery else 1.0)


def altitude_limit_m(spec: ApplicationSpec, mobility: MobilityFeatures) -> float:
    """Return the maximum altitude of a flight in metres above home: the lower limit of application and drone."""
    limit_m: float = mobility.max_altitude
    return limit_m if spec.max_altitude is None else min(limit_m, spec.max_altitude)


def stay_minutes(spec: ApplicationSpec) -> float:
    """Return the total declared duration of a driver's flights in regions, in minutes."""
    return sum(p.duration or 0.0 for p in spec.driver.control_points) if spec.driver is not None else 0.0


def home_of(drone: Drone, depots: Mapping[str, Depot]) -> Position | None:
    """Return the parking position of a drone on the ground, or None if the position is unknown."""
    depot = depots.get(drone.spec.depot or "")
    position = drone.spec.home or (depot.spec.location if depot is not None else None)
    return Position(lat=position.lat, lon=position.lon) if position is not None else None


@dataclass(frozen=True, slots=True)
class MissionLeg:
    """A straight leg of a mission.

    Attributes:
        flown_by: Control authority. This is the system for the return flight, because every driver may leave the return
            to the system.
        free: True if the driver chooses its own route, in a region.
    """

    start: Position
    end: Position
    flown_by: Literal["system", "driver"]
    free: bool = False


def mission_legs(
    spec: ApplicationSpec, area: OperationArea, home: Position, depots: Mapping[str, Depot]
) -> Iterator[MissionLeg]:
    """Return the legs of a mission from the parking position of the drone and back, in order."""
    driver = spec.driver
    at = home
    if driver is None:
        for position in area.route:
            yield MissionLeg(at, position, "system")
            at = position
    for point, route in zip(
        driver.control_points if driver is not None else (),
        control_routes(driver.control_points, depots) if driver is not None else (),
        strict=True,
    ):
        for i, position in enumerate(route):
            transit = i == 0 and driver is not None and driver.control == "partial"
            roams = point.region is not None and i == len(route) - 1
            yield MissionLeg(at, position, "system" if transit else "driver", free=roams and not transit)
            at = position
    yield MissionLeg(at, home, "system")


def transit_legs(
    spec: ApplicationSpec, area: OperationArea, home: Position, depots: Mapping[str, Depot]
) -> list[TransitLeg]:
    """Return the legs that the system flies.

    These are the legs to and between the control points of a driver with partial control, or through all points of interest
    of an application without a driver, and the return flight. A driver with full control flies the whole mission.
    """
    if spec.driver is not None and spec.driver.control != "partial":
        return []
    return [
        TransitLeg(start=leg.start, end=leg.end)
        for leg in mission_legs(spec, area, home, depots)
        if leg.flown_by == "system" and (leg.start.lat, leg.start.lon) != (leg.end.lat, leg.end.lon)
    ]


def flight_of(application: Application, depots: Mapping[str, Depot]) -> Flight:
    """Return the planned flight of an application: the paths of its driver, or its points of interest.

    Raises:
        InvalidObject: A control point names an unknown depot.
    """
    spec = application.spec
    legs: list[tuple[Position, ...]] = []
    if spec.driver is not None:
        open_leg: list[Position] = []
        for point, route in zip(
            spec.driver.control_points, control_routes(spec.driver.control_points, depots), strict=True
        ):
            if point.region is not None:
                # The route to a region is known only if the control point has a start. The route out of a region is
                # never known.
                start = route[:1] if point.point is not None else []
                legs.append((*open_leg, *start))
                open_leg = []
            else:
                open_leg += route
        legs.append(tuple(open_leg))
    elif spec.points_of_interest is not None:
        legs.append(tuple(spec.points_of_interest.points))
    return Flight(application.key, tuple(leg for leg in legs if leg))


def remaining_flight(flight: Flight, position: Position, radius_m: float) -> Flight | None:
    """Return the rest of a flight from the position of its drone.

    If the path passes the position more than once, the last passage counts, so that the rest contains no visited point.

    Returns:
        The rest of the flight, or None if the drone is not near its path and its route is therefore unknown.
    """
    if not flight.legs:
        return None
    path = [p for leg in flight.legs for p in leg]
    frame = LocalFrame.at(center_of([*path, position]))
    starts, ends = _segments(frame, replace(flight, reached=0))
    near = np.flatnonzero(np.isfinite(_passages(starts, ends, _spot(frame, position, None), radius_m)[:, 0]))
    if not len(near):
        return None
    piece = int(near[-1])
    for i, leg in enumerate(flight.legs):
        pieces = max(len(leg) - 1, 1)
        if piece < pieces:
            return replace(flight, legs=((position, *leg[piece + 1 :]), *flight.legs[i + 1 :]), reached=0)
        piece -= pieces
    return None


def misses(application: Application, flight: Flight, radius_m: float) -> int | None:
    """Return the index of the first point of interest that a flight does not visit. None: the flight visits all of them."""
    poi = application.spec.points_of_interest
    if poi is None:
        return 0
    return first_missed(poi.points, flight, radius_m, ordered=poi.ordered)


def first_missed(points: Sequence[Position], flight: Flight, radius_m: float, *, ordered: bool) -> int | None:
    """Return the index of the first point that a flight does not visit, or None if it visits all points.

    A point is visited if the path passes within the radius over ground. If both the point and the path have an altitude in
    the same datum, the altitudes must also differ by at most the radius. Ordered points must be passed in their order.
    """
    path = [p for leg in flight.legs for p in leg]
    if len(path) <= flight.reached:
        return 0
    frame = LocalFrame.at(center_of([*path, *points]))
    starts, ends = _segments(frame, flight)
    at = 0.0
    for i, point in enumerate(points):
        passages = _passages(starts, ends, _spot(frame, point, point.alt), radius_m)
        index = np.arange(len(passages))
        begin = index + passages[:, 0]
        end = index + passages[:, 1]
        open_ = np.isfinite(passages[:, 0]) & (end >= at)
        if not open_.any():
            return i
        if ordered:
            at = max(at, float(begin[open_].min()))
    return None


_Spots = NDArray[np.float64]
_DATUMS: dict[Reference, float] = exhaustive(Reference, {"home": 0.0, "terrain": 1.0, "amsl": 2.0})


def _spot(frame: LocalFrame, position: Position, alt: float | None) -> list[float]:
    x, y = frame.xy(position.lat, position.lon)
    return [x, y, math.nan if alt is None else alt, _DATUMS[position.altitude_reference]]


def _segments(frame: LocalFrame, flight: Flight) -> tuple[_Spots, _Spots]:
    """Return starts and ends of the remaining segments: x, y, altitude (NaN if unknown), datum; shape (n, 4)."""
    starts = []
    ends = []
    passed = flight.reached
    for leg in flight.legs:
        spots = []
        alt: float | None = None
        for position in leg:
            alt = position.alt if position.alt is not None else alt
            spots.append(_spot(frame, position, alt))
        # The drone is between the last reached point and the next one, so the segment between them remains.
        left = spots[max(passed - 1, 0) :] if passed < len(spots) else []
        passed = max(passed - len(spots), 0)
        starts += left[:-1] or left
        ends += left[1:] or left
    return np.array(starts), np.array(ends)


def _passages(starts: _Spots, ends: _Spots, spot: Sequence[float], radius_m: float) -> _Spots:
    """Return the part of each segment within a radius of a point.

    Returns:
        Begin and end of the part as shares of the segment, shape (n, 2). Infinite if no part is within the radius.
    """
    along = ends[:, :2] - starts[:, :2]
    offset = starts[:, :2] - np.array(spot[:2])
    a = (along**2).sum(axis=1)
    b = (along * offset).sum(axis=1)
    c = (offset**2).sum(axis=1) - radius_m**2
    span = np.where(a > 0, b * b - a * c, -c)
    with np.errstate(invalid="ignore", divide="ignore"):
        root = np.sqrt(span)
        low = np.where(a > 0, (-b - root) / a, 0.0)
        high = np.where(a > 0, (-b + root) / a, 1.0)
        rise = ends[:, 2] - starts[:, 2]
        below = spot[2] - radius_m - starts[:, 2]
        above = spot[2] + radius_m - starts[:, 2]
        at = np.sort(np.column_stack((below / rise, above / rise)), axis=1)
        level = np.where((below <= 0) & (above >= 0), 0.0, np.inf)
    known = ~np.isnan(rise) & ~math.isnan(spot[2]) & (starts[:, 3] == spot[3]) & (ends[:, 3] == spot[3])
    sloped = known & (rise != 0)
    low = np.maximum(low, np.where(sloped, at[:, 0], np.where(known, level, 0.0)))
    high = np.minimum(high, np.where(sloped, at[:, 1], 1.0))
    low = np.maximum(low, 0.0)
    high = np.minimum(high, 1.0)
    never = ~(span >= 0) | ~(low <= high)
    return np.where(never[:, None], np.inf, np.column_stack((low, high)))

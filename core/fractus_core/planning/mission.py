"""What a mission asks of a drone: how long it takes, which legs the system flies, whom it can take along."""

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
from fractus_core.api.nodes import Depot, Drone
from fractus_core.api.plans import TransitLeg
from fractus_core.exhaustive import exhaustive
from fractus_core.geo import LocalFrame, center_of, distance_m
from fractus_core.planning.inventory import Flight, Settings
from fractus_core.planning.operation_area import OperationArea, control_routes


@dataclass(frozen=True, slots=True)
class Estimate:
    """What a mission takes of a drone, from its stand and back to it.

    Attributes:
        distance_m: over ground.
        approach_m: of it from the stand to the first point.
        top_m: the highest point, above home.
        needed_min: minutes of flight.
        available_min: minutes that the drone can fly with its reserve kept.
    """

    distance_m: float
    approach_m: float
    top_m: float
    needed_min: float
    available_min: float


class MissionEstimator:
    """What an application asks of a drone; what does not depend on the drone is found once."""

    def __init__(self, spec: ApplicationSpec, area: OperationArea, settings: Settings) -> None:
        self._area = area
        self._settings = settings
        self._stay_min = stay_minutes(spec)
        self._ways: dict[tuple[float, float], tuple[float, float]] = {}
        self._climbs: dict[float | None, tuple[float, float]] = {}

    def estimate(self, home: Point, drone: Drone) -> Estimate:
        """Length, climb and time of the whole mission, with the way to the first point and home from the last.

        Legs are straight; altitudes are gained and lost at the climb speed on top of the time over ground; a region
        counts with the way to its middle and the stay its control point declares.
        """
        approach, distance = self._way(home)
        top, climb = self._climb(drone)
        mobility = drone.spec.services.mobility
        speed, available = self._settings.cruise_speed_mps, 0.0
        if mobility is not None:
            speed = min(speed, mobility.max_speed)
            available = remaining_minutes(drone) - self._settings.battery_reserve * mobility.max_flight_time
        needed = (distance / speed + climb / self._settings.climb_speed_mps) / 60 + self._stay_min
        return Estimate(distance, approach, top, needed, available)

    def _way(self, home: Point) -> tuple[float, float]:
        key = (home.lat, home.lon)
        if key not in self._ways:
            approach = distance_m(home, self._area.route[0])
            self._ways[key] = (approach, approach + self._area.length_m + distance_m(self._area.route[-1], home))
        return self._ways[key]

    def _climb(self, drone: Drone) -> tuple[float, float]:
        base = drone.spec.home.alt if drone.spec.home is not None else None
        if base not in self._climbs:
            heights = [0.0, *heights_m(self._area.route, base), 0.0]
            self._climbs[base] = (max(heights), sum(abs(b - a) for a, b in itertools.pairwise(heights)))
        return self._climbs[base]


def heights_m(route: Sequence[Position], home_amsl_m: float | None) -> list[float]:
    """Metres above home along a route; unset keeps the altitude, and one above sea level counts if home's is known."""
    base = home_amsl_m
    heights = [0.0]
    for place in route:
        if place.alt is None or (place.altitude_reference == "amsl" and base is None):
            heights.append(heights[-1])
        elif place.altitude_reference == "amsl":
            heights.append(max(place.alt - (base or 0.0), 0.0))
        else:
            heights.append(max(place.alt, 0.0))
    return heights[1:]


def remaining_minutes(drone: Drone) -> float:
    """Minutes the drone can fly with what its battery holds."""
    mobility = drone.spec.services.mobility
    if mobility is None:
        return 0.0
    battery = drone.status.battery if drone.status else None
    return mobility.max_flight_time * (battery.remaining if battery else 1.0)


def stay_minutes(spec: ApplicationSpec) -> float:
    """Minutes that a driver will move in the regions of its control points."""
    return sum(p.duration or 0.0 for p in spec.driver.control_points) if spec.driver is not None else 0.0


def home_of(drone: Drone, depots: Mapping[str, Depot]) -> Position | None:
    """Where a drone stands, on the ground; None where that is not known."""
    depot = depots.get(drone.spec.depot or "")
    place = drone.spec.home or (depot.spec.location if depot is not None else None)
    return Position(lat=place.lat, lon=place.lon) if place is not None else None


@dataclass(frozen=True, slots=True)
class MissionLeg:
    """A straight piece of a mission.

    Attributes:
        flown_by: the way home counts as the system's, for any application may leave it to the system.
        free: the driver finds its own way there, in a region.
    """

    start: Position
    end: Position
    flown_by: Literal["system", "driver"]
    free: bool = False


def mission_legs(
    spec: ApplicationSpec, area: OperationArea, home: Position, depots: Mapping[str, Depot]
) -> Iterator[MissionLeg]:
    """The legs from the drone's stand and back to it, in order."""
    driver, at = spec.driver, home
    if driver is None:
        for place in area.route:
            yield MissionLeg(at, place, "system")
            at = place
    for point, route in zip(
        driver.control_points if driver is not None else (),
        control_routes(driver.control_points, depots) if driver is not None else (),
        strict=True,
    ):
        for i, place in enumerate(route):
            transit = i == 0 and driver is not None and driver.control == "partial"
            roams = point.region is not None and i == len(route) - 1
            yield MissionLeg(at, place, "system" if transit else "driver", free=roams and not transit)
            at = place
    yield MissionLeg(at, home, "system")


def transit_legs(
    spec: ApplicationSpec, area: OperationArea, home: Position, depots: Mapping[str, Depot]
) -> list[TransitLeg]:
    """The legs that the system flies itself.

    To and between the control points of a driver with partial control, through all points of interest of an
    application without a driver, and home from there. A driver with full control flies all of it.
    """
    if spec.driver is not None and spec.driver.control != "partial":
        return []
    return [
        TransitLeg(start=leg.start, end=leg.end)
        for leg in mission_legs(spec, area, home, depots)
        if leg.flown_by == "system" and (leg.start.lat, leg.start.lon) != (leg.end.lat, leg.end.lon)
    ]


def flight_of(application: Application, depots: Mapping[str, Depot]) -> Flight:
    """What a drone flies for an application: its driver's paths, or its points of interest.

    Raises:
        InvalidObject: a control point names an unknown depot.
    """
    spec = application.spec
    legs: list[tuple[Position, ...]] = []
    if spec.driver is not None:
        open_leg: list[Position] = []
        for point, route in zip(
            spec.driver.control_points, control_routes(spec.driver.control_points, depots), strict=True
        ):
            if point.region is not None:
                # The way to a region is known only if it has a start; the way out of it never is.
                start = route[:1] if point.point is not None else []
                legs.append((*open_leg, *start))
                open_leg = []
            else:
                open_leg += route
        legs.append(tuple(open_leg))
    elif spec.points_of_interest is not None:
        legs.append(tuple(spec.points_of_interest.points))
    return Flight(application.key, tuple(leg for leg in legs if leg))


def ahead(flight: Flight, place: Position, radius_m: float) -> Flight | None:
    """What is left of a flight whose drone is at a place: from there on, along the path.

    Where the path passes the place more than once, the last passage counts, so that no application is promised what may lie behind.

    Returns:
        The rest of the flight; None where the drone is nowhere near its path, so that nothing is known of its way.
    """
    if not flight.legs:
        return None
    path = [p for leg in flight.legs for p in leg]
    frame = LocalFrame.at(center_of([*path, place]))
    starts, ends = _segments(frame, replace(flight, reached=0))
    near = np.flatnonzero(np.isfinite(_passages(starts, ends, _spot(frame, place, None), radius_m)[:, 0]))
    if not len(near):
        return None
    piece = int(near[-1])
    for i, leg in enumerate(flight.legs):
        pieces = max(len(leg) - 1, 1)
        if piece < pieces:
            return replace(flight, legs=((place, *leg[piece + 1 :]), *flight.legs[i + 1 :]), reached=0)
        piece -= pieces
    return None


def misses(application: Application, flight: Flight, radius_m: float) -> int | None:
    """The first point of interest of an application that a flight does not visit; None if it can come along."""
    poi = application.spec.points_of_interest
    if poi is None:
        return 0
    return first_missed(poi.points, flight, radius_m, ordered=poi.ordered)


def first_missed(points: Sequence[Position], flight: Flight, radius_m: float, *, ordered: bool) -> int | None:
    """The first of some points that a flight does not visit, None if it visits all.

    A point is visited where the path passes within the radius over ground, and within the radius of its altitude if
    both the point and the path there have one of the same datum. Ordered points must be passed in their order.
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
        begin, end = index + passages[:, 0], index + passages[:, 1]
        open_ = np.isfinite(passages[:, 0]) & (end >= at)
        if not open_.any():
            return i
        if ordered:
            at = max(at, float(begin[open_].min()))
    return None


_Spots = NDArray[np.float64]
_DATUMS: dict[Reference, float] = exhaustive(Reference, {"home": 0.0, "terrain": 1.0, "amsl": 2.0})


def _spot(frame: LocalFrame, place: Position, alt: float | None) -> list[float]:
    x, y = frame.xy(place.lat, place.lon)
    return [x, y, math.nan if alt is None else alt, _DATUMS[place.altitude_reference]]


def _segments(frame: LocalFrame, flight: Flight) -> tuple[_Spots, _Spots]:
    """Starts and ends of the pieces of path that lie ahead: x, y, altitude (nan if unknown), datum; shape (n, 4)."""
    starts, ends = [], []
    passed = flight.reached
    for leg in flight.legs:
        spots = []
        alt: float | None = None
        for place in leg:
            alt = place.alt if place.alt is not None else alt
            spots.append(_spot(frame, place, alt))
        # The drone is between the last point reached and the next, so the piece between them counts.
        ahead = spots[max(passed - 1, 0) :] if passed < len(spots) else []
        passed = max(passed - len(spots), 0)
        starts += ahead[:-1] or ahead
        ends += ahead[1:] or ahead
    return np.array(starts), np.array(ends)


def _passages(starts: _Spots, ends: _Spots, spot: Sequence[float], radius_m: float) -> _Spots:
    """From where to where (0 to 1) each piece of path is near a spot; inf where it never is. Shape (n, 2)."""
    along = ends[:, :2] - starts[:, :2]
    offset = starts[:, :2] - np.array(spot[:2])
    a, b = (along**2).sum(axis=1), (along * offset).sum(axis=1)
    c = (offset**2).sum(axis=1) - radius_m**2
    span = np.where(a > 0, b * b - a * c, -c)
    with np.errstate(invalid="ignore", divide="ignore"):
        root = np.sqrt(span)
        low = np.where(a > 0, (-b - root) / a, 0.0)
        high = np.where(a > 0, (-b + root) / a, 1.0)
        rise = ends[:, 2] - starts[:, 2]
        below, above = spot[2] - radius_m - starts[:, 2], spot[2] + radius_m - starts[:, 2]
        at = np.sort(np.column_stack((below / rise, above / rise)), axis=1)
        level = np.where((below <= 0) & (above >= 0), 0.0, np.inf)
    known = ~np.isnan(rise) & ~math.isnan(spot[2]) & (starts[:, 3] == spot[3]) & (ends[:, 3] == spot[3])
    sloped = known & (rise != 0)
    low = np.maximum(low, np.where(sloped, at[:, 0], np.where(known, level, 0.0)))
    high = np.minimum(high, np.where(sloped, at[:, 1], 1.0))
    low, high = np.maximum(low, 0.0), np.minimum(high, 1.0)
    never = ~(span >= 0) | ~(low <= high)
    return np.where(never[:, None], np.inf, np.column_stack((low, high)))

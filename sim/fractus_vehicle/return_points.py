"""Destination of return flights: home or a rally point."""

from __future__ import annotations

import math
from dataclasses import dataclass

from fractus_services.mavlink_server.mission_items import Item

from fractus_vehicle.earth import Place
from fractus_vehicle.state import VehicleState


@dataclass(frozen=True, slots=True)
class ReturnPoint:
    """Destination of a return flight.

    Attributes:
        north: Local position in metres.
        east: Local position in metres.
        base_down: Local height of home, the reference of return altitudes.
        altitude_m: Minimum return altitude above home.
    """

    north: float
    east: float
    base_down: float
    altitude_m: float

    def distance_m(self, position: tuple[float, float]) -> float:
        """Return the horizontal distance in metres."""
        return math.dist((self.north, self.east), position)


def reachable_rally_points(v: VehicleState) -> list[ReturnPoint]:
    """Return the rally points within RALLY_LIMIT_KM of the vehicle."""
    origin = v.origin or v.start
    home = v.home or origin
    position = (v.est.north, v.est.east)
    limit_m = v.params["RALLY_LIMIT_KM"] * 1000.0
    rallies = [_rally(v, item, origin, home) for item in v.rally.items]
    return [rally for rally in rallies if limit_m <= 0.0 or rally.distance_m(position) <= limit_m]


def return_point(v: VehicleState) -> ReturnPoint:
    """Return home, or the nearest rally point within RALLY_LIMIT_KM."""
    origin = v.origin or v.start
    home = v.home or origin
    position = (v.est.north, v.est.east)
    at_home = ReturnPoint(*origin.vector_to(home), altitude_m=0.0)
    reachable = reachable_rally_points(v)
    if not reachable:
        return at_home
    nearest = min(reachable, key=lambda rally: rally.distance_m(position))
    home_is_near = at_home.distance_m(position) <= nearest.distance_m(position)
    return at_home if int(v.params["RALLY_INCL_HOME"]) and home_is_near else nearest


def _rally(v: VehicleState, item: Item, origin: Place, home: Place) -> ReturnPoint:
    north, east, base_down = origin.vector_to(Place(item.x, item.y, home.alt_m))
    base = v.altitude_base_m(item.frame)
    altitude_m = item.z if base is None else base + item.z - home.alt_m
    return ReturnPoint(north, east, base_down, altitude_m)

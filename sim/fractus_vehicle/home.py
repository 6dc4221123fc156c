"""Home position and the destination of return flights: home or a rally point."""

from __future__ import annotations

import math
from dataclasses import dataclass

from fractus_vehicle.earth import Place, valid_place
from fractus_vehicle.mission_items import Item
from fractus_vehicle.state import VehicleState
from fractus_vehicle.telemetry import send_on_all


def set_home(v: VehicleState, place: Place) -> None:
    """Set the home position, also in the mission, and send HOME_POSITION and GPS_GLOBAL_ORIGIN."""
    v.home = place
    v.mission.set_home(place)
    send_on_all(v, "HOME_POSITION")
    send_on_all(v, "GPS_GLOBAL_ORIGIN")


def set_home_to_position(v: VehicleState) -> bool:
    """Set home to the current position and keep it on arming. Return False if the position is unknown."""
    if not v.position_ok:
        return False
    v.home_locked = True
    set_home(v, v.place)
    return True


def set_home_at(v: VehicleState, lat_e7: int, lon_e7: int, alt_amsl_m: float) -> bool:
    """Set home to a given position and keep it on arming.

    Returns:
        False if the position is invalid or the estimator has no origin yet.
    """
    if not valid_place(lat_e7, lon_e7, alt_amsl_m) or (lat_e7 == 0 and lon_e7 == 0) or v.origin is None:
        return False
    v.home_locked = True
    set_home(v, Place(lat_e7, lon_e7, alt_amsl_m))
    return True


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


def return_point(v: VehicleState) -> ReturnPoint:
    """Return home, or the nearest rally point within RALLY_LIMIT_KM."""
    origin = v.origin or v.start
    home = v.home or origin
    position = (v.est.north, v.est.east)
    at_home = ReturnPoint(*origin.vector_to(home), altitude_m=0.0)
    limit_m = v.params["RALLY_LIMIT_KM"] * 1000.0
    rallies = [_rally(v, item, origin, home) for item in v.rally.items]
    reachable = [rally for rally in rallies if limit_m <= 0.0 or rally.distance_m(position) <= limit_m]
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

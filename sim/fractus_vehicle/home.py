"""Home position."""

from __future__ import annotations

from fractus_vehicle.earth import Place, valid_place
from fractus_vehicle.state import VehicleState
from fractus_vehicle.telemetry import send_on_all


def set_home(v: VehicleState, place: Place) -> None:
    """Set the home position, also in the mission, and send HOME_POSITION and GPS_GLOBAL_ORIGIN."""
    v.home = place
    v.mission.set_home(place.lat_e7, place.lon_e7, place.alt_m)
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

"""The state of the drone as the policy engine judges it."""

from __future__ import annotations

from dataclasses import replace

from fractus_core.policy.values import Airframe, Situation

from fractus_services.mobility.authority.control import Control


def situation_of(control: Control, time_s: float) -> Situation:
    """The state of the drone at this moment; a stale position counts as unknown.

    Args:
        control: the drone.
        time_s: Unix time, by which policies have schedules; positions age by the monotonic clock.
    """
    autopilot, vehicle, motion = control.autopilot, control.autopilot.vehicle, control.motion
    airframe = control.checked.airframe if control.checked is not None else Airframe()
    if airframe.retraces and not control.retraces:
        airframe = replace(airframe, retraces=False)
    unlocated = Situation(
        time_s=time_s,
        home=vehicle.home,
        armed=vehicle.armed,
        in_air=vehicle.in_air,
        airframe=airframe,
        altitude_m=vehicle.altitude_m,
        speed_setpoint_mps=control.cruise_mps,
    )
    if not vehicle.position_fresh(autopilot.now):
        return unlocated
    return replace(
        unlocated,
        lat=vehicle.lat,
        lon=vehicle.lon,
        north_mps=vehicle.north_mps,
        east_mps=vehicle.east_mps,
        down_mps=vehicle.down_mps,
        position_error_m=vehicle.position_error_m,
        forward_mps2=vehicle.forward_mps2,
        vertical=motion is not None and motion.kind in {"Takeoff", "Land", "ReturnToLaunch"},
    )

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
    autopilot, motion = control.autopilot, control.motion
    airframe = control.checked.airframe if control.checked is not None else Airframe()
    if airframe.retraces and not control.retraces:
        airframe = replace(airframe, retraces=False)
    vertical = motion is not None and motion.kind in {"Takeoff", "Land", "ReturnToLaunch"}
    now = autopilot.vehicle.situation(time_s, airframe, control.cruise_mps, vertical)
    if autopilot.vehicle.position_fresh(autopilot.now):
        return now
    return Situation(
        time_s=now.time_s,
        home=now.home,
        armed=now.armed,
        in_air=now.in_air,
        airframe=airframe,
        altitude_m=now.altitude_m,
        speed_setpoint_mps=now.speed_setpoint_mps,
    )

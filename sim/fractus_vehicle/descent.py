"""Landing descent: first fast, then slow near the ground. The vehicle disarms after touchdown."""

from __future__ import annotations

import math

from fractus_vehicle.shaping import clamp
from fractus_vehicle.state import CONTROL_STEP_S, VehicleState

LANDING_CONFIRMED_S = 1.0


def descend(v: VehicleState, *, disarm: bool = True) -> None:
    """Descend for one control step as in LAND: fast at first, slowly below LAND_ALT_LOW. Stop the motors after touchdown.

    Args:
        v: State of the vehicle.
        disarm: False to keep the motors running after touchdown, for a mission that takes off again.
    """
    p = v.params
    slow = p["LAND_SPEED"] / 100.0
    high = (p["LAND_SPEED_HIGH"] / 100.0) or v.control.limits.sink_mps
    low_m = max(p["LAND_ALT_LOW"] / 100.0, 1.0)
    above = v.height_m - low_m
    speed = slow
    if above > 0.0:
        speed = clamp(slow + math.sqrt(2.0 * 0.7 * v.control.limits.accel_z_mps2 * above), slow, max(high, slow))
    v.control.climb(speed)
    if v.body.on_ground:
        v.touch_time_s += CONTROL_STEP_S
        if v.touch_time_s >= LANDING_CONFIRMED_S:
            v.land_complete()
            if disarm:
                v.disarm()
    else:
        v.touch_time_s = 0.0

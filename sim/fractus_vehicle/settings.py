"""Conversion of parameters to settings of controllers, fence, battery and wind."""

from __future__ import annotations

import math

from fractus_vehicle.body import Wind
from fractus_vehicle.control import Control
from fractus_vehicle.fence import Fence
from fractus_vehicle.params import Parameters
from fractus_vehicle.sensors import Battery
from fractus_vehicle.shaping import clamp

# Share of PSC_JERK_XY that is used for position targets. The attitude controllers need the rest.
JERK_SHARE = 0.75

# Share of PSC_VELXY_P and PSC_VELXY_I that takes effect, because the attitude follows with a delay. Fitted to a real
# ArduCopter, which exceeds a commanded speed by up to 5 %, and flies 0.5 m past a target.
VELOCITY_GAIN_SHARE = 0.45

# AVOID_ENABLE bit: limit velocities at the fence.
AVOID_FENCE = 1

LIMIT_PREFIXES = frozenset({"WPNAV", "PSC", "ANGLE", "ATC", "MOT", "LOIT"})


def leg_speeds_mps(params: Parameters) -> tuple[float, float, float]:
    """Return the speeds of mission legs in m/s: horizontal, up and down."""
    return (
        max(params["WPNAV_SPEED"] / 100.0, 0.2),
        max(params["WPNAV_SPEED_UP"] / 100.0, 0.1),
        max(params["WPNAV_SPEED_DN"] / 100.0, 0.1),
    )


def set_limits(params: Parameters, control: Control) -> None:
    """Set motion limits and gains of the controllers."""
    limits = control.limits
    gains = control.gains
    limits.speed_mps, limits.climb_mps, limits.sink_mps = leg_speeds_mps(params)
    limits.accel_mps2 = max(params["WPNAV_ACCEL"] / 100.0, 0.5)
    limits.accel_z_mps2 = max(params["WPNAV_ACCEL_Z"] / 100.0, 0.5)
    limits.velocity_jerk_mps3 = max(params["PSC_JERK_XY"], 1.0)
    limits.jerk_mps3 = JERK_SHARE * limits.velocity_jerk_mps3
    lean_deg = params["PSC_ANGLE_MAX"] or params["ANGLE_MAX"] / 100.0
    limits.tilt_max_rad = math.radians(clamp(lean_deg, 10.0, 80.0))
    limits.yaw_rate_rps = math.radians(clamp(params["ATC_SLEW_YAW"] / 100.0, 5.0, 180.0))
    gains.position = clamp(params["PSC_POSXY_P"], 0.2, 3.0)
    gains.velocity = VELOCITY_GAIN_SHARE * clamp(params["PSC_VELXY_P"], 0.1, 6.0)
    gains.velocity_i = VELOCITY_GAIN_SHARE * clamp(params["PSC_VELXY_I"], 0.0, 2.0)


def set_fence(params: Parameters, fence: Fence, changed: str = "FENCE_ENABLE") -> None:
    """Set the limits of the fence.

    Only a change of FENCE_ENABLE enables or disables the fence. Otherwise, other changes could undo a command.
    """
    if changed == "FENCE_ENABLE":
        fence.enabled = int(params["FENCE_ENABLE"]) != 0
    fence.types = int(params["FENCE_TYPE"])
    fence.alt_max_m = params["FENCE_ALT_MAX"]
    fence.alt_min_m = params["FENCE_ALT_MIN"]
    fence.radius_m = params["FENCE_RADIUS"]
    fence.margin_m = max(params["FENCE_MARGIN"], 0.0)
    fence.avoid = bool(int(params["AVOID_ENABLE"]) & AVOID_FENCE)


def accelerometers_differ(params: Parameters) -> bool:
    """Return True if the biases of the first two accelerometers differ by more than ARMING_ACCTHRESH.

    The vertical axis counts half, as in ArduPilot's check.
    """
    x, y, z = (params[f"SIM_ACC1_BIAS_{axis}"] - params[f"SIM_ACC2_BIAS_{axis}"] for axis in "XYZ")
    return math.hypot(x, y, 0.5 * z) > params["ARMING_ACCTHRESH"]


def set_battery(params: Parameters, battery: Battery) -> None:
    """Set capacity and full voltage of the battery."""
    battery.capacity_mah = max(params["BATT_CAPACITY"], 1.0)
    battery.full_v = params["SIM_BATT_VOLTAGE"]
    battery.pack_mah = 1000.0 * max(params["SIM_BATT_CAP_AH"], 0.0)


def set_wind(params: Parameters, wind: Wind) -> None:
    """Set mean wind and turbulence."""
    wind.speed_mps = max(params["SIM_WIND_SPD"], 0.0)
    wind.from_deg = params["SIM_WIND_DIR"]
    wind.turbulence_mps = max(params["SIM_WIND_TURB"], 0.0)

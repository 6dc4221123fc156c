"""Why a vehicle would not arm: ArduCopter's checks before the motors start, in its order and words."""

from __future__ import annotations

from fractus_mavlink.enums import COPTER_MODE, GPS_FIX_TYPE

from fractus_vehicle.state import VehicleState

# The modes that fly without knowing where they are.
WITHOUT_POSITION = frozenset({COPTER_MODE.STABILIZE, COPTER_MODE.ALT_HOLD, COPTER_MODE.LAND})


def arming_refusal(v: VehicleState) -> str | None:
    """Why the vehicle would not arm now: the first check that fails, or None."""
    volts, failsafes, params = v.battery.voltage_v, v.failsafes, v.params
    needs_position = v.mode not in WITHOUT_POSITION
    checks = (
        (not v.estimator.healthy, "AHRS: EKF3 not healthy"),
        (needs_position and v.gps.fix_type < GPS_FIX_TYPE.TYPE_3D_FIX, "GPS 1: Bad fix"),
        (not v.position_ok and (needs_position or v.fence.enabled), "Need Position Estimate"),
        (not v.estimator.ready, "AHRS: waiting for home"),
        (0.0 < volts < params["BATT_ARM_VOLT"], "Battery 1 below minimum arming voltage"),
        (failsafes.battery, "Battery 1 low voltage failsafe"),
        (volts < params["BATT_CRT_VOLT"], "Battery 1 critical voltage failsafe"),
        (failsafes.gcs, "GCS failsafe on"),
        (failsafes.radio, "Radio failsafe on"),
        (
            v.home is not None and bool(v.fence.outside(v.est.north, v.est.east, 0.0, v.home_xy)),
            "Vehicle outside fence",
        ),
    )
    return next((text for failed, text in checks if failed), None)

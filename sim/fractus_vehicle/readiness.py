"""Arming checks of ArduCopter, in its order and wording."""

from __future__ import annotations

from collections.abc import Iterator
from enum import IntFlag

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle.copter import TRAITS, mode_title
from fractus_vehicle.return_points import reachable_rally_points
from fractus_vehicle.sensors import GPS_HDOP
from fractus_vehicle.state import VehicleState


class Check(IntFlag):
    """Bits of ARMING_CHECK. 0 disables all but the mandatory checks."""

    ALL = 1
    COMPASS = 4
    GPS = 8
    INS = 16
    PARAMETERS = 32
    RC = 64
    VOLTAGE = 128
    BATTERY = 256
    MISSION = 1 << 14


# Bits of ARMING_MIS_ITEMS: an item that the mission must contain, with its name in the refusal. Bit 5: a rally point.
REQUIRED_ITEMS = (
    (1, mavlink.MAV_CMD_NAV_LAND, "land"),
    (2, mavlink.MAV_CMD_NAV_VTOL_LAND, "vtol land"),
    (4, mavlink.MAV_CMD_DO_LAND_START, "do land start"),
    (8, mavlink.MAV_CMD_NAV_TAKEOFF, "takeoff"),
    (16, mavlink.MAV_CMD_NAV_VTOL_TAKEOFF, "vtol takeoff"),
    (64, mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH, "RTL"),
)
REQUIRED_RALLY_POINT = 32
# AHRS_EKF_TYPE: the sources of attitude and position that a simulated ArduCopter has, and DCM, without a position.
EKF_TYPES = frozenset({3, 10})
DCM = 0
# Permitted lean angles (ANGLE_MAX) in hundredths of a degree, and least trigger of the throttle failsafe.
ANGLE_MAX_CDEG = range(1000, 8001)
THROTTLE_FAILSAFE_MIN_US = 910
THROTTLE_FAILSAFE_GAP_US = 10
COMPASSES = ("", "2", "3")


def arming_refusals(v: VehicleState) -> list[str]:
    """Return the texts of all failing checks, in reporting order. Empty if the vehicle is ready to arm."""
    if int(v.params["FRAME_CLASS"]) == 0:
        return ["Motors: Check frame class and type"]
    if int(v.params["ARMING_CHECK"]) == 0:
        return mandatory_refusals(v)
    return [
        *_parameter_refusals(v),
        *_failsafe_refusals(v),
        *_altitude_refusals(v),
        *_sensor_refusals(v),
        *_battery_refusals(v),
        *_mission_refusals(v),
        *_fence_refusals(v),
    ]


def mandatory_refusals(v: VehicleState) -> list[str]:
    """Return the texts of failing checks that also apply to forced arming."""
    return [*_position_refusals(v), *_altitude_refusals(v)]


def mode_refusal(v: VehicleState) -> str | None:
    """Return the refusal if the current mode does not allow arming, or None.

    Call this after all other checks have passed.
    """
    return None if TRAITS[v.mode].arms else f"{mode_title(v.mode)} mode not armable"


def _checks(v: VehicleState, check: Check) -> bool:
    return bool(int(v.params["ARMING_CHECK"]) & (check | Check.ALL))


def _parameter_refusals(v: VehicleState) -> Iterator[str]:
    """Check parameters that would make a flight unsafe. Only the first invalid one is reported."""
    p = v.params
    if not _checks(v, Check.PARAMETERS):
        return
    trigger_us = p["FS_THR_VALUE"]
    too_high = p["RC3_MIN"] <= trigger_us + THROTTLE_FAILSAFE_GAP_US
    if int(p["FS_THR_ENABLE"]) and (too_high or trigger_us < THROTTLE_FAILSAFE_MIN_US):
        yield "Check FS_THR_VALUE"
    elif int(p["ANGLE_MAX"]) not in ANGLE_MAX_CDEG:
        yield "Check ANGLE_MAX"
    elif p["ACRO_BAL_ROLL"] > p["ATC_ANG_RLL_P"] or p["ACRO_BAL_PITCH"] > p["ATC_ANG_PIT_P"]:
        yield "Check ACRO_BAL_ROLL/PITCH"
    elif p["PILOT_SPEED_UP"] <= 0.0:
        yield "Check PILOT_SPEED_UP"


def _failsafe_refusals(v: VehicleState) -> Iterator[str]:
    if v.failsafes.gcs:
        yield "GCS failsafe on"
    if int(v.params["FS_THR_ENABLE"]) and v.throttle_below_failsafe and _checks(v, Check.RC):
        yield "Throttle below failsafe"
    if v.failsafes.radio:
        yield "Radio failsafe on"


def _altitude_refusals(v: VehicleState) -> Iterator[str]:
    if not TRAITS[v.mode].manual_throttle and not (v.estimator.aligned and _uses_ekf(v)):
        yield "Need Alt Estimate"


def _sensor_refusals(v: VehicleState) -> Iterator[str]:
    if _checks(v, Check.INS):
        if not v.estimator.consistent or v.time_s < v.accels_agree_from_s:
            yield "Accels inconsistent"
        if not v.estimator.aligned or not _uses_ekf(v):
            yield "EKF attitude is bad"
    if _checks(v, Check.COMPASS) and not _compass_healthy(v):
        yield "Compass not healthy"
    needs_position = TRAITS[v.mode].needs_position or _fence_needs_position(v)
    no_fix = needs_position and v.estimator.consistent and v.gps.fix_type < mavlink.GPS_FIX_TYPE_3D_FIX
    if no_fix and _checks(v, Check.GPS):
        yield "GPS 1: Bad fix"
    else:
        refusals = list(_position_refusals(v))
        yield from refusals
        if not refusals and needs_position and _checks(v, Check.GPS) and v.params["GPS_HDOP_GOOD"] < GPS_HDOP:
            yield "High GPS HDOP"


def _uses_ekf(v: VehicleState) -> bool:
    return int(v.params["AHRS_EKF_TYPE"]) in EKF_TYPES


def _compass_healthy(v: VehicleState) -> bool:
    """Return True if the first compass in use works, or no compass is in use."""
    p = v.params
    if not int(p["COMPASS_ENABLE"]):
        return True
    used = (number for number, suffix in enumerate(COMPASSES, start=1) if int(p[f"COMPASS_USE{suffix}"]))
    first = next(used, None)
    return first is None or not int(p[f"SIM_MAG{first}_FAIL"])


def _position_refusals(v: VehicleState) -> Iterator[str]:
    other_type = not _uses_ekf(v) and int(v.params["AHRS_EKF_TYPE"]) != DCM
    if not v.estimator.active or other_type:
        yield "AHRS: not using configured AHRS type"
    elif v.home is None:
        yield "AHRS: waiting for home"
    elif v.position_ok and _uses_ekf(v):
        return
    elif TRAITS[v.mode].needs_position:
        yield "Need Position Estimate"
    elif _fence_needs_position(v):
        yield "Fence enabled, need position estimate"


def _fence_needs_position(v: VehicleState) -> bool:
    return v.fence.enabled and bool(v.fence.types & (mavlink.FENCE_TYPE_CIRCLE | mavlink.FENCE_TYPE_POLYGON))


def _battery_refusals(v: VehicleState) -> Iterator[str]:
    volts = v.battery.voltage_v
    left_mah = v.battery.capacity_mah - v.battery.used_mah
    p = v.params
    if _checks(v, Check.BATTERY):
        if 0.0 < volts < p["BATT_ARM_VOLT"]:
            yield "Battery 1 below minimum arming voltage"
        elif p["BATT_ARM_MAH"] > 0.0 and left_mah < p["BATT_ARM_MAH"]:
            yield "Battery 1 below minimum arming capacity"
        elif 0.0 < volts < p["BATT_CRT_VOLT"]:
            yield "Battery 1 critical voltage failsafe"
        elif 0.0 < volts < p["BATT_LOW_VOLT"]:
            yield "Battery 1 low voltage failsafe"
        elif p["BATT_CRT_MAH"] > 0.0 and left_mah < p["BATT_CRT_MAH"]:
            yield "Battery 1 critical capacity failsafe"
        elif p["BATT_LOW_MAH"] > 0.0 and left_mah < p["BATT_LOW_MAH"]:
            yield "Battery 1 low capacity failsafe"
    if v.failsafes.battery and _checks(v, Check.VOLTAGE):
        yield "Battery failsafe"


def _mission_refusals(v: VehicleState) -> Iterator[str]:
    """Check that the mission contains the items of ARMING_MIS_ITEMS. Only the first missing item is reported."""
    required = int(v.params["ARMING_MIS_ITEMS"])
    if not _checks(v, Check.MISSION):
        return
    commands = {item.command for item in v.mission.items[1:]}
    missing = [title for bit, command, title in REQUIRED_ITEMS if required & bit and command not in commands]
    if missing:
        yield f"Missing mission item: {missing[0]}"
    elif required & REQUIRED_RALLY_POINT and not reachable_rally_points(v):
        yield "No sufficiently close rally point located"


def _fence_refusals(v: VehicleState) -> Iterator[str]:
    if v.home is not None and v.fence.outside(v.est.north, v.est.east, v.altitude_m, v.home_xy):
        yield "Vehicle outside Fence"

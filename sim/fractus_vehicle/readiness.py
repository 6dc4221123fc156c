"""Arming checks of ArduCopter, in its order and wording."""

from __future__ import annotations

from collections.abc import Iterator
from enum import IntFlag

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle.copter import TRAITS, mode_title
from fractus_vehicle.state import VehicleState


class Check(IntFlag):
    """Bits of ARMING_CHECK. 0 disables all but the mandatory checks."""

    ALL = 1
    GPS = 8
    INS = 16
    VOLTAGE = 128
    BATTERY = 256


def arming_refusals(v: VehicleState) -> list[str]:
    """Return the texts of all failing checks, in reporting order. Empty if the vehicle is ready to arm."""
    if int(v.params["ARMING_CHECK"]) == 0:
        return mandatory_refusals(v)
    return [
        *_failsafe_refusals(v),
        *_altitude_refusals(v),
        *_sensor_refusals(v),
        *_battery_refusals(v),
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


def _failsafe_refusals(v: VehicleState) -> Iterator[str]:
    if v.failsafes.gcs:
        yield "GCS failsafe on"
    if v.failsafes.radio:
        yield "Radio failsafe on"


def _altitude_refusals(v: VehicleState) -> Iterator[str]:
    if not TRAITS[v.mode].manual_throttle and not v.estimator.aligned:
        yield "Need Alt Estimate"


def _sensor_refusals(v: VehicleState) -> Iterator[str]:
    if _checks(v, Check.INS):
        if not v.estimator.consistent:
            yield "Accels inconsistent"
        if not v.estimator.aligned:
            yield "EKF attitude is bad"
    needs_position = TRAITS[v.mode].needs_position or _fence_needs_position(v)
    no_fix = needs_position and v.estimator.consistent and v.gps.fix_type < mavlink.GPS_FIX_TYPE_3D_FIX
    if no_fix and _checks(v, Check.GPS):
        yield "GPS 1: Bad fix"
    else:
        yield from _position_refusals(v)


def _position_refusals(v: VehicleState) -> Iterator[str]:
    if not v.estimator.active:
        yield "AHRS: not using configured AHRS type"
    elif v.home is None:
        yield "AHRS: waiting for home"
    elif v.position_ok:
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


def _fence_refusals(v: VehicleState) -> Iterator[str]:
    if v.home is not None and v.fence.outside(v.est.north, v.est.east, v.altitude_m, v.home_xy):
        yield "Vehicle outside Fence"

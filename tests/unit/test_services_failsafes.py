"""Failsafe parameters that are set and verified before arming."""

from __future__ import annotations

import math

import pytest
from fractus_core.policy.decision_types import Airframe
from fractus_runtime.mavlink_codec import message
from fractus_services.mobility.autopilot import FailsafeStatus
from fractus_services.mobility.mavlink.companion import SYSTEM_ID
from fractus_services.mobility.mavlink.failsafes import MavlinkFailsafes
from parameter_vehicle import MOVEMENT, ParameterVehicle
from virtual_time import run

SOUND = {
    "FS_GCS_ENABLE": 1.0, "FS_GCS_TIMEOUT": 5.0, "BATT_FS_LOW_ACT": 2.0, "BATT_FS_CRT_ACT": 1.0, "FS_EKF_ACTION": 1.0,
    "FS_EKF_THRESH": 0.8,
}  # fmt: skip


class Parameters(ParameterVehicle):
    """Fake autopilot that has only parameters. Parameters in `fixed` cannot be set."""

    def __init__(self, values: dict[str, float], fixed: tuple[str, ...] = ()) -> None:
        super().__init__(MOVEMENT | SOUND | values, fixed)


def configured(parameters: Parameters, *, flying: bool = False) -> FailsafeStatus:
    return run(MavlinkFailsafes(parameters).configure(flying=flying))


def test_companion_is_not_a_ground_station() -> None:
    assert SYSTEM_ID not in {0, 1, 255}


def test_gcs_failsafe_monitors_only_the_companion() -> None:
    for name in ("SYSID_MYGCS", "MAV_GCS_SYSID"):
        vehicle = Parameters({name: 255.0, "MAV_GCS_SYSID_HI": 255.0})
        assert not configured(vehicle).problem
        assert vehicle.values[name] == SYSTEM_ID
    assert vehicle.values["MAV_GCS_SYSID_HI"] == 0.0


@pytest.mark.parametrize(
    ("owned", "holds"), [(0.0, False), (-1.0, False), (0.8, True), (0.6, True), (1.0, True), (50.0, False)]
)
def test_ekf_failsafe_is_enabled_if_the_owner_disabled_it(owned: float, holds: bool) -> None:
    vehicle = Parameters({"SYSID_MYGCS": 244.0, "FS_EKF_THRESH": owned})
    assert not configured(vehicle).problem
    assert vehicle.values["FS_EKF_THRESH"] == (owned if holds else 0.75)


def test_gcs_failsafe_with_another_system_prevents_arming() -> None:
    assert "SYSID_MYGCS is 255" in configured(Parameters({"SYSID_MYGCS": 255.0}, ("SYSID_MYGCS",))).problem
    assert "no SYSID_MYGCS or MAV_GCS_SYSID" in configured(Parameters({})).problem


def test_nan_airframe_parameter_prevents_arming() -> None:
    checked = configured(Parameters({"SYSID_MYGCS": 255.0, "WPNAV_ACCEL": math.nan, "PSC_POSXY_P": math.inf}))
    assert "WPNAV_ACCEL is not a number" in checked.problem
    assert "PSC_POSXY_P is not a number" in checked.problem
    assert checked.airframe == Airframe()


def test_leg_speed_uses_parameter_name_of_the_firmware() -> None:
    for stored, expected in (({"WPNAV_SPEED": 1000.0}, 10.0), ({"WP_SPD": 7.0}, 3.0)):
        vehicle = Parameters({"SYSID_MYGCS": 255.0, "WPNAV_SPEED": 300.0})
        vehicle.vehicle_parameters.leg_speed = stored
        assert configured(vehicle).speed_mps == expected
    newer = Parameters({"SYSID_MYGCS": 255.0, "WP_SPD": 4.0})
    del newer.values["WPNAV_SPEED"]
    newer.vehicle_parameters.leg_speed = {"WPNAV_SPEED": 1000.0}
    assert configured(newer).speed_mps == 4.0


def test_rtl_parameters_lead_home_above_home_altitude_and_land() -> None:
    owned = {"RTL_ALT_TYPE": 1.0, "RTL_ALT_FINAL": 500.0, "RALLY_LIMIT_KM": 0.5}
    vehicle = Parameters({"SYSID_MYGCS": 255.0} | owned)
    assert not configured(vehicle, flying=True).problem
    assert {name: vehicle.values[name] for name in owned} == {
        "RTL_ALT_TYPE": 0.0, "RTL_ALT_FINAL": 0.0, "RALLY_LIMIT_KM": 2.0**-10,
    }  # fmt: skip
    stubborn = Parameters({"SYSID_MYGCS": 255.0} | owned, ("RTL_ALT_FINAL",))
    assert "RTL_ALT_FINAL is 500" in configured(stubborn, flying=True).problem


RETRACING = {"SYSID_MYGCS": 244.0, "SRTL_POINTS": 300.0}


def test_failsafe_uses_smart_rtl_if_path_is_recorded() -> None:
    vehicle = Parameters(RETRACING)
    checked = configured(vehicle)
    assert not checked.problem
    assert checked.airframe.retraces
    assert (vehicle.values["FS_GCS_ENABLE"], vehicle.values["BATT_FS_LOW_ACT"]) == (3.0, 3.0)


def test_smart_rtl_or_land_action_of_owner_is_kept() -> None:
    vehicle = Parameters(RETRACING | {"FS_GCS_ENABLE": 4.0, "BATT_FS_LOW_ACT": 4.0})
    assert configured(vehicle).airframe.retraces
    assert (vehicle.values["FS_GCS_ENABLE"], vehicle.values["BATT_FS_LOW_ACT"]) == (4.0, 4.0)


@pytest.mark.parametrize("how", [{"SRTL_POINTS": 0.0}, {"SRTL_POINTS": 50.0}])
def test_smart_rtl_with_too_few_points_counts_as_unavailable(how: dict[str, float]) -> None:
    vehicle = Parameters(RETRACING | how | {"FS_GCS_ENABLE": 3.0})
    checked = configured(vehicle)
    assert not checked.problem
    assert not checked.airframe.retraces
    assert vehicle.values["FS_GCS_ENABLE"] == 1.0


@pytest.mark.parametrize("fixed", ["FS_GCS_ENABLE", "BATT_FS_LOW_ACT"])
def test_path_is_not_retraced_if_failsafe_action_is_rtl(fixed: str) -> None:
    vehicle = Parameters(RETRACING, (fixed,))
    checked = configured(vehicle)
    assert not checked.problem
    assert not checked.airframe.retraces
    assert vehicle.values["FS_GCS_ENABLE"] == 1.0


def test_failsafe_uses_rtl_if_armed_away_from_home_and_smart_rtl_at_home() -> None:
    async def chosen() -> None:
        vehicle = Parameters(RETRACING)
        checked = await MavlinkFailsafes(vehicle).configure()
        away = await MavlinkFailsafes(vehicle).choose_return(checked, retrace=False)
        assert not away.airframe.retraces
        assert vehicle.values["FS_GCS_ENABLE"] == 1.0
        rechecked = await MavlinkFailsafes(vehicle).choose_return(away, retrace=True)
        assert rechecked.airframe.retraces
        assert vehicle.values["FS_GCS_ENABLE"] == 3.0

    run(chosen())


def test_velocity_timeout_is_short() -> None:
    vehicle = Parameters({"SYSID_MYGCS": SYSTEM_ID, "GUID_TIMEOUT": 3.0})
    assert not configured(vehicle, flying=True).problem
    assert vehicle.values["GUID_TIMEOUT"] == 1.0
    assert "GUID_TIMEOUT is 3" in configured(Parameters({"GUID_TIMEOUT": 3.0}, ("GUID_TIMEOUT",)), flying=True).problem
    assert "GUID_TIMEOUT" in configured(Parameters({"SYSID_MYGCS": SYSTEM_ID}), flying=True).missing


@pytest.mark.parametrize(
    ("options", "after"), [(0.0, 0.0), (4.0, 4.0), (128.0, 128.0), (16.0, 0.0), (64.0, 0.0), (36.0, 0.0)]
)
def test_guided_options_are_set_for_flight(options: float, after: float) -> None:
    vehicle = Parameters({"SYSID_MYGCS": SYSTEM_ID, "GUID_OPTIONS": options})
    assert not configured(vehicle, flying=True).problem
    assert vehicle.values["GUID_OPTIONS"] == after
    stubborn = Parameters({"SYSID_MYGCS": SYSTEM_ID, "GUID_OPTIONS": 32.0}, ("GUID_OPTIONS",))
    assert "GUID_OPTIONS is 32" in configured(stubborn, flying=True).problem


@pytest.mark.parametrize(("slope", "after"), [(0.0, 0.0), (0.5, 3.0), (3.0, 3.0), (8.0, 8.0)])
def test_rtl_cone_slope_is_at_least_three_unless_disabled(slope: float, after: float) -> None:
    vehicle = Parameters({"SYSID_MYGCS": SYSTEM_ID, "RTL_CONE_SLOPE": slope})
    assert not configured(vehicle, flying=True).problem
    assert vehicle.values["RTL_CONE_SLOPE"] == after


@pytest.mark.parametrize(
    ("lean", "accel_mps2"),
    [
        ({}, 2.5), ({"ANGLE_MAX": 1000.0}, 1.03), ({"PSC_ANGLE_MAX": 12.0}, 1.38),
        ({"ANGLE_MAX": 1000.0, "PSC_ANGLE_MAX": 30.0}, 2.5), ({"PSC_ANGLE_MAX": 3.0}, 0.1),
    ],
)  # fmt: skip
def test_braking_deceleration_is_limited_by_lean_angle(lean: dict[str, float], accel_mps2: float) -> None:
    checked = configured(Parameters({"SYSID_MYGCS": SYSTEM_ID, **lean}))
    assert checked.airframe.accel_mps2 == pytest.approx(accel_mps2, abs=0.01)


def test_lean_angle_parameter_of_release_4_7_is_known() -> None:
    vehicle = Parameters({"SYSID_MYGCS": SYSTEM_ID, "ATC_ANGLE_MAX": 10.0})
    del vehicle.values["ANGLE_MAX"]
    assert configured(vehicle).airframe.accel_mps2 == pytest.approx(1.03, abs=0.01)


def test_fence_ceiling_limits_return_altitude() -> None:
    fence = {"FENCE_ENABLE": 1.0, "FENCE_TYPE": 7.0, "FENCE_ALT_MAX": 40.0, "FENCE_MARGIN": 3.0}

    def returns_at(**changes: float) -> float:
        return configured(Parameters({"RTL_ALT": 5000.0, **fence, **changes})).airframe.return_altitude_m

    assert returns_at() == 37.0
    assert returns_at(RTL_ALT=2000.0) == 20.0
    assert returns_at(FENCE_TYPE=6.0) == 50.0, "a fence without altitude limit does not lower the return altitude"
    assert returns_at(FENCE_ENABLE=0.0) == 50.0
    assert returns_at(FENCE_ENABLE=0.0, FENCE_AUTOENABLE=1.0) == 37.0


def test_fence_ceiling_set_later_limits_return_altitude() -> None:
    async def learnt() -> None:
        vehicle = Parameters(RETRACING | {"RTL_ALT": 5000.0})
        checked = await MavlinkFailsafes(vehicle).configure()
        assert checked.airframe.return_altitude_m == 50.0
        vehicle.values |= {"FENCE_ENABLE": 1.0, "FENCE_TYPE": 5.0, "FENCE_ALT_MAX": 35.0}
        lower = await MavlinkFailsafes(vehicle).learn_return(checked)
        assert lower.airframe.return_altitude_m == 33.0
        assert lower.airframe.retraces
        vehicle.values["FENCE_ALT_MAX"] = math.nan
        assert "FENCE_ALT_MAX is not a number" in (await MavlinkFailsafes(vehicle).learn_return(checked)).problem

    run(learnt())


FENCED = {"FENCE_ENABLE": 1.0, "FENCE_TYPE": 5.0, "FENCE_ALT_MAX": 65.0}


@pytest.mark.parametrize("removed_parameter", ["RTL_ALT", "FENCE_ENABLE"])
def test_lost_return_altitude_parameter_keeps_value_and_prevents_arming(removed_parameter: str) -> None:
    async def learnt() -> None:
        vehicle = Parameters(RETRACING | FENCED | {"RTL_ALT": 6000.0})
        checked = await MavlinkFailsafes(vehicle).configure()
        assert checked.airframe.return_altitude_m == 60.0
        vehicle.values |= {"RTL_ALT": 9000.0}
        del vehicle.values[removed_parameter]
        later = await MavlinkFailsafes(vehicle).learn_return(checked)
        assert later.airframe.return_altitude_m == 60.0
        assert later.problem == f"{removed_parameter} cannot be read: the autopilot does not answer"

    run(learnt())


def test_fence_without_known_ceiling_prevents_arming() -> None:
    vehicle = Parameters(RETRACING | FENCED)
    del vehicle.values["FENCE_ALT_MAX"]
    assert configured(vehicle).problem == "the autopilot has no FENCE_ALT_MAX"


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("retrace", [True, False])
def test_return_parameters_are_not_changed_in_flight(retrace: bool, known: bool) -> None:
    async def flown() -> None:
        vehicle = Parameters(RETRACING)
        chosen = await MavlinkFailsafes(vehicle).choose_return(
            await MavlinkFailsafes(vehicle).configure(), retrace=retrace
        )
        before = vehicle.values["FS_GCS_ENABLE"]
        rechecked = await MavlinkFailsafes(vehicle).configure(flying=True, before=chosen if known else None)
        assert rechecked.airframe.retraces is retrace
        assert vehicle.values["FS_GCS_ENABLE"] == before == (3.0 if retrace else 1.0)
        landed = await MavlinkFailsafes(vehicle).configure(before=chosen)
        assert landed.airframe.retraces

    run(flown())


def test_unreadable_parameters_keep_last_value_in_flight() -> None:
    async def flown() -> None:
        moves = {"WPNAV_ACCEL": 100.0, "RTL_ALT": 6000.0, "WPNAV_SPEED": 800.0}
        vehicle = Parameters(RETRACING | moves)
        before = await MavlinkFailsafes(vehicle).configure()
        for name in (*moves, "SRTL_POINTS"):
            del vehicle.values[name]
        rechecked = await MavlinkFailsafes(vehicle).configure(flying=True, before=before)
        assert (rechecked.airframe, rechecked.speed_mps) == (before.airframe, 8.0)
        assert rechecked.airframe.retraces
        assert "WPNAV_ACCEL" in rechecked.problem
        assert "cannot be read: the autopilot does not answer" in rechecked.problem

    run(flown())


@pytest.mark.parametrize(("kind", "firmware"), [(2, 12), (1, 3), (10, 3), (20, 3)])
def test_parameters_are_set_only_in_arducopter(kind: int, firmware: int) -> None:
    vehicle = Parameters(RETRACING | {"FS_GCS_ENABLE": 0.0})
    vehicle.vehicle.take(message("HEARTBEAT", type=kind, autopilot=firmware), 1.0)
    assert configured(vehicle).problem == f"the vehicle is no ArduCopter (MAV_AUTOPILOT {firmware}, MAV_TYPE {kind})"
    assert vehicle.values["FS_GCS_ENABLE"] == 0.0
    vehicle.vehicle.take(message("HEARTBEAT", type=13, autopilot=3), 2.0)
    assert not configured(vehicle).problem

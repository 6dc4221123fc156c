"""What must hold in the autopilot before anything may arm."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Coroutine
from typing import Any, TypeVar

import pytest
from fractus_core.policy.decision_types import Airframe
from fractus_runtime.mavlink_codec import message
from fractus_services.mobility.autopilot import Checked
from fractus_services.mobility.mavlink.companion import SYSTEM_ID
from fractus_services.mobility.mavlink.failsafes import MavlinkFailsafes
from parameter_vehicle import MOVEMENT, ParameterVehicle
from virtual_time import Loop

SOUND = {
    "FS_GCS_ENABLE": 1.0, "FS_GCS_TIMEOUT": 5.0, "BATT_FS_LOW_ACT": 2.0, "BATT_FS_CRT_ACT": 1.0, "FS_EKF_ACTION": 1.0,
    "FS_EKF_THRESH": 0.8,
}  # fmt: skip


class Parameters(ParameterVehicle):
    """An autopilot that only has parameters; those in `fixed` cannot be set."""

    def __init__(self, values: dict[str, float], fixed: tuple[str, ...] = ()) -> None:
        super().__init__(MOVEMENT | SOUND | values, fixed)


T = TypeVar("T")


def run(work: Coroutine[Any, Any, T]) -> T:
    """The outcome of work in a loop whose time jumps."""
    with asyncio.Runner(loop_factory=Loop) as runner:
        return runner.run(work)


def configured(parameters: Parameters, *, flying: bool = False) -> Checked:
    return run(MavlinkFailsafes(parameters).configure(flying=flying))


def test_the_companion_is_no_ground_station() -> None:
    assert SYSTEM_ID not in {0, 1, 255}


def test_the_failsafe_listens_to_the_companion_alone() -> None:
    for name in ("SYSID_MYGCS", "MAV_GCS_SYSID"):
        vehicle = Parameters({name: 255.0, "MAV_GCS_SYSID_HI": 255.0})
        assert not configured(vehicle).problem
        assert vehicle.values[name] == SYSTEM_ID
    assert vehicle.values["MAV_GCS_SYSID_HI"] == 0.0


@pytest.mark.parametrize(
    ("owned", "holds"), [(0.0, False), (-1.0, False), (0.8, True), (0.6, True), (1.0, True), (50.0, False)]
)
def test_the_estimators_failsafe_is_not_left_switched_off(owned: float, holds: bool) -> None:
    vehicle = Parameters({"SYSID_MYGCS": 244.0, "FS_EKF_THRESH": owned})
    assert not configured(vehicle).problem
    assert vehicle.values["FS_EKF_THRESH"] == (owned if holds else 0.75)


def test_a_failsafe_that_listens_to_others_forbids_arming() -> None:
    assert "SYSID_MYGCS is 255" in configured(Parameters({"SYSID_MYGCS": 255.0}, ("SYSID_MYGCS",))).problem
    assert "no SYSID_MYGCS or MAV_GCS_SYSID" in configured(Parameters({})).problem


def test_an_airframe_that_is_not_a_number_forbids_arming() -> None:
    checked = configured(Parameters({"SYSID_MYGCS": 255.0, "WPNAV_ACCEL": math.nan, "PSC_POSXY_P": math.inf}))
    assert "WPNAV_ACCEL is not a number" in checked.problem
    assert "PSC_POSXY_P is not a number" in checked.problem
    assert checked.airframe == Airframe()


def test_legs_are_flown_with_the_owners_speed_where_the_vehicle_spells_it_so() -> None:
    for stored, expected in (({"WPNAV_SPEED": 1000.0}, 10.0), ({"WP_SPD": 7.0}, 3.0)):
        vehicle = Parameters({"SYSID_MYGCS": 255.0, "WPNAV_SPEED": 300.0})
        vehicle.vehicle_parameters.leg_speed = stored
        assert configured(vehicle).speed_mps == expected
    newer = Parameters({"SYSID_MYGCS": 255.0, "WP_SPD": 4.0})
    del newer.values["WPNAV_SPEED"]
    newer.vehicle_parameters.leg_speed = {"WPNAV_SPEED": 1000.0}
    assert configured(newer).speed_mps == 4.0


def test_its_own_return_leads_home_at_an_altitude_above_home_and_ends_on_the_ground() -> None:
    owned = {"RTL_ALT_TYPE": 1.0, "RTL_ALT_FINAL": 500.0, "RALLY_LIMIT_KM": 0.5}
    vehicle = Parameters({"SYSID_MYGCS": 255.0} | owned)
    assert not configured(vehicle, flying=True).problem
    assert {name: vehicle.values[name] for name in owned} == {
        "RTL_ALT_TYPE": 0.0, "RTL_ALT_FINAL": 0.0, "RALLY_LIMIT_KM": 2.0**-10,
    }  # fmt: skip
    stubborn = Parameters({"SYSID_MYGCS": 255.0} | owned, ("RTL_ALT_FINAL",))
    assert "RTL_ALT_FINAL is 500" in configured(stubborn, flying=True).problem


RETRACING = {"SYSID_MYGCS": 244.0, "SRTL_POINTS": 300.0}


def test_a_vehicle_that_remembers_its_path_goes_back_on_it() -> None:
    vehicle = Parameters(RETRACING)
    checked = configured(vehicle)
    assert not checked.problem
    assert checked.airframe.retraces
    assert (vehicle.values["FS_GCS_ENABLE"], vehicle.values["BATT_FS_LOW_ACT"]) == (3.0, 3.0)


def test_smart_return_or_landing_may_stay() -> None:
    vehicle = Parameters(RETRACING | {"FS_GCS_ENABLE": 4.0, "BATT_FS_LOW_ACT": 4.0})
    assert configured(vehicle).airframe.retraces
    assert (vehicle.values["FS_GCS_ENABLE"], vehicle.values["BATT_FS_LOW_ACT"]) == (4.0, 4.0)


@pytest.mark.parametrize("how", [{"SRTL_POINTS": 0.0}, {"SRTL_POINTS": 50.0}])
def test_a_short_memory_is_none(how: dict[str, float]) -> None:
    vehicle = Parameters(RETRACING | how | {"FS_GCS_ENABLE": 3.0})
    checked = configured(vehicle)
    assert not checked.problem
    assert not checked.airframe.retraces
    assert vehicle.values["FS_GCS_ENABLE"] == 1.0


@pytest.mark.parametrize("fixed", ["FS_GCS_ENABLE", "BATT_FS_LOW_ACT"])
def test_a_failsafe_that_stays_straight_retraces_nothing(fixed: str) -> None:
    vehicle = Parameters(RETRACING, (fixed,))
    checked = configured(vehicle)
    assert not checked.problem
    assert not checked.airframe.retraces
    assert vehicle.values["FS_GCS_ENABLE"] == 1.0


def test_armed_elsewhere_it_goes_straight_and_from_home_again_on_its_path() -> None:
    async def chosen() -> None:
        vehicle = Parameters(RETRACING)
        checked = await MavlinkFailsafes(vehicle).configure()
        away = await MavlinkFailsafes(vehicle).choose_return(checked, retrace=False)
        assert not away.airframe.retraces
        assert vehicle.values["FS_GCS_ENABLE"] == 1.0
        again = await MavlinkFailsafes(vehicle).choose_return(away, retrace=True)
        assert again.airframe.retraces
        assert vehicle.values["FS_GCS_ENABLE"] == 3.0

    run(chosen())


def test_a_velocity_ends_soon_without_another() -> None:
    vehicle = Parameters({"SYSID_MYGCS": SYSTEM_ID, "GUID_TIMEOUT": 3.0})
    assert not configured(vehicle, flying=True).problem
    assert vehicle.values["GUID_TIMEOUT"] == 1.0
    assert "GUID_TIMEOUT is 3" in configured(Parameters({"GUID_TIMEOUT": 3.0}, ("GUID_TIMEOUT",)), flying=True).problem
    assert "GUID_TIMEOUT" in configured(Parameters({"SYSID_MYGCS": SYSTEM_ID}), flying=True).missing


@pytest.mark.parametrize(
    ("options", "after"), [(0.0, 0.0), (4.0, 4.0), (128.0, 128.0), (16.0, 0.0), (64.0, 0.0), (36.0, 0.0)]
)
def test_a_vehicle_flies_and_stops_as_it_is_told(options: float, after: float) -> None:
    vehicle = Parameters({"SYSID_MYGCS": SYSTEM_ID, "GUID_OPTIONS": options})
    assert not configured(vehicle, flying=True).problem
    assert vehicle.values["GUID_OPTIONS"] == after
    stubborn = Parameters({"SYSID_MYGCS": SYSTEM_ID, "GUID_OPTIONS": 32.0}, ("GUID_OPTIONS",))
    assert "GUID_OPTIONS is 32" in configured(stubborn, flying=True).problem


@pytest.mark.parametrize(("slope", "after"), [(0.0, 0.0), (0.5, 3.0), (3.0, 3.0), (8.0, 8.0)])
def test_a_vehicle_returns_no_lower_than_ways_home_are_judged_for(slope: float, after: float) -> None:
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
def test_a_vehicle_brakes_no_harder_than_it_leans_in_wind(lean: dict[str, float], accel_mps2: float) -> None:
    checked = configured(Parameters({"SYSID_MYGCS": SYSTEM_ID, **lean}))
    assert checked.airframe.accel_mps2 == pytest.approx(accel_mps2, abs=0.01)


def test_the_lean_is_known_by_its_name_of_release_4_7() -> None:
    vehicle = Parameters({"SYSID_MYGCS": SYSTEM_ID, "ATC_ANGLE_MAX": 10.0})
    del vehicle.values["ANGLE_MAX"]
    assert configured(vehicle).airframe.accel_mps2 == pytest.approx(1.03, abs=0.01)


def test_the_vehicles_own_fence_caps_its_way_home() -> None:
    fence = {"FENCE_ENABLE": 1.0, "FENCE_TYPE": 7.0, "FENCE_ALT_MAX": 40.0, "FENCE_MARGIN": 3.0}

    def returns_at(**changes: float) -> float:
        return configured(Parameters({"RTL_ALT": 5000.0, **fence, **changes})).airframe.return_altitude_m

    assert returns_at() == 37.0
    assert returns_at(RTL_ALT=2000.0) == 20.0
    assert returns_at(FENCE_TYPE=6.0) == 50.0, "no ceiling"
    assert returns_at(FENCE_ENABLE=0.0) == 50.0
    assert returns_at(FENCE_ENABLE=0.0, FENCE_AUTOENABLE=1.0) == 37.0


def test_a_fence_raised_later_caps_it_as_well() -> None:
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


@pytest.mark.parametrize("lost", ["RTL_ALT", "FENCE_ENABLE"])
def test_a_return_altitude_that_is_lost_stays_and_forbids_arming(lost: str) -> None:
    async def learnt() -> None:
        vehicle = Parameters(RETRACING | FENCED | {"RTL_ALT": 6000.0})
        checked = await MavlinkFailsafes(vehicle).configure()
        assert checked.airframe.return_altitude_m == 60.0
        vehicle.values |= {"RTL_ALT": 9000.0}
        del vehicle.values[lost]
        later = await MavlinkFailsafes(vehicle).learn_return(checked)
        assert later.airframe.return_altitude_m == 60.0
        assert later.problem == f"{lost} cannot be read: the autopilot does not answer"

    run(learnt())


def test_a_fence_without_its_ceiling_forbids_arming() -> None:
    vehicle = Parameters(RETRACING | FENCED)
    del vehicle.values["FENCE_ALT_MAX"]
    assert configured(vehicle).problem == "the autopilot has no FENCE_ALT_MAX"


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("retrace", [True, False])
def test_in_flight_the_way_home_stays_as_it_was_chosen(retrace: bool, known: bool) -> None:
    async def flown() -> None:
        vehicle = Parameters(RETRACING)
        chosen = await MavlinkFailsafes(vehicle).choose_return(
            await MavlinkFailsafes(vehicle).configure(), retrace=retrace
        )
        before = vehicle.values["FS_GCS_ENABLE"]
        again = await MavlinkFailsafes(vehicle).configure(flying=True, before=chosen if known else None)
        assert again.airframe.retraces is retrace
        assert vehicle.values["FS_GCS_ENABLE"] == before == (3.0 if retrace else 1.0)
        landed = await MavlinkFailsafes(vehicle).configure(before=chosen)
        assert landed.airframe.retraces

    run(flown())


def test_in_flight_what_cannot_be_read_is_as_it_was() -> None:
    async def flown() -> None:
        moves = {"WPNAV_ACCEL": 100.0, "RTL_ALT": 6000.0, "WPNAV_SPEED": 800.0}
        vehicle = Parameters(RETRACING | moves)
        before = await MavlinkFailsafes(vehicle).configure()
        for name in (*moves, "SRTL_POINTS"):
            del vehicle.values[name]
        again = await MavlinkFailsafes(vehicle).configure(flying=True, before=before)
        assert (again.airframe, again.speed_mps) == (before.airframe, 8.0)
        assert again.airframe.retraces
        assert "WPNAV_ACCEL" in again.problem
        assert "cannot be read: the autopilot does not answer" in again.problem

    run(flown())


@pytest.mark.parametrize(("kind", "firmware"), [(2, 12), (1, 3), (10, 3), (20, 3)])
def test_nothing_is_set_in_a_vehicle_that_is_no_arducopter(kind: int, firmware: int) -> None:
    vehicle = Parameters(RETRACING | {"FS_GCS_ENABLE": 0.0})
    vehicle.vehicle.take(message("HEARTBEAT", type=kind, autopilot=firmware), 1.0)
    assert configured(vehicle).problem == f"the vehicle is no ArduCopter (MAV_AUTOPILOT {firmware}, MAV_TYPE {kind})"
    assert vehicle.values["FS_GCS_ENABLE"] == 0.0
    vehicle.vehicle.take(message("HEARTBEAT", type=13, autopilot=3), 2.0)
    assert not configured(vehicle).problem

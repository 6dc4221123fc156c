"""Parameters over lossy links: the service distinguishes absent parameters from lost responses."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import Any

import pytest
from depth import examples
from fractus_core.policy.decision_types import Airframe
from fractus_runtime.mavlink_codec import message
from fractus_services.errors import AutopilotError
from fractus_services.mobility.autopilot import FailsafeStatus
from fractus_services.mobility.mavlink.ardupilot import ARDUCOPTER
from fractus_services.mobility.mavlink.failsafes import MavlinkFailsafes, Reader
from fractus_services.mobility.mavlink.parameters import ParameterLost
from parameter_vehicle import BY_NAME, ParameterVehicle, as_release_4_7
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from virtual_time import run

OTHER_PARAMETERS = {f"P{number:04}": float(number) for number in range(1380)}
"""Additional parameters. The vehicle then has as many parameters as a real one."""

AS_4_6 = {
    "SYSID_MYGCS": 255.0, "FS_GCS_ENABLE": 0.0, "FS_GCS_TIMEOUT": 5.0, "GUID_TIMEOUT": 3.0, "BATT_FS_CRT_ACT": 0.0,
    "BATT_FS_LOW_ACT": 0.0, "FS_EKF_ACTION": 1.0, "SRTL_POINTS": 300.0, "FENCE_ENABLE": 0.0, "FENCE_TYPE": 7.0,
    "FENCE_ALT_MAX": 100.0, "FENCE_ACTION": 1.0, "FENCE_MARGIN": 2.0, "FENCE_AUTOENABLE": 0.0, "FENCE_OPTIONS": 0.0,
    "WPNAV_ACCEL": 100.0, "PSC_POSXY_P": 0.6, "WPNAV_ACCEL_Z": 70.0, "PSC_JERK_XY": 3.0, "RTL_ALT": 4200.0,
    "WPNAV_SPEED": 700.0, "RTL_SPEED": 0.0, "RTL_CLIMB_MIN": 0.0, "RTL_ALT_TYPE": 1.0, "RTL_ALT_FINAL": 500.0,
    "RALLY_LIMIT_KM": 0.25, "RTL_CONE_SLOPE": 3.0, "GUID_OPTIONS": 0.0, "ANGLE_MAX": 3000.0, "PSC_ANGLE_MAX": 0.0, "FS_EKF_THRESH": 0.8,
}  # fmt: skip
AS_4_7 = as_release_4_7(AS_4_6)
AS_4_7_0 = {{"PSC_NE_JERK": "PSC_JERK_NE"}.get(name, name): value for name, value in AS_4_7.items()}
FIGURES = Airframe(
    accel_mps2=1.0, position_gain=0.6, climb_accel_mps2=0.7, jerk_mps3=3.0, return_altitude_m=42.0, retraces=True
)


async def started(vehicle: ParameterVehicle) -> FailsafeStatus:
    return await MavlinkFailsafes(vehicle).configure()


def rounded(airframe: Airframe) -> Airframe:
    return replace(
        airframe,
        **{name: round(getattr(airframe, name), 4) for name in ("accel_mps2", "position_gain", "climb_accel_mps2")},
        return_altitude_m=round(airframe.return_altitude_m, 3),
    )


@pytest.mark.parametrize("release", [AS_4_6, AS_4_7, AS_4_7_0])
@pytest.mark.parametrize(("loss", "starts"), [(0.1, examples(60)), (0.3, examples(40, 20))])
def test_startup_uses_only_parameter_values_of_the_vehicle(loss: float, starts: int, release: dict[str, float]) -> None:
    verified = 0
    for seed in range(starts):
        vehicle = ParameterVehicle(release | OTHER_PARAMETERS, loss=loss, seed=seed, delay_s=0.05)
        checked = run(started(vehicle))
        if not checked.problem:
            verified += 1
            assert rounded(checked.airframe) == FIGURES, f"seed {seed}"
            assert checked.speed_mps == pytest.approx(7.0)
            settings = {name: vehicle.values[name] for name in ("FS_GCS_ENABLE", "GUID_TIMEOUT", "BATT_FS_CRT_ACT")}
            assert settings == {"FS_GCS_ENABLE": 3.0, "GUID_TIMEOUT": 3.0, "BATT_FS_CRT_ACT": 1.0}, f"seed {seed}"
    assert verified >= 0.8 * starts, "on a lossy link, most starts succeed"


@pytest.mark.parametrize(
    "unanswered", sorted({"WPNAV_ACCEL", "SRTL_POINTS", "FENCE_ALT_MAX", "RTL_ALT", "FS_GCS_ENABLE"})
)
def test_parameter_without_response_prevents_arming_and_is_named(unanswered: str) -> None:
    class Deaf(ParameterVehicle):
        def send(self, outgoing: Any) -> None:
            named = outgoing.name == "PARAM_REQUEST_READ" and outgoing.text("param_id") == unanswered
            if not named:
                super().send(outgoing)

        def take(self, incoming: Any) -> None:
            if incoming.name != "PARAM_VALUE" or incoming.text("param_id") != unanswered or listing:
                super().take(incoming)

    for listing in (False, True):
        problem = run(started(Deaf(AS_4_6 | OTHER_PARAMETERS))).problem
        # If the list contains the parameter, its value is used. Otherwise the list is incomplete.
        assert ("cannot be read" in problem and unanswered in problem) is not listing, problem


def test_incomplete_parameter_list_names_requested_parameters() -> None:
    class Mute(ParameterVehicle):
        def take(self, incoming: Any) -> None:
            if incoming.name != "PARAM_VALUE" or incoming.text("param_id") not in {"WPNAV_ACCEL", "P0100"}:
                super().take(incoming)

    problem = run(started(Mute(AS_4_6 | OTHER_PARAMETERS))).problem
    assert "WPNAV_ACCEL or WP_ACC cannot be read" in problem


def test_absent_parameter_is_detected_by_one_list_request() -> None:
    async def read_parameters() -> None:
        vehicle = ParameterVehicle(
            {name: value for name, value in AS_4_6.items() if name != "BATT_FS_CRT_ACT"} | OTHER_PARAMETERS
        )
        checked = await started(vehicle)
        assert not checked.problem
        assert checked.missing == ("BATT_FS_CRT_ACT",)
        assert vehicle.received_names.count("PARAM_REQUEST_LIST") == 1
        begun = vehicle.now
        assert (await started(vehicle)).missing == ("BATT_FS_CRT_ACT",)
        assert vehicle.now - begun < 0.1

    run(read_parameters())


def test_absent_parameter_is_detected_by_an_error_message_without_the_list() -> None:
    async def read_parameters() -> None:
        values = {name: value for name, value in AS_4_7.items() if name != "BATT_FS_CRT_ACT"} | OTHER_PARAMETERS
        vehicle = ParameterVehicle(values, delay_s=0.05, errors=True)
        begun = vehicle.now
        checked = await started(vehicle)
        assert not checked.problem
        assert checked.missing == ("BATT_FS_CRT_ACT",)
        assert "PARAM_REQUEST_LIST" not in vehicle.received_names
        assert vehicle.now - begun < 2.0
        vehicle.values["BATT_FS_CRT_ACT"] = 0.0
        await started(vehicle)
        assert not (await started(vehicle)).missing, "a parameter of a feature that was enabled meanwhile is used"

    run(read_parameters())


@pytest.mark.parametrize("release", [AS_4_6, AS_4_7, AS_4_7_0])
def test_startup_with_lost_error_messages_uses_only_values_of_the_vehicle(release: dict[str, float]) -> None:
    for seed in range(examples(10)):
        vehicle = ParameterVehicle(release | OTHER_PARAMETERS, loss=0.2, seed=seed, delay_s=0.05, errors=True)
        checked = run(started(vehicle))
        assert checked.problem or rounded(checked.airframe) == FIGURES, f"seed {seed}"


def test_refused_parameter_keeps_its_value_and_is_not_sent_again() -> None:
    async def written() -> None:
        fixed = ParameterVehicle({"RTL_ALT": 1500.0}, fixed=("RTL_ALT",), errors=True)
        await fixed.vehicle_parameters.read([("RTL_ALT",)])
        assert await fixed.vehicle_parameters.write("RTL_ALT", 3000.0) == 1500.0
        assert fixed.received_names.count("PARAM_SET") == 1
        with pytest.raises(AutopilotError, match="RTL_ALT_M cannot be set to 30: the autopilot has no such parameter"):
            await fixed.vehicle_parameters.write("RTL_ALT_M", 30.0)

    run(written())


def test_error_message_of_an_earlier_request_does_not_refuse_a_later_one() -> None:
    async def written() -> None:
        vehicle = ParameterVehicle({"RTL_ALT": 1500.0}, errors=True)
        absent = mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST
        vehicle.take(message("PARAM_ERROR", param_id=b"RTL_ALT", param_index=-1, error=absent))
        assert await vehicle.vehicle_parameters.write("RTL_ALT", 3000.0) == 3000.0
        assert await vehicle.vehicle_parameters.read([("RTL_ALT",)]) == {"RTL_ALT": 3000.0}

    run(written())


def test_parameter_list_is_not_requested_if_all_parameters_are_reported() -> None:
    for release in (AS_4_6, AS_4_7):
        vehicle = ParameterVehicle(release | OTHER_PARAMETERS, delay_s=0.02)
        assert not run(started(vehicle)).problem
        assert "PARAM_REQUEST_LIST" not in vehicle.received_names


def test_parameter_hidden_from_list_is_read_by_name() -> None:
    async def read_parameters() -> None:
        values = {name: value for name, value in AS_4_6.items() if name != "FS_EKF_ACTION"} | OTHER_PARAMETERS
        vehicle = ParameterVehicle(values, hidden=("BATT_FS_LOW_ACT", "BATT_FS_CRT_ACT"), loss=0.1, seed=3)
        checked = await started(vehicle)
        assert not checked.problem
        assert checked.missing == ("FS_EKF_ACTION",)
        assert vehicle.values["BATT_FS_CRT_ACT"] == 1.0

    run(read_parameters())


def test_parameter_list_that_grows_while_read_is_read_again() -> None:
    class Growing(ParameterVehicle):
        def send(self, outgoing: Any) -> None:
            super().send(outgoing)
            if outgoing.name == "PARAM_REQUEST_LIST" and self.received_names.count("PARAM_REQUEST_LIST") == 1:
                self.values = {"A_FIRST": 1.0} | self.values

    async def read_parameters() -> None:
        vehicle = Growing({"WPNAV_ACCEL": 100.0} | OTHER_PARAMETERS, loss=0.02, seed=5)
        assert await vehicle.vehicle_parameters.read([("NEVER",), ("WPNAV_ACCEL",)]) == {"WPNAV_ACCEL": 100.0}

    run(read_parameters())


def test_missing_or_late_response_is_not_a_refusal() -> None:
    async def written() -> None:
        fixed = ParameterVehicle({"RTL_ALT": 1500.0}, fixed=("RTL_ALT",))
        assert await fixed.vehicle_parameters.write("RTL_ALT", 3000.0) == 1500.0
        silent = ParameterVehicle({"RTL_ALT": 1500.0}, loss=1.0)
        with pytest.raises(ParameterLost, match="RTL_ALT cannot be set to 3000: the autopilot does not answer"):
            await silent.vehicle_parameters.write("RTL_ALT", 3000.0)
        late = ParameterVehicle({"RTL_ALT": 1500.0}, delay_s=0.5)
        before = message("PARAM_VALUE", param_id=b"RTL_ALT", param_value=1500.0, param_count=1, param_index=BY_NAME)
        asyncio.get_running_loop().call_later(0.1, late.take, before)
        assert await late.vehicle_parameters.write("RTL_ALT", 3000.0) == 3000.0

    run(written())


def test_two_readers_of_one_parameter_both_receive_it() -> None:
    async def used() -> None:
        parameters = ParameterVehicle({"FENCE_TYPE": 1.0}, loss=0.2, seed=1).vehicle_parameters
        read, written = await asyncio.gather(parameters.read([("FENCE_TYPE",)]), parameters.write("FENCE_TYPE", 2.0))
        assert written == 2.0
        assert read["FENCE_TYPE"] in {1.0, 2.0}

    run(used())


def test_every_vehicle_parameter_is_requested() -> None:
    class Asking(dict[str, float]):
        def __contains__(self, name: object) -> bool:
            used.add(str(name))
            return super().__contains__(name)

    for release in (AS_4_6, AS_4_7):
        used: set[str] = set()
        ARDUCOPTER.airframe(Reader(Asking(release | {"FENCE_ENABLE": 1.0})), Airframe(), 5.0)
        assert used <= {name for names in ARDUCOPTER.movement for name in names}

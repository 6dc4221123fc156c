"""What must hold in the autopilot before anything may arm."""

from __future__ import annotations

import asyncio
import math
from typing import Any

from fractus_core.policy.values import Airframe
from fractus_services.mobility.autopilot import SYSTEM_ID
from fractus_services.mobility.failsafes import Checked, configure

SOUND = {
    "FS_GCS_ENABLE": 1.0, "FS_GCS_TIMEOUT": 5.0, "BATT_FS_LOW_ACT": 2.0, "BATT_FS_CRT_ACT": 1.0, "FS_EKF_ACTION": 1.0,
}  # fmt: skip


class Parameters:
    """An autopilot that only has parameters; those in `fixed` cannot be set."""

    def __init__(self, values: dict[str, float], fixed: tuple[str, ...] = ()) -> None:
        self.values = SOUND | values
        self.fixed = fixed

    async def read_parameter(self, name: str, attempts: int = 4) -> float | None:
        del attempts
        return self.values.get(name)

    async def write_parameter(self, name: str, value: float) -> float | None:
        if name not in self.fixed:
            self.values[name] = value
        return self.values[name]


def configured(parameters: Any) -> Checked:
    return asyncio.run(configure(parameters))


def test_the_companion_is_no_ground_station() -> None:
    assert SYSTEM_ID not in {0, 1, 255}


def test_the_failsafe_listens_to_the_companion_alone() -> None:
    for name in ("SYSID_MYGCS", "MAV_GCS_SYSID"):
        vehicle = Parameters({name: 255.0, "MAV_GCS_SYSID_HI": 255.0})
        assert not configured(vehicle).problem
        assert vehicle.values[name] == SYSTEM_ID
    assert vehicle.values["MAV_GCS_SYSID_HI"] == 0.0


def test_a_failsafe_that_listens_to_others_forbids_arming() -> None:
    assert "SYSID_MYGCS is 255" in configured(Parameters({"SYSID_MYGCS": 255.0}, ("SYSID_MYGCS",))).problem
    assert "no SYSID_MYGCS or MAV_GCS_SYSID" in configured(Parameters({})).problem


def test_an_airframe_that_is_not_a_number_forbids_arming() -> None:
    checked = configured(Parameters({"SYSID_MYGCS": 255.0, "WPNAV_ACCEL": math.nan, "PSC_POSXY_P": math.inf}))
    assert "WPNAV_ACCEL is not a number" in checked.problem
    assert "PSC_POSXY_P is not a number" in checked.problem
    assert checked.airframe == Airframe()

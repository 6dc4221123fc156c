"""Parameters of the autopilot's return flight: the owner's values are restored, also after an update of the firmware."""

from __future__ import annotations

from pathlib import Path

import pytest
from fractus_core.policy.return_route import ReturnBounds
from fractus_services.mobility.mavlink.rtl_parameters import RtlParameters
from parameter_vehicle import FAILSAFES, MOVEMENT, ParameterVehicle, as_release_4_7

OWNED = MOVEMENT | FAILSAFES | {"RTL_ALT": 3000.0, "RTL_SPEED": 900.0, "RTL_CLIMB_MIN": 200.0, "RTL_ALT_FINAL": 450.0}
BOUNDS = ReturnBounds(height_m=12.0, speed_mps=4.0)


def as_release_4_6(values: dict[str, float]) -> dict[str, float]:
    renamed = {next(iter(as_release_4_7({name: 1.0}))): name for name in OWNED}
    return {
        renamed[name]: value / as_release_4_7({renamed[name]: 1.0})[name]
        for name, value in values.items()
        if name in renamed
    }


@pytest.mark.parametrize("newer", [True, False])
async def test_owner_values_are_restored_after_firmware_was_replaced(tmp_path: Path, newer: bool) -> None:
    vehicle = ParameterVehicle(dict(OWNED) if newer else as_release_4_7(OWNED))
    await RtlParameters(vehicle, tmp_path).limit(BOUNDS)
    limited = dict(vehicle.values)
    converted = as_release_4_7(limited) if newer else as_release_4_6(limited)
    expected = as_release_4_7(OWNED) if newer else OWNED
    assert converted != pytest.approx(expected)
    vehicle = ParameterVehicle(converted)
    restarted = RtlParameters(vehicle, tmp_path)
    assert restarted.limited
    await restarted.limit(BOUNDS)
    await restarted.lift(lambda: True)
    assert vehicle.values == pytest.approx(expected)
    assert not restarted.limited

"""Whether a vehicle flies, when it says so, says otherwise, or says nothing."""

from __future__ import annotations

import pytest
from fractus_services.mobility.vehicle import Vehicle


@pytest.mark.parametrize(
    ("landed_state", "landed_at", "altitude_m", "flies"),
    [(2, 10.0, 0.0, True), (1, 10.0, 0.2, False), (1, 10.0, 3.0, True), (1, 5.0, 1.0, True), (1, 5.0, 0.1, False),
     (3, 5.0, 0.1, True), (0, float("-inf"), 1.0, True)],
)  # fmt: skip
def test_in_doubt_it_flies(landed_state: int, landed_at: float, altitude_m: float, flies: bool) -> None:
    vehicle = Vehicle(
        armed=True, heartbeat_at=10.0, position_at=10.0, landed_state=landed_state, landed_at=landed_at,
        altitude_m=altitude_m,
    )  # fmt: skip
    assert vehicle.in_air is flies
    vehicle.armed = False
    assert not vehicle.in_air


def test_an_armed_vehicle_whose_place_is_unknown_flies() -> None:
    assert Vehicle(armed=True, heartbeat_at=10.0).in_air

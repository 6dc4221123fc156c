"""Whether a vehicle flies, when it says so, says otherwise, or says nothing."""

from __future__ import annotations

import pytest
from fractus_mavlink import message
from fractus_services.mobility.mavlink.ardupilot import ARDUCOPTER
from fractus_services.mobility.mavlink.vehicle import Vehicle


@pytest.mark.parametrize(
    ("landed_state", "landed_at", "altitude_m", "flies"),
    [(2, 10.0, 0.0, True), (1, 10.0, 0.2, False), (1, 10.0, 3.0, True), (1, 5.0, 1.0, True), (1, 5.0, 0.1, False),
     (3, 5.0, 0.1, True), (0, float("-inf"), 1.0, True)],
)  # fmt: skip
def test_in_doubt_it_flies(landed_state: int, landed_at: float, altitude_m: float, flies: bool) -> None:
    vehicle = Vehicle(
        stack=ARDUCOPTER, armed=True, heartbeat_at=10.0, position_at=10.0, landed_state=landed_state, landed_at=landed_at,
        altitude_m=altitude_m,
    )  # fmt: skip
    assert vehicle.in_air is flies
    vehicle.armed = False
    assert not vehicle.in_air


def test_an_armed_vehicle_whose_place_is_unknown_flies() -> None:
    assert Vehicle(stack=ARDUCOPTER, armed=True, heartbeat_at=10.0).in_air


@pytest.mark.parametrize(("vx", "forward_mps2"), [((100, 12), 2.4), ((600, -10), -2.0), ((300, 0), 0.0)])
def test_it_tells_how_it_speeds_up(vx: tuple[int, int], forward_mps2: float) -> None:
    vehicle = Vehicle(stack=ARDUCOPTER, located=True)
    assert vehicle.forward_mps2 is None
    for i in range(12):
        told = message("GLOBAL_POSITION_INT", lat=1, lon=1, vx=vx[0] + i * vx[1])
        vehicle.take(told, i * 0.05)
    assert vehicle.forward_mps2 == pytest.approx(forward_mps2, abs=0.01)
    assert len(vehicle.courses) < 10, "old ones are forgotten"

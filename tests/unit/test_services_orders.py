"""What a vehicle was told of late: what its known state may not show yet."""

from __future__ import annotations

import pytest
from fractus_core.geo import LocalFrame
from fractus_services.mobility.autopilot import LEG_MPS, VehicleState
from fractus_services.mobility.mavlink.orders import Orders, Velocity

HERE = (39.36, 22.95)
WEST = (0.0, -LEG_MPS, 0.0)


def orders(*legs: tuple[float, float, float]) -> Orders:
    """Legs, each with metres east and north and when it began."""
    found, vehicle = Orders(), VehicleState(lat=HERE[0], lon=HERE[1], altitude_m=10.0)
    for east, north, at in legs:
        lat, lon = LocalFrame(*HERE).latlon(east, north)
        found.go_to(lat, lon, 10.0, vehicle, at)
    return found


@pytest.mark.parametrize(
    ("velocity", "turns"),
    [
        ((5.0, -2.0, 0.0), True),
        ((0.0, 3.0, 0.0), True),
        ((0.6, -8.0, 0.0), True),
        ((0.4, -8.0, 0.0), False),
        ((0.1, 0.0, 0.0), False),
    ],
)
def test_a_leg_is_told_until_the_drone_has_turned_onto_it(velocity: Velocity, turns: bool) -> None:
    told = orders((-100.0, 0.0, 1.0)).since(9.0, velocity)
    assert len(told) == turns
    if turns:
        assert told[0] == pytest.approx(WEST, abs=0.01)


def test_what_follows_it_has_no_effect_before_it_is_old_enough() -> None:
    both = orders((-100.0, 0.0, 1.0), (100.0, 0.0, 9.5))
    assert [leg[1] for leg in both.since(9.0, (5.0, -2.0, 0.0))] == pytest.approx([-LEG_MPS, LEG_MPS])
    assert [leg[1] for leg in both.since(9.6, (5.0, -2.0, 0.0))] == pytest.approx([LEG_MPS])
    assert both.since(10.0, (0.0, 6.0, 0.0)) == (), "it flies east by then"


def test_a_velocity_that_is_held_is_told_until_something_else_is() -> None:
    held = Orders()
    held.fly((0.0, 3.0, 0.0), 1.0)
    assert held.since(9.0, (0.0, 3.0, 0.0)) == ((0.0, 3.0, 0.0),)
    held.fly((0.0, 0.0, 0.0), 10.0)
    assert held.since(9.5, (0.0, 3.0, 0.0)) == ((0.0, 3.0, 0.0), (0.0, 0.0, 0.0))
    assert held.since(10.5, (0.0, 2.0, 0.0)) == ()

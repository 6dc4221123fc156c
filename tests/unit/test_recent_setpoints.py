"""Recent setpoints: a setpoint is pending as long as the vehicle may still react to it."""

from __future__ import annotations

import pytest
from fractus_core.geo import LocalFrame
from fractus_services.mobility.autopilot import LEG_MPS, VehicleState
from fractus_services.mobility.mavlink.mavlink_autopilot import RecentSetpoints, Velocity

POSITION = (39.36, 22.95)
WEST = (0.0, -LEG_MPS, 0.0)


def legs(*targets: tuple[float, float, float]) -> RecentSetpoints:
    """Return setpoints with one leg for each target (metres east, metres north, start time in s)."""
    setpoints = RecentSetpoints()
    vehicle = VehicleState(lat=POSITION[0], lon=POSITION[1], altitude_m=10.0)
    for east, north, at in targets:
        lat, lon = LocalFrame(*POSITION).latlon(east, north)
        setpoints.add_leg(lat, lon, 10.0, vehicle, at)
    return setpoints


@pytest.mark.parametrize(
    ("velocity", "turning"),
    [
        ((5.0, -2.0, 0.0), True),
        ((0.0, 3.0, 0.0), True),
        ((0.6, -8.0, 0.0), True),
        ((0.4, -8.0, 0.0), False),
        ((0.1, 0.0, 0.0), False),
    ],
)
def test_leg_is_pending_until_the_drone_has_turned_onto_it(velocity: Velocity, turning: bool) -> None:
    pending = legs((-100.0, 0.0, 1.0)).pending_since(9.0, velocity)
    assert len(pending) == turning
    if turning:
        assert pending[0] == pytest.approx(WEST, abs=0.01)


def test_earlier_leg_is_not_pending_if_the_later_leg_is_old_enough() -> None:
    setpoints = legs((-100.0, 0.0, 1.0), (100.0, 0.0, 9.5))
    assert [leg[1] for leg in setpoints.pending_since(9.0, (5.0, -2.0, 0.0))] == pytest.approx([-LEG_MPS, LEG_MPS])
    assert [leg[1] for leg in setpoints.pending_since(9.6, (5.0, -2.0, 0.0))] == pytest.approx([LEG_MPS])
    assert setpoints.pending_since(10.0, (0.0, 6.0, 0.0)) == (), "the drone flies to the east, along the later leg"


def test_held_velocity_is_pending_until_another_setpoint_is_sent() -> None:
    setpoints = RecentSetpoints()
    setpoints.add_velocity((0.0, 3.0, 0.0), 1.0)
    assert setpoints.pending_since(9.0, (0.0, 3.0, 0.0)) == ((0.0, 3.0, 0.0),)
    setpoints.add_velocity((0.0, 0.0, 0.0), 10.0)
    assert setpoints.pending_since(9.5, (0.0, 3.0, 0.0)) == ((0.0, 3.0, 0.0), (0.0, 0.0, 0.0))
    assert setpoints.pending_since(10.5, (0.0, 2.0, 0.0)) == ()

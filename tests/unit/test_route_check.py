"""State of the drone after the calls of a route."""

from __future__ import annotations

from dataclasses import replace

import pytest
from fractus_core.policy.decision_types import Args, Call, GotoArgs, Home, SetSpeedArgs, Situation, TakeoffArgs, Verdict
from fractus_core.policy.route_check import after, at_rest

NOW = Situation(0.0, 39.36, 22.95, 5.0, home=Home(39.35, 22.94, 10.0), in_air=True)


class Grant:
    """The part of a Grant that altitudes need."""

    flat_terrain = False


def _after(method: str, args: Args = None, corrected: Args = None, now: Situation = NOW) -> Situation:
    verdict = Verdict("correct" if corrected is not None else "allow", corrected if corrected is not None else args)
    return after(Call(method, args), verdict, now, Grant())  # type: ignore[arg-type]


def test_leg_ends_at_the_corrected_target() -> None:
    state = _after("Goto", GotoArgs(39.37, 22.95, 20.0), GotoArgs(39.365, 22.95, 15.0))
    assert (state.lat, state.altitude_m) == (39.365, 15.0)


def test_altitude_above_sea_level_becomes_an_altitude_above_home() -> None:
    assert _after("Goto", GotoArgs(39.37, 22.95, 40.0, "amsl")).altitude_m == 30.0


def test_takeoff_in_the_air_does_not_descend() -> None:
    assert _after("Takeoff", TakeoffArgs(3.0)).altitude_m == 5.0
    state = _after("Takeoff", TakeoffArgs(12.0), now=replace(NOW, altitude_m=0.0, in_air=False))
    assert (state.altitude_m, state.in_air) == (12.0, True)


def test_speed_applies_to_the_following_legs() -> None:
    assert _after("SetSpeed", SetSpeedArgs(9.0), SetSpeedArgs(7.0)).speed_setpoint_mps == 7.0


@pytest.mark.parametrize(("method", "lat"), [("Land", 39.36), ("ReturnToLaunch", 39.35)])
def test_landing_ends_on_the_ground(method: str, lat: float) -> None:
    state = _after(method)
    assert (state.lat, state.altitude_m, state.in_air) == (lat, 0.0, False)


def test_drone_at_rest_is_armed_and_does_not_move() -> None:
    state = at_rest(replace(NOW, north_mps=5.0, pending=((3.0, 0.0, 0.0),), forward_mps2=1.0))
    assert state.armed
    assert not state.is_moving
    assert state.forward_mps2 is None

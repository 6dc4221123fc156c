"""The guarantee of docs/mobility.md, cell by cell: what a drone keeps from a zone, over links of every delay and in wind."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from closed_loop import Weather
from fractus_core.policy.motion import stop_point
from fractus_core.policy.values import Situation
from link_flights import appears, attempt, both, straight

KEPT_M = 1.0
"""What docs/mobility.md promises of velocities and legs."""


def weather(delay_s: float, wind_mps: float = 0.0, *, loss: float = 0.0, speedup: int = 1) -> Weather:
    """A link that delays by at most so much, there and back: its frames come up to half again as late as the least."""
    return Weather(
        there_s=delay_s * 0.6 / 1.5, back_s=delay_s * 0.4 / 1.5, wind_mps=wind_mps, gusts_mps=wind_mps / 6, loss=loss,
        speedup=speedup,
    )  # fmt: skip


@pytest.mark.parametrize("wind_mps", [0.0, 6.0])
@pytest.mark.parametrize("delay_s", [0.0, 0.1, 0.25, 0.5])
def test_velocities_keep_their_distance(delay_s: float, wind_mps: float) -> None:
    flown = attempt(both, 7, weather(delay_s, wind_mps))
    assert flown.kept_m >= KEPT_M
    assert flown.kept_m < 15.0, "the driver came near enough to find out"
    assert flown.permitted > 50
    assert flown.denied > 20


def test_velocities_keep_their_distance_where_frames_are_lost() -> None:
    flown = attempt(both, 8, weather(0.5, 3.0, loss=0.1))
    assert flown.kept_m >= KEPT_M
    assert flown.permitted > 50


@pytest.mark.parametrize("speedup", [2, 3, 5])
def test_velocities_keep_their_distance_from_a_simulator_that_runs_faster(speedup: int) -> None:
    flown = attempt(both, 9, weather(0.02, speedup=speedup))
    assert flown.kept_m >= KEPT_M
    assert flown.permitted > 30


@pytest.mark.parametrize(("who", "speedup"), [("vehicle", 3), ("service", 5), ("vehicle", 5)])
def test_velocities_keep_their_distance_on_a_machine_that_stalls_one_side(who: str, speedup: int) -> None:
    """For a third of a second: of a fast vehicle's time more than a second, in which its position is not known."""
    flown = attempt(straight, 10, replace(weather(0.02, speedup=speedup), stall=(who, 0.35)))
    assert flown.kept_m >= KEPT_M
    assert flown.permitted > 5
    assert (flown.unavailable > 0) == (who == "vehicle")
    assert flown.account is not None
    assert not any("driver lost" in event for event in flown.account.events[:-3]), "who has the drone keeps it"


NOTICED_S = 0.15
"""Until the monitor has looked, and the link's own jitter."""


def needed_m(delay_s: float, speed_mps: float) -> float:
    """How far ahead a zone may appear: the last column of the table."""
    now = Situation(0.0, north_mps=speed_mps, latency_s=delay_s + 0.3, forward_mps2=0.0, speed_setpoint_mps=speed_mps)
    return math.hypot(*stop_point(now, (0.0, 0.0))) + NOTICED_S * speed_mps + 2.0


@pytest.mark.parametrize(("delay_s", "seed"), [(0.0, 1), (0.1, 2), (0.25, 3), (0.5, 4)])
def test_a_zone_that_appears_far_enough_ahead_is_not_entered(delay_s: float, seed: int) -> None:
    flown = attempt(appears(needed_m(delay_s, 10.0)), seed, weather(delay_s))
    assert 0.0 < flown.kept_m < 12.0


def test_a_link_that_delays_by_more_than_can_be_flown_with_lets_nothing_take_off() -> None:
    flown = attempt(both, 3, weather(2.2))
    assert flown.kept_m == math.inf
    assert flown.permitted == 0

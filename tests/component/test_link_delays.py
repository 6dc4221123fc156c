"""The guarantee of docs/mobility.md, cell by cell: what a drone keeps from a zone, over links of every delay and in wind."""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from pathlib import Path

import pytest
from closed_loop import Weather
from depth import cells
from fractus_services.mobility.mavlink.timing import Timing
from link_flights import Attempt, appears, as_fast_as_let, attempt, both, straight

KEPT_M = 1.0
"""What docs/mobility.md promises of velocities and legs."""


def weather(
    delay_s: float, wind_mps: float = 0.0, *, loss: float = 0.0, speedup: int = 1, error_m: float = 0.0
) -> Weather:
    """A link that delays by at most so much, there and back: its frames come up to half again as late as the least."""
    return Weather(
        there_s=delay_s * 0.6 / 1.5, back_s=delay_s * 0.4 / 1.5, wind_mps=wind_mps, gusts_mps=wind_mps / 6, loss=loss,
        speedup=speedup, error_m=error_m,
    )  # fmt: skip


COSTS_M = 0.3
"""What a slow link may cost of the distance: it costs room ahead instead, for the delay is counted."""


@functools.cache
def flown_at_once(wind_mps: float, error_m: float) -> Attempt:
    """The flight without a delay."""
    return attempt(as_fast_as_let, 7, weather(0.0, wind_mps, error_m=error_m))


CALM = (0.0, 0.5)
WINDY = (6.0, 5.0)
"""Wind in m/s, and how far from the truth a position is, in metres."""


@pytest.mark.parametrize(
    ("delay_s", "air"),
    cells(
        [0.0, 0.1, 0.25, 0.5], [CALM, (6.0, 0.5), (0.0, 2.0), WINDY], quick=[(0.0, CALM), (0.5, CALM), (0.25, WINDY)]
    ),
)
def test_velocities_keep_their_distance(delay_s: float, air: tuple[float, float]) -> None:
    wind_mps, error_m = air
    first = flown_at_once(wind_mps, error_m)
    flown = attempt(as_fast_as_let, 7, weather(delay_s, wind_mps, error_m=error_m)) if delay_s else first
    assert flown.kept_m >= max(KEPT_M, first.kept_m - COSTS_M)
    assert flown.kept_m < 15.0, "the driver came near enough to find out"
    assert flown.permitted > 10
    assert flown.denied > 20


def test_a_delay_that_is_not_measured_costs_the_distance(monkeypatch: pytest.MonkeyPatch) -> None:
    """So would a figure that is taken for granted, which the cells above must notice."""
    first = flown_at_once(0.0, 0.5)
    measured = Timing.latency_s
    monkeypatch.setattr(Timing, "latency_s", lambda self, now: min(measured(self, now), 0.3))
    assert attempt(as_fast_as_let, 7, weather(0.5, error_m=0.5)).kept_m < first.kept_m - COSTS_M


def test_a_position_error_that_is_not_told_costs_the_distance() -> None:
    lying = replace(weather(0.0, error_m=5.0), claimed_error_m=0.3)
    assert attempt(as_fast_as_let, 7, lying).kept_m < KEPT_M


def test_velocities_keep_their_distance_where_frames_are_lost() -> None:
    flown = attempt(both, 8, weather(0.5, 3.0, loss=0.1))
    assert flown.kept_m >= KEPT_M
    assert flown.permitted > 50


@pytest.mark.parametrize("speedup", cells([2, 3, 5], quick=[5]))
def test_velocities_keep_their_distance_from_a_simulator_that_runs_faster(speedup: int) -> None:
    flown = attempt(both, 9, weather(0.02, speedup=speedup))
    assert flown.kept_m >= KEPT_M
    assert flown.permitted > 30


@pytest.mark.parametrize(
    ("who", "speedup"), cells([("vehicle", 3), ("service", 5), ("vehicle", 5)], quick=[("service", 5), ("vehicle", 5)])
)
def test_velocities_keep_their_distance_on_a_machine_that_stalls_one_side(who: str, speedup: int) -> None:
    """For a third of a second: of a fast vehicle's time more than a second, in which its position is not known."""
    flown = attempt(straight, 10, replace(weather(0.02, speedup=speedup), stall=(who, 0.35)))
    assert flown.kept_m >= KEPT_M
    assert flown.permitted > 2, "it flies, though most of what is asked for comes late"
    assert (flown.unavailable > 0) == (who == "vehicle")
    assert flown.account is not None
    assert not any("driver lost" in event for event in flown.account.events[:-3]), "who has the drone keeps it"


AHEAD_M = {0.0: (12.0, 31.0), 0.1: (13.0, 32.0), 0.25: (13.0, 33.0), 0.5: (15.0, 36.0)}
"""How far ahead a zone may appear by the delay, at 5 and at 10 m/s: the last columns of the table."""


SLOW = (5.0, 0.5)
FAST = (10.0, 0.5)
AHEAD = (10.0, 5.0)
BEHIND = (10.0, -5.0)
"""Speed in m/s, and how far ahead of where it believes to be the drone is, in metres."""


@pytest.mark.parametrize(
    ("delay_s", "motion"),
    cells(AHEAD_M, [SLOW, FAST, AHEAD, BEHIND], quick=[(0.0, BEHIND), (0.1, SLOW), (0.25, FAST), (0.5, AHEAD)]),
)
def test_a_zone_that_appears_far_enough_ahead_is_not_entered(delay_s: float, motion: tuple[float, float]) -> None:
    speed_mps, error_m = motion
    ahead_m = AHEAD_M[delay_s][speed_mps == 10.0]
    flown = attempt(appears(ahead_m, speed_mps), 1 + list(AHEAD_M).index(delay_s), weather(delay_s, error_m=error_m))
    assert 0.0 < flown.kept_m < 16.0


def test_the_table_says_what_is_flown() -> None:
    table = (Path(__file__).parents[2] / "docs" / "mobility.md").read_text()
    for delay_s, (slow_m, fast_m) in AHEAD_M.items():
        row = f"| {delay_s:g}{' s' if delay_s else ''} | {KEPT_M:g} m | {KEPT_M:g} m | {KEPT_M:g} m | {slow_m:g} m | {fast_m:g} m |"
        assert row in table


def test_a_link_that_delays_by_more_than_can_be_flown_with_lets_nothing_take_off() -> None:
    flown = attempt(both, 3, weather(2.2))
    assert flown.kept_m == math.inf
    assert flown.permitted == 0

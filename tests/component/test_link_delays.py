"""Distances between drone and zone that docs/mobility.md guarantees for each link delay, with and without wind."""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from pathlib import Path

import pytest
from closed_loop import Weather
from depth import cells
from fractus_services.mobility.mavlink.timing import Timing
from link_flights import Attempt, at_highest_permitted_speed, attempt, both, straight, wall_added_ahead

GUARANTEED_M = 1.0
"""Distance that docs/mobility.md guarantees for velocities and legs."""


def weather(
    delay_s: float, wind_mps: float = 0.0, *, loss: float = 0.0, speedup: int = 1, error_m: float = 0.0
) -> Weather:
    """Return an environment whose link has the given maximum round-trip delay.

    The jitter is half of the minimum delay.
    """
    return Weather(
        uplink_s=delay_s * 0.6 / 1.5, downlink_s=delay_s * 0.4 / 1.5, wind_mps=wind_mps, gusts_mps=wind_mps / 6, loss=loss,
        speedup=speedup, error_m=error_m,
    )  # fmt: skip


DELAY_COST_M = 0.3
"""Maximum reduction of the distance by a slow link.

The service measures the delay and stops the drone earlier, so the distance is almost the same.
"""


@functools.cache
def flight_without_delay(wind_mps: float, error_m: float, seed: int = 7) -> Attempt:
    """Return the result of a flight without link delay."""
    return attempt(at_highest_permitted_speed, seed, weather(0.0, wind_mps, error_m=error_m))


CALM = (0.0, 0.5)
WINDY = (6.0, 5.0)
"""Pairs of wind in m/s and position error in metres."""


@pytest.mark.parametrize(
    ("delay_s", "conditions"),
    cells(
        [0.0, 0.1, 0.25, 0.5], [CALM, (6.0, 0.5), (0.0, 2.0), WINDY], quick=[(0.0, CALM), (0.5, CALM), (0.25, WINDY)]
    ),
)
def test_velocity_setpoints_keep_the_guaranteed_distance(delay_s: float, conditions: tuple[float, float]) -> None:
    wind_mps, error_m = conditions
    undelayed = flight_without_delay(wind_mps, error_m)
    flown = (
        attempt(at_highest_permitted_speed, 7, weather(delay_s, wind_mps, error_m=error_m)) if delay_s else undelayed
    )
    assert flown.least_distance_m >= max(GUARANTEED_M, undelayed.least_distance_m - DELAY_COST_M)
    assert flown.least_distance_m < 15.0, "the drone came close to the wall"
    assert flown.permitted > 10
    assert flown.denied > 20


def test_unmeasured_delay_reduces_the_distance(monkeypatch: pytest.MonkeyPatch) -> None:
    """In this test, the service never measures a delay above 0.3 s. The tests above would detect this error."""
    first = flight_without_delay(0.0, 0.5, seed=8)
    measured = Timing.latency_s
    monkeypatch.setattr(Timing, "latency_s", lambda self, now: min(measured(self, now), 0.3))
    assert (
        attempt(at_highest_permitted_speed, 8, weather(0.5, error_m=0.5)).least_distance_m
        < first.least_distance_m - DELAY_COST_M
    )


def test_unreported_position_error_reduces_the_distance() -> None:
    unreported = replace(weather(0.0, error_m=5.0), claimed_error_m=0.3)
    assert attempt(at_highest_permitted_speed, 7, unreported).least_distance_m < GUARANTEED_M


def test_velocity_setpoints_keep_the_guaranteed_distance_despite_frame_loss() -> None:
    flown = attempt(both, 8, weather(0.5, 3.0, loss=0.1))
    assert flown.least_distance_m >= GUARANTEED_M
    assert flown.permitted > 50


@pytest.mark.parametrize("speedup", cells([2, 3, 5], quick=[5]))
def test_velocity_setpoints_keep_the_guaranteed_distance_with_a_faster_simulator(speedup: int) -> None:
    flown = attempt(both, 9, weather(0.02, speedup=speedup))
    assert flown.least_distance_m >= GUARANTEED_M
    assert flown.permitted > 30


@pytest.mark.parametrize(
    ("process", "speedup"),
    cells([("vehicle", 3), ("service", 5), ("vehicle", 5)], quick=[("service", 5), ("vehicle", 5)]),
)
def test_velocity_setpoints_keep_the_guaranteed_distance_despite_stalls(process: str, speedup: int) -> None:
    """A stall of 0.35 s lasts more than a second on the clock of a vehicle that is simulated faster than real time.

    If the vehicle stalls, its position is unknown during the stall.
    """
    flown = attempt(straight, 10, replace(weather(0.02, speedup=speedup), stall=(process, 0.35)))
    assert flown.least_distance_m >= GUARANTEED_M
    assert flown.permitted > 2, "the service permits some setpoints although most of them arrive late"
    assert (flown.unavailable > 0) == (process == "vehicle")
    assert flown.account is not None
    assert not any("driver lost" in event for event in flown.account.events[:-3]), "the driver keeps control"


AHEAD_M = {0.0: (12.0, 31.0), 0.1: (13.0, 32.0), 0.25: (13.0, 33.0), 0.5: (15.0, 36.0)}
"""For each delay in s: distances at which the drone can still stop before a new zone, at 5 and at 10 m/s.

The distances are the last columns of the table in docs/mobility.md.
"""


SLOW = (5.0, 0.5)
FAST = (10.0, 0.5)
AHEAD = (10.0, 5.0)
BEHIND = (10.0, -5.0)
"""Pairs of speed in m/s and distance of the true position ahead of the estimated position in metres."""


@pytest.mark.parametrize(
    ("delay_s", "motion"),
    cells(AHEAD_M, [SLOW, FAST, AHEAD, BEHIND], quick=[(0.0, BEHIND), (0.1, SLOW), (0.25, FAST), (0.5, AHEAD)]),
)
def test_zone_added_far_enough_ahead_is_not_entered(delay_s: float, motion: tuple[float, float]) -> None:
    speed_mps, error_m = motion
    ahead_m = AHEAD_M[delay_s][speed_mps == 10.0]
    flown = attempt(
        wall_added_ahead(ahead_m, speed_mps), 1 + list(AHEAD_M).index(delay_s), weather(delay_s, error_m=error_m)
    )
    assert 0.0 < flown.least_distance_m < 16.0


def test_documented_table_matches_tested_distances() -> None:
    table = (Path(__file__).parents[2] / "docs" / "mobility.md").read_text()
    for delay_s, (slow_m, fast_m) in AHEAD_M.items():
        row = f"| {delay_s:g}{' s' if delay_s else ''} | {GUARANTEED_M:g} m | {GUARANTEED_M:g} m | {GUARANTEED_M:g} m | {slow_m:g} m | {fast_m:g} m |"
        assert row in table


def test_takeoff_is_refused_over_a_too_slow_link() -> None:
    flown = attempt(both, 3, weather(2.2))
    assert flown.least_distance_m == math.inf
    assert flown.permitted == 0

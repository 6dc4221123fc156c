"""Digests of all messages that the simulated vehicle sends in given flights. Refactoring must not change them.

After an intended change of behaviour, `python tests/component/test_vehicle_golden.py` prints the new digests.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest
from vehicle_flights import at_random, breaches, by_hand, failing, mission, pilot_of, smart_return
from vehicle_pilot import Pilot

FLIGHTS: tuple[tuple[Callable[[Pilot], None], int, dict[str, float], str], ...] = (
    (mission, 2, {"SIM_WIND_SPD": 5.0, "SIM_WIND_TURB": 1.5, "WP_YAW_BEHAVIOR": 0.0}, "99469accccc88673"),
    (by_hand, 3, {"SIM_WIND_SPD": 4.0, "SIM_WIND_TURB": 2.0}, "891d43c7dd03c903"),
    (smart_return, 4, {}, "d2b5b3b2d69a0b49"),
    (breaches, 5, {}, "2356db92c8ffe468"),
    (breaches, 6, {"FENCE_ACTION": 3.0}, "34486dd037334bea"),
    (failing, 7, {}, "8c19001e99e0e0da"),
    (at_random, 10, {}, "c9b9219166b54fb3"),
    (at_random, 17, {}, "0da2e3b02a800de4"),
)


def digest(flight: Callable[[Pilot], None], seed: int, parameters: dict[str, float]) -> str:
    """Fly and return the digest of all received messages."""
    pilot = pilot_of(seed, **parameters)
    flight(pilot)
    return pilot.digest.hexdigest()[:16]


@pytest.mark.parametrize(
    ("flight", "seed", "parameters", "expected"),
    FLIGHTS,
    ids=[f"{flight.__name__}-{seed}" for flight, seed, _, _ in FLIGHTS],
)
def test_golden_flight_matches_recorded_digest(
    flight: Callable[[Pilot], None], seed: int, parameters: dict[str, float], expected: str
):
    assert digest(flight, seed, parameters) == expected


if __name__ == "__main__":
    for flight, seed, parameters, _ in FLIGHTS:
        print(f'({flight.__name__}, {seed}, {parameters}, "{digest(flight, seed, parameters)}"),')

"""A few random flights of the complete mobility service on the simulated vehicle.

`bench/closed_loop.py` runs hundreds of these flights.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import pytest
from closed_loop import Weather, flight, position_fault_of, weather_of
from depth import cells, examples
from fractus_services.mobility.flight import monitor as monitor_module


@pytest.mark.parametrize("seed", range(1, 1 + examples(60, 2)))
def test_random_flight_violates_no_rule(seed: int, tmp_path: Path) -> None:
    account = flight(seed, tmp_path)
    assert account.wrong == [], "\n".join(account.events)


@pytest.mark.parametrize("speedup", cells([2, 3, 5], quick=[5]))
@pytest.mark.parametrize("seed", range(501, 501 + examples(10, 1)))
def test_random_flight_with_faster_simulator_violates_no_rule(seed: int, speedup: int, tmp_path: Path) -> None:
    account = flight(seed, tmp_path, replace(weather_of(seed), loss=0.0, cut=None, speedup=speedup))
    assert account.wrong == [], "\n".join(account.events)


@pytest.mark.parametrize("kind", cells(["glitch", "second", "jump", "altitude", "drift"], quick=["jump", "drift"]))
def test_random_flight_with_position_fault_violates_no_rule(kind: str, tmp_path: Path) -> None:
    seeds = (seed for seed in itertools.count(1) if fault_kind(seed) == kind)
    for seed in itertools.islice(seeds, examples(6, 1)):
        account = flight(seed, tmp_path, replace(weather_of(seed), cut=None, fault=position_fault_of(seed, 1.0)))
        assert account.wrong == [], "\n".join(account.events)


def fault_kind(seed: int) -> str:
    fault = position_fault_of(seed, 1.0)
    assert fault is not None
    return fault.kind


def test_oracle_detects_missing_monitor(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(monitor_module, "monitor", lambda *_, **__: None)
    assert any(flight(seed, tmp_path, Weather()).wrong for seed in range(2, 30))

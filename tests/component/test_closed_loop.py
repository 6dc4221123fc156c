"""Some random flights of the complete mobility service on the simulated vehicle.

`bench/closed_loop.py` runs hundreds of these flights.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from closed_loop import Weather, flight, weather_of
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


def test_oracle_detects_missing_monitor(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(monitor_module, "monitor", lambda *_, **__: None)
    assert any(flight(seed, tmp_path, Weather()).wrong for seed in range(2, 30))

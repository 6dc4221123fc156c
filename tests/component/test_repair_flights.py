"""Some random flights that select a repair. `bench/closed_loop.py --repairs` flies hundreds of them."""

from __future__ import annotations

from pathlib import Path

import pytest
from depth import examples
from fractus_services.mobility.authority.control_store import ControlStore
from repair_flights import REPAIRS, repair_flight


@pytest.mark.parametrize("seed", range(len(REPAIRS) * examples(10, 1)))
def test_random_violation_ends_as_its_repair_demands(seed: int, tmp_path: Path) -> None:
    account = repair_flight(seed, tmp_path)
    assert account.wrong == [], "\n".join(account.events)


def test_oracle_detects_missing_landing_place(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(ControlStore, "landing_place", None)
    assert any(repair_flight(seed, tmp_path).wrong for seed in range(REPAIRS.index("abort"), 40, len(REPAIRS)))


def test_oracle_detects_missing_suspension(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(ControlStore, "suspension", None)
    assert any(repair_flight(seed, tmp_path).wrong for seed in range(REPAIRS.index("suspend"), 40, len(REPAIRS)))


def test_oracle_detects_ignored_loss_of_contact(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(ControlStore, "check_contact", lambda _store: None)
    assert any(repair_flight(seed, tmp_path).wrong for seed in range(REPAIRS.index("lose"), 40, len(REPAIRS)))

"""Preloaded library for chaos runs: it steps the clock of selected services."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import cast

import pytest
from fractus_sim.chaos.chaos_cluster import ChaosTarget
from fractus_sim.chaos.chaos_faults import FAULTS, inject
from fractus_sim.chaos.clock_faults import can_step, install_library, library_environment, set_offset
from fractus_sim.errors import ExperimentError

DAY_S = 86_400.0

PROGRAM = """
import datetime, sys, threading, time
for _ in sys.stdin:
    began = time.monotonic()
    threading.Event().wait(0.01)
    waited = time.monotonic() - began
    print(time.time(), time.clock_gettime(time.CLOCK_REALTIME), datetime.datetime.now().timestamp(), waited, flush=True)
"""


class ClockProcess:
    """A process with the preloaded library.

    On request, it prints its clocks and the measured duration of a 10 ms wait.
    """

    def __init__(self, environment: dict[str, str]) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **environment},
            text=True,
        )

    def is_ahead(self, offset_s: float) -> bool:
        """Return True if all clocks of the child process are ahead of the test's clock by the offset."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        began_s = time.time()
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        *times, waited_s = map(float, self.process.stdout.readline().split())
        assert 0.01 <= waited_s < 5
        return all(began_s <= time_s - offset_s <= time.time() for time_s in times)


@pytest.fixture
def clocked(tmp_path: Path) -> Iterator[dict[str, ClockProcess]]:
    """A process for each of two services."""
    install_library([tmp_path])
    running = {
        service: ClockProcess(library_environment(tmp_path / "chaos", service)) for service in ("agent", "mobility")
    }
    yield running
    for clock_process in running.values():
        clock_process.process.kill()
        clock_process.process.communicate()


def test_clock_offset_applies_only_to_the_selected_services(clocked: dict[str, ClockProcess], tmp_path: Path) -> None:
    agent = clocked["agent"]
    mobility = clocked["mobility"]
    assert agent.is_ahead(0)
    assert mobility.is_ahead(0)
    for offset_s in (DAY_S, -DAY_S, -30.5, 0.0):
        set_offset(tmp_path, ("mobility",), offset_s)
        assert mobility.is_ahead(offset_s)
        assert agent.is_ahead(0)
    set_offset(tmp_path, ("agent", "mobility"), 30.0)
    assert agent.is_ahead(30)
    assert mobility.is_ahead(30)


def test_clock_offset_applies_to_a_process_that_starts_later(clocked: dict[str, ClockProcess], tmp_path: Path) -> None:
    set_offset(tmp_path, ("mobility",), DAY_S)
    clocked["later"] = ClockProcess(library_environment(tmp_path / "chaos", "mobility"))
    assert clocked["later"].is_ahead(DAY_S)


def test_clock_offset_is_reset_when_the_library_is_installed(clocked: dict[str, ClockProcess], tmp_path: Path) -> None:
    set_offset(tmp_path, ("mobility",), DAY_S)
    install_library([tmp_path])
    assert clocked["mobility"].is_ahead(0)
    assert can_step(tmp_path)


def test_clock_fault_steps_clocks_and_resets_them_at_the_end(clocked: dict[str, ClockProcess], tmp_path: Path) -> None:
    target = cast("ChaosTarget", SimpleNamespace(state=tmp_path, drone="drone-1"))
    stepped = set()
    for seed in range(20):
        with inject(FAULTS["clock-jump"], target, Random(seed)) as description:
            ahead = tuple(name for name, process in clocked.items() if not process.is_ahead(0))
            stepped.add(ahead)
            assert all(name in description for name in ahead)
        assert all(process.is_ahead(0) for process in clocked.values())
    assert stepped == {(), ("agent",), ("mobility",), ("agent", "mobility")}


def test_clock_fault_is_rejected_if_the_library_is_not_installed(tmp_path: Path) -> None:
    target = cast("ChaosTarget", SimpleNamespace(state=tmp_path, drone="drone-1"))
    with pytest.raises(ExperimentError, match="cannot be stepped"), inject(FAULTS["clock-jump"], target, Random(1)):
        pass

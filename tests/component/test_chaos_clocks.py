"""Chaos runs step the clock of one service by a library that the service preloads."""

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
from fractus_sim.chaos.chaos_cluster import Stage
from fractus_sim.chaos.chaos_faults import FAULTS, broken
from fractus_sim.chaos.clock_faults import can_step, furnish, loaded, step
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
    """Process that loads the library. For each line of input it prints the time and the duration of a 10 ms wait."""

    def __init__(self, environment: dict[str, str]) -> None:
        self.popen = subprocess.Popen(
            [sys.executable, "-c", PROGRAM],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **environment},
            text=True,
        )

    def is_ahead(self, offset_s: float) -> bool:
        """Return True if all clock functions of the process are ahead of this process by the offset."""
        assert self.popen.stdin is not None
        assert self.popen.stdout is not None
        began_s = time.time()
        self.popen.stdin.write("\n")
        self.popen.stdin.flush()
        *times, waited_s = map(float, self.popen.stdout.readline().split())
        assert 0.01 <= waited_s < 5
        return all(began_s <= time_s - offset_s <= time.time() for time_s in times)


@pytest.fixture
def clocked(tmp_path: Path) -> Iterator[dict[str, ClockProcess]]:
    """Processes of two services, with their state in one directory."""
    furnish([tmp_path])
    running = {service: ClockProcess(loaded(tmp_path / "chaos", service)) for service in ("agent", "mobility")}
    yield running
    for process in running.values():
        process.popen.kill()
        process.popen.communicate()


def test_step_affects_only_the_named_services(clocked: dict[str, ClockProcess], tmp_path: Path) -> None:
    agent = clocked["agent"]
    mobility = clocked["mobility"]
    assert agent.is_ahead(0)
    assert mobility.is_ahead(0)
    for offset_s in (DAY_S, -DAY_S, -30.5, 0.0):
        step(tmp_path, ("mobility",), offset_s)
        assert mobility.is_ahead(offset_s)
        assert agent.is_ahead(0)
    step(tmp_path, ("agent", "mobility"), 30.0)
    assert agent.is_ahead(30)
    assert mobility.is_ahead(30)


def test_process_started_after_a_step_has_the_stepped_clock(clocked: dict[str, ClockProcess], tmp_path: Path) -> None:
    step(tmp_path, ("mobility",), DAY_S)
    clocked["later"] = ClockProcess(loaded(tmp_path / "chaos", "mobility"))
    assert clocked["later"].is_ahead(DAY_S)


def test_furnish_resets_stepped_clocks(clocked: dict[str, ClockProcess], tmp_path: Path) -> None:
    step(tmp_path, ("mobility",), DAY_S)
    furnish([tmp_path])
    assert clocked["mobility"].is_ahead(0)
    assert can_step(tmp_path)


def test_clock_fault_steps_clocks_and_resets_them(clocked: dict[str, ClockProcess], tmp_path: Path) -> None:
    stage = cast("Stage", SimpleNamespace(state=tmp_path, drone="drone-1"))
    stepped = set()
    for seed in range(20):
        with broken(FAULTS["clock-jump"], stage, Random(seed)) as description:
            ahead = tuple(name for name, process in clocked.items() if not process.is_ahead(0))
            stepped.add(ahead)
            assert all(name in description for name in ahead)
        assert all(process.is_ahead(0) for process in clocked.values())
    assert stepped == {(), ("agent",), ("mobility",), ("agent", "mobility")}


def test_clock_fault_is_refused_if_no_service_loads_the_library(tmp_path: Path) -> None:
    stage = cast("Stage", SimpleNamespace(state=tmp_path, drone="drone-1"))
    with pytest.raises(ExperimentError, match="cannot be stepped"), broken(FAULTS["clock-jump"], stage, Random(1)):
        pass

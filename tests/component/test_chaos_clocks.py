"""The library by which chaos steps the clock of one service, in processes that load it."""

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
from fractus_sim.chaos.clocks import can_step, furnish, loaded, step
from fractus_sim.chaos.faults import FAULTS, broken
from fractus_sim.chaos.stage import Stage
from fractus_sim.demo.kube import DemoError

DAY_S = 86_400.0

PROGRAM = """
import datetime, sys, threading, time
for _ in sys.stdin:
    began = time.monotonic()
    threading.Event().wait(0.01)
    waited = time.monotonic() - began
    print(time.time(), time.clock_gettime(time.CLOCK_REALTIME), datetime.datetime.now().timestamp(), waited, flush=True)
"""


class Clocked:
    """A process that loads the library and says the time, and how long it waited when it was to wait 10 ms."""

    def __init__(self, environment: dict[str, str]) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **environment},
            text=True,
        )

    def is_ahead(self, offset_s: float) -> bool:
        """Whether it is ahead of this process by so much, in each way to ask for the time."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        began_s = time.time()
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        *times, waited_s = map(float, self.process.stdout.readline().split())
        assert 0.01 <= waited_s < 5
        return all(began_s <= time_s - offset_s <= time.time() for time_s in times)


@pytest.fixture
def clocked(tmp_path: Path) -> Iterator[dict[str, Clocked]]:
    """A process for each of two services, with their state in a directory."""
    furnish([tmp_path])
    running = {service: Clocked(loaded(tmp_path / "chaos", service)) for service in ("agent", "mobility")}
    yield running
    for each in running.values():
        each.process.kill()
        each.process.communicate()


def test_a_service_is_stepped_and_no_other(clocked: dict[str, Clocked], tmp_path: Path) -> None:
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


def test_a_process_that_starts_meanwhile_has_the_same_clock(clocked: dict[str, Clocked], tmp_path: Path) -> None:
    step(tmp_path, ("mobility",), DAY_S)
    clocked["later"] = Clocked(loaded(tmp_path / "chaos", "mobility"))
    assert clocked["later"].is_ahead(DAY_S)


def test_a_run_begins_with_clocks_that_go_right(clocked: dict[str, Clocked], tmp_path: Path) -> None:
    step(tmp_path, ("mobility",), DAY_S)
    furnish([tmp_path])
    assert clocked["mobility"].is_ahead(0)
    assert can_step(tmp_path)


def test_the_fault_steps_a_clock_and_sets_it_right_again(clocked: dict[str, Clocked], tmp_path: Path) -> None:
    stage = cast("Stage", SimpleNamespace(state=tmp_path, drone="drone-1"))
    stepped = set()
    for seed in range(20):
        with broken(FAULTS["clock-jump"], stage, Random(seed)) as said:
            ahead = tuple(name for name, each in clocked.items() if not each.is_ahead(0))
            stepped.add(ahead)
            assert all(name in said for name in ahead)
        assert all(each.is_ahead(0) for each in clocked.values())
    assert stepped == {(), ("agent",), ("mobility",), ("agent", "mobility")}


def test_clocks_that_services_do_not_load_are_left_alone(tmp_path: Path) -> None:
    stage = cast("Stage", SimpleNamespace(state=tmp_path, drone="drone-1"))
    with pytest.raises(DemoError, match="cannot be stepped"), broken(FAULTS["clock-jump"], stage, Random(1)):
        pass

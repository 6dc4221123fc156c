"""Measurement of programs: processor time and memory equal those that the program itself reports."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from fractus_sim.testbeds import resource_meter
from fractus_sim.testbeds.resource_meter import ResourceMeter

PROGRAM = """
import json, resource, subprocess, sys, time
block = bytearray(b"x" * (60 * 2**20))
if len(sys.argv) < 2:
    subprocess.run([sys.executable, sys.argv[0], "child"], check=True)
while time.process_time() < 0.4:
    pass
if len(sys.argv) < 2:
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    memory = int(open("/proc/self/statm").read().split()[1]) * resource.getpagesize() / 2**20
    print(json.dumps([sum(u.ru_utime + u.ru_stime for u in usages), memory]), flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def program(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    (tmp_path / "program.py").write_text(PROGRAM)
    command = [sys.executable, str(tmp_path / "program.py")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        yield process


def test_measured_resources_equal_those_of_the_program_and_its_children(
    program: subprocess.Popen[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resource_meter, "INTERVAL_S", 0.0)
    meter = ResourceMeter()
    meter.add("p", "drone-1", program.pid)
    assert program.stdout is not None
    cpu_s, memory_mib = json.loads(program.stdout.readline())
    meter.measure()
    usage = meter.usages["p"]
    assert usage.vehicle == "drone-1"
    assert usage.cpu_s == pytest.approx(cpu_s, rel=0.1)
    assert usage.mean_memory_mib == usage.peak_memory_mib == pytest.approx(memory_mib, rel=0.1)
    assert usage.cpu == pytest.approx(usage.cpu_s / usage.wall_s)


def test_usage_of_an_ended_program_stays(program: subprocess.Popen[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resource_meter, "INTERVAL_S", 0.0)
    meter = ResourceMeter()
    meter.add("p", "drone-1", program.pid)
    assert program.stdin is not None
    meter.measure()
    before = meter.usages["p"]
    program.stdin.close()
    program.wait()
    meter.measure()
    assert meter.usages["p"] == before


def test_program_is_measured_at_most_once_per_interval(program: subprocess.Popen[str]) -> None:
    meter = ResourceMeter()
    meter.add("p", "drone-1", program.pid)
    meter.measure()
    before = meter.usages["p"]
    meter.measure()
    assert meter.usages["p"] == before
    time.sleep(resource_meter.INTERVAL_S)
    meter.measure()
    assert meter.usages["p"].wall_s > before.wall_s


def test_program_that_has_already_ended_is_not_measured() -> None:
    meter = ResourceMeter()
    meter.add("p", "drone-1", 2**22 + 1)
    meter.measure()
    assert meter.usages == {}

"""Processor time and memory of local programs, measured from /proc."""

from __future__ import annotations

import time
from dataclasses import dataclass

import psutil

INTERVAL_S = 0.25
MIB = 2**20


@dataclass(frozen=True, slots=True)
class ProgramUsage:
    """Resources that a program and its child processes used.

    Attributes:
        vehicle: Drone on which the program runs.
        cpu_s: Processor time, seconds.
        wall_s: Real time between the start of the program and the last measurement, seconds.
        mean_memory_mib: Mean resident memory, MiB.
        peak_memory_mib: Maximum resident memory, MiB.
    """

    vehicle: str
    cpu_s: float
    wall_s: float
    mean_memory_mib: float
    peak_memory_mib: float

    @property
    def cpu(self) -> float:
        """Mean number of used processor cores."""
        return self.cpu_s / self.wall_s if self.wall_s > 0 else 0.0


class ResourceMeter:
    """Measures running programs a few times per second.

    Processor time after the last measurement, and of child processes that nobody waits for, is not included.
    """

    def __init__(self) -> None:
        self._programs: dict[str, _Program] = {}
        self._measured_s = 0.0

    @property
    def usages(self) -> dict[str, ProgramUsage]:
        """Resources used so far, by program."""
        return {name: program.usage for name, program in self._programs.items() if program.usage is not None}

    def add(self, name: str, vehicle: str, pid: int) -> None:
        """Measure a program from now on. A program that is started again is measured from zero."""
        try:
            process = psutil.Process(pid)
        except psutil.NoSuchProcess:
            return
        self._programs[name] = _Program(process, vehicle)

    def measure(self) -> bool:
        """Measure all programs, at most once per `INTERVAL_S`. Return True if they were measured."""
        if time.monotonic() - self._measured_s < INTERVAL_S:
            return False
        self._measured_s = time.monotonic()
        for program in self._programs.values():
            program.measure()
        return True


class _Program:
    def __init__(self, process: psutil.Process, vehicle: str) -> None:
        self.usage: ProgramUsage | None = None
        self._process = process
        self._vehicle = vehicle
        self._began_s = time.monotonic()
        self._memory_mib: list[float] = []

    def measure(self) -> None:
        try:
            processes = [self._process, *self._process.children(recursive=True)]
            own = self._process.cpu_times()
            cpu_s = own.children_user + own.children_system
            memory = 0
            for process in processes:
                times = process.cpu_times()
                cpu_s += times.user + times.system
                memory += process.memory_info().rss
        except (psutil.NoSuchProcess, psutil.ZombieProcess):
            return
        if not memory:
            return
        self._memory_mib.append(memory / MIB)
        mean = sum(self._memory_mib) / len(self._memory_mib)
        wall_s = time.monotonic() - self._began_s
        self.usage = ProgramUsage(self._vehicle, cpu_s, wall_s, mean, max(self._memory_mib))

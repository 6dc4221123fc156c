"""Common interface of the three experiment modes, and the results that they collect."""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeVar

from fractus_core.api.grants import GrantSpec

from fractus_sim.errors import ExperimentError
from fractus_sim.experiment.checks import DataLevel
from fractus_sim.experiment.definition import Experiment, Program, VehicleSetup
from fractus_sim.report.audit_log_reader import read_audit_logs
from fractus_sim.testbeds.detections import ObservedObject
from fractus_sim.testbeds.ground_station import OBSERVER_ID, Link, Station
from fractus_sim.testbeds.local_processes import Processes
from fractus_sim.testbeds.resource_meter import ProgramUsage
from fractus_sim.testbeds.tlog import TlogWriter

AUDIT_LOGS = ("mobility.jsonl", "camera.jsonl")
"""Audit logs of the services of a drone."""

_JUDGED_KINDS = frozenset({"call", "monitor", "takeover"})


@dataclass(frozen=True, slots=True)
class Moment:
    """A time on two clocks: seconds since the start of the testbed on its own clock, and Unix time in microseconds."""

    time_s: float
    unix_us: int


@dataclass
class Findings:
    """Results for checks and report that are not part of a flight recording.

    Attributes:
        programs: Exit codes by program. None if the program had to be stopped. Programs that were not started are missing.
        usages: Resources that programs used, by program.
        data_sent: Bytes that each drone or node sent, by level (app, runtime, autopilot). Unmeasured levels are missing.
        calls: Audit log entries with a verdict.
        audit_problems: Verification problem by log. Empty if the log is valid.
        phases: Phases of each Application in the order observed.
        detections: Detections of programs.
        truths: Objects in view of the camera worlds.
    """

    programs: dict[str, int | None] = field(default_factory=dict)
    usages: dict[str, ProgramUsage] = field(default_factory=dict)
    data_sent: dict[str, dict[DataLevel, int]] = field(default_factory=dict)
    calls: list[Mapping[str, Any]] = field(default_factory=list)
    audit_problems: dict[str, str] = field(default_factory=dict)
    phases: dict[str, list[str]] = field(default_factory=dict)
    detections: list[ObservedObject] = field(default_factory=list)
    truths: list[ObservedObject] = field(default_factory=list)


class Closable(Protocol):
    """An object with a `close` method."""

    def close(self) -> None:
        """Close the object."""


_Resource = TypeVar("_Resource", bound=Closable)


class Testbed(ABC):
    """Vehicles of an experiment and their environment.

    Attributes:
        observers: Ground station of each vehicle for recording and fault injection. Its link is never cut.
        pilots: Ground station of each vehicle for its task. Empty in modes in which applications fly.
        endpoints: MAVLink endpoint of each vehicle for QGroundControl or Mission Planner.
        findings: Results, complete after `collect`.
        processes: Local processes. None if the mode starts none.
    """

    def __init__(self, experiment: Experiment, folder: Path, base: Path, report: Callable[[str], None]) -> None:
        """Create the testbed without starting anything.

        Args:
            experiment: Experiment to run.
            folder: Output folder.
            base: Base directory of relative paths in the experiment.
            report: Called with progress lines.
        """
        self.experiment = experiment
        self.folder = folder
        self.base = base
        self.report = report
        self.observers: dict[str, Station] = {}
        self.pilots: dict[str, Station] = {}
        self.endpoints: dict[str, str] = {}
        self.findings = Findings()
        self.processes: Processes | None = None
        self._resources = ExitStack()

    def keep(self, resource: _Resource) -> _Resource:
        """Register an object that the testbed closes at its end. Call this right after the creation of the object."""
        self._resources.callback(resource.close)
        return resource

    def at_end(self, action: Callable[[], object]) -> None:
        """Register an action to run when the testbed is closed."""
        self._resources.callback(action)

    def observe(self, setup: VehicleSetup, link: Link) -> None:
        """Add the observer of a vehicle, which uses a separate link."""
        log = self.keep(TlogWriter(self.folder / "logs" / f"{setup.name}-observer.tlog"))
        station = Station(link, setup.system_id, log, own_id=OBSERVER_ID, sends_heartbeats=False)
        self.observers[setup.name] = self.keep(station)

    def close(self) -> None:
        """Close all registered objects in reverse order, even after an error or interrupt."""
        self._resources.close()

    @abstractmethod
    def set_up(self) -> None:
        """Start all parts.

        Raises:
            ExperimentError: A part did not start.
        """

    @abstractmethod
    def tick(self) -> Moment:
        """Advance time by one tick.

        Raises:
            ExperimentError: A required process has ended.
        """

    @abstractmethod
    def begin(self, program: Program | None = None) -> None:
        """Start a program of the experiment. Called when the vehicles are ready.

        Args:
            program: Program to start. None: all programs, or all Applications in mode cluster.

        Raises:
            ExperimentError: The program cannot be started.
        """

    def reissue(self, grants: Iterable[GrantSpec]) -> None:
        """Replace Grants in flight. A drone whose Grant is not replaced keeps it.

        Args:
            grants: Compiled Grants of this experiment's applications.

        Raises:
            ExperimentError: The mode has no Grants, or its operator issues them.
        """
        raise ExperimentError(f"Grants cannot be reissued in mode {self.experiment.mode}; use mode standalone")

    @property
    def busy(self) -> bool:
        """True while a foreground program or an Application has not ended."""
        processes = self.processes
        programs = [program.name for program in self.experiment.programs if not program.background]
        return processes is not None and any(map(processes.running, programs))

    @property
    def required_flights(self) -> Sequence[str]:
        """Names of vehicles. If it is not empty, the experiment does not end before one of these vehicles has flown."""
        return ()

    def revoke(self, vehicle: str) -> None:
        """Remove the Grants of a drone. The system takes the drone and brings it home.

        Raises:
            ExperimentError: The mode has no Grants, or its operator issues them.
        """
        raise ExperimentError(
            f"{vehicle}: Grants cannot be revoked in mode {self.experiment.mode}; use mode standalone"
        )

    @abstractmethod
    def set_link(self, vehicle: str, *, connected: bool) -> None:
        """Drop all traffic on the link of a vehicle, or restore the link."""

    def set_power(self, node: str, *, on: bool) -> None:
        """Power a node on or off.

        Raises:
            ExperimentError: The mode has no nodes.
        """
        raise ExperimentError(f"{node}: cannot power {'on' if on else 'off'}; the mode has no nodes")

    def collect(self) -> None:
        """Collect results into `findings` before the testbed is closed. The base class adds exit codes of programs."""
        if self.processes is not None:
            for program in self.experiment.programs:
                if self.processes.started(program.name):
                    self.findings.programs[program.name] = self.processes.exit_code(program.name)

    def read_audit_logs(self, vehicle: str, folder: Path) -> None:
        """Verify the audit logs of a drone's services, and add their policy decisions to the findings."""
        for log in read_audit_logs(folder / name for name in AUDIT_LOGS if (folder / name).exists()):
            self.findings.audit_problems[f"{vehicle}/{log.path.name}"] = log.problem
            self.findings.calls += [entry for entry in log.entries if entry.get("kind") in _JUDGED_KINDS]


def program_command(program: Program) -> list[str]:
    """Return the command of a program. `python` is replaced by the current interpreter."""
    executable, *arguments = program.command
    return [sys.executable if executable in {"python", "python3"} else executable, *arguments]


def wind_argument(experiment: Experiment) -> str:
    """Return the initial wind as the option `--wind` of the simulated vehicle: speed, direction, turbulence."""
    wind = experiment.wind
    return f"{wind.speed},{wind.direction},{wind.turbulence}"

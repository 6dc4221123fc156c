"""Common interface of the three experiment modes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeVar

from fractus_sim.experiment.definition import Experiment, VehicleSetup
from fractus_sim.testbeds.detections import Seen
from fractus_sim.testbeds.ground_station import OBSERVER_ID, Link, Station
from fractus_sim.testbeds.tlog import TlogWriter


@dataclass(frozen=True, slots=True)
class Moment:
    """Seconds since the start of the testbed on its own clock, and Unix time in microseconds."""

    time_s: float
    unix_us: int


class Closable(Protocol):
    """An object with a `close` method."""

    def close(self) -> None:
        """Close the object."""


_Kept = TypeVar("_Kept", bound=Closable)


class Testbed(ABC):
    """Vehicles of an experiment and their environment.

    Attributes:
        observers: Link of each vehicle that records and injects faults. It is never cut.
        pilots: Ground station of each vehicle that flies its task. Empty in modes where applications fly.
        endpoints: MAVLink endpoint of each vehicle for QGroundControl or Mission Planner.
    """

    def __init__(self, experiment: Experiment, folder: Path, base: Path, tell: Callable[[str], None]) -> None:
        self.experiment = experiment
        self.folder = folder
        self.base = base
        self.tell = tell
        self.observers: dict[str, Station] = {}
        self.pilots: dict[str, Station] = {}
        self.endpoints: dict[str, str] = {}
        self.findings = Findings()
        self._kept = ExitStack()

    def keep(self, resource: _Kept) -> _Kept:
        """Register an object to be closed with the testbed. Call this right after its creation."""
        self._kept.callback(resource.close)
        return resource

    def at_end(self, action: Callable[[], object]) -> None:
        """Register an action to run when the testbed is closed."""
        self._kept.callback(action)

    def observe(self, setup: VehicleSetup, link: Link) -> None:
        """Record a vehicle over a separate link."""
        log = self.keep(TlogWriter(self.folder / "logs" / f"{setup.name}-observer.tlog"))
        self.observers[setup.name] = self.keep(Station(link, setup.system_id, log, own_id=OBSERVER_ID, beats=False))

    def close(self) -> None:
        """Close everything in reverse order. Failures and interrupts do not skip the remaining objects."""
        self._kept.close()

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
    def begin(self) -> None:
        """Start programs or apply Applications. Called when the vehicles are ready."""

    @property
    def busy(self) -> bool:
        """True while a program or Application has not ended."""
        return False

    @property
    def flies(self) -> Sequence[str]:
        """Vehicles of which at least one must fly before the experiment can end."""
        return ()

    @abstractmethod
    def cut_link(self, vehicle: str) -> None:
        """Drop all traffic on the link of a vehicle."""

    @abstractmethod
    def heal_link(self, vehicle: str) -> None:
        """Restore the link of a vehicle."""

    @abstractmethod
    def power_off(self, node: str) -> None:
        """Power off a node."""

    @abstractmethod
    def power_on(self, node: str) -> None:
        """Power on a node."""

    @abstractmethod
    def collect(self) -> None:
        """Collect results into `findings` before the testbed is closed."""


@dataclass
class Findings:
    """Results that the testbed collects for checks and report.

    Attributes:
        programs: Exit codes by program. None if the program had to be stopped.
        calls: Audit log entries with a verdict.
        audit_problems: Verification problem by log. Empty if the log is valid.
        phases: Phases of each Application in the order observed.
        detections: Detections of programs.
        truths: Objects in view of the camera worlds.
    """

    programs: dict[str, int | None] = field(default_factory=dict)
    calls: list[Mapping[str, Any]] = field(default_factory=list)
    audit_problems: dict[str, str] = field(default_factory=dict)
    phases: dict[str, list[str]] = field(default_factory=dict)
    detections: list[Seen] = field(default_factory=list)
    truths: list[Seen] = field(default_factory=list)

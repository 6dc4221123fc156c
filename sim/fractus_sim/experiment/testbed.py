"""Where an experiment runs: the three modes, behind one interface."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeVar

from fractus_sim.experiment.findings import Findings
from fractus_sim.experiment.model import Experiment, VehicleSetup
from fractus_sim.experiment.station import OBSERVER_ID, Link, Station
from fractus_sim.experiment.tlog import TlogWriter


@dataclass(frozen=True, slots=True)
class Moment:
    """Seconds since the testbed was set, on its own clock, and the time of day in microseconds."""

    time_s: float
    unix_us: int


class Closable(Protocol):
    """Something to be closed."""

    def close(self) -> None:
        """End it."""


_Kept = TypeVar("_Kept", bound=Closable)


class Testbed(ABC):
    """The vehicles of an experiment and what stands around them.

    Attributes:
        observers: for each vehicle a link that records, injects faults, and is never cut.
        pilots: for each vehicle a ground station that flies its task; not in modes where applications fly.
        endpoints: for each vehicle where QGroundControl or Mission Planner can attach.
    """

    def __init__(self, experiment: Experiment, folder: Path, base: Path, tell: Callable[[str], None]) -> None:
        self.experiment, self.folder, self.base, self.tell = experiment, folder, base, tell
        self.observers: dict[str, Station] = {}
        self.pilots: dict[str, Station] = {}
        self.endpoints: dict[str, str] = {}
        self.findings = Findings()
        self._kept = ExitStack()

    def keep(self, resource: _Kept) -> _Kept:
        """Have something closed with the testbed; say so as soon as it is made."""
        self._kept.callback(resource.close)
        return resource

    def at_end(self, action: Callable[[], object]) -> None:
        """Have something done when the testbed is closed."""
        self._kept.callback(action)

    def observe(self, setup: VehicleSetup, link: Link) -> None:
        """Have a vehicle recorded by a link of its own."""
        log = self.keep(TlogWriter(self.folder / "logs" / f"{setup.name}-observer.tlog"))
        self.observers[setup.name] = self.keep(Station(link, setup.system_id, log, own_id=OBSERVER_ID, beats=False))

    def close(self) -> None:
        """End everything that was started, the last first; what fails or is interrupted keeps nothing else from its end."""
        self._kept.close()

    @abstractmethod
    def set_up(self) -> None:
        """Bring everything up.

        Raises:
            ExperimentError: something did not come up.
        """

    @abstractmethod
    def tick(self) -> Moment:
        """Let a little time pass.

        Raises:
            ExperimentError: something that must run has ended.
        """

    @abstractmethod
    def begin(self) -> None:
        """Vehicles are ready: start programs, apply applications."""

    @property
    def busy(self) -> bool:
        """Whether something that was begun is not over."""
        return False

    @property
    def flies(self) -> Sequence[str]:
        """Vehicles of which at least one must have flown before the experiment can be over."""
        return ()

    @abstractmethod
    def cut_link(self, vehicle: str) -> None:
        """Let nothing pass on the vehicle's link of this mode."""

    @abstractmethod
    def heal_link(self, vehicle: str) -> None:
        """Let everything pass again."""

    @abstractmethod
    def power_off(self, node: str) -> None:
        """Pull a node's power."""

    @abstractmethod
    def power_on(self, node: str) -> None:
        """Give it back."""

    @abstractmethod
    def collect(self) -> None:
        """Gather what is left for `findings`, before everything is taken down."""

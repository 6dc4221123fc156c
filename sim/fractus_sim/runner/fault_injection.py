"""Injection of faults into a running experiment."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, replace

from fractus_sim.errors import ExperimentError
from fractus_sim.experiment.timed_faults import Fault, LinkLoss, NodePowerOff
from fractus_sim.testbeds.ground_station import Station
from fractus_sim.testbeds.testbed import Testbed

RESPONSE_TIMEOUT_S = 1.0
ATTEMPTS = 5


@dataclass(frozen=True, slots=True)
class Occurrence:
    """A fault that was injected. Times are seconds of the experiment.

    Attributes:
        vehicle: Name of the vehicle. Empty for a node without a vehicle.
        end_s: End of the fault. None while it lasts.
    """

    kind: str
    title: str
    vehicle: str
    begin_s: float
    end_s: float | None = None


@dataclass(slots=True)
class _InjectedFault:
    """A fault for one vehicle. `index` is its index in the occurrences. It is None until the fault has begun."""

    fault: Fault
    vehicle: str
    steps: Iterator[None]
    index: int | None = None
    over: bool = False


class FaultInjector:
    """Injects the faults of an experiment. Each fault is a generator that is resumed at every poll.

    Args:
        faults: Faults of the experiment file.
        testbed: Testbed whose links and power the faults cut. Its observers stay connected during all faults.
        report: Called with the vehicle (empty for a node without a vehicle) and a text when a fault begins or ends.

    Attributes:
        occurrences: Faults that have begun.
        takeoffs_s: Time of the first takeoff of each vehicle.
    """

    def __init__(self, faults: Sequence[Fault], testbed: Testbed, report: Callable[[str, str], None]) -> None:
        self.occurrences: list[Occurrence] = []
        self.takeoffs_s: dict[str, float] = {}
        self._testbed = testbed
        self._observers = testbed.observers
        self._report = report
        self._now_s = 0.0
        self._faults = [self._prepare(fault, vehicle) for fault in faults for vehicle in self._targets(fault)]

    def step(self, now_s: float) -> None:
        """Advance all faults. Call this after each poll of the observers.

        Raises:
            ExperimentError: A vehicle rejected a parameter.
        """
        self._now_s = now_s
        for name, observer in self._observers.items():
            if observer.state.flying and name not in self.takeoffs_s:
                self.takeoffs_s[name] = now_s
        for running in self._faults:
            if not running.over:
                running.over = next(running.steps, StopIteration) is StopIteration

    @property
    def active(self) -> bool:
        """True if any fault has begun and not ended yet."""
        return any(not running.over and running.index is not None for running in self._faults)

    @property
    def missed(self) -> list[tuple[str, str]]:
        """Vehicle and title of the faults that have not begun."""
        return [(running.vehicle, running.fault.title) for running in self._faults if running.index is None]

    def _targets(self, fault: Fault) -> Sequence[str]:
        """Return the names of the vehicles of a fault.

        The name is empty for the power fault of a node without a vehicle.
        """
        if isinstance(fault, NodePowerOff) and fault.node is not None:
            return [""]
        return fault.vehicles or tuple(self._observers)

    def _prepare(self, fault: Fault, vehicle: str) -> _InjectedFault:
        running = _InjectedFault(fault, vehicle, iter(()))
        running.steps = self._inject(running)
        return running

    def _begin_s(self, running: _InjectedFault) -> float | None:
        """Return the time when a fault begins. Return None until the takeoff if the time is relative to it."""
        if running.fault.since == "start":
            return running.fault.at
        takeoffs = self.takeoffs_s
        takeoff_s = takeoffs.get(running.vehicle) if running.vehicle else min(takeoffs.values(), default=None)
        return None if takeoff_s is None else takeoff_s + running.fault.at

    def _inject(self, running: _InjectedFault) -> Generator[None, None, None]:
        """Wait until a fault begins, inject it, end it after its duration, and restore the changed parameters."""
        fault = running.fault
        while (begin_s := self._begin_s(running)) is None or self._now_s < begin_s:
            yield
        running.index = len(self.occurrences)
        self.occurrences.append(Occurrence(fault.fault, fault.title, running.vehicle, self._now_s))
        self._report(running.vehicle, fault.title)
        original: dict[str, float] = {}
        if isinstance(fault, LinkLoss):
            self._testbed.set_link(running.vehicle, connected=False)
        elif isinstance(fault, NodePowerOff):
            self._testbed.set_power(fault.node or running.vehicle, on=False)
        for after_s, values in fault.steps():
            while self._now_s < begin_s + after_s:
                yield
            for name, value in values.items():
                if name not in original and fault.duration is not None:
                    original[name] = yield from self._read(running.vehicle, name)
                yield from self._set(running.vehicle, name, value)
        if fault.duration is None:
            return
        while self._now_s < begin_s + fault.duration:
            yield
        if isinstance(fault, LinkLoss):
            self._testbed.set_link(running.vehicle, connected=True)
        elif isinstance(fault, NodePowerOff):
            self._testbed.set_power(fault.node or running.vehicle, on=True)
        for name, value in original.items():
            yield from self._set(running.vehicle, name, value)
        self.occurrences[running.index] = replace(self.occurrences[running.index], end_s=self._now_s)
        self._report(running.vehicle, f"{fault.title} ended")

    def _read(self, vehicle: str, name: str) -> Generator[None, None, float]:
        """Read a parameter.

        Raises:
            ExperimentError: The vehicle did not report the parameter.
        """
        observer = self._observers[vehicle]
        for _ in range(ATTEMPTS):
            observer.read_parameter(name)
            if (yield from self._wait_for_parameter(observer, name)):
                return observer.parameters[name]
        raise ExperimentError(f"{vehicle}: the autopilot has no parameter {name}, which a fault needs")

    def _set(self, vehicle: str, name: str, value: float) -> Generator[None, None, None]:
        """Set a parameter.

        Raises:
            ExperimentError: The vehicle did not report the parameter.
        """
        observer = self._observers[vehicle]
        for _ in range(ATTEMPTS):
            observer.set_parameter(name, value)
            if (yield from self._wait_for_parameter(observer, name)):
                return
        raise ExperimentError(f"{vehicle}: the autopilot rejected {name} = {value:g}, which a fault needs")

    def _wait_for_parameter(self, observer: Station, name: str) -> Generator[None, None, bool]:
        """Wait until the vehicle reports a parameter. Return False after the timeout."""
        deadline_s = self._now_s + RESPONSE_TIMEOUT_S
        while self._now_s < deadline_s:
            yield
            if name in observer.parameters:
                return True
        return False

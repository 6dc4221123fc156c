"""Result of an experiment: recorded flights, faults, verdicts and events."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from fractus_sim.experiment.definition import Experiment
from fractus_sim.report.flight_record import JudgedCall
from fractus_sim.runner.check_evaluation import Verdict
from fractus_sim.runner.fault_injection import Occurrence
from fractus_sim.runner.telemetry_recording import Flight
from fractus_sim.testbeds.testbed import Findings


@dataclass(frozen=True, slots=True)
class Event:
    """An event of a task or fault. `vehicle` is empty for an event of the whole experiment."""

    time_s: float
    vehicle: str
    text: str


@dataclass(frozen=True)
class Outcome:
    """Result of an experiment. Times are seconds of the experiment.

    Attributes:
        folder: Output folder.
        flights: Recordings by vehicle.
        occurrences: Injected faults.
        verdicts: Results of the checks.
        findings: Other results, such as exit codes of programs.
        events: Events of tasks and faults, in order.
        decisions: Calls that policies corrected or denied.
        duration_s: Duration in simulated time.
        wall_s: Duration in real time.
        problem: Reason why the experiment was aborted. Empty if it completed.
    """

    experiment: Experiment
    folder: Path
    flights: dict[str, Flight]
    occurrences: tuple[Occurrence, ...]
    verdicts: tuple[Verdict, ...]
    findings: Findings
    events: tuple[Event, ...]
    decisions: tuple[JudgedCall, ...]
    duration_s: float
    wall_s: float
    problem: str = ""

    @property
    def holds(self) -> bool:
        """True if the experiment completed and every check holds."""
        return not self.problem and all(verdict.holds for verdict in self.verdicts)

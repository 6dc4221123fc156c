"""Result of an experiment."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from fractus_sim.experiment.findings import Findings
from fractus_sim.experiment.injection import Occurrence
from fractus_sim.experiment.judging import Verdict
from fractus_sim.experiment.model import Experiment
from fractus_sim.experiment.recording import Flight
from fractus_sim.report.record import Judgement


@dataclass(frozen=True)
class Outcome:
    """Result of an experiment. Times are seconds of the experiment.

    Attributes:
        problem: Reason why the experiment was aborted. Empty if it completed.
        duration_s: Duration in simulated time.
        wall_s: Duration in real time.
        events: (seconds, vehicle or empty, text) of tasks and faults.
        judgements: Calls that policies corrected or denied.
    """

    experiment: Experiment
    folder: Path
    flights: dict[str, Flight]
    occurrences: tuple[Occurrence, ...]
    verdicts: tuple[Verdict, ...]
    findings: Findings
    events: tuple[tuple[float, str, str], ...]
    judgements: tuple[Judgement, ...]
    duration_s: float
    wall_s: float
    problem: str = ""

    @property
    def holds(self) -> bool:
        """True if the experiment completed and every check holds."""
        return not self.problem and all(verdict.holds for verdict in self.verdicts)

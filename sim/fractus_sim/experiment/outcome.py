"""What came of an experiment."""

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
    """What came of an experiment; seconds of the experiment.

    Attributes:
        problem: why it did not run to its end; empty when it could.
        duration_s: how long it took, in the vehicles' time.
        wall_s: how long it took here.
        events: (seconds, vehicle or empty, text) of tasks and faults.
        judgements: what policies corrected or refused.
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
        """Whether it ran to its end and every check holds."""
        return not self.problem and all(verdict.holds for verdict in self.verdicts)

"""Results of an experiment that are not part of a flight recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from fractus_sim.experiment.detections import Seen


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

"""What is known of an experiment beside its vehicles' flights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from fractus_sim.experiment.detections import Seen


@dataclass
class Findings:
    """What only the testbed knows, for checks and report.

    Attributes:
        programs: exit codes; None for one that had to be stopped.
        calls: entries of the audit logs that are judgements.
        audit_problems: by log; empty text for one that verifies.
        phases: of each Application, in the order seen.
        detections: what programs detected.
        truths: what camera worlds had in view.
    """

    programs: dict[str, int | None] = field(default_factory=dict)
    calls: list[Mapping[str, Any]] = field(default_factory=list)
    audit_problems: dict[str, str] = field(default_factory=dict)
    phases: dict[str, list[str]] = field(default_factory=dict)
    detections: list[Seen] = field(default_factory=list)
    truths: list[Seen] = field(default_factory=list)

"""Summary page of chaos runs: violations and timeline of each run."""

from __future__ import annotations

from collections.abc import Sequence

from fractus_sim.chaos.chaos_run import ChaosRun
from fractus_sim.report.report_files import format_duration, table


def chaos_page(runs: Sequence[ChaosRun], fault_time_s: float) -> str:
    """Return the page in Markdown.

    Args:
        runs: Completed runs.
        fault_time_s: Duration of fault injection per run, seconds.
    """
    violations = sum(len(run.violations) for run in runs)
    headline = f"{violations} invariant violations." if violations else "Every invariant held."
    head = ("Seed", "In the air", "Missions", "Events", "Audit entries", "Violations")
    rows = [
        (
            str(run.seed),
            format_duration(run.flown_s),
            _phase_counts(run),
            str(sum(":" in text for _, text in run.timeline)),
            str(run.audit_entries),
            "; ".join(f"{violation.invariant}: {violation.description}" for violation in run.violations) or "none",
        )
        for run in runs
    ]
    parts = ["# Chaos", f"{len(runs)} runs of {format_duration(fault_time_s)}. {headline}", table(head, rows)]
    for run in runs:
        events = [f"- {time_s:.1f} s: {text}" for time_s, text in sorted(run.timeline)]
        missions = [f"- {name}: {phase}: {message}" for name, (phase, message) in run.missions.items()]
        parts += [f"## Seed {run.seed}", "\n".join(events), "Missions:", "\n".join(missions)]
    return "\n\n".join(parts) + "\n"


def _phase_counts(run: ChaosRun) -> str:
    phases = [phase for phase, _ in run.missions.values()]
    return ", ".join(f"{phases.count(phase)} {phase}" for phase in sorted(set(phases)))

"""Summary page of chaos runs: violations and timeline of each run."""

from __future__ import annotations

from collections.abc import Sequence

from fractus_sim.chaos.chaos_run import Run
from fractus_sim.report.report_files import clock, table


def page(runs: Sequence[Run], run_s: float) -> str:
    """Return the page in Markdown."""
    broken = sum(len(run.broken) for run in runs)
    held = "Every invariant held." if not broken else f"{broken} invariant violations."
    rows = [
        (
            str(run.seed), clock(run.flown_s), _missions(run), str(sum(":" in text for _, text in run.timeline)), str(run.entries),
            "; ".join(f"{each.invariant}: {each.found}" for each in run.broken) or "none",
        )
        for run in runs
    ]  # fmt: skip
    head = ("Seed", "In the air", "Missions", "Events", "Audit entries", "Broken")
    parts = ["# Chaos", f"{len(runs)} runs of {clock(run_s)}. {held}", table(head, rows)]
    for run in runs:
        lines = [f"- {at_s:.1f} s: {text}" for at_s, text in sorted(run.timeline)]
        ends = [f"- {name}: {phase}: {message}" for name, (phase, message) in run.ended.items()]
        parts += [f"## Seed {run.seed}", "\n".join(lines), "Missions:", "\n".join(ends)]
    return "\n\n".join(parts) + "\n"


def _missions(run: Run) -> str:
    phases = [phase for phase, _ in run.ended.values()]
    return ", ".join(f"{phases.count(phase)} {phase}" for phase in sorted(set(phases)))

"""`python -m fractus_sim.chaos`: fly missions on an embedded cluster while faults are injected."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import click

from fractus_sim.chaos.chaos_cluster import DRONE, VEHICLE_PORT, VehicleWatch, chaos_cluster
from fractus_sim.chaos.chaos_faults import FAULTS
from fractus_sim.chaos.chaos_run import ChaosRun, RunConfig, execute_run
from fractus_sim.command_line import command_errors
from fractus_sim.report.report_files import PAGE, format_duration, table, write_page


def report(line: str) -> None:
    """Print a progress line."""
    click.echo(line, err=True)


@click.command()
@click.option("--seeds", default=1, show_default=True, help="Number of runs.")
@click.option(
    "--first-seed", default=1, show_default=True, help="Seed of the first run. Each further run uses the next seed."
)
@click.option("--minutes", default=5.0, show_default=True, help="Minutes of fault injection per run.")
@click.option(
    "--fault",
    "kinds",
    multiple=True,
    type=click.Choice(sorted(FAULTS)),
    help="Inject only this fault (repeatable). Default: all faults.",
)
@click.option(
    "--out", type=click.Path(path_type=Path, file_okay=False), default=Path("out/chaos"), show_default=True,
    help="Output folder of the report.",
)  # fmt: skip
@click.option("--keep", is_flag=True, help="Do not remove the cluster at the end.")
def chaos(*, seeds: int, first_seed: int, minutes: float, kinds: tuple[str, ...], out: Path, keep: bool) -> None:
    """Fly missions while faults are injected by a seeded schedule, and check the invariants.

    Exit code: 0 if all invariants hold, 1 if an invariant is violated or the runs could not be executed.
    """
    runs: list[ChaosRun] = []
    with command_errors():
        out.mkdir(parents=True, exist_ok=True)
        with chaos_cluster(report, keep=keep) as target:
            namespace = target.node.wiring.namespace_path(DRONE)
            with VehicleWatch(namespace, VEHICLE_PORT, target.state / "grants") as watch:
                for seed in range(first_seed, first_seed + seeds):
                    config = RunConfig(seed, minutes * 60, kinds or sorted(FAULTS))
                    runs.append(execute_run(target, watch, config, report))
                    write_page(out, chaos_page(runs, minutes * 60))
    violations = [(run.seed, violation) for run in runs for violation in run.violations]
    for seed, violation in violations:
        click.echo(f"seed {seed}: {violation.invariant}: {violation.description}")
    click.echo(f"{len(runs)} runs, {len(violations)} invariant violations; report: {out / PAGE}")
    sys.exit(1 if violations else 0)


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


if __name__ == "__main__":
    chaos(prog_name="python -m fractus_sim.chaos")

"""`python -m fractus_sim.chaos`: fly missions on an embedded cluster while faults are injected."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from fractus_sim.chaos.chaos_cluster import DRONE, VEHICLE_PORT, VehicleWatch, chaos_cluster
from fractus_sim.chaos.chaos_faults import FAULTS
from fractus_sim.chaos.chaos_report import chaos_page
from fractus_sim.chaos.chaos_run import ChaosRun, RunConfig, execute_run
from fractus_sim.command_line import command_errors
from fractus_sim.report.report_files import PAGE, write_page


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


if __name__ == "__main__":
    chaos(prog_name="python -m fractus_sim.chaos")

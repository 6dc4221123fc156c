"""`make scenario-field`: fly the field experiment and write figures, tables and results."""

from __future__ import annotations

from pathlib import Path

import click

from fractus_sim.command_line import command_errors, exit_with_expectations
from fractus_sim.report.report_files import Expectation, remove_report
from fractus_sim.scenarios.field.field_evidence import Evidence
from fractus_sim.scenarios.field.field_expectations import evaluate_run
from fractus_sim.scenarios.field.field_flight import RUNS, Autopilot, find_parked_vehicle, fly
from fractus_sim.scenarios.field.field_report import write_field_report
from fractus_sim.scenarios.field.field_site import EXAMPLE, FieldSite


@click.command()
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("out/field"), show_default=True,
    help="Output folder of the report.",
)  # fmt: skip
@click.option(
    "--autopilot",
    metavar="tcp:HOST:PORT",
    help="Fly with a running ArduCopter (SITL or a vehicle) instead of simulated vehicles.",
)
@click.option(
    "--speedup",
    type=click.FloatRange(0.2, 8.0),
    default=3.0,
    show_default=True,
    help="Factor of real time. For a running autopilot: its actual factor.",
)
@click.option("--run", "names", multiple=True, type=click.Choice([run.name for run in RUNS]), help="Only these runs.")
def field(*, out: Path, autopilot: str | None, speedup: float, names: tuple[str, ...]) -> None:
    """Fly the field experiment three times: normally, with violations under policies, and without policies.

    Exit code: 0 if all expectations hold, 2 if an expectation does not hold, 1 if the experiment could not be flown.
    """
    with command_errors():
        expectations = run_field_experiment(out, Autopilot(autopilot, speedup), names)
    exit_with_expectations(expectations, out)


def run_field_experiment(out: Path, autopilot: Autopilot, names: tuple[str, ...] = ()) -> list[Expectation]:
    """Fly the runs, write the report, and return the expectations.

    Args:
        out: Output folder.
        autopilot: Vehicle to fly.
        names: Names of the runs. Default: all runs.

    Raises:
        ExperimentError: A run could not be flown.
    """
    if autopilot.link is None:
        site = FieldSite.read(EXAMPLE)
        vehicle = "simulated vehicles"
    else:
        parked = find_parked_vehicle(autopilot.link, _report)
        site = FieldSite.read(EXAMPLE, parked.home)
        vehicle = f"vehicle {parked.system_id} at {autopilot.link}"
    out.mkdir(parents=True, exist_ok=True)
    remove_report(out)
    runs: list[Evidence] = []
    expectations: list[Expectation] = []
    for run in RUNS:
        if names and run.name not in names:
            continue
        click.echo(f"run: {run.title}")
        evidence = fly(run, site, autopilot, out / run.name, _report)
        expectations += evaluate_run(site, evidence)
        runs.append(evidence)
    write_field_report(site, runs, expectations, vehicle, out)
    return expectations


def _report(line: str) -> None:
    click.echo(f"  {line}")


if __name__ == "__main__":
    field.main(prog_name="scenario-field")

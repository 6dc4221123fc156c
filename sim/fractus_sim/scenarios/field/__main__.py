"""`make scenario-field`: fly the field experiment and write figures, tables and results."""

from __future__ import annotations

from pathlib import Path

import click

from fractus_sim.command_line import command_errors, exit_with_expectations
from fractus_sim.errors import ExperimentError
from fractus_sim.report.report_files import Expectation, remove_report
from fractus_sim.scenarios.field.field_evidence import Evidence
from fractus_sim.scenarios.field.field_expectations import evaluate_owner, evaluate_run
from fractus_sim.scenarios.field.field_flight import RUNS, Autopilot, drone_setup, find_parked_vehicle, fly
from fractus_sim.scenarios.field.field_report import write_field_report
from fractus_sim.scenarios.field.field_site import EXAMPLE, FieldSite
from fractus_sim.testbeds.borrowed_autopilot import BorrowedAutopilot, default_state


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
@click.option(
    "--state", type=click.Path(file_okay=False, path_type=Path), metavar="DIR",
    help="Directory that keeps the settings of a running autopilot's owner until they are restored; by default in ~/.local/state/fractus.",
)  # fmt: skip
@click.option("--restore", is_flag=True, help="Only restore the settings that an interrupted run left in --autopilot.")
@click.option("--run", "names", multiple=True, type=click.Choice([run.name for run in RUNS]), help="Only these runs.")
def field(
    *, out: Path, autopilot: str | None, speedup: float, state: Path | None, restore: bool, names: tuple[str, ...]
) -> None:
    """Fly the field experiment three times: normally, with violations under policies, and without policies.

    Exit code: 0 if all expectations hold, 2 if an expectation does not hold, 1 if the experiment could not be flown.
    """
    if autopilot is None and (restore or state is not None):
        raise click.UsageError("--restore and --state need --autopilot")
    with command_errors():
        borrowed = None
        if autopilot is not None:
            borrowed = BorrowedAutopilot(autopilot, (state or default_state(autopilot)).absolute(), _report)
        if restore:
            restore_borrowed_autopilot(out, Autopilot(borrowed, speedup))
            return
        try:
            expectations = run_field_experiment(out, Autopilot(borrowed, speedup), names)
        finally:
            if borrowed is not None and borrowed.interrupted:
                click.echo(
                    f"the vehicle at {autopilot} may still have settings of the experiment; the next run restores those of its owner,"
                    " or the same command with --restore (make scenario-field AUTOPILOT=... RESTORE=1)",
                    err=True,
                )
    exit_with_expectations(expectations, out)


def restore_borrowed_autopilot(out: Path, autopilot: Autopilot) -> None:
    """Restore the settings that an interrupted run left in a running autopilot.

    Raises:
        ExperimentError: They cannot be restored.
    """
    borrowed = autopilot.borrowed
    if borrowed is None or not borrowed.interrupted:
        _report("nothing to restore")
        return
    _restore(borrowed, out, autopilot, forced=True)


def _restore(borrowed: BorrowedAutopilot, out: Path, autopilot: Autopilot, *, forced: bool) -> None:
    borrowed.restore(out / "restore", drone_setup(FieldSite.read(EXAMPLE), autopilot), forced=forced)


def run_field_experiment(out: Path, autopilot: Autopilot, names: tuple[str, ...] = ()) -> list[Expectation]:
    """Fly the runs, write the report, and return the expectations.

    A running autopilot gets the settings of its owner back after each run. Settings that an interrupted run left are restored first.

    Args:
        out: Output folder.
        autopilot: Vehicle to fly.
        names: Names of the runs. Default: all runs.

    Raises:
        ExperimentError: A run could not be flown.
    """
    borrowed = autopilot.borrowed
    if borrowed is None:
        site = FieldSite.read(EXAMPLE)
        vehicle = "simulated vehicles"
    else:
        if borrowed.interrupted:
            _restore(borrowed, out, autopilot, forced=False)
        parked = find_parked_vehicle(borrowed.link, _report)
        site = FieldSite.read(EXAMPLE, parked.home)
        vehicle = f"vehicle {parked.system_id} at {borrowed.link}"
    out.mkdir(parents=True, exist_ok=True)
    remove_report(out)
    runs: list[Evidence] = []
    expectations: list[Expectation] = []
    for run in RUNS:
        if names and run.name not in names:
            continue
        click.echo(f"run: {run.title}")
        if borrowed is not None:
            borrowed.take()
        evidence = fly(run, site, autopilot, out / run.name, _report)
        expectations += evaluate_run(site, evidence)
        if borrowed is not None:
            expectations.append(evaluate_owner(run.name, _give_back(borrowed)))
        runs.append(evidence)
    write_field_report(site, runs, expectations, vehicle, out)
    return expectations


def _give_back(borrowed: BorrowedAutopilot) -> list[str]:
    """Restore the autopilot's settings, and return the differences. A failure is returned as a difference, too."""
    try:
        return borrowed.give_back()
    except ExperimentError as error:
        return [str(error)]


def _report(line: str) -> None:
    click.echo(f"  {line}")


if __name__ == "__main__":
    field.main(prog_name="scenario-field")

"""`make scenario-field`: fly the field experiment and write figures, tables and results."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from fractus_sim.errors import ExperimentError
from fractus_sim.interruption import break_off_on_signals
from fractus_sim.report.figure_style import save
from fractus_sim.report.report_files import PAGE, write_page
from fractus_sim.scenarios.field.field_evidence import Evidence
from fractus_sim.scenarios.field.field_expectations import Check, Judge
from fractus_sim.scenarios.field.field_flight import RUNS, Autopilot, fly, look
from fractus_sim.scenarios.field.field_report import draw_altitudes, draw_ground, figures, summary
from fractus_sim.scenarios.field.field_site import EXAMPLE, Field, dump

FAILED_EXPECTATIONS = 2


@click.command()
@click.option("--out", type=click.Path(path_type=Path), default=Path("out/field"), show_default=True)
@click.option(
    "--autopilot",
    metavar="tcp:HOST:PORT",
    help="Fly with an ArduCopter that runs already (SITL or a vehicle) instead of simulated ones.",
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

    Exit code: 0 if all expectations hold, 2 if one does not, 1 if the experiment could not be flown.
    """
    break_off_on_signals()
    try:
        checks = experiment(out, Autopilot(autopilot, speedup), names)
    except ExperimentError as error:
        raise click.ClickException(str(error)) from None
    failed = [check for check in checks if not check.holds]
    for check in failed:
        click.echo(f"NOT AS EXPECTED, {check.run}: {check.text} ({check.seen})", err=True)
    click.echo(f"{len(checks) - len(failed)} of {len(checks)} expectations hold; see {out / 'summary.md'}")
    if failed:
        sys.exit(FAILED_EXPECTATIONS)


def experiment(out: Path, autopilot: Autopilot, names: tuple[str, ...] = ()) -> list[Check]:
    """Fly the runs, write the report, and return the checks.

    Raises:
        ExperimentError: A run could not be flown.
    """
    ground = Field.read(EXAMPLE)
    words = "simulated vehicles"
    if autopilot.link is not None:
        standing = look(autopilot.link, _tell)
        ground = Field.read(EXAMPLE, standing.home)
        words = f"vehicle {standing.system_id} at {autopilot.link}"
    out.mkdir(parents=True, exist_ok=True)
    (out / PAGE).unlink(missing_ok=True)
    runs: list[Evidence] = []
    checks: list[Check] = []
    for run in RUNS:
        if names and run.name not in names:
            continue
        _tell(f"run: {run.title}")
        flown = fly(run, ground, autopilot, out / run.name, _tell)
        judge = Judge(ground, flown)
        checks += {"normal": judge.normal, "guarded": judge.guarded, "unguarded": judge.unguarded}[run.name]()
        runs.append(flown)
    area = ground.operation_area(ground.grants(ground.write(out), policies=True))
    save(draw_ground(ground, area, runs), out / "map.png")
    save(draw_altitudes(runs), out / "altitude.png")
    (out / "report.json").write_text(dump(figures(ground, runs, checks, words)))
    write_page(out, summary(ground, runs, checks, words))
    return checks


def _tell(text: str) -> None:
    click.echo(f"  {text}" if not text.startswith("run:") else text)


if __name__ == "__main__":
    field.main(prog_name="scenario-field")

"""`make scenario-links`: fly the links scenario on an embedded cluster and write figures, tables and results."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import click

from fractus_sim.errors import ExperimentError
from fractus_sim.interruption import break_off_on_signals
from fractus_sim.report.figure_style import save
from fractus_sim.report.report_files import PAGE, write_page
from fractus_sim.scenarios.links.links_evidence import Evidence, Line, read
from fractus_sim.scenarios.links.links_flight import LOG, fly
from fractus_sim.scenarios.links.links_report import draw_bandwidth, draw_map, summary
from fractus_sim.scenarios.links.links_results import Expectation, expectations, gains, report
from fractus_sim.scenarios.links.links_site import DRONE, Site, read_site

FAILED_EXPECTATIONS = 2


@click.command()
@click.option("--out", type=click.Path(path_type=Path), default=Path("out/links"), show_default=True)
@click.option(
    "--factor",
    type=click.FloatRange(0.5, 1.5),
    default=1.0,
    show_default=True,
    help="Actual radio range as a factor of the declared range.",
)
@click.option("--again", is_flag=True, help="Only write the report again from the data of an earlier run.")
def links(*, out: Path, factor: float, again: bool) -> None:
    """Fly past edge nodes with WiFi while one picture per second is sent, and evaluate the delivery of the pictures.

    Exit code: 0 if all expectations hold, 2 if one does not, 1 if the scenario could not be flown.
    """
    break_off_on_signals()
    site = read_site(factor)
    out.mkdir(parents=True, exist_ok=True)
    try:
        run = read_again(out) if again else fly(site, out, lambda text: click.echo(f"  {text}"))
    except (ExperimentError, OSError) as error:
        raise click.ClickException(str(error)) from None
    checks = write(site, run, out)
    failed = [check for check in checks if not check.holds]
    for check in failed:
        click.echo(f"NOT AS EXPECTED: {check.text} ({check.seen})", err=True)
    click.echo(f"{len(checks) - len(failed)} of {len(checks)} expectations hold; see {out / PAGE}")
    if failed:
        sys.exit(FAILED_EXPECTATIONS)


def read_again(out: Path) -> Evidence:
    """Read the data of an earlier run.

    Raises:
        OSError: There is no data.
    """
    lines = [Line(*json.loads(line)) for line in (out / LOG).read_text().splitlines()]
    track = [(at, (p[0], p[1], p[2])) for at, p in json.loads((out / "track.json").read_text())]
    return read(lines, track, DRONE)


def write(site: Site, run: Evidence, out: Path) -> list[Expectation]:
    """Write the report, and return the checks."""
    (out / PAGE).unlink(missing_ok=True)
    table = gains(site, run)
    checks = expectations(run, table)
    save(draw_map(site, run), out / "map.png")
    save(draw_bandwidth(site, run), out / "bandwidth.png")
    (out / "report.json").write_text(json.dumps(report(site, run, table, checks), indent=2) + "\n")
    write_page(out, summary(site, run, table, checks))
    return checks


if __name__ == "__main__":
    links.main(prog_name="scenario-links")

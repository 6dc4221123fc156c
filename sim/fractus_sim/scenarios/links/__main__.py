"""`make scenario-links`: fly the links scenario on an embedded cluster and write figures, tables and results."""

from __future__ import annotations

from pathlib import Path

import click

from fractus_sim.command_line import command_errors, exit_with_expectations
from fractus_sim.report.report_files import remove_report
from fractus_sim.scenarios.links.links_flight import fly, read_earlier_run
from fractus_sim.scenarios.links.links_report import write_links_report
from fractus_sim.scenarios.links.links_site import read_site


@click.command()
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("out/links"), show_default=True,
    help="Output folder of the report.",
)  # fmt: skip
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

    Exit code: 0 if all expectations hold, 2 if an expectation does not hold, 1 if the scenario could not be flown.
    """
    with command_errors():
        site = read_site(factor)
        out.mkdir(parents=True, exist_ok=True)
        evidence = read_earlier_run(out) if again else fly(site, out, lambda line: click.echo(f"  {line}"))
        remove_report(out)
        expectations = write_links_report(site, evidence, out)
    exit_with_expectations(expectations, out)


if __name__ == "__main__":
    links.main(prog_name="scenario-links")

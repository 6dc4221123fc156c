"""`fractus experiment`: run and check experiment files, and print their JSON schema."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import click
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from fractus_sim.command_line import EXIT_FAILED, command_errors
from fractus_sim.experiment.definition import Experiment, load, parse
from fractus_sim.progress import Progress
from fractus_sim.report.report_files import PAGE
from fractus_sim.runner import Outcome, run


@click.group()
def experiment() -> None:
    """Run experiments: vehicles, services or a whole cluster, with timed faults, checks and a report."""


@experiment.command(name="run")
@click.argument("file", type=click.Path(path_type=Path, dir_okay=False))
@click.option(
    "--out", type=click.Path(path_type=Path, file_okay=False), help="Output folder of logs and report. [out/NAME]"
)
@click.option("--seed", type=click.IntRange(0), help="Seed to use instead of the seed in the file.")
@click.option(
    "--speedup", type=click.FloatRange(0, 100), help="Factor of real time to use instead of the file's. 0: lockstep."
)
@click.option("--quiet", is_flag=True, help="Print only the results of the checks.")
def run_(file: Path, out: Path | None, seed: int | None, speedup: float | None, quiet: bool) -> None:
    """Run the experiment in FILE.

    Exit code: 0 if all checks hold, 2 if a check failed or the experiment was aborted, 1 for invalid input.
    """
    console = Console(highlight=False)
    with command_errors():
        definition = _with_changes(load(file), seed=seed, speedup=speedup)
        folder = out or Path("out") / definition.name
        status = console.status("setting up")
        with status:
            progress = Progress()
            if not quiet:
                progress = Progress(
                    lambda line: console.print(escape(line), soft_wrap=True), lambda line: status.update(escape(line))
                )
            outcome = run(definition, folder, base=file.parent.absolute(), progress=progress)
    _print_outcome(console, outcome)
    sys.exit(0 if outcome.holds else EXIT_FAILED)


@experiment.command()
@click.argument("file", type=click.Path(path_type=Path, dir_okay=False))
def check(file: Path) -> None:
    """Validate FILE without running it."""
    with command_errors():
        definition = load(file)
    click.echo(
        f"{file}: mode {definition.mode}, {len(definition.setups())} vehicles, {len(definition.faults)} faults,"
        f" {len(definition.checks)} checks"
    )


@experiment.command()
def schema() -> None:
    """Print the JSON schema of experiment files."""
    click.echo(json.dumps(Experiment.model_json_schema(), indent=2))


def _with_changes(definition: Experiment, **fields: float | None) -> Experiment:
    """Return a copy of the experiment with new values for the fields that are not None.

    Raises:
        InvalidObject: A changed field is invalid for this experiment.
    """
    changes = {name: value for name, value in fields.items() if value is not None}
    return parse({**definition.to_dict(), **changes}) if changes else definition


def _print_outcome(console: Console, outcome: Outcome) -> None:
    if outcome.verdicts:
        table = Table("", "check", "vehicle", "result", title=outcome.experiment.name, title_justify="left")
        for verdict in outcome.verdicts:
            mark = "[green]holds[/green]" if verdict.holds else "[red]failed[/red]"
            table.add_row(mark, escape(verdict.check), verdict.vehicle, escape(verdict.observed))
        console.print(table)
    if outcome.problem:
        console.print(f"[red]aborted:[/red] {escape(outcome.problem)}", soft_wrap=True)
    console.print(f"report: {outcome.folder / PAGE}", soft_wrap=True)

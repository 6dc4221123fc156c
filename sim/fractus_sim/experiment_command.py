"""`fractus experiment`: run and check experiments, and print the JSON schema of their files."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import click
from fractus_core.api.model import InvalidObject
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from fractus_sim.errors import ExperimentError
from fractus_sim.experiment.definition import Experiment, load, parse
from fractus_sim.interruption import break_off_on_signals
from fractus_sim.runner.experiment_runner import Outcome, Progress, run

_FAILED = 2


@click.group()
def experiment() -> None:
    """Run experiments: vehicles, services or a whole cluster, faults in time, checks, and a report."""


@experiment.command(name="run")
@click.argument("file", type=click.Path(path_type=Path, dir_okay=False))
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), help="Folder of logs and report. [out/NAME]")
@click.option("--seed", type=click.IntRange(0), help="Another seed than the file's.")
@click.option("--speedup", type=click.FloatRange(0, 100), help="Another pace than the file's; 0: lockstep.")
@click.option("--quiet", is_flag=True, help="Say only what came of the checks.")
def run_(file: Path, out: Path | None, seed: int | None, speedup: float | None, quiet: bool) -> None:
    """Run the experiment in FILE; exit code 0 if all checks hold, 2 if one failed, 1 for bad input."""
    console = Console(highlight=False)
    break_off_on_signals()
    try:
        loaded = _changed(load(file), seed=seed, speedup=speedup)
    except InvalidObject as error:
        raise click.ClickException(str(error)) from None
    folder = out or Path("out") / loaded.name
    status = console.status("setting up")
    try:
        with status:
            progress = Progress() if quiet else _progress(console, status.update)
            outcome = run(loaded, folder, base=file.parent.absolute(), progress=progress)
    except (ExperimentError, InvalidObject) as error:
        raise click.ClickException(str(error)) from None
    except OSError as error:
        raise click.ClickException(_problem(error, folder)) from None
    _tell_outcome(console, outcome)
    sys.exit(0 if outcome.holds else _FAILED)


@experiment.command()
@click.argument("file", type=click.Path(path_type=Path, dir_okay=False))
def check(file: Path) -> None:
    """Check FILE without running it."""
    try:
        loaded = load(file)
    except InvalidObject as error:
        raise click.ClickException(str(error)) from None
    click.echo(
        f"{file}: mode {loaded.mode}, {len(loaded.setups())} vehicles, {len(loaded.faults)} faults,"
        f" {len(loaded.checks)} checks"
    )


@experiment.command()
def schema() -> None:
    """Print the JSON schema of experiments' files."""
    click.echo(json.dumps(Experiment.model_json_schema(), indent=2))


def _problem(error: OSError, folder: Path) -> str:
    """Describe an operating system error, with the file if the error names one."""
    reason = error.strerror or str(error) or type(error).__name__
    if error.filename:
        return f"cannot write to {folder}: {error.filename}: {reason}"
    return f"the experiment was aborted: {reason}"


def _changed(loaded: Experiment, **changes: float | None) -> Experiment:
    given = {name: value for name, value in changes.items() if value is not None}
    return parse({**loaded.to_dict(), **given}) if given else loaded


def _progress(console: Console, update: object) -> Progress:
    def tell(line: str) -> None:
        console.print(escape(line), soft_wrap=True)

    def show(line: str) -> None:
        if callable(update):
            update(escape(line))

    return Progress(tell, show)


def _tell_outcome(console: Console, outcome: Outcome) -> None:
    shown = Table("", "check", "vehicle", "result", title=outcome.experiment.name, title_justify="left")
    for verdict in outcome.verdicts:
        mark = "[green]holds[/green]" if verdict.holds else "[red]failed[/red]"
        shown.add_row(mark, escape(verdict.check), verdict.vehicle, escape(verdict.found))
    if outcome.verdicts:
        console.print(shown)
    if outcome.problem:
        console.print(f"[red]aborted:[/red] {escape(outcome.problem)}", soft_wrap=True)
    console.print(f"report: {outcome.folder}/summary.md", soft_wrap=True)

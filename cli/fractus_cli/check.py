"""`fractus check`: find errors in driver programs before they fly."""

from __future__ import annotations

import json
import pathlib

import click

from fractus_cli import EXIT_INFEASIBLE
from fractus_cli.output import output_option, printable
from fractus_cli.program_check import check_program


@click.command()
@click.argument(
    "programs",
    nargs=-1,
    required=True,
    metavar="PROGRAM...",
    type=click.Path(exists=True, dir_okay=False, path_type=pathlib.Path),
)
@output_option
def check(programs: tuple[pathlib.Path, ...], output: str) -> None:
    """Check driver programs without running them.

    Finds calls of the SDK with wrong names or arguments, forgotten awaits, calls that block the event loop, suppressed
    cancellations, and programs that `fractus.run` refuses. A type checker (mypy) finds further errors. The exit code is 2 if
    there is a problem.
    """
    found = []
    for path in programs:
        try:
            source = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise click.ClickException(f"{path}: cannot read the program as UTF-8 text ({error})") from None
        found += [{"file": str(path), "line": p.line, "problem": p.text} for p in check_program(source)]
    if output == "json":
        click.echo(json.dumps({"problems": found}))
    for problem in found if output == "text" else ():
        click.echo(printable(f"{problem['file']}:{problem['line']}: {problem['problem']}"))
    if found:
        raise click.exceptions.Exit(EXIT_INFEASIBLE)
    if output == "text":
        click.echo("no problem found")

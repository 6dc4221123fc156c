"""Common behaviour of the commands: signals, errors, expectations and exit codes.

Exit codes: 0 if all expectations hold, 2 if an expectation does not hold, 1 for an error.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import click
from fractus_cluster.errors import ClusterError
from fractus_core.api.model import InvalidObject

from fractus_sim.errors import ExperimentError
from fractus_sim.interruption import interrupt_on_signals
from fractus_sim.report.report_files import PAGE, Expectation

EXIT_FAILED = 2


@contextmanager
def command_errors() -> Iterator[None]:
    """Run a block with interruption by signals. Print expected errors in one line.

    Raises:
        ClickException: The block raised an expected error. click prints it and exits with 1.
    """
    interrupt_on_signals()
    try:
        yield
    except (ExperimentError, ClusterError, InvalidObject) as error:
        raise click.ClickException(str(error)) from None
    except OSError as error:
        raise click.ClickException(_describe(error)) from None


def _describe(error: OSError) -> str:
    reason = error.strerror or str(error) or type(error).__name__
    if error.filename:
        return f"cannot read or write {error.filename}: {reason}"
    return f"the run was aborted: {reason}"


def exit_with_expectations(expectations: Sequence[Expectation], out: Path) -> None:
    """Print the expectations that do not hold, and a summary. Exit with 2 if an expectation does not hold."""
    failed = [expectation for expectation in expectations if not expectation.holds]
    for expectation in failed:
        run = f", {expectation.run}" if expectation.run else ""
        click.echo(f"NOT AS EXPECTED{run}: {expectation.text} ({expectation.observed})", err=True)
    click.echo(f"{len(expectations) - len(failed)} of {len(expectations)} expectations hold; see {out / PAGE}")
    if failed:
        sys.exit(EXIT_FAILED)

"""The `fractus` command: finds its subcommands in whatever parts of Fractus are installed."""

from __future__ import annotations

import difflib
import importlib.metadata
import sys
from collections.abc import Sequence

import click

GROUP = "fractus.commands"
EXIT_OK = 0
EXIT_BAD_INPUT = 1
EXIT_INFEASIBLE = 2
EXIT_INTERRUPTED = 130

_EXTRA_OF = {
    "fractus_cluster": "sim",
    "fractus_sim": "sim",
    "fractus_vehicle": "sim",
    "fractus_world": "sim",
    "fractus_services": "services",
    "fractus_agent": "agent",
    "fractus_cli": "core",
}


class LazyGroup(click.Group):
    """A group whose commands are entry points, imported only when they are asked for.

    A command whose extra is not installed stays out of the help; calling it says what to install.
    """

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names of the commands that there could be."""
        return sorted({*super().list_commands(ctx), *(e.name for e in _entry_points())})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import one command; None when there is none of that name."""
        own = super().get_command(ctx, cmd_name)
        if own is not None:
            return own
        for entry in _entry_points():
            if entry.name == cmd_name:
                return _load(entry)
        return None

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command meant; a mistyped one is answered with the nearest."""
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError:
            near = difflib.get_close_matches(args[0], self.list_commands(ctx), n=1)
            hint = f"did you mean {near[0]}?" if near else "see `fractus --help`"
            raise click.UsageError(f"there is no command {args[0]}; {hint}") from None


def _entry_points() -> Sequence[importlib.metadata.EntryPoint]:
    return tuple(importlib.metadata.entry_points(group=GROUP))


def _load(entry: importlib.metadata.EntryPoint) -> click.Command:
    try:
        command = entry.load()
    except ImportError as error:
        return _missing(entry, error)
    if not isinstance(command, click.Command):
        raise click.ClickException(f"{entry.value} is not a command; reinstall the package that brings it")
    return command


def _missing(entry: importlib.metadata.EntryPoint, error: ImportError) -> click.Command:
    extra = _EXTRA_OF.get(entry.module.split(".", maxsplit=1)[0], "sim")
    lacking = error.name or str(error)

    @click.command(entry.name, hidden=True, add_help_option=False, context_settings={"ignore_unknown_options": True})
    @click.argument("rest", nargs=-1, type=click.UNPROCESSED)
    def hint(rest: tuple[str, ...]) -> None:
        del rest
        raise click.ClickException(
            f"`fractus {entry.name}` needs {lacking}; install it with: pip install 'fractus[{extra}]'"
        )

    return hint


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="fractus", prog_name="fractus", message="%(prog)s %(version)s")
def fractus() -> None:
    """Run, check and watch Fractus: drones, edge and cloud under stakeholders' policies."""


def run(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code: 0, 1 for bad input, 2 for what cannot be done as asked.

    A command refuses by raising: `click.ClickException`, or any exception with an integer `exit_code`; its text is the
    one line that the user sees.
    """
    try:
        outcome = fractus.main(
            args=list(arguments) if arguments is not None else None, prog_name="fractus", standalone_mode=False
        )
    except Exception as error:  # the outermost edge of the program: one line instead of a traceback
        return _explain(error)
    except KeyboardInterrupt:
        return _complain("interrupted", EXIT_INTERRUPTED)
    return outcome if isinstance(outcome, int) else EXIT_OK


def _explain(error: Exception) -> int:
    while isinstance(error, ExceptionGroup):
        error = error.exceptions[0]  # what failed first; what it took along says less
    match error:
        case click.exceptions.NoArgsIsHelpError():
            click.echo(error.format_message())
            return EXIT_OK
        case click.UsageError():
            where = f" (see `{error.ctx.command_path} --help`)" if error.ctx is not None else ""
            return _complain(error.format_message() + where, EXIT_BAD_INPUT)
        case click.ClickException():
            return _complain(error.format_message(), error.exit_code)
        case click.Abort():
            return _complain("interrupted", EXIT_INTERRUPTED)
        case BrokenPipeError():
            sys.stderr.close()
            return EXIT_OK
    code = getattr(error, "exit_code", EXIT_BAD_INPUT)
    return _complain(_sentence(error), code if isinstance(code, int) else EXIT_BAD_INPUT)


def _sentence(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    text = " ".join(str(error).split())
    return text or type(error).__name__


def _complain(message: str, code: int) -> int:
    click.echo(f"fractus: {' '.join(message.split())}", err=True)
    return code


def main() -> None:
    """Entry point of the `fractus` command."""
    sys.exit(run())

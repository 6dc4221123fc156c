"""The `fractus` command. It lists subcommands without importing them, and imports only the called subcommand."""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import click

from fractus_cli import EXIT_BAD_INPUT, EXIT_INTERRUPTED, EXIT_OK
from fractus_cli.output import printable

_MARKERS = {
    "geometry": "shapely",
    "kube": "kubernetes",
    "management": "fastapi",
    "model": "pydantic",
    "operator": "cryptography",
    "services": "cv2",
    "sim": "matplotlib",
    "view": "aiohttp",
}
"""For each extra, a module that the extra installs.

A search for the module takes a millisecond. An import of the command takes up to a second.
"""


@dataclass(frozen=True, slots=True)
class Entry:
    """Location and summary of a subcommand.

    The location is a string, because importing every command would take seconds and fail if an extra is missing.

    Attributes:
        location: MODULE:ATTRIBUTE.
        summary: Text in `fractus --help`.
        extra: Extra of fractus-drones that the command requires, or an empty string. "sim" stands for the distribution fractus-sim.
    """

    location: str
    summary: str
    extra: str = ""

    @property
    def installed(self) -> bool:
        """True if the module of the command and a module of its extra are installed."""
        modules = [self.location.partition(":")[0].partition(".")[0], *filter(None, [_MARKERS.get(self.extra)])]
        return all(importlib.util.find_spec(module) for module in modules)

    @property
    def requirement(self) -> str:
        """Requirement with which pip installs the command."""
        if self.extra == "sim":
            return "fractus-sim"
        return f"fractus-drones[{self.extra}]" if self.extra else "fractus-drones"


COMMANDS: dict[str, Entry] = {
    "api": Entry("fractus_management.command:api", "Serve the REST API for flights as a service.", "management"),
    "audit": Entry("fractus_cli.audit:audit", "Verify, show and export audit logs of a node's services and agent.", "services"),
    "camera": Entry("fractus_services.commands:camera", "Run the camera service of a node.", "services"),
    "camera-world": Entry("fractus_world.__main__:camera_world", "Serve images of a camera above a simulated world.", "sim"),
    "check": Entry("fractus_cli.check:check", "Check driver programs without running them."),
    "cluster": Entry("fractus_cluster.cli:cluster", "Run a Kubernetes cluster of several nodes on this machine.", "sim"),
    "completion": Entry("fractus_cli.completion:completion", "Print the completion script of a shell."),
    "cp": Entry("fractus_cli.cp:cp", "Copy files of a component, also after its mission.", "model"),
    "doctor": Entry("fractus_cli.doctor:doctor", "Check a cluster and print a remedy for each problem.", "operator"),
    "experiment": Entry("fractus_sim.experiment_command:experiment", "Run experiments with faults, checks and a report.", "sim"),
    "explain": Entry("fractus_cli.explain:explain", "Explain the plan of an Application.", "kube"),
    "flights": Entry("fractus_cli.flights:flights", "Order, start, watch and end flights of approved applications.", "operator"),
    "gateway": Entry("fractus_services.commands:gateway", "Run the gateway for MAVLink programs.", "services"),
    "grants": Entry("fractus_cli.grants:grants", "Sign Grants and issue certificates, without Kubernetes.", "operator"),
    "images": Entry("fractus_cluster.images.cli:images", "Build and list the container images of Fractus.", "sim"),
    "init": Entry("fractus_cli.init:init", "Write the files of a new application.", "model"),
    "mobility": Entry("fractus_services.commands:mobility", "Run the mobility service of a drone.", "services"),
    "plan": Entry("fractus_cli.plan:plan", "Plan Applications from manifests, without a cluster.", "geometry"),
    "policy": Entry("fractus_cli.policy:policy", "Judge a call with the policy engine, without a cluster.", "geometry"),
    "report": Entry("fractus_sim.report_command:report", "Write the report of an Application's last flight.", "sim"),
    "schema": Entry("fractus_cli.schema:schema", "Print the JSON schema of manifests.", "model"),
    "status": Entry("fractus_cli.status:status", "Show the drones and applications of a cluster.", "kube"),
    "telemetry": Entry("fractus_cli.telemetry:telemetry", "Print the state of a drone until interrupted."),
    "vehicle": Entry("fractus_vehicle.__main__:vehicle", "Simulate ArduCopter-compatible vehicles.", "sim"),
    "view": Entry("fractus_view.command:view", "Show live or recorded flights on a web page.", "view"),
    "zones": Entry("fractus_cli.zones:zones", "Import and export Zones in other formats.", "geometry"),
}  # fmt: skip


class LazyGroup(click.Group):
    """Group that imports a command when it is called, and lists the commands whose extra is installed."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all commands."""
        return sorted(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a command. Return None if the name is unknown."""
        entry = COMMANDS.get(cmd_name)
        if entry is None:
            return None
        module, _, attribute = entry.location.partition(":")
        try:
            command: click.Command = getattr(importlib.import_module(module), attribute)
        except ImportError as error:
            return _missing(cmd_name, entry, error)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, entry.summary) for name, entry in COMMANDS.items() if entry.installed])

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command. If it is unknown, the error suggests the closest name."""
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError:
            near = difflib.get_close_matches(args[0], COMMANDS, n=1)
            hint = f"did you mean {near[0]}?" if near else "see `fractus --help`"
            raise click.UsageError(f"unknown command {args[0]}; {hint}") from None


def _missing(name: str, entry: Entry, error: ImportError) -> click.Command:
    module = error.name or str(error)

    @click.command(name, hidden=True, add_help_option=False, context_settings={"ignore_unknown_options": True})
    @click.argument("rest", nargs=-1, type=click.UNPROCESSED)
    def hint(rest: tuple[str, ...]) -> None:
        del rest
        raise click.ClickException(
            f"`fractus {name}` requires {module}; install it with: pip install '{entry.requirement}'"
        )

    return hint


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="fractus-drones", prog_name="fractus", message="%(prog)s %(version)s")
def fractus() -> None:
    """Plan, run, check and watch applications on drones, edge nodes and the cloud."""


def run(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code: 0 for success, 1 for bad input, 2 for an infeasible request or failed check.

    A command fails by raising `click.ClickException`, or any exception with an optional integer `exit_code`. The text of
    the exception is printed as one line.
    """
    try:
        outcome = fractus.main(
            args=list(arguments) if arguments is not None else None, prog_name="fractus", standalone_mode=False
        )
    except Exception as error:  # Print one line instead of a traceback.
        return _report(error)
    except KeyboardInterrupt:
        return _print_error("interrupted", EXIT_INTERRUPTED)
    return outcome if isinstance(outcome, int) else EXIT_OK


def _report(error: Exception) -> int:
    while isinstance(error, ExceptionGroup):
        error = error.exceptions[0]  # Report only the first failure, because it cancelled the other tasks.
    match error:
        case click.exceptions.NoArgsIsHelpError():
            click.echo(error.format_message())
            return EXIT_OK
        case click.UsageError():
            hint = f" (see `{error.ctx.command_path} --help`)" if error.ctx is not None else ""
            return _print_error(error.format_message() + hint, EXIT_BAD_INPUT)
        case click.ClickException():
            return _print_error(error.format_message(), error.exit_code)
        case click.Abort():
            return _print_error("interrupted", EXIT_INTERRUPTED)
        case BrokenPipeError():
            sys.stderr.close()
            return EXIT_OK
    code = getattr(error, "exit_code", EXIT_BAD_INPUT)
    return _print_error(_sentence(error), code if isinstance(code, int) else EXIT_BAD_INPUT)


def _sentence(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return " ".join(str(error).split()) or type(error).__name__


def _print_error(message: str, code: int) -> int:
    click.echo(printable(f"fractus: {' '.join(message.split())}"), err=True)
    return code


def main() -> None:
    """Entry point of the `fractus` command."""
    sys.exit(run())

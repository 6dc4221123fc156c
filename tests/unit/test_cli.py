"""The `fractus` command: what it finds, what it says when something is wrong, and its exit codes."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import click
import pytest
from fractus_cli import main as cli


class Infeasible(Exception):
    exit_code = 2


@click.command()
@click.argument("how")
def probe(how: str) -> None:
    """Do what the test says."""
    if how == "infeasible":
        raise Infeasible("no drone can fly\nso far")
    if how == "bug":
        raise RuntimeError("something broke")
    if how == "task":
        raise ExceptionGroup("unhandled errors in a TaskGroup", [ExceptionGroup("", [ValueError("no port in tcp:x")])])
    if how == "file":
        open("/no/such/file")  # noqa: PTH123, SIM115
    if how == "bad":
        raise click.ClickException("latitude must be -90 to 90, not 95")
    if how == "stop":
        raise KeyboardInterrupt
    click.echo(how)


@pytest.fixture
def commands(monkeypatch: pytest.MonkeyPatch) -> None:
    entries = {
        "probe": cli.Entry(f"{__name__}:probe", "Do what the test says."),
        "cluster": cli.Entry("no_such_package.cli:cluster", "A cluster.", "sim"),
    }
    monkeypatch.setattr(cli, "COMMANDS", entries)


@pytest.fixture
def fractus(commands: None, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    def call(*arguments: str) -> tuple[int, str, str]:
        code = cli.run(arguments)
        said = capsys.readouterr()
        return code, said.out, said.err

    return call


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["probe", "infeasible"], 2, "fractus: no drone can fly so far\n"),
        (["probe", "bug"], 1, "fractus: something broke\n"),
        (["probe", "file"], 1, "fractus: /no/such/file: No such file or directory\n"),
        (["probe", "task"], 1, "fractus: no port in tcp:x\n"),
        (["probe", "bad"], 1, "fractus: latitude must be -90 to 90, not 95\n"),
        (["probe", "stop"], 130, "\nfractus: interrupted\n"),
        (["probe"], 1, "fractus: Missing argument 'HOW'. (see `fractus probe --help`)\n"),
        (["prob"], 1, "fractus: there is no command prob; did you mean probe?\n"),
        (["xyz"], 1, "fractus: there is no command xyz; see `fractus --help`\n"),
    ],
)
def test_what_goes_wrong_is_one_line_and_an_exit_code(
    fractus: Callable[..., tuple[int, str, str]], arguments: list[str], code: int, said: str
) -> None:
    assert fractus(*arguments) == (code, "", said)


def test_a_command_runs(fractus: Callable[..., tuple[int, str, str]]) -> None:
    assert fractus("probe", "well") == (0, "well\n", "")


def test_a_command_whose_extra_is_missing_is_hidden_and_says_what_to_install(
    fractus: Callable[..., tuple[int, str, str]],
) -> None:
    code, out, _ = fractus("--help")
    assert code == 0
    assert "probe" in out
    assert "cluster" not in out
    code, _, err = fractus("cluster", "up", "--nodes", "3")
    assert code == 1
    assert "pip install 'fractus-drones[sim]'" in err


def test_version_and_bare_command(fractus: Callable[..., tuple[int, str, str]]) -> None:
    code, out, _ = fractus("--version")
    assert (code, out) == (0, f"fractus {importlib.metadata.version('fractus-drones')}\n")
    code, out, _ = fractus()
    assert code == 0
    assert out.startswith("Usage: fractus")


@pytest.mark.parametrize("name", sorted(cli.COMMANDS))
def test_the_list_names_commands_that_are_there(name: str) -> None:
    entry = cli.COMMANDS[name]
    assert entry.installed
    module, _, attribute = entry.place.partition(":")
    package, *below = module.split(".")
    spec = importlib.util.find_spec(package)
    assert spec is not None
    assert spec.submodule_search_locations is not None
    # Looked for in the source: to import every command takes seconds.
    source = Path(spec.submodule_search_locations[0], *below).with_suffix(".py")
    assert f"\ndef {attribute}(" in source.read_text()


def test_help_imports_no_command() -> None:
    program = "import sys; from fractus_cli.main import run; run(['--help']); print(*sys.modules, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    for name in cli.COMMANDS:
        assert f"\n  {name} " in done.stdout
    imported = {module.partition(".")[0] for module in done.stderr.split()}
    assert {module for module in imported if module.startswith("fractus")} == {"fractus_cli"}
    assert not imported & {"grpc", "numpy", "shapely", "pydantic", "yaml"}

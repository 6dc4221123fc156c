"""The `fractus` command: subcommands, error messages and exit codes."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import click
import pytest
from fractus_cli import EXIT_BAD_INPUT
from fractus_cli import main as cli
from fractus_cluster.cluster import Cluster, NodeStatus


class Infeasible(Exception):
    exit_code = 2


@click.command()
@click.argument("how")
def probe(how: str) -> None:
    """Fail in a given way, or print HOW."""
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
    if how == "escape":
        raise click.ClickException("there is no zone \x1b[2J\u202etown")
    if how == "stop":
        raise KeyboardInterrupt
    click.echo(how)


@pytest.fixture
def commands(monkeypatch: pytest.MonkeyPatch) -> None:
    entries = {
        "probe": cli.Entry(f"{__name__}:probe", "Fail in a given way."),
        "cluster": cli.Entry("no_such_package.cli:cluster", "A cluster.", "sim"),
    }
    monkeypatch.setattr(cli, "COMMANDS", entries)


@pytest.fixture
def fractus(commands: None, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    def call(*arguments: str) -> tuple[int, str, str]:
        code = cli.run(arguments)
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["probe", "infeasible"], 2, "fractus: no drone can fly so far\n"),
        (["probe", "bug"], 1, "fractus: something broke\n"),
        (["probe", "file"], 1, "fractus: /no/such/file: No such file or directory\n"),
        (["probe", "task"], 1, "fractus: no port in tcp:x\n"),
        (["probe", "bad"], 1, "fractus: latitude must be -90 to 90, not 95\n"),
        (["probe", "escape"], 1, "fractus: there is no zone \\x1b[2J\\u202etown\n"),
        (["probe", "stop"], 130, "\nfractus: interrupted\n"),
        (["probe"], 1, "fractus: Missing argument 'HOW'. (see `fractus probe --help`)\n"),
        (["prob"], 1, "fractus: unknown command prob; did you mean probe?\n"),
        (["xyz"], 1, "fractus: unknown command xyz; see `fractus --help`\n"),
    ],
)
def test_failure_prints_one_line_and_returns_exit_code(
    fractus: Callable[..., tuple[int, str, str]], arguments: list[str], code: int, message: str
) -> None:
    assert fractus(*arguments) == (code, "", message)


def test_command_runs_and_returns_0(fractus: Callable[..., tuple[int, str, str]]) -> None:
    assert fractus("probe", "well") == (0, "well\n", "")


def test_command_without_its_extra_is_hidden_and_names_the_requirement(
    fractus: Callable[..., tuple[int, str, str]],
) -> None:
    code, out, _ = fractus("--help")
    assert code == 0
    assert "probe" in out
    assert "cluster" not in out
    code, _, err = fractus("cluster", "up", "--nodes", "3")
    assert code == 1
    assert "pip install 'fractus-sim'" in err


def test_version_and_help_without_command_return_0(fractus: Callable[..., tuple[int, str, str]]) -> None:
    code, out, _ = fractus("--version")
    assert (code, out) == (0, f"fractus {importlib.metadata.version('fractus-drones')}\n")
    code, out, _ = fractus()
    assert code == 0
    assert out.startswith("Usage: fractus")


@pytest.mark.parametrize("name", sorted(cli.COMMANDS))
def test_listed_command_exists(name: str) -> None:
    entry = cli.COMMANDS[name]
    assert entry.installed
    module, _, attribute = entry.location.partition(":")
    package, *below = module.split(".")
    spec = importlib.util.find_spec(package)
    assert spec is not None
    assert spec.submodule_search_locations is not None
    # Search the source, because importing every command takes seconds.
    source = Path(spec.submodule_search_locations[0], *below).with_suffix(".py")
    assert f"\ndef {attribute}(" in source.read_text()


def test_cluster_error_is_printed_as_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FRACTUS_STATE", str(tmp_path))
    assert cli.run(["cluster", "status"]) == EXIT_BAD_INPUT
    assert capsys.readouterr().err == "fractus: no cluster; start one: fractus cluster up FILE\n"


@pytest.mark.parametrize(("powered", "code"), [(True, 0), (False, 2)])
def test_cluster_status_prints_json_and_exit_code(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], powered: bool, code: int
) -> None:
    node = NodeStatus("drone-1", "drone", "10.0.0.2", powered, True, True, None, True)
    shown = SimpleNamespace(name="demo", running=True, radio=SimpleNamespace(running=None), status=lambda: [node])
    monkeypatch.setattr(Cluster, "existing", lambda _name: shown)
    assert run_to_end(["cluster", "status", "-o", "json"]) == code
    status = json.loads(capsys.readouterr().out)
    assert (status["well"], status["radio"], status["nodes"][0]["name"]) == (powered, None, "drone-1")
    assert status["nodes"][0]["vehicle_running"] is None
    assert run_to_end(["cluster", "status"]) == code
    assert "drone-1" in capsys.readouterr().out


def run_to_end(arguments: list[str]) -> int:
    try:
        return cli.run(arguments)
    except SystemExit as ended:
        return int(ended.code or 0)


def test_unknown_autopilot_link_type_is_reported_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("grants", "tls", "state"):
        (tmp_path / name).mkdir()
    directories = [f"--{name}={tmp_path / name}" for name in ("grants", "tls", "state")]
    argv = ["mobility", "serve", *directories, f"--audit={tmp_path}/audit.jsonl", f"--description={tmp_path}/none.yaml"]
    assert cli.run([*argv, f"--node-object={tmp_path}/none.json", "--autopilot", "bluetooth:x"]) == EXIT_BAD_INPUT
    lines = capsys.readouterr().err.splitlines()
    assert "bluetooth" in lines[-1] and lines[-1].startswith("fractus: ")
    assert not any("Traceback" in line for line in lines)

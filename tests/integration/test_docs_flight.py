"""Run the flight without Kubernetes of docs/standalone.md, and commands of other pages on the files of the flight."""

from __future__ import annotations

import contextlib
import re
import shlex
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml
from browser import serving, wait_for_events
from docs_pages import ROOT, shell_lines, shown_file
from docs_shell import Shell
from fractus_cli.standalone import StandalonePki
from fractus_cluster.ports import free_port
from fractus_core.api import Grant
from fractus_runtime.audit_chain import last_entry
from operator_world import FRACTUS, World

pytestmark = pytest.mark.slow

PAGE = "docs/standalone.md"
TEXT = (ROOT / PAGE).read_text()
INIT, SIGN, MOBILITY, CAMERA, FLY, SINCE, SINCE_STATUS = shell_lines(PAGE)
_CLUSTER, LIVE, REPLAY = (line for line in shell_lines("docs/view.md") if line.startswith("fractus view"))
FLIGHT_TIMEOUT_S = 120


@dataclass(frozen=True)
class Flown:
    """Results of a flight.

    Attributes:
        folder: Working directory of the commands.
        output: Output of the component.
    """

    folder: Path
    output: str


def command_in_sentence(beginning: str) -> str:
    """Return the command with this beginning that the page shows between backticks."""
    match = re.search(rf"`({beginning}[^`]*)`", TEXT)
    assert match is not None, beginning
    return match[1]


@contextlib.contextmanager
def serving_process(shell: Shell, folder: Path, line: str) -> Iterator[None]:
    """Run a service until the end of the block, and then terminate it."""
    program = shlex.split(line)
    with (folder / f"{program[1]}.log").open("wb") as log:
        process = subprocess.Popen(program, cwd=folder, env=shell.environment, stdout=log, stderr=log)
        try:
            yield
        finally:
            process.terminate()
            process.wait(20)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """Fly as docs/standalone.md describes, with recordings as docs/recordings.md describes."""
    folder = tmp_path_factory.mktemp("standalone")
    shell = Shell(folder)
    ports = {known: str(free_port()) for known in ("50051", "50052", "5760")}

    def with_free_ports(line: str) -> str:
        return re.sub("|".join(ports), lambda match: ports[match[0]], line)

    def listens(port: str) -> str:
        return f" --listen 127.0.0.1:{ports[port]} --description none.yaml"

    for name in ("survey.yaml", "navigator.py"):
        (folder / name).write_text(shown_file(PAGE, name))
    shell.type(INIT)
    shell.type(command_in_sentence("cp -r"))
    shell.type(SIGN)
    vehicle = (
        f"{command_in_sentence('fractus vehicle')} --listen tcp:127.0.0.1:{ports['5760']} --ready-after 2 --speedup 3"
    )
    mobility = re.sub(r"--autopilot \S+", with_free_ports(command_in_sentence("--autopilot tcp")), MOBILITY)
    with (
        serving_process(shell, folder, vehicle),
        serving_process(shell, folder, f"{mobility} --recordings recordings/mobility{listens('50051')}"),
        serving_process(
            shell, folder,
            f"{CAMERA} --recordings recordings/camera --mobility 127.0.0.1:{ports['50051']}{listens('50052')}",
        ),
    ):  # fmt: skip
        result = subprocess.run(
            ["bash", "-c", with_free_ports(FLY)], cwd=folder, env=shell.environment, capture_output=True, text=True,
            timeout=FLIGHT_TIMEOUT_S, check=False,
        )  # fmt: skip
    logs = "".join((folder / f"{name}.log").read_text() for name in ("vehicle", "mobility", "camera"))
    assert result.returncode == 0, result.stdout + result.stderr + logs
    return Flown(folder, result.stdout + result.stderr)


def test_component_reports_corrected_and_denied_calls(flown: Flown) -> None:
    assert re.search(r"^climbed to 15 m: .*policy low", flown.output, re.MULTILINE), flown.output
    assert re.search(r"^waypoint skipped: .*zone pool of policy pool", flown.output, re.MULTILINE), flown.output
    assert re.search(r"^picture of \d{4,} bytes$", flown.output, re.MULTILINE), flown.output
    assert "run: mission complete" in flown.output


def test_audit_log_has_the_verdicts_and_verification_finds_removed_entries(
    flown: Flown, world: World, tmp_path: Path
) -> None:
    shutil.copytree(flown.folder, tmp_path, dirs_exist_ok=True)
    shell = Shell(tmp_path, world.plane)
    verdicts = shell.type(command_in_sentence("fractus audit show"))
    assert re.search(r"Takeoff.*\blow\b", verdicts), verdicts
    assert re.search(r"Goto.*\bpool\b", verdicts), verdicts
    kept = tmp_path / "kept"
    kept.mkdir()
    for name in ("mobility", "camera"):
        shutil.copy(tmp_path / "audit" / f"{name}.checkpoint", kept)
    log = tmp_path / "audit/mobility.jsonl"
    head = last_entry(log)
    assert head is not None
    reported = {"status": {"audit": [f"mobility:{head.sequence}:{head.hash}"]}}
    world.api.merge(f"{FRACTUS}/drones/drone-1/status", reported)
    alone = command_in_sentence("fractus audit verify audit")
    for line in (alone, SINCE, SINCE_STATUS):
        shell.type(line)
    log.write_text("".join(log.read_text().splitlines(keepends=True)[:-3]))
    (tmp_path / "audit/mobility.checkpoint").unlink()
    shell.type(alone)
    for line in (SINCE, SINCE_STATUS):
        shell.type(line, code=1)


def test_grants_are_signed_from_python(flown: Flown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(flown.folder / "pki", tmp_path / "pki")
    monkeypatch.chdir(tmp_path)
    names = {"manifest": yaml.safe_load(shown_file(PAGE, "survey.yaml")), "Grant": Grant}
    exec(re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)[-1], names)
    assert names["StandalonePki"] is StandalonePki
    assert (tmp_path / "grants/default.survey-navigator.json").is_file()
    for folder in (names["tls"], names["own"]):
        assert {"tls.key", "tls.crt", "ca.crt"} <= {path.name for path in (tmp_path / str(folder)).iterdir()}


@pytest.mark.parametrize("line", [LIVE, REPLAY], ids=["live", "replay"])
def test_view_shows_the_recordings(flown: Flown, line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(flown.folder)
    folder = flown.folder / "recordings"
    for name, recorded in (("flight", "mobility"), ("camera", "camera")):
        (recording,) = (folder / recorded).glob("*.mcap")
        shutil.copy(recording, f"{name}.mcap")
        recording.touch()
    words = [word.replace("/var/lib/fractus/recordings", str(folder)) for word in shlex.split(line, comments=True)]
    with serving(*words[2:]) as address:
        wait_for_events(address, '"drone-1"', '"verdict"', "InsideExclusionZone", '"picture"')

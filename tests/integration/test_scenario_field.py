"""Fly the violating program of the field experiment with a running autopilot that has another home, and settings of its owner.

Waypoints, readiness, modes and acknowledgements must not depend on the set-up of the scenario's own vehicles. Only
`make scenario-field` flies the other runs, because one run takes more than a minute.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from fractus_cluster.ports import free_port
from owner_settings import assert_owned, parameter_arguments, read_settings, upload_lists
from vehicle_process import running_vehicle

pytestmark = pytest.mark.slow

SPEEDUP = "2"
HOME = (-35.3632621, 149.1652374)
RESTORED = "the vehicle has the parameters, the fence and the rally points of its owner again"


def scenario(link: str, folder: Path, *arguments: str) -> subprocess.Popen[str]:
    command = [
        sys.executable,
        "-m",
        "fractus_sim.scenarios.field",
        "--out",
        str(folder / "field"),
        "--state",
        str(folder / "state"),
    ]
    return subprocess.Popen(
        [*command, "--autopilot", link, "--speedup", SPEEDUP, *arguments],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=Path(__file__).parents[2], env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )  # fmt: skip


def until_printed(process: subprocess.Popen[str], text: str) -> None:
    """Read the output of a process until it contains a text."""
    lines = []
    assert process.stdout is not None
    for line in process.stdout:
        lines.append(line)
        if text in line:
            return
    raise AssertionError("".join(lines))


def end_program(folder: Path, name: str) -> None:
    """Kill a program of the experiment, whose process was started with the path of its file."""
    found = subprocess.run(["pgrep", "-f", f"{name}.py"], capture_output=True, text=True, check=True)
    for number in found.stdout.split():
        if str(folder).encode() in Path(f"/proc/{number}/environ").read_bytes():
            os.kill(int(number), signal.SIGKILL)


@pytest.mark.timeout(500)
def test_scenario_field_violating_program_is_corrected_and_owner_settings_survive_a_killed_run(tmp_path: Path):
    link = f"tcp:127.0.0.1:{free_port()}"
    guest = f"tcp:127.0.0.1:{free_port()}"
    options = (
        "--sysid", "7", "--heading", "250", "--ready-after", "5", "--throttle", "1500", "--speedup", SPEEDUP, "--seed", "9",
        "--home", f"{HOME[0]},{HOME[1]},584", "--wind", "3,10,1", "--param", "WPNAV_ACCEL=150", "--param", "LAND_SPEED=70",
    )  # fmt: skip
    with running_vehicle(*options, *parameter_arguments(), links=(link, guest)):
        upload_lists(guest, HOME)
        owner = read_settings(guest)
        killed = scenario(link, tmp_path, "--run", "guarded")
        until_printed(killed, "granted: control point 1")
        time.sleep(3)
        end_program(tmp_path, "navigator")
        until_printed(killed, "waiting until the service has restored")
        killed.kill()
        killed.wait(10)
        assert read_settings(guest).differences(owner), "the killed run left settings of the mission"

        flown = scenario(link, tmp_path, "--run", "guarded")
        output = flown.communicate(timeout=300)[0]
        assert flown.returncode == 0, output[-4000:]
        assert "restoring the settings of the owner" in output
        assert_owned(guest, owner)
    out = tmp_path / "field"
    report = json.loads((out / "report.json").read_text())
    (run,) = report["runs"]
    assert report["holds"]
    assert RESTORED in {expectation["text"] for expectation in report["checks"]}
    assert report["home"]["lat"] == pytest.approx(-35.36326, abs=1e-4)
    assert run["corrected"] == 3
    assert "keep-away" in run["takeover"]
    for name in ("map.png", "altitude.png", "summary.md", "guarded/logs/drone-1.tlog"):
        assert (out / name).stat().st_size > 1000


def test_scenario_field_interrupted_run_names_the_command_that_restores_the_vehicle(tmp_path: Path):
    link = f"tcp:127.0.0.1:{free_port()}"
    guest = f"tcp:127.0.0.1:{free_port()}"
    home = ("--home", f"{HOME[0]},{HOME[1]},584", "--ready-after", "5", "--speedup", SPEEDUP)
    with running_vehicle(*home, *parameter_arguments(), links=(link, guest)):
        upload_lists(guest, HOME)
        owner = read_settings(guest)
        interrupted = scenario(link, tmp_path, "--run", "normal")
        until_printed(interrupted, "run: normal")
        log = tmp_path / "field/normal/logs/drone-1-mobility.log"
        deadline = time.monotonic() + 60
        while not (log.exists() and "failsafes: set" in log.read_text()):
            assert time.monotonic() < deadline
            time.sleep(0.2)
        interrupted.send_signal(signal.SIGINT)
        output = interrupted.communicate(timeout=60)[0]
        assert interrupted.returncode != 0
        assert "may still have settings of the experiment" in output
        assert "--restore" in output
        deadline = time.monotonic() + 120
        restored = scenario(link, tmp_path, "--restore")
        output = restored.communicate(timeout=120)[0]
        while "is armed" in output and time.monotonic() < deadline:
            restored = scenario(link, tmp_path, "--restore")
            output = restored.communicate(timeout=120)[0]
        assert restored.returncode == 0, output
        assert "the settings of the owner are restored" in output
        assert_owned(guest, owner)


def test_scenario_field_missing_autopilot_is_reported_in_one_line(tmp_path: Path):
    link = f"tcp:127.0.0.1:{free_port()}"
    process = subprocess.run(
        [sys.executable, "-m", "fractus_sim.scenarios.field", "--out", str(tmp_path), "--autopilot", link],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=60, check=False,
        cwd=Path(__file__).parents[2],
    )  # fmt: skip
    assert process.returncode == 1
    assert f"cannot connect to the autopilot at {link}" in process.stdout
    assert "Traceback" not in process.stdout

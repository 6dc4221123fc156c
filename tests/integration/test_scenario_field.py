"""The field experiment's violating flight, with an autopilot that was started apart, stands elsewhere, and flies slowly.

Waypoints, readiness, modes and acknowledgements must not depend on how the scenario's own vehicles are set up. The other
runs are left to `make scenario-field`: this one, three times faster than real time, takes more than a minute already.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from fractus_cluster.ports import free_port
from vehicle_process import running_vehicle

pytestmark = pytest.mark.slow

SLOW = ("WPNAV_SPEED=450", "WPNAV_ACCEL=150", "WPNAV_SPEED_UP=200", "RTL_ALT=1300", "LAND_SPEED=70")
SPEEDUP = "2"


@pytest.mark.timeout(320)
def test_a_violating_program_is_corrected_refused_and_brought_home(tmp_path: Path):
    link = f"tcp:127.0.0.1:{free_port()}"
    parameters = [part for setting in SLOW for part in ("--param", setting)]
    options = (
        "--sysid",
        "7",
        "--heading",
        "250",
        "--ready-after",
        "5",
        "--throttle",
        "1500",
        "--speedup",
        SPEEDUP,
        "--seed",
        "9",
    )
    elsewhere = ("--home", "-35.3632621,149.1652374,584", "--wind", "3,10,1")
    out = tmp_path / "field"
    with running_vehicle(*options, *elsewhere, *parameters, links=(link,)):
        done = subprocess.run(
            [sys.executable, "-m", "fractus_sim.scenarios.field", "--out", str(out), "--run", "guarded",
             "--autopilot", link, "--speedup", SPEEDUP],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=300, check=False,
            cwd=Path(__file__).parents[2],
        )  # fmt: skip
    assert done.returncode == 0, done.stdout[-4000:]
    report = json.loads((out / "report.json").read_text())
    (run,) = report["runs"]
    assert report["holds"]
    assert report["home"]["lat"] == pytest.approx(-35.36326, abs=1e-4)
    assert run["corrected"] == 3
    assert "keep-away" in run["takeover"]
    for name in ("map.png", "altitude.png", "summary.md", "guarded/logs/drone-1.tlog"):
        assert (out / name).stat().st_size > 1000


def test_an_autopilot_that_is_not_there_is_one_sentence(tmp_path: Path):
    link = f"tcp:127.0.0.1:{free_port()}"
    done = subprocess.run(
        [sys.executable, "-m", "fractus_sim.scenarios.field", "--out", str(tmp_path), "--autopilot", link],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=60, check=False,
        cwd=Path(__file__).parents[2],
    )  # fmt: skip
    assert done.returncode == 1
    assert f"no autopilot answers at {link}" in done.stdout
    assert "Traceback" not in done.stdout

"""Fly the violating program of the field experiment with a running autopilot that has another home and parameters.

Waypoints, readiness, modes and acknowledgements must not depend on the set-up of the scenario's own vehicles. Only
`make scenario-field` flies the other runs, because one run takes more than a minute.
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
def test_scenario_field_violating_program_is_corrected_refused_and_flown_home(tmp_path: Path):
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
    position = ("--home", "-35.3632621,149.1652374,584", "--wind", "3,10,1")
    out = tmp_path / "field"
    with running_vehicle(*options, *position, *parameters, links=(link,)):
        process = subprocess.run(
            [sys.executable, "-m", "fractus_sim.scenarios.field", "--out", str(out), "--run", "guarded",
             "--autopilot", link, "--speedup", SPEEDUP],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=300, check=False,
            cwd=Path(__file__).parents[2],
        )  # fmt: skip
    assert process.returncode == 0, process.stdout[-4000:]
    report = json.loads((out / "report.json").read_text())
    (run,) = report["runs"]
    assert report["holds"]
    assert report["home"]["lat"] == pytest.approx(-35.36326, abs=1e-4)
    assert run["corrected"] == 3
    assert "keep-away" in run["takeover"]
    for name in ("map.png", "altitude.png", "summary.md", "guarded/logs/drone-1.tlog"):
        assert (out / name).stat().st_size > 1000


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

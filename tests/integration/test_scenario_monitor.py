"""Fly two runs of the monitor scenario: a DroneKit program leaves its course, and pictures are taken above a no-photo zone.

`tests/component/test_monitor_scenario.py` tests the expectations without flights.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_scenario_monitor_keeps_a_dronekit_program_on_its_course_and_suppresses_pictures(tmp_path: Path):
    flown = subprocess.run(
        [
            sys.executable, "-m", "fractus_sim.scenarios.monitor", "--out", str(tmp_path), "--speedup", "1.5",
            "--run", "monitored", "--run", "declared",
        ],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False, cwd=Path(__file__).parents[2],
    )  # fmt: skip
    assert flown.returncode == 0, flown.stdout[-4000:]
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["holds"]
    assert len(report["runs"]) == 2
    assert "city-hall" in report["runs"][0]["takeover"]
    for name in ("map.png", "pictures.png", "summary.md", "monitored/logs/drone-1.tlog"):
        assert (tmp_path / name).stat().st_size > 1000

"""Bad MAVLink programs against a vehicle without the services, which obeys them."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from fractus_cluster.ports import free_port
from fractus_testing.malice import BREACH, mavlink_programs
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from vehicle_process import Client, running_vehicle


@pytest.mark.slow
def test_wrong_frames_reports_a_breach_if_the_vehicle_obeys() -> None:
    program_link, station_link = (f"tcp:127.0.0.1:{free_port()}" for _ in range(2))
    with running_vehicle("--speedup", "4", "--ready-after", "1", links=(program_link, station_link)):
        station = Client(station_link)
        station.wait(
            lambda _: (
                not station.command(
                    mavlink.MAV_CMD_DO_SET_MODE, mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, mavlink.COPTER_MODE_GUIDED
                )
            )
        )
        station.close()
        program = subprocess.run(
            [sys.executable, "-m", "fractus_testing.malice.mavlink_programs", "wrong-frames"],
            env={**os.environ, "FRACTUS_VEHICLE": program_link},
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
    assert program.returncode == BREACH, program.stderr
    assert "latitude and longitude exchanged: the drone flew" in program.stderr


def test_missing_telemetry_is_an_error_and_not_a_prevented_attack(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FRACTUS_VEHICLE", f"udpin:127.0.0.1:{free_port()}")
    monkeypatch.setattr(mavlink_programs, "ANSWER_TIMEOUT_S", 0.1)
    vehicle = mavlink_programs.Vehicle()
    vehicle.stop_heartbeats()
    with pytest.raises(SystemExit, match="no position was received"):
        vehicle.position()
    with pytest.raises(SystemExit, match="no heartbeat was received"):
        vehicle.armed()

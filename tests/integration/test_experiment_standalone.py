"""Drones with their services as local processes: programs as components, power failures, and complete clean-up."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from fractus_core.api.model import InvalidObject
from fractus_sim.experiment import ExperimentError
from fractus_sim.testbeds.standalone_drones import DroneSetup, Standalone
from mobility_rig import HOME, grant
from pymavlink import mavutil

pytestmark = pytest.mark.slow

PROGRAM = """
import asyncio, os, pathlib, fractus

async def main():
    (task,) = fractus.control_points()
    async with fractus.mobility() as drone, drone.control():
        async for state in drone.telemetry(interval_s=0.2):
            if state.ready or state.in_air:
                break
        if not state.in_air:
            await drone.arm()
            await drone.takeoff(5)
        print("up at", os.environ["FRACTUS_NODE"], len(task.path), flush=True)
        if pathlib.Path("hold").exists():
            await asyncio.sleep(600)
print("began", flush=True)
try:
    asyncio.run(main())
except fractus.FractusError as lost:  # the autopilot may have returned home before the restart, or while the program waited
    print("lost:", lost)
"""


def wait_for_output(drones: Standalone, text: str, count: int) -> None:
    """Wait until the output of the program contains the text `count` times."""
    log = drones.processes.log("pilot")
    deadline = time.monotonic() + 60
    while log.read_text().count(text) < count:
        assert time.monotonic() < deadline, log.read_text()
        time.sleep(0.1)


def test_program_flies_until_its_companion_computer_loses_power(tmp_path: Path) -> None:
    (tmp_path / "pilot.py").write_text(PROGRAM)
    (tmp_path / "hold").touch()
    with Standalone(tmp_path / "drones") as drones:
        drone = drones.add_drone(DroneSetup("drone-1", HOME, speedup=2))
        identity = drones.grant(grant())
        drones.run("pilot", [sys.executable, "pilot.py"], identity, folder=tmp_path)
        wait_for_output(drones, "up at drone-1 2", 1)
        drones.power_off("drone-1")
        assert not drones.processes.running("pilot")
        assert not drones.processes.running("drone-1-mobility")
        assert drones.processes.running("drone-1-vehicle")
        drones.check()
        (tmp_path / "hold").unlink()
        drones.power_on("drone-1")
        wait_for_output(drones, "began", 2)
        assert drones.processes.wait_end("pilot", 30) == 0
        drones.check()
        tlog = str(drone.tlog)
    assert not subprocess.run(["pgrep", "-f", str(tmp_path)], capture_output=True, check=False).stdout
    log = mavutil.mavlink_connection(tlog)
    takeoff = log.recv_match(type="COMMAND_LONG", condition="COMMAND_LONG.command==22")
    log.close()
    assert takeoff is not None, "the tlog lacks the takeoff command of the service"


def test_gateway_socket_is_in_the_directory_of_its_drone_also_with_a_long_path(tmp_path: Path) -> None:
    folder = tmp_path / ("long" * 30)
    with Standalone(folder) as drones:
        drones.add_drone(DroneSetup("drone-1", HOME, gateway=True))
        drones.processes.wait("drone-1-gateway", (folder / "drone-1" / "gateway.sock").is_socket, 10)
        drones.check()


def test_standalone_rejects_invalid_use_immediately(tmp_path: Path) -> None:
    with Standalone(tmp_path) as drones:
        with pytest.raises(ExperimentError, match="no drone drone-1; known: none"):
            drones.grant(grant())
        with pytest.raises(ExperimentError, match="has no Grant"):
            drones.environment("spiffe://fractus.dev/ns/a/app/b/component/C/instance/d")
        bad: dict[str, Any] = {"services": {"mobility": {"maxSpeed": -1}}}
        with pytest.raises(InvalidObject, match="maxSpeed"):
            drones.add_drone(DroneSetup("drone-1", HOME, description=bad))
        with pytest.raises(ExperimentError, match="drone-2-vehicle ended with"):
            drones.add_drone(DroneSetup("drone-2", HOME, vehicle_arguments=("--no-such-option",)))

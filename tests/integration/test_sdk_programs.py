"""Driver programs as real processes and in a real Jupyter kernel, and the types of the SDK under mypy."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
import textwrap
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from jupyter_client.asynchronous.client import AsyncKernelClient
from jupyter_client.manager import start_new_async_kernel
from mobility_rig import DRIVER, NAVIGATOR_MISSION, NODE, Rig, grant, outcomes

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

HANGING = """
import sys, time
import fractus

async def patrol(drone, control):
    await drone.arm()
    await drone.takeoff(8)
    print("up", flush=True)
    time.sleep(float(sys.argv[1]))
    async for point in control.remaining():
        await drone.goto(point.lat, point.lon, point.alt)

fractus.run(patrol)
"""

NOTEBOOK = (
    "import fractus",
    """
async def patrol(drone, control):
    await drone.arm()
    await drone.takeoff(8)
    async for point in control.remaining():
        await drone.goto(point.lat, point.lon, point.alt)
    print("waypoints", control.waypoints_reached)
""",
)


@pytest.fixture
def environment(rig: Rig) -> dict[str, str]:
    """Environment variables of a component on the drone."""
    folder = rig.directory / "driver-tls"
    folder.mkdir()
    key, certificate = rig.authority.issue(DRIVER)
    for name, data in (("tls.key", key), ("tls.crt", certificate), ("ca.crt", rig.authority.pem)):
        (folder / name).write_bytes(data)
    return {"FRACTUS_NODE": NODE, "FRACTUS_MOBILITY_ADDRESS": rig.address, "FRACTUS_TLS_DIR": str(folder)}


@pytest.fixture
async def flying_rig(rig: Rig) -> Rig:
    rig.write_grant(grant())
    rig.start_service("--driver-grace", "15")
    rig.start_vehicle()
    return rig


def audit_codes(rig: Rig) -> list[str]:
    entries = [json.loads(line) for line in rig.audit.read_text().splitlines()]
    return [entry["code"] for entry in entries if entry.get("kind") == "takeover"]


def start_driver(
    rig: Rig, environment: dict[str, str], name: str, monkeypatch: pytest.MonkeyPatch, sleep_s: float
) -> None:
    program = rig.directory / "driver.py"
    program.write_text(HANGING)
    for variable, value in environment.items():
        monkeypatch.setenv(variable, value)
    rig.start(name, str(program), str(sleep_s))


async def test_driver_with_time_sleep_loses_control_and_drone_flies_home(
    flying_rig: Rig, environment: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    start_driver(flying_rig, environment, "hanging", monkeypatch, 60.0)
    await flying_rig.until_logged("hanging", "up", 60)
    begun = asyncio.get_running_loop().time()
    await flying_rig.until(lambda t: t.controller == "system", 20, "takeover")
    assert asyncio.get_running_loop().time() - begun < 10.0
    state = await flying_rig.until(lambda t: NAVIGATOR_MISSION in t.missions and not t.armed, 90, "landing")
    assert outcomes(state)[NAVIGATOR_MISSION] == "failed: the driver's program did not respond for 5 s"
    assert "DriverUnresponsive" in audit_codes(flying_rig)


@pytest.mark.parametrize("first", ["runs", "is suspended"])
async def test_second_driver_process_waits_for_the_first_one(
    first: str, flying_rig: Rig, environment: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    start_driver(flying_rig, environment, "first", monkeypatch, 3.0)
    await flying_rig.until_logged("first", "up", 60)
    if first == "is suspended":
        flying_rig.send_signal("first", signal.SIGSTOP)
    start_driver(flying_rig, environment, "second", monkeypatch, 0.0)
    if first == "is suspended":
        await flying_rig.until_logged("second", "control granted", 15)
    state = await flying_rig.until(lambda t: NAVIGATOR_MISSION in t.missions and not t.armed, 120, "landing")
    assert outcomes(state)[NAVIGATOR_MISSION] == "complete"
    assert ("control granted" in flying_rig.log("second")) is (first == "is suspended")
    if first == "runs":
        assert "another process of this component has the control stream" in flying_rig.log("second")


@pytest.fixture
async def kernel(environment: dict[str, str]) -> AsyncIterator[AsyncKernelClient]:
    manager, client = await start_new_async_kernel(kernel_name="python3", env={**os.environ, **environment})
    yield client
    client.stop_channels()
    await manager.shutdown_kernel(now=True)


async def execute(kernel: AsyncKernelClient, cell: str, timeout_s: float = 120.0) -> str:
    """Run a cell. Return what it prints, and its error."""
    text: list[str] = []

    def collect(message: dict[str, Any]) -> None:
        content = message["content"]
        if message["msg_type"] == "stream":
            text.append(content["text"])
        elif message["msg_type"] == "error":
            text.append(f"{content['ename']}: {content['evalue']}")

    await kernel.execute_interactive(textwrap.dedent(cell), output_hook=collect, timeout=timeout_s)
    return "".join(text)


async def test_notebook_flies_a_mission(flying_rig: Rig, kernel: AsyncKernelClient) -> None:
    for cell in NOTEBOOK:
        assert not await execute(kernel, cell)
    refused = await execute(kernel, "fractus.run(patrol)")
    assert refused == (
        "InvalidRequest: an event loop is running already, as in a notebook: use `await fractus.fly(program)`"
    )
    wrong = await execute(kernel, "await fractus.fly(lambda drone: None)")
    assert wrong.startswith("InvalidRequest: <lambda> cannot be called with drone and control")
    assert await execute(kernel, "await fractus.fly(patrol)") == "waypoints 2\n"
    state = await flying_rig.until(lambda t: NAVIGATOR_MISSION in t.missions and not t.armed, 90, "landing")
    assert outcomes(state)[NAVIGATOR_MISSION] == "complete"
    again = await execute(kernel, "await fractus.fly(patrol)")
    assert "for another flight, apply the application again, or give the Grant another uid" in again


TYPED = """
import asyncio
import fractus

async def patrol(drone: fractus.Mobility, control: fractus.Control) -> None:
    await drone.arm()
    up: fractus.Progress = await drone.takeoff(20, progress=lambda step: print(step.distance_m))
    if await drone.can_i.goto(1.0, 2.0, 3.0):
        async for step in drone.goto(1.0, 2.0, 3.0):
            print(step.distance_m, up.corrected)
    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(control.report(1))
    refused: dict[int, fractus.PolicyDenied] = await drone.mission(fractus.orbit(fractus.Position(1, 2, 3), 30))
    print(refused)

async def notebook() -> None:
    async with fractus.mobility() as drone:
        await fractus.fly(patrol, drone, response_timeout_s=10)

def synchronous() -> None:
    with fractus.sync.mobility() as drone, drone.control() as control:
        drone.takeoff(20)
        for point in control.remaining():
            drone.goto(point.lat, point.lon, point.alt)

fractus.run(patrol, strict=True)
"""
WRONG = """
import fractus

async def patrol(drone: fractus.Mobility, control: fractus.Control) -> None:
    drone.takeoff(20)  # E: unused-awaitable
    await drone.goto("1", 2.0, 3.0)  # E: arg-type
    await drone.take_off(20)  # E: attr-defined
    await drone.goto(1.0, 2.0)  # E: call-arg

def synchronous(drone: fractus.Mobility, control: fractus.Control) -> None:
    return None

fractus.run(synchronous)  # E: arg-type
"""


@pytest.mark.parametrize("source", [TYPED, WRONG], ids=["correct", "wrong"])
def test_mypy_strict_accepts_correct_programs_and_finds_errors_in_wrong_ones(source: str, tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(source)
    checked = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--enable-error-code", "unused-awaitable", "--config-file", os.devnull, str(program)],
        capture_output=True, text=True, check=False, cwd=tmp_path,
    )  # fmt: skip
    expected = [(n, line.partition("# E: ")[2]) for n, line in enumerate(source.split("\n"), 1) if "# E: " in line]
    errors = [line for line in checked.stdout.splitlines() if ": error: " in line]
    found = [(int(line.split(":")[1]), line.rpartition("[")[2].rstrip("]")) for line in errors]
    assert found == expected, checked.stdout

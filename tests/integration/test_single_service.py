"""Two processes of one service on a node: only one writes to the autopilot, the state and the audit log."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from fractus_runtime.audit_chain import verify
from fractus_services.mobility.mavlink.ardupilot import ARDUCOPTER
from mobility_rig import Driver, Rig, grant, passenger_grant
from test_camera import CAMERA, EDGE, capture, stub
from test_mobility_lost import until_mode


def opened(rig: Rig, name: str) -> set[str]:
    """Return the open files and sockets of a process."""
    targets = set()
    for entry in Path(f"/proc/{rig.pid(name)}/fd").iterdir():
        try:
            targets.add(str(entry.readlink()))
        except FileNotFoundError:
            continue
    return targets


def is_connected_to_autopilot(rig: Rig, name: str) -> bool:
    """Return True if a process has a connection to the vehicle."""
    port = f":{int(rig.link.rpartition(':')[2]):04X}"
    lines = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    return not opened(rig, name).isdisjoint(f"socket:[{line[9]}]" for line in lines if line[2].endswith(port))


def has_valid_chain(path: Path) -> bool:
    with path.open("rb") as log:
        return not verify(log).problem


async def start_flight(rig: Rig, speedup: float) -> None:
    rig.write_grant(grant())
    rig.start_service()
    rig.start_vehicle(speedup)
    await Driver(rig).up(4.0)


async def test_second_service_takes_over_drone_after_first_dies(rig: Rig) -> None:
    await start_flight(rig, speedup=1.0)
    assert is_connected_to_autopilot(rig, "service")
    rig.start_service("--driver-grace", "1", name="second")
    await rig.until_logged("second", f"mobility: waiting for {rig.directory / 'state' / 'mobility.lock'}, held by pid")
    assert f"held by pid {rig.pid('service')} on " in rig.log("second")
    assert not is_connected_to_autopilot(rig, "second")
    assert not any(path.startswith(str(rig.directory / "state")) for path in opened(rig, "second"))
    assert (await rig.telemetry()).in_air
    assert len(rig.entries("started")) == 1

    rig.kill("service")
    await rig.until(lambda t: t.armed and t.controller == "system", 20, "takeover by the second service")
    assert is_connected_to_autopilot(rig, "second")
    rig.kill("second", signal.SIGTERM)
    assert len(rig.entries("started")) == 2
    assert has_valid_chain(rig.audit)


async def test_second_service_exits_after_lock_timeout(rig: Rig) -> None:
    rig.start_service()
    await rig.until_logged("service", "mobility: serving")
    rig.start_service("--lock-timeout", "1", name="second")
    assert await rig.ended("second") == 1
    lines = rig.log("second").splitlines()
    assert lines[-1].startswith(
        f"Error: {rig.directory / 'state' / 'mobility.lock'} is still held by pid {rig.pid('service')} on "
    )
    assert lines[-1].endswith("end that process, and restart")
    assert "Traceback" not in rig.log("second")
    rig.start_service("--lock-timeout", "1", "--state", str(rig.directory / "other"), name="third")
    assert await rig.ended("third") == 1
    assert f"Error: {rig.audit}.lock is still held by pid {rig.pid('service')} on " in rig.log("third")
    rig.start_service(name="fourth")
    await rig.until_logged("fourth", "waiting for")
    rig.kill("fourth", signal.SIGTERM)
    assert rig.log("fourth").count("\n") == 1, "the waiting service did more than wait and exit"
    assert len(rig.entries("started")) == 1


def _replace_lock_file(rig: Rig) -> None:
    fresh = rig.directory / "fresh.lock"
    fresh.touch()
    fresh.replace(rig.directory / "state" / "mobility.lock")


def _move_state_directory(rig: Rig) -> None:
    (rig.directory / "state").rename(rig.directory / "another-mount")


# `make test` shows the other loss with test_process_ends_when_its_lock_file_is_lost.
@pytest.mark.parametrize("lose", [_replace_lock_file, pytest.param(_move_state_directory, marks=pytest.mark.slow)])
async def test_service_stops_sending_when_lock_is_lost(rig: Rig, lose: Callable[[Rig], None]) -> None:
    await start_flight(rig, speedup=2.0)
    entries = len(rig.entries())
    lose(rig)
    assert await rig.ended("service") == 1
    assert "mobility: lock lost" in rig.log("service")
    written = [entry["kind"] for entry in rig.entries()[entries:]]
    assert set(written) <= {"state"}, "after the loss of the lock, the service wrote other entries than states"
    await until_mode(rig.link, ARDUCOPTER.return_retracing)
    rig.start_service()
    await rig.until(lambda t: t.autopilot_connected, 20, "connection of the restarted service")
    rig.kill("service", signal.SIGTERM)
    assert has_valid_chain(rig.audit)


async def test_second_camera_service_waits_for_first(rig: Rig) -> None:
    rig.write_grant(passenger_grant(services=CAMERA, operationArea=[], **{"class": None}))
    first = rig.start_camera(description=EDGE)
    await capture(stub(rig, first), width=64, height=64)
    second = rig.start_camera(description=EDGE, name="second")
    await rig.until_logged("second", f"camera: waiting for {rig.directory / 'pictures' / 'camera.lock'}, held by pid")
    rig.kill("camera")
    taken = await capture(stub(rig, second), width=64, height=64)
    assert taken.image.name
    rig.kill("second", signal.SIGTERM)
    assert has_valid_chain(rig.directory / "camera.jsonl")
    third = rig.start_camera(description=EDGE, name="third")
    await capture(stub(rig, third), width=64, height=64)
    (rig.directory / "pictures" / "camera.lock").unlink()
    assert await rig.ended("third") == 1

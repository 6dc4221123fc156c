"""`fractus forward` beside a real flight: the ground station sees it, and what it commands comes to nothing."""

from __future__ import annotations

import asyncio
import signal
import socket
import time
from pathlib import Path

from fractus_cluster.ports import free_port
from fractus_runtime.mavlink_codec import Endpoint
from mobility_rig import Driver, Rig, grant
from pymavlink.dialects.v20 import ardupilotmega as mavlink

FORCE = 21196
"""Param 2 of MAV_CMD_COMPONENT_ARM_DISARM: also in flight."""


def heard(ground: socket.socket, parser: Endpoint, seconds: float) -> tuple[set[str], tuple[str, int] | None]:
    """Names of messages that come in for some time, and who sends them."""
    names, sender, end = set[str](), None, time.monotonic() + seconds
    ground.settimeout(0.2)
    while time.monotonic() < end:
        try:
            data, sender = ground.recvfrom(2048)
        except TimeoutError:
            continue
        names |= {message.name for message in parser.decode(data)}
    return names, sender


async def test_a_ground_station_sees_the_flight_and_cannot_end_it(tmp_path: Path) -> None:
    rig, ground = Rig(tmp_path), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    ground.bind(("127.0.0.1", 0))
    qgc = Endpoint(255, 190)
    killing = qgc.encode(
        "COMMAND_LONG",
        {
            "target_system": 1,
            "target_component": 1,
            "command": mavlink.MAV_CMD_COMPONENT_ARM_DISARM,
            "param1": 0,
            "param2": FORCE,
        },
    )
    direct = free_port()
    recordings = tmp_path / "recordings"
    recordings.mkdir(mode=0o700)
    try:
        rig.write_grant(grant())
        rig.start_service("--recordings", str(recordings))
        rig.start_vehicle(1.0, "--listen", f"tcp:127.0.0.1:{direct}")
        to = f"127.0.0.1:{ground.getsockname()[1]}"
        rig.start("forward", "-m", "fractus_cli", "forward", "--recordings", str(recordings), "--to", to)
        driver = Driver(rig)
        await driver.up(10.0)
        names, sender = await asyncio.to_thread(heard, ground, qgc, 10.0)
        assert {"HEARTBEAT", "GLOBAL_POSITION_INT", "ATTITUDE"} <= names
        assert sender is not None
        for _ in range(20):
            ground.sendto(killing, sender)
        names, _ = await asyncio.to_thread(heard, ground, qgc, 6.0)
        assert "COMMAND_ACK" not in names
        flying = await rig.until(lambda t: t.autopilot_connected, 30, "telemetry")
        assert flying.armed
        # The same command has its effect where there is a way to the vehicle.
        with socket.create_connection(("127.0.0.1", direct), 5) as way:
            way.sendall(killing)
            await rig.until(lambda t: not t.armed, 60, "motors stopped")
        rig.tell("forward", signal.SIGINT)
        assert await rig.ended("forward") == 130
    finally:
        ground.close()
        await rig.close()

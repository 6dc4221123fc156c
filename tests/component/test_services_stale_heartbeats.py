"""Delayed heartbeats that were sent before arming and arrive in flight.

Heartbeats have no timestamp. A delayed heartbeat must not end the control authority.
"""

from __future__ import annotations

import asyncio
import math
from pathlib import Path
from typing import Any

import pytest
from closed_loop import Sky
from fractus_core.control import StreamState
from fractus_core.policy.decision_types import TakeoffArgs
from fractus_runtime.mavlink_codec import Parser
from mobility_world import end, goto
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sky_drone import fly, ready, until


def test_stale_disarmed_heartbeats_in_flight_do_not_end_control(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        async with ready(sky, directory) as (drone, grant):
            (wire,) = sky.wires
            deliver = wire._protocol.data_received
            parser = Parser()
            stale_frames = []

            def keep(data: Any) -> None:
                stale_frames.extend(
                    m.frame for m in parser.feed(bytes(data)) if m.name == "HEARTBEAT" and not sky.truth.armed
                )
                deliver(data)

            monkeypatch.setattr(wire._protocol, "data_received", keep)
            await until(lambda: len(stale_frames) >= 3)
            await drone.service.arm(grant, 120.0)
            climb = asyncio.ensure_future(end(drone.service.take_off(grant, TakeoffArgs(15.0))))
            await asyncio.sleep(0.5)
            assert not drone.autopilot.vehicle.in_air
            deliver(b"".join(stale_frames[:3]))
            await climb
            for _ in range(3):
                deliver(b"".join(stale_frames[:3]))
                await asyncio.sleep(2.5)
            assert drone.state is StreamState.GRANTED
            await end(drone.service.goto(grant, goto(20, 0, 15), 0.0))
            assert drone.state is StreamState.GRANTED
            await end(drone.service.land(grant))
            await until(lambda: not sky.truth.armed)
            await until(lambda: not drone.autopilot.vehicle.armed, 3.0)

    fly(work, tmp_path)


def test_disarm_in_flight_is_detected(tmp_path: Path) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        async with ready(sky, directory) as (drone, grant):
            await drone.service.arm(grant, 120.0)
            await end(drone.service.take_off(grant, TakeoffArgs(15.0)))
            sky.truth.armed = False
            await until(lambda: not drone.autopilot.vehicle.armed, 3.0)
            assert sky.truth.mode == mavlink.COPTER_MODE_GUIDED

    fly(work, tmp_path)


def test_landing_during_link_outage_is_not_reported_as_found_in_air(tmp_path: Path) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        async with ready(sky, directory) as (drone, grant):
            await drone.service.arm(grant, 120.0)
            await end(drone.service.take_off(grant, TakeoffArgs(15.0)))
            sky.severed_at = sky.time()
            await until(lambda: not sky.truth.armed)
            assert drone.autopilot.vehicle.in_air
            sky.severed_at = math.inf
            await until(lambda: drone.autopilot.connected)
            assert not drone.autopilot.vehicle.armed
            assert not any("found the drone in the air" in event for event in drone._account.events)

    fly(work, tmp_path)


def test_landing_during_connection_loss_is_not_reported_as_found_in_air(tmp_path: Path) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        async with ready(sky, directory) as (drone, grant):
            await drone.service.arm(grant, 120.0)
            await end(drone.service.take_off(grant, TakeoffArgs(15.0)))
            landing = asyncio.ensure_future(end(drone.service.land(grant)))
            await until(lambda: not sky.truth.armed)
            assert drone.autopilot.vehicle.armed
            (wire,) = sky.wires
            wire._protocol.connection_lost(None)
            await until(lambda: drone.autopilot._broken.is_set() or sky.wires != [wire])
            await until(lambda: drone.autopilot.connected and sky.wires != [wire], 10.0)
            assert not drone.autopilot.vehicle.armed
            assert not any("found the drone in the air" in event for event in drone._account.events)
            await asyncio.gather(landing, return_exceptions=True)

    fly(work, tmp_path)

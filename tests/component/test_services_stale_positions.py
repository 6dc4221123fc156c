"""A delayed position report from home that arrives in flight must not let the drone land."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path
from typing import Any

import pytest
from closed_loop import Sky
from fractus_core.policy.decision_types import TakeoffArgs
from fractus_runtime.mavlink_codec import Parser
from mobility_world import FRAME, end, goto
from sky_drone import fly, ready, until


def test_stale_home_position_does_not_land_returning_drone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        def away_m() -> float:
            place = sky.truth.true_place
            return math.hypot(*FRAME.xy(place.lat_e7 / 1e7, place.lon_e7 / 1e7))

        async with ready(sky, directory) as (drone, grant):
            (wire,) = sky.wires
            deliver = wire._protocol.data_received
            parser = Parser()
            stale_frames = []

            def keep(data: Any) -> None:
                stale_frames.extend(m.frame for m in parser.feed(bytes(data)) if m.name == "GLOBAL_POSITION_INT")
                deliver(data)

            await drone.service.arm(grant, 120.0)
            await end(drone.service.take_off(grant, TakeoffArgs(15.0)))
            monkeypatch.setattr(wire._protocol, "data_received", keep)
            await until(lambda: stale_frames)
            await end(drone.service.goto(grant, goto(0, 60, 15), 0.0))
            deliver(stale_frames[0])
            assert drone.autopilot.vehicle.distance_m(*FRAME.latlon(0, 0)) > 50.0
            await drone.control.return_control(grant)
            for _ in range(50):
                deliver(stale_frames[0])
                await asyncio.sleep(0.02)
            await until(lambda: not sky.truth.armed)
            assert away_m() < 3.0

    fly(work, tmp_path)

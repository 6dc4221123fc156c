"""Failsafes whose action is BRAKE. The drone then hovers without a pilot, so the system returns it home."""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path

from closed_loop import Sky
from fractus_core.control import StreamState
from fractus_core.policy.decision_types import TakeoffArgs, VelocityArgs
from fractus_services.errors import AutopilotError, Refused
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sky_drone import fly, ready, until


def test_drone_returns_home_after_radio_failsafe_brakes(tmp_path: Path) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        async with ready(sky, directory) as (drone, grant):
            await drone.service.arm(grant, 120.0)
            async for _ in drone.service.take_off(grant, TakeoffArgs(15.0)):
                pass
            modes: set[int] = set()
            sky.witnesses.append(lambda: modes.add(sky.truth.mode))
            sky.truth.params.set("SIM_RC_FAIL", 1.0)
            await until(lambda: drone.state is StreamState.LOST)
            await until(lambda: not sky.truth.armed)
            assert mavlink.COPTER_MODE_BRAKE in modes
            assert "failsafe" in str(drone.control.state.missions["m1"].outcome)

    # Value 7 of FS_THR_ENABLE: BRAKE, or LAND if BRAKE is not possible.
    fly(work, tmp_path, {"FS_THR_ENABLE": 7.0})


def test_drone_returns_home_after_owner_fence_brakes(tmp_path: Path) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        async with ready(sky, directory) as (drone, grant):
            await drone.service.arm(grant, 120.0)
            async for _ in drone.service.take_off(grant, TakeoffArgs(15.0)):
                pass
            with contextlib.suppress(Refused, AutopilotError):
                while drone.state is StreamState.GRANTED:
                    await drone.service.set_velocity(grant, VelocityArgs(6.0, 0.0, 0.0, None, 1.0))
                    await asyncio.sleep(0.5)
            await until(lambda: not sky.truth.armed)
            assert abs(sky.truth.body.north) < 3.0

    owners = {"FENCE_ENABLE": 1.0, "FENCE_TYPE": 2.0, "FENCE_RADIUS": 40.0, "FENCE_ACTION": 4.0, "AVOID_ENABLE": 0.0}
    fly(work, tmp_path, owners)

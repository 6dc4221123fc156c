"""Faults of a second GPS, compass, barometer and EKF lane in flight: the drone stops at once and ends its flight as documented."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path

import pytest
from closed_loop import Sky
from fractus_core.policy.decision_types import TakeoffArgs
from fractus_services.errors import AutopilotError, Refused
from fractus_services.mobility.rpc.telemetry import located
from mobility_world import end, goto
from sky_drone import fly, ready, until

GLITCH_DEG = 0.0003
TWO = {"GPS2_TYPE": 1.0, "SIM_GPS2_DISABLE": 0.0}


@pytest.mark.parametrize(
    ("name", "value", "reason", "within_s"),
    [
        ("SIM_GPS2_GLTCH_X", GLITCH_DEG, "GPS2_RAW", 2.0),
        ("SIM_MAG1_OFS_X", 400.0, "compass", 2.5),
        ("SIM_BARO_GLITCH", 20.0, "altitude", 1.5),
        ("SIM_ACC_FAIL_MSK", 1.0, "another estimator", 0.8),
    ],
)
def test_drone_stops_when_sensor_fails(tmp_path: Path, name: str, value: float, reason: str, within_s: float) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        async with ready(sky, directory) as (drone, grant):
            await drone.service.arm(grant, 120.0)
            await end(drone.service.take_off(grant, TakeoffArgs(15.0)))

            async def leave() -> None:
                with pytest.raises((AutopilotError, Refused)):
                    await end(drone.service.goto(grant, goto(150.0, 0.0, 15.0), 0.0))

            leg = asyncio.ensure_future(leave())
            await asyncio.sleep(4.0)
            assert located(drone.control)
            sky.truth.params.assign(name, value)
            await until(lambda: not located(drone.control), within_s)
            assert reason in drone.autopilot.vehicle.position_problem
            await until(lambda: math.hypot(sky.truth.body.vn, sky.truth.body.ve) < 0.5, 6.0)
            await leg

    fly(work, tmp_path, TWO)


def test_drone_lands_where_it_is_if_altitude_jumps(tmp_path: Path) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        async with ready(sky, directory) as (drone, grant):
            await drone.service.arm(grant, 120.0)
            await end(drone.service.take_off(grant, TakeoffArgs(20.0)))
            await end(drone.service.goto(grant, goto(30.0, 0.0, 20.0), 0.0))
            heights_m: list[float] = []
            sky.witnesses.append(lambda: heights_m.append(-sky.truth.body.down))
            sky.truth.params.assign("SIM_BARO_GLITCH", -20.0)
            await asyncio.sleep(55.0)
            assert heights_m[-1] > 18.0
            assert max(heights_m) < 22.0, "the autopilot would climb by 20 m to its altitude"
            await until(lambda: not sky.truth.armed, 120.0)
            assert max(heights_m) < 22.0
            assert sky.truth.body.east == pytest.approx(30.0, abs=2.0)

    fly(work, tmp_path)

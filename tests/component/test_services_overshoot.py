"""Limits of speed and altitude, which the simulated vehicle keeps although it overshoots its commands."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path
from typing import Any

import pytest
from closed_loop import Sky, Weather
from fractus_core.policy import limits
from fractus_core.policy.decision_types import TakeoffArgs, VelocityArgs
from mobility_world import goto, spec
from sky_drone import fly, ready

SPEED_MPS = 7.7
HEIGHT_M = 15.0
HEADWIND = Weather(uplink_s=0.02, downlink_s=0.02, wind_mps=6.0)


def limit(kind: str, upper: float) -> dict[str, Any]:
    return {"name": kind, "spec": {"type": "LimitControl", "kind": kind, "upperLimit": upper}}


def peaks(directory: Path) -> tuple[float, float]:
    """Request the limits themselves, and return the highest true speed and height."""
    speeds_mps = [0.0]
    heights_m = [0.0]

    async def work(sky: Sky, state: Path) -> None:
        async with ready(sky, state) as (drone, _):
            grant = drone.grants.put(spec(limit("speed", SPEED_MPS), limit("altitude", HEIGHT_M)))
            await drone.service.arm(grant, 120.0)
            body = sky.truth.body
            sky.witnesses.append(lambda: speeds_mps.append(math.hypot(body.vn, body.ve)))
            sky.witnesses.append(lambda: heights_m.append(-body.down))
            async for _ in drone.service.take_off(grant, TakeoffArgs(HEIGHT_M)):
                pass
            async for progress in drone.service.goto(grant, goto(0.0, 80.0, HEIGHT_M, speed_mps=SPEED_MPS), 0.0):
                assert progress.verdict.action == "allow"

    fly(work, directory, None, HEADWIND)
    return max(speeds_mps), max(heights_m)


def test_drone_keeps_limits_although_it_overshoots(tmp_path: Path) -> None:
    speed_mps, height_m = peaks(tmp_path)
    assert 0.93 * SPEED_MPS < speed_mps <= SPEED_MPS
    assert HEIGHT_M - 0.3 < height_m <= HEIGHT_M + 0.02


def test_drone_exceeds_limits_without_distance_from_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "commanded_value", lambda value, bounds: min(value, limits._highest(bounds)))
    speed_mps, height_m = peaks(tmp_path)
    assert speed_mps > SPEED_MPS + 0.1
    assert height_m > HEIGHT_M + 0.05


@pytest.mark.parametrize("limit_mps", [2.8, 5.0])
def test_drone_keeps_low_speed_limit_when_it_turns_with_the_wind_and_climbs(tmp_path: Path, limit_mps: float) -> None:
    speeds_mps = [0.0]

    async def work(sky: Sky, state: Path) -> None:
        async with ready(sky, state) as (drone, _):
            grant = drone.grants.put(spec(limit("speed", limit_mps)))
            await drone.service.arm(grant, 120.0)
            body = sky.truth.body
            async for _ in drone.service.take_off(grant, TakeoffArgs(HEIGHT_M)):
                pass
            sky.witnesses.append(lambda: speeds_mps.append(math.hypot(body.vn, body.ve)))
            for _ in range(20):
                await drone.service.set_velocity(grant, VelocityArgs(-limit_mps, 0.0))
                await asyncio.sleep(0.5)
            async for _ in drone.service.goto(grant, goto(0.0, 20.0, HEIGHT_M + 7.0, speed_mps=limit_mps), 0.0):
                pass

    fly(work, tmp_path, None, HEADWIND)
    assert 0.8 * limit_mps < max(speeds_mps) <= limit_mps

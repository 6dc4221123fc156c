"""A pilot changes the mode during a mode change by the system. The system must not overrule the pilot."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest
from closed_loop import Sky, Wire
from fractus_core.control import Authority
from fractus_core.policy.decision_types import TakeoffArgs
from fractus_runtime.mavlink_codec import Parser
from mobility_world import end, goto, spec
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sky_drone import fly, ready, until


def lose_mode_changes(wire: Wire, count: int, monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Drop the first `count` mode commands of the companion. Return a list of the send times of all mode commands."""
    write = wire.write
    parser = Parser()
    sent_at = []

    def noted(data: Any) -> None:
        for sent in parser.feed(bytes(data)):
            if sent.name == "COMMAND_LONG" and sent.integer("command") == mavlink.MAV_CMD_DO_SET_MODE:
                sent_at.append(asyncio.get_running_loop().time())
                if len(sent_at) <= count:
                    return
        write(data)

    monkeypatch.setattr(wire, "write", noted)
    return sent_at


@pytest.mark.parametrize("after_s", [0.1, 0.5, 1.0])
def test_pilot_keeps_control_when_taking_over_during_system_mode_change(
    after_s: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first mode commands of the system are lost.

    Their retries must not replace the mode that the pilot has chosen in the meantime.
    """

    async def work(sky: Sky, directory: Path) -> None:
        async with ready(sky, directory) as (drone, grant):
            await drone.service.arm(grant, 120.0)
            await end(drone.service.take_off(grant, TakeoffArgs(15.0)))
            await end(drone.service.goto(grant, goto(0, 40, 15), 0.0))
            sent_at = lose_mode_changes(sky.wires[0], 3, monkeypatch)
            await drone.control.return_control(grant)
            await until(lambda: sent_at)
            await asyncio.sleep(after_s)
            assert sky.truth.mode == mavlink.COPTER_MODE_GUIDED
            assert sky.craft.vehicle.modes.change(mavlink.COPTER_MODE_LOITER)
            await until(lambda: drone.control.authority is Authority.PILOT, 2.0)
            await asyncio.sleep(10.0)
            assert sky.truth.mode == mavlink.COPTER_MODE_LOITER
            assert drone.control.authority is Authority.PILOT

    fly(work, tmp_path)


def test_drone_handed_back_just_after_touchdown_does_not_climb_to_a_lower_limit(tmp_path: Path) -> None:
    """The autopilot has not detected the landing yet, so the drone still counts as flying below the limit."""

    async def work(sky: Sky, directory: Path) -> None:
        async with ready(sky, directory) as (drone, _):
            floor = {"type": "LimitControl", "kind": "altitude", "lowerLimit": 5.0}
            grant = drone.grants.put(spec({"name": "floor", "spec": floor, "zones": []}))
            await drone.service.arm(grant, 120.0)
            await end(drone.service.take_off(grant, TakeoffArgs(10.0)))
            assert sky.craft.vehicle.modes.change(mavlink.COPTER_MODE_LAND)
            await until(lambda: drone.control.authority is Authority.PILOT, 2.0)
            await until(lambda: sky.truth.touch_time_s >= 0.5)
            vehicle = drone.control.autopilot.vehicle
            assert vehicle.in_air
            assert sky.craft.vehicle.modes.change(mavlink.COPTER_MODE_GUIDED)
            await until(lambda: drone.control.authority is Authority.SYSTEM, 2.0)
            highest_m = 0.0
            for _ in range(100):
                await asyncio.sleep(0.1)
                highest_m = max(highest_m, vehicle.altitude_m)
            assert highest_m < 1.0

    fly(work, tmp_path)

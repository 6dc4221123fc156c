"""The vehicle fence is switched off by a command or a radio switch. No parameter changes in either case."""

from __future__ import annotations

import asyncio
from pathlib import Path

from closed_loop import Sky
from fractus_core.policy.decision_types import TakeoffArgs
from fractus_runtime.mavlink_codec import Endpoint
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sky_drone import fly, ready, until

FENCE_SWITCH = 11.0
OFF = 0.0


def test_vehicle_fence_is_switched_on_again_in_flight_and_before_next_arming(tmp_path: Path) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        station = Endpoint(255, mavlink.MAV_COMP_ID_MISSIONPLANNER)

        def switch_off(command: int, *params: float) -> None:
            values: dict[str, float] = {f"param{i}": value for i, value in enumerate(params, 1)}
            values |= {"target_system": 1, "target_component": 1, "command": command}
            sky.craft.receive(sky.wires[0]._channel, station.encode("COMMAND_LONG", values))
            assert not sky.truth.fence.enabled
            assert sky.truth.params["FENCE_ENABLE"] == 1.0

        async with ready(sky, directory) as (drone, grant):
            await drone.service.arm(grant, 120.0)
            async for _ in drone.service.take_off(grant, TakeoffArgs(15.0)):
                pass
            switch_off(mavlink.MAV_CMD_DO_FENCE_ENABLE, OFF)
            await until(lambda: sky.truth.fence.enabled, timeout_s=20.0)
            await until(lambda: any("SettingChanged" in event for event in drone._account.events))
            landing = drone.service.land(grant)
            async for _ in landing:
                if sky.truth.mode == mavlink.COPTER_MODE_LAND and sky.truth.fence.enabled:
                    switch_off(mavlink.MAV_CMD_DO_FENCE_ENABLE, OFF)
            assert not sky.truth.fence.enabled, "the autopilot may switch off the fence before a landing"
            switch_off(mavlink.MAV_CMD_DO_AUX_FUNCTION, FENCE_SWITCH, OFF)
            await asyncio.sleep(2.0)
            await drone.service.arm(grant, 120.0)
            assert sky.truth.armed
            assert sky.truth.fence.enabled

    fly(work, tmp_path)

"""What the service does about an autopilot that restarts, or that another station tells what to send, on a link that does not break."""

from __future__ import annotations

import asyncio
from pathlib import Path

from closed_loop import Sky
from fractus_core.control import StreamState
from fractus_core.policy.values import TakeoffArgs
from fractus_mavlink import Endpoint
from fractus_mavlink.enums import COPTER_MODE, MAV_COMPONENT, MAV_DATA_STREAM
from mobility_world import end, goto
from sky_drone import fly, ready, until

STATION = 255


def test_an_autopilot_that_restarts_is_prepared_again(tmp_path: Path) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        async with ready(sky, directory) as (drone, grant):
            await until(lambda: sky.simulation.time_s > 20.0)
            # As a station does that resets all parameters: no message tells.
            sky.truth.params.set("SYSID_MYGCS", 255.0)
            sky.truth.params.set("FS_GCS_ENABLE", 0.0)
            before = sky.craft.vehicle
            before.reboot_wanted = True
            await until(lambda: sky.craft.vehicle is not before)
            await until(lambda: drone.autopilot.vehicle.unready(drone.autopilot.now))
            await drone.service.arm(grant, 120.0)
            assert sky.truth.armed
            assert sky.truth.params["SYSID_MYGCS"] == 244.0
            assert sky.truth.params["FS_GCS_ENABLE"] in {1.0, 3.0}

    fly(work, tmp_path)


def test_streams_that_another_station_stopped_come_again(tmp_path: Path) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        async with ready(sky, directory) as (drone, grant):
            await drone.service.arm(grant, 120.0)
            await end(drone.service.take_off(grant, TakeoffArgs(15.0)))
            frame = Endpoint(STATION, MAV_COMPONENT.MISSIONPLANNER).encode(
                "REQUEST_DATA_STREAM",
                {
                    "target_system": 1, "target_component": 1, "req_stream_id": MAV_DATA_STREAM.ALL,
                    "req_message_rate": 0, "start_stop": 0,
                },
            )  # fmt: skip
            for wire in sky.wires:
                sky.craft.receive(wire._channel, frame)
            await asyncio.sleep(10.0)
            await end(drone.service.goto(grant, goto(20, 0, 15), 0.0))
            assert drone.state is StreamState.GRANTED
            assert sky.truth.mode is COPTER_MODE.GUIDED

    fly(work, tmp_path)

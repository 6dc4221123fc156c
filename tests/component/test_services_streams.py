"""Events on an intact link: the autopilot reboots, or another station stops its telemetry streams."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest
from closed_loop import Sky
from fractus_core.control import StreamState
from fractus_core.policy.decision_types import TakeoffArgs
from fractus_runtime.mavlink_codec import Endpoint, Parser, message_id
from fractus_services.mobility.mavlink.companion import SYSTEM_ID
from mobility_world import end, goto
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sky_drone import fly, ready, until

STATION = 255


def test_rebooted_autopilot_gets_failsafes_again_before_arming(tmp_path: Path) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        async with ready(sky, directory) as (drone, grant):
            await until(lambda: sky.simulation.time_s > 20.0)
            # Another station resets the parameters without any message to the service.
            sky.truth.params.set("SYSID_MYGCS", 255.0)
            sky.truth.params.set("FS_GCS_ENABLE", 0.0)
            before = sky.craft.vehicle
            before.reboot_requested = True
            await until(lambda: sky.craft.vehicle is not before)
            await until(lambda: drone.autopilot.vehicle.arming_refusal(drone.autopilot.now))
            await drone.service.arm(grant, 120.0)
            assert sky.truth.armed
            assert sky.truth.params["SYSID_MYGCS"] == 244.0
            assert sky.truth.params["FS_GCS_ENABLE"] in {1.0, 3.0}

    fly(work, tmp_path)


def test_telemetry_streams_stopped_by_another_station_are_requested_again(tmp_path: Path) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        async with ready(sky, directory) as (drone, grant):
            await drone.service.arm(grant, 120.0)
            await end(drone.service.take_off(grant, TakeoffArgs(15.0)))
            frame = Endpoint(STATION, mavlink.MAV_COMP_ID_MISSIONPLANNER).encode(
                "REQUEST_DATA_STREAM",
                {
                    "target_system": 1, "target_component": 1, "req_stream_id": mavlink.MAV_DATA_STREAM_ALL,
                    "req_message_rate": 0, "start_stop": 0,
                },
            )  # fmt: skip
            for wire in sky.wires:
                sky.craft.receive(wire._channel, frame)
            await asyncio.sleep(10.0)
            await end(drone.service.goto(grant, goto(20, 0, 15), 0.0))
            assert drone.state is StreamState.GRANTED
            assert sky.truth.mode == mavlink.COPTER_MODE_GUIDED

    fly(work, tmp_path)


@pytest.mark.parametrize("kind", ["SYS_STATUS", "GLOBAL_POSITION_INT"])
def test_lost_stream_request_is_repeated_despite_duplicate_acknowledgement(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        connect = sky.create_connection
        requested_id = float(message_id(kind))
        dropped = []
        answer = {
            "command": mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
            "result": mavlink.MAV_RESULT_ACCEPTED,
            "target_system": SYSTEM_ID,
        }
        twice = Endpoint(1, mavlink.MAV_COMP_ID_AUTOPILOT1).encode("COMMAND_ACK", answer)

        async def create_connection(*args: Any, **kwargs: Any) -> Any:
            wire, protocol = await connect(*args, **kwargs)
            write = wire.write
            parser = Parser()

            def lose_the_first(data: Any) -> None:
                for sent in parser.feed(bytes(data)):
                    is_request = (
                        sent.name == "COMMAND_LONG" and sent.integer("command") == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
                    )
                    if is_request and sent.real("param1") == requested_id and not dropped:
                        dropped.append(sent)
                        sky.call_later(0.01, protocol.data_received, twice)
                    else:
                        write(sent.frame)

            wire.write = lose_the_first
            return wire, protocol

        monkeypatch.setattr(sky, "create_connection", create_connection)
        async with ready(sky, directory) as (drone, grant):
            await drone.service.arm(grant, 60.0)
            assert dropped
            assert sky.truth.armed

    fly(work, tmp_path)

"""Foreign MAVLink components on the link of the drone are not mistaken for its autopilot."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest
from closed_loop import Account, Drone, Sky, Wire
from fractus_core.control import StreamState
from fractus_core.policy.decision_types import TakeoffArgs
from fractus_runtime.mavlink_codec import Endpoint, Parser
from fractus_services.errors import Refused
from fractus_services.mobility.mavlink.vehicle_identification import CONFIRM_AFTER_S, KnownVehicleFile
from mobility_world import end, goto
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sky_drone import fly, ready, until


def heartbeat(sysid: int, compid: int, kind: int, autopilot: int, **more: int) -> bytes:
    values = {
        "type": kind,
        "autopilot": autopilot,
        "system_status": mavlink.MAV_STATE_STANDBY,
        "mavlink_version": 3,
        **more,
    }
    return Endpoint(sysid, compid).encode("HEARTBEAT", values)


GIMBAL = heartbeat(1, mavlink.MAV_COMP_ID_GIMBAL, mavlink.MAV_TYPE_GIMBAL, mavlink.MAV_AUTOPILOT_GENERIC)
TRACKER = heartbeat(
    9, mavlink.MAV_COMP_ID_AUTOPILOT1, mavlink.MAV_TYPE_ANTENNA_TRACKER, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
)
OTHER = heartbeat(2, mavlink.MAV_COMP_ID_AUTOPILOT1, mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA)

FLYING = heartbeat(
    2, mavlink.MAV_COMP_ID_AUTOPILOT1, mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
    base_mode=mavlink.MAV_MODE_FLAG_SAFETY_ARMED | mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, custom_mode=mavlink.COPTER_MODE_GUIDED,
)  # fmt: skip


def deliver_first(sky: Sky, *frames: bytes) -> None:
    """Deliver the given frames at the beginning of each new connection, before all others."""
    connect = sky.create_connection

    async def create_connection(*args: Any, **kwargs: Any) -> Any:
        wire, protocol = await connect(*args, **kwargs)
        sky.call_soon(protocol.data_received, b"".join(frames))
        return wire, protocol

    sky.create_connection = create_connection  # type: ignore[method-assign]


@pytest.mark.parametrize("stranger", [GIMBAL, TRACKER, OTHER], ids=["gimbal", "tracker", "other"])
def test_reconnected_link_ignores_heartbeats_of_foreign_components_in_flight(stranger: bytes, tmp_path: Path) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        async with ready(sky, directory) as (drone, grant):
            await drone.service.arm(grant, 120.0)
            await end(drone.service.take_off(grant, TakeoffArgs(15.0)))
            deliver_first(sky, stranger)
            (wire,) = sky.wires
            wire._protocol.connection_lost(None)
            await until(lambda: drone.autopilot._broken.is_set() or sky.wires != [wire])
            await until(lambda: drone.autopilot.connected and sky.wires != [wire])
            assert drone.autopilot.target == (1, 1)
            assert drone.autopilot.vehicle.armed
            await asyncio.sleep(5.0)
            await end(drone.service.goto(grant, goto(20, 0, 15), 0.0))
            assert drone.state is StreamState.GRANTED
            assert sky.truth.mode == mavlink.COPTER_MODE_GUIDED

    fly(work, tmp_path)


def test_arming_is_refused_while_two_vehicles_are_on_the_link(tmp_path: Path) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        async with ready(sky, directory) as (drone, grant):
            assert not drone.autopilot.vehicle.arming_refusal(drone.autopilot.now)

            async def speak(wire: Wire) -> None:
                while True:
                    wire._protocol.data_received(OTHER + GIMBAL + TRACKER)
                    await asyncio.sleep(1.0)

            speaking = asyncio.ensure_future(speak(sky.wires[0]))
            await until(lambda: drone.autopilot.vehicle.identity_problem)
            with pytest.raises(Refused, match=r"other vehicles are on its link \(MAVLink systems 2\)"):
                await drone.service.arm(grant)
            assert not sky.truth.armed
            speaking.cancel()
            await drone.service.arm(grant, 120.0)
            assert sky.truth.armed

    fly(work, tmp_path)


def test_command_is_resent_if_acknowledgement_belongs_to_another_station(tmp_path: Path) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        async with ready(sky, directory) as (drone, _):
            (wire,) = sky.wires
            write = wire.write
            parser = Parser()
            arrived = []
            foreign = {
                "target_system": 1,
                "target_component": 1,
                "command": mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
                "param1": 147.0,
            }
            station = Endpoint(255, mavlink.MAV_COMP_ID_MISSIONPLANNER).encode(
                "COMMAND_LONG", foreign | {"param2": 1e6}
            )

            def lose_the_first(data: Any) -> None:
                for sent in parser.feed(bytes(data)):
                    if sent.name == "COMMAND_LONG" and sent.integer("command") == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                        if not arrived:
                            write(station)
                        arrived.append(sent.real("param2"))
                        if len(arrived) == 1:
                            return
                write(data)

            wire.write = lose_the_first  # type: ignore[method-assign]
            await drone.autopilot.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 147.0, 2e6)
            assert arrived == [2e6, 2e6]

    fly(work, tmp_path)


def messages_to(sky: Sky, system: int) -> list[str]:
    """Record the messages that are sent to a MAVLink system from now on. Return the growing list of their names."""
    names: list[str] = []
    connect = sky.create_connection

    async def create_connection(*args: Any, **kwargs: Any) -> Any:
        wire, protocol = await connect(*args, **kwargs)
        write = wire.write
        parser = Parser()

        def noted(data: Any) -> None:
            names.extend(sent.name for sent in parser.feed(bytes(data)) if sent.values.get("target_system") == system)
            write(data)

        wire.write = noted
        return wire, protocol

    sky.create_connection = create_connection  # type: ignore[method-assign]
    return names


@pytest.mark.parametrize("stranger", [OTHER, FLYING], ids=["standing", "flying"])
def test_restarted_service_selects_known_vehicle_and_sends_nothing_to_foreign_vehicle(
    stranger: bytes, tmp_path: Path
) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        turning = asyncio.ensure_future(sky.run_vehicle())

        def started() -> Drone:
            return Drone(
                directory, Account(0), known_vehicle=KnownVehicleFile(directory / "vehicle.json", "tcp:vehicle:1")
            )

        first = started()
        await until(lambda: first.autopilot.connected)
        await asyncio.sleep(CONFIRM_AFTER_S + 2.0)
        await first.close()
        for wire in sky.wires:
            wire.close()
        deliver_first(sky, stranger)
        sent_names = messages_to(sky, 2)
        restarted = started()
        await until(lambda: restarted.autopilot.connected)
        assert restarted.autopilot.target == (1, 1)
        await asyncio.sleep(5.0)
        assert not sent_names
        await restarted.close()
        turning.cancel()

    fly(work, tmp_path)


def test_unknown_armed_vehicle_receives_no_commands(tmp_path: Path) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        sky.craft.receive = lambda *_: None  # type: ignore[method-assign]
        sent_names = messages_to(sky, 2)
        drone = Drone(
            directory, Account(0), known_vehicle=KnownVehicleFile(directory / "vehicle.json", "tcp:vehicle:1")
        )
        for _ in range(20):
            for wire in sky.wires:
                wire._protocol.data_received(FLYING)
            await asyncio.sleep(1.0)
        assert not sent_names
        assert not drone.autopilot.found
        assert "unknown vehicle is armed (MAVLink system 2)" in drone.control.arming_problem
        await drone.close()

    fly(work, tmp_path)

"""Arming by another station while a driver waits.

The flight was not prepared for a driver, so the pilot gets control authority.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from pathlib import Path

import pytest
import virtual_time
from closed_loop import Sky
from fractus_core.control import Authority, StreamState
from fractus_core.control.state import FlightMode
from fractus_core.policy.decision_types import TakeoffArgs
from fractus_runtime.mavlink_codec import Endpoint
from fractus_services.errors import AutopilotError, Refused
from fractus_services.mobility.mavlink.ardupilot import ARDUCOPTER
from mobility_world import GUIDED, RTL, World, spec
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sky_drone import fly, ready, until


@pytest.mark.parametrize("mode", [mavlink.COPTER_MODE_LOITER, mavlink.COPTER_MODE_GUIDED])
def test_drone_armed_by_another_station_belongs_to_pilot(mode: int, tmp_path: Path) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        station = Endpoint(255, mavlink.MAV_COMP_ID_MISSIONPLANNER)

        def send(command: int, *params: float) -> None:
            values = {f"param{i}": value for i, value in enumerate(params, 1)}
            values |= {"target_system": 1, "target_component": 1, "command": command}
            sky.craft.receive(sky.wires[0]._channel, station.encode("COMMAND_LONG", values))

        async with ready(sky, directory) as (drone, grant):
            send(mavlink.MAV_CMD_DO_SET_MODE, mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, mode)
            await until(lambda: drone.autopilot.vehicle.mode == ARDUCOPTER.mode(mode))
            send(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
            await until(lambda: drone.autopilot.vehicle.armed)
            await until(lambda: drone.state is StreamState.LOST)
            assert drone.control.authority is Authority.PILOT
            with pytest.raises(Refused):
                async for _ in drone.service.take_off(grant, TakeoffArgs(15.0)):
                    pass
            with pytest.raises(Refused):
                await drone.service.arm(grant)
            await asyncio.sleep(2.0)
            assert sky.truth.mode == mode
            assert sky.truth.body.down > -0.5

    fly(work, tmp_path)


def test_driver_keeps_control_if_link_breaks_before_arming_is_confirmed(tmp_path: Path) -> None:
    """The link breaks at the moment of arming. The first heartbeat of the armed drone arrives seconds later."""

    async def work(sky: Sky, directory: Path) -> None:
        async with ready(sky, directory) as (drone, grant):

            def cut() -> None:
                if sky.truth.armed and not cuts:
                    cuts.append(sky.time())
                    sky.severed_at = sky.time()
                    sky.call_later(3.5, repair)

            def repair() -> None:
                sky.severed_at = math.inf

            cuts: list[float] = []
            sky.witnesses.append(cut)
            arming = asyncio.ensure_future(drone.service.arm(grant, 0.0))
            await until(lambda: arming.done() or (cuts and not sky.severed and drone.autopilot.vehicle.armed))
            with contextlib.suppress(AutopilotError, Refused):
                await arming
            await until(lambda: drone.autopilot.vehicle.armed or not sky.truth.armed)
            assert sky.truth.armed
            await asyncio.sleep(1.0)
            assert (drone.control.authority, drone.state) == (Authority.DRIVER, StreamState.GRANTED)
            await drone.service.arm(grant, 60.0)
            async for _ in drone.service.take_off(grant, TakeoffArgs(15.0)):
                pass
            assert sky.truth.body.down < -10.0

    fly(work, tmp_path)


@pytest.mark.parametrize("mode", [GUIDED, RTL])
def test_drone_armed_by_others_stays_with_pilot_after_service_restart(mode: FlightMode, tmp_path: Path) -> None:
    async def work() -> None:
        async with World(tmp_path) as world:
            world.grants.put(spec())
            world.plane.vehicle.armed = True
            world.observer.heartbeat()
            assert world.control.authority is Authority.PILOT
        world.plane.height = 20.0
        world.plane.set_to(mode)
        async with World(tmp_path, after=world, initialised=False) as restarted:
            world.plane.commands.clear()
            restarted.observer.found()
            assert (restarted.control.authority, restarted.control.state.armed_by_others) == (Authority.PILOT, True)
            await restarted.plane.update(5.0)
            assert mavlink.MAV_CMD_DO_SET_MODE not in restarted.plane.commands
            restarted.plane.vehicle.armed = False
            restarted.observer.heartbeat()
            assert (restarted.control.authority, restarted.journal.record.armed_by_others) == (Authority.SYSTEM, False)

    virtual_time.fly(work)


def test_rearmed_motors_belong_to_pilot_after_confirmed_disarm(tmp_path: Path) -> None:
    """The service's arm command was acknowledged, and the motors stopped again.

    The service therefore expects no further arming. If the motors start again, a pilot has armed them.
    """

    async def work() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.drive(grant)
            await world.service.arm(grant)
            for armed in (False, True):
                world.plane.vehicle.armed = armed
                world.observer.heartbeat()
            assert world.control.authority is Authority.PILOT
            assert world.control.state.armed_by_others

    virtual_time.fly(work)

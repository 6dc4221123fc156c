"""Home position in flight.

Altitudes and return flights refer to the home at the time of arming, even if another station moves home in flight.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
import sky_drone
from closed_loop import Sky
from fractus_core.control import Authority
from fractus_core.policy.decision_types import GotoArgs, TakeoffArgs
from fractus_runtime.mavlink_codec import Endpoint, Parser, message
from fractus_services.errors import AutopilotError, Refused, Unavailable
from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.mavlink.ardupilot import ARDUCOPTER
from fractus_services.mobility.mavlink.telemetry_requests import HomePositionMonitor
from fractus_services.mobility.mavlink.vehicle import Vehicle
from fractus_services.mobility.rpc.telemetry import located
from mobility_world import FRAME, GROUND_M, GUIDED, LOITER, SMART_RTL, World, at, end, refusal, spec
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sky_drone import ready, until
from virtual_time import fly

AWAY = (0.0, 100.0, 0.0)
UP = (0.0, 0.0, 60.0)
DOWN = (0.0, 0.0, -60.0)
CEILING = {"name": "low", "spec": {"type": "LimitControl", "kind": "altitude", "upperLimit": 15}}


def move(world: World, target: tuple[float, float, float]) -> None:
    """Move home, like the function "set home here" of a ground station."""
    east, north, up = target
    lat, lon = FRAME.latlon(east, north)
    world.plane.move_home(round(lat * 1e7), round(lon * 1e7), GROUND_M + up)


async def send_heartbeats(world: World) -> None:
    """Deliver heartbeats until cancelled."""
    while True:
        world.observer.heartbeat()
        await asyncio.sleep(0.5)


@contextlib.asynccontextmanager
async def flying(world: World, *policies: dict[str, Any]) -> AsyncIterator[ActiveGrant]:
    """Take off with a driver, and deliver heartbeats of the vehicle."""
    beating = asyncio.ensure_future(send_heartbeats(world))
    grant = world.grants.put(spec(*policies))
    await world.up(grant)
    yield grant
    beating.cancel()


def at_home(world: World) -> bool:
    home = world.plane.vehicle.home
    return home is not None and abs(home.amsl_m - GROUND_M) < 0.5 and abs(home.lat - 39.36) < 1e-5


def home_moved_entries(world: World) -> list[dict[str, Any]]:
    return [entry for entry in world.kinds("control") if entry["code"] == "HomeMoved"]


@pytest.mark.parametrize("target", [AWAY, UP, DOWN])
def test_moved_home_is_restored_before_flight_continues(tmp_path: Path, target: tuple[float, float, float]) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world, flying(world, CEILING) as grant:
            leg = asyncio.ensure_future(refusal(world.service.goto(grant, GotoArgs(*at(0, 90), 12.0), 0)))
            await world.until(lambda: world.plane.xy[1] > 20)
            move(world, target)
            # Altitudes are invalid until home is restored. Motions and camera requests must not use them.
            assert not located(world.control)
            with pytest.raises(Unavailable):
                world.service.goto(grant, GotoArgs(*at(0, 90), 12.0), 0)
            assert isinstance(await leg, Unavailable)
            await world.until(lambda: at_home(world) and located(world.control), 5)
            await end(world.service.goto(grant, GotoArgs(*at(0, 90), 12.0), 0))
            assert len(home_moved_entries(world)) == 1
            assert max(height for _, _, height in world.plane.trace) < 16
            await world.control.return_control(grant)
            await world.until(lambda: not world.plane.vehicle.armed)
            assert abs(world.plane.xy[1]) < 3
            assert "failed" not in world.outcome()

    fly(flight)


def test_return_leads_to_original_home_after_home_was_moved(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world, flying(world) as grant:
            await end(world.service.goto(grant, GotoArgs(*at(0, 90), 12.0), 0))
            await world.control.return_control(grant)
            await world.until(lambda: world.plane.xy[1] < 60)
            move(world, (80.0, 60.0, 0.0))
            await world.until(lambda: not world.plane.vehicle.armed)
            assert abs(world.plane.xy[1]) < 3
            assert max(x for x, _, _ in world.plane.trace) < 3

    fly(flight)


def test_mission_ends_if_moved_home_cannot_be_restored(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world, flying(world):
            world.plane.refuses.add(mavlink.MAV_CMD_DO_SET_HOME)
            move(world, AWAY)
            await world.until(world.outcome)
            assert "cannot be set back" in world.kinds("takeover")[0]["reason"]
            await world.until(lambda: not world.plane.vehicle.armed)

    fly(flight)


@pytest.mark.parametrize("refused", [True, False])
def test_drone_lands_at_original_home_if_home_keeps_moving(tmp_path: Path, refused: bool) -> None:
    """The autopilot refuses to restore home, or home is moved again after each restore.

    SmartRTL still returns the drone to the position at which it was armed.
    """

    async def move_home_repeatedly(world: World) -> None:
        while True:
            move(world, AWAY)
            await asyncio.sleep(0.1)

    async def flight() -> None:
        async with World(tmp_path, retraces=True) as world, flying(world) as grant:
            await end(world.service.goto(grant, GotoArgs(*at(0, 60), 12.0), 0))
            if refused:
                world.plane.refuses.add(mavlink.MAV_CMD_DO_SET_HOME)
            moving = asyncio.ensure_future(move_home_repeatedly(world))
            await world.control.return_control(grant)
            await world.until(lambda: world.plane.vehicle.mode == SMART_RTL, 120)
            await world.until(lambda: not world.plane.vehicle.armed, 200)
            moving.cancel()
            assert abs(world.plane.xy[1]) < 3

    fly(flight)


def test_home_moved_by_pilot_is_restored_after_handback(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world, flying(world) as grant:
            await end(world.service.goto(grant, GotoArgs(*at(0, 50), 12.0), 0))
            world.plane.set_to(LOITER)
            await world.until(lambda: world.control.state.controller == "pilot")
            assert located(world.control)
            move(world, AWAY)
            await asyncio.sleep(5.0)
            assert not at_home(world)
            assert not located(world.control), "altitudes relative to the moved home are invalid"
            world.plane.set_to(GUIDED)
            await world.until(lambda: at_home(world), 5)
            await world.until(lambda: not world.plane.vehicle.armed)
            assert abs(world.plane.xy[1]) < 3

    fly(flight)


def test_camera_position_is_unknown_while_home_is_moved_in_pilot_flight(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.grants.put(spec())
            plane = world.plane
            move(world, (3.0, 0.0, 0.5))
            plane.set_to(LOITER)
            plane.vehicle.armed = True
            plane.goal = (0.0, 0.0)
            plane.goal_height = 60.0
            world.observer.heartbeat()
            await world.until(lambda: plane.vehicle.altitude_m > 50)
            assert world.control.state.controller == "pilot"
            assert located(world.control)
            move(world, UP)
            await asyncio.sleep(1.0)
            assert not located(world.control)
            move(world, (3.0, 0.0, 0.5))
            await asyncio.sleep(1.0)
            assert located(world.control)

    fly(flight)


def heartbeat(world: World, *, armed: bool) -> None:
    """Deliver a heartbeat in a pilot mode."""
    world.plane.take(
        message(
            "HEARTBEAT", type=mavlink.MAV_TYPE_QUADROTOR, autopilot=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, custom_mode=mavlink.COPTER_MODE_LOITER,
            base_mode=mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0,
        )
    )  # fmt: skip
    world.observer.heartbeat()


def test_pilot_flight_fixes_home_from_first_message_after_arming(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            plane = world.plane
            move(world, (0.0, 0.0, 0.0))
            plane.xy[:] = [0.0, 50.0]
            heartbeat(world, armed=True)
            plane.goal = (0.0, 50.0)
            plane.goal_height = 60.0
            await world.until(lambda: plane.vehicle.in_air)
            assert not located(world.control), "no home has been reported since arming"
            move(world, (0.0, 50.0, 0.0))
            await world.until(lambda: plane.vehicle.altitude_m > 20)
            assert located(world.control)
            move(world, (0.0, 50.0, 60.0))
            await asyncio.sleep(1.0)
            assert not located(world.control)

    fly(flight)


def test_pilot_flight_after_landed_mission_uses_new_home(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world, flying(world) as grant:
            plane = world.plane
            await end(world.service.goto(grant, GotoArgs(*at(0, 50), 12.0), 0))
            await end(world.service.land(grant))
            await world.until(lambda: not plane.vehicle.armed)
            heartbeat(world, armed=False)
            heartbeat(world, armed=True)
            move(world, (0.0, 50.0, 0.0))
            assert (world.control.authority, world.control.state.armed_by_others) == (Authority.PILOT, True)
            plane.goal = (0.0, 50.0)
            plane.goal_height = 20.0
            await world.until(lambda: plane.vehicle.altitude_m > 10)
            assert world.control.state.mission is not None
            assert located(world.control), "the pilot flight has its own home"
            move(world, (0.0, 0.0, 0.0))
            await asyncio.sleep(1.0)
            assert not located(world.control)

    fly(flight)


def test_failed_arming_does_not_fix_home(tmp_path: Path) -> None:
    """The autopilot refuses to arm, for example because of magnetic interference.

    The drone is then carried to another place and armed there.
    """

    async def flight() -> None:
        async with World(tmp_path) as world:
            plane = world.plane
            grant = world.grants.put(spec())
            await world.drive(grant)
            plane.refuses.add(mavlink.MAV_CMD_COMPONENT_ARM_DISARM)
            with pytest.raises(AutopilotError):
                await world.service.arm(grant)
            plane.xy[:] = [30.0, 0.0]
            await asyncio.sleep(0.5)
            plane.refuses.clear()
            await world.service.arm(grant)
            home = plane.vehicle.home
            assert home is not None
            east, north = FRAME.xy(home.lat, home.lon)
            assert abs(east - 30.0) < 0.5
            assert abs(north) < 0.5
            # If the drone lands and arms again during the mission, home must not change.
            await end(world.service.take_off(grant, TakeoffArgs(10.0)))
            await end(world.service.goto(grant, GotoArgs(*at(0, 40), 10.0), 0))
            await end(world.service.land(grant))
            await world.service.arm(grant)
            assert plane.vehicle.home == home

    fly(flight)


@pytest.mark.parametrize("up_m", [-40.0, 40.0])
def test_vertical_home_move_is_detected_without_home_position_message(
    up_m: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another station stopped the HOME_POSITION stream, and the single message about the move is lost."""

    async def work(sky: Sky, directory: Path) -> None:
        station = Endpoint(255, mavlink.MAV_COMP_ID_MISSIONPLANNER)
        parser = Parser()
        lost_messages = []
        async with ready(sky, directory) as (drone, grant):
            (wire,) = sky.wires
            deliver = wire._protocol.data_received

            def send(kind: str, **values: Any) -> None:
                values |= {"target_system": 1, "target_component": 1}
                sky.craft.receive(wire._channel, station.encode(kind, values))

            def lose_the_first(data: Any) -> None:
                for received in parser.feed(bytes(data)):
                    if received.name == "HOME_POSITION" and not lost_messages:
                        lost_messages.append(received)
                    else:
                        deliver(received.frame)

            await drone.service.arm(grant, 120.0)
            await end(drone.service.take_off(grant, TakeoffArgs(15.0)))
            kind = float(mavlink.MAVLINK_MSG_ID_HOME_POSITION)
            send("COMMAND_LONG", command=mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, param1=kind, param2=-1.0)
            await asyncio.sleep(0.3)
            monkeypatch.setattr(wire._protocol, "data_received", lose_the_first)
            lat, lon = (round(degrees * 1e7) for degrees in at(0, 0))
            place = {"x": lat, "y": lon, "z": GROUND_M + up_m}
            send("COMMAND_INT", command=mavlink.MAV_CMD_DO_SET_HOME, frame=mavlink.MAV_FRAME_GLOBAL, **place)
            await until(lambda: lost_messages, 2.0)
            with contextlib.suppress(Refused):
                await end(drone.service.goto(grant, GotoArgs(*at(0, 20), 15.0), 0.0))
            await until(lambda: not drone.control.home_moved, 3.0)
            assert abs(-sky.truth.body.down - 15.0) < 2.5

    sky_drone.fly(work, tmp_path)


async def test_home_position_request_is_rate_limited_after_refusal() -> None:
    """The autopilot refuses each request immediately. The service must not repeat the request at once."""

    class Refusing:
        vehicle = Vehicle(stack=ARDUCOPTER, armed=True, heartbeat_at=10.0)
        connected = True
        requests = 0

        async def request_home(self) -> None:
            self.requests += 1
            raise AutopilotError("refused", refused=True)

    autopilot = Refusing()
    assert autopilot.vehicle.in_air
    monitor = HomePositionMonitor(autopilot)
    for amsl_m in (50.0, 90.0):
        autopilot.vehicle.amsl_m = amsl_m
        monitor.take("GLOBAL_POSITION_INT")
    for _ in range(20):
        await asyncio.sleep(0)
        monitor.take("ATTITUDE")
    assert autopilot.requests == 1
    assert monitor._request is not None
    monitor._request.cancel()

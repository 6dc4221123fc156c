"""MAVLink programs upload missions, which the gateway stores and flies as calls of the mobility service."""

from __future__ import annotations

import asyncio
import math
import os
import time
from pathlib import Path
from typing import Any

import sky_drone
from closed_loop import Sky
from fractus_core.api.names import ComponentIdentity
from fractus_core.control import OutcomeKind
from gateway_world import ACCEPTED, DENIED, GUIDED, Flight, flying, item, mavlink_spec, waypoint
from mobility_world import FRAME, zone
from pymavlink.dialects.v20 import ardupilotmega as mavlink

AUTO = mavlink.COPTER_MODE_AUTO
TAKEOFF = item(mavlink.MAV_CMD_NAV_TAKEOFF, altitude_m=10.0)
HOME = item(mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH)


def fly(flight: Flight, directory: Path) -> None:
    """Run a flight in virtual time."""

    async def work(sky: Sky, path: Path) -> None:
        async with flying(sky, path) as world:
            await flight(world)

    sky_drone.fly(work, directory)


async def ready(world, *policies, **changes):
    """Return a program that has control, and its Grant."""
    grant = world.drone.grants.put(mavlink_spec(*policies, **changes))
    program = await world.program(grant.identity)
    await program.until(lambda: program.mode == GUIDED)
    assert await program.command(511, mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, 100_000) == ACCEPTED
    await program.until(lambda: "GLOBAL_POSITION_INT" in program.latest)
    return program, grant


async def start(program) -> None:
    """Arm and start the mission."""
    assert await program.command(400, 1) == ACCEPTED, program.texts
    assert await program.command(300) == ACCEPTED, program.texts


def test_mission_is_flown_with_progress_and_returns(tmp_path: Path) -> None:
    async def flight(world):
        program, grant = await ready(world)
        items = [TAKEOFF, item(178, 1, 4.0, -1), waypoint(0, 30), waypoint(20, 30, 14), HOME]
        assert await program.upload(*items) == mavlink.MAV_MISSION_ACCEPTED, program.texts
        await start(program)
        await program.until(lambda: program.mode == AUTO)
        await program.until(lambda: program.reached[-1:] == [3], 90.0)
        assert abs(program.place[1] - 30) < 1.5
        assert program.latest["MISSION_CURRENT"].integer("mission_state") == mavlink.MISSION_STATE_ACTIVE
        await program.until(lambda: program.reached[-1:] == [4], 60.0)
        assert abs(program.place[0] - 20) < 1.5
        assert abs(program.place[2] - 14) < 1.0
        await program.until(lambda: not program.armed, 180.0)
        assert program.reached == [1, 2, 3, 4, 5]
        assert "Mission: 2 ChangeSpeed" in program.texts
        assert "Reached command #4" in program.texts
        await program.until(lambda: program.mode == GUIDED)
        assert program.latest["MISSION_CURRENT"].integer("mission_state") == mavlink.MISSION_STATE_COMPLETE
        await program.close()
        await sky_drone.until(lambda: world.drone.control.mission(grant).outcome is not None)
        assert world.drone.control.mission(grant).outcome.kind is OutcomeKind.COMPLETE

    fly(flight, tmp_path)


def test_item_in_a_forbidden_zone_is_refused_and_the_former_mission_is_kept(tmp_path: Path) -> None:
    async def flight(world):
        program, _ = await ready(world, zone("pool", "ignore", -20, 40, 20, 60))
        assert await program.upload(TAKEOFF, waypoint(0, 20)) == mavlink.MAV_MISSION_ACCEPTED, program.texts
        result = await program.upload(TAKEOFF, waypoint(0, 20), waypoint(0, 50))
        assert result == mavlink.MAV_MISSION_DENIED
        assert "Mission: item 3: " in program.texts
        assert "pool" in program.texts
        assert [m.integer("command") for m in await program.download()] == [16, 22, 16]
        assert {entry["message"] for entry in world.refused} == {"Mission"}
        await program.close()

    fly(flight, tmp_path)


def test_leg_through_a_forbidden_zone_is_refused(tmp_path: Path) -> None:
    async def flight(world):
        program, _ = await ready(world, zone("pool", "ignore", -20, 40, 20, 60))
        assert await program.upload(TAKEOFF, waypoint(0, 80)) == mavlink.MAV_MISSION_DENIED
        items = [TAKEOFF, waypoint(40, 0), waypoint(40, 80), waypoint(0, 80)]
        assert await program.upload(*items) == mavlink.MAV_MISSION_ACCEPTED, program.texts
        jump = [TAKEOFF, waypoint(0, 20), waypoint(40, 0), waypoint(40, 80), waypoint(0, 80), item(177, 2, -1)]
        assert await program.upload(*jump) == mavlink.MAV_MISSION_DENIED
        assert "Mission: item 2: " in program.texts
        await program.close()

    fly(flight, tmp_path)


def test_circle_is_judged_over_its_whole_path_and_flown(tmp_path: Path) -> None:
    def circle(y: float) -> dict[str, Any]:
        return {**waypoint(0, y, command=mavlink.MAV_CMD_NAV_LOITER_TURNS), "param1": 1.0, "param3": 15.0}

    async def flight(world):
        program, _ = await ready(world, zone("pool", "ignore", -5, 40, 5, 50))
        # Centre and nearest point are legal, but the circle passes through the zone.
        assert await program.upload(TAKEOFF, circle(28), HOME) == mavlink.MAV_MISSION_DENIED
        assert "Mission: item 2: " in program.texts
        assert await program.upload(TAKEOFF, circle(20), HOME) == mavlink.MAV_MISSION_ACCEPTED, program.texts
        begun = len(program.received)
        await start(program)
        await program.until(lambda: program.reached[-1:] == [2], 300.0)
        reports = [m for m in program.received[begun:] if m.name == "GLOBAL_POSITION_INT"]
        points = [FRAME.xy(m.integer("lat") / 1e7, m.integer("lon") / 1e7) for m in reports]
        bearings = {
            round(math.degrees(math.atan2(x, y - 20)) / 45) % 8 for x, y in points if math.hypot(x, y - 20) > 14
        }
        assert bearings == set(range(8))
        assert max(math.hypot(x, y - 20) for x, y in points if y > 10) < 16.5
        await program.close()

    fly(flight, tmp_path)


def test_mission_outside_the_operation_area_is_refused(tmp_path: Path) -> None:
    async def flight(world):
        program, _ = await ready(world)
        assert await program.upload(TAKEOFF, waypoint(0, 500)) == mavlink.MAV_MISSION_DENIED
        assert "Mission: item 2: " in program.texts
        await program.close()

    fly(flight, tmp_path)


def test_mission_is_paused_and_continued(tmp_path: Path) -> None:
    async def flight(world):
        program, _ = await ready(world)
        assert await program.upload(TAKEOFF, waypoint(0, 40), waypoint(30, 40)) == mavlink.MAV_MISSION_ACCEPTED
        await start(program)
        await program.until(lambda: program.place[1] > 15)
        assert await program.command(193, 0) == ACCEPTED
        await program.until(lambda: program.latest["GLOBAL_POSITION_INT"].integer("vx") < 30)
        paused = program.place
        await asyncio.sleep(10.0)
        assert abs(program.place[1] - paused[1]) < 3.0
        assert program.mode == AUTO
        assert await program.command(193, 1) == ACCEPTED
        await program.until(lambda: program.reached[-1:] == [3])
        # In AUTO mode, targets are refused.
        program.target(0, 0)
        await program.until(lambda: "SET_POSITION_TARGET_GLOBAL_INT: the mode is AUTO" in program.texts)
        assert await program.command(176, 1, GUIDED) == ACCEPTED
        program.target(0, 40)
        await program.until(lambda: program.place[0] < 2.0)
        assert await program.command(21) == ACCEPTED
        await program.until(lambda: not program.armed)
        await program.close()

    fly(flight, tmp_path)


def test_current_item_is_set_in_flight(tmp_path: Path) -> None:
    async def flight(world):
        program, _ = await ready(world, zone("pool", "ignore", 10, 20, 30, 30))
        items = [TAKEOFF, waypoint(-20, 0), waypoint(-20, 40), waypoint(20, 40)]
        assert await program.upload(*items) == mavlink.MAV_MISSION_ACCEPTED, program.texts
        await start(program)
        await program.until(lambda: program.place[0] < -5)
        assert await program.command(224, 9) == DENIED
        program.send("MISSION_SET_CURRENT", seq=4)  # the direct way leads through the zone
        await program.until(lambda: "MISSION_SET_CURRENT: item 4: " in program.texts)
        assert program.latest["MISSION_CURRENT"].integer("seq") == 2
        program.send("MISSION_SET_CURRENT", seq=3)
        await program.until(lambda: program.reached[-1:] == [4])
        assert 2 not in program.reached
        assert await program.command(224, 3) == ACCEPTED
        await program.until(lambda: program.reached[-2:] == [4, 3])
        await program.close()

    fly(flight, tmp_path)


def test_zone_that_appears_stops_the_mission(tmp_path: Path) -> None:
    async def flight(world):
        program, _ = await ready(world)
        assert await program.upload(TAKEOFF, waypoint(0, 30), waypoint(0, 80)) == mavlink.MAV_MISSION_ACCEPTED
        await start(program)
        await program.until(lambda: program.place[1] > 10)
        world.drone.grants.put(mavlink_spec(zone("pool", "ignore", -20, 50, 20, 70)))
        await program.until(lambda: program.mode == mavlink.COPTER_MODE_BRAKE, 90.0)
        assert "Mission stopped at item 3: " in program.texts
        assert "pool" in program.texts
        assert program.place[1] < 50.0
        assert await program.command(300) == DENIED
        assert await program.command(20) == ACCEPTED
        await program.until(lambda: not program.armed, 120.0)
        await program.close()

    fly(flight, tmp_path)


def test_program_that_dies_during_its_mission_is_brought_home(tmp_path: Path) -> None:
    async def flight(world):
        program, _ = await ready(world)
        assert await program.upload(TAKEOFF, waypoint(0, 60), waypoint(60, 60)) == mavlink.MAV_MISSION_ACCEPTED
        await start(program)
        await program.until(lambda: program.place[1] > 20)
        await program.close()
        await sky_drone.until(lambda: not world.sky.truth.armed, 180.0)
        vehicle = world.drone.autopilot.vehicle
        assert vehicle.home is not None
        assert abs(vehicle.lat - vehicle.home.lat) * 111_319 < 3.0
        assert abs(vehicle.lon - vehicle.home.lon) * 80_000 < 3.0

    fly(flight, tmp_path)


def test_partial_write_replaces_one_item_after_the_whole_mission_was_judged(tmp_path: Path) -> None:
    async def flight(world):
        program, _ = await ready(world, zone("pool", "ignore", -20, 40, 20, 60))
        assert await program.upload(TAKEOFF, waypoint(0, 20), waypoint(30, 20)) == mavlink.MAV_MISSION_ACCEPTED

        async def write(row) -> int:
            begun = len(program.received)
            program.send("MISSION_WRITE_PARTIAL_LIST", start_index=3, end_index=3)
            program.send("MISSION_ITEM_INT", seq=3, **row)
            await program.until(lambda: any(m.name == "MISSION_ACK" for m in program.received[begun:]))
            return program.latest["MISSION_ACK"].integer("type")

        assert await write(waypoint(0, 80)) == mavlink.MAV_MISSION_DENIED
        assert await write(waypoint(30, 30)) == mavlink.MAV_MISSION_ACCEPTED
        (*_, last) = await program.download()
        assert last.integer("x") == waypoint(30, 30)["x"]
        await program.close()

    fly(flight, tmp_path)


def test_mission_leg_corrected_by_a_policy_is_flown_to_the_corrected_place(tmp_path: Path) -> None:
    async def flight(world):
        program, _ = await ready(world, zone("pool", "adjust", -20, 40, 20, 60))
        items = [TAKEOFF, waypoint(0, 50), waypoint(30, 20), HOME]
        assert await program.upload(*items) == mavlink.MAV_MISSION_ACCEPTED, program.texts
        assert "corrected in flight: item 2: " in program.texts
        await start(program)
        await program.until(lambda: program.reached[-1:] == [2], 90.0)
        assert 25 < program.place[1] < 40
        await program.until(lambda: program.reached[-1:] == [3], 90.0)
        await program.until(lambda: not program.armed, 180.0)
        await program.close()

    fly(flight, tmp_path)


def test_fence_of_the_program_refuses_targets_and_returns_the_drone(tmp_path: Path) -> None:
    async def flight(world):
        program, _ = await ready(world)
        corners = [waypoint(x, y, 0, frame=0, command=5001) for x, y in ((-40, -40), (40, -40), (40, 40), (-40, 40))]
        rows = [{**corner, "param1": 4} for corner in corners]
        assert await program.command(207, 1) == mavlink.MAV_RESULT_FAILED
        assert await program.upload(*rows, kind=1) == mavlink.MAV_MISSION_ACCEPTED
        assert await program.command(207, 1) == ACCEPTED
        assert len(await program.download(1)) == 4
        assert await program.upload(TAKEOFF, waypoint(0, 60)) == mavlink.MAV_MISSION_DENIED
        await program.up()
        program.target(0, 60)
        await program.until(lambda: "outside the fence" in program.texts)
        program.target(0, 35)
        await program.until(lambda: program.place[1] > 33)
        for _ in range(8):
            program.send(
                "SET_POSITION_TARGET_LOCAL_NED",
                coordinate_frame=mavlink.MAV_FRAME_LOCAL_NED, type_mask=0b110111000111, vx=4.0,
            )  # fmt: skip
            await asyncio.sleep(1.0)
        await program.until(lambda: program.mode == mavlink.COPTER_MODE_RTL, 10.0)
        await program.until(lambda: not program.armed, 120.0)
        await program.close()

    fly(flight, tmp_path)


def test_rally_points_are_stored(tmp_path: Path) -> None:
    async def flight(world):
        program, _ = await ready(world)
        assert await program.upload(waypoint(0, -15, 10, command=5100), kind=2) == mavlink.MAV_MISSION_ACCEPTED
        assert len(await program.download(2)) == 1
        await program.close()

    fly(flight, tmp_path)


def test_lists_of_an_instance_that_has_not_connected_for_a_week_are_removed(tmp_path: Path) -> None:
    async def flight(world):
        grant = world.drone.grants.put(mavlink_spec())
        program = await world.program(grant.identity)
        await program.until(lambda: program.mode == GUIDED)
        directory = tmp_path / "missions"
        directory.mkdir(exist_ok=True)
        parsed = ComponentIdentity.parse(grant.identity)
        connected = directory / f"{parsed.namespace}.{parsed.instance}.json"
        old = directory / "default.ended.json"
        recent = directory / "default.recent.json"
        for file, days in ((connected, 8), (old, 8), (recent, 6)):
            file.write_text("{}")
            os.utime(file, (time.time() - days * 86_400,) * 2)
        world.gateway.remove_unused_missions(time.time())
        assert sorted(directory.glob("*.json")) == sorted([connected, recent])
        os.utime(connected, (0.0, 0.0))
        await program.close()
        await program.until(lambda: connected.stat().st_mtime > 0.0)  # its time begins when the last connection ends

    fly(flight, tmp_path)

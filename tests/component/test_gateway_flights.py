"""MAVLink programs fly through the gateway under a Grant, and policies are enforced."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
import sky_drone
from closed_loop import Sky
from fractus_core.control import OutcomeKind
from fractus_runtime.mavlink_codec import Parser
from fractus_runtime.metrics import metrics_text
from fractus_services.gateway.decisions import DECISIONS
from fractus_services.gateway.mobility_client import MobilityClient
from fractus_services.gateway.translate import UNSUPPORTED
from fractus_services.options import CannotServe
from gateway_world import ACCEPTED, DENIED, GUIDED, Flight, GatewayWorld, flying, mavlink_spec
from mobility_world import zone
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from scraping import assert_documented, values


def fly(flight: Flight, directory: Path) -> None:
    """Run a flight in virtual time."""

    async def work(sky: Sky, path: Path) -> None:
        async with flying(sky, path) as world:
            await flight(world)

    sky_drone.fly(work, directory)


def test_program_takes_off_flies_a_target_and_a_velocity_and_returns(tmp_path: Path) -> None:
    async def flight(world):
        grant = world.drone.grants.put(mavlink_spec())
        program = await world.program(grant.identity)
        await program.up()
        program.target(0, 30, 12)
        await program.until(lambda: abs(program.place[1] - 30) < 1.0)
        program.send(
            "SET_POSITION_TARGET_LOCAL_NED",
            coordinate_frame=mavlink.MAV_FRAME_LOCAL_NED,
            type_mask=0b110111000111,
            vy=3.0,
        )
        await program.until(lambda: program.latest["GLOBAL_POSITION_INT"].integer("vy") > 200)
        assert await program.command(20) == ACCEPTED
        await program.until(lambda: program.mode == mavlink.COPTER_MODE_RTL)
        await program.until(lambda: not program.armed, 120.0)
        await program.close()
        await program.until(lambda: world.drone.control.mission(grant).outcome is not None)
        assert world.drone.control.mission(grant).outcome.kind is OutcomeKind.COMPLETE

    fly(flight, tmp_path)


def test_answers_are_sent_as_soon_as_they_are_known(tmp_path: Path) -> None:
    """An upload of 650 mission items waits for an answer to each item."""

    async def flight(world):
        grant = world.drone.grants.put(mavlink_spec())
        program = await world.program(grant.identity)
        await program.until(lambda: program.mode == GUIDED)
        loop = asyncio.get_running_loop()
        waits_s = []
        for number in range(50):
            begun_s = loop.time()
            program.send("PING", seq=number, target_system=0, target_component=0)
            while "PING" not in program.latest or program.latest["PING"].integer("seq") != number:  # noqa: ASYNC110
                await asyncio.sleep(0.001)
            waits_s.append(loop.time() - begun_s)
        # The gateway's timer has an interval of 20 ms. If answers waited for it, only the first one could be faster.
        assert sorted(waits_s)[10] < 0.01
        await program.close()

    fly(flight, tmp_path)


@pytest.mark.parametrize(("altitude_cm", "expected_m"), [(2500.0, 25.0), (9000.0, 60.0)])
def test_program_returns_at_the_altitude_that_it_has_written_within_the_limits(
    altitude_cm: float, expected_m: float, tmp_path: Path
) -> None:
    async def flight(world):
        grant = world.drone.grants.put(mavlink_spec())
        program = await world.program(grant.identity)
        await program.until(lambda: program.mode == GUIDED)
        # The autopilot is in STABILIZE, which rejects a speed.
        program.send("PARAM_SET", param_id=b"WPNAV_SPEED", param_value=400.0)
        program.send("PARAM_SET", param_id=b"RTL_ALT", param_value=altitude_cm)
        await program.up()
        assert "PARAM_SET" not in program.texts
        program.target(0, 100)
        await program.until(lambda: abs(program.place[1] - 100) < 1.0, 90.0)
        assert world.drone.control.cruise_mps == 4.0
        heights = []

        def landed() -> bool:
            heights.append(program.place[2])
            return not program.armed

        assert await program.command(20) == ACCEPTED
        await program.until(landed, 180.0)
        assert max(heights) == pytest.approx(expected_m, abs=1.5)
        await program.close()

    fly(flight, tmp_path)


def test_mission_is_complete_when_the_program_leaves_while_another_connection_stays_open(tmp_path: Path) -> None:
    async def flight(world):
        grant = world.drone.grants.put(mavlink_spec())
        program = await world.program(grant.identity)
        idle = await world.program(grant.identity)
        idle.beats = False
        await program.up()
        program.target(0, 20)
        await program.until(lambda: abs(program.place[1] - 20) < 1.0)
        await program.until(lambda: world.drone.control.mission(grant).legs == 1)
        assert await program.command(21) == ACCEPTED
        await program.until(lambda: not program.armed, 60.0)
        await program.close()
        await sky_drone.until(lambda: world.drone.control.mission(grant).outcome is not None)
        assert world.drone.control.mission(grant).outcome.kind is OutcomeKind.COMPLETE
        await idle.close()

    fly(flight, tmp_path)


def test_target_in_a_forbidden_zone_is_refused_with_the_reason(tmp_path: Path) -> None:
    async def flight(world):
        grant = world.drone.grants.put(mavlink_spec(zone("pool", "ignore", -20, 40, 20, 60)))
        program = await world.program(grant.identity)
        await program.up()
        program.target(0, 50)
        await program.until(lambda: "SET_POSITION_TARGET_GLOBAL_INT: " in program.texts)
        assert "pool" in program.texts
        assert program.mode == GUIDED
        assert abs(program.place[1]) < 1.5
        await program.close()

    fly(flight, tmp_path)


def test_program_without_mavlink_in_its_grant_gets_neither_control_nor_telemetry(tmp_path: Path) -> None:
    async def flight(world):
        grant = world.drone.grants.put(mavlink_spec(interfaces=("grpc",)))
        program = await world.program(grant.identity)
        assert await program.command(400, 1) != ACCEPTED
        assert "over mavlink" in program.texts
        assert set(program.latest) == {"COMMAND_ACK", "STATUSTEXT"}
        assert not world.sky.truth.armed
        await program.close()

    fly(flight, tmp_path)


def test_program_without_grant_receives_nothing(tmp_path: Path) -> None:
    async def flight(world):
        program = await world.program("spiffe://fractus.dev/ns/x/app/y/component/Z/instance/z")
        assert await program.command(22, 0, 0, 0, 0, 0, 0, 10) != ACCEPTED
        assert "HEARTBEAT" not in program.latest
        await program.close()

    fly(flight, tmp_path)


def test_silent_program_loses_control_and_the_drone_returns(tmp_path: Path) -> None:
    async def flight(world):
        grant = world.drone.grants.put(mavlink_spec())
        program = await world.program(grant.identity)
        await program.up()
        program.target(0, 60)
        await program.until(lambda: program.place[1] > 10)
        program.beats = False
        await program.until(lambda: program.mode != GUIDED, 10.0)
        await program.until(lambda: not program.armed, 180.0)
        assert abs(program.place[0]) < 3.0
        assert abs(program.place[1]) < 3.0
        await program.close()

    fly(flight, tmp_path)


def test_program_that_dies_in_flight_is_brought_home(tmp_path: Path) -> None:
    async def flight(world):
        grant = world.drone.grants.put(mavlink_spec())
        program = await world.program(grant.identity)
        await program.up()
        await program.close()
        await sky_drone.until(lambda: not world.sky.truth.armed, 180.0)

    fly(flight, tmp_path)


def test_vehicle_receives_no_frame_that_the_service_did_not_encode(tmp_path: Path) -> None:
    async def flight(world):
        grant = world.drone.grants.put(mavlink_spec())
        program = await world.program(grant.identity)
        await program.until(lambda: program.mode == GUIDED)
        senders = world.tap()
        await program.up()
        for name in ("MANUAL_CONTROL", "SET_ATTITUDE_TARGET", "HIL_SENSOR", "GPS_INPUT", "SET_MODE"):
            program.send(name)
        await program.until(lambda: "GPS_INPUT" in program.texts)
        assert senders == {(244, 191)}
        await program.close()

    fly(flight, tmp_path)


def test_parameters_are_one_dense_list(tmp_path: Path) -> None:
    async def flight(world):
        grant = world.drone.grants.put(mavlink_spec())
        program = await world.program(grant.identity)
        program.send("PARAM_REQUEST_LIST")

        def values():
            return {m.integer("param_index"): m for m in program.received if m.name == "PARAM_VALUE"}

        await program.until(lambda: values() and len(values()) == values()[0].integer("param_count"), 120.0)
        assert len(values()) > 1000
        assert {m.integer("param_count") for m in values().values()} == {len(values())}
        await program.close()

    fly(flight, tmp_path)


def test_messages_of_an_instance_are_recorded_around_its_flight(tmp_path: Path) -> None:
    async def flight(world):
        grant = world.drone.grants.put(mavlink_spec())
        program = await world.program(grant.identity)
        await program.up()
        program.send("SERIAL_CONTROL", device=0, flags=1)
        await program.until(lambda: "SERIAL_CONTROL" in program.texts)
        await program.close()
        await world.gateway.close()
        (log,) = (world.recordings / "default.app-navigator").glob("*.tlog")
        recorded = [m.name for m in Parser().feed(log.read_bytes())]
        assert {"COMMAND_LONG", "COMMAND_ACK", "SERIAL_CONTROL", "STATUSTEXT", "GLOBAL_POSITION_INT"} <= set(recorded)

    fly(flight, tmp_path)


def test_speed_written_before_control_is_applied_when_control_is_granted(tmp_path: Path) -> None:
    async def flight(world):
        grant = world.drone.grants.put(mavlink_spec())
        program = await world.program(grant.identity)
        await program.until(lambda: "HEARTBEAT" in program.latest)
        assert program.mode != GUIDED
        program.send("PARAM_SET", param_id=b"WPNAV_SPEED", param_value=300.0)
        await program.until(lambda: "PARAM_VALUE" in program.latest)
        assert program.latest["PARAM_VALUE"].real("param_value") == 300.0
        await program.until(lambda: world.drone.control.cruise_mps == 3.0)
        await program.close()

    fly(flight, tmp_path)


def test_gateway_socket_does_not_replace_a_file(tmp_path: Path) -> None:
    async def work(sky: Sky, path: Path) -> None:
        (path / "gateway.sock").write_text("notes")
        world = GatewayWorld(sky, path)
        try:
            with pytest.raises(CannotServe, match="name a file that does not exist"):
                await world.socket.run()
        finally:
            await world.drone.close()
        assert (path / "gateway.sock").read_text() == "notes"

    sky_drone.fly(work, tmp_path)


def test_audit_entries_about_refused_messages_are_limited_for_each_instance(tmp_path: Path) -> None:
    async def flight(world):
        refused = [number for number, entry in mavlink.enums["MAV_CMD"].items() if _is_denied(entry.name)][:60]
        programs = [await world.program("spiffe://fractus.dev/ns/x/app/y/component/Z/instance/z") for _ in range(2)]
        for program in programs:
            results = [await program.command(number) for number in refused]
            assert set(results) == {DENIED}
        assert 50 <= len(world.refused) < 80
        for program in programs:
            await program.close()

    fly(flight, tmp_path)


def _is_denied(name: str) -> bool:
    command = name.removeprefix("MAV_CMD_")
    return DECISIONS.commands.get(command) == "refuse" and command not in UNSUPPORTED


def test_gateway_socket_closes_open_connections_when_it_ends(tmp_path: Path) -> None:
    async def work(sky: Sky, path: Path) -> None:
        world = GatewayWorld(sky, path)
        serving = asyncio.ensure_future(world.socket.run())
        await asyncio.sleep(0.1)
        reader, writer = await asyncio.open_unix_connection(path / "gateway.sock")
        await asyncio.sleep(0.1)
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)
        async with asyncio.timeout(1.0):
            assert await reader.read() == b""
        writer.close()
        await world.drone.close()

    sky_drone.fly(work, tmp_path)


def test_unexpected_error_closes_the_connections_of_one_instance_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def flight(world):
        grant = world.drone.grants.put(mavlink_spec())
        other = await world.program(grant.identity)
        await other.until(lambda: other.mode == GUIDED)
        monkeypatch.setattr(MobilityClient, "open", lambda *_args: 1 / 0)
        program = await world.program("spiffe://fractus.dev/ns/x/app/y/component/Z/instance/z")
        await program.until(program.reader.at_eof, 5.0)
        assert await other.command(400, 1) == ACCEPTED
        for each in (program, other):
            await each.close()

    fly(flight, tmp_path)


def test_metrics_contain_verdicts_and_connections(tmp_path: Path) -> None:
    async def flight(world):
        grant = world.drone.grants.put(mavlink_spec(zone("pool", "ignore", -20, 40, 20, 60)))
        program = await world.program(grant.identity)
        await program.up()
        program.target(0, 50)
        program.send("SERIAL_CONTROL", device=0, flags=1)
        await program.until(lambda: "pool" in program.texts)
        text = metrics_text(world.gateway.metrics.collect()).decode()
        assert_documented(text, "Gateway")
        found = values(text)
        assert found["fractus_gateway_messages_total", "deny"] == 1
        assert found["fractus_gateway_messages_total", "refuse"] == 1
        assert found["fractus_gateway_messages_total", "allow"] == 2
        assert found["fractus_gateway_verdict_seconds_count",] == 2, "takeoff and target"
        assert found["fractus_gateway_connections",] == 1
        assert found["fractus_gateway_instances", "connected"] == 1
        await program.close()

    fly(flight, tmp_path)

"""Attacks of a MAVLink program in flight: each is refused and audited, and the flight continues."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest
from fractus_runtime.mavlink_codec import Endpoint
from fractus_runtime.metrics import metrics_text
from fractus_services.gateway.session import RESERVED_SOURCES
from fractus_services.mobility.mavlink import companion
from gateway_frames import frames
from gateway_world import DENIED, GUIDED, GatewayWorld, Program, mavlink_spec
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from scraping import values
from test_gateway_flights import fly

SERVICE = (companion.SYSTEM_ID, companion.COMPONENT_ID)
FORCE = 21196.0
FAILSAFES = {"FS_GCS_ENABLE": 0.0, "FS_THR_ENABLE": 0.0, "FENCE_ENABLE": 0.0, "SYSID_MYGCS": 255.0}


async def _denied(program: Program, number: int, *params: float) -> None:
    assert await program.command(number, *params) == DENIED


async def forced_arming(program: Program) -> None:
    await _denied(program, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1, FORCE)


async def forced_disarming(program: Program) -> None:
    await _denied(program, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, FORCE)


async def flight_termination(program: Program) -> None:
    await _denied(program, mavlink.MAV_CMD_DO_FLIGHTTERMINATION, 1)


async def reboot(program: Program) -> None:
    await _denied(program, mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1)


async def failsafe_parameters(program: Program) -> None:
    for name, value in FAILSAFES.items():
        program.send("PARAM_SET", param_id=name.encode(), param_value=value)


async def serial_control(program: Program) -> None:
    program.send(
        "SERIAL_CONTROL", device=0, flags=mavlink.SERIAL_CONTROL_FLAG_EXCLUSIVE, count=4, data=(35, 35, 35, 10)
    )


async def remote_control(program: Program) -> None:
    program.send("RC_CHANNELS_OVERRIDE", chan3_raw=1000)


async def bus_forwarding(program: Program) -> None:
    await _denied(program, mavlink.MAV_CMD_CAN_FORWARD, 1)


async def file_transfer(program: Program) -> None:
    """Request to open a file for writing (opcode 6)."""
    program.send("FILE_TRANSFER_PROTOCOL", payload=(1, 0, 0, 6, 4, 0, 0, 0, 0, 0, 0, 0, *b"/log"))
    await program.until(lambda: "FILE_TRANSFER_PROTOCOL" in program.latest)
    assert program.latest["FILE_TRANSFER_PROTOCOL"].array("payload")[3] == 129, "NAK"


async def spoofed_heartbeats(program: Program) -> None:
    """Send heartbeats as the autopilot and as the mobility service, which hold off or cause a failsafe."""
    for source in RESERVED_SOURCES:
        spoofed = Endpoint(*source).encode("HEARTBEAT", {"type": 18, "autopilot": 8, "system_status": 5})
        program.writer.write(spoofed * 3)


async def replayed_signed_frames(program: Program) -> None:
    """Replace the signing key, and replay frames that a station has signed."""
    program.send("SETUP_SIGNING", secret_key=tuple(range(32)), initial_timestamp=1)
    station = Endpoint(255, 190)
    station.set_signing(bytes(range(32)), 1000)
    end = {"target_system": 1, "target_component": 1, "command": mavlink.MAV_CMD_DO_FLIGHTTERMINATION, "param1": 1.0}
    signed = station.encode("COMMAND_LONG", end)
    assert signed[2] & mavlink.MAVLINK_IFLAG_SIGNED
    begun = len(program.received)
    program.writer.write(signed * 3)

    def results() -> list[int]:
        return [m.integer("result") for m in program.received[begun:] if m.name == "COMMAND_ACK"]

    await program.until(lambda: len(results()) == 3)
    assert set(results()) == {DENIED}


ATTACKS: dict[Callable[[Program], Awaitable[None]], set[str]] = {
    forced_arming: {"COMPONENT_ARM_DISARM"},
    forced_disarming: {"COMPONENT_ARM_DISARM"},
    flight_termination: {"DO_FLIGHTTERMINATION"},
    reboot: {"PREFLIGHT_REBOOT_SHUTDOWN"},
    failsafe_parameters: {"PARAM_SET"},
    serial_control: {"SERIAL_CONTROL"},
    remote_control: {"RC_CHANNELS_OVERRIDE"},
    bus_forwarding: {"CAN_FORWARD"},
    file_transfer: {"FILE_TRANSFER_PROTOCOL"},
    spoofed_heartbeats: {"HEARTBEAT"},
    replayed_signed_frames: {"SETUP_SIGNING", "DO_FLIGHTTERMINATION"},
}
"""Attacks, and the entries that each causes in the audit log."""


@pytest.mark.parametrize("attack", ATTACKS)
def test_attack_in_flight_is_refused_and_audited_and_the_flight_continues(
    tmp_path: Path, attack: Callable[[Program], Awaitable[None]]
) -> None:
    async def flight(world: GatewayWorld) -> None:
        grant = world.drone.grants.put(mavlink_spec())
        program = await world.program(grant.identity)
        await program.up(5.0)
        parameters = {name: world.sky.truth.params[name] for name in FAILSAFES}
        senders = world.tap()
        program.target(0, 15, 5.0)
        await program.until(lambda: program.place[1] > 2)
        await attack(program)
        await program.until(lambda: abs(program.place[1] - 15) < 1.0)
        assert world.sky.truth.armed
        assert program.mode == GUIDED
        assert {entry["message"] for entry in world.refused} == ATTACKS[attack]
        assert {name: world.sky.truth.params[name] for name in FAILSAFES} == parameters
        assert senders == {SERVICE}
        await program.close()

    fly(flight, tmp_path)


def test_service_and_autopilot_have_reserved_ids() -> None:
    assert {SERVICE, (1, 1)} == RESERVED_SOURCES


FUZZED = 100_000


def test_fuzzed_frames_disturb_no_flight_of_another_instance(tmp_path: Path) -> None:
    """Send frames over all connections of an instance, each at the rate at which the gateway reads."""

    async def flight(world: GatewayWorld) -> None:
        grant = world.drone.grants.put(mavlink_spec())
        program = await world.program(grant.identity)
        await program.up()
        senders = world.tap()
        attackers = [await world.program("spiffe://fractus.dev/ns/x/app/y/component/Z/instance/z") for _ in range(4)]

        async def attack(seed: int, attacker: Program) -> None:
            for frame in frames(seed, FUZZED // len(attackers)):
                attacker.writer.write(frame)
                await attacker.writer.drain()

        fuzzing = asyncio.gather(*(attack(seed, attacker) for seed, attacker in enumerate(attackers)))
        for number in range(60):
            if fuzzing.done():
                break
            goal = 10.0 if number % 2 else 0.0
            program.target(goal, 10.0)
            await program.until(lambda goal=goal: abs(program.place[0] - goal) < 1.0, 20.0)
        await fuzzing
        counts = values(metrics_text(world.gateway.metrics.collect()).decode())
        handled = sum(count for key, count in counts.items() if key[0] == "fractus_gateway_messages_total")
        assert handled > 0.7 * FUZZED, "all intact frames except those behind damaged ones, and replaced targets"
        assert program.mode == GUIDED
        assert not any(attacker.reader.at_eof() for attacker in attackers)
        assert senders == {SERVICE}
        for each in (program, *attackers):
            await each.close()

    fly(flight, tmp_path)

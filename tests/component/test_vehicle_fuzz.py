"""Fuzzing: valid frames with extreme contents and random bytes, in every phase of a flight."""

from __future__ import annotations

import math
import random
import struct

import pytest
from depth import examples
from fractus_runtime.mavlink_codec import Endpoint, message_class
from fractus_services.mavlink_server.mission_items import SUPPORTED
from fractus_vehicle.commands import HANDLERS as COMMAND_HANDLERS
from fractus_vehicle.copter import SUPPORTED_MODES
from fractus_vehicle.dispatch import HANDLERS
from fractus_vehicle.state import VehicleState
from mavlink_frames import values_of
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from vehicle_pilot import Pilot
from vehicle_world import airborne, alone

WILD = (math.nan, math.inf, -math.inf, 0.0, 1.0, -1.0, 2.0, 255.0, 1e38, -1e38, 1e-40, 21196.0, 400.0, 48.2)
COMMANDS = sorted(
    (SUPPORTED | COMMAND_HANDLERS.keys() | {mavlink.MAV_CMD_DO_PARACHUTE, 9999})
    - {mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN}
)


def _wild_frame(rng: random.Random, name: str) -> bytes:
    kind = message_class(name)
    values = values_of(kind, rng.randbytes(kind.unpacker.size))
    for field, value in values.items():
        if isinstance(value, float) and rng.random() < 0.7:
            values[field] = rng.choice(WILD)
        elif field in ("target_system", "target_component", "target"):
            values[field] = 1
        elif field == "command" and rng.random() < 0.9:
            values[field] = rng.choice(COMMANDS)
        elif field in ("coordinate_frame", "frame"):
            values[field] = rng.randrange(14)
        elif field == "type_mask":
            values[field] = rng.choice((0xDF8, 0xDC7, 0xFFF, 0x9F8, 0xE3F, rng.randrange(4096))) & (
                0xFF if name == "SET_ATTITUDE_TARGET" else 0xFFFF
            )
        elif field in ("mission_type", "current", "seq", "count", "custom_mode", "base_mode"):
            values[field] = rng.choice((0, 1, 2, 3, 5))
        elif field == "param_id":
            values[field] = rng.choice(
                (b"WPNAV_SPEED", b"PSC_JERK_XY", b"FENCE_TYPE", b"BATT_CAPACITY", rng.randbytes(16))
            )
    return Endpoint(255, 190).encode(name, values)


def _sane(vehicle: VehicleState) -> bool:
    body = vehicle.body
    numbers = (body.north, body.east, body.down, body.vn, body.ve, body.vd, *body.quaternion, body.p, body.q, body.r)
    return all(math.isfinite(number) and abs(number) < 1e7 for number in numbers)


@pytest.mark.parametrize("seed", range(examples(6, 2)))
def test_random_valid_frames_do_not_break_vehicle(seed: int):
    rng = random.Random(seed)
    vehicle, pilot = airborne(10.0) if seed % 2 else alone()
    names = sorted(name for name in HANDLERS if name != "SETUP_SIGNING")
    for _ in range(2500):
        pilot.craft.receive(pilot.channel, _wild_frame(rng, rng.choice(names)))
        if rng.random() < 0.3:
            pilot.step()
        if rng.random() < 0.01:
            _restart(vehicle, pilot, rng)
    assert _sane(vehicle)
    pilot.read()
    assert pilot.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 0) == 0


def _restart(vehicle: VehicleState, pilot: Pilot, rng: random.Random) -> None:
    """Put the vehicle back into the air in a random mode. All modes are tested in this way."""
    if not vehicle.armed:
        pilot.craft.vehicle.arm()
    pilot.craft.vehicle.modes.force(rng.choice(sorted(SUPPORTED_MODES)))
    vehicle.body.on_ground = False
    vehicle.landed = False
    vehicle.body.down = min(vehicle.body.down, -5.0)
    pilot.fly_on(0.5)


def test_every_command_survives_extreme_numbers():
    vehicle, pilot = airborne(10.0)
    for command in COMMANDS:
        for name in ("COMMAND_LONG", "COMMAND_INT"):
            for value in WILD:
                values = {f"param{at}": value for at in range(1, 5)}
                rest = {"x": 1, "y": 1, "z": value} if name == "COMMAND_INT" else {"param5": value, "param7": value}
                pilot.send(name, {"target_system": 1, "target_component": 1, "command": command} | values | rest)
                pilot.step()
    assert _sane(vehicle)


def test_random_bytes_are_ignored():
    rng = random.Random(9)
    vehicle, pilot = alone()
    for _ in range(2000):
        pilot.craft.receive(pilot.channel, rng.randbytes(rng.randrange(1, 300)))
    assert struct.calcsize("<B") == 1
    assert pilot.channel.parser.pending < 600
    assert not vehicle.armed

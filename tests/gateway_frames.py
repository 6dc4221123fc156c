"""Random frames for the gateway, most of them intact, and the properties of the calls that they cause."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator

from fractus_runtime.mavlink_codec import Endpoint, Value
from fractus_services.gateway.session import Call
from fractus_services.gateway.translate import CHECK_MISSION, FLY_MISSION
from fractus_services.mobility.rpc.gateway_socket import METHODS
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message as ProtobufMessage
from mavlink_frames import MESSAGE_CLASSES, MessageClass, frame_v1, frame_v2
from pymavlink.dialects.v20 import ardupilotmega as mavlink

INTACT = 0.9
"""Share of frames with a correct checksum."""

NUMBERS = (0.0, 1.0, -1.0, 4.0, 21196.0, 2989.0, 1e-30, 1e30, math.nan, math.inf, -math.inf)
_COMMANDS = tuple(mavlink.enums["MAV_CMD"])
_TARGETS = (
    mavlink.MAVLink_set_position_target_local_ned_message,
    mavlink.MAVLink_set_position_target_global_int_message,
    mavlink.MAVLink_mission_item_message,
    mavlink.MAVLink_mission_item_int_message,
)
_V1 = tuple(kind for kind in MESSAGE_CLASSES if kind.id <= 0xFF)


def frames(seed: int, count: int) -> Iterator[bytes]:
    """Yield random frames: commands and targets with unusual numbers, and all messages with random content."""
    rng = random.Random(seed)
    for _ in range(count):
        frame = _frame(rng)
        if rng.random() >= INTACT:
            at = rng.randrange(len(frame))
            frame = frame[:at] + bytes((frame[at] ^ rng.randrange(1, 256),)) + frame[at + 1 :]
        yield frame


def _frame(rng: random.Random) -> bytes:
    source = (rng.randrange(256), rng.randrange(256))
    choice = rng.random()
    if choice < 0.35:
        values = {f"param{number}": _number(rng) for number in range(1, 8)}
        command = rng.choice(_COMMANDS) if rng.random() < 0.9 else rng.randrange(0x10000)
        return Endpoint(*source).encode(
            "COMMAND_LONG", values | {"command": command, "target_system": rng.choice((0, 1))}
        )
    if choice < 0.5:
        kind = rng.choice(_TARGETS)
        return Endpoint(*source).encode(kind.msgname, _values(rng, kind))
    if choice < 0.6:
        kind = rng.choice(_V1)
        return frame_v1(kind, rng.randbytes(kind.unpacker.size))
    kind = rng.choice(MESSAGE_CLASSES)
    return frame_v2(kind, rng.randbytes(rng.randrange(kind.unpacker.size + 1)), source=source)


def _values(rng: random.Random, kind: MessageClass) -> dict[str, Value]:
    """Return the fields of a target for the vehicle, in all frames and with all masks."""
    values: dict[str, Value] = {
        name: _number(rng) if kind_of_field == "float" else rng.randrange(1 << 15)
        for name, kind_of_field in zip(kind.fieldnames, kind.fieldtypes, strict=True)
    }
    small = {"current": 5, "frame": 22, "coordinate_frame": 22, "target_system": 2, "target_component": 2}
    values |= {name: rng.randrange(bound) for name, bound in small.items() if name in values}
    values |= {name: rng.randrange(256) for name in ("autocontinue", "mission_type") if name in values}
    values |= {name: mavlink.MAV_CMD_NAV_WAYPOINT for name in ("command",) if name in values and rng.random() < 0.9}
    values |= {name: rng.randrange(1 << 12) for name in ("type_mask",) if name in values}
    return values


def _number(rng: random.Random) -> float:
    return rng.choice(NUMBERS) if rng.random() < 0.5 else rng.uniform(-200.0, 200.0)


def check_call(call: Call) -> None:
    """Check that a call is one that programs may make, with finite numbers and without force."""
    request = call.request
    if request.method in {FLY_MISSION, CHECK_MISSION}:
        return  # the mobility service judges the route of a mission before it is flown
    assert request.method in METHODS, request
    assert isinstance(request.message, METHODS[request.method]), request
    assert METHODS[request.method].FromString(request.message.SerializeToString()) is not None
    for number in _numbers(request.message):
        assert math.isfinite(number), request


def _numbers(message: ProtobufMessage) -> Iterator[float]:
    for field, value in message.ListFields():
        if field.type == FieldDescriptor.TYPE_MESSAGE:
            yield from _numbers(value)
        elif field.type in {FieldDescriptor.TYPE_DOUBLE, FieldDescriptor.TYPE_FLOAT}:
            yield value

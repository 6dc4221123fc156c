"""MAVLink frames with arbitrary payloads, built by hand from pymavlink's message definitions."""

from __future__ import annotations

import struct

from fractus_runtime.mavlink_codec import Parser, Value
from pymavlink.dialects.v20 import ardupilotmega as mavlink

MessageClass = type[mavlink.MAVLink_message]

MESSAGE_CLASSES: tuple[MessageClass, ...] = tuple(mavlink.mavlink_map[number] for number in sorted(mavlink.mavlink_map))
"""Every message of the dialect, by id."""


def frame_v2(
    kind: MessageClass, payload: bytes, *, sequence: int = 0, flags: int = 0, source: tuple[int, int] = (1, 1)
) -> bytes:
    """Return a MAVLink 2 frame with a payload of any length; the payload is sent as it is."""
    body = (
        struct.pack("<BBBBBBHB", len(payload), flags, 0, sequence, *source, kind.id & 0xFFFF, kind.id >> 16) + payload
    )
    return bytes((mavlink.PROTOCOL_MARKER_V2,)) + body + _checksum(kind, body)


def frame_v1(kind: MessageClass, payload: bytes) -> bytes:
    """Return a MAVLink 1 frame."""
    body = struct.pack("<BBBBB", len(payload), 0, 1, 1, kind.id) + payload
    return bytes((mavlink.PROTOCOL_MARKER_V1,)) + body + _checksum(kind, body)


def _checksum(kind: MessageClass, body: bytes) -> bytes:
    return struct.pack("<H", mavlink.x25crc(body + bytes((kind.crc_extra,))).crc)


def values_of(kind: MessageClass, payload: bytes) -> dict[str, Value]:
    """Return the field values that a payload encodes."""
    (message,) = Parser().feed(frame_v2(kind, payload))
    return dict(message.values)

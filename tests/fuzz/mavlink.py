"""Bytes of an autopilot, a ground station or a broken cable: the same messages however they are cut, and again as frames."""

from __future__ import annotations

import struct
import sys

import atheris

with atheris.instrument_imports(include=["fractus_mavlink"]):
    from fractus_mavlink import Message, Parser, encode, layout_of
    from fractus_mavlink.framing import MAGIC_V2
from fastcrc.crc16 import mcrf4xx

LAYOUTS = [layout for layout in map(layout_of, range(1 << 16)) if layout is not None]


def one(data: bytes) -> None:
    """Bytes as they are, and as the payload of a sound frame."""
    pieces(data)
    if len(data) > 2:
        layout = LAYOUTS[int.from_bytes(data[:2], "little") % len(LAYOUTS)]
        payload = data[2:257]
        body = (
            struct.pack("<BBBBBBHB", len(payload), 0, 0, 0, 1, 1, layout.msgid & 0xFFFF, layout.msgid >> 16) + payload
        )
        frame = bytes((MAGIC_V2,)) + body + struct.pack("<H", mcrf4xx(body + bytes((layout.crc_extra,))))
        for message in pieces(frame):
            again(message)


def pieces(data: bytes) -> list[Message]:
    """Messages of a stream: whole, in two parts and byte by byte."""
    whole, parts, single = Parser(), Parser(), Parser()
    messages = whole.feed(data)
    half = len(data) // 2
    assert repr(parts.feed(data[:half]) + parts.feed(data[half:])) == repr(messages)
    assert repr([m for i in range(len(data)) for m in single.feed(data[i : i + 1])]) == repr(messages)
    assert whole.pending <= 280, whole.pending
    return messages


def again(message: Message) -> None:
    """A message that was read can be sent, and is read as the same."""
    layout = layout_of(message.msgid)
    assert layout is not None
    frame = encode(layout, message.values, sequence=0, sysid=1, compid=1)
    (read,) = Parser().feed(frame)
    assert repr(read.values) == repr(message.values)


if __name__ == "__main__":
    atheris.Setup(sys.argv, one)
    atheris.Fuzz()

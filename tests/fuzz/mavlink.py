"""Bytes of an autopilot, a ground station or a broken cable: the same messages however they are cut, and again as frames.

Frames that are recorded are found in the tlog again while it grows, and none that was changed is believed on a signed link.
"""

from __future__ import annotations

import struct
import sys

import atheris

with atheris.instrument_imports(include=["fractus_mavlink", "fractus_cli.tlog_tail"]):
    from fractus_cli.tlog_tail import Tail, split
    from fractus_mavlink import Message, Parser, Signing, encode, layout_of
    from fractus_mavlink.framing import MAGIC_V2
from fastcrc.crc16 import mcrf4xx

LAYOUTS = [layout for layout in map(layout_of, range(1 << 16)) if layout is not None]
KEY = bytes(range(32))
STAMP = struct.pack(">Q", 1_790_000_000_000_000)
NAME = "000001-20260601T120000Z.tlog"


def one(data: bytes) -> None:
    """Bytes as they are, as a tlog, and as the payload of a sound frame."""
    pieces(data)
    tlog(data)
    if len(data) > 2:
        layout = LAYOUTS[int.from_bytes(data[:2], "little") % len(LAYOUTS)]
        payload = data[2:257]
        body = (
            struct.pack("<BBBBBBHB", len(payload), 0, 0, 0, 1, 1, layout.msgid & 0xFFFF, layout.msgid >> 16) + payload
        )
        frame = bytes((MAGIC_V2,)) + body + struct.pack("<H", mcrf4xx(body + bytes((layout.crc_extra,))))
        for message in pieces(frame):
            again(message)
        recorded(frame, data)
        signed(frame, data)


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


def tlog(data: bytes) -> None:
    """Any bytes as a part of a tlog: what is found is a part of it, and no more than a frame is kept for later."""
    frames, rest = split(data)
    assert all(one.data in data for one in frames)
    assert sum(len(STAMP) + len(one.data) for one in frames) + len(rest) <= len(data)
    assert len(rest) < len(STAMP) + 280, len(rest)


class Growing:
    """A tlog that is being written."""

    def __init__(self) -> None:
        self.data: bytes | None = None

    def sizes(self) -> dict[str, int]:
        return {} if self.data is None else {NAME: len(self.data)}

    def read(self, _name: str, offset: int) -> bytes:
        return (self.data or b"")[offset:]


def recorded(frame: bytes, cuts: bytes) -> None:
    """Records of a frame: each is found once, wherever the file ended when it was looked at."""
    whole, directory = (STAMP + frame) * 3, Growing()
    tail = Tail(directory)
    tail.read()
    found = []
    for end in sorted({*(cut * len(whole) // 255 for cut in cuts[:8]), len(whole)}):
        directory.data = whole[:end]
        found += tail.read()
    assert [one.data for one in found] == [frame] * 3, found


def signed(frame: bytes, data: bytes) -> None:
    """A frame as it was signed is believed once; one that was changed, or has no signature, never."""
    flagged = frame[:2] + b"\x01" + frame[3:-2]
    layout = layout_of(int.from_bytes(frame[7:10], "little"))
    assert layout is not None
    flagged += struct.pack("<H", mcrf4xx(flagged[1:] + bytes((layout.crc_extra,))))
    whole = Signing(KEY, 1000).sign(flagged)
    signing = Signing(KEY, 1000)
    parser = Parser(lambda: signing)
    at = int.from_bytes(data[:2], "big") % len(whole)
    bad = whole[:at] + bytes((whole[at] ^ (data[-1] or 1),)) + whole[at + 1 :]
    assert not [one for one in parser.feed(bad + bytes(300)) if one.signed]
    (read,) = (one for one in Parser(lambda: signing).feed(whole) if one.signed)
    assert read.frame == whole
    assert not [one for one in Parser(lambda: signing).feed(whole) if one.signed], "a replay"


if __name__ == "__main__":
    atheris.Setup(sys.argv, one)
    atheris.Fuzz()

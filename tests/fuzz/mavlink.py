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
    from fractus_mavlink.framing import MAGIC_V1, MAGIC_V2
    from fractus_mavlink.messages import Layout
from fastcrc.crc16 import mcrf4xx

LAYOUTS = [layout for layout in map(layout_of, range(1 << 16)) if layout is not None]
MAGICS = bytes((MAGIC_V1, MAGIC_V2))
KEY = bytes(range(32))
STAMP = struct.pack(">Q", 1_790_000_000_000_000)
NAME = "000001-20260601T120000Z.tlog"


def one(data: bytes) -> None:
    """Bytes as they are, as a tlog, and as the payload of sound frames."""
    pieces(data)
    tlog(data)
    if len(data) > 3:
        layout = LAYOUTS[int.from_bytes(data[:2], "little") % len(LAYOUTS)]
        # Any length: none at all, what a sender cuts off, what a newer dialect adds.
        payload = data[3 : 3 + data[2]]
        frame = framed(layout, payload)
        again(heard(frame, data))
        recorded(frame, data)
        signed(frame, data)
        if layout.msgid <= 0xFF:
            old = framed_v1(layout, payload)
            assert repr(heard(old, data).values) == repr(layout.unpack(payload))
            recorded(old, data)
            unsigned(old, layout)
        unsigned(frame, layout)


def framed(layout: Layout, payload: bytes) -> bytes:
    """A frame of MAVLink 2."""
    body = struct.pack("<BBBBBBHB", len(payload), 0, 0, 0, 1, 1, layout.msgid & 0xFFFF, layout.msgid >> 16) + payload
    return bytes((MAGIC_V2,)) + body + struct.pack("<H", mcrf4xx(body + bytes((layout.crc_extra,))))


def framed_v1(layout: Layout, payload: bytes) -> bytes:
    """A frame of MAVLink 1."""
    body = struct.pack("<BBBBB", len(payload), 0, 1, 1, layout.msgid) + payload
    return bytes((MAGIC_V1,)) + body + struct.pack("<H", mcrf4xx(body + bytes((layout.crc_extra,))))


def heard(frame: bytes, noise: bytes) -> Message:
    """A sound frame is one message, also behind bytes that begin none and before any."""
    (message,) = pieces(noise[:16].translate(None, MAGICS) + frame)
    (first, *_) = pieces(frame + noise[:16])
    assert message.frame == first.frame == frame
    return message


def unsigned(frame: bytes, layout: Layout) -> None:
    """A frame without a signature is not believed on a signed link, but of a modem that has no key."""
    signing = Signing(KEY, 1000)
    messages = Parser(lambda: signing).feed(frame)
    assert [one.name for one in messages] == ["RADIO_STATUS"] * (layout.name == "RADIO_STATUS")
    assert not any(one.signed for one in messages)


def pieces(data: bytes) -> list[Message]:
    """Messages of a stream: whole, in two parts and byte by byte; what is none is counted alike."""
    half = len(data) // 2
    outcomes, told = [], []
    for cuts in ([data[i : i + 1] for i in range(len(data))], [data[:half], data[half:]], [data]):
        foreign: list[bytes] = []
        parser = Parser(unknown=foreign.append)
        messages = [message for part in cuts for message in parser.feed(part)]
        assert parser.pending <= 280, parser.pending
        outcomes.append((repr(messages), parser.bad, parser.lost))
        told.append(foreign)
    assert outcomes[0] == outcomes[1] == outcomes[2], outcomes
    # While no byte is behind it, what ends as noise may be told as a frame of another dialect.
    assert {*told[2]} <= {*told[1]} <= {*told[0]}, told
    assert all(frame in data for frame in told[0])
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

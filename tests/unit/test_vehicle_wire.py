"""The MAVLink codec against pymavlink, which knows nothing of it."""

from __future__ import annotations

import hashlib
import random
import struct

import pymavlink.dialects.v20.ardupilotmega as dialect
import pytest
from fractus_vehicle import wire

IDS = sorted(number for number in dialect.mavlink_map if number >= 0)


def _random_values(layout: wire.Layout, rng: random.Random) -> dict[str, wire.Value]:
    formats = layout.packer.format.lstrip("<")
    values: dict[str, wire.Value] = {}
    position = 0

    def scalar(code: str) -> wire.Scalar:
        if code in "fd":
            return struct.unpack("<f", struct.pack("<f", rng.uniform(-1000, 1000)))[0]
        bits = {"b": 8, "B": 8, "h": 16, "H": 16, "i": 32, "I": 32, "q": 64, "Q": 64}[code]
        low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if code.islower() else (0, (1 << bits) - 1)
        return rng.randint(low, high)

    for name, count in zip(layout.fields, layout.counts, strict=True):
        digits = ""
        while formats[position].isdigit():
            digits += formats[position]
            position += 1
        code = formats[position]
        position += 1
        if count == 0:
            values[name] = bytes(rng.choices(b"ABCDEFGH", k=int(digits)))
        elif count == 1:
            values[name] = scalar(code)
        else:
            values[name] = tuple(scalar(code) for _ in range(count))
    return values


def test_table_has_every_message_of_the_dialect():
    for number in IDS:
        theirs = dialect.mavlink_map[number]
        ours = wire.layout_of(number)
        assert ours is not None
        assert (ours.name, ours.crc_extra) == (theirs.msgname, theirs.crc_extra)
        assert list(ours.fields) == theirs.ordered_fieldnames
        assert ours.packer.size == theirs.unpacker.size
    assert wire.layout_of(max(IDS) + 1) is None


@pytest.mark.parametrize("seed", [1, 2])
def test_pymavlink_reads_what_we_write_and_back(seed: int):
    rng = random.Random(seed)
    theirs = dialect.MAVLink(None, srcSystem=7, srcComponent=8)
    theirs.robust_parsing = False
    parser = wire.Parser()
    for number in IDS:
        layout = wire.layout_of(number)
        assert layout is not None
        values = _random_values(layout, rng)
        frame = wire.encode(layout, values, sequence=number & 0xFF, sysid=7, compid=8)
        message = theirs.parse_buffer(frame)[0]
        assert message.get_type() == layout.name
        again = message.pack(theirs)
        (ours,) = parser.feed(bytes(again))
        assert ours.values == values, layout.name
        assert (ours.sysid, ours.compid) == (7, 8)


def test_mavlink_1_is_understood():
    theirs = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
    frame = dialect.MAVLink_heartbeat_message(6, 8, 0, 4, 3, 3).pack(theirs, force_mavlink1=True)
    assert frame[0] == wire.MAGIC_V1
    (message,) = wire.Parser().feed(bytes(frame))
    assert message.name == "HEARTBEAT"
    assert message.integer("custom_mode") == 4


def test_frames_survive_any_fragmentation_between_garbage():
    rng = random.Random(3)
    layout = wire.layout_named("ATTITUDE")
    frames = [wire.encode(layout, {"time_boot_ms": at}, sequence=at, sysid=1, compid=1) for at in range(50)]
    stream = b"".join(bytes(rng.choices(range(0xFD), k=rng.randrange(9))) + frame for frame in frames)
    parser = wire.Parser()
    seen = []
    while stream:
        cut = rng.randrange(1, 40)
        seen += parser.feed(stream[:cut])
        stream = stream[cut:]
    assert [message.integer("time_boot_ms") for message in seen] == list(range(50))
    assert parser.lost == 0


def test_damaged_frames_are_dropped_and_memory_stays_bounded():
    rng = random.Random(4)
    parser = wire.Parser()
    layouts = [wire.layout_of(number) for number in IDS]
    for _ in range(10_000):
        layout = rng.choice(layouts)
        assert layout is not None
        frame = bytearray(wire.encode(layout, {}, sequence=0, sysid=1, compid=1))
        if rng.random() < 0.5:
            frame[rng.randrange(1, len(frame))] ^= 1 << rng.randrange(8)
        else:
            del frame[rng.randrange(1, len(frame)) :]
        parser.feed(bytes(frame))
        assert parser.pending <= 280 + len(frame)
    assert parser.bad > 1000


def test_a_flipped_bit_never_passes():
    layout = wire.layout_named("COMMAND_LONG")
    frame = wire.encode(layout, {"command": 400, "param1": 1.0}, sequence=0, sysid=255, compid=190)
    for bit in range(8, len(frame) * 8):
        damaged = bytearray(frame)
        damaged[bit // 8] ^= 1 << bit % 8
        assert [m for m in wire.Parser().feed(bytes(damaged)) if m.name == "COMMAND_LONG"] == []


def test_signatures_interoperate_with_pymavlink():
    key = hashlib.sha256(b"secret").digest()
    theirs = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
    theirs.signing.secret_key = key
    theirs.signing.sign_outgoing = True
    theirs.signing.timestamp = 1000
    signing = wire.Signing(key, 1000)
    parser = wire.Parser(lambda: signing)
    frame = bytes(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 3, 3).pack(theirs))
    (message,) = parser.feed(frame)
    assert message.signed
    assert parser.feed(frame) == [], "a replay must not pass"
    unsigned = wire.encode(wire.layout_named("HEARTBEAT"), {}, sequence=0, sysid=255, compid=190)
    assert parser.feed(unsigned) == []
    answer = wire.encode(wire.layout_named("HEARTBEAT"), {}, sequence=0, sysid=1, compid=1, signing=signing)
    (theirs_read,) = theirs.parse_buffer(answer)
    assert theirs_read.get_signed()
    stranger = wire.Signing(hashlib.sha256(b"other").digest(), 10**9)
    forged = wire.encode(wire.layout_named("HEARTBEAT"), {}, sequence=0, sysid=255, compid=190, signing=stranger)
    assert parser.feed(forged) == []


def test_a_refused_frame_does_not_delay_the_next():
    key = hashlib.sha256(b"secret").digest()
    signing = wire.Signing(key, 1000)
    parser = wire.Parser(lambda: signing)
    # The unsigned frame holds a byte that looks like the start of a long frame.
    unsigned = wire.encode(
        wire.layout_named("HEARTBEAT"), {"custom_mode": 0xFDFD}, sequence=0xFD, sysid=255, compid=190
    )
    sender = wire.Signing(key, 2000)
    good = wire.encode(wire.layout_named("HEARTBEAT"), {}, sequence=1, sysid=255, compid=190, signing=sender)
    assert parser.feed(unsigned) == []
    assert [message.name for message in parser.feed(good)] == ["HEARTBEAT"]
    unknown = bytearray(wire.encode(wire.layout_named("HEARTBEAT"), {}, sequence=2, sysid=255, compid=190))
    unknown[7:10] = (60_000).to_bytes(3, "little")
    parser = wire.Parser()
    again = wire.encode(wire.layout_named("HEARTBEAT"), {}, sequence=3, sysid=255, compid=190)
    assert [message.name for message in parser.feed(bytes(unknown) + again)] == ["HEARTBEAT"]

"""The MAVLink codec against pymavlink, which knows nothing of it."""

from __future__ import annotations

import hashlib
import math
import random
import struct

import pymavlink.dialects.v20.ardupilotmega as dialect
import pytest
from fractus_mavlink import (
    Endpoint,
    Parser,
    Scalar,
    Signing,
    UnknownMessageError,
    Value,
    encode,
    enums,
    layout_named,
    layout_of,
    message,
)
from fractus_mavlink.framing import MAGIC_V1
from fractus_mavlink.generate import PACKAGE, generate
from fractus_mavlink.messages import Layout

IDS = sorted(number for number in dialect.mavlink_map if number >= 0)
BEYOND = {80: ("COMMAND_CANCEL", 14), 336: ("CELLULAR_CONFIG", 245), 420: ("RADIO_RC_CHANNELS", 20)}
"""Messages of upstream MAVLink that ArduPilot does not define, with the CRC seeds that others publish."""

UPSTREAM = {
    "MAV_RESULT": {6: "MAV_RESULT_CANCELLED", 9: "MAV_RESULT_COMMAND_UNSUPPORTED_MAV_FRAME"},
    "MAV_CMD": {
        610: "MAV_CMD_DO_SET_SYS_CMP_ID",
        611: "MAV_CMD_DO_SET_GLOBAL_ORIGIN",
        2020: "MAV_CMD_CAMERA_START_MTI",
        5005: "MAV_CMD_NAV_FENCE_HOME_CIRCLE_INCLUSION",
    },
}

POLICED = (
    0, 2, 5, 7, 11, 23, 33, 38, 39, 41, 44, 45, 48, 50, 54, 66, 69, 70, 73, 75, 76, 80, 81, 82, 84, 86, 90, 91, 92, 93, 100,
    101, 102, 103, 104, 106, 107, 110, 113, 114, 115, 121, 123, 126, 132, 134, 138, 139, 144, 147, 149, 151, 154, 155, 156,
    157, 160, 175, 201, 232, 233, 243, 246, 247, 248, 251, 252, 256, 282, 284, 287, 288, 296, 299, 323, 330, 331, 332, 333,
    336, 385, 386, 387, 388, 420, 11000, 11002, 11004, 11011, 11037,
)  # fmt: skip
"""Ids with which an application could move, reconfigure or blind a drone: a gateway must be able to read them."""


def _random_values(layout: Layout, rng: random.Random) -> dict[str, Value]:
    formats = layout.packer.format.lstrip("<")
    values: dict[str, Value] = {}
    position = 0

    def scalar(code: str) -> Scalar:
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
        ours = layout_of(number)
        assert ours is not None
        assert (ours.name, ours.crc_extra) == (theirs.msgname, theirs.crc_extra)
        assert list(ours.fields) == theirs.ordered_fieldnames
        assert ours.packer.size == theirs.unpacker.size
    assert layout_of(max(IDS) + 1) is None
    assert {number: (layout.name, layout.crc_extra) for number in BEYOND if (layout := layout_of(number))} == BEYOND


def test_everything_that_a_gateway_must_judge_is_understood():
    assert [number for number in POLICED if layout_of(number) is None] == []


def test_generated_tables_are_those_of_the_dialect():
    for file, text in generate().items():
        assert (PACKAGE / file).read_text(encoding="ascii") == text, f"{file}: run make generate"


def test_enumerations_are_pymavlinks():
    checked = 0
    for name, theirs in dialect.enums.items():
        ours = getattr(enums, name, None)
        if ours is not None:
            known = {number: entry.name for number, entry in theirs.items() if not entry.name.endswith("_ENUM_END")}
            known |= UPSTREAM.get(name, {})
            assert {int(member) for member in ours.__members__.values()} == known.keys(), name
            assert all(known[member].endswith(member.name.removeprefix("TYPE_")) for member in ours)
            checked += 1
    assert checked > 30


def test_fields_that_do_not_exist_and_values_that_do_not_fit_are_mistakes():
    with pytest.raises(TypeError, match="COMMAND_LONG has no field altitude"):
        message("COMMAND_LONG", altitude=3)
    with pytest.raises(UnknownMessageError, match="COMMAND_SHORT"):
        message("COMMAND_SHORT")
    wild: dict[str, Value] = {"x": 1 << 40, "z": 1e39, "command": -1, "param1": math.inf}
    with pytest.raises((struct.error, OverflowError)):
        Endpoint(1, 1).encode("COMMAND_INT", wild)
    (sent,) = Parser().feed(Endpoint(1, 1, saturate=True).encode("COMMAND_INT", wild))
    assert (sent.integer("x"), sent.integer("command"), sent.real("param1")) == ((1 << 31) - 1, 0, math.inf)
    assert sent.real("z") == pytest.approx(3.4028234e38)


def test_trailing_zeroes_are_cut_and_filled_in_again():
    theirs = dialect.MAVLink(None, srcSystem=7, srcComponent=8)
    for sent in (message("HEARTBEAT"), message("STATUSTEXT", severity=3), message("COMMAND_ACK", command=400)):
        frame = Endpoint(7, 8).encode(sent.name, sent.values)
        assert frame == bytes(theirs.parse_buffer(frame)[0].pack(theirs))
        (read,) = Endpoint(1, 1).decode(frame)
        assert {
            name: read.text(name) if isinstance(value, bytes) else value for name, value in read.values.items()
        } == {name: "" if isinstance(value, bytes) else value for name, value in sent.values.items()}
        theirs.seq = 0


def test_endpoints_count_what_is_lost():
    sender, receiver = Endpoint(1, 1), Endpoint(2, 1)
    frames = [sender.encode("HEARTBEAT", {}) for _ in range(260)]
    assert [frame[4] for frame in frames] == [at % 256 for at in range(260)]
    receiver.decode(b"".join(frames[:10] + frames[12:]))
    assert receiver.parser.lost == 2


@pytest.mark.parametrize("seed", [1, 2])
def test_pymavlink_reads_what_we_write_and_back(seed: int):
    rng = random.Random(seed)
    theirs = dialect.MAVLink(None, srcSystem=7, srcComponent=8)
    theirs.robust_parsing = False
    parser = Parser()
    for number in IDS:
        layout = layout_of(number)
        assert layout is not None
        values = _random_values(layout, rng)
        frame = encode(layout, values, sequence=number & 0xFF, sysid=7, compid=8)
        message = theirs.parse_buffer(frame)[0]
        assert message.get_type() == layout.name
        again = message.pack(theirs)
        (ours,) = parser.feed(bytes(again))
        assert ours.values == values, layout.name
        assert (ours.sysid, ours.compid) == (7, 8)


def test_mavlink_1_is_understood():
    theirs = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
    frame = dialect.MAVLink_heartbeat_message(6, 8, 0, 4, 3, 3).pack(theirs, force_mavlink1=True)
    assert frame[0] == MAGIC_V1
    (message,) = Parser().feed(bytes(frame))
    assert message.name == "HEARTBEAT"
    assert message.integer("custom_mode") == 4


def test_frames_survive_any_fragmentation_between_garbage():
    rng = random.Random(3)
    layout = layout_named("ATTITUDE")
    frames = [encode(layout, {"time_boot_ms": at}, sequence=at, sysid=1, compid=1) for at in range(50)]
    stream = b"".join(bytes(rng.choices(range(0xFD), k=rng.randrange(9))) + frame for frame in frames)
    parser = Parser()
    seen = []
    while stream:
        cut = rng.randrange(1, 40)
        seen += parser.feed(stream[:cut])
        stream = stream[cut:]
    assert [message.integer("time_boot_ms") for message in seen] == list(range(50))
    assert parser.lost == 0


def test_damaged_frames_are_dropped_and_memory_stays_bounded():
    rng = random.Random(4)
    parser = Parser()
    layouts = [layout_of(number) for number in IDS]
    for _ in range(10_000):
        layout = rng.choice(layouts)
        assert layout is not None
        frame = bytearray(encode(layout, {}, sequence=0, sysid=1, compid=1))
        if rng.random() < 0.5:
            frame[rng.randrange(1, len(frame))] ^= 1 << rng.randrange(8)
        else:
            del frame[rng.randrange(1, len(frame)) :]
        parser.feed(bytes(frame))
        assert parser.pending <= 280 + len(frame)
    assert parser.bad > 1000


def test_a_flipped_bit_never_passes():
    layout = layout_named("COMMAND_LONG")
    frame = encode(layout, {"command": 400, "param1": 1.0}, sequence=0, sysid=255, compid=190)
    for bit in range(8, len(frame) * 8):
        damaged = bytearray(frame)
        damaged[bit // 8] ^= 1 << bit % 8
        assert [m for m in Parser().feed(bytes(damaged)) if m.name == "COMMAND_LONG"] == []


def test_signatures_interoperate_with_pymavlink():
    key = hashlib.sha256(b"secret").digest()
    theirs = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
    theirs.signing.secret_key = key
    theirs.signing.sign_outgoing = True
    theirs.signing.timestamp = 1000
    signing = Signing(key, 1000)
    parser = Parser(lambda: signing)
    frame = bytes(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 3, 3).pack(theirs))
    (message,) = parser.feed(frame)
    assert message.signed
    assert parser.feed(frame) == [], "a replay must not pass"
    unsigned = encode(layout_named("HEARTBEAT"), {}, sequence=0, sysid=255, compid=190)
    assert parser.feed(unsigned) == []
    answer = encode(layout_named("HEARTBEAT"), {}, sequence=0, sysid=1, compid=1, signing=signing)
    (theirs_read,) = theirs.parse_buffer(answer)
    assert theirs_read.get_signed()
    stranger = Signing(hashlib.sha256(b"other").digest(), 10**9)
    forged = encode(layout_named("HEARTBEAT"), {}, sequence=0, sysid=255, compid=190, signing=stranger)
    assert parser.feed(forged) == []


@pytest.mark.parametrize("behind", [b"", b"\x00", b"noise"])
def test_a_message_inside_of_what_looked_like_a_frame_is_found_however_bytes_arrive(behind):
    inner = encode(layout_named("HEARTBEAT"), {"custom_mode": 7}, sequence=0, sysid=1, compid=1)
    # A MAVLink 1 header of a message that is in no dialect, as noise has it.
    noise = bytes((0xFE, len(inner), 0, 1, 1, 60)) + inner + b"\x00\x00"
    other = encode(layout_named("ATTITUDE"), {}, sequence=1, sysid=1, compid=1)
    for cut in range(1, len(noise) + len(behind)):
        heard = []
        parser = Parser(unknown=heard.append)
        data = noise + behind
        found = parser.feed(data[:cut]) + parser.feed(data[cut:]) + parser.feed(other)
        assert [message.name for message in found] == (["HEARTBEAT"] if behind else []) + ["ATTITUDE"], cut
        assert heard == ([noise] if not behind or cut == len(noise) else []), cut
        assert parser.bad >= 1


def test_a_refused_frame_does_not_delay_the_next():
    key = hashlib.sha256(b"secret").digest()
    signing = Signing(key, 1000)
    parser = Parser(lambda: signing)
    # The unsigned frame holds a byte that looks like the start of a long frame.
    unsigned = encode(layout_named("HEARTBEAT"), {"custom_mode": 0xFDFD}, sequence=0xFD, sysid=255, compid=190)
    sender = Signing(key, 2000)
    good = encode(layout_named("HEARTBEAT"), {}, sequence=1, sysid=255, compid=190, signing=sender)
    assert parser.feed(unsigned) == []
    assert [message.name for message in parser.feed(good)] == ["HEARTBEAT"]
    unknown = bytearray(encode(layout_named("HEARTBEAT"), {}, sequence=2, sysid=255, compid=190))
    unknown[7:10] = (60_000).to_bytes(3, "little")
    parser = Parser()
    again = encode(layout_named("HEARTBEAT"), {}, sequence=3, sysid=255, compid=190)
    assert [message.name for message in parser.feed(bytes(unknown) + again)] == ["HEARTBEAT"]

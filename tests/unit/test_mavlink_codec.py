"""MAVLink codec: messages are encoded by name, and the parser raises no error for any bytes."""

from __future__ import annotations

import hashlib
import math
import random
import struct

import pytest
from fractus_runtime.mavlink_codec import (
    MAX_FRAME_LENGTH,
    Endpoint,
    Message,
    Parser,
    Scalar,
    UnknownMessageError,
    Value,
    enum_name,
    enum_names,
    message,
)
from hypothesis import given
from hypothesis import strategies as st
from mavlink_frames import MESSAGE_CLASSES, MessageClass, frame_v1, frame_v2
from pymavlink.dialects.v10 import ardupilotmega as v10
from pymavlink.dialects.v20 import ardupilotmega as mavlink

KEY = hashlib.sha256(b"secret").digest()
FOREIGN_KEY = hashlib.sha256(b"other").digest()
FRAME_STARTS = bytes((mavlink.PROTOCOL_MARKER_V1, mavlink.PROTOCOL_MARKER_V2))


def heartbeat(custom_mode: int = 0) -> bytes:
    return Endpoint(1, 1).encode("HEARTBEAT", {"custom_mode": custom_mode})


def signing_endpoint(key: bytes, timestamp: int, sysid: int = 255) -> Endpoint:
    endpoint = Endpoint(sysid, 190)
    endpoint.set_signing(key, timestamp)
    return endpoint


def random_values(kind: MessageClass, rng: random.Random) -> dict[str, Value]:
    def scalar(type_: str) -> Scalar:
        if type_ in {"float", "double"}:
            return float(struct.unpack("<f", struct.pack("<f", rng.uniform(-1000, 1000)))[0])
        bits = int(type_.removeprefix("u").removeprefix("int").removesuffix("_t"))
        return rng.randrange(1 << bits) if type_.startswith("u") else rng.randrange(-(1 << bits - 1), 1 << bits - 1)

    lengths = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
    values: dict[str, Value] = {}
    for name, type_ in zip(kind.fieldnames, kind.fieldtypes, strict=True):
        if type_ == "char":
            values[name] = bytes(rng.choices(b"ABCDEFGH", k=lengths[name]))
        elif lengths[name]:
            values[name] = tuple(scalar(type_) for _ in range(lengths[name]))
        else:
            values[name] = scalar(type_)
    return values


def test_unknown_message_or_field_raises() -> None:
    with pytest.raises(TypeError, match="COMMAND_LONG has no field altitude"):
        message("COMMAND_LONG", altitude=3)
    with pytest.raises(UnknownMessageError, match="COMMAND_SHORT"):
        message("COMMAND_SHORT")
    with pytest.raises(UnknownMessageError, match="COMMAND_SHORT"):
        Endpoint(1, 1).encode("COMMAND_SHORT", {})


def test_value_that_does_not_fit_raises_or_saturates() -> None:
    wild: dict[str, Value] = {"x": 1 << 40, "z": 1e39, "command": -1, "param1": math.inf}
    with pytest.raises((struct.error, OverflowError)):
        Endpoint(1, 1).encode("COMMAND_INT", wild)
    (received,) = Parser().feed(Endpoint(1, 1, saturate=True).encode("COMMAND_INT", wild))
    assert (received.integer("x"), received.integer("command"), received.real("param1")) == ((1 << 31) - 1, 0, math.inf)
    assert received.real("z") == pytest.approx(3.4028234e38)


def test_sequence_numbers_count_up_and_wrap() -> None:
    sender = Endpoint(1, 1)
    assert [sender.encode("HEARTBEAT", {})[4] for _ in range(260)] == [number % 256 for number in range(260)]


def test_trailing_zeros_are_cut_and_restored() -> None:
    frame = Endpoint(7, 8).encode("STATUSTEXT", {"severity": 3, "text": b"low battery"})
    assert len(frame) == mavlink.HEADER_LEN_V2 + 12 + 2
    (received,) = Parser().feed(frame)
    assert received.values == message("STATUSTEXT", severity=3, text=b"low battery").values
    (empty,) = Parser().feed(Endpoint(7, 8).encode("HEARTBEAT", {}))
    assert empty.values == message("HEARTBEAT").values


@pytest.mark.parametrize("seed", [1, 2])
def test_every_message_of_the_dialect_survives_encoding_and_decoding(seed: int) -> None:
    rng = random.Random(seed)
    sender = Endpoint(7, 8)
    parser = Parser()
    for kind in MESSAGE_CLASSES:
        values = random_values(kind, rng)
        (received,) = parser.feed(sender.encode(kind.msgname, values))
        assert received.values == values, kind.msgname
        assert (received.name, received.msgid, received.sysid, received.compid) == (kind.msgname, kind.id, 7, 8)
    assert parser.bad == 0


def test_short_arrays_are_filled_with_zeros() -> None:
    (received,) = Parser().feed(Endpoint(1, 1).encode("BATTERY_STATUS", {"voltages": (12_000, 11_900)}))
    assert received.array("voltages") == (12_000, 11_900) + (0,) * 8


def test_not_a_number_survives_encoding_and_decoding() -> None:
    (received,) = Parser().feed(Endpoint(1, 1).encode("COMMAND_LONG", {"param1": math.nan, "param2": -math.inf}))
    assert math.isnan(received.real("param1"))
    assert received.real("param2") == -math.inf


@pytest.mark.parametrize(
    ("raw", "text"),
    [(b"ARMING_CHECK", "ARMING_CHECK"), (b"SIXTEEN_LETTERS_", "SIXTEEN_LETTERS_"), (b"A\0B", "A"), (b"\xff\xfe", "��")],
)
def test_text_ends_at_its_first_nul_and_is_always_valid(raw: bytes, text: str) -> None:
    (received,) = Parser().feed(Endpoint(1, 1).encode("PARAM_VALUE", {"param_id": raw}))
    assert received.text("param_id") == text


def test_mavlink_1_is_decoded() -> None:
    payload = struct.pack("<IBBBBB", 4, 6, 8, 0, 3, 3)
    (received,) = Parser().feed(frame_v1(mavlink.MAVLink_heartbeat_message, payload))
    assert (received.name, received.integer("custom_mode"), received.integer("type")) == ("HEARTBEAT", 4, 6)


@pytest.mark.parametrize("kind", [kind for kind in MESSAGE_CLASSES if kind.id in v10.mavlink_map])
def test_mavlink_1_frame_contains_no_extension_fields(kind: MessageClass) -> None:
    endpoint = Endpoint(1, 1)
    endpoint.mavlink1 = True
    values = random_values(kind, random.Random(kind.id))
    frame = endpoint.encode(kind.msgname, values)
    receiver = v10.MAVLink(None)
    decoded = receiver.decode(bytearray(frame))
    assert decoded.get_type() == kind.msgname
    assert len(frame) == 8 + v10.mavlink_map[kind.id].unpacker.size
    (message,) = Parser().feed(frame)
    base = v10.mavlink_map[kind.id].fieldnames
    assert {name: message.values[name] for name in base} == {name: values[name] for name in base}


@pytest.mark.parametrize("length", [0, 1, 8, 9, 20, 255])
def test_payload_of_another_length_than_defined_is_decoded(length: int) -> None:
    """Payloads are shorter if the sender cuts trailing zeros, and longer if a newer dialect has more fields."""
    payload = bytes(range(1, 256))[:length]
    (received,) = Parser().feed(frame_v2(mavlink.MAVLink_heartbeat_message, payload))
    assert received.integer("custom_mode") == int.from_bytes(payload[:4], "little")


def test_fragmented_frames_between_garbage_are_decoded() -> None:
    rng = random.Random(3)
    sender = Endpoint(1, 1)
    frames = [sender.encode("ATTITUDE", {"time_boot_ms": number}) for number in range(50)]
    stream = b"".join(bytes(rng.choices(range(0xFD), k=rng.randrange(9))) + frame for frame in frames)
    parser = Parser()
    received = []
    while stream:
        cut = rng.randrange(1, 40)
        received += parser.feed(stream[:cut])
        stream = stream[cut:]
    assert [message.integer("time_boot_ms") for message in received] == list(range(50))


@pytest.mark.parametrize("length", [0, 2, 30, 60, 100, 255])
def test_frames_after_a_damaged_length_byte_are_decoded(length: int) -> None:
    """Unlike this parser, the parser of pymavlink loses the frames after the damaged byte."""
    damaged = bytearray(heartbeat(99))
    damaged[1] = length
    intact = [heartbeat(number) for number in range(20)]
    parser = Parser()
    received = parser.feed(bytes(damaged) + b"".join(intact))
    assert [message.integer("custom_mode") for message in received] == list(range(20))
    assert parser.bad >= 1


def test_frame_after_a_truncated_frame_is_decoded() -> None:
    whole = Endpoint(1, 1).encode("ATTITUDE", {"yaw": 1.0})
    for length in range(1, len(whole)):
        # The zeros make the stream longer than the length that the truncated header announces.
        received = Parser().feed(whole[:length] + heartbeat(7) * 3 + bytes(300))
        assert [message.integer("custom_mode") for message in received] == [7, 7, 7], length


def test_damaged_frames_are_dropped_and_memory_stays_bounded() -> None:
    rng = random.Random(4)
    parser = Parser()
    for _ in range(10_000):
        frame = bytearray(Endpoint(1, 1).encode(rng.choice(MESSAGE_CLASSES).msgname, {}))
        if rng.random() < 0.5:
            frame[rng.randrange(1, len(frame))] ^= 1 << rng.randrange(8)
        else:
            del frame[rng.randrange(1, len(frame)) :]
        parser.feed(bytes(frame))
        assert parser.pending <= MAX_FRAME_LENGTH
    assert parser.bad > 1000


def test_large_input_without_frames_leaves_nothing_behind() -> None:
    parser = Parser()
    assert parser.feed(bytes(1_000_000)) == []
    assert parser.pending == 0
    assert parser.feed(bytes((0xFD,)) * 100_000) == []
    assert parser.pending <= MAX_FRAME_LENGTH
    assert [message.name for message in parser.feed(bytes(300) + heartbeat())] == ["HEARTBEAT"]


def test_frame_with_a_flipped_bit_is_never_accepted() -> None:
    frame = Endpoint(255, 190).encode("COMMAND_LONG", {"command": 400, "param1": 1.0})
    for bit in range(8, len(frame) * 8):
        damaged = bytearray(frame)
        damaged[bit // 8] ^= 1 << bit % 8
        assert [m for m in Parser().feed(bytes(damaged)) if m.name == "COMMAND_LONG"] == []


def test_unknown_incompatibility_flag_is_refused() -> None:
    parser = Parser()
    assert parser.feed(frame_v2(mavlink.MAVLink_heartbeat_message, bytes(9), flags=0x02)) == []
    assert parser.bad >= 1


@given(
    st.lists(
        st.one_of(
            st.binary(max_size=40),
            st.sampled_from([*(bytes((start,)) for start in FRAME_STARTS), heartbeat(), heartbeat(1)[:-3]]),
            st.builds(
                lambda start, rest: bytes((start,)) + rest, st.sampled_from(FRAME_STARTS), st.binary(max_size=300)
            ),
        ),
        max_size=8,
    ),
    st.booleans(),
)
def test_decoded_messages_do_not_depend_on_the_division_of_the_stream(chunks: list[bytes], signed: bool) -> None:
    def parse(parts: list[bytes]) -> tuple[list[Message], int]:
        endpoint = signing_endpoint(KEY, 1000) if signed else Endpoint(1, 1)
        messages = [message for part in parts for message in endpoint.decode(part)]
        assert endpoint.parser.pending <= MAX_FRAME_LENGTH
        return messages, endpoint.parser.bad

    stream = b"".join(chunks)
    assert repr(parse([stream])) == repr(parse(chunks)) == repr(parse([stream[i : i + 1] for i in range(len(stream))]))


def test_only_frames_signed_with_the_key_are_accepted_while_signing_is_enabled() -> None:
    receiver = signing_endpoint(KEY, 1000, sysid=1)
    frame = signing_endpoint(KEY, 1000).encode("HEARTBEAT", {})
    (received,) = receiver.decode(frame)
    assert received.signed
    assert receiver.decode(frame) == [], "a replayed frame is refused"
    assert receiver.decode(Endpoint(255, 190).encode("HEARTBEAT", {})) == [], "a frame without signature is refused"
    assert receiver.decode(signing_endpoint(FOREIGN_KEY, 2000).encode("HEARTBEAT", {})) == [], (
        "a frame that is signed with another key is refused"
    )
    (answer,) = signing_endpoint(KEY, 1000).decode(receiver.encode("HEARTBEAT", {}))
    assert answer.signed


def test_modem_status_needs_no_signature() -> None:
    receiver = signing_endpoint(KEY, 1000, sysid=1)
    (received,) = receiver.decode(Endpoint(51, 68).encode("RADIO_STATUS", {"rssi": 200}))
    assert (received.name, received.signed) == ("RADIO_STATUS", False)


def test_forged_signature_with_a_late_timestamp_does_not_block_the_sender() -> None:
    receiver = signing_endpoint(KEY, 1000, sysid=1)
    sender = signing_endpoint(KEY, 1000)
    assert receiver.decode(signing_endpoint(FOREIGN_KEY, 10**9).encode("HEARTBEAT", {})) == []
    assert len(receiver.decode(sender.encode("HEARTBEAT", {}))) == 1
    assert receiver.decode(signing_endpoint(FOREIGN_KEY, 10**9).encode("HEARTBEAT", {})) == []
    assert len(receiver.decode(sender.encode("HEARTBEAT", {}))) == 1


def test_every_frame_is_accepted_after_signing_is_disabled() -> None:
    receiver = signing_endpoint(KEY, 1000, sysid=1)
    receiver.set_signing(None)
    assert not receiver.signed
    (received,) = receiver.decode(Endpoint(255, 190).encode("HEARTBEAT", {}))
    assert not received.signed


@pytest.mark.parametrize("behind", [b"", b"\x00", b"noise"])
def test_message_inside_of_noise_that_looks_like_a_frame_is_decoded(behind: bytes) -> None:
    inner = heartbeat(7)
    # A MAVLink 1 header with a message id that the dialect does not define.
    noise = bytes((0xFE, len(inner), 0, 1, 1, 60)) + inner + b"\x00\x00"
    other = Endpoint(1, 1).encode("ATTITUDE", {})
    for cut in range(1, len(noise) + len(behind)):
        unknown: list[bytes] = []
        parser = Parser(unknown=unknown.append)
        data = noise + behind
        received = parser.feed(data[:cut]) + parser.feed(data[cut:]) + parser.feed(other)
        assert [message.name for message in received] == (["HEARTBEAT"] if behind else []) + ["ATTITUDE"], cut
        assert unknown == ([noise] if not behind or cut == len(noise) else []), cut
        assert parser.bad >= 1


def test_frame_with_an_unknown_message_id_is_skipped_whole() -> None:
    unknown = bytearray(heartbeat())
    unknown[7:10] = (60_000).to_bytes(3, "little")
    assert [message.name for message in Parser().feed(bytes(unknown) + heartbeat())] == ["HEARTBEAT"]


def test_frame_after_a_frame_with_refused_signature_is_decoded_without_delay() -> None:
    receiver = signing_endpoint(KEY, 1000, sysid=1)
    # The payload of the unsigned frame contains bytes that look like the start of a long frame.
    unsigned = Endpoint(255, 190).encode("HEARTBEAT", {"custom_mode": 0xFDFD})
    assert receiver.decode(unsigned) == []
    assert [message.name for message in receiver.decode(signing_endpoint(KEY, 2000).encode("HEARTBEAT", {}))] == [
        "HEARTBEAT"
    ]


def test_enumeration_names_have_no_prefix() -> None:
    assert enum_name("MAV_CMD", mavlink.MAV_CMD_NAV_LAND) == "NAV_LAND"
    assert enum_name("MAV_CMD", 65_000) == "65000"
    assert enum_names("COPTER_MODE")[mavlink.COPTER_MODE_GUIDED] == "GUIDED"
    assert "ENUM_END" not in enum_names("COPTER_MODE").values()

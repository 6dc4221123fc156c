"""Fuzz the MAVLink parser. It raises no exception, and the chunk sizes of its input do not change its messages.

Also checks that no changed frame is accepted on a signed link.
"""

from __future__ import annotations

import sys

import atheris

with atheris.instrument_imports(include=["fractus_runtime.mavlink_codec", "pymavlink"]):
    from fractus_runtime.mavlink_codec import MAX_FRAME_LENGTH, Endpoint, Message, Parser
    from mavlink_frames import MESSAGE_CLASSES, MessageClass, frame_v1, frame_v2
    from pymavlink.dialects.v20 import ardupilotmega as mavlink

MARKERS = bytes((mavlink.PROTOCOL_MARKER_V1, mavlink.PROTOCOL_MARKER_V2))
KEY = bytes(range(32))


def fuzz_one(data: bytes) -> None:
    """Parse the input as a stream, and then use it as the payload of intact frames."""
    parsed(data)
    if len(data) > 3:
        kind = MESSAGE_CLASSES[int.from_bytes(data[:2], "little") % len(MESSAGE_CLASSES)]
        # The payload may have any length: senders cut trailing zeros, and newer dialects add fields.
        payload = data[3 : 3 + data[2]]
        frame = frame_v2(kind, payload)
        check_encoded_again(accepted(frame, data))
        check_signed(kind, payload, data)
        if kind.id <= 0xFF:
            old = frame_v1(kind, payload)
            assert repr(accepted(old, data).values) == repr(accepted(frame, data).values)
            check_unsigned(old, kind)
        check_unsigned(frame, kind)


def signed_link() -> Endpoint:
    """Return an endpoint of a signed link."""
    endpoint = Endpoint(1, 1)
    endpoint.set_signing(KEY, 1000)
    return endpoint


def accepted(frame: bytes, noise: bytes) -> Message:
    """Check that an intact frame is parsed as one message, also with noise before or after the frame."""
    (message,) = parsed(noise[:16].translate(None, MARKERS) + frame)
    (first, *_) = parsed(frame + noise[:16])
    assert message.frame == first.frame == frame
    return message


def check_unsigned(frame: bytes, kind: MessageClass) -> None:
    """Check that a signed link accepts no unsigned frames except RADIO_STATUS, which radio modems send."""
    messages = signed_link().decode(frame)
    assert [message.name for message in messages] == ["RADIO_STATUS"] * (kind.msgname == "RADIO_STATUS")
    assert not any(message.signed for message in messages)


def parsed(data: bytes) -> list[Message]:
    """Return the messages of a stream. Check that they are the same for several chunk sizes."""
    half = len(data) // 2
    outcomes = []
    reported = []
    for cuts in ([data[i : i + 1] for i in range(len(data))], [data[:half], data[half:]], [data]):
        unknown: list[bytes] = []
        parser = Parser(unknown=unknown.append)
        messages = [message for part in cuts for message in parser.feed(part)]
        assert parser.pending <= MAX_FRAME_LENGTH, parser.pending
        outcomes.append((repr(messages), parser.bad))
        reported.append(unknown)
    assert outcomes[0] == outcomes[1] == outcomes[2], outcomes
    # Noise at the end of the received bytes may be reported as a frame of another dialect.
    assert {*reported[2]} <= {*reported[1]} <= {*reported[0]}, reported
    assert all(frame in data for frame in reported[0])
    return messages


def check_encoded_again(message: Message) -> None:
    """Check that a received message can be encoded and decoded again without a change."""
    (decoded,) = Parser().feed(Endpoint(1, 1).encode(message.name, message.values))
    assert repr(decoded.values) == repr(message.values)


def check_signed(kind: MessageClass, payload: bytes, data: bytes) -> None:
    """Check that a signed frame is accepted once, and never if it was changed."""
    sender = mavlink.MAVLink(None, 1, 1)
    sender.signing.secret_key = KEY
    sender.signing.timestamp = 1001
    unsigned = mavlink.MAVLink_bad_data(frame_v2(kind, payload, flags=mavlink.MAVLINK_IFLAG_SIGNED), "")
    unsigned.sign_packet(sender)
    whole = bytes(unsigned.get_msgbuf())
    at = int.from_bytes(data[:2], "big") % len(whole)
    bad = whole[:at] + bytes((whole[at] ^ (data[-1] or 1),)) + whole[at + 1 :]
    link = signed_link()
    assert not [message for message in link.decode(bad + bytes(300)) if message.signed]
    link = signed_link()
    (received,) = (message for message in link.decode(whole) if message.signed)
    assert received.frame == whole
    assert not [message for message in link.decode(whole) if message.signed], "a replay"


if __name__ == "__main__":
    atheris.Setup(sys.argv, fuzz_one)
    atheris.Fuzz()

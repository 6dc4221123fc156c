"""MAVLink over pymavlink's stock dialect `ardupilotmega`: typed messages, and a stream parser that resynchronises.

pymavlink encodes, decodes and signs. This module adds what the mobility service and the simulator need around it:

- `Message`, a typed view of a decoded message. The classes of pymavlink have no common typed field access.
- `Parser`, which searches for the next frame directly behind the first byte of a damaged one. pymavlink's own
  `parse_buffer` trusts the length byte of a damaged frame and drops the intact frames that follow within that length.
- `Endpoint`, which encodes messages by name with fields that default to zero.

Constants, message ids and enumerations come from the dialect itself:

    from pymavlink.dialects.v20 import ardupilotmega as mavlink

Example:
    link = Endpoint(sysid=255, compid=mavlink.MAV_COMP_ID_MISSIONPLANNER)
    frame = link.encode("COMMAND_LONG", {"command": mavlink.MAV_CMD_NAV_LAND, "target_system": 1})
    for message in link.decode(received):
        if message.name == "ATTITUDE":
            print(message.real("yaw"))
"""

from __future__ import annotations

import functools
import math
import struct
from collections.abc import Callable, Mapping
from typing import NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mavlink

# pymavlink accepts damaged frames if the environment variable MAV_IGNORE_CRC is set. A drone must not.
mavlink.MAVLINK_IGNORE_CRC = 0

Scalar = int | float
Value = Scalar | bytes | tuple[Scalar, ...]

CHECKSUM_LENGTH = 2
MAX_FRAME_LENGTH = mavlink.HEADER_LEN_V2 + 255 + CHECKSUM_LENGTH + mavlink.MAVLINK_SIGNATURE_BLOCK_LEN

_MARKERS = (mavlink.PROTOCOL_MARKER_V2, mavlink.PROTOCOL_MARKER_V1)
_FLOAT_MAX = 3.4028234e38
_INTEGER_BITS = {
    "int8_t": 8, "int16_t": 16, "int32_t": 32, "int64_t": 64, "uint8_t": 8, "uint16_t": 16, "uint32_t": 32, "uint64_t": 64,
}  # fmt: skip


class UnknownMessageError(KeyError):
    """The dialect has no message with this name."""


class Message(NamedTuple):
    """A MAVLink message.

    Attributes:
        name: Message name, for example `HEARTBEAT`.
        msgid: Message id.
        sysid: System id of the sender.
        compid: Component id of the sender.
        values: Field values by name, in wire order. Text fields are bytes, arrays are tuples.
        frame: The frame as received; empty for a message that was not received.
        signed: True if the frame has a signature that was verified.
    """

    name: str
    msgid: int
    sysid: int
    compid: int
    values: Mapping[str, Value]
    frame: bytes = b""
    signed: bool = False

    def real(self, field_name: str) -> float:
        """Return a numeric field as float."""
        value = self.values[field_name]
        return float(value) if isinstance(value, (int, float)) else 0.0

    def integer(self, field_name: str) -> int:
        """Return an integer field."""
        value = self.values[field_name]
        return value if isinstance(value, int) else 0

    def text(self, field_name: str) -> str:
        """Return a text field up to its first NUL. A text that fills its field has no NUL."""
        value = self.values[field_name]
        return value.split(b"\0", 1)[0].decode("utf-8", "replace") if isinstance(value, bytes) else ""

    def array(self, field_name: str) -> tuple[Scalar, ...]:
        """Return an array field."""
        value = self.values[field_name]
        return value if isinstance(value, tuple) else ()

    def has(self, field_name: str) -> bool:
        """Return True if the message has this field."""
        return field_name in self.values


def message(name: str, **values: Value) -> Message:
    """Return a message to send. Fields that are not given are zero.

    Raises:
        UnknownMessageError: The dialect has no such message.
        TypeError: The message has no such field.
    """
    kind = message_class(name)
    defaults = _default_fields(name)
    if unknown := values.keys() - defaults.keys():
        raise TypeError(f"{name} has no field {', '.join(sorted(unknown))}")
    return Message(
        name, kind.id, 0, 0, {field: values.get(field, defaults[field]) for field in kind.ordered_fieldnames}
    )


@functools.cache
def message_class(name: str) -> type[mavlink.MAVLink_message]:
    """Return pymavlink's class of a message.

    Raises:
        UnknownMessageError: The dialect has no such message.
    """
    kind = _classes_by_name().get(name)
    if kind is None:
        raise UnknownMessageError(name)
    return kind


def message_id(name: str) -> int:
    """Return the id of a message.

    Raises:
        UnknownMessageError: The dialect has no such message.
    """
    return message_class(name).id


@functools.cache
def enum_names(enum: str) -> Mapping[int, str]:
    """Return the names of an enumeration's entries by value, without the enumeration's prefix.

    Args:
        enum: Name of the enumeration, for example `MAV_CMD`.
    """
    return {
        value: entry.name.removeprefix(f"{enum}_")
        for value, entry in mavlink.enums[enum].items()
        if not entry.name.endswith("_ENUM_END")
    }


def enum_name(enum: str, value: int) -> str:
    """Return the name of an enumeration entry, for example `NAV_LAND`, or the number if the dialect does not define it."""
    return enum_names(enum).get(value, str(value))


def frame_length(data: bytes | bytearray, start: int = 0) -> int:
    """Return the length of the frame whose first three bytes are at `start`, in bytes."""
    if data[start] == mavlink.PROTOCOL_MARKER_V1:
        return data[start + 1] + mavlink.HEADER_LEN_V1 + CHECKSUM_LENGTH
    signature = mavlink.MAVLINK_SIGNATURE_BLOCK_LEN if data[start + 2] & mavlink.MAVLINK_IFLAG_SIGNED else 0
    return data[start + 1] + mavlink.HEADER_LEN_V2 + CHECKSUM_LENGTH + signature


class Parser:
    """Cut the byte stream of one link into messages.

    Bytes that are not part of an intact frame are skipped. pymavlink's exceptions do not propagate.

    Args:
        unknown: Callback that receives each frame with a message id that the dialect does not define. Such a frame cannot
            be verified, because its checksum depends on the definition.
        protocol: pymavlink's protocol object, which holds the signing state of the link.

    Attributes:
        bad: Number of frames that were damaged, unknown or not acceptably signed.
    """

    def __init__(
        self, unknown: Callable[[bytes], None] = lambda _frame: None, protocol: mavlink.MAVLink | None = None
    ) -> None:
        self.bad = 0
        self._protocol = protocol or mavlink.MAVLink(None)
        self._buffer = bytearray()
        self._unknown = unknown
        self._unknown_reported = False

    @property
    def pending(self) -> int:
        """Number of bytes that wait for the rest of their frame; at most one frame."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[Message]:
        """Add received bytes and return the messages that they complete."""
        messages: list[Message] = []
        buffer = self._buffer
        buffer += data
        start = 0
        end = len(buffer)
        while start < end:
            if buffer[start] not in _MARKERS:
                start += 1
                continue
            if end - start < 3:
                break
            after = start + frame_length(buffer, start)
            if after > end:
                break
            frame = bytes(buffer[start:after])
            decoded = self._decode(frame)
            if isinstance(decoded, mavlink.MAVLink_unknown):
                if after == end:
                    # The next byte decides if this is a frame of another dialect or noise with messages inside. It may
                    # arrive much later, so the frame is reported now and decided when more bytes arrive.
                    self._report_unknown(frame)
                    self._unknown_reported = True
                    break
                self.bad += 1
                followed_by_frame = buffer[after] in _MARKERS
                if followed_by_frame:
                    self._report_unknown(frame)
                self._unknown_reported = False
                start = after if followed_by_frame else start + 1
            elif isinstance(decoded, mavlink.MAVLink_bad_data):
                self.bad += 1
                self._unknown_reported = False
                start = after if decoded.reason == _BAD_SIGNATURE else start + 1
            else:
                messages.append(_message_of(decoded, frame))
                start = after
        del buffer[:start]
        return messages

    def _report_unknown(self, frame: bytes) -> None:
        if not self._unknown_reported:
            self._unknown(frame)

    def _decode(self, frame: bytes) -> mavlink.MAVLink_message:
        """Decode one frame; damaged and wrongly signed frames become `MAVLink_bad_data`."""
        is_v2 = frame[0] == mavlink.PROTOCOL_MARKER_V2
        # A receiver must refuse a frame with an incompatibility flag that it does not know.
        if is_v2 and frame[2] & ~mavlink.MAVLINK_IFLAG_SIGNED:
            return mavlink.MAVLink_bad_data(frame, "unknown incompatibility flag")
        try:
            return self._protocol.decode(bytearray(frame))
        except mavlink.MAVError as error:
            return mavlink.MAVLink_bad_data(frame, error.message)


_BAD_SIGNATURE = "Invalid signature"
"""Message of the exception that pymavlink raises for an intact frame without an acceptable signature."""


class _Protocol(mavlink.MAVLink):
    """pymavlink's protocol object, with a replay protection that only senders with the key can influence."""

    def check_signature(self, msgbuf: bytearray, srcSystem: int, srcComponent: int) -> bool:  # noqa: N803
        """Verify the signature of a frame.

        pymavlink stores the timestamp of a signature before it verifies the signature. Without the correction here, one
        forged frame with a late timestamp would shut out the sender who has the key.
        """
        timestamps = self.signing.stream_timestamps
        stream = (msgbuf[-mavlink.MAVLINK_SIGNATURE_BLOCK_LEN], srcSystem, srcComponent)
        newest = timestamps.get(stream)
        accepted = super().check_signature(msgbuf, srcSystem, srcComponent)
        if not accepted:
            if newest is None:
                timestamps.pop(stream, None)
            else:
                timestamps[stream] = newest
        return accepted


class Endpoint:
    """End of a link: encodes the messages that a system sends, and parses the messages that it receives.

    Args:
        sysid: System id of the sender.
        compid: Component id of the sender, `MAV_COMP_ID_*`.
        saturate: Send the nearest value that a field can hold instead of raising an error.

    Attributes:
        parser: Parser of the received bytes.
        mavlink1: True to encode MAVLink 1 frames. Extension fields are omitted.
    """

    def __init__(self, sysid: int, compid: int, *, saturate: bool = False) -> None:
        self.sysid = sysid
        self.compid = compid
        self.mavlink1 = False
        self._saturate = saturate
        self._protocol = _Protocol(None, srcSystem=sysid, srcComponent=compid)
        self.parser = Parser(protocol=self._protocol)

    @property
    def signed(self) -> bool:
        """True if frames are signed, and unsigned frames are refused."""
        return self._protocol.signing.secret_key is not None

    def set_signing(self, key: bytes | None, timestamp: int = 0) -> None:
        """Sign frames, and refuse frames without a valid signature.

        Args:
            key: 32 bytes that both ends share; no key turns signing off.
            timestamp: Time of the next signature in units of 10 µs since 1 January 2015.
        """
        signing = mavlink.MAVLinkSigning()
        if key is not None:
            signing.secret_key = key
            signing.sign_outgoing = True
            signing.timestamp = timestamp
            signing.allow_unsigned_callback = _allows_unsigned
        self._protocol.signing = signing

    def encode(self, name: str, values: Mapping[str, Value]) -> bytes:
        """Return one frame with the next sequence number. Fields that are not given are zero.

        Raises:
            UnknownMessageError: The dialect has no such message.
            struct.error: A value does not fit its field, or the id of the message does not fit into MAVLink 1.
            OverflowError: A number does not fit a float field.
        """
        kind = message_class(name)
        fields = [
            _padded(values.get(field, default), default) if isinstance(default, tuple) else values.get(field, default)
            for field, default in _default_fields(name).items()
        ]
        message = kind(*fields)  # type: ignore[arg-type]  # pymavlink has no types
        try:
            frame = message.pack(self._protocol, force_mavlink1=self.mavlink1)
        except (struct.error, OverflowError):
            if not self._saturate:
                raise
            fields = [_saturated(type_, value) for type_, value in zip(kind.fieldtypes, fields, strict=True)]
            message = kind(*fields)  # type: ignore[arg-type]  # pymavlink has no types
            frame = message.pack(self._protocol, force_mavlink1=self.mavlink1)
        if self.mavlink1:
            frame = self._without_extensions(kind, frame)
        self._protocol.seq = (self._protocol.seq + 1) & 0xFF
        return bytes(frame)

    @staticmethod
    def _without_extensions(kind: type[mavlink.MAVLink_message], frame: bytes) -> bytes:
        """Return a MAVLink 1 frame without the extension fields, which pymavlink encodes too."""
        length = _base_length(kind.id)
        body = bytes((length,)) + frame[2 : mavlink.HEADER_LEN_V1 + length]
        checksum = mavlink.x25crc(body + bytes((kind.crc_extra,))).crc
        return frame[:1] + body + struct.pack("<H", checksum)

    def decode(self, data: bytes) -> list[Message]:
        """Return the messages that these bytes complete."""
        return self.parser.feed(data)


def _allows_unsigned(_protocol: mavlink.MAVLink, msgid: int) -> bool:
    """Accept RADIO_STATUS without a signature, because a modem has no key. ArduPilot does the same."""
    return msgid == mavlink.MAVLINK_MSG_ID_RADIO_STATUS


def _message_of(decoded: mavlink.MAVLink_message, frame: bytes) -> Message:
    fields = vars(decoded)
    values = {}
    for name in decoded.ordered_fieldnames:
        # pymavlink decodes text as ASCII. The original bytes are in another attribute.
        value = fields.get(f"_{name}_raw", fields[name])
        values[name] = tuple(value) if isinstance(value, list) else value
    header = decoded.get_header()
    return Message(
        decoded.msgname, header.msgId, header.srcSystem, header.srcComponent, values, frame, decoded.get_signed()
    )


@functools.cache
def _classes_by_name() -> Mapping[str, type[mavlink.MAVLink_message]]:
    return {kind.msgname: kind for kind in mavlink.mavlink_map.values()}


@functools.cache
def _default_fields(name: str) -> Mapping[str, Value]:
    """Return the zero value of each field of a message, in the order of the constructor of its class."""
    kind = message_class(name)
    lengths = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
    defaults: dict[str, Value] = {}
    for field, type_ in zip(kind.fieldnames, kind.fieldtypes, strict=True):
        if type_ == "char":
            defaults[field] = b""
        elif lengths[field]:
            defaults[field] = (0,) * lengths[field]
        else:
            defaults[field] = 0
    return defaults


@functools.cache
def _base_length(message_id: int) -> int:
    """Return the payload length of a message in MAVLink 1, which has no extension fields."""
    # Imported only if a peer uses MAVLink 1, because the dialect needs 5 MB of memory.
    from pymavlink.dialects.v10 import ardupilotmega as mavlink1  # noqa: PLC0415

    return int(mavlink1.mavlink_map[message_id].unpacker.size)


def _padded(value: Value, default: tuple[Scalar, ...]) -> tuple[Scalar, ...]:
    """Fill a short array with zeros."""
    items = value if isinstance(value, tuple) else ()
    return items + default[len(items) :]


def _saturated(type_: str, value: Value) -> Value:
    """Return the nearest value that a field of this type can hold."""
    if isinstance(value, tuple):
        return tuple(_saturated_scalar(type_, item) for item in value)
    if type_ == "char":
        return value if isinstance(value, bytes) else b""
    return _saturated_scalar(type_, value) if isinstance(value, int | float) else 0


def _saturated_scalar(type_: str, value: Scalar) -> Scalar:
    if type_ in {"float", "double"}:
        return max(-_FLOAT_MAX, min(_FLOAT_MAX, value)) if math.isfinite(value) else value
    if not math.isfinite(value):
        return 0
    bits = _INTEGER_BITS[type_]
    if type_.startswith("u"):
        return max(0, min((1 << bits) - 1, int(value)))
    return max(-(1 << (bits - 1)), min((1 << (bits - 1)) - 1, int(value)))

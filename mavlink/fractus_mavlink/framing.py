"""Frames on the wire: MAVLink 2 out, MAVLink 1 and 2 in, whatever else the line carries."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from enum import Enum

from fastcrc.crc16 import mcrf4xx

from fractus_mavlink.messages import Layout, Message, Value, layout_of
from fractus_mavlink.signing import SIGNATURE_LENGTH, Signing

MAGIC_V1 = 0xFE
MAGIC_V2 = 0xFD
HEADER_V1 = 6
HEADER_V2 = 10
CHECKSUM_LENGTH = 2
MAVLINK_IFLAG_SIGNED = 0x01
MAX_STREAMS = 256

_MAGICS = (MAGIC_V2, MAGIC_V1)
_header_v2 = struct.Struct("<BBBBBBBHB")
_checksum = struct.Struct("<H")


def encode(
    layout: Layout,
    values: Mapping[str, Value],
    *,
    sequence: int,
    sysid: int,
    compid: int,
    signing: Signing | None = None,
    saturate: bool = False,
) -> bytes:
    """Build a MAVLink 2 frame."""
    # Trailing zeroes are not sent, but a payload has at least one byte.
    payload = layout.pack(values, saturate=saturate).rstrip(b"\0") or b"\0"
    msgid = layout.msgid
    flags = 0 if signing is None else MAVLINK_IFLAG_SIGNED
    body = (
        _header_v2.pack(MAGIC_V2, len(payload), flags, 0, sequence & 0xFF, sysid, compid, msgid & 0xFFFF, msgid >> 16)
        + payload
    )
    frame = body + _checksum.pack(mcrf4xx(body[1:] + bytes((layout.crc_extra,))))
    return frame if signing is None else signing.sign(frame)


def frame_length(data: bytes | bytearray, at: int = 0) -> int:
    """How long the frame is whose first three bytes are at a position."""
    if data[at] == MAGIC_V1:
        return data[at + 1] + HEADER_V1 + CHECKSUM_LENGTH
    signature = SIGNATURE_LENGTH if data[at + 2] & MAVLINK_IFLAG_SIGNED else 0
    return data[at + 1] + HEADER_V2 + CHECKSUM_LENGTH + signature


class _Refusal(Enum):
    """Why a frame is no message; decides where the search for the next one begins."""

    DAMAGED = 1  # right behind the first byte: it was no frame
    UNKNOWN = 2  # behind it, if another frame follows
    SIGNATURE = 3  # behind it: a sound frame of a sender without the key


class Parser:
    """Cuts one link's byte stream into messages; what is not a sound frame is counted and skipped.

    Args:
        signing: the link's signing as it is now; None when frames need no signature.
        unknown: told of frames that are not of this dialect, whose checksums no one can verify.

    Attributes:
        bad: how many frames were none, or not of this dialect.
        lost: how many frames are missing, by the senders' sequence numbers.
    """

    def __init__(
        self,
        signing: Callable[[], Signing | None] = lambda: None,
        unknown: Callable[[bytes], None] = lambda _frame: None,
    ) -> None:
        self._buffer = bytearray()
        self._unknown = unknown
        self._told = False
        self._signing = signing
        self.bad = 0
        self.lost = 0
        self._next_sequence: dict[tuple[int, int], int] = {}

    @property
    def pending(self) -> int:
        """Bytes that wait for the rest of their frame; never more than one frame."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[Message]:
        """Take bytes and return the messages they complete."""
        messages: list[Message] = []
        buffer = self._buffer
        buffer += data
        at = 0
        end = len(buffer)
        while at < end:
            if buffer[at] not in _MAGICS:
                at += 1
                continue
            if end - at < 3:
                break
            after = at + frame_length(buffer, at)
            if after > end:
                break
            verdict = self._decode(bytes(buffer[at:after]))
            if isinstance(verdict, Message):
                messages.append(verdict)
                at = after
            elif verdict is _Refusal.UNKNOWN and after == end:
                # Only the byte behind it shows whether messages have to be looked for inside, and may come much later.
                self._tell(bytes(buffer[at:after]))
                self._told = True
                break
            else:
                self.bad += 1
                framed = verdict is _Refusal.UNKNOWN and buffer[after] in _MAGICS
                if framed:
                    self._tell(bytes(buffer[at:after]))
                self._told = False
                at = after if framed or verdict is _Refusal.SIGNATURE else at + 1
        del buffer[:at]
        return messages

    def _tell(self, frame: bytes) -> None:
        """Tell of a frame of another dialect, once."""
        if not self._told:
            self._unknown(frame)

    def _decode(self, frame: bytes) -> Message | _Refusal:
        length = frame[1]
        if frame[0] == MAGIC_V2:
            # A receiver must refuse a frame with an incompatibility flag that it does not know.
            if frame[2] & ~MAVLINK_IFLAG_SIGNED:
                return _Refusal.DAMAGED
            sequence, sysid, compid = frame[4], frame[5], frame[6]
            msgid = frame[7] | frame[8] << 8 | frame[9] << 16
            start = HEADER_V2
            signed = bool(frame[2] & MAVLINK_IFLAG_SIGNED)
        else:
            sequence, sysid, compid, msgid = frame[2], frame[3], frame[4], frame[5]
            start = HEADER_V1
            signed = False
        layout = layout_of(msgid)
        if layout is None:
            # Without the definition's checksum the frame's own cannot be verified.
            return _Refusal.UNKNOWN
        crc_at = start + length
        if mcrf4xx(frame[1:crc_at] + bytes((layout.crc_extra,))) != frame[crc_at] | frame[crc_at + 1] << 8:
            return _Refusal.DAMAGED
        authentic = False
        signing = self._signing()
        if signing is not None:
            authentic = signed and signing.accepts(frame)
            # RADIO_STATUS comes from a modem that has no key; ArduPilot lets it through as well.
            if not authentic and layout.name != "RADIO_STATUS":
                return _Refusal.SIGNATURE
        self._count_lost(sysid, compid, sequence)
        return Message(layout.name, msgid, sysid, compid, layout.unpack(frame[start:crc_at]), frame, authentic)

    def _count_lost(self, sysid: int, compid: int, sequence: int) -> None:
        expected = self._next_sequence.get((sysid, compid))
        if expected is not None:
            self.lost += (sequence - expected) & 0xFF
        elif len(self._next_sequence) >= MAX_STREAMS:
            self._next_sequence.clear()
        self._next_sequence[sysid, compid] = (sequence + 1) & 0xFF

"""MAVLink 2 on the wire: frames to messages and back, for every message of the ardupilotmega dialect.

The full pymavlink dialect costs 90 MB of memory in each process; this codec reads a compact table of the same
messages (`messages.txt`, generated from pymavlink and checked against it by a test) and costs almost nothing.
"""

from __future__ import annotations

import functools
import hashlib
import hmac
import math
import re
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from importlib import resources

from fastcrc.crc16 import mcrf4xx

MAGIC_V1 = 0xFE
MAGIC_V2 = 0xFD
INCOMPAT_SIGNED = 0x01
SIGNATURE_LENGTH = 13
HEADER_V1 = 6
HEADER_V2 = 10
# A signature's clock may be this far behind ours when a stream is first seen, in units of 10 µs.
SIGNATURE_WINDOW = 6_000_000

Scalar = int | float
Value = Scalar | bytes | tuple[Scalar, ...]

_FLOAT_MAX = 3.4028234e38
_header_v2 = struct.Struct("<BBBBBBBHB")


class UnknownMessageError(KeyError):
    """A message name that the dialect does not have."""


@dataclass(frozen=True, slots=True)
class Layout:
    """How one message lies in memory: names in wire order, the struct, and the CRC seed."""

    msgid: int
    name: str
    crc_extra: int
    fields: tuple[str, ...]
    counts: tuple[int, ...]
    packer: struct.Struct
    plain: bool

    def pack(self, values: Mapping[str, Value]) -> bytes:
        """Serialise `values`; a field that is not given is zero, a number that does not fit saturates."""
        flat: list[Scalar | bytes] = self._flat(values)
        try:
            return self.packer.pack(*flat)
        except (struct.error, OverflowError):
            codes = _expanded(self.packer.format)
            return self.packer.pack(*[_fitted(code, value) for code, value in zip(codes, flat, strict=True)])

    def _flat(self, values: Mapping[str, Value]) -> list[Scalar | bytes]:
        if self.plain:
            return [0 if isinstance(number := values.get(name, 0), tuple) else number for name in self.fields]
        flat: list[Scalar | bytes] = []
        for name, count in zip(self.fields, self.counts, strict=True):
            value = values.get(name)
            if count == 1:
                flat.append(0 if value is None or isinstance(value, tuple) else value)
            elif count == 0:
                flat.append(value if isinstance(value, bytes) else b"")
            else:
                items = value if isinstance(value, tuple) else ()
                flat.extend(items)
                flat.extend([0] * (count - len(items)))
        return flat

    def unpack(self, payload: bytes) -> dict[str, Value]:
        """Read a payload, which may be shorter (trailing zeros cut) or longer (newer extensions)."""
        size = self.packer.size
        flat = self.packer.unpack(payload[:size].ljust(size, b"\0"))
        if self.plain:
            return dict(zip(self.fields, flat, strict=True))
        values: dict[str, Value] = {}
        at = 0
        for name, count in zip(self.fields, self.counts, strict=True):
            if count <= 1:
                values[name] = flat[at]
                at += 1
            else:
                values[name] = tuple(flat[at : at + count])
                at += count
        return values


def _expanded(format_: str) -> list[str]:
    """`<2Hb16s` to `H H b s`: one code for each value that the struct takes."""
    codes: list[str] = []
    for count, code in re.findall(r"(\d*)([a-zA-Z])", format_):
        codes += [code] * (1 if code == "s" else int(count or 1))
    return codes


def _fitted(code: str, value: Scalar | bytes) -> Scalar | bytes:
    if isinstance(value, bytes) or code == "s":
        return value if isinstance(value, bytes) else b""
    if code in "fd":
        return max(-_FLOAT_MAX, min(_FLOAT_MAX, value)) if math.isfinite(value) else value
    bits = 8 * struct.calcsize(code if code not in "qQ" else "<" + code)
    low, high = (-(1 << (bits - 1)), (1 << (bits - 1)) - 1) if code.islower() else (0, (1 << bits) - 1)
    return max(low, min(high, int(value))) if math.isfinite(value) else 0


@functools.cache
def _lines() -> tuple[dict[int, str], dict[str, int]]:
    text = resources.files(__package__).joinpath("messages.txt").read_text(encoding="ascii")
    by_id = {int(line.split(" ", 1)[0]): line for line in text.splitlines()}
    by_name = {line.split(" ", 2)[1]: msgid for msgid, line in by_id.items()}
    return by_id, by_name


@functools.cache
def layout_of(msgid: int) -> Layout | None:
    """The layout of a message id, or None when the dialect has no such message."""
    line = _lines()[0].get(msgid)
    if line is None:
        return None
    _, name, crc_extra, *fields = line.split(" ")
    names = tuple(part.split(":")[0] for part in fields)
    codes = [part.split(":")[1] for part in fields]
    # 0 marks a string, 1 a scalar, more an array of that many elements.
    counts = tuple(0 if code.endswith("s") else int(code[:-1] or 1) for code in codes)
    packer = struct.Struct("<" + "".join(codes))
    return Layout(msgid, name, int(crc_extra), names, counts, packer, all(count == 1 for count in counts))


@functools.cache
def layout_named(name: str) -> Layout:
    """The layout of a message name.

    Raises:
        UnknownMessageError: the dialect has no such message.
    """
    msgid = _lines()[1].get(name)
    layout = None if msgid is None else layout_of(msgid)
    if layout is None:
        raise UnknownMessageError(name)
    return layout


@dataclass(frozen=True, slots=True)
class Message:
    """One received message, with the frame it came in."""

    name: str
    msgid: int
    sysid: int
    compid: int
    values: Mapping[str, Value]
    frame: bytes
    signed: bool = False

    def real(self, field_name: str) -> float:
        """A numeric field as float."""
        value = self.values[field_name]
        return float(value) if isinstance(value, (int, float)) else 0.0

    def integer(self, field_name: str) -> int:
        """An integer field."""
        value = self.values[field_name]
        return value if isinstance(value, int) else 0

    def text(self, field_name: str) -> str:
        """A character field up to its first NUL."""
        value = self.values[field_name]
        return value.split(b"\0", 1)[0].decode("ascii", "replace") if isinstance(value, bytes) else ""

    def array(self, field_name: str) -> tuple[Scalar, ...]:
        """An array field."""
        value = self.values[field_name]
        return value if isinstance(value, tuple) else ()

    def has(self, field_name: str) -> bool:
        """Whether the message has such a field."""
        return field_name in self.values


@dataclass(slots=True)
class Signing:
    """The state of MAVLink 2 message signing on one link."""

    key: bytes
    timestamp: int
    link_id: int = 0
    streams: dict[tuple[int, int, int], int] = field(default_factory=dict)
    max_streams: int = 16

    def sign(self, frame: bytes) -> bytes:
        """Return the frame with its signature block."""
        self.timestamp += 1
        block = struct.pack("<B", self.link_id) + self.timestamp.to_bytes(6, "little")
        return frame + block + hashlib.sha256(self.key + frame + block).digest()[:6]

    def accepts(self, frame: bytes) -> bool:
        """Check signature and replay protection of a signed frame."""
        body, signature = frame[:-6], frame[-6:]
        if not hmac.compare_digest(hashlib.sha256(self.key + body).digest()[:6], signature):
            return False
        timestamp = int.from_bytes(frame[-12:-6], "little")
        stream = (frame[-13], frame[5], frame[6])
        last = self.streams.get(stream)
        if last is None:
            if timestamp + SIGNATURE_WINDOW < self.timestamp or len(self.streams) >= self.max_streams:
                return False
        elif timestamp <= last:
            return False
        self.streams[stream] = timestamp
        self.timestamp = max(self.timestamp, timestamp)
        return True


def encode(
    layout: Layout,
    values: Mapping[str, Value],
    *,
    sequence: int,
    sysid: int,
    compid: int,
    signing: Signing | None = None,
) -> bytes:
    """Build a MAVLink 2 frame."""
    payload = layout.pack(values).rstrip(b"\0") or b"\0"
    msgid = layout.msgid
    flags = 0 if signing is None else INCOMPAT_SIGNED
    body = (
        _header_v2.pack(MAGIC_V2, len(payload), flags, 0, sequence & 0xFF, sysid, compid, msgid & 0xFFFF, msgid >> 16)
        + payload
    )
    crc = mcrf4xx(body[1:] + bytes((layout.crc_extra,)))
    frame = body + struct.pack("<H", crc)
    return frame if signing is None else signing.sign(frame)


class _Refusal(Enum):
    """Why a frame is no message; decides where the search for the next one begins."""

    DAMAGED = 1  # right behind the first byte: it was no frame
    UNKNOWN = 2  # behind it, if another frame follows
    SIGNATURE = 3  # behind it: a sound frame of somebody without the key


class Parser:
    """Cuts one link's byte stream into messages; whatever is not a sound frame is counted and skipped."""

    def __init__(self, signing: Callable[[], Signing | None] = lambda: None) -> None:
        self._buffer = bytearray()
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
            magic = buffer[at]
            if magic not in (MAGIC_V2, MAGIC_V1):
                at += 1
                continue
            if end - at < 3:
                break
            length = buffer[at + 1] + (HEADER_V1 if magic == MAGIC_V1 else HEADER_V2) + 2
            if magic == MAGIC_V2 and buffer[at + 2] & INCOMPAT_SIGNED:
                length += SIGNATURE_LENGTH
            if end - at < length:
                break
            after = at + length
            verdict = self._decode(bytes(buffer[at:after]))
            if isinstance(verdict, Message):
                messages.append(verdict)
                at = after
            else:
                self.bad += 1
                framed = verdict is _Refusal.UNKNOWN and (after == end or buffer[after] in (MAGIC_V2, MAGIC_V1))
                at = after if framed or verdict is _Refusal.SIGNATURE else at + 1
        del buffer[:at]
        return messages

    def _decode(self, frame: bytes) -> Message | _Refusal:
        length = frame[1]
        if frame[0] == MAGIC_V2:
            if frame[2] & ~INCOMPAT_SIGNED:
                return _Refusal.DAMAGED
            sequence, sysid, compid = frame[4], frame[5], frame[6]
            msgid = frame[7] | frame[8] << 8 | frame[9] << 16
            start = HEADER_V2
            signed = bool(frame[2] & INCOMPAT_SIGNED)
        else:
            sequence, sysid, compid, msgid = frame[2], frame[3], frame[4], frame[5]
            start = HEADER_V1
            signed = False
        layout = layout_of(msgid)
        if layout is None:
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
        elif len(self._next_sequence) >= 256:
            self._next_sequence.clear()
        self._next_sequence[sysid, compid] = (sequence + 1) & 0xFF

"""Messages and their payloads, by the layouts of the dialect.

A layout is read from its line of the table when its message is first met: an import costs a dictionary of strings, not
a class for each of three hundred messages of which a program uses twenty.
"""

from __future__ import annotations

import functools
import math
import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from fractus_mavlink.dialect import LAYOUTS

Scalar = int | float
Value = Scalar | bytes | tuple[Scalar, ...]

_FLOAT_MAX = 3.4028234e38


class UnknownMessageError(KeyError):
    """A message name that the dialect does not have."""


@dataclass(frozen=True, slots=True)
class Layout:
    """How the payload of one message lies on the wire.

    Attributes:
        msgid: the message's number.
        name: the message's name.
        crc_extra: a checksum of the definition, which goes into that of each frame: two ends with different definitions
            of a message do not understand each other's.
        fields: names in wire order, the widest types first and extensions last.
        counts: for each field 0 when it is text, 1 for a number, else the length of the array.
        packer: all fields.
        plain: whether every field is a number.
        blank: every field with zeroes.
    """

    msgid: int
    name: str
    crc_extra: int
    fields: tuple[str, ...]
    counts: tuple[int, ...]
    packer: struct.Struct
    plain: bool
    blank: Mapping[str, Value]

    def pack(self, values: Mapping[str, Value], *, saturate: bool = False) -> bytes:
        """Serialise `values`; a field that is not given is zero.

        Args:
            values: by field name.
            saturate: send the nearest value of the field's type for a number that does not fit.

        Raises:
            struct.error: a value does not fit its field.
            OverflowError: a number does not fit a float.
        """
        flat = self._flat(values)
        try:
            return self.packer.pack(*flat)
        except (struct.error, OverflowError):
            if not saturate:
                raise
            codes = _expanded(self.packer.format)
            return self.packer.pack(*[_fitted(code, value) for code, value in zip(codes, flat, strict=True)])

    def _flat(self, values: Mapping[str, Value]) -> list[Value]:
        if self.plain:
            return [values.get(name, 0) for name in self.fields]
        flat: list[Value] = []
        for name, count in zip(self.fields, self.counts, strict=True):
            value = values.get(name, self.blank[name])
            if count <= 1:
                flat.append(value)
            else:
                items = value if isinstance(value, tuple) else ()
                flat += items
                flat += (0,) * (count - len(items))
        return flat

    def unpack(self, payload: bytes) -> dict[str, Value]:
        """Read a payload; a sender cuts trailing zeroes, and a newer one may add fields that are not known here."""
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
                values[name] = flat[at : at + count]
                at += count
        return values


def _expanded(format_: str) -> list[str]:
    """`<2Hb16s` to `H H b s`: one code for each value that the struct takes."""
    codes: list[str] = []
    for count, code in re.findall(r"(\d*)([a-zA-Z])", format_):
        codes += [code] * (1 if code == "s" else int(count or 1))
    return codes


def _fitted(code: str, value: Value) -> Scalar | bytes:
    if code == "s":
        return value if isinstance(value, bytes) else b""
    if not isinstance(value, int | float):
        return 0
    if code in "fd":
        return max(-_FLOAT_MAX, min(_FLOAT_MAX, value)) if math.isfinite(value) else value
    bits = 8 * struct.calcsize("<" + code)
    low, high = (-(1 << (bits - 1)), (1 << (bits - 1)) - 1) if code.islower() else (0, (1 << bits) - 1)
    return max(low, min(high, int(value))) if math.isfinite(value) else 0


@functools.cache
def layout_of(msgid: int) -> Layout | None:
    """The layout of a message id, or None when the dialect has no such message."""
    line = LAYOUTS.get(msgid)
    if line is None:
        return None
    name, crc_extra, *fields = line.split(" ")
    names = tuple(part.split(":")[0] for part in fields)
    codes = [part.split(":")[1] for part in fields]
    counts = tuple(0 if code.endswith("s") else int(code[:-1] or 1) for code in codes)
    blank: dict[str, Value] = {
        name: b"" if count == 0 else 0 if count == 1 else (0,) * count
        for name, count in zip(names, counts, strict=True)
    }
    packer = struct.Struct("<" + "".join(codes))
    return Layout(msgid, name, int(crc_extra), names, counts, packer, all(count == 1 for count in counts), blank)


@functools.cache
def _ids() -> Mapping[str, int]:
    return {line.split(" ", 1)[0]: msgid for msgid, line in LAYOUTS.items()}


@functools.cache
def layout_named(name: str) -> Layout:
    """The layout of a message name.

    Raises:
        UnknownMessageError: the dialect has no such message.
    """
    layout = layout_of(_ids().get(name, -1))
    if layout is None:
        raise UnknownMessageError(name)
    return layout


class Message(NamedTuple):
    """One message, and where it came from.

    Attributes:
        name: the message's name.
        msgid: its number.
        sysid: the system that sent it.
        compid: the component that sent it.
        values: its fields, in wire order.
        frame: the frame as it arrived; empty for a message that was not received.
        signed: whether a signature was checked.
    """

    name: str
    msgid: int
    sysid: int
    compid: int
    values: Mapping[str, Value]
    frame: bytes = b""
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
        """A character field up to its first NUL; a text that fills its field has none."""
        value = self.values[field_name]
        return value.split(b"\0", 1)[0].decode("utf-8", "replace") if isinstance(value, bytes) else ""

    def array(self, field_name: str) -> tuple[Scalar, ...]:
        """An array field."""
        value = self.values[field_name]
        return value if isinstance(value, tuple) else ()

    def has(self, field_name: str) -> bool:
        """Whether the message has such a field."""
        return field_name in self.values


def message(name: str, **values: Value) -> Message:
    """A message to send; a field that is not given is zero.

    Raises:
        UnknownMessageError: the dialect has no such message.
        TypeError: the message has no such field.
    """
    layout = layout_named(name)
    if unknown := values.keys() - layout.blank.keys():
        raise TypeError(f"{name} has no field {', '.join(sorted(unknown))}")
    return Message(name, layout.msgid, 0, 0, {**layout.blank, **values})

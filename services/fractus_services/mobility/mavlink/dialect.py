"""The part of the ardupilotmega dialect that the mobility service speaks.

Importing pymavlink's full dialect costs 90 MB of memory. The framing of its smallest dialect is the same code, so the
messages that we need are added to that one from a table (`messages.txt`: id, name, CRC seed, fields in wire order),
which a test compares with the full dialect.
"""

from __future__ import annotations

import struct
from importlib import resources
from typing import Any

from pymavlink.dialects.v20 import minimal

_TYPES = {
    "B": "uint8_t", "b": "int8_t", "H": "uint16_t", "h": "int16_t", "I": "uint32_t", "i": "int32_t",
    "Q": "uint64_t", "q": "int64_t", "f": "float", "d": "double", "s": "char",
}  # fmt: skip


class _Message(minimal.MAVLink_message):  # type: ignore[misc]
    """A message of the table; fields are in wire order."""

    def __init__(self, *values: Any) -> None:
        super().__init__(self.id, self.msgname)
        self._fieldnames = self.fieldnames
        for name, value in zip(self.fieldnames, values, strict=True):
            setattr(self, name, value)

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        """Serialise the message."""
        flat: list[Any] = []
        for name, count in zip(self.fieldnames, self.array_lengths, strict=True):
            value = getattr(self, name)
            if count and not isinstance(value, bytes):
                flat.extend(value)
            else:
                flat.append(value)
        return bytes(self._pack(mav, self.crc_extra, self.unpacker.pack(*flat), force_mavlink1=force_mavlink1))


def _define(line: str) -> type[_Message]:
    number, name, crc_extra, *fields = line.split(" ")
    names = [field.split(":")[0] for field in fields]
    codes = [field.split(":")[1] for field in fields]
    counts = [int(code[:-1] or 0) for code in codes]
    text = [code.endswith("s") for code in codes]
    native = "<" + "".join(codes)
    return type(
        f"MAVLink_{name.lower()}_message",
        (_Message,),
        {
            "id": int(number),
            "msgname": name,
            "fieldnames": names,
            "ordered_fieldnames": names,
            "fieldtypes": [_TYPES[code[-1]] for code in codes],
            "native_format": bytearray(native, "ascii"),
            "orders": list(range(len(names))),
            "lengths": [1 if is_text else max(count, 1) for count, is_text in zip(counts, text, strict=True)],
            "array_lengths": counts,
            "crc_extra": int(crc_extra),
            "unpacker": struct.Struct(native),
        },
    )


def _load() -> dict[str, type[Any]]:
    table = resources.files(__package__).joinpath("messages.txt").read_text(encoding="ascii")
    defined = {cls.msgname: cls for cls in map(_define, table.splitlines())}
    for cls in defined.values():
        minimal.mavlink_map[cls.id] = cls
    return {**{cls.msgname: cls for cls in minimal.mavlink_map.values()}, **defined}


MESSAGES: dict[str, type[Any]] = _load()


def message(name: str, **values: Any) -> Any:
    """A message by name; a field that is not given is zero, and 0xFF.. stays the caller's business."""
    cls = MESSAGES[name]
    ordered = []
    for field, code, count in zip(cls.fieldnames, cls.fieldtypes, cls.array_lengths, strict=True):
        default: Any = b"" if code == "char" else [0] * count if count else 0
        ordered.append(values.pop(field, default))
    if values:
        raise TypeError(f"{name} has no field {', '.join(values)}")
    return cls(*ordered)


class Codec:
    """Frames of one link: messages to bytes and back."""

    def __init__(self, system: int, component: int) -> None:
        self._mav = minimal.MAVLink(None, srcSystem=system, srcComponent=component)
        self._mav.robust_parsing = True

    def encode(self, outgoing: Any) -> bytes:
        """One frame."""
        frame: bytes = outgoing.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256
        return frame

    def decode(self, data: bytes) -> list[Any]:
        """The known messages that these bytes complete; whatever is not a sound frame is skipped."""
        return [m for m in self._mav.parse_buffer(data) or () if m.get_type() in MESSAGES]

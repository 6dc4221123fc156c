"""One end of a link: numbers and signs the frames that it sends, and reads those that arrive."""

from __future__ import annotations

from collections.abc import Mapping

from fractus_mavlink.framing import Parser, encode
from fractus_mavlink.messages import Message, Value, layout_named
from fractus_mavlink.signing import Signing


class Endpoint:
    """A system's end of one link.

    Args:
        sysid: the sender's system id.
        compid: the sender's component id, see MAV_COMPONENT.
        saturate: send the nearest value for a number that does not fit its field, instead of raising an error.

    Attributes:
        signing: the link's key; None when it is not signed.
        parser: counts what is lost and damaged.
    """

    def __init__(self, sysid: int, compid: int, *, saturate: bool = False) -> None:
        self.sysid = sysid
        self.compid = compid
        self.signing: Signing | None = None
        self.parser = Parser(lambda: self.signing)
        self._saturate = saturate
        self._sequence = 0

    def encode(self, name: str, values: Mapping[str, Value]) -> bytes:
        """One frame; a field that is not given is zero.

        Raises:
            UnknownMessageError: the dialect has no such message.
            struct.error: a value does not fit its field.
        """
        frame = encode(
            layout_named(name),
            values,
            sequence=self._sequence,
            sysid=self.sysid,
            compid=self.compid,
            signing=self.signing,
            saturate=self._saturate,
        )
        # The receiver counts the frames that it missed by gaps in these numbers.
        self._sequence = (self._sequence + 1) & 0xFF
        return frame

    def decode(self, data: bytes) -> list[Message]:
        """The messages that these bytes complete."""
        return self.parser.feed(data)

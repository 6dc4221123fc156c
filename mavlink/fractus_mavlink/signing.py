"""MAVLink 2 message signing: who holds the link's key, and no replays."""

from __future__ import annotations

import hashlib
import hmac
import struct
from dataclasses import dataclass, field

SIGNATURE_LENGTH = 13
"""The link's id, 48 bits of time and 48 bits of SHA-256."""

MAX_CLOCK_DELAY = 6_000_000
"""How far the clock of a stream that is heard first may be behind ours, in units of 10 µs: one minute."""


@dataclass(slots=True)
class Signing:
    """The state of signing on one link.

    Attributes:
        key: 32 bytes that both ends share.
        timestamp: units of 10 µs since 1 January 2015; only ever grows.
        link_id: tells the links of one sender apart, whose frames overtake each other.
        streams: the last time of each link, system and component: a frame that is not newer is a replay.
        max_streams: more senders than this are not believed, so that a flood cannot fill the memory.
    """

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
            if timestamp + MAX_CLOCK_DELAY < self.timestamp or len(self.streams) >= self.max_streams:
                return False
        elif timestamp <= last:
            return False
        self.streams[stream] = timestamp
        self.timestamp = max(self.timestamp, timestamp)
        return True

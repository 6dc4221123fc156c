"""Mobile uplink: rate and delay per direction, with a drop-tail queue (thesis 8.9.3: 60 ms, 8 Mbit/s)."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field

QUEUE_BYTES = 128 * 1024


@dataclass(slots=True)
class Uplink:
    """One direction of an uplink. It is a pure model: all times are arguments.

    Attributes:
        rate_bps: Bits per second.
        delay_s: Delay from the end of transmission to arrival.
        off: True if the direction is cut. It then drops all frames, including the frames in transit.
    """

    rate_bps: float = 8e6
    delay_s: float = 0.06
    off: bool = False
    dropped: int = 0
    _free_s: float = -math.inf
    _in_transit: deque[tuple[float, bytes]] = field(default_factory=deque)

    def offer(self, frame: bytes, now_s: float) -> None:
        """Queue a frame. Drop it if the queue is full."""
        waiting_s = max(self._free_s - now_s, 0.0)
        if self.off or waiting_s * self.rate_bps / 8 > QUEUE_BYTES:
            self.dropped += 1
            return
        sent_s = max(self._free_s, now_s) + len(frame) * 8 / self.rate_bps
        self._free_s = sent_s
        self._in_transit.append((sent_s + self.delay_s, frame))

    @property
    def next_s(self) -> float:
        """Time of the next arrival. Infinite if no frame is in transit."""
        return self._in_transit[0][0] if self._in_transit else math.inf

    def advance(self, now_s: float) -> Iterator[bytes]:
        """Return the frames that have arrived by `now_s`."""
        while self._in_transit and self._in_transit[0][0] <= now_s:
            _, frame = self._in_transit.popleft()
            if not self.off:
                yield frame

"""Vehicle end of one link: framing, message streams and a bounded send queue."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from fractus_runtime.mavlink_codec import Endpoint, Message, Value, message_id

# Maximum size of queued frames for a client that does not read. Frames beyond it are dropped, as on a radio link.
OUTBOX_LIMIT = 256 * 1024
PARAMETERS_PER_TICK = 23
# Tolerance for rounding: sums of intervals differ slightly from multiples of the step.
TIME_SLACK_S = 1e-6
IMMEDIATELY = -1e9
MAX_MAVLINK1_ID = 255


@dataclass(slots=True)
class Stream:
    """A message that is sent at an interval."""

    interval_s: float
    due_s: float


class Channel(Endpoint):
    """The vehicle's end of one link."""

    def __init__(
        self,
        sysid: int,
        compid: int = 1,
        name: str = "",
        tap: Callable[[bytes], None] | None = None,
        *,
        discard: bool = False,
        port: int | None = None,
    ) -> None:
        # Simulated values that exceed the range of a message field are limited, as in the drivers of a real autopilot.
        super().__init__(sysid, compid, saturate=True)
        self.name = name
        self.port = port  # ArduPilot serial port number, selects the SRn_ parameters
        self.streams: dict[str, Stream] = {}
        self.next_due_s = 0.0
        self.peers: set[tuple[int, int]] = set()
        self.parameters: deque[int] = deque()
        self.dropped = 0
        self._defaults: dict[str, float | None] = {}
        self._outbox: deque[bytes] = deque()
        self._waiting = 0
        self._tap = tap
        self._discard = discard

    def receive(self, data: bytes) -> list[Message]:
        """Decode received bytes into messages and register their senders as peers."""
        messages = self.decode(data)
        for message in messages:
            if message.sysid and len(self.peers) < 64:
                self.peers.add((message.sysid, message.compid))
        return messages

    def send(self, name: str, values: Mapping[str, Value]) -> None:
        """Encode and queue a message of this vehicle, unless the link uses MAVLink 1, which does not define the message."""
        if self.mavlink1 and message_id(name) > MAX_MAVLINK1_ID:
            return
        frame = self.encode(name, values)
        if self._tap is not None:
            self._tap(frame)
        if not self._discard:
            self.forward(frame)

    def forward(self, frame: bytes) -> None:
        """Queue an encoded frame."""
        if self._waiting + len(frame) > OUTBOX_LIMIT:
            self.dropped += 1
            return
        self._outbox.append(frame)
        self._waiting += len(frame)

    @property
    def waiting(self) -> int:
        """Size of the queued frames in bytes."""
        return self._waiting

    @property
    def frames(self) -> deque[bytes]:
        """Queued frames, for datagram links."""
        return self._outbox

    def take_frame(self) -> bytes:
        """Remove and return the oldest queued frame."""
        frame = self._outbox.popleft()
        self._waiting -= len(frame)
        return frame

    def take(self) -> bytes:
        """Remove and return all queued bytes."""
        data = b"".join(self._outbox)
        self._outbox.clear()
        self._waiting = 0
        return data

    def set_interval(self, name: str, interval_s: float | None) -> None:
        """Send a message at an interval, or stop sending it (None)."""
        if interval_s is None:
            self.streams.pop(name, None)
        else:
            self.streams[name] = Stream(interval_s, IMMEDIATELY)
            self.next_due_s = IMMEDIATELY

    def set_default(self, name: str, interval_s: float | None) -> None:
        """Set the default interval of a message and apply it."""
        self._defaults[name] = interval_s
        self.set_interval(name, interval_s)

    def reset_interval(self, name: str) -> None:
        """Restore the default interval of a message."""
        self.set_interval(name, self._defaults.get(name))

    @property
    def next_send_s(self) -> float:
        """Vehicle time at which the next stream message or parameter is due."""
        return IMMEDIATELY if self.parameters else self.next_due_s

    def due(self, now_s: float) -> list[str]:
        """Return the names of the messages due now.

        Long-term rates are exact. Messages that were missed during a delay are not sent later.
        """
        if now_s + TIME_SLACK_S < self.next_due_s:
            return []
        names: list[str] = []
        soonest = now_s + 1.0
        for name, stream in self.streams.items():
            if stream.due_s <= now_s + TIME_SLACK_S:
                names.append(name)
                following = stream.due_s + stream.interval_s
                stream.due_s = following if following > now_s + TIME_SLACK_S else now_s + stream.interval_s
            soonest = min(soonest, stream.due_s)
        self.next_due_s = soonest
        return names

"""One link's share of the conversation: framing, its own streams and intervals, and a bounded outbox."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from fractus_runtime.mavlink_codec import Endpoint, Message, Value

# A client that does not read costs at most this much memory; what does not fit is dropped, as on a radio.
OUTBOX_LIMIT = 256 * 1024
PARAMETERS_PER_TICK = 23
# Sums of intervals round differently from multiples of the step.
TIME_SLACK_S = 1e-6
AT_ONCE = -1e9


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
        # A simulated quantity may run out of its field; a real autopilot's driver saturates as well.
        super().__init__(sysid, compid, saturate=True)
        self.name = name
        self.port = port  # the autopilot's own number of this link, which selects its SRn_ parameters
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
        """Bytes from the wire to messages; remembers who speaks here."""
        messages = self.decode(data)
        for message in messages:
            if message.sysid and len(self.peers) < 64:
                self.peers.add((message.sysid, message.compid))
        return messages

    def send(self, name: str, values: Mapping[str, Value]) -> None:
        """Queue a message of our own."""
        frame = self.encode(name, values)
        if self._tap is not None:
            self._tap(frame)
        if not self._discard:
            self.forward(frame)

    def forward(self, frame: bytes) -> None:
        """Queue a frame as it is."""
        if self._waiting + len(frame) > OUTBOX_LIMIT:
            self.dropped += 1
            return
        self._outbox.append(frame)
        self._waiting += len(frame)

    @property
    def waiting(self) -> int:
        """Bytes that wait to be sent."""
        return self._waiting

    @property
    def frames(self) -> deque[bytes]:
        """Frames that wait to be sent, for datagram links."""
        return self._outbox

    def take_frame(self) -> bytes:
        """Take the oldest waiting frame."""
        frame = self._outbox.popleft()
        self._waiting -= len(frame)
        return frame

    def take(self) -> bytes:
        """Take everything that waits to be sent."""
        data = b"".join(self._outbox)
        self._outbox.clear()
        self._waiting = 0
        return data

    def set_interval(self, name: str, interval_s: float | None) -> None:
        """Send a message at an interval from now on, or no more (None)."""
        if interval_s is None:
            self.streams.pop(name, None)
        else:
            self.streams[name] = Stream(interval_s, AT_ONCE)
            self.next_due_s = AT_ONCE

    def set_default(self, name: str, interval_s: float | None) -> None:
        """Send a message at an interval, now and whenever its default rate is asked for."""
        self._defaults[name] = interval_s
        self.set_interval(name, interval_s)

    def reset_interval(self, name: str) -> None:
        """Go back to the default rate of a message."""
        self.set_interval(name, self._defaults.get(name))

    @property
    def speaks_s(self) -> float:
        """When a stream is due or a parameter is sent next, in the vehicle's time."""
        return AT_ONCE if self.parameters else self.next_due_s

    def due(self, now_s: float) -> list[str]:
        """Names of the messages to send now; keeps long-term rates exact and never bursts to catch up."""
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

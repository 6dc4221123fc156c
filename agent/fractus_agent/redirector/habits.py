"""When a connection may be closed without a loss: between a reply and the next request, by how its client and server behave.

A request that meets a connection while it is being closed is lost, for its client notices only when it runs. So a connection is
closed as soon as its reply is complete, and where a client calls all the time, early in a rest that is long enough.

Frames of HTTP/2 that ask and answer nothing, such as pings and window updates, go both ways at any time. They are told from
requests and replies by their length: on their own they are shorter, and beside a long reply few.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from fractus_agent.redirector.nft import Endpoint
from fractus_agent.redirector.sockets import JIFFY_MS, Connection

MIN_IDLE_MS, MAX_IDLE_MS = 2 * JIFFY_MS, 500
WORK_MARGIN = 1.5
DECAY = 0.9
UNKNOWN_WORK_MS = 60.0
"""A reply may be complete once nothing has come for longer than its server usually takes to answer. How long a service works is
learned from its connections all the time."""

MIN_REPLY_BYTES, MIN_REQUEST_BYTES = 35, 31
"""HTTP/2's ping (17) and window update (13) together are shorter; a request of gRPC's has 31 where it says nothing at all."""
OPENING_BYTES = 128
"""What each end of an HTTP/2 connection sends before its first request, or reply, is less; with that it is more."""
CONTROL_SHARE = 1 / 256
"""What a client sends at most while it takes a long reply: two window updates (26) for each frame of data (16,384) are half of it."""

TALK_SHARE = 1 / 16
"""A client that sends so much while it receives takes no long reply: both talk on a stream, and rest in between."""

LONG_BYTES = 8 * 1024
LONG_IDLE_MS = 250.0
"""A long reply may pause for a segment that was lost: TCP sends it again after 200 ms."""
PAUSE_MARGIN = 2.0

NOTICE_MS = 8.0
"""What is asked of the rest that is left: the client has to run to notice that its connection was closed."""


@dataclass(frozen=True, slots=True)
class Exchange:
    """A request and its reply, as far as they were seen of a connection that is looked at again and again.

    Attributes:
        connection: as it was last.
        before_bytes: received in all before the reply, or before the first look.
        at_send: as it was when something of the client's had arrived last.
        seen: whether the request was seen.
        asked_bytes: of the request.
        previous_bytes: of the reply before; None where that was not seen as a whole, or the request not.
        pause_ms: longest silence within the reply.
        said_bytes: sent by the client since the request, in pieces too short for another one.
    """

    connection: Connection
    before_bytes: int
    at_send: Connection
    seen: bool = False
    asked_bytes: int = 0
    previous_bytes: int | None = None
    pause_ms: int = 0
    said_bytes: int = 0

    @classmethod
    def first(cls, connection: Connection) -> Exchange:
        """A connection that is looked at for the first time; it may be waiting for its first reply."""
        if connection.received_bytes < OPENING_BYTES <= connection.sent_bytes:
            return cls(connection, OPENING_BYTES - MIN_REPLY_BYTES, connection, True, connection.sent_bytes)
        return cls(connection, connection.received_bytes, connection)

    def then(self, connection: Connection) -> Exchange:
        """The same connection, looked at again."""
        more = connection.received_bytes > self.connection.received_bytes
        pause_ms = max(self.pause_ms, self.connection.received_ms) if more else self.pause_ms
        now = replace(self, connection=connection, pause_ms=pause_ms)
        sent = connection.sent_bytes - self.at_send.sent_bytes
        if not sent:
            return now
        if self.waiting:
            # A request in several segments is sent over a time; it is one as long as nothing comes.
            return replace(now, at_send=connection, asked_bytes=self.asked_bytes + sent)
        came = connection.received_bytes - self.at_send.received_bytes
        if sent < max(MIN_REQUEST_BYTES, CONTROL_SHARE * came):
            return replace(now, at_send=connection, said_bytes=self.said_bytes + sent)
        previous = self.reply_bytes if self.seen else None
        return Exchange(connection, self.connection.received_bytes, connection, True, sent, previous)

    @property
    def reply_bytes(self) -> int:
        """How much came since the request, or since the first look."""
        return self.connection.received_bytes - self.before_bytes

    @property
    def waiting(self) -> bool:
        """Whether nothing that can be a reply came since the request, however long ago that was."""
        return self.seen and self.reply_bytes < MIN_REPLY_BYTES

    @property
    def long(self) -> bool:
        """Whether the reply comes in several segments, so that it may pause within."""
        return self.reply_bytes >= LONG_BYTES and self.said_bytes < TALK_SHARE * self.reply_bytes

    @property
    def complete(self) -> bool:
        """Whether a short request was answered by a short reply, as long as the one before: a longer one may go on."""
        if self.previous_bytes is None or self.long or self.asked_bytes >= LONG_BYTES:
            return False
        expected = max(self.previous_bytes, MIN_REPLY_BYTES)
        return expected <= self.reply_bytes <= expected + MIN_REPLY_BYTES


class Habits:
    """How long services work for a request, and how long their clients rest between two, learned from their connections."""

    def __init__(self) -> None:
        self._worked_ms: dict[Endpoint, float] = {}
        self._rested_ms: dict[Endpoint, float] = {}

    def learn(self, connection: Connection) -> None:
        """Learn from a connection as it is now."""
        if connection.answered:
            known_ms = DECAY * self._worked_ms.get(connection.peer, 0.0)
            self._worked_ms[connection.peer] = max(known_ms, connection.worked_ms)
        elif rested := connection.rested_ms:
            known_ms = self._rested_ms.get(connection.peer, rested) / DECAY
            self._rested_ms[connection.peer] = min(known_ms, rested)

    def closable(self, exchange: Exchange, left: float) -> bool:
        """Whether a connection may be closed now.

        Args:
            exchange: what was seen of it.
            left: share of the time that it has for becoming idle: as it runs out, less is asked for.
        """
        connection = exchange.connection
        if exchange.waiting or not connection.answered:
            return False
        demand = min(2 * left, 1.0)
        if self._about_to_ask(connection, demand):
            return False
        if exchange.complete:
            return True
        worked_ms = max(self._worked_ms.get(connection.peer, UNKNOWN_WORK_MS), connection.worked_ms)
        idle_ms = min(WORK_MARGIN * worked_ms, MAX_IDLE_MS)
        if exchange.long:
            idle_ms = max(idle_ms, LONG_IDLE_MS, min(PAUSE_MARGIN * exchange.pause_ms, MAX_IDLE_MS))
        return connection.idle_ms >= max(idle_ms * demand, MIN_IDLE_MS)

    def _about_to_ask(self, connection: Connection, demand: float) -> bool:
        """Whether too little is left of the rest that clients of this service take."""
        rest_ms = self._rested_ms.get(connection.peer)
        # Who has rested for much longer than before has no habit that tells when the next request comes.
        if rest_ms is None or connection.received_ms >= MAX_IDLE_MS or not demand:
            return False
        return rest_ms - connection.received_ms < max(NOTICE_MS, rest_ms / 2) * demand

"""When a connection may be closed without a loss: between a reply and the next request, as its client and server usually behave.

A request that meets a connection while it is being closed is lost, for its client notices only when it runs. So a connection is
closed as soon as its reply is complete, and where a client calls all the time, early in a rest that is long enough.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from fractus_agent.redirector.nft import Endpoint
from fractus_agent.redirector.sockets import JIFFY_MS, Connection

MIN_IDLE_MS, MAX_IDLE_MS = 2 * JIFFY_MS, 500
WORK_MARGIN = 1.5
DECAY = 0.9
UNKNOWN_WORK_MS = 60.0
"""A reply may be complete once nothing has come for longer than its server usually takes to answer. Frames that answer nothing,
such as HTTP/2's pings and window updates, look like replies; so how long a service works is learned from its connections
all the time."""

MIN_REPLY_BYTES = 35
"""HTTP/2's ping (17) and window update (13) together are shorter, all replies longer."""

NOTICE_MS = 8.0
"""What is asked of the rest that is left: the client has to run to notice that its connection was closed."""


@dataclass(frozen=True, slots=True)
class Exchange:
    """What was seen of a connection while it was looked at again and again.

    Attributes:
        connection: as it was last.
        sent_at_ms: when the client last sent.
        before_bytes: received before that; None when it was not looked at then.
        usual_bytes: of the reply before; None when it was not seen.
    """

    connection: Connection
    sent_at_ms: float
    before_bytes: int | None = None
    usual_bytes: int | None = None

    @classmethod
    def first(cls, connection: Connection, now_ms: float) -> Exchange:
        """A connection that is looked at for the first time."""
        return cls(connection, now_ms - connection.sent_ms)

    def then(self, connection: Connection, now_ms: float) -> Exchange:
        """The same connection, looked at again."""
        sent_at_ms = now_ms - connection.sent_ms
        # Ages are told in steps; requests in several segments are sent over a time, and are one as long as nothing comes.
        if sent_at_ms <= self.sent_at_ms + 2 * JIFFY_MS or not self._replied:
            return replace(self, connection=connection, sent_at_ms=max(sent_at_ms, self.sent_at_ms))
        return Exchange(connection, sent_at_ms, self.connection.received_bytes, self._reply_bytes)

    @property
    def _reply_bytes(self) -> int | None:
        return None if self.before_bytes is None else self.connection.received_bytes - self.before_bytes

    @property
    def _replied(self) -> bool:
        """Whether more came since the last request than answers nothing, as far as that is known."""
        return (reply := self._reply_bytes) is None or reply >= MIN_REPLY_BYTES

    @property
    def complete(self) -> bool:
        """Whether a reply came that is as long as the one before."""
        reply, usual = self._reply_bytes, self.usual_bytes
        return reply is not None and usual is not None and reply >= max(usual, MIN_REPLY_BYTES)


class Habits:
    """How long services work for a request, and how long their clients rest between two, learned from their connections."""

    def __init__(self) -> None:
        self._worked_ms: dict[Endpoint, float] = {}
        self._rested_ms: dict[Endpoint, float] = {}

    def learn(self, connection: Connection) -> None:
        """Learn from a connection as it is now."""
        if connection.answered:
            usual = DECAY * self._worked_ms.get(connection.peer, 0.0)
            self._worked_ms[connection.peer] = max(usual, connection.worked_ms)
        elif rested := connection.rested_ms:
            usual = self._rested_ms.get(connection.peer, rested) / DECAY
            self._rested_ms[connection.peer] = min(usual, rested)

    def closable(self, exchange: Exchange, left: float) -> bool:
        """Whether a connection may be closed now.

        Args:
            exchange: what was seen of it.
            left: share of the time that is left for it: as it runs out, less is asked for.
        """
        connection = exchange.connection
        if not connection.answered:
            return False
        patience = min(2 * left, 1.0)
        if self._about_to_ask(connection, patience):
            return False
        if exchange.complete:
            return True
        worked_ms = max(self._worked_ms.get(connection.peer, UNKNOWN_WORK_MS), connection.worked_ms)
        return connection.idle_ms >= max(min(WORK_MARGIN * worked_ms, MAX_IDLE_MS) * patience, MIN_IDLE_MS)

    def _about_to_ask(self, connection: Connection, patience: float) -> bool:
        """Whether too little is left of the rest that clients of this service usually take."""
        rest_ms = self._rested_ms.get(connection.peer)
        # Who has rested for much longer than usual has no habit that tells when the next request comes.
        if rest_ms is None or connection.received_ms >= MAX_IDLE_MS:
            return False
        return rest_ms - connection.received_ms < max(NOTICE_MS, rest_ms / 2) * patience

"""The drone's path to the cloud: what it offers by the node's description, and whether it answers at this moment."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import Awaitable, Callable

from fractus_core.api.nodes import Drone, EdgeNode, direct_interface
from fractus_core.linking import PathMetrics

log = logging.getLogger(__name__)

ASK_S, ANSWER_TIMEOUT_S = 1.0, 2.0
"""Seconds between questions, and for an answer: each needs a round trip, and a packet that was lost another one."""
SILENT_S = 4.0
"""A path that has not answered for so long offers nothing."""
STEADY_S = 5.0
"""One that was silent offers something again once it has answered for so long: a path that comes and goes moves no traffic."""
WAYS = 10
"""The quickest of the last N answers tells the latency: others waited for a handshake, or behind pictures."""

_LATENCY_MS = {"Ethernet": 1.0, "WiFi": 5.0, "5G": 15.0, "4G": 60.0, "BLE": 60.0}
"""One way to the cloud before it was measured, by what the node is connected with."""
_MBPS = 8.0

Node = Drone | EdgeNode


class Answering:
    """Whether a path answers; pure: times are passed in, in seconds on one monotonic clock."""

    def __init__(self) -> None:
        self._unanswered_s: float | None = None
        self._back_s: float | None = None

    def asked(self, now_s: float) -> None:
        """A question goes out. Only these make a path silent: who was kept from asking knows nothing of it."""
        if self._unanswered_s is None:
            self._unanswered_s = now_s

    def answered(self, now_s: float) -> None:
        """An answer came."""
        if self._silent(now_s):
            self._back_s = now_s
        elif self._back_s is not None and now_s - self._back_s >= STEADY_S:
            self._back_s = None
        self._unanswered_s = None

    def works(self, now_s: float) -> bool:
        """Whether the path is to be used."""
        return self._back_s is None and not self._silent(now_s)

    def _silent(self, now_s: float) -> bool:
        return self._unanswered_s is not None and now_s - self._unanswered_s >= SILENT_S


class Uplink:
    """The path to the cloud.

    Args:
        node: the node's Drone as it is now; None while that is not known.
        ask: asks something at the other end of the path; whether an answer came within some seconds.
    """

    def __init__(self, node: Callable[[], Node | None], ask: Callable[[float], Awaitable[bool]]) -> None:
        self._node = node
        self._ask = ask
        self._answering = Answering()
        self._worked = True
        self._ways_ms: deque[float] = deque(maxlen=WAYS)

    def offers(self) -> PathMetrics | None:
        """What the path offers; None while it does not answer."""
        works = self._answering.works(time.monotonic())
        if works != self._worked:
            self._worked = works
            log.warning("links: the cloud path %s", "answers again" if works else "does not answer")
        if not works:
            return None
        return declared(self._node(), min(self._ways_ms, default=None))

    async def run(self) -> None:
        """Ask until cancelled."""
        while True:
            asked_s = time.monotonic()
            self._answering.asked(asked_s)
            if await self._ask(ANSWER_TIMEOUT_S):
                answered_s = time.monotonic()
                self._answering.answered(answered_s)
                self._ways_ms.append((answered_s - asked_s) / 2 * 1e3)
            await asyncio.sleep(ASK_S)


def declared(node: Node | None, latency_ms: float | None = None) -> PathMetrics:
    """What the path to the cloud offers, by the best of a node's other interfaces.

    Args:
        node: with its interfaces.
        latency_ms: one way, as it was measured.
    """
    interfaces = node.spec.interfaces if node is not None else ()
    direct = direct_interface(interfaces)
    best = max((each for each in interfaces if each is not direct), key=lambda each: each.bandwidth_mbps, default=None)
    rate = best.bandwidth_mbps if best is not None else _MBPS
    if latency_ms is None:
        latency_ms = _LATENCY_MS[best.technology if best is not None else "4G"]
    return PathMetrics(rate, rate, latency_ms, latency_ms)

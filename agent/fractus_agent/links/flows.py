"""What flows over a link: by service from the kernel's counters, so that a link that is in full use need not be probed."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

from fractus_agent.redirector.nft import Endpoint

WINDOW_S = 0.1
"""Pictures come in bursts: a longer window would show less than the link delivers."""
KEPT = 30
"""Windows that count."""
FULL = 0.8
"""Traffic that takes this share of what the link was found to deliver confirms it; a probe would only get in its way."""
MAX_CONFIRMED = 3
"""Times in a row: traffic that takes less than the link offers looks like a link that offers less."""


@dataclass(frozen=True, slots=True)
class Flow:
    """What a service moved over the link lately.

    Attributes:
        sent_mbps: towards the other node.
        received_mbps: from it.
    """

    sent_mbps: float = 0.0
    received_mbps: float = 0.0


class Flows:
    """Rates over the last few seconds, from counters that only grow."""

    def __init__(self) -> None:
        self._last: tuple[float, Mapping[Endpoint, tuple[int, int]]] | None = None
        self._windows: deque[tuple[float, dict[Endpoint, tuple[int, int]]]] = deque(maxlen=KEPT)

    def take(self, now_s: float, counted: Mapping[Endpoint, tuple[int, int]]) -> None:
        """Take the counters as they are now; they begin again when a service changes its path."""
        if self._last is not None and now_s > self._last[0]:
            moved = {service: _since(self._last[1].get(service), now) for service, now in counted.items()}
            self._windows.append((now_s - self._last[0], moved))
        self._last = (now_s, dict(counted))

    @property
    def peak_mbps(self) -> float:
        """The most that all services together moved in one window, both ways: radios share the air."""
        return max(
            (8e-6 * sum(s + r for s, r in moved.values()) / span_s for span_s, moved in self._windows), default=0.0
        )

    @property
    def by_service(self) -> dict[Endpoint, Flow]:
        """Mean rates."""
        span_s = sum(span_s for span_s, _ in self._windows)
        found: dict[Endpoint, Flow] = {}
        for service in {service for _, moved in self._windows for service in moved}:
            both = [moved.get(service, (0, 0)) for _, moved in self._windows]
            found[service] = Flow(8e-6 * sum(s for s, _ in both) / span_s, 8e-6 * sum(r for _, r in both) / span_s)
        return found


def _since(before: tuple[int, int] | None, now: tuple[int, int]) -> tuple[int, int]:
    """Bytes between two looks at a counter; all of them where it has begun again."""
    if before is None or now[0] < before[0] or now[1] < before[1]:
        return now
    return now[0] - before[0], now[1] - before[1]

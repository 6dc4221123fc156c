"""Traffic rates of services on a link, from the kernel's byte counters.

The rates confirm the bandwidth of a link that is in full use, so that it need not be probed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

from fractus_agent.redirector.nft_maps import Endpoint

WINDOW_S = 0.1
"""Length of a window in seconds.

Pictures are sent in bursts. A longer window would include pauses between them, so its rate would be below the bandwidth.
"""
WINDOWS = 30
"""Number of windows that are kept."""
CONFIRMING_SHARE = 0.8
"""Share of the measured bandwidth. Traffic with at least this share of the bandwidth confirms the measurement.

No probe is then sent, which would disturb the traffic.
"""
MAX_CONFIRMATIONS = 3
"""Limit of successive confirmations by traffic. The next measurement is then a probe.

Without this limit, traffic that does not fill the link would hide a higher bandwidth.
"""


@dataclass(frozen=True, slots=True)
class ServiceRate:
    """Recent traffic of a service over the link.

    Attributes:
        sent_mbps: Mean rate towards the other node, in Mbit/s.
        received_mbps: Mean rate from the other node, in Mbit/s.
    """

    sent_mbps: float = 0.0
    received_mbps: float = 0.0


class TrafficRates:
    """Rates over the last few seconds, from monotonic byte counters."""

    def __init__(self) -> None:
        self._last: tuple[float, Mapping[Endpoint, tuple[int, int]]] | None = None
        self._windows: deque[tuple[float, dict[Endpoint, tuple[int, int]]]] = deque(maxlen=WINDOWS)

    def update(self, now_s: float, counts: Mapping[Endpoint, tuple[int, int]]) -> None:
        """Add the current values of the byte counters.

        The counter of a service restarts when the service changes its path.
        """
        if self._last is not None and now_s > self._last[0]:
            moved = {service: _bytes_since(self._last[1].get(service), now) for service, now in counts.items()}
            self._windows.append((now_s - self._last[0], moved))
        self._last = (now_s, dict(counts))

    @property
    def peak_mbps(self) -> float:
        """Highest total rate of all services in one window, in Mbit/s.

        The rates of both directions are added, because the radios of the link share one channel.
        """
        return max(
            (8e-6 * sum(s + r for s, r in moved.values()) / span_s for span_s, moved in self._windows), default=0.0
        )

    @property
    def by_service(self) -> dict[Endpoint, ServiceRate]:
        """Mean rates by service."""
        span_s = sum(span_s for span_s, _ in self._windows)
        rates: dict[Endpoint, ServiceRate] = {}
        for service in {service for _, moved in self._windows for service in moved}:
            both = [moved.get(service, (0, 0)) for _, moved in self._windows]
            sent_mbps = 8e-6 * sum(sent for sent, _ in both) / span_s
            received_mbps = 8e-6 * sum(received for _, received in both) / span_s
            rates[service] = ServiceRate(sent_mbps, received_mbps)
        return rates


def _bytes_since(before: tuple[int, int] | None, now: tuple[int, int]) -> tuple[int, int]:
    """Return the bytes between two readings of a counter, or the current reading if the counter has restarted."""
    if before is None or now[0] < before[0] or now[1] < before[1]:
        return now
    return now[0] - before[0], now[1] - before[1]

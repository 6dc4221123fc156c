"""Cloud path of the drone: its declared bandwidth, measured latency and reachability."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import Awaitable, Callable

from fractus_core.api.nodes import Drone, EdgeNode, direct_interface
from fractus_core.linking import PathMetrics

log = logging.getLogger(__name__)

PROBE_S = 1.0
PROBE_TIMEOUT_S = 2.0
"""Interval and timeout of probes, in seconds. A probe takes one round trip, or more after packet loss."""
SILENT_S = 4.0
"""Time without a response after which the path counts as unreachable, in seconds."""
STEADY_S = 5.0
"""Time for which an unreachable path must respond before it counts as reachable again, in seconds.

If the path fails again within this time, the path stays unreachable. A path that fails often therefore causes few
switches.
"""
LATENCY_SAMPLES = 10
"""Number of recent samples whose minimum is the latency.

Samples above the minimum include a TLS handshake, or the time of waiting in a queue behind pictures.
"""

_LATENCY_MS = {"Ethernet": 1.0, "WiFi": 5.0, "5G": 15.0, "4G": 60.0, "BLE": 60.0}
"""Expected one-way latency to the cloud by technology, until it is measured."""
_DEFAULT_MBPS = 8.0

Node = Drone | EdgeNode


class ReachabilityMonitor:
    """Decides if a path is reachable. Pure: callers pass times in seconds on one monotonic clock."""

    def __init__(self) -> None:
        self._pending_since_s: float | None = None
        self._recovered_s: float | None = None

    def on_request(self, now_s: float) -> None:
        """Record a request. The path becomes unreachable only if a request has no response for `SILENT_S`."""
        if self._pending_since_s is None:
            self._pending_since_s = now_s

    def on_response(self, now_s: float) -> None:
        """Record a response."""
        if self._is_silent(now_s):
            self._recovered_s = now_s
        elif self._recovered_s is not None and now_s - self._recovered_s >= STEADY_S:
            self._recovered_s = None
        self._pending_since_s = None

    def is_reachable(self, now_s: float) -> bool:
        """Return True if the path may be used."""
        return self._recovered_s is None and not self._is_silent(now_s)

    def _is_silent(self, now_s: float) -> bool:
        return self._pending_since_s is not None and now_s - self._pending_since_s >= SILENT_S


class CloudPath:
    """Path to the cloud, probed by requests to the API server.

    Args:
        node: Returns the node's current Drone, None if unknown.
        probe: Sends a request with a timeout in seconds, and returns True if a response arrived.
    """

    def __init__(self, node: Callable[[], Node | None], probe: Callable[[float], Awaitable[bool]]) -> None:
        self._node = node
        self._probe = probe
        self._monitor = ReachabilityMonitor()
        self._was_reachable = True
        self._latencies_ms: deque[float] = deque(maxlen=LATENCY_SAMPLES)

    def metrics(self) -> PathMetrics | None:
        """Return the performance of the path, None while it is unreachable."""
        reachable = self._monitor.is_reachable(time.monotonic())
        if reachable != self._was_reachable:
            self._was_reachable = reachable
            log.warning("links: cloud path %s", "reachable again" if reachable else "unreachable")
        if not reachable:
            return None
        return declared_metrics(self._node(), min(self._latencies_ms, default=None))

    async def run(self) -> None:
        """Probe the path until cancelled."""
        while True:
            requested_s = time.monotonic()
            self._monitor.on_request(requested_s)
            if await self._probe(PROBE_TIMEOUT_S):
                responded_s = time.monotonic()
                self._monitor.on_response(responded_s)
                self._latencies_ms.append((responded_s - requested_s) / 2 * 1e3)
            await asyncio.sleep(PROBE_S)


def declared_metrics(node: Node | None, latency_ms: float | None = None) -> PathMetrics:
    """Return the performance of the cloud path, from the fastest interface other than the direct interface.

    Args:
        node: Node with its interfaces, None if unknown.
        latency_ms: Measured one-way latency in milliseconds, None to use the default of the technology.
    """
    interfaces = node.spec.interfaces if node is not None else ()
    direct = direct_interface(interfaces)
    best = max((each for each in interfaces if each is not direct), key=lambda each: each.bandwidth_mbps, default=None)
    rate_mbps = _DEFAULT_MBPS
    default_latency_ms = _LATENCY_MS["4G"]
    if best is not None:
        rate_mbps = best.bandwidth_mbps
        default_latency_ms = _LATENCY_MS[best.technology]
    if latency_ms is None:
        latency_ms = default_latency_ms
    return PathMetrics(rate_mbps, rate_mbps, latency_ms, latency_ms)

"""Prometheus metrics of the drone's paths: performance, current path and number of switches."""

from __future__ import annotations

from collections.abc import Iterator

from fractus_core.linking import LinkPhase, PathMetrics
from fractus_runtime.metrics import gauge
from prometheus_client import Metric
from prometheus_client.core import CounterMetricFamily

from fractus_agent.links.direct_link_store import route_key
from fractus_agent.links.link_status import DroneLinkReport

CLOUD = "cloud"

_GAUGES = {
    "fractus_path_bandwidth_mbps": (
        "path",
        "Bandwidth of a path: measured for the link that is up, otherwise expected. cloud is the cloud path.",
    ),
    "fractus_path_latency_milliseconds": ("path", "One-way latency of a path, measured or expected."),
    "fractus_path_quality": (
        "path",
        "Share of its bandwidth that a link is expected to offer at the position of the drone.",
    ),
    "fractus_link_up": ("path", "1 while the direct link to this node is up."),
    "fractus_link_attempts_failed": ("path", "Failed pairing attempts since the link last worked."),
    "fractus_traffic_direct": ("", "Number of services on the direct link."),
    "fractus_service_sent_mbps": (
        "service",
        "Traffic of a service to the other node over the link, mean of the last seconds.",
    ),
    "fractus_service_received_mbps": (
        "service",
        "Traffic of a service from the other node over the link, mean of the last seconds.",
    ),
}
"""Label and description by metric name."""


class LinkMetrics:
    """Collects metrics from the reports of the drone's link controller."""

    def __init__(self) -> None:
        self._report: DroneLinkReport | None = None
        self._switches = 0

    def update(self, report: DroneLinkReport) -> None:
        """Set the latest report."""
        before = self._report.direct if self._report is not None else frozenset()
        self._switches += len(before ^ report.direct)
        self._report = report

    def collect(self) -> Iterator[Metric]:
        """Yield all metrics."""
        description = "Changes of the path of a service."
        yield CounterMetricFamily("fractus_switches_total", description, value=self._switches)
        by_name: dict[str, dict[str, float]] = {}
        for name, key, value in self._samples():
            by_name.setdefault(name, {})[key] = value
        for name, values in by_name.items():
            label, description = _GAUGES[name]
            yield gauge(name, description, values, label)

    def _samples(self) -> Iterator[tuple[str, str, float]]:
        if (report := self._report) is None:
            return
        yield "fractus_traffic_direct", "", len(report.direct)
        for service, rate in report.rates.items():
            yield "fractus_service_sent_mbps", route_key(service), rate.sent_mbps
            yield "fractus_service_received_mbps", route_key(service), rate.received_mbps
        if report.cloud is not None:
            yield from _path_samples(CLOUD, report.cloud)
        else:
            yield "fractus_path_bandwidth_mbps", CLOUD, 0.0
        for peer, expected in report.expected.items():
            up = report.link.phase is LinkPhase.UP and report.link.peer == peer.name
            yield "fractus_link_up", peer.name, up
            learned = report.ranges.get(peer.name)
            yield "fractus_link_attempts_failed", peer.name, learned.failures if learned is not None else 0
            share = expected.ingress_mbps / peer.offers.ingress_mbps if expected is not None else 0.0
            yield "fractus_path_quality", peer.name, share
            path = report.measured if up and report.measured is not None else expected
            if path is not None:
                yield from _path_samples(peer.name, path)


def _path_samples(name: str, path: PathMetrics) -> Iterator[tuple[str, str, float]]:
    yield "fractus_path_bandwidth_mbps", name, path.ingress_mbps
    yield "fractus_path_latency_milliseconds", name, path.ingress_latency_ms

"""Metrics of the drone's paths for Prometheus: what each offers, which one is taken, how often that changed."""

from __future__ import annotations

from collections.abc import Iterator

from fractus_core.linking import PathMetrics, Phase
from fractus_runtime.figures import Figure, gauge

from fractus_agent.links.plans import route_key
from fractus_agent.links.reports import DroneReport

CLOUD = "cloud"

_GAUGES = {
    "fractus_path_bandwidth_mbps": (
        "path",
        "What a path offers: measured of the link that is up, else expected; cloud is the cloud path.",
    ),
    "fractus_path_latency_milliseconds": ("path", "How long a path takes, one way: measured or expected."),
    "fractus_path_quality": ("path", "Share of its bandwidth that a link is expected to offer where the drone is."),
    "fractus_link_up": ("path", "1 while the direct link goes to this node."),
    "fractus_link_attempts_failed": ("path", "Attempts to pair that failed since the link last worked."),
    "fractus_traffic_direct": ("", "Services that take the direct link."),
    "fractus_service_sent_mbps": (
        "service",
        "What a service moved to the other node over the link, in the last seconds.",
    ),
    "fractus_service_received_mbps": (
        "service",
        "What a service moved from the other node over the link, in the last seconds.",
    ),
}
"""Label and description by name."""


class LinkMetrics:
    """What Prometheus is told; it is made of the drone's reports."""

    def __init__(self) -> None:
        self._report: DroneReport | None = None
        self._switches = 0

    def take(self, report: DroneReport) -> None:
        """Take what the drone's end has done."""
        before = self._report.direct if self._report is not None else frozenset()
        self._switches += len(before ^ report.direct)
        self._report = report

    def collect(self) -> Iterator[Figure]:
        """All metrics."""
        what = "Changes of services' paths."
        yield Figure("fractus_switches_total", what, "counter", [("", {}, self._switches)])
        found: dict[str, dict[str, float]] = {}
        for name, key, value in self._samples():
            found.setdefault(name, {})[key] = value
        for name, values in found.items():
            label, what = _GAUGES[name]
            yield gauge(name, what, values, label)

    def _samples(self) -> Iterator[tuple[str, str, float]]:
        if (report := self._report) is None:
            return
        yield "fractus_traffic_direct", "", len(report.direct)
        for service, flow in report.flows.items():
            yield "fractus_service_sent_mbps", route_key(service), flow.sent_mbps
            yield "fractus_service_received_mbps", route_key(service), flow.received_mbps
        if report.cloud is not None:
            yield from _path(CLOUD, report.cloud)
        else:
            yield "fractus_path_bandwidth_mbps", CLOUD, 0.0
        for peer, offered in report.offers.items():
            up = report.link.phase is Phase.UP and report.link.peer == peer.name
            yield "fractus_link_up", peer.name, up
            reach = report.reaches.get(peer.name)
            yield "fractus_link_attempts_failed", peer.name, reach.failures if reach is not None else 0
            share = offered.ingress_mbps / peer.offers.ingress_mbps if offered is not None else 0.0
            yield "fractus_path_quality", peer.name, share
            if (path := report.measured if up and report.measured is not None else offered) is not None:
                yield from _path(peer.name, path)


def _path(name: str, path: PathMetrics) -> Iterator[tuple[str, str, float]]:
    yield "fractus_path_bandwidth_mbps", name, path.ingress_mbps
    yield "fractus_path_latency_milliseconds", name, path.ingress_latency_ms

"""Metrics of the drone's paths for Prometheus, on the node's loopback: what each offers, which one is taken, how often that changed."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterator

from fractus_core.linking import PathMetrics, Phase

from fractus_agent.links.plans import route_key
from fractus_agent.links.reports import DroneReport

log = logging.getLogger(__name__)

PORT = 46812
REQUEST_TIMEOUT_S = 2.0
CLOUD = "cloud"

_HELP = {
    "fractus_path_bandwidth_mbps": ("gauge", "What a path offers: measured of the link that is up, else expected."),
    "fractus_path_latency_milliseconds": ("gauge", "How long a path takes, one way: measured or expected."),
    "fractus_path_quality": ("gauge", "Share of its bandwidth that a link is expected to offer where the drone is."),
    "fractus_link_up": ("gauge", "Whether the direct link goes to this node."),
    "fractus_link_attempts_failed": ("gauge", "Attempts to pair that failed since the link last worked."),
    "fractus_traffic_direct": ("gauge", "How many services take the direct link."),
    "fractus_service_sent_mbps": (
        "gauge",
        "What a service moved to the other node over the link, in the last seconds.",
    ),
    "fractus_service_received_mbps": ("gauge", "What a service moved from the other node over the link."),
    "fractus_switches_total": ("counter", "Changes of services' paths since the agent started."),
}


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

    def text(self) -> str:
        """All metrics in Prometheus' text format."""
        lines: list[str] = []
        shown = ""
        for name, path, value in sorted(self._samples()):
            if name != shown:
                kind, what = _HELP[name]
                lines += [f"# HELP {name} {what}", f"# TYPE {name} {kind}"]
                shown = name
            kind = "service" if name.startswith("fractus_service") else "path"
            label = f'{{{kind}="{path}"}}' if path else ""
            lines.append(f"{name}{label} {value:g}")
        return "\n".join(lines) + "\n"

    def _samples(self) -> Iterator[tuple[str, str, float]]:
        yield "fractus_switches_total", "", self._switches
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


async def serve(text: Callable[[], str]) -> None:
    """Answer Prometheus on the loopback until cancelled; a port that is taken costs the metrics and nothing else."""

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            async with asyncio.timeout(REQUEST_TIMEOUT_S):
                await reader.readuntil(b"\r\n\r\n")
                body = text().encode()
                head = f"HTTP/1.1 200 OK\r\nContent-Type: text/plain; version=0.0.4\r\nContent-Length: {len(body)}\r\n"
                writer.write(head.encode() + b"Connection: close\r\n\r\n" + body)
                await writer.drain()
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError) as error:
            log.debug("links: metrics not told (error=%s)", error)
        finally:
            writer.close()

    try:
        server = await asyncio.start_server(answer, "127.0.0.1", PORT)
    except OSError as error:
        log.warning("links: no metrics (port=%d error=%s)", PORT, error)
        await asyncio.Event().wait()
        return
    async with server:
        await server.serve_forever()

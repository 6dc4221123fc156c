"""What the operator tells Prometheus; docs/metrics.md describes each name."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager
from typing import Any, Literal

from prometheus_client import CollectorRegistry, Counter, Histogram, disable_created_metrics
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest

# When a figure began says nothing that a restart does not.
disable_created_metrics()
REGISTRY = CollectorRegistry()
_SECONDS = (0.001, 0.005, 0.02, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)
_REQUEST_TIMEOUT_S = 5.0

RECONCILES = Histogram(
    "fractus_operator_reconcile_seconds",
    "How long one step of reconciliation took, waiting for the API server included.",
    ["kind"],
    buckets=_SECONDS,
    registry=REGISTRY,
)
ERRORS = Counter(
    "fractus_operator_reconcile_errors",
    "Steps of reconciliation that failed and are tried again, by why (a reason of the API server, or Bug).",
    ["kind", "reason"],
    registry=REGISTRY,
)
PHASES = Histogram(
    "fractus_operator_plan_phase_seconds",
    "How long a phase of deploying an Application took: observe, plan, grants, rollout; ways: what policies say of its way.",
    ["phase"],
    buckets=_SECONDS,
    registry=REGISTRY,
)

Phase = Literal["observe", "plan", "grants", "rollout", "ways"]


@contextmanager
def reconciling(kind: str) -> Iterator[None]:
    """Measure one step of reconciliation; one that raises counts as failed.

    Args:
        kind: Of what is reconciled.
    """
    with RECONCILES.labels(kind).time():
        try:
            yield
        except Exception as error:
            ERRORS.labels(kind, str(getattr(error, "reason", None) or "Bug")).inc()
            raise


@contextmanager
def phase(name: Phase) -> Iterator[None]:
    """Measure a phase of deploying an Application."""
    with PHASES.labels(name).time():
        yield


class Observed:
    """Figures that are read when they are asked for.

    Args:
        lease_s: For how many seconds this operator may still act; none where it does not lead.
        watches: By plural of the kind: whether its watch is open, and seconds since the API server said anything.
        phases: The phases of all Applications.
        states: The flight states of all Drones.
    """

    def __init__(
        self,
        lease_s: Callable[[], float],
        watches: Callable[[], Mapping[str, tuple[bool, float]]] = dict,
        phases: Callable[[], Iterable[str]] = tuple,
        states: Callable[[], Iterable[str]] = tuple,
    ) -> None:
        self._lease_s = lease_s
        self._watches = watches
        self._phases = phases
        self._states = states

    def collect(self) -> Iterator[Any]:
        """The figures as they are now."""
        lease = GaugeMetricFamily(
            "fractus_operator_lease_left_seconds", "For how long this operator may still act; 0: it does not lead."
        )
        lease.add_metric([], self._lease_s())
        yield lease
        is_open = GaugeMetricFamily(
            "fractus_operator_watch_open", "1 while the watch of a kind is open.", labels=["kind"]
        )
        age = GaugeMetricFamily(
            "fractus_operator_watch_age_seconds",
            "Seconds since the API server said anything about a kind; it does at least about every minute.",
            labels=["kind"],
        )
        for kind, (watching, age_s) in self._watches().items():
            is_open.add_metric([kind], float(watching))
            age.add_metric([kind], age_s)
        yield from (is_open, age)
        for name, help_, label, values in (
            ("fractus_applications", "Applications by phase.", "phase", self._phases()),
            ("fractus_drones", "Drones by flight state.", "state", self._states()),
        ):
            family = GaugeMetricFamily(name, help_, labels=[label])
            counts: dict[str, int] = {}
            for value in values:
                counts[value] = counts.get(value, 0) + 1
            for value, count in sorted(counts.items()):
                family.add_metric([value], count)
            yield family


@asynccontextmanager
async def serving(port: int, observed: Callable[[], Observed]) -> AsyncIterator[None]:
    """Answer GET /metrics in this event loop, which is where the figures are.

    Args:
        port: Where; 0: nowhere.
        observed: What is read when it is asked for.
    """

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            async with asyncio.timeout(_REQUEST_TIMEOUT_S):
                head = await reader.readuntil(b"\r\n\r\n")
                writer.write(_response(head, observed()))
                await writer.drain()
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass
        finally:
            writer.close()

    if not port:
        yield
        return
    server = await asyncio.start_server(answer, None, port)
    try:
        yield
    finally:
        server.close()


def _response(head: bytes, observed: Observed) -> bytes:
    if not head.startswith((b"GET /metrics ", b"GET /metrics?")):
        return b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
    now = CollectorRegistry()
    now.register(observed)
    body = generate_latest(REGISTRY) + generate_latest(now)
    head = f"HTTP/1.1 200 OK\r\nContent-Type: {CONTENT_TYPE_LATEST}\r\nContent-Length: {len(body)}\r\n".encode()
    return head + b"Connection: close\r\n\r\n" + body

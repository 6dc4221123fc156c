"""Prometheus metrics of a process: builders of metrics, and an HTTP endpoint in the process's event loop.

The metrics are read from objects that belong to the event loop, so the endpoint runs in that loop. The HTTP server of
`prometheus_client` would read them in other threads.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import threading
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Generic, TypeVar

from prometheus_client import CONTENT_TYPE_PLAIN_0_0_4, Metric, disable_created_metrics, generate_latest
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

log = logging.getLogger(__name__)

CERTIFICATE_EXPIRY = "fractus_certificate_expiry_timestamp_seconds"
"""Metric name shared by all workloads that have a certificate."""

MAX_CONNECTIONS = 4
"""Limit of connections that are served at the same time. Further connections wait in the kernel's queue.

The limit is needed because any host that reaches the node can connect.
"""
REQUEST_TIMEOUT_S = 5.0
MAX_REQUEST_BYTES = 8192
RETRY_S = 1.0
"""Delay before the first retry to bind an address in use. It doubles with each retry."""
MAX_RETRY_S = 60.0
ACCEPT_RETRY_S = 0.1
"""Delay after a failed accept, for example if no file descriptor is free."""
ACCEPT_INTERVAL_S = 0.05
"""Seconds between two accepted connections, which limits responses to 20 per second."""

T = TypeVar("T")

# Creation times of counters are separate time series of no use here.
disable_created_metrics()


def gauge(name: str, description: str, value: float | Mapping[str, float], label: str = "") -> Metric:
    """Return a gauge.

    Args:
        name: Name of the metric, including its unit.
        description: HELP text.
        value: Value of the gauge, or values by value of the label.
        label: Name of the label if there are several values.
    """
    if not isinstance(value, Mapping):
        return GaugeMetricFamily(name, description, value=value)
    metric = GaugeMetricFamily(name, description, labels=[label] if label else [])
    for key, number in value.items():
        metric.add_metric([key] if label else [], number)
    return metric


def hash_number(hash_: str) -> int:
    """Return the first 13 hexadecimal digits of a hash as a number: 52 bits, which a metric stores exactly."""
    return int(hash_[:13], 16)


@dataclass(frozen=True, slots=True)
class _Collected(Collector):
    metrics: Iterable[Metric]

    def collect(self) -> Iterable[Metric]:
        return self.metrics


def metrics_text(metrics: Iterable[Metric]) -> bytes:
    """Return metrics in Prometheus' text format."""
    return generate_latest(_Collected(metrics))


class BackgroundReader(Generic[T]):
    """A value that is read from disk in a thread, for an event loop that must not wait for the disk.

    Each call returns the value of the last completed read and starts another read, unless one is still running.

    Args:
        read: Reads the value. The first read runs in the calling thread.
    """

    def __init__(self, read: Callable[[], T]) -> None:
        self._read = read
        self._last = read()
        self._thread: threading.Thread | None = None

    def __call__(self) -> T:
        """Return the value of the last completed read."""
        if self._thread is None or not self._thread.is_alive():
            self._thread = threading.Thread(target=self._refresh, name="metrics", daemon=True)
            self._thread.start()
        return self._last

    def _refresh(self) -> None:
        try:
            self._last = self._read()
        except Exception:
            log.exception("metrics: value not read")


@asynccontextmanager
async def serve_metrics(listen: str, collect: Callable[[], Iterable[Metric]]) -> AsyncIterator[None]:
    """Serve GET /metrics inside the `async with` block.

    If the address cannot be bound, the failure is logged and the attempt repeated. Until then the process has no metrics.

    Args:
        listen: HOST:PORT. An empty host stands for all addresses. If `listen` is empty, nothing is served.
        collect: Returns the current metrics. Called in this event loop.
    """
    if not listen:
        yield
        return
    server = None
    try:
        server = await _bind(listen)
    except (OverflowError, ValueError) as error:
        log.warning("metrics: not served, use HOST:PORT (address=%s error=%s)", listen, error)
        yield
        return
    except OSError as error:
        log.warning("metrics: not served until the address can be bound (address=%s error=%s)", listen, error)
    serving = asyncio.create_task(_serve(server, listen, collect))
    try:
        yield
    finally:
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)
        if server is not None:
            server.close()


async def _bind(listen: str) -> socket.socket:
    """Return a listening socket.

    Raises:
        OSError: The address cannot be bound now.
        OverflowError: The port is out of range.
        ValueError: The port is not a number.
    """
    host, _, port = listen.rpartition(":")
    if host:
        loop = asyncio.get_running_loop()
        candidates = await loop.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_STREAM)
        family, _, _, _, address = candidates[0]
        server = socket.create_server(address, family=family)
    elif socket.has_dualstack_ipv6():
        server = socket.create_server(("", int(port)), family=socket.AF_INET6, dualstack_ipv6=True)
    else:
        server = socket.create_server(("", int(port)))
    server.setblocking(False)
    return server


async def _serve(server: socket.socket | None, listen: str, collect: Callable[[], Iterable[Metric]]) -> None:
    """Accept connections. If there is no socket yet, retry to bind the address first."""
    delay_s = RETRY_S
    while server is None:
        await asyncio.sleep(delay_s)
        delay_s = min(2 * delay_s, MAX_RETRY_S)
        with contextlib.suppress(OSError):
            server = await _bind(listen)
            log.info("metrics: served (address=%s)", listen)
    with server:
        await _accept(server, collect)


async def _accept(server: socket.socket, collect: Callable[[], Iterable[Metric]]) -> None:
    loop = asyncio.get_running_loop()
    slots = asyncio.Semaphore(MAX_CONNECTIONS)
    async with asyncio.TaskGroup() as responses:
        while True:
            await slots.acquire()
            try:
                connection, _ = await loop.sock_accept(server)
            except OSError as error:
                log.debug("metrics: connection not accepted (error=%s)", error)
                slots.release()
                await asyncio.sleep(ACCEPT_RETRY_S)
            else:
                responses.create_task(_respond(connection, collect)).add_done_callback(lambda _: slots.release())
                # The port may be reachable for every pod, and the flight shares this event loop.
                await asyncio.sleep(ACCEPT_INTERVAL_S)


async def _respond(connection: socket.socket, collect: Callable[[], Iterable[Metric]]) -> None:
    loop = asyncio.get_running_loop()
    with connection:
        connection.setblocking(False)
        try:
            async with asyncio.timeout(REQUEST_TIMEOUT_S):
                request = b""
                while b"\r\n\r\n" not in request and len(request) < MAX_REQUEST_BYTES:
                    received = await loop.sock_recv(connection, MAX_REQUEST_BYTES)
                    if not received:
                        return
                    request += received
                await loop.sock_sendall(connection, _response(request, collect))
        except (OSError, TimeoutError) as error:
            log.debug("metrics: response not sent (error=%s)", error)


def _response(request: bytes, collect: Callable[[], Iterable[Metric]]) -> bytes:
    if not request.startswith((b"GET /metrics ", b"GET /metrics?")):
        return _http("404 Not Found", b"")
    try:
        return _http("200 OK", metrics_text(collect()))
    except Exception:
        # A metric that cannot be collected must not end the process that it describes.
        log.exception("metrics: collection failed")
        return _http("500 Internal Server Error", b"")


def _http(status: str, body: bytes) -> bytes:
    headers = {
        "Content-Type": CONTENT_TYPE_PLAIN_0_0_4,
        "Content-Length": str(len(body)),
        "Connection": "close",
    }
    lines = [f"HTTP/1.1 {status}", *(f"{name}: {value}" for name, value in headers.items())]
    return "\r\n".join(lines).encode() + b"\r\n\r\n" + body

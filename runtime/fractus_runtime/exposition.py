"""Answers GET /metrics from an event loop that has a drone to fly: few requests at once, and few a second."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any, Generic, TypeVar

from fractus_runtime.figures import CONTENT_TYPE

LOG = logging.getLogger(__name__)

CERTIFICATE_EXPIRY = "fractus_certificate_expiry_timestamp_seconds"
"""The one name under which every workload tells of its certificate."""

MAX_CONNECTIONS = 4
"""Answered at once; others wait in the kernel's queue, or are refused by it."""
PAUSE_S = 0.05
"""Between two that are accepted: a client that asks without end gets 20 answers a second, and the loop has the rest of its time."""
REQUEST_TIMEOUT_S = 5.0
RETRY_S = 1.0
"""After which an address that was taken is tried again; twice as long each time, up to the next."""
MAX_RETRY_S = 60.0
MAX_REQUEST_BYTES = 8192

T = TypeVar("T")


class LastRead(Generic[T]):
    """A figure on disk, for an event loop that must not wait for one: a call tells what was read last, and has it read again.

    Args:
        read: reads it; called in a thread, and here once.
    """

    def __init__(self, read: Callable[[], T]) -> None:
        self._read = read
        self._last = read()
        self._reading: threading.Thread | None = None

    def __call__(self) -> T:
        """What was read last; a reading that hangs is not begun a second time."""
        if self._reading is None or not self._reading.is_alive():
            self._reading = threading.Thread(target=self._again, name="figures", daemon=True)
            self._reading.start()
        return self._last

    def _again(self) -> None:
        try:
            self._last = self._read()
        except Exception:
            LOG.exception("metrics: a figure cannot be read")


@asynccontextmanager
async def serving(listen: str, text: Callable[[], bytes]) -> AsyncIterator[None]:
    """Answer GET /metrics meanwhile; an address that is taken is tried again, and costs the metrics and nothing else.

    Args:
        listen: HOST:PORT, all addresses where the host is empty; empty: nowhere.
        text: makes the answer, in this event loop, which is where the figures are.
    """
    if not listen:
        yield
        return
    server = None
    try:
        server = await _bound(listen)
    except (OverflowError, ValueError) as error:
        LOG.warning("metrics: not served (address=%s error=%s)", listen, error)
        yield
        return
    except OSError as error:
        LOG.warning("metrics: not served until the address can be bound (address=%s error=%s)", listen, error)
    answering = asyncio.create_task(_answer_all(server, listen, text))
    try:
        yield
    finally:
        answering.cancel()
        await asyncio.gather(answering, return_exceptions=True)
        if server is not None:
            server.close()


async def _bound(listen: str) -> socket.socket:
    """A socket that listens.

    Raises:
        OSError: the address cannot be bound now.
        OverflowError: its port is none.
        ValueError: it is none.
    """
    host, _, port = listen.rpartition(":")
    if host:
        loop = asyncio.get_running_loop()
        found = await loop.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_STREAM)
        family, _, _, _, address = found[0]
        server = socket.create_server(address, family=family)
    elif socket.has_dualstack_ipv6():
        server = socket.create_server(("", int(port)), family=socket.AF_INET6, dualstack_ipv6=True)
    else:
        server = socket.create_server(("", int(port)))
    server.setblocking(False)
    return server


async def _answer_all(server: socket.socket | None, listen: str, text: Callable[[], bytes]) -> None:
    """Answer at a socket, or at the address once it can be bound."""
    delay_s = RETRY_S
    while server is None:
        await asyncio.sleep(delay_s)
        delay_s = min(2 * delay_s, MAX_RETRY_S)
        with contextlib.suppress(OSError):
            server = await _bound(listen)
            LOG.info("metrics: served (address=%s)", listen)
    with server:
        await _accept(server, text)


async def _accept(server: socket.socket, text: Callable[[], bytes]) -> None:
    loop = asyncio.get_running_loop()
    slots = asyncio.Semaphore(MAX_CONNECTIONS)
    async with asyncio.TaskGroup() as answers:
        while True:
            await slots.acquire()
            try:
                connection, _ = await loop.sock_accept(server)
            except OSError as error:
                # Out of file descriptors, or a peer that was gone at once.
                LOG.debug("metrics: not accepted (error=%s)", error)
                slots.release()
            else:
                answers.create_task(_answer(connection, text)).add_done_callback(lambda _: slots.release())
            await asyncio.sleep(PAUSE_S)


async def _answer(connection: socket.socket, text: Callable[[], bytes]) -> None:
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
                await loop.sock_sendall(connection, _response(request, text))
        except (OSError, TimeoutError) as error:
            LOG.debug("metrics: not told (error=%s)", error)


def _response(request: bytes, text: Callable[[], bytes]) -> bytes:
    if not request.startswith((b"GET /metrics ", b"GET /metrics?")):
        return _http("404 Not Found", b"")
    try:
        return _http("200 OK", text())
    except Exception:
        # A figure that cannot be had is no reason to end what is observed.
        LOG.exception("metrics: a figure failed")
        return _http("500 Internal Server Error", b"")


def _http(status: str, body: bytes) -> bytes:
    fields: dict[str, Any] = {"Content-Type": CONTENT_TYPE, "Content-Length": len(body), "Connection": "close"}
    lines = [f"HTTP/1.1 {status}", *(f"{name}: {value}" for name, value in fields.items())]
    return "\r\n".join(lines).encode() + b"\r\n\r\n" + body

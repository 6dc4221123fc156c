"""Mutually authenticated gRPC channel to a node service that survives service restarts and certificate renewal."""

from __future__ import annotations

import asyncio
import random
import weakref
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any, Self

import grpc
import grpc.aio

from fractus.environment import Endpoint
from fractus.errors import NotConfigured, Unavailable, decision_of, translate
from fractus.tracing import traced

CALL_TIMEOUT_S = 10.0
RECONNECT_TIMEOUT_S = 30.0
"""Time for which a call retries while the service restarts. After its start, the service gives a driver 15 s to reconnect."""

WAITING_CODES = frozenset({"Suspended", "ContactLost"})
"""Codes of motions that have to wait: for the end of a corrected leg, or for contact with the API server."""

MAX_RETRY_DELAY_S = 2.0
"""Longest delay between two attempts."""

NOT_RETRIED = frozenset({"Arm", "SetVelocity"})
"""Methods that are not retried, because a late repetition would have an effect that the caller no longer expects."""

_OPTIONS = (
    ("grpc.keepalive_time_ms", 10_000),
    ("grpc.keepalive_timeout_ms", 5_000),
    ("grpc.keepalive_permit_without_calls", 0),
    ("grpc.http2.max_pings_without_data", 0),
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.min_reconnect_backoff_ms", 5_000),  # a handshake may take this long on a busy node
    ("grpc.max_reconnect_backoff_ms", 1_000),
    ("grpc.enable_retries", 0),
    ("grpc.enable_http_proxy", 0),
    ("grpc.max_receive_message_length", 8 * 2**20),
)

_FILES = ("ca.crt", "tls.key", "tls.crt")
_REMEDY = "set FRACTUS_TLS_DIR to the directory of this component's tls.crt, tls.key and ca.crt"
_Stamp = tuple[tuple[int, int, int], ...]


def backoff(
    first_s: float = 0.1, cap_s: float = MAX_RETRY_DELAY_S, rng: random.Random | None = None
) -> Iterator[float]:
    """Yield delays in seconds that double from `first_s` to `cap_s`, each reduced by a random jitter of up to 50 %.

    `fractus_runtime.backoff` has the same delays for services, agent and operator. The SDK imports only the generated stubs.
    """
    draw = (rng or random).uniform
    delay = first_s
    while True:
        yield delay * draw(0.5, 1.0)
        delay = min(delay * 2, cap_s)


@dataclass(eq=False, slots=True)
class _Connection:
    channel: Any
    stub: Any
    stamp: _Stamp
    calls: int = 0


class ServiceChannel:
    """gRPC channel to one service of one node.

    When the certificate files change, new calls use a new connection. The old connection is closed after its last
    call, so certificate renewal never interrupts a flight.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        stub: Callable[[Any], Any],
        *,
        timeout_s: float = CALL_TIMEOUT_S,
        reconnect_timeout_s: float = RECONNECT_TIMEOUT_S,
    ) -> None:
        self.address = endpoint.address
        self._endpoint = endpoint
        self._make_stub = stub
        self._timeout_s = timeout_s
        self.reconnect_timeout_s = reconnect_timeout_s
        self._connection: _Connection | None = None
        self._retired: set[_Connection] = set()
        self._outdated: weakref.WeakSet[grpc.aio.AioRpcError] = weakref.WeakSet()

    async def close(self) -> None:
        """Close all connections and cancel their calls."""
        connections = [*self._retired, *([self._connection] if self._connection else [])]
        self._retired.clear()
        self._connection = None
        for connection in connections:
            await connection.channel.close()

    @asynccontextmanager
    async def stub(self) -> AsyncIterator[Any]:
        """Return the service's stub on a connection that stays open until the block ends."""
        if self._connection is None or self._connection.stamp != self._stamp():
            fresh = self._connect()
            if self._connection is not None:
                self._retired.add(self._connection)
            self._connection = fresh
        connection = self._connection
        connection.calls += 1
        try:
            yield connection.stub
        except grpc.aio.AioRpcError as error:
            # The service ends a stream when the certificate that opened the connection expires.
            if error.code() is grpc.StatusCode.UNAUTHENTICATED and connection.stamp != self._stamp():
                # All calls of this connection end together and may be retried with the new certificate.
                self._outdated.add(error)
            raise
        finally:
            connection.calls -= 1
            await self._close_unused()

    def transient(self, error: grpc.aio.AioRpcError) -> bool:
        """Return True if a retry may succeed: the service is unreachable, or the certificate was renewed during the call."""
        return error in self._outdated or error.code() is grpc.StatusCode.UNAVAILABLE

    async def unary(self, method: str, request: Any, *, timeout_s: float | None = None) -> Any:
        """Call a method with a deadline.

        The call is retried for at most `reconnect_timeout_s` while the service restarts, unless it is in `NOT_RETRIED`.

        Raises:
            FractusError: One of the typed errors; `Unavailable` if the service did not return in time.
        """
        retries = Retries(self, method, retried=method not in NOT_RETRIED)
        while True:
            try:
                async with self.stub() as stub:
                    return await getattr(stub, method)(request, timeout=timeout_s or self._timeout_s)
            except grpc.aio.AioRpcError as error:
                await retries.pause(error)

    async def stream(self, method: str, request: Any) -> AsyncGenerator[Any, None]:
        """Yield the messages of a stream, and reopen it after the service restarts.

        Raises:
            FractusError: One of the typed errors; `Unavailable` if the service did not return in time.
        """
        retries = Retries(self, method)
        while True:
            try:
                async with self.stub() as stub:
                    call = getattr(stub, method)(request)
                    try:
                        async for message in call:
                            yield message
                            retries.reset()
                    finally:
                        call.cancel()
            except grpc.aio.AioRpcError as error:
                await retries.pause(error)
            else:
                return

    async def _close_unused(self) -> None:
        for connection in [c for c in self._retired if not c.calls]:
            self._retired.discard(connection)
            await connection.channel.close()

    def _stamp(self) -> _Stamp:
        try:
            files = [(self._endpoint.tls_dir / name).stat() for name in _FILES]
        except OSError as error:
            raise self._unreadable(error) from None
        return tuple((s.st_mtime_ns, s.st_size, s.st_ino) for s in files)

    @staticmethod
    def _unreadable(error: OSError) -> NotConfigured:
        return NotConfigured(f"the certificate {error.filename} cannot be read: {error.strerror}; {_REMEDY}")

    def _connect(self) -> _Connection:
        stamp = self._stamp()
        for _ in range(3):  # Retry if a file changed during reading, because key and certificate must belong together.
            try:
                ca, key, chain = ((self._endpoint.tls_dir / name).read_bytes() for name in _FILES)
            except OSError as error:
                raise self._unreadable(error) from None
            previous_stamp = stamp
            stamp = self._stamp()
            if previous_stamp == stamp:
                break
        for name, content in zip(_FILES, (ca, key, chain), strict=True):
            # With an invalid PEM file, gRPC would retry the connection indefinitely without reporting the cause.
            if b"-----BEGIN " not in content:
                raise NotConfigured(f"{self._endpoint.tls_dir / name} is not a PEM file; {_REMEDY}")
        credentials = grpc.ssl_channel_credentials(ca, key, chain)
        options = (*_OPTIONS, ("grpc.ssl_target_name_override", self._endpoint.server_name))
        channel = grpc.aio.secure_channel(self.address, credentials, options=options)
        return _Connection(channel, self._make_stub(traced(channel)), stamp)


class Retries:
    """Retry policy of one call while its service restarts: delays, and when to give up.

    Args:
        channel: Channel of the call.
        method: Name of the method, for error messages.
        max_delay_s: Longest delay between two attempts, in seconds.
        retried: False if the call must not be retried.
    """

    def __init__(
        self, channel: ServiceChannel, method: str, *, max_delay_s: float = MAX_RETRY_DELAY_S, retried: bool = True
    ) -> None:
        self._channel = channel
        self._method = method
        self._max_delay_s = max_delay_s
        self._retried = retried
        self.reset()

    def reset(self) -> None:
        """Reset delays and deadline after a response of the service."""
        self._delays = backoff(cap_s=self._max_delay_s)
        self._give_up: float | None = None

    async def pause(self, error: grpc.aio.AioRpcError | None = None) -> None:
        """Wait before the next attempt.

        While a motion has to wait for another leg or for contact, attempts continue, because the service responds.

        Args:
            error: Failure of the last attempt; None if the service ended the stream.

        Raises:
            FractusError: The reason why there is no further attempt.
        """
        now = asyncio.get_running_loop().time()
        delay = next(self._delays)
        decision = decision_of(error) if error is not None else None
        if decision is not None and decision.code in WAITING_CODES:
            self._give_up = None
        self._give_up = self._give_up or now + self._channel.reconnect_timeout_s
        transient = error is None or self._channel.transient(error)
        if not (transient and self._retried) or now + delay > self._give_up:
            if error is None:
                raise Unavailable(f"{self._method}: the service ended the stream")
            raise translate(error, self._method, self._channel.address) from None
        await asyncio.sleep(delay)


class ServiceClient:
    """Client of one service of one node, as an asynchronous context manager that closes the connection."""

    _channel: ServiceChannel

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connection."""
        await self._channel.close()

"""A mutually authenticated connection to a node service that outlives its restarts and our certificates."""

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
from fractus.errors import NotConfigured, Unavailable, translate
from fractus.tracing import traced

CALL_TIMEOUT_S = 10.0
RECONNECT_TIMEOUT_S = 30.0
"""How long a call waits for a service that is restarting: once it runs it gives a drone's driver 15 s to come back."""

MAX_RETRY_DELAY_S = 2.0
"""The longest pause between two attempts."""

NOT_RETRIED = frozenset({"Arm", "SetVelocity"})
"""Methods that are for this moment: repeated late, they would do what is no longer wanted."""

_OPTIONS = (
    ("grpc.keepalive_time_ms", 10_000),
    ("grpc.keepalive_timeout_ms", 5_000),
    ("grpc.keepalive_permit_without_calls", 0),
    ("grpc.http2.max_pings_without_data", 0),
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.min_reconnect_backoff_ms", 5_000),  # as long may a handshake take on a busy node
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
    """Delays that double from `first_s` to `cap_s`, each jittered down by up to half."""
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
    retired: bool = False


class ServiceChannel:
    """Calls on one service of one node.

    Certificates are read again when their files change: calls that begin then use a new connection, and the old one
    closes after its last call, so that renewal never interrupts a flight.
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
        """Close every connection; calls in flight are cancelled."""
        connections = [*self._retired, *([self._connection] if self._connection else [])]
        self._retired.clear()
        self._connection = None
        for connection in connections:
            await connection.channel.close()

    @asynccontextmanager
    async def stub(self) -> AsyncIterator[Any]:
        """The service's stub on a connection that stays open until the block ends."""
        connection = self._current()
        connection.calls += 1
        try:
            yield connection.stub
        except grpc.aio.AioRpcError as error:
            # A stream may outlive the certificate that it was opened with.
            if error.code() is grpc.StatusCode.UNAUTHENTICATED and connection.stamp != self._stamp():
                # All that were opened with it end together.
                self._outdated.add(error)
            raise
        finally:
            connection.calls -= 1
            await self._close_unused()

    def transient(self, error: grpc.aio.AioRpcError) -> bool:
        """Whether another attempt may succeed: the service is away, or the certificate was renewed since the call began."""
        return error in self._outdated or error.code() is grpc.StatusCode.UNAVAILABLE

    async def unary(self, method: str, request: Any, *, timeout_s: float | None = None) -> Any:
        """One call with a deadline; while the service restarts it is tried again, for `reconnect_timeout_s` at most, unless in `NOT_RETRIED`.

        Raises:
            FractusError: one of the typed errors; `Unavailable` when the service did not come back.
        """
        retries = Retries(self, method, retried=method not in NOT_RETRIED)
        while True:
            try:
                async with self.stub() as stub:
                    return await getattr(stub, method)(request, timeout=timeout_s or self._timeout_s)
            except grpc.aio.AioRpcError as error:
                await retries.pause(error)

    async def stream(self, method: str, request: Any) -> AsyncGenerator[Any, None]:
        """The messages of a stream that is opened again after the service restarts.

        Raises:
            FractusError: one of the typed errors; `Unavailable` when the service did not come back.
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

    def _current(self) -> _Connection:
        stamp = self._stamp()
        current = self._connection
        if current is not None and current.stamp == stamp:
            return current
        fresh = self._connect()
        if current is not None:
            current.retired = True
            self._retired.add(current)
        self._connection = fresh
        return fresh

    async def _close_unused(self) -> None:
        for connection in [c for c in self._retired if not c.calls]:
            self._retired.discard(connection)
            await connection.channel.close()

    def _stamp(self) -> _Stamp:
        try:
            found = [(self._endpoint.tls_dir / name).stat() for name in _FILES]
        except OSError as error:
            raise self._unreadable(error) from None
        return tuple((s.st_mtime_ns, s.st_size, s.st_ino) for s in found)

    @staticmethod
    def _unreadable(error: OSError) -> NotConfigured:
        return NotConfigured(f"the certificate {error.filename} cannot be read: {error.strerror}; {_REMEDY}")

    def _connect(self) -> _Connection:
        stamp = self._stamp()
        for _ in range(3):  # until no file changed while we read: key and certificate must belong together
            try:
                ca, key, chain = ((self._endpoint.tls_dir / name).read_bytes() for name in _FILES)
            except OSError as error:
                raise self._unreadable(error) from None
            before, stamp = stamp, self._stamp()
            if before == stamp:
                break
        for name, content in zip(_FILES, (ca, key, chain), strict=True):
            # gRPC itself would only fail to connect, indefinitely and without a word of this.
            if b"-----BEGIN " not in content:
                raise NotConfigured(f"{self._endpoint.tls_dir / name} is no PEM file; {_REMEDY}")
        credentials = grpc.ssl_channel_credentials(ca, key, chain)
        options = (*_OPTIONS, ("grpc.ssl_target_name_override", self._endpoint.server_name))
        channel = grpc.aio.secure_channel(self.address, credentials, options=options)
        return _Connection(channel, self._make_stub(traced(channel)), stamp)


class Retries:
    """The pauses between attempts at one call while its service restarts, and when to give up.

    Args:
        channel: where the call goes.
        method: what is called.
        max_delay_s: the longest pause.
        retried: whether the call may be tried again at all.
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
        """The service has answered: the next failure is a first one."""
        self._delays = backoff(cap_s=self._max_delay_s)
        self._give_up: float | None = None

    async def pause(self, error: grpc.aio.AioRpcError | None = None) -> None:
        """Wait before the next attempt, after a failure or the end of a stream (None).

        Raises:
            FractusError: there is no other attempt; this is why.
        """
        now, delay = asyncio.get_running_loop().time(), next(self._delays)
        self._give_up = self._give_up or now + self._channel.reconnect_timeout_s
        transient = error is None or self._channel.transient(error)
        if not (transient and self._retried) or now + delay > self._give_up:
            if error is None:
                raise Unavailable(f"{self._method}: the service ended the stream")
            raise translate(error, self._method, self._channel.address) from None
        await asyncio.sleep(delay)


class ServiceClient:
    """A client of one service of one node; `async with` closes it."""

    _channel: ServiceChannel

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connection."""
        await self._channel.close()

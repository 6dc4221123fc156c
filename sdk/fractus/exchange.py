"""Requests between components of an application. They are repeated until a response arrives, and processed once.

When traffic moves to another network path, connections break: a request may arrive twice, or its response may be lost.
Each request therefore has an id, and its repetitions have the same id. The responder stores its responses for some time.
If a request is repeated, it returns the stored response instead of calling the handler again. A repetition may reach
another instance than the first attempt. A component that collects results must therefore drop results with a `Request.id` that
it already received.

An id is valid for one client. Each `Requester` identifies itself by a random secret, so that no other client can use up its ids
or read the responses to them. The network address does not identify a client, because it changes with the path.

The connections are not encrypted.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
import math
import signal
import uuid
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

import grpc

from fractus.channel import backoff
from fractus.environment import egress
from fractus.errors import InvalidRequest, Unavailable

log = logging.getLogger(__name__)

SERVICE = "fractus.exchange"
ID_HEADER = "fractus-request-id"
ATTEMPT_HEADER = "fractus-attempt"
CLIENT_HEADER = "fractus-client"
MAX_BODY_BYTES = 16 * 2**20
TIMEOUT_S = 30.0
ATTEMPT_TIMEOUT_S = 5.0
MAX_DELAY_S = 0.5
CONNECTION_AGE_S = 30.0
CONNECTION_GRACE_S = 10.0
MAX_STORED_RESPONSES = 4096
MAX_STORED_BYTES = 16 * 2**20
_MAX_ID_LENGTH = 200
_MAX_ATTEMPT_LENGTH = 9

_REPEATED = frozenset(
    {
        grpc.StatusCode.UNAVAILABLE,
        grpc.StatusCode.DEADLINE_EXCEEDED,
        grpc.StatusCode.CANCELLED,
        grpc.StatusCode.INTERNAL,
    }
)
_LENGTHS = (
    ("grpc.max_send_message_length", MAX_BODY_BYTES + 1024),
    ("grpc.max_receive_message_length", MAX_BODY_BYTES + 1024),
)
_CLIENT = (
    *_LENGTHS,
    ("grpc.enable_http_proxy", 0),
    # Detect a silent path within 4 s, and reconnect quickly.
    ("grpc.keepalive_time_ms", 2000),
    ("grpc.keepalive_timeout_ms", 2000),
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.min_reconnect_backoff_ms", 1000),
    ("grpc.max_reconnect_backoff_ms", 1000),
)


@dataclass(frozen=True, slots=True)
class Request:
    """A request to a component.

    Attributes:
        id: Id, unique for its client and the same in every repetition. An id with another body is refused.
        method: Name of the requested method.
        body: Content in a format that the components agree on.
        attempt: Number of the attempt, from 1.
        client: Secret of the `Requester` that sends the request. Empty if it has none, as in earlier releases.
    """

    id: str
    method: str
    body: bytes
    attempt: int = 1
    client: str = field(default="", repr=False)


Handler = Callable[[Request], Awaitable[bytes]]
_Key = tuple[str, str, str]


class _StoredResponse(NamedTuple):
    digest: bytes
    task: asyncio.Task[bytes]


class StoredResponses:
    """Stored responses by client, method and request id, so that no request is processed twice. The oldest are removed first.

    Args:
        count: Maximum number of stored responses.
        size: Maximum size of all stored responses, in bytes.
    """

    def __init__(self, count: int = MAX_STORED_RESPONSES, size: int = MAX_STORED_BYTES) -> None:
        self._count = count
        self._free_bytes = size
        self._stored: OrderedDict[_Key, _StoredResponse] = OrderedDict()
        self.repeated = 0

    async def once(self, request: Request, handler: Handler) -> bytes:
        """Return the response of `handler`. It is called only for the first request with this client, method and id.

        If the handler raises, the request counts as not processed, and a repetition calls the handler again. A running
        handler continues when the connection breaks.

        Raises:
            ValueError: An earlier request with this id had another body.
        """
        key = (request.client, request.method, request.id)
        digest = hashlib.sha256(request.body).digest()
        stored = self._stored.get(key)
        if stored is None:
            stored = self._stored[key] = _StoredResponse(digest, asyncio.ensure_future(_run(handler, request)))
            stored.task.add_done_callback(lambda done: self._ended(key, done))
        elif stored.digest != digest:
            raise ValueError(f"request {request.id} had another body before; use a new id for each request")
        else:
            self.repeated += 1
        return await asyncio.shield(stored.task)

    def _ended(self, key: _Key, task: asyncio.Task[bytes]) -> None:
        if task.cancelled() or task.exception() is not None:
            self._stored.pop(key, None)
            return
        self._free_bytes -= len(task.result())
        for oldest in list(self._stored):
            if self._free_bytes >= 0 and len(self._stored) <= self._count:
                return
            if self._stored[oldest].task.done():
                self._free_bytes += len(self._stored.pop(oldest).task.result())


async def _run(handler: Handler, request: Request) -> bytes:
    return await handler(request)


class Requester:
    """Client for requests to another component, as an asynchronous context manager.

    After the first request it keeps a connection open. A connection that breaks, or that is closed because traffic moves
    to another path, is reopened immediately, so that the next request does not wait.

    Args:
        address: `host:port`.
        attempt_timeout_s: Longest duration of one attempt, in seconds. It must exceed the response time on the slowest
            path.
    """

    def __init__(self, address: str, *, attempt_timeout_s: float = ATTEMPT_TIMEOUT_S) -> None:
        self.address = address
        self.repeated = 0
        self._attempt_timeout_s = attempt_timeout_s
        self._client = uuid.uuid4().hex
        self._channel: Any = None
        self._connecting: asyncio.Task[None] | None = None

    async def request(
        self, method: str, body: bytes = b"", *, timeout_s: float = TIMEOUT_S, request_id: str | None = None
    ) -> bytes:
        """Send a request, repeat it with the same id until a response arrives, and return the response.

        Args:
            method: Name of the requested method.
            body: Content, at most 16 MiB.
            timeout_s: Seconds after which the request fails.
            request_id: Id of the received request that causes this one. All requests of this `Requester` with one id
                must have the same body. Default: a new id.

        Raises:
            InvalidRequest: The other component refused the request.
            Unavailable: No response arrived in time.
        """
        if len(body) > MAX_BODY_BYTES:
            raise InvalidRequest(f"{method}: the body exceeds {MAX_BODY_BYTES >> 20} MiB; send it in parts")
        loop = asyncio.get_running_loop()
        deadline = loop.time() + timeout_s
        request_id = request_id or uuid.uuid4().hex
        for attempt, delay in enumerate(backoff(cap_s=MAX_DELAY_S), 1):
            self.repeated += attempt > 1
            try:
                return await self._attempt(method, body, request_id, attempt, deadline - loop.time())
            except grpc.aio.AioRpcError as error:
                message = f"{method} on {self.address}: {error.details() or error.code().name}"
                if error.code() not in _REPEATED:
                    raise InvalidRequest(message) from None
            if loop.time() + delay >= deadline:
                raise Unavailable(f"{message} (after {attempt} attempts)")
            await asyncio.sleep(delay)
        raise AssertionError("the back-off is infinite")

    async def _attempt(self, method: str, body: bytes, request_id: str, attempt: int, remaining_s: float) -> bytes:
        if self._channel is None:
            self._channel = grpc.aio.insecure_channel(self.address, options=_CLIENT)
            self._connecting = asyncio.create_task(_keep_connected(self._channel))
        call = self._channel.unary_unary(f"/{SERVICE}/{method}")
        metadata = ((ID_HEADER, request_id), (ATTEMPT_HEADER, str(attempt)), (CLIENT_HEADER, self._client))
        response: bytes = await call(body, timeout=min(remaining_s, self._attempt_timeout_s), metadata=metadata)
        return response

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connection."""
        if self._connecting is not None:
            self._connecting.cancel()
            await asyncio.gather(self._connecting, return_exceptions=True)
            self._connecting = None
        if self._channel is not None:
            await self._channel.close()
            self._channel = None


async def _keep_connected(channel: Any) -> None:
    """Reconnect immediately after a disconnect. By default, gRPC would wait for the next call."""
    while True:
        await channel.wait_for_state_change(channel.get_state(try_to_connect=True))


def requester(component: str, *, attempt_timeout_s: float = ATTEMPT_TIMEOUT_S) -> Requester:
    """Return a client for requests to a component in this component's `egress`.

    Raises:
        NotConfigured: The application does not list the component in this component's `egress`.
    """
    return Requester(egress(component), attempt_timeout_s=attempt_timeout_s)


class Responder:
    """Server for requests of other components.

    Args:
        handlers: Handlers by method name. A handler that raises ValueError refuses the request permanently. If it raises
            OSError or `Unavailable`, the client repeats the request.
        port: Port to listen on; 0 selects a free port.
        connection_age_s: Age in seconds after which a connection is closed gracefully, so that no connection stays on a
            path that traffic has left.
    """

    def __init__(
        self, handlers: Mapping[str, Handler], port: int, *, connection_age_s: float = CONNECTION_AGE_S
    ) -> None:
        self.port = port
        self.responses = StoredResponses()
        self._handlers = dict(handlers)
        self._connection_age_s = connection_age_s
        self._server: Any = None

    async def start(self) -> None:
        """Start the server.

        Raises:
            Unavailable: The port is in use.
        """
        age_ms = math.ceil(self._connection_age_s * 1e3)
        options = (
            *_LENGTHS,
            ("grpc.max_connection_age_ms", age_ms),
            ("grpc.max_connection_age_grace_ms", math.ceil(CONNECTION_GRACE_S * 1e3)),
            ("grpc.http2.min_recv_ping_interval_without_data_ms", 1000),
            ("grpc.so_reuseport", 0),
        )
        server = grpc.aio.server(options=options)
        methods = {name: self._method(name, handler) for name, handler in self._handlers.items()}
        server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(SERVICE, methods),))
        try:
            self.port = server.add_insecure_port(f"[::]:{self.port}")
        except RuntimeError as error:
            raise Unavailable(f"cannot listen on port {self.port}: {error}") from None
        await server.start()
        self._server = server

    async def stop(self, grace_s: float = 1.0) -> None:
        """Stop the server after the current requests have completed, at the latest after `grace_s` seconds."""
        if self._server is not None:
            await self._server.stop(grace_s)

    async def serve(self) -> None:
        """Serve requests until SIGTERM.

        Raises:
            Unavailable: The port is in use.
        """
        terminated = asyncio.Event()
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, terminated.set)
        await self.start()
        await terminated.wait()
        await self.stop()

    def _method(self, name: str, handler: Handler) -> Any:
        """Return the gRPC method handler for a handler function."""

        async def handle(body: bytes, context: Any) -> bytes:
            metadata = dict(context.invocation_metadata())
            request_id = str(metadata.get(ID_HEADER, ""))
            attempt = str(metadata.get(ATTEMPT_HEADER, ""))
            if not 0 < len(request_id) <= _MAX_ID_LENGTH:
                await context.abort(grpc.StatusCode.INVALID_ARGUMENT, f"{ID_HEADER} is missing or too long")
            client = str(metadata.get(CLIENT_HEADER, ""))
            if len(client) > _MAX_ID_LENGTH:
                await context.abort(grpc.StatusCode.INVALID_ARGUMENT, f"{CLIENT_HEADER} is too long")
            valid_attempt = attempt.isdecimal() and len(attempt) <= _MAX_ATTEMPT_LENGTH
            request = Request(request_id, name, body, int(attempt) if valid_attempt else 1, client)
            try:
                return await self.responses.once(request, handler)
            except ValueError as error:
                await context.abort(grpc.StatusCode.INVALID_ARGUMENT, str(error))
            except (OSError, Unavailable) as error:
                await context.abort(grpc.StatusCode.UNAVAILABLE, str(error))
            except Exception as error:
                log.exception("%s: the handler failed", name)
                await context.abort(grpc.StatusCode.UNKNOWN, f"the handler failed ({type(error).__name__})")
            raise AssertionError("abort does not return")

        return grpc.unary_unary_rpc_method_handler(handle)

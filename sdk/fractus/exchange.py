"""Requests between an application's components, over whatever path there is: repeated until answered, carried out once.

Where traffic moves from one network path to another, connections break, and a request may arrive twice or its answer not at
all. So each request has an id that it keeps when it is repeated; who answers keeps the answers for a while and gives them
again instead of doing the work twice. A repetition can reach another instance than the first attempt did: what collects
results has to drop those whose `Request.id` it has had (`Answers` does).

The connections are not encrypted by themselves.
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
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import grpc

from fractus.channel import backoff
from fractus.environment import egress
from fractus.errors import InvalidRequest, Unavailable

log = logging.getLogger(__name__)

SERVICE = "fractus.exchange"
ID, ATTEMPT = "fractus-request-id", "fractus-attempt"
MAX_BODY_BYTES = 16 * 2**20
TIMEOUT_S, ATTEMPT_TIMEOUT_S = 30.0, 5.0
MAX_DELAY_S = 0.5
CONNECTION_AGE_S, CONNECTION_GRACE_S = 30.0, 10.0
KEPT_ANSWERS, KEPT_BYTES = 4096, 16 * 2**20
_MAX_ID, _MAX_ATTEMPT = 200, 9
"""Characters of what a request says of itself."""

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
    # A path that is gone without a word is given up within 4 s, and a new one found quickly.
    ("grpc.keepalive_time_ms", 2000),
    ("grpc.keepalive_timeout_ms", 2000),
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.min_reconnect_backoff_ms", 1000),
    ("grpc.max_reconnect_backoff_ms", 1000),
)


@dataclass(frozen=True, slots=True)
class Request:
    """What a component is asked.

    Attributes:
        id: the same in every repetition, and in those only: an id that comes with another body is refused.
        method: what is asked for.
        body: of whatever form the components agree on.
        attempt: 1 for the first; only in repetitions more.
    """

    id: str
    method: str
    body: bytes
    attempt: int = 1


Handler = Callable[[Request], Awaitable[bytes]]


class _Kept(NamedTuple):
    digest: bytes
    answer: asyncio.Task[bytes]


class Answers:
    """Answers by method and request id, so that no request is carried out twice; the oldest are forgotten first.

    Args:
        count: how many are kept.
        size: how many bytes of them.
    """

    def __init__(self, count: int = KEPT_ANSWERS, size: int = KEPT_BYTES) -> None:
        self._count = count
        self._left = size
        self._kept: OrderedDict[tuple[str, str], _Kept] = OrderedDict()
        self.repeated = 0

    async def once(self, request: Request, handler: Handler) -> bytes:
        """The answer of a handler, which is called for the first request of a method and an id only.

        A handler that raises has carried nothing out: a repetition calls it again. One that has begun goes on when the
        connection breaks.

        Raises:
            ValueError: the request of that id had another body.
        """
        key, digest = (request.method, request.id), hashlib.sha256(request.body).digest()
        kept = self._kept.get(key)
        if kept is None:
            kept = self._kept[key] = _Kept(digest, asyncio.ensure_future(_run(handler, request)))
            kept.answer.add_done_callback(lambda done: self._ended(key, done))
        elif kept.digest != digest:
            raise ValueError(f"request {request.id} had another body before: give each request an id of its own")
        else:
            self.repeated += 1
        return await asyncio.shield(kept.answer)

    def _ended(self, key: tuple[str, str], task: asyncio.Task[bytes]) -> None:
        if task.cancelled() or task.exception() is not None:
            self._kept.pop(key, None)
            return
        self._left -= len(task.result())
        for oldest in list(self._kept):
            if self._left >= 0 and len(self._kept) <= self._count:
                return
            if self._kept[oldest].answer.done():
                self._left += len(self._kept.pop(oldest).answer.result())


async def _run(handler: Handler, request: Request) -> bytes:
    return await handler(request)


class Requester:
    """Asks another component; `async with` closes it.

    From the first request on it keeps a connection: one that breaks, or is closed because traffic has to move to another
    path, is opened again at once, so that the next request need not wait for it.

    Args:
        address: `host:port`.
        attempt_timeout_s: how long one attempt may take; more than the other end needs over the slowest path.
    """

    def __init__(self, address: str, *, attempt_timeout_s: float = ATTEMPT_TIMEOUT_S) -> None:
        self.address = address
        self.repeated = 0
        self._attempt_timeout_s = attempt_timeout_s
        self._channel: Any = None
        self._connecting: asyncio.Task[None] | None = None

    async def ask(
        self, method: str, body: bytes = b"", *, timeout_s: float = TIMEOUT_S, request_id: str | None = None
    ) -> bytes:
        """The answer to a request, which is repeated with the same id until there is one.

        Args:
            method: what is asked for.
            body: at most 16 MiB.
            timeout_s: when to give up.
            request_id: of a request on whose behalf this one is made, which then has the same body each time; by default a
                new one.

        Raises:
            InvalidRequest: the other component refuses it.
            Unavailable: no answer in time.
        """
        if len(body) > MAX_BODY_BYTES:
            raise InvalidRequest(f"{method}: a body has at most {MAX_BODY_BYTES >> 20} MiB; send it in parts")
        loop = asyncio.get_running_loop()
        end, wanted = loop.time() + timeout_s, request_id or uuid.uuid4().hex
        for attempt, delay in enumerate(backoff(cap_s=MAX_DELAY_S), 1):
            self.repeated += attempt > 1
            try:
                return await self._attempt(method, body, wanted, attempt, end - loop.time())
            except grpc.aio.AioRpcError as error:
                said = f"{method} on {self.address}: {error.details() or error.code().name}"
                if error.code() not in _REPEATED:
                    raise InvalidRequest(said) from None
            if loop.time() + delay >= end:
                raise Unavailable(f"{said} (after {attempt} attempts)")
            await asyncio.sleep(delay)
        raise AssertionError("delays never end")

    async def _attempt(self, method: str, body: bytes, request_id: str, attempt: int, left_s: float) -> bytes:
        if self._channel is None:
            self._channel = grpc.aio.insecure_channel(self.address, options=_CLIENT)
            self._connecting = asyncio.create_task(_keep_connected(self._channel))
        call = self._channel.unary_unary(f"/{SERVICE}/{method}")
        metadata = ((ID, request_id), (ATTEMPT, str(attempt)))
        answer: bytes = await call(body, timeout=min(left_s, self._attempt_timeout_s), metadata=metadata)
        return answer

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
    """Connect whenever there is no connection; left alone, gRPC would wait for the next call."""
    while True:
        await channel.wait_for_state_change(channel.get_state(try_to_connect=True))


def requester(component: str, *, attempt_timeout_s: float = ATTEMPT_TIMEOUT_S) -> Requester:
    """What asks a component that the application lists in this one's egress.

    Raises:
        NotConfigured: it lists no such component.
    """
    return Requester(egress(component), attempt_timeout_s=attempt_timeout_s)


class Responder:
    """Answers other components.

    Args:
        handlers: by method. One that raises ValueError refuses the request for good; with OSError or one of the SDK's
            errors, the other end repeats it.
        port: to listen on; 0 for any.
        connection_age_s: a connection is closed in peace when it is about so old, so that none stays on a path that
            traffic has left.
    """

    def __init__(
        self, handlers: Mapping[str, Handler], port: int, *, connection_age_s: float = CONNECTION_AGE_S
    ) -> None:
        self.port = port
        self.answers = Answers()
        self._handlers = dict(handlers)
        self._connection_age_s = connection_age_s
        self._server: Any = None

    async def start(self) -> None:
        """Begin to listen.

        Raises:
            Unavailable: the port is taken.
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
        """Let requests that are being answered end, and stop."""
        if self._server is not None:
            await self._server.stop(grace_s)

    async def serve(self) -> None:
        """Answer until SIGTERM.

        Raises:
            Unavailable: the port is taken.
        """
        over = asyncio.Event()
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, over.set)
        await self.start()
        await over.wait()
        await self.stop()

    def _method(self, name: str, handler: Handler) -> Any:
        """A method as gRPC knows it."""

        async def answer(body: bytes, context: Any) -> bytes:
            told = dict(context.invocation_metadata())
            request_id, attempt = str(told.get(ID, "")), str(told.get(ATTEMPT, ""))
            if not 0 < len(request_id) <= _MAX_ID:
                await context.abort(grpc.StatusCode.INVALID_ARGUMENT, f"{ID} is missing, or too long")
            counted = attempt.isdecimal() and len(attempt) <= _MAX_ATTEMPT
            request = Request(request_id, name, body, int(attempt) if counted else 1)
            try:
                return await self.answers.once(request, handler)
            except ValueError as error:
                await context.abort(grpc.StatusCode.INVALID_ARGUMENT, str(error))
            except (OSError, Unavailable) as error:
                await context.abort(grpc.StatusCode.UNAVAILABLE, str(error))
            except Exception as error:
                log.exception("%s: the handler failed", name)
                await context.abort(grpc.StatusCode.UNKNOWN, f"{name}: {type(error).__name__}")
            raise AssertionError("abort does not return")

        return grpc.unary_unary_rpc_method_handler(answer)

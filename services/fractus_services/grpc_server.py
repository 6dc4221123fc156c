"""gRPC server of both services: admission of calls, conversion of errors to a status, and lifetime of the process."""

from __future__ import annotations

import asyncio
import logging
import os
import time
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine
from contextlib import AbstractContextManager, asynccontextmanager, nullcontext
from typing import Any

import grpc
from fractus_core.api.methods import Interface, Service
from fractus_core.api.names import component_name
from fractus_core.policy.decision_types import Verdict
from fractus_runtime import tracing
from google.protobuf.message import DecodeError
from opentelemetry import trace

from fractus_services.auth import SERVER_OPTIONS, Caller, Callers, TlsFiles
from fractus_services.error_details import abort
from fractus_services.errors import (
    InternalError,
    InvalidRequest,
    NotAuthenticated,
    PolicyDenied,
    Refused,
    ResourceExhausted,
)
from fractus_services.grant_files import ActiveGrant, GrantFiles
from fractus_services.options import CannotServe

log = logging.getLogger(__name__)

CALLS_PER_S = 50.0
CALL_BURST = 100.0
"""Rate and burst of calls of one identity. A driver that streams setpoints stays far below these limits."""

URGENT_PER_S = 20.0
URGENT_BURST = 40.0
"""Rate and burst of urgent calls, which only make the flight safer. They are counted separately from other calls."""

MAX_OPEN_CALLS = 32
"""Maximum number of concurrent calls of one identity, including streams."""

REQUEST_TIMEOUT_S = 10.0
"""Time between the start of a call and its request message.

Clients send both together, but a bad link may delay the message.
"""

STOP_TIMEOUT_S = 2.0
"""Time for which open calls may continue when the server stops."""

UNTRACED = frozenset({"fractus.v1.MobilityService/ConfirmAlive"})
"""Methods without spans: the answer to a liveness request, once per second."""

_MAX_COUNTED = 1_000


class RateLimiter:
    """A token bucket for each caller, so that a flood of calls affects only the caller that sends it."""

    def __init__(self, rate: float = CALLS_PER_S, burst: float = CALL_BURST) -> None:
        self._rate = rate
        self._burst = burst
        self._buckets: dict[str, tuple[float, float]] = {}

    def take(self, identity: str, time_s: float) -> None:
        """Take one token of a caller.

        Args:
            identity: Identity of the caller.
            time_s: Monotonic time in seconds.

        Raises:
            ResourceExhausted: The caller has no token left. The error contains the time until the next token.
        """
        tokens, updated_s = self._buckets.get(identity, (self._burst, time_s))
        tokens = min(self._burst, tokens + max(time_s - updated_s, 0.0) * self._rate)
        if tokens < 1.0:
            self._buckets[identity] = (tokens, time_s)
            reason = f"more than {self._rate:.0f} calls per second; slow down"
            raise ResourceExhausted("TooManyCalls", reason, retry_after_s=(1.0 - tokens) / self._rate)
        self._buckets[identity] = (tokens - 1.0, time_s)
        if len(self._buckets) > _MAX_COUNTED:
            full_s = self._burst / self._rate
            self._buckets = {name: bucket for name, bucket in self._buckets.items() if time_s - bucket[1] < full_s}


class CallAdmission(grpc.aio.ServerInterceptor):  # type: ignore[misc]  # grpc has no types
    """Interceptor of one service: authorizes calls, traces them, and ends failed calls with a gRPC status.

    Args:
        grants: Grants of this node.
        clock: Returns Unix time.
        translate: Converts an exception of the service to a refusal, or returns None for an unknown exception.
        failed: Callback invoked with a verdict when a call raises an unexpected exception.
        on_passenger: Callback invoked with the Grant of a caller that is not a driver, each time the Grant is read.
        service: Service whose calls are admitted.
        interface: Protocol of the calls. The Grant of the caller must list it.
    """

    def __init__(
        self,
        grants: GrantFiles,
        clock: Callable[[], float],
        translate: Callable[[Exception], Refused | None] = lambda _error: None,
        failed: Callable[[Verdict], None] = lambda _verdict: None,
        on_passenger: Callable[[ActiveGrant], None] = lambda _grant: None,
        *,
        service: Service = "mobility",
        interface: Interface = "grpc",
    ) -> None:
        self._grants = grants
        self._service = service
        self._interface = interface
        self._callers = Callers(clock)
        self._translate = translate
        self._failed = failed
        self._on_passenger = on_passenger
        self._limiter = RateLimiter()
        self._urgent_limiter = RateLimiter(URGENT_PER_S, URGENT_BURST)
        self._open: Counter[str] = Counter()
        self._handlers: dict[str, grpc.RpcMethodHandler] = {}

    @asynccontextmanager
    async def call(self, context: Any, urgent: bool = False, lasting: bool = False) -> AsyncIterator[Caller]:
        """Admit a call, and yield its caller. Exceptions within the block end the call with a status.

        Args:
            context: gRPC context of the call.
            urgent: True if the call only makes the flight safer. It needs no deadline, may use a certificate that has expired
                since the handshake, and has its own rate limit.
            lasting: True for a stream that keeps the caller's control lease alive. It needs no deadline.
        """
        admitted = ""
        try:
            caller = self._callers.of(context.auth_context(), urgent)
            trace.get_current_span().set_attribute("fractus.caller", caller.identity)
            limiter = self._urgent_limiter if urgent else self._limiter
            limiter.take(caller.identity, time.monotonic())
            if not urgent and self._open[caller.identity] >= MAX_OPEN_CALLS:
                reason = f"{MAX_OPEN_CALLS} calls are in progress; end one before the next"
                raise ResourceExhausted("TooManyCalls", reason, retry_after_s=1.0)
            admitted = caller.identity
            self._open[admitted] += 1
            if not (urgent or lasting) and context.time_remaining() is None:
                reason = "the call has no deadline; set a timeout, as the SDK does"
                raise InvalidRequest("DeadlineMissing", reason)
            yield caller
        except Refused as refusal:
            await abort(context, refusal)
        except grpc.aio.AbortError:
            raise
        except Exception as error:
            known = self._translate(error)
            if known is not None:
                await abort(context, known)
            log.exception("rpc: unexpected error, call refused")
            reason = "the service failed; nothing was done"
            self._failed(Verdict("deny", None, "InternalError", reason, (), "hover"))
            await abort(context, InternalError("InternalError", reason))
        finally:
            if admitted:
                self._open[admitted] -= 1
                if not self._open[admitted]:
                    del self._open[admitted]

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[grpc.RpcMethodHandler | None]],
        details: grpc.HandlerCallDetails,
    ) -> grpc.RpcMethodHandler | None:
        """Return the wrapped handler of a method, or None if the method does not exist."""
        wrapped = self._handlers.get(details.method)
        if wrapped is None:
            handler = await continuation(details)
            if handler is None:
                return None
            wrapped = self.wrap(details.method.lstrip("/"), handler)
            self._handlers[details.method] = wrapped
        return wrapped

    def wrap(self, method: str, handler: grpc.RpcMethodHandler) -> grpc.RpcMethodHandler:
        """Wrap a handler so that its calls are traced, and requests are decoded after their caller is counted.

        Malformed requests then count as well. gRPC starts the handler of a method with a single request only after the request
        has arrived, and keeps calls whose request never arrives. The wrapped handler therefore has a request stream, and reads
        one message from it.

        Args:
            method: `package.Service/Method`.
            handler: Handler with a single request.
        """
        decode = handler.request_deserializer
        handle = handler.unary_unary or handler.unary_stream
        unsent: Counter[str] = Counter()

        async def behaviour(_requests: Any, context: Any) -> Any:
            span: AbstractContextManager[None] = nullcontext()
            if method not in UNTRACED:
                span = tracing.server_span(method, context.invocation_metadata(), grpc.aio.AbortError)
            with span:
                body = await self._received(unsent, context)
                try:
                    request = None if body is grpc.aio.EOF else decode(body)
                except DecodeError:
                    request = None
                if request is not None:
                    return await handle(request, context)
                async with self.call(context, lasting=True):
                    raise InvalidRequest(
                        "InvalidArgument", "cannot decode the request; send the request message of this method"
                    )

        build = grpc.stream_unary_rpc_method_handler if handler.unary_unary else grpc.stream_stream_rpc_method_handler
        return build(behaviour, None, handler.response_serializer)

    async def _received(self, unsent: Counter[str], context: Any) -> Any:
        """Return the request message of a call as bytes, or EOF if the client sent none.

        Abort the call if its request message does not arrive in time. Also abort it if too many calls of the same
        client still wait for their request messages.

        Args:
            unsent: Number of calls without a request message, by identity of the client.
            context: gRPC context of the call.
        """
        try:
            identity = self._callers.of(context.auth_context(), True).identity
        except NotAuthenticated:
            identity = ""
        if unsent[identity] >= MAX_OPEN_CALLS:
            reason = f"{MAX_OPEN_CALLS} calls of this method wait for their request; send the request with the call"
            await abort(context, ResourceExhausted("TooManyCalls", reason, retry_after_s=1.0))
        unsent[identity] += 1
        try:
            async with asyncio.timeout(REQUEST_TIMEOUT_S):
                return await context.read()
        except TimeoutError:
            reason = f"no request arrived within {REQUEST_TIMEOUT_S:.0f} s of the call; send the request with the call"
            await abort(context, InvalidRequest("InvalidArgument", reason))
        finally:
            unsent[identity] -= 1
            if not unsent[identity]:
                del unsent[identity]

    def grant_of(self, caller: Caller) -> ActiveGrant:
        """Return the Grant of a caller.

        Raises:
            PolicyDenied: The caller has no Grant on this node, or its Grant does not list the interface.
        """
        grant = self._grants.active.get(caller.identity)
        if grant is None:
            log.warning(
                "policy: call refused because the caller has no Grant on this node (caller=%s)",
                caller.identity,
                extra={"limit_by": caller.identity},
            )
            raise PolicyDenied("NoGrant", f"{component_name(caller.identity)} has no Grant on this node")
        if self._interface not in grant.compiled.interfaces[self._service]:
            raise PolicyDenied(
                "InterfaceNotGranted",
                f"the Grant does not permit calls of the {self._service} service over {self._interface}; "
                f"add {self._interface} to the interfaces of the service in the component",
            )
        if grant.spec.class_ != "driver":
            self._on_passenger(grant)
        return grant


async def serve_grpc(
    name: str, listen: str, tls: TlsFiles, register: Callable[[Any], None], admission: CallAdmission, *, node: str
) -> None:
    """Wait for certificates, then serve calls until cancelled.

    Args:
        name: Name of the service, for logs and traces.
        listen: HOST:PORT.
        tls: Certificates of the server.
        register: Adds the servicer to the server.
        admission: Authenticates and limits callers.
        node: Name of the node, for traces.

    Raises:
        CannotServe: The address cannot be bound, or the key does not match the certificate.
    """
    await tls.wait()
    # Importing the tracing libraries takes seconds on a small computer. A thread keeps the service responsive for a drone in
    # flight.
    close_tracing = await asyncio.to_thread(tracing.configure, name, node, os.environ)
    server = grpc.aio.server(interceptors=[admission], options=SERVER_OPTIONS)
    try:
        try:
            server.add_secure_port(listen, tls.server_credentials())
        except RuntimeError:
            raise CannotServe(
                f"--listen {listen}: cannot listen there; specify HOST:PORT with an address of this machine and a free"
                " port, and check that tls.key in --tls belongs to tls.crt"
            ) from None
        register(server)
        await server.start()
        log.info("%s: serving (address=%s)", name, listen)
        await asyncio.Event().wait()
    finally:
        await asyncio.shield(server.stop(STOP_TIMEOUT_S))
        await asyncio.shield(asyncio.to_thread(close_tracing))


async def run_until(stop: asyncio.Event, *parts: Coroutine[Any, Any, None]) -> None:
    """Run the parts of a service until `stop` is set. If one part fails, all parts end.

    Raises:
        ExceptionGroup: A part failed.
    """
    async with asyncio.TaskGroup() as tasks:
        running = [tasks.create_task(part) for part in parts]
        await stop.wait()
        for task in running:
            task.cancel()

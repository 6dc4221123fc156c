"""gRPC server of both services: binding, a server interceptor, and the lifetime of the process."""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any

import grpc
from fractus_runtime import tracing

from fractus_services.admission import CallAdmission
from fractus_services.auth import SERVER_OPTIONS, TlsFiles
from fractus_services.options import CannotServe

log = logging.getLogger(__name__)

STOP_TIMEOUT_S = 2.0


class CallInterceptor(grpc.aio.ServerInterceptor):  # type: ignore[misc]  # grpc has no types
    """Traces calls, and decodes requests after their callers are authenticated and counted.

    Args:
        admission: Authenticates and limits callers.
    """

    def __init__(self, admission: CallAdmission) -> None:
        self._admission = admission
        self._handlers: dict[str, grpc.RpcMethodHandler] = {}

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
            wrapped = _traced(details.method.lstrip("/"), self._admission.decoded(handler))
            self._handlers[details.method] = wrapped
        return wrapped


def _traced(method: str, handler: grpc.RpcMethodHandler) -> grpc.RpcMethodHandler:
    """Wrap a handler of a request stream in a span that begins before its caller is authenticated."""
    handle = handler.stream_unary or handler.stream_stream

    async def behaviour(requests: Any, context: Any) -> Any:
        with tracing.server_span(method, context.invocation_metadata(), grpc.aio.AbortError):
            return await handle(requests, context)

    build = grpc.stream_unary_rpc_method_handler if handler.stream_unary else grpc.stream_stream_rpc_method_handler
    return build(behaviour, handler.request_deserializer, handler.response_serializer)


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
    server = grpc.aio.server(interceptors=[CallInterceptor(admission)], options=SERVER_OPTIONS)
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
    """Run the parts of a service until `stop` is set. The failure of one part ends all.

    Raises:
        ExceptionGroup: A part failed.
    """
    async with asyncio.TaskGroup() as tasks:
        running = [tasks.create_task(part) for part in parts]
        await stop.wait()
        for task in running:
            task.cancel()

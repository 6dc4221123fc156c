"""What both services do once they run: bind, serve, stop."""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Callable, Coroutine, Mapping
from typing import Any

import grpc
from fractus_runtime import tracing
from fractus_runtime.spans import Tracer

from fractus_services.admission import CallAdmission
from fractus_services.auth import KEEPALIVE, TlsFiles
from fractus_services.options import CannotServe

log = logging.getLogger(__name__)

STOP_TIMEOUT_S = 2.0


class _Registry:
    """What generated code adds the handlers of a service to.

    Args:
        server: where they go.
        admission: lets their callers in.
        tracer: of their calls; None where they are not traced.
    """

    def __init__(self, server: grpc.aio.Server, admission: CallAdmission, tracer: Tracer | None) -> None:
        self._server = server
        self._admission = admission
        self._tracer = tracer

    def add_generic_rpc_handlers(self, _handlers: object) -> None:
        """The same handlers once more, by name; they are registered already."""

    def add_registered_method_handlers(self, service: str, handlers: Mapping[str, grpc.RpcMethodHandler]) -> None:
        """Add the handlers of a service."""
        decoded = {name: self._admission.decoded(handler) for name, handler in handlers.items()}
        if self._tracer is not None:
            decoded = {name: _traced(f"{service}/{name}", handler, self._tracer) for name, handler in decoded.items()}
        self._server.add_registered_method_handlers(service, decoded)


def _traced(method: str, handler: grpc.RpcMethodHandler, tracer: Tracer) -> grpc.RpcMethodHandler:
    """A handler whose calls are traced, from before their callers are let in."""
    handle = handler.stream_unary or handler.stream_stream

    async def behaviour(requests: Any, context: Any) -> Any:
        with tracer.serve(method, context.invocation_metadata()):
            return await handle(requests, context)

    build = grpc.stream_unary_rpc_method_handler if handler.stream_unary else grpc.stream_stream_rpc_method_handler
    return build(behaviour, handler.request_deserializer, handler.response_serializer)


async def serve_grpc(
    name: str, listen: str, tls: TlsFiles, register: Callable[[Any], None], admission: CallAdmission, *, node: str
) -> None:
    """Wait for certificates, then serve calls until cancelled.

    Args:
        name: of the service, for the log and for traces.
        listen: HOST:PORT.
        tls: certificates of the server.
        register: adds the handlers to the server.
        admission: lets callers in.
        node: that it runs on, for traces.

    Raises:
        CannotServe: the address cannot be bound.
    """
    server = grpc.aio.server(options=KEEPALIVE)
    await tls.wait()
    try:
        server.add_secure_port(listen, tls.server_credentials())
    except RuntimeError:
        raise CannotServe(
            f"--listen {listen}: cannot listen there; give HOST:PORT with an address of this machine and a free port,"
            " and in --tls a tls.key that belongs to tls.crt"
        ) from None
    # What it imports takes a small computer seconds, in which a drone in flight must not be left alone.
    tracer = await asyncio.to_thread(tracing.tracer, name, node, os.environ)
    register(_Registry(server, admission, tracer))
    await server.start()
    log.info("%s: serving (address=%s)", name, listen)
    try:
        await asyncio.Event().wait()
    finally:
        await asyncio.shield(server.stop(STOP_TIMEOUT_S))
        if tracer is not None:
            await asyncio.shield(asyncio.to_thread(tracer.close))


async def run_until(stop: asyncio.Event, *parts: Coroutine[Any, Any, None]) -> None:
    """Run the parts of a service until `stop` is set; the failure of any one ends all.

    Raises:
        ExceptionGroup: a part failed.
    """
    async with asyncio.TaskGroup() as tasks:
        running = [tasks.create_task(part) for part in parts]
        await stop.wait()
        for task in running:
            task.cancel()

"""What both services do once they run: bind, serve, stop."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine, Mapping
from typing import Any

import grpc

from fractus_services.admission import CallAdmission
from fractus_services.auth import KEEPALIVE, TlsFiles
from fractus_services.errors import CannotServe

log = logging.getLogger(__name__)

STOP_TIMEOUT_S = 2.0


class _Registry:
    """What generated code adds the handlers of a service to.

    Args:
        server: where they go.
        admission: lets their callers in.
    """

    def __init__(self, server: grpc.aio.Server, admission: CallAdmission) -> None:
        self._server = server
        self._admission = admission

    def add_generic_rpc_handlers(self, _handlers: object) -> None:
        """The same handlers once more, by name; they are registered already."""

    def add_registered_method_handlers(self, service: str, handlers: Mapping[str, grpc.RpcMethodHandler]) -> None:
        """Add the handlers of a service."""
        decoded = {name: self._admission.decoded(handler) for name, handler in handlers.items()}
        self._server.add_registered_method_handlers(service, decoded)


async def serve_grpc(
    name: str, listen: str, tls: TlsFiles, register: Callable[[Any], None], admission: CallAdmission
) -> None:
    """Wait for certificates, then serve calls until cancelled.

    Args:
        name: of the service, for the log.
        listen: HOST:PORT.
        tls: certificates of the server.
        register: adds the handlers to the server.
        admission: lets callers in.

    Raises:
        CannotServe: the address cannot be bound.
    """
    server = grpc.aio.server(options=KEEPALIVE)
    register(_Registry(server, admission))
    await tls.wait()
    try:
        server.add_secure_port(listen, tls.server_credentials())
    except RuntimeError:
        raise CannotServe(
            f"--listen {listen}: cannot listen there; give HOST:PORT with an address of this machine and a free port,"
            " and in --tls a tls.key that belongs to tls.crt"
        ) from None
    await server.start()
    log.info("%s: serving (address=%s)", name, listen)
    try:
        await asyncio.Event().wait()
    finally:
        await asyncio.shield(server.stop(STOP_TIMEOUT_S))


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

"""What both services do once they run: read the node's description, bind, serve, stop."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import grpc
from fractus_core.api.descriptions import InvalidDescription, parse_description
from fractus_core.api.nodes import Drone, EdgeNode

from fractus_services.auth import KEEPALIVE, TlsFiles
from fractus_services.errors import CannotServe

log = logging.getLogger(__name__)

STOP_TIMEOUT_S = 2.0


def read_description(path: Path, *kinds: type[Drone | EdgeNode]) -> Drone | EdgeNode | None:
    """Read the manifest that describes this node; None where there is none.

    Raises:
        CannotServe: the file is not a valid manifest of one of these kinds.
    """
    try:
        description = parse_description(path.read_text(encoding="utf-8"), *kinds)
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
        description = None
    except (OSError, UnicodeDecodeError) as error:
        raise CannotServe(f"--description {path}: cannot be read: {error}") from None
    except InvalidDescription as error:
        raise CannotServe(f"--description {path}: {error}") from None
    if description is None:
        log.warning("service: this node has no description, using defaults (file=%s)", path)
    return description


async def serve_grpc(name: str, listen: str, tls: TlsFiles, register: Callable[[grpc.aio.Server], None]) -> None:
    """Wait for certificates, then serve calls until cancelled.

    Args:
        name: of the service, for the log.
        listen: HOST:PORT.
        tls: certificates of the server.
        register: adds the handlers to the server.

    Raises:
        CannotServe: the address cannot be bound.
    """
    server = grpc.aio.server(options=KEEPALIVE)
    register(server)
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

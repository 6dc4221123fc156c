"""Wires the camera service together and runs it."""

from __future__ import annotations

import asyncio
import logging
import socket
import time
from pathlib import Path
from typing import TYPE_CHECKING

import grpc
import yaml
from fractus_core.api.model import InvalidObject
from fractus_core.api.nodes import Drone, EdgeNode
from fractus_proto.v1 import camera_pb2_grpc

from fractus_services.answering import Reception
from fractus_services.audit import AuditLog
from fractus_services.auth import KEEPALIVE, TlsFiles
from fractus_services.camera.album import Album
from fractus_services.camera.handlers import CameraHandlers
from fractus_services.camera.service import CameraService, Whereabouts, known
from fractus_services.camera.whereabouts import Airborne, Fixed
from fractus_services.clock import Clock
from fractus_services.grants import GrantFiles
from fractus_services.seals import Seals

if TYPE_CHECKING:
    from fractus_services.camera.__main__ import Options

log = logging.getLogger(__name__)

STOP_S = 2.0
DEFAULT_RESOLUTION = (1280, 720)


def describe(path: Path) -> Drone | EdgeNode | None:
    """This node's description, where there is one.

    Raises:
        InvalidObject: it is neither a Drone nor an EdgeNode manifest.
    """
    if not path.is_file():
        return None
    body = yaml.safe_load(path.read_text(encoding="utf-8"))
    kinds: dict[str, type[Drone] | type[EdgeNode]] = {"Drone": Drone, "EdgeNode": EdgeNode}
    kind = kinds.get(body.get("kind", "") if isinstance(body, dict) else "")
    if kind is None:
        raise InvalidObject("kind", f"{path} must hold a Drone or an EdgeNode")
    return kind.from_body(body)


def resolution_of(description: Drone | EdgeNode | None) -> tuple[int, int]:
    """The camera's own pixels."""
    camera = description.spec.services.camera if description is not None else None
    if camera is None:
        return DEFAULT_RESOLUTION
    width, height = camera.resolution.split("x")
    return int(width), int(height)


async def run(options: Options, stop: asyncio.Event) -> None:
    """Serve until `stop` is set, or a part of the service fails."""
    clock = Clock()
    description = describe(options.description)
    node = options.node or (description.name if description is not None else socket.gethostname())
    tls = TlsFiles(options.tls)
    audit = AuditLog(options.audit, clock)
    grants = GrantFiles(
        options.grants, node, Seals(options.tls, options.state / "grants-seen.json"), refused=audit.refused_grant
    )
    grants.scan()
    whereabouts: Whereabouts
    if isinstance(description, EdgeNode):
        whereabouts = Fixed.of(description.spec)
    else:
        whereabouts = Airborne(options.mobility, node, tls, time.monotonic)
    album = Album(options.state, options.keep, options.keep_mb * 1_000_000)
    service = CameraService(whereabouts, album, audit, clock, resolution_of(description))
    handlers = CameraHandlers(service, Reception(grants, clock, known))
    audit.append("started", {"node": node})
    async with asyncio.TaskGroup() as tasks:
        running = [
            tasks.create_task(part) for part in (grants.run(), _serve(options.listen, tls, handlers, whereabouts))
        ]
        await stop.wait()
        for task in running:
            task.cancel()
    await audit.close()


async def _serve(listen: str, tls: TlsFiles, handlers: CameraHandlers, whereabouts: Whereabouts) -> None:
    await tls.wait()
    server = grpc.aio.server(options=KEEPALIVE)
    camera_pb2_grpc.add_CameraServiceServicer_to_server(handlers, server)  # type: ignore[no-untyped-call]
    server.add_secure_port(listen, tls.server_credentials())
    await server.start()
    log.info("camera service on %s", listen)
    try:
        await whereabouts.run()
        await asyncio.Event().wait()
    finally:
        await asyncio.shield(server.stop(STOP_S))

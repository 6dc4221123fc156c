"""Wires the camera service together and runs it."""

from __future__ import annotations

import asyncio
import logging
import socket
import time

import grpc
from fractus_core.api.nodes import Drone, EdgeNode
from fractus_core.policy.footprint import lens_of
from fractus_proto.v1 import camera_pb2_grpc

from fractus_services.answering import Reception
from fractus_services.audit import AuditLog
from fractus_services.auth import KEEPALIVE, TlsFiles
from fractus_services.camera.album.album import Album
from fractus_services.camera.capture.connection import driver_for
from fractus_services.camera.capture.shutter import Shutter
from fractus_services.camera.imaging.faces import CascadeDetector, Detector, ModelDetector
from fractus_services.camera.pictures.service import Body, CameraService, Whereabouts, known, owner_of
from fractus_services.camera.pose.provider import Airborne, Fixed
from fractus_services.camera.rpc.handlers import CameraHandlers
from fractus_services.clock import Clock
from fractus_services.grant_verifier import GrantVerifier
from fractus_services.grants import GrantFiles
from fractus_services.hosting import bind, read_description
from fractus_services.options import CameraOptions

log = logging.getLogger(__name__)

STOP_S = 2.0


def body_of(description: Drone | EdgeNode | None) -> Body:
    """The camera's own properties."""
    camera = description.spec.services.camera if description is not None else None
    fixed = isinstance(description, EdgeNode)
    return Body(camera.pixels, camera.model, camera.sensor_type, fixed) if camera is not None else Body(fixed=fixed)


def detector_of(options: CameraOptions) -> Detector:
    """What finds faces.

    Raises:
        BadModel: the model that was named cannot be used.
    """
    if options.face_model is not None:
        return ModelDetector(options.face_model, options.face_px)
    return CascadeDetector(options.face_px)


def _whereabouts(options: CameraOptions, description: Drone | EdgeNode | None, node: str, tls: TlsFiles) -> Whereabouts:
    if isinstance(description, EdgeNode):
        return Fixed.of(description.spec, options.relief)
    lens = lens_of(description.spec.services.camera) if description is not None else None
    return Airborne(options.mobility, node, tls, time.monotonic, lens=lens, relief_m=options.relief)


async def run(options: CameraOptions, stop: asyncio.Event) -> None:
    """Serve until `stop` is set, or a part of the service fails.

    Raises:
        CannotServe: an option is wrong; also within an ExceptionGroup.
        BadConnection: there is no such camera.
        BadModel: the face detector cannot be used.
    """
    clock = Clock()
    description = read_description(options.description, Drone, EdgeNode)
    node = options.node or (description.name if description is not None else socket.gethostname())
    tls = TlsFiles(options.tls)
    audit = AuditLog(options.audit, clock)
    grants = GrantFiles(
        options.grants,
        node,
        GrantVerifier(options.tls, options.state / "grants-seen.json"),
        refused=audit.refused_grant,
    )
    grants.scan()
    camera = description.spec.services.camera if description is not None else None
    shutter = Shutter(driver_for(options.camera or (camera.connection if camera is not None else "test:")))
    whereabouts = _whereabouts(options, description, node, tls)
    album = Album(
        options.state,
        options.keep,
        options.keep_mb * 1_000_000,
        options.keep_total_mb * 1_000_000,
        lambda: [owner_of(grant) for grant in grants.active.values()],
    )
    service = CameraService(
        whereabouts, shutter, body_of(description), detector=detector_of(options), album=album, audit=audit, clock=clock
    )
    handlers = CameraHandlers(service, Reception(grants, clock, known))
    audit.append("started", {"node": node})
    async with asyncio.TaskGroup() as tasks:
        running = [
            tasks.create_task(part) for part in (grants.run(), _serve(options.listen, tls, handlers, whereabouts))
        ]
        await stop.wait()
        for task in running:
            task.cancel()
    shutter.close()
    await audit.close()


async def _serve(listen: str, tls: TlsFiles, handlers: CameraHandlers, whereabouts: Whereabouts) -> None:
    server = grpc.aio.server(options=KEEPALIVE)
    camera_pb2_grpc.add_CameraServiceServicer_to_server(handlers, server)  # type: ignore[no-untyped-call]
    await bind(server, listen, tls)
    log.info("camera service on %s", listen)
    try:
        await whereabouts.run()
        await asyncio.Event().wait()
    finally:
        await asyncio.shield(server.stop(STOP_S))

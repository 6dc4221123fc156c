"""Wires the camera service together and runs it."""

from __future__ import annotations

import asyncio
import socket
import time

import grpc
from fractus_core.api.nodes import Drone, EdgeNode
from fractus_core.policy.footprint import lens_of
from fractus_proto.v1 import camera_pb2_grpc

from fractus_services.admission import CallAdmission
from fractus_services.audit import AuditLog
from fractus_services.auth import TlsFiles
from fractus_services.camera.album.album import Album, owner_of
from fractus_services.camera.capture.connection import driver_for
from fractus_services.camera.capture.properties import CameraProperties
from fractus_services.camera.capture.shutter import Shutter
from fractus_services.camera.imaging.faces import BadModel, CascadeDetector, Detector, ModelDetector
from fractus_services.camera.pictures.capture import MAX_FILTERING, PictureCapture
from fractus_services.camera.pictures.fair_queue import MAX_PER_OWNER, FairQueue
from fractus_services.camera.pictures.judge import PictureJudge
from fractus_services.camera.pictures.library import PictureLibrary
from fractus_services.camera.pose.history import PoseHistory
from fractus_services.camera.pose.provider import FixedPose, PoseProvider
from fractus_services.camera.rpc.handlers import CameraHandlers
from fractus_services.camera.rpc.telemetry import follow_telemetry
from fractus_services.clock import Clock
from fractus_services.errors import CannotServe
from fractus_services.grant_verifier import GrantVerifier
from fractus_services.grants import GrantFiles
from fractus_services.hosting import read_description, run_until, serve_grpc
from fractus_services.options import CameraOptions


def detector_of(options: CameraOptions) -> Detector:
    """What finds faces.

    Raises:
        CannotServe: the model that was named cannot be used.
    """
    if options.face_model is None:
        return CascadeDetector(options.face_px)
    try:
        return ModelDetector(options.face_model, options.face_px)
    except BadModel as error:
        raise CannotServe(str(error)) from None


async def run(options: CameraOptions, stop: asyncio.Event) -> None:
    """Serve until `stop` is set, or a part of the service fails.

    Raises:
        CannotServe: an option is wrong; also within an ExceptionGroup.
    """
    clock = Clock()
    description = read_description(options.description, Drone, EdgeNode)
    node = options.node or (description.name if description is not None else socket.gethostname())
    tls = TlsFiles(options.tls)
    audit = AuditLog(options.audit, clock)
    grants = GrantFiles(
        options.grants, node, GrantVerifier(options.tls, options.grant_memory), refused=audit.refused_grant
    )
    grants.scan()
    described = description.spec.services.camera if description is not None else None
    camera = CameraProperties.of(description)
    shutter = Shutter(driver_for(options.camera or (described.connection if described is not None else "test:")))
    album = Album(
        options.state,
        options.keep,
        options.keep_mb * 1_000_000,
        options.keep_total_mb * 1_000_000,
        lambda: [owner_of(grant) for grant in grants.active.values()],
    )
    detector = detector_of(options)
    judge = PictureJudge(audit, detector)
    queue = FairQueue(MAX_PER_OWNER, MAX_FILTERING)
    parts = [grants.run()]
    poses: PoseProvider
    if isinstance(description, EdgeNode):
        poses = FixedPose(description.spec, options.relief)
    else:
        lens = lens_of(described) if described is not None else None
        poses = history = PoseHistory(time.monotonic, lens=lens, relief_m=options.relief)
        parts.append(follow_telemetry(options.mobility, node, tls, history.add))
    handlers = CameraHandlers(
        PictureCapture(
            poses, shutter, camera, detector=detector, filter_queue=queue, album=album, judge=judge, clock=clock
        ),
        PictureLibrary(poses, album, detector=detector, filter_queue=queue, judge=judge, clock=clock),
        CallAdmission(grants, clock),
    )

    def register(server: grpc.aio.Server) -> None:
        camera_pb2_grpc.add_CameraServiceServicer_to_server(handlers, server)

    audit.append("started", {"node": node})
    await run_until(stop, *parts, serve_grpc("camera", options.listen, tls, register))
    shutter.close()
    await audit.close()

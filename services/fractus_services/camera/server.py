"""Wires the camera service together and runs it."""

from __future__ import annotations

import asyncio
import logging
import socket
import time
from collections.abc import Coroutine, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

from fractus_core.api.nodes import Drone, EdgeNode
from fractus_core.policy.lenses import bounding_lens
from fractus_proto.v1 import camera_pb2_grpc
from fractus_runtime.audit import AuditLog
from fractus_runtime.exposition import LastRead, serving
from fractus_runtime.figures import Figure

from fractus_services.admission import CallAdmission
from fractus_services.auth import TlsFiles
from fractus_services.camera.camera_properties import CameraProperties
from fractus_services.camera.drivers.connection import driver_for
from fractus_services.camera.face_detection import BadModel, CascadeDetector, Detector, ModelDetector
from fractus_services.camera.fair_queue import MAX_PER_OWNER, FairQueue
from fractus_services.camera.handlers import CameraHandlers
from fractus_services.camera.image_authorization import ImageAuthorizer
from fractus_services.camera.image_capture import MAX_FILTERING, ImageCapture
from fractus_services.camera.image_store import ImageStore, owner_of
from fractus_services.camera.pose_history import PoseHistory
from fractus_services.camera.pose_provider import FixedPose, PoseProvider
from fractus_services.camera.shutter import Shutter
from fractus_services.camera.stored_images import StoredImages
from fractus_services.camera.telemetry_client import follow_telemetry
from fractus_services.clock import Clock
from fractus_services.decision_log import log_decision
from fractus_services.grant_files import GrantFiles
from fractus_services.grant_verifier import GrantVerifier
from fractus_services.grpc_server import run_until, serve_grpc
from fractus_services.metrics import ServiceMetrics, common_figures, telemetry_age
from fractus_services.node_description import NodeDescription
from fractus_services.options import CameraOptions, CannotServe
from fractus_services.recording.recorder import Recorder
from fractus_services.recording.segment_directory import segments_in

log = logging.getLogger(__name__)

MAX_WAITING_PICTURES = 16
"""Pictures that wait to be recorded, each of about a megabyte."""


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
    """Serve until `stop` is set, or a part of the service fails; begin again when the node is described otherwise.

    Raises:
        CannotServe: an option is wrong; also within an ExceptionGroup.
    """
    # The log has its times from the clock, and is looked up when that is stepped.
    clock = Clock(lambda step_s, trusted: audit.clock_stepped(step_s, trusted))  # noqa: PLW0108
    description = NodeDescription(options.node, options.node_object, options.description, Drone, EdgeNode)
    node = options.node or (description.value.name if description.value is not None else socket.gethostname())
    tls = TlsFiles(options.tls)
    recorder = Recorder(
        segments_in(options.recordings, options.recordings_mb),
        node,
        always=True,
        max_waiting=MAX_WAITING_PICTURES,
        told=options.recording_problem,
    )
    metrics = ServiceMetrics()

    def recorded(entry: dict[str, Any]) -> None:
        metrics.take_entry(entry)
        recorder.take_entry(entry)
        log_decision(entry)

    audit = AuditLog(options.audit, clock, tls=options.tls, copied=recorded)
    grants = GrantFiles(
        options.grants, node, GrantVerifier(options.tls, options.grant_memory), refused=audit.refused_grant
    )
    grants.scan()
    judge = ImageAuthorizer(audit, detector_of(options))
    # One for all descriptions: a second one would tidy away what the first is still writing.
    album = ImageStore(
        options.state,
        options.keep,
        options.keep_mb * 1_000_000,
        options.keep_total_mb * 1_000_000,
        lambda: [owner_of(grant) for grant in grants.active.values()],
        added=recorder.take_picture,
    )
    metrics.observe(partial(common_figures, LastRead(tls.expires_s), grants, audit, lambda: recorder.problem))
    watched = _Watched()
    metrics.observe(watched.figures)
    async with serving(options.metrics, metrics.text):
        while not stop.is_set():
            audit.append("started", {"node": node})
            await _serve(
                options,
                description,
                node,
                stop,
                tls=tls,
                grants=grants,
                clock=clock,
                judge=judge,
                album=album,
                watched=watched,
            )
    await audit.close()
    await recorder.close()


@dataclass(slots=True)
class _Watched:
    """Where the drone's telemetry goes; None for a camera that stands."""

    history: PoseHistory | None = None

    def figures(self) -> Iterator[Figure]:
        """What Prometheus is told of it."""
        if self.history is not None:
            yield telemetry_age(self.history.age_s)


async def _serve(
    options: CameraOptions,
    description: NodeDescription,
    node: str,
    stop: asyncio.Event,
    *,
    tls: TlsFiles,
    grants: GrantFiles,
    clock: Clock,
    judge: ImageAuthorizer,
    album: ImageStore,
    watched: _Watched,
) -> None:
    """Serve until `stop` is set, or the description changes."""
    described = description.value.spec.services.camera if description.value is not None else None
    fixed = isinstance(description.value, EdgeNode)
    missing = described.unknown_view(fixed) if described is not None else "services.camera"
    if missing:
        log.warning("camera: what it sees is not described, it counts as seeing everything (missing=%s)", missing)
    camera = CameraProperties.of(description.value)
    shutter = Shutter(driver_for(options.camera or (described.connection if described is not None else "test:")))
    queue = FairQueue(MAX_PER_OWNER, MAX_FILTERING)
    ended = asyncio.Event()
    parts = [grants.run(), _set_after(stop.wait(), ended), _set_after(description.changed(), ended)]
    poses: PoseProvider
    watched.history = None
    if isinstance(description.value, EdgeNode):
        poses = FixedPose(description.value.spec, options.relief)
    else:
        gimbal = described is not None and described.mount is not None and described.mount.gimbal
        poses = history = PoseHistory(
            time.monotonic, lens=bounding_lens(described), relief_m=options.relief, gimbal=gimbal
        )
        watched.history = history
        parts.append(follow_telemetry(options.mobility, node, tls, history.add, clock=clock, gimbal=gimbal))
    admission = CallAdmission(grants, clock)
    handlers = CameraHandlers(
        ImageCapture(
            poses, shutter, camera, detector=judge.detector, filter_queue=queue, album=album, judge=judge, clock=clock
        ),
        StoredImages(poses, album, detector=judge.detector, filter_queue=queue, judge=judge, clock=clock),
        admission,
    )
    register = partial(camera_pb2_grpc.add_CameraServiceServicer_to_server, handlers)
    await run_until(ended, *parts, serve_grpc("camera", options.listen, tls, register, admission, node=node))
    shutter.close()


async def _set_after(waiting: Coroutine[Any, Any, object], event: asyncio.Event) -> None:
    await waiting
    event.set()

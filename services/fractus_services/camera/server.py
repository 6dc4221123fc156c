"""Creates the components of the camera service and runs them."""

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
from fractus_runtime.metrics import BackgroundReader, serve_metrics
from prometheus_client import Metric

from fractus_services.auth import TlsFiles
from fractus_services.camera.camera_properties import CameraProperties
from fractus_services.camera.drivers.connection import create_driver
from fractus_services.camera.face_detection import CascadeDetector, FaceDetector, InvalidFaceModel, ModelDetector
from fractus_services.camera.fair_queue import FairQueue
from fractus_services.camera.handlers import CameraHandlers
from fractus_services.camera.image_authorization import ImageAuthorizer
from fractus_services.camera.image_capture import ImageCapture
from fractus_services.camera.image_store import ImageStore, owner_of
from fractus_services.camera.picture_counts import PictureCounts
from fractus_services.camera.pose import FixedPose, PoseProvider
from fractus_services.camera.pose_history import PoseHistory
from fractus_services.camera.settings import CameraSettings
from fractus_services.camera.shutter import Shutter
from fractus_services.camera.stored_images import StoredImages
from fractus_services.camera.telemetry_client import follow_telemetry
from fractus_services.clock import Clock
from fractus_services.decision_log import log_decision
from fractus_services.grant_files import GrantFiles
from fractus_services.grant_verifier import GrantVerifier
from fractus_services.grpc_server import CallAdmission, run_until, serve_grpc
from fractus_services.node_description import NodeDescription
from fractus_services.options import CannotServe
from fractus_services.recording.recorder import Recorder
from fractus_services.recording.segment_directory import segments_in
from fractus_services.service_metrics import ServiceMetrics, common_metrics, telemetry_age

log = logging.getLogger(__name__)


def create_detector(settings: CameraSettings) -> FaceDetector:
    """Create the face detector.

    Raises:
        CannotServe: The specified face model is unusable.
    """
    if settings.face_model is None:
        return CascadeDetector(settings.face_px)
    try:
        return ModelDetector(settings.face_model, settings.face_px)
    except InvalidFaceModel as error:
        raise CannotServe(str(error)) from None


@dataclass(slots=True)
class _PoseMetrics:
    """Metric of the telemetry age. It has no value for a camera that does not move."""

    history: PoseHistory | None = None

    def collect(self) -> Iterator[Metric]:
        if self.history is not None:
            yield telemetry_age(self.history.age_s)


@dataclass(frozen=True, slots=True)
class _Components:
    """Components that are not created again when the node description changes.

    A second image store would remove files that the first one is still writing.
    """

    settings: CameraSettings
    node: str
    clock: Clock
    tls: TlsFiles
    grants: GrantFiles
    authorizer: ImageAuthorizer
    store: ImageStore
    counts: PictureCounts
    pose_metrics: _PoseMetrics


async def run(settings: CameraSettings, stop: asyncio.Event) -> None:
    """Serve until `stop` is set or a part of the service fails. Restart the service if the node description changes.

    Raises:
        CannotServe: A setting is wrong. It may be within an ExceptionGroup.
    """
    # The clock and the audit log need each other. The lambda uses `audit` only when the clock is stepped, after `audit` is set.
    clock = Clock(lambda step_s, trusted: audit.clock_stepped(step_s, trusted))  # noqa: PLW0108
    description = NodeDescription(settings.node, settings.node_object, settings.description, Drone, EdgeNode)
    name = description.value.name if description.value is not None else socket.gethostname()
    node = settings.node or name
    tls = TlsFiles(settings.tls)
    recorder = Recorder(
        segments_in(settings.recordings, settings.recordings_mb),
        node,
        max_waiting=settings.max_unrecorded_images,
        problem_file=settings.recording_problem,
    )
    metrics = ServiceMetrics()

    audit = AuditLog(
        settings.audit, clock, tls=settings.tls, listeners=(metrics.take_entry, recorder.take_entry, log_decision)
    )
    grants = GrantFiles(
        settings.grants, node, GrantVerifier(settings.tls, settings.grant_memory), refused=audit.refused_grant
    )
    grants.scan()
    store = ImageStore(
        settings.state,
        settings.keep,
        settings.keep_mb * 1_000_000,
        settings.keep_total_mb * 1_000_000,
        lambda: [owner_of(grant) for grant in grants.active.values()],
        on_added=recorder.take_picture,
    )
    authorizer = ImageAuthorizer(audit, create_detector(settings))
    counts = PictureCounts(settings.picture_counts, lambda: [grant.key for grant in grants.active.values()])
    components = _Components(settings, node, clock, tls, grants, authorizer, store, counts, _PoseMetrics())
    metrics.add_callback(
        partial(common_metrics, BackgroundReader(tls.expires_s), grants, audit, lambda: recorder.problem)
    )
    metrics.add_callback(components.pose_metrics.collect)
    async with serve_metrics(settings.metrics, metrics.collect):
        while not stop.is_set():
            audit.append("started", {"node": node})
            await _serve(components, description, stop)
    await audit.close()
    await recorder.close()


async def _serve(components: _Components, description: NodeDescription, stop: asyncio.Event) -> None:
    """Serve until `stop` is set or the node description changes."""
    settings = components.settings
    clock = components.clock
    camera = description.value.spec.services.camera if description.value is not None else None
    fixed = isinstance(description.value, EdgeNode)
    missing = camera.unknown_view(fixed) if camera is not None else "services.camera"
    if missing:
        log.warning(
            "camera: field of view unknown, policies assume that the camera sees everything (missing=%s)", missing
        )
    connection = settings.camera or (camera.connection if camera is not None else "test:")
    shutter = Shutter(create_driver(connection), settings.capture_timeout_s)
    ended = asyncio.Event()
    parts = [components.grants.run(), _set_after(stop.wait(), ended), _set_after(description.changed(), ended)]
    poses: PoseProvider
    components.pose_metrics.history = None
    if isinstance(description.value, EdgeNode):
        poses = FixedPose(description.value.spec, settings.relief)
    else:
        gimbal = camera is not None and camera.mount is not None and camera.mount.gimbal
        history = PoseHistory(time.monotonic, lens=bounding_lens(camera), relief_m=settings.relief, gimbal=gimbal)
        poses = history
        components.pose_metrics.history = history
        parts.append(
            follow_telemetry(
                settings.mobility,
                components.node,
                components.tls,
                history.add,
                clock=clock,
                gimbal=gimbal,
                interval_s=settings.telemetry_interval_s,
                retry_s=settings.telemetry_retry_s,
            )
        )
    admission = CallAdmission(components.grants, clock, service="camera")
    filter_queue = FairQueue(settings.max_requests_per_instance, settings.max_filtering)
    detector = components.authorizer.detector
    capture = ImageCapture(
        poses,
        shutter,
        CameraProperties.from_description(description.value),
        detector=detector,
        filter_queue=filter_queue,
        capture_queue=FairQueue(settings.max_requests_per_instance, settings.max_captures),
        store=components.store,
        authorizer=components.authorizer,
        clock=clock,
        motion_frame_interval_s=settings.motion_frame_interval_s,
    )
    stored = StoredImages(
        poses,
        components.store,
        detector=detector,
        filter_queue=filter_queue,
        authorizer=components.authorizer,
        clock=clock,
    )
    handlers = CameraHandlers(capture, stored, admission, components.counts)
    register = partial(camera_pb2_grpc.add_CameraServiceServicer_to_server, handlers)
    parts.append(serve_grpc("camera", settings.listen, components.tls, register, admission, node=components.node))
    await run_until(ended, *parts)
    shutter.close()


async def _set_after(waiting: Coroutine[Any, Any, object], event: asyncio.Event) -> None:
    await waiting
    event.set()

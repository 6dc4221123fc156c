"""Takes images: authorized before and after the exposure, and filtered before they are stored."""

from __future__ import annotations

import asyncio
import itertools
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime

from fractus_core.policy.decision_types import Call, CaptureArgs, Situation, UncertainTime, Verdict, earliest_time
from fractus_core.policy.footprint import exposure_footprint
from fractus_core.policy.picture_rules import judge_privacy
from fractus_runtime import tracing

from fractus_services.background import Background
from fractus_services.camera.camera_properties import CameraProperties
from fractus_services.camera.drivers.driver import CaptureRequest
from fractus_services.camera.face_detection import FaceDetector, smallest_face_px
from fractus_services.camera.fair_queue import FairQueue
from fractus_services.camera.filter_pipeline import apply_filters
from fractus_services.camera.image_authorization import ImageAuthorizer, combine_verdicts
from fractus_services.camera.image_metadata import with_metadata
from fractus_services.camera.image_store import ImageRecord, ImageStore, ImageStoreFull, owner_of
from fractus_services.camera.motion_detection import MAX_MOTION_WIDTH_PX
from fractus_services.camera.pixels import Pixels, crop_and_resize, crop_to_aspect_ratio, encode_jpeg
from fractus_services.camera.pose import Pose, PoseProvider, is_upright
from fractus_services.camera.shutter import Shutter
from fractus_services.grant_files import ActiveGrant

_ROUNDING_PX = 2
"""Maximum difference, in pixels, between the full view and a requested size of the same aspect ratio, caused by rounding."""


@dataclass(frozen=True, slots=True)
class _Exposure:
    """Authorized frames of an exposure.

    Attributes:
        name: Name of the image.
        grant: Grant by which the exposure was authorized.
        verdict: Verdict with the required filters.
        recorded: Verdict before the exposure. The audit log contains it.
        after: Situation at the end of the exposure, with all situations during the exposure.
        frames: Frames of the camera.
        view_width_px: Width of the full view, in pixels that the camera returned.
    """

    name: str
    grant: ActiveGrant
    verdict: Verdict
    recorded: Verdict
    after: Situation
    frames: list[Pixels]
    view_width_px: int


class ImageCapture:
    """`CaptureImage` of Table 8.2 of the thesis, for callers with a Grant.

    Images are filtered in memory. If a policy requires filters, the unfiltered image is never written to the disk.

    Args:
        poses: Poses of the camera.
        shutter: Camera thread.
        camera: Properties of the camera.
        detector: Face detector.
        filter_queue: Queue of requests that filter an image, shared with `StoredImages`.
        capture_queue: Queue of requests that use the camera.
        store: Image store.
        authorizer: Policy decisions.
        clock: Returns Unix time.
        motion_frame_interval_s: Interval between the three frames for motion detection, in seconds.
    """

    def __init__(
        self,
        poses: PoseProvider,
        shutter: Shutter,
        camera: CameraProperties,
        *,
        detector: FaceDetector,
        filter_queue: FairQueue,
        capture_queue: FairQueue,
        store: ImageStore,
        authorizer: ImageAuthorizer,
        clock: Callable[[], float],
        motion_frame_interval_s: float = 0.25,
    ) -> None:
        self._poses = poses
        self._shutter = shutter
        self._camera = camera
        self._detector = detector
        self._filter_queue = filter_queue
        self._capture_queue = capture_queue
        self._store = store
        self._authorizer = authorizer
        self._clock = clock
        self._motion_frame_interval_s = motion_frame_interval_s
        self._sequence = itertools.count()
        self._tasks = Background()

    async def capture(
        self, grant: ActiveGrant, args: CaptureArgs, current_grant: Callable[[], ActiveGrant] | None = None
    ) -> tuple[Verdict, ImageRecord]:
        """Take an image and store it.

        The call is authorized when the camera is free. It is authorized again after the exposure with everything that the camera
        may have seen, because the drone moves and Grants may change in the meantime.

        Args:
            grant: Grant of the caller.
            args: Size in pixels. 0 means the camera's own size.
            current_grant: Returns the current Grant of the caller, or raises an exception if the Grant was removed.

        Raises:
            Refused: The call is invalid or denied, or no image could be taken.
        """
        width = args.width or self._camera.resolution[0]
        height = args.height or self._camera.resolution[1]
        self._camera.check_size(width, height)
        sized = replace(args, width=width, height=height)
        return await self._tasks.complete(self._capture(owner_of(grant), sized, current_grant or (lambda: grant)))

    async def _capture(
        self, owner: str, args: CaptureArgs, current_grant: Callable[[], ActiveGrant]
    ) -> tuple[Verdict, ImageRecord]:
        expected = judge_privacy(self._poses.situation(self._clock()), current_grant().compiled)
        if not expected.filters:
            exposure = await self._expose(owner, args, current_grant)
            if not exposure.verdict.filters:
                return await self._filter_and_store(args, exposure)
            async with self._filter_queue.turn(owner):
                return await self._filter_and_store(args, exposure)
        # Wait for the filter queue before the exposure, so that no image waits in memory for its filters.
        async with self._filter_queue.turn(owner):
            return await self._filter_and_store(args, await self._expose(owner, args, current_grant))

    async def _expose(self, owner: str, args: CaptureArgs, current_grant: Callable[[], ActiveGrant]) -> _Exposure:
        call = Call("CaptureImage", args)
        async with self._capture_queue.turn(owner):
            # The camera may return an image that it took before the request.
            start_s = time.monotonic() - self._shutter.latency_s
            grant = current_grant()
            before = self._poses.situation(self._clock())
            recorded = self._authorizer.authorize(call, grant, before)
            problem = await asyncio.to_thread(self._store.quota_problem, owner)
            if problem:
                raise ImageStoreFull(problem)
            with tracing.child_span("camera.capture"):
                frames = await self._take_frames(args, grant, before, recorded)
            if before.lens is not None:
                # Crop frames to the described aspect ratio, because policies judge the view with this ratio.
                frames = [crop_to_aspect_ratio(frame, *self._camera.resolution) for frame in frames]
            situations = self._poses.situations_since(start_s, self._clock())
            grant = current_grant()
            after = replace(situations[-1], exposure=situations)
            verdict = combine_verdicts([recorded, *self._authorize_exposure(call, grant, before, after)])
            # Enlarging an image does not make its faces easier to detect.
            view_width_px = min(self._camera.source_size(args.width, args.height)[0], frames[len(frames) // 2].shape[1])
            return _Exposure(self._name(after), grant, verdict, recorded, after, frames, view_width_px)

    async def _take_frames(
        self, args: CaptureArgs, grant: ActiveGrant, situation: Situation, verdict: Verdict
    ) -> list[Pixels]:
        """Take one frame, or three if a filter needs motion detection."""
        camera = self._camera
        width, height = camera.source_size(args.width, args.height)
        request = CaptureRequest(width, height, camera.resolution, camera.sensor, situation, grant.spec.node)
        needs_motion = any(required.action == "removeBackground" for required in verdict.filters)
        return await self._shutter.expose(request, 3 if needs_motion else 1, self._motion_frame_interval_s)

    def _authorize_exposure(self, call: Call, grant: ActiveGrant, before: Situation, after: Situation) -> list[Verdict]:
        """Return the verdicts on everything that the camera may have seen, at each possible time of the exposure.

        Zones have schedules. A zone applies if it was active at the start of the call, is active now, or was active when a camera
        with latency may have taken the image.
        """
        verdicts = [
            self._authorizer.authorize(call, grant, situation, record=False)
            for situation in (after, replace(after, time_s=before.time_s))
        ]
        exposure_s = UncertainTime(before.time_s, earliest_time(before.time_s) - self._shutter.latency_s)
        return [*verdicts, self._authorizer.authorize_view(call, grant, replace(after, time_s=exposure_s))]

    def _name(self, after: Situation) -> str:
        time_text = datetime.fromtimestamp(after.time_s, UTC).strftime("%Y%m%d%H%M%S%f")[:17]
        return f"{time_text}-{next(self._sequence) % 10000:04d}.jpg"

    async def _filter_and_store(self, args: CaptureArgs, exposure: _Exposure) -> tuple[Verdict, ImageRecord]:
        grant = exposure.grant
        after = exposure.after
        frames = exposure.frames
        camera = self._camera
        view = exposure_footprint(after.exposure, grant.compiled.frame)
        farthest_m = view.farthest_m if view is not None else math.inf
        face_px = smallest_face_px(after.lens, farthest_m, exposure.view_width_px)
        plan, verdict = self._authorizer.plan_filters(
            Call("CaptureImage", args), grant, exposure.verdict, after, face_px=face_px, recorded=exposure.recorded
        )
        poses = tuple(Pose.from_situation(situation) for situation in after.exposure)
        time_s = float(after.time_s)
        located = self._poses.fixed or self._authorizer.may_locate(grant, poses, after)
        requested_size = (args.width, args.height)
        full_size = camera.source_size(args.width, args.height)

        def render() -> bytes:
            # Filter the full view before cropping. Otherwise callers could request parts that show half faces, which are not detected.
            sized = _resize_frames(frames, *(full_size if plan.filters else requested_size))
            frames.clear()
            upright = is_upright(poses)
            filtered = apply_filters(sized, plan, self._detector, face_px, upright=upright, fixed=camera.fixed)
            data = encode_jpeg(crop_and_resize(filtered, *requested_size))
            if verdict.filters:
                # The metadata of a filtered image would disclose where it was taken.
                return data
            # For other lenses than a pinhole, the pose contains only an upper bound of the field of view. The focal length is unknown.
            view_px = full_size[0] if camera.pinhole else None
            return with_metadata(
                data, poses[-1], time_s=time_s, camera=camera.model, view_width_px=view_px, located=located
            )

        with tracing.child_span("camera.filters") as span:
            span.set_attribute("fractus.filters", [planned.action for planned in plan.filters])
            data = await asyncio.to_thread(render)
        # A part of the view may show cut faces, which could not be detected if a later policy requires filtering.
        uncut = max(full_size[0] - requested_size[0], full_size[1] - requested_size[1]) <= _ROUNDING_PX
        record = ImageRecord(
            exposure.name,
            time_s,
            *requested_size,
            len(data),
            poses,
            face_px if uncut else 0.0,
            plan.filters,
            whole=uncut,
        )
        await asyncio.to_thread(self._store.add, owner_of(grant), record, data)
        return verdict, record


def _resize_frames(frames: list[Pixels], width: int, height: int) -> list[Pixels]:
    """Resize the middle frame to a size, and the others to at most the size in which motion is detected."""
    scale = min(MAX_MOTION_WIDTH_PX / width, 1.0)
    sizes = [(max(round(width * scale), 1), max(round(height * scale), 1))] * len(frames)
    sizes[len(sizes) // 2] = (width, height)
    return [crop_and_resize(frame, *size) for frame, size in zip(frames, sizes, strict=True)]

"""Takes a picture: judged when the shutter is free and again once it is taken, filtered before it is stored."""

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
from fractus_runtime import spans

from fractus_services.background import Background
from fractus_services.camera.camera_properties import CameraProperties
from fractus_services.camera.drivers.driver import CaptureRequest
from fractus_services.camera.face_detection import Detector, smallest_face_px
from fractus_services.camera.fair_queue import MAX_PER_OWNER, FairQueue
from fractus_services.camera.filter_pipeline import apply_filters
from fractus_services.camera.filters import MOTION_PX
from fractus_services.camera.image_authorization import ImageAuthorizer, combined
from fractus_services.camera.image_metadata import with_metadata
from fractus_services.camera.image_record import ImageRecord
from fractus_services.camera.image_store import ImageStore, ImageStoreFull, owner_of
from fractus_services.camera.pixels import Pixels, cropped, encoded, fitted
from fractus_services.camera.pose import Pose, is_upright
from fractus_services.camera.pose_provider import PoseProvider
from fractus_services.camera.shutter import Shutter
from fractus_services.grant_files import ActiveGrant

MAX_EXPOSURES = 8
"""Pictures of all components that are being taken or wait for the shutter."""
MAX_FILTERING = 8
"""Pictures that are being filtered or wait for it; each takes tens of megabytes of memory."""
FRAME_INTERVAL_S = 0.25
"""Between the frames that show what moves."""
_ROUNDED_PX = 2
"""By so much the whole view may be larger than what was asked for, in its own proportions."""


@dataclass(frozen=True, slots=True)
class _Exposure:
    """What came out of an exposure, judged.

    Attributes:
        name: of the picture.
        grant: by which it was judged.
        verdict: which filters it needs.
        known: the verdict before it was taken, which was written down.
        after: where the camera was at the end, and on which way it got there.
        frames: what the camera gave.
        view_width_px: width of the whole view, in pixels that the camera gave.
    """

    name: str
    grant: ActiveGrant
    verdict: Verdict
    known: Verdict
    after: Situation
    frames: list[Pixels]
    view_width_px: int


class ImageCapture:
    """CaptureImage of Table 8.2 of the thesis, for callers whose grant is known.

    A picture is filtered before it is stored: where a policy requires filters, no picture without them is ever on disk.

    Args:
        poses: where the camera is.
        shutter: the camera.
        camera: its properties.
        detector: finds faces.
        filter_queue: who may filter a picture next.
        album: where pictures are stored.
        judge: judges and records.
        clock: Unix time.
    """

    def __init__(
        self,
        poses: PoseProvider,
        shutter: Shutter,
        camera: CameraProperties,
        *,
        detector: Detector,
        filter_queue: FairQueue,
        album: ImageStore,
        judge: ImageAuthorizer,
        clock: Callable[[], float],
    ) -> None:
        self._poses = poses
        self._shutter = shutter
        self._camera = camera
        self._detector = detector
        self._filter_queue = filter_queue
        self._album = album
        self._judge = judge
        self._clock = clock
        self._numbers = itertools.count()
        self._exposures = FairQueue(MAX_PER_OWNER, MAX_EXPOSURES)
        self._tasks = Background()

    async def capture(
        self, grant: ActiveGrant, args: CaptureArgs, current_grant: Callable[[], ActiveGrant] | None = None
    ) -> tuple[Verdict, ImageRecord]:
        """Take a picture and store it.

        It is judged when the shutter is free, and again when the picture is taken, together with all that the camera saw
        on the way: the drone moves meanwhile, and grants change.

        Args:
            grant: the caller's.
            args: pixels; 0 means the camera's own.
            current_grant: the caller's grant at a later moment; raises when there is none any more.
        """
        width, height = args.width or self._camera.resolution[0], args.height or self._camera.resolution[1]
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
                return await self._store(args, exposure)
            async with self._filter_queue.turn(owner):
                return await self._store(args, exposure)
        # The picture must not wait in memory for its filters, so the turn for these comes first.
        async with self._filter_queue.turn(owner):
            return await self._store(args, await self._expose(owner, args, current_grant))

    async def _expose(self, owner: str, args: CaptureArgs, current_grant: Callable[[], ActiveGrant]) -> _Exposure:
        call = Call("CaptureImage", args)
        async with self._exposures.turn(owner):
            # A camera may deliver a picture that it took before it was asked.
            begun_s = time.monotonic() - self._shutter.latency_s
            grant, before = current_grant(), self._poses.situation(self._clock())
            known = self._judge.judge(call, grant, before)
            problem = await asyncio.to_thread(self._album.quota_problem, owner)
            if problem:
                raise ImageStoreFull(problem)
            with spans.call().child("camera.capture"):
                frames = await self._shutter.expose(*self._wanted(args, grant, before, known))
            if before.lens is not None:
                # It is judged by a view in these proportions, whatever the camera gave.
                frames = [cropped(one, *self._camera.resolution) for one in frames]
            way, grant = self._poses.situations_since(begun_s, self._clock()), current_grant()
            after = replace(way[-1], exposure=way)
            verdict = combined([known, *self._judge_again(call, grant, before, after)])
            # Enlarging a picture does not make its faces easier to find.
            view_width_px = min(self._camera.source_size(args.width, args.height)[0], frames[len(frames) // 2].shape[1])
            return _Exposure(self._name(after), grant, verdict, known, after, frames, view_width_px)

    def _wanted(
        self, args: CaptureArgs, grant: ActiveGrant, before: Situation, verdict: Verdict
    ) -> tuple[CaptureRequest, int, float]:
        """What to ask the shutter for; what moves is seen only in several frames."""
        camera = self._camera
        size = camera.source_size(args.width, args.height)
        wanted = CaptureRequest(*size, camera.resolution, camera.sensor, before, grant.spec.node)
        moving = any(one.action == "removeBackground" for one in verdict.filters)
        return wanted, 3 if moving else 1, FRAME_INTERVAL_S

    def _judge_again(self, call: Call, grant: ActiveGrant, before: Situation, after: Situation) -> list[Verdict]:
        """The verdicts on all that the camera saw, at every moment the picture may be from.

        Policies have schedules: a zone that was active when the picture was begun counts as well as one that is active
        now, and so does one that was active when a camera with latency may have taken it.
        """
        verdicts = [
            self._judge.judge(call, grant, moment, record=False)
            for moment in (after, replace(after, time_s=before.time_s))
        ]
        first_s = UncertainTime(before.time_s, earliest_time(before.time_s) - self._shutter.latency_s)
        return [*verdicts, self._judge.judge_view(call, grant, replace(after, time_s=first_s))]

    def _name(self, after: Situation) -> str:
        moment = datetime.fromtimestamp(after.time_s, UTC).strftime("%Y%m%d%H%M%S%f")[:17]
        return f"{moment}-{next(self._numbers) % 10000:04d}.jpg"

    async def _store(self, args: CaptureArgs, exposure: _Exposure) -> tuple[Verdict, ImageRecord]:
        grant, after, frames = exposure.grant, exposure.after, exposure.frames
        view = exposure_footprint(after.exposure, grant.compiled.frame)
        farthest_m = view.farthest_m if view is not None else math.inf
        face_px = smallest_face_px(after.lens, farthest_m, exposure.view_width_px)
        call, camera = Call("CaptureImage", args), self._camera
        plan, verdict = self._judge.plan(call, grant, exposure.verdict, after, face_px=face_px, known=exposure.known)
        poses, moment_s = tuple(Pose.of(one) for one in after.exposure), float(after.time_s)
        asked, whole = (args.width, args.height), camera.source_size(args.width, args.height)

        def work() -> bytes:
            # Filters see the whole view: callers could ask for parts of it that cut each face in two, which no detector finds.
            sized = _sized(frames, *(whole if plan.filters else asked))
            frames.clear()
            upright = is_upright(poses)
            filtered = apply_filters(sized, plan, self._detector, face_px, upright=upright, fixed=camera.fixed)
            data = encoded(fitted(filtered, *asked))
            if verdict.filters:
                # A filtered picture tells nothing of where it was taken.
                return data
            # Of another lens the pose has a bound of the view, which is wider.
            view_px = whole[0] if camera.pinhole else None
            return with_metadata(data, poses[-1], time_s=moment_s, camera=camera.model, view_width_px=view_px)

        with spans.call().child("camera.filters") as span:
            span.note("fractus.filters", [one.action for one in plan.filters])
            data = await asyncio.to_thread(work)
        # In a part of the view faces are cut as well, when they have to be hidden later.
        uncut = max(whole[0] - asked[0], whole[1] - asked[1]) <= _ROUNDED_PX
        found_px = face_px if uncut else 0.0
        shot = ImageRecord(exposure.name, moment_s, *asked, len(data), poses, found_px, plan.filters, whole=uncut)
        await asyncio.to_thread(self._album.add, owner_of(grant), shot, data)
        return verdict, shot


def _sized(frames: list[Pixels], width: int, height: int) -> list[Pixels]:
    """The middle frame in a size, the others no larger than motion is detected in."""
    scale = min(MOTION_PX / width, 1.0)
    sizes = [(max(round(width * scale), 1), max(round(height * scale), 1))] * len(frames)
    sizes[len(sizes) // 2] = (width, height)
    return [fitted(one, *size) for one, size in zip(frames, sizes, strict=True)]

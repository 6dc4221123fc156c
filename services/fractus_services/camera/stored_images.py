"""Returns, lists and deletes stored images. Each access is authorized under the current policies."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from fractus_core.policy.decision_types import Call, Situation, Verdict
from fractus_core.policy.picture_rules import remaining_filters
from fractus_runtime import tracing
from fractus_runtime.files import UnsuitableFile, read_file

from fractus_services.background import Background
from fractus_services.camera.face_detection import FaceDetector
from fractus_services.camera.fair_queue import FairQueue
from fractus_services.camera.filter_pipeline import FilterPlan, apply_filters
from fractus_services.camera.image_authorization import ImageAuthorizer, situation_of
from fractus_services.camera.image_metadata import without_metadata
from fractus_services.camera.image_store import ImageRecord, ImageStore, NoSuchImage, owner_of
from fractus_services.camera.pixels import MAX_BYTES, decode_image, encode_jpeg
from fractus_services.camera.pose import PoseProvider, is_upright
from fractus_services.errors import PolicyDenied
from fractus_services.grant_files import ActiveGrant


class StoredImages:
    """`RetrieveImage`, `ListImages` and `DeleteImage` of Table 8.2 of the thesis, for callers with a Grant.

    Args:
        poses: Poses of the camera.
        store: Image store.
        detector: Face detector.
        filter_queue: Queue of requests that filter an image, shared with `ImageCapture`.
        authorizer: Policy decisions.
        clock: Returns Unix time.
    """

    def __init__(
        self,
        poses: PoseProvider,
        store: ImageStore,
        *,
        detector: FaceDetector,
        filter_queue: FairQueue,
        authorizer: ImageAuthorizer,
        clock: Callable[[], float],
    ) -> None:
        self._poses = poses
        self._store = store
        self._detector = detector
        self._filter_queue = filter_queue
        self._authorizer = authorizer
        self._clock = clock
        self._tasks = Background()

    async def retrieve(
        self, grant: ActiveGrant, name: str, current_grant: Callable[[], ActiveGrant] | None = None
    ) -> tuple[Verdict, ImageRecord, bytes | Path]:
        """Return an image under the policies that apply where it was taken and where the camera is now.

        The image is authorized again after filtering, because filtering may wait for other images.

        Args:
            grant: Grant of the caller.
            name: Name of the image.
            current_grant: Returns the current Grant of the caller, or raises an exception if the Grant was removed.

        Returns:
            The verdict, the record and the image. The image is a file, or bytes if filters were applied now.

        Raises:
            Refused: The call is denied, or the image does not exist.
        """
        call = Call("RetrieveImage")
        now = self._now()
        recorded = self._authorizer.authorize(call, grant, now)
        owner = owner_of(grant)
        record = await asyncio.to_thread(self._store.find, owner, name)
        verdict = self._authorizer.authorize_stored(call, grant, record.poses, recorded, now)
        missing = remaining_filters(verdict.filters, record.filters)
        path = self._store.path(owner, name)
        if not missing and (record.filters or self.locates(grant, record)):
            return verdict, record, path
        if not missing:
            data = without_metadata(await asyncio.to_thread(_read_image, path, name))
            return verdict, replace(record, size_bytes=len(data)), data
        # Earlier filters may have made faces undetectable, so the face size of a filtered image counts as unknown.
        face_px = 0.0 if record.filters else record.face_px
        plan, noted = self._authorizer.plan_filters(
            call, grant, replace(verdict, filters=missing), situation_of(record.poses, now),
            face_px=face_px, recorded=recorded,
        )  # fmt: skip
        data = await self._tasks.complete(self._filter(owner, path, plan, replace(record, face_px=face_px)))
        record = replace(record, size_bytes=len(data), filters=(*record.filters, *plan.filters))
        self.authorize_transfer(current_grant() if current_grant else grant, owner, record)
        return replace(verdict, reason=noted.reason), record, data

    def locates(self, grant: ActiveGrant, record: ImageRecord) -> bool:
        """Return True if a caller may get the position of an image.

        The position of a filtered image is private, because a policy required the filter because of this position. Other positions
        of a drone need the permission to call GetPosition.
        """
        if record.filters:
            return False
        return self._poses.fixed or self._authorizer.may_locate(grant, record.poses, self._now())

    def authorize_transfer(
        self, grant: ActiveGrant, owner: str, record: ImageRecord, *, has_position: bool = False
    ) -> None:
        """Authorize an image again under the current policies. Call this before each part of the image is sent.

        Args:
            grant: Current Grant of the caller.
            owner: Owner of the image.
            record: Record that `retrieve` returned, with all filters that were applied.
            has_position: True if reply or metadata contain the position of the image.

        Raises:
            Refused: Current policies forbid the image or its position, or require more filters than were applied.
        """
        if owner_of(grant) != owner:
            raise PolicyDenied(
                "NoGrant", "the application was replaced by another of the same name, which does not own this image"
            )
        call = Call("RetrieveImage")
        now = self._now()
        verdict = self._authorizer.authorize(call, grant, now, record=False)
        verdict = self._authorizer.authorize_stored(call, grant, record.poses, verdict, now)
        if remaining_filters(verdict.filters, record.filters):
            reason = f"{verdict.reason}, which was not required when this image was requested; request it again"
            refusal = Verdict("deny", None, "PrivacyZone", reason, verdict.policies)
            self._authorizer.enforce(call, grant, refusal, now)
        if has_position and not self.locates(grant, record):
            reason = (
                "the image contains its position, and the component may no longer call GetPosition; request it again"
            )
            self._authorizer.enforce(call, grant, Verdict("deny", None, "MethodDenied", reason), now)

    async def _filter(self, owner: str, path: Path, plan: FilterPlan, record: ImageRecord) -> bytes:
        def render() -> bytes:
            picture = decode_image(read_file(path, MAX_BYTES))
            upright = is_upright(record.poses)
            return encode_jpeg(apply_filters([picture], plan, self._detector, record.face_px, upright=upright))

        async with self._filter_queue.turn(owner):
            with tracing.child_span("camera.filters") as span:
                span.set_attribute("fractus.filters", [planned.action for planned in plan.filters])
                return await asyncio.to_thread(render)

    async def list(self, grant: ActiveGrant) -> tuple[Verdict, tuple[ImageRecord, ...]]:
        """Return the records of the caller's images."""
        verdict = self._authorizer.authorize(Call("ListImages"), grant, self._now())
        return verdict, await asyncio.to_thread(self._store.list, owner_of(grant))

    async def delete(self, grant: ActiveGrant, name: str) -> Verdict:
        """Delete an image of the caller."""
        verdict = self._authorizer.authorize(Call("DeleteImage"), grant, self._now())
        await asyncio.to_thread(self._store.delete, owner_of(grant), name)
        return verdict

    def _now(self) -> Situation:
        return self._poses.situation(self._clock())


def _read_image(path: Path, name: str) -> bytes:
    """Read the file of an image.

    Raises:
        NoSuchImage: The image was deleted.
    """
    try:
        return read_file(path, MAX_BYTES)
    except (FileNotFoundError, UnsuitableFile):
        raise NoSuchImage(f"image {name[:64]!r} was deleted") from None

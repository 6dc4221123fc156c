"""Returns, lists and deletes stored pictures; each is judged again under the policies of the present."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from fractus_core.policy.decision_types import Call, Situation, Verdict
from fractus_core.policy.picture_rules import remaining_filters
from fractus_runtime import spans

from fractus_services.background import Background
from fractus_services.camera.face_detection import Detector
from fractus_services.camera.fair_queue import FairQueue
from fractus_services.camera.filter_pipeline import FilterPlan, apply_filters
from fractus_services.camera.image_authorization import ImageAuthorizer, taken_at
from fractus_services.camera.image_record import ImageRecord
from fractus_services.camera.image_store import ImageStore, owner_of
from fractus_services.camera.pixels import decoded, encoded
from fractus_services.camera.pose import is_upright
from fractus_services.camera.pose_provider import PoseProvider
from fractus_services.errors import PolicyDenied
from fractus_services.grant_files import ActiveGrant


class StoredImages:
    """RetrieveImage, ListImages and DeleteImage of Table 8.2 of the thesis, for callers whose grant is known.

    Args:
        poses: where the camera is.
        detector: finds faces.
        filter_queue: who may filter a picture next.
        album: where pictures are stored.
        judge: judges and records.
        clock: Unix time.
    """

    def __init__(
        self,
        poses: PoseProvider,
        album: ImageStore,
        *,
        detector: Detector,
        filter_queue: FairQueue,
        judge: ImageAuthorizer,
        clock: Callable[[], float],
    ) -> None:
        self._poses = poses
        self._detector = detector
        self._filter_queue = filter_queue
        self._album = album
        self._judge = judge
        self._clock = clock
        self._tasks = Background()

    async def retrieve(
        self, grant: ActiveGrant, name: str, current_grant: Callable[[], ActiveGrant] | None = None
    ) -> tuple[Verdict, ImageRecord, bytes | Path]:
        """A picture; policies apply to where it was taken and to where the camera is now, and the stricter counts.

        It is judged again when its filters are applied, as other pictures may come first.

        Args:
            grant: the caller's.
            name: of the picture.
            current_grant: as for `ImageCapture.capture`.
        """
        call, now = Call("RetrieveImage"), self._now()
        known = self._judge.judge(call, grant, now)
        owner = owner_of(grant)
        shot = await asyncio.to_thread(self._album.find, owner, name)
        verdict = self._judge.judge_stored(call, grant, shot.poses, known, now)
        missing = remaining_filters(verdict.filters, shot.filters)
        path = self._album.path(owner, name)
        if not missing:
            return verdict, shot, path
        # In a picture that was filtered before it is unknown which faces are still found.
        face_px = 0.0 if shot.filters else shot.face_px
        plan, noted = self._judge.plan(
            call, grant, replace(verdict, filters=missing), taken_at(shot.poses, now), face_px=face_px, known=known
        )
        data = await self._tasks.complete(self._filtered(owner, path, plan, replace(shot, face_px=face_px)))
        shot = replace(shot, size_bytes=len(data), filters=(*shot.filters, *plan.filters))
        self.judge_again(current_grant() if current_grant else grant, owner, shot)
        return replace(verdict, reason=noted.reason), shot, data

    def judge_again(self, grant: ActiveGrant, owner: str, shot: ImageRecord) -> None:
        """Judge a picture whose retrieval was permitted by the policies of this moment: before each part of it is sent.

        Args:
            grant: the caller's by now.
            owner: whose picture it is.
            shot: the picture as `retrieve` returned it, with the filters that it got.

        Raises:
            Refused: it may not be returned any more, or needs more filters than it got.
        """
        if owner_of(grant) != owner:
            raise PolicyDenied(
                "NoGrant", "the application was replaced by one of the same name; this picture is not its own"
            )
        call, now = Call("RetrieveImage"), self._now()
        verdict = self._judge.judge(call, grant, now, record=False)
        verdict = self._judge.judge_stored(call, grant, shot.poses, verdict, now)
        if remaining_filters(verdict.filters, shot.filters):
            reason = f"{verdict.reason}, which it did not when this picture was asked for; ask again"
            refusal = Verdict("deny", None, "PrivacyZone", reason, verdict.policies)
            self._judge.require(call, grant, refusal, now)

    async def _filtered(self, owner: str, path: Path, plan: FilterPlan, shot: ImageRecord) -> bytes:
        def work() -> bytes:
            picture, upright = decoded(path.read_bytes()), is_upright(shot.poses)
            return encoded(apply_filters([picture], plan, self._detector, shot.face_px, upright=upright))

        async with self._filter_queue.turn(owner):
            with spans.call().child("camera.filters") as span:
                span.note("fractus.filters", [one.action for one in plan.filters])
                return await asyncio.to_thread(work)

    async def list(self, grant: ActiveGrant) -> tuple[Verdict, tuple[ImageRecord, ...]]:
        """The pictures of the caller."""
        verdict = self._judge.judge(Call("ListImages"), grant, self._now())
        return verdict, await asyncio.to_thread(self._album.list, owner_of(grant))

    async def delete(self, grant: ActiveGrant, name: str) -> Verdict:
        """Remove a picture of the caller."""
        verdict = self._judge.judge(Call("DeleteImage"), grant, self._now())
        await asyncio.to_thread(self._album.delete, owner_of(grant), name)
        return verdict

    def _now(self) -> Situation:
        return self._poses.situation(self._clock())

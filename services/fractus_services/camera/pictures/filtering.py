"""Filters for pictures, one picture at a time: which apply, and who is next."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import replace

from fractus_core.policy.values import Call, Filter, Situation, Verdict

from fractus_services.camera.imaging.faces import Detector
from fractus_services.camera.imaging.pipeline import FacesNotReliable, FilterPlan, apply_filters, plan_filters
from fractus_services.camera.imaging.pixels import Pixels
from fractus_services.camera.pictures.fair_queue import MAX_PER_OWNER, FairQueue
from fractus_services.camera.pictures.judge import PictureJudge
from fractus_services.camera.pose.pose import Pose, is_upright
from fractus_services.grants import ActiveGrant

MAX_FILTERING = 8
"""Pictures that are being filtered or wait for it; each is tens of megabytes in memory."""


class Filtering:
    """Filters pictures.

    Args:
        detector: finds faces.
        judge: raises and records the refusals.
        fixed: the camera does not move.
    """

    def __init__(self, detector: Detector, judge: PictureJudge, *, fixed: bool = False) -> None:
        self._detector = detector
        self._judge = judge
        self._fixed = fixed
        self._queue = FairQueue(MAX_PER_OWNER, MAX_FILTERING)

    def turn(self, owner: str) -> AbstractAsyncContextManager[None]:
        """Wait for the turn of an owner to filter a picture, and hold it."""
        return self._queue.turn(owner)

    def plan(
        self,
        call: Call,
        grant: ActiveGrant,
        verdict: Verdict,
        *,
        required: tuple[Filter, ...],
        face_px: float,
        seen: Situation,
    ) -> tuple[FilterPlan, Verdict]:
        """The filters that apply, and the verdict that names a fallback among them.

        Args:
            call: method and arguments.
            grant: the caller's.
            verdict: which policies require filters.
            required: the filters to apply.
            face_px: width of the smallest face that the picture may show; 0 when it is unknown.
            seen: where the picture was taken.

        Raises:
            Refused: faces cannot be hidden reliably, and a policy allows no picture then.
        """
        try:
            plan = plan_filters(required, face_px, self._detector)
        except FacesNotReliable as error:
            refusal = Verdict("deny", None, "FacesNotFound", f"{verdict.reason}; {error}", verdict.policies)
            self._judge.require(call, grant, refusal, seen)
            raise AssertionError("a denial always raises") from error
        return plan, replace(verdict, reason=f"{verdict.reason}; {plan.note}") if plan.note else verdict

    def apply(self, frames: Sequence[Pixels], plan: FilterPlan, face_px: float, poses: Sequence[Pose]) -> Pixels:
        """The picture with its filters applied; takes up to seconds, so call it in a thread."""
        upright = is_upright(poses)
        return apply_filters(frames, plan, self._detector, face_px, upright=upright, fixed=self._fixed)

"""Policy decisions about images. Each decision is written to the audit log."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace

from fractus_core.policy.decision_types import Call, Situation, Verdict
from fractus_core.policy.engine import judge, judge_access, judge_denials
from fractus_core.policy.picture_rules import combine_filters, judge_privacy
from fractus_runtime import tracing
from fractus_runtime.audit import AuditLog

from fractus_services.camera.face_detection import FaceDetector
from fractus_services.camera.filter_pipeline import FaceDetectionUnreliable, FilterPlan, plan_filters
from fractus_services.camera.pose import Pose
from fractus_services.errors import denied
from fractus_services.grant_files import ActiveGrant

log = logging.getLogger(__name__)


class ImageAuthorizer:
    """Authorizes calls of the camera service with the policy engine. A denial is raised as an exception.

    Args:
        audit: Audit log that records decisions.
        detector: Face detector. Policies may deny an image for which it is unreliable.
    """

    def __init__(self, audit: AuditLog, detector: FaceDetector) -> None:
        self._audit = audit
        self.detector = detector

    def authorize(self, call: Call, grant: ActiveGrant, situation: Situation, *, record: bool = True) -> Verdict:
        """Judge a call, and return a verdict that permits it.

        Args:
            call: Method and arguments.
            grant: Grant of the caller.
            situation: Situation of the camera.
            record: False if the call was recorded before. A verdict that permits is then not recorded. Denials are always recorded.

        Raises:
            Refused: The call is denied, or the engine failed.
        """
        with tracing.child_span("policy.judge") as span:
            try:
                verdict = judge(call, situation, grant.compiled)
            except Exception:
                log.exception("policy: engine failed, call denied (method=%s)", call.method)
                verdict = Verdict("deny", None, "InternalError", f"the policy engine failed on {call.method}")
            tracing.set_verdict(span, verdict.action, verdict.code, verdict.policies)
        return self.enforce(call, grant, verdict, situation, record=record)

    def authorize_view(self, call: Call, grant: ActiveGrant, seen: Situation) -> Verdict:
        """Judge the view of the camera by privacy policies and by policies that deny the method.

        Raises:
            Refused: No image of this view may be taken or returned.
        """
        verdict = judge_denials(call.method, seen, grant.compiled) or judge_privacy(seen, grant.compiled)
        return self.enforce(call, grant, verdict, seen)

    def authorize_stored(
        self, call: Call, grant: ActiveGrant, poses: Sequence[Pose], verdict: Verdict, now: Situation
    ) -> Verdict:
        """Combine a verdict on a call with the current policies' verdict on the view of a stored image.

        Raises:
            Refused: No image of this view may be returned.
        """
        return combine_verdicts([verdict, self.authorize_view(call, grant, situation_of(poses, now))])

    def may_locate(self, grant: ActiveGrant, poses: Sequence[Pose], now: Situation) -> bool:
        """Return True if the caller may know where an image was taken.

        The caller must be permitted to call GetPosition at the current position and at all positions of the exposure.
        """
        situations = [now, *(pose.apply_to(now) for pose in poses)]
        try:
            return all(judge_access(Call("GetPosition"), seen, grant.compiled) is None for seen in situations)
        except Exception:
            log.exception("policy: engine failed, position of an image omitted")
            return False

    def plan_filters(
        self, call: Call, grant: ActiveGrant, verdict: Verdict, seen: Situation, *, face_px: float, recorded: Verdict
    ) -> tuple[FilterPlan, Verdict]:
        """Return the filters to apply to an image, and the verdict. If a fallback filter is used, its reason is added to the verdict.

        The verdict is recorded if its filters or policies differ from `recorded`.

        Args:
            call: Method and arguments.
            grant: Grant of the caller.
            verdict: Verdict with the required filters.
            seen: Situation in which the image was taken.
            face_px: Width of the smallest face that the image may show, in pixels, or 0 if it is unknown.
            recorded: Verdict on this call that the audit log already contains.

        Raises:
            Refused: Faces cannot be detected reliably, and a policy then permits no image.
        """
        try:
            plan = plan_filters(verdict.filters, face_px, self.detector)
        except FaceDetectionUnreliable as error:
            refusal = Verdict("deny", None, "FacesNotFound", f"{verdict.reason}; {error}", verdict.policies)
            self.enforce(call, grant, refusal, seen)
            raise AssertionError("a denial always raises") from error
        noted = replace(verdict, reason=f"{verdict.reason}; {plan.note}") if plan.note else verdict
        if (plan.filters, verdict.policies) != (recorded.filters, recorded.policies):
            self.enforce(call, grant, replace(noted, filters=plan.filters), seen, record=True)
        return plan, noted

    def enforce(
        self, call: Call, grant: ActiveGrant, verdict: Verdict, situation: Situation, *, record: bool = False
    ) -> Verdict:
        """Return a verdict that permits. Record and raise a verdict that denies.

        Raises:
            Refused: The verdict denies the call.
        """
        if record or not verdict.permits:
            self._audit.append(
                "call",
                {
                    "caller": grant.identity, "method": call.method, "args": asdict(call.args) if call.args else {},
                    "action": verdict.action, "code": verdict.code, "reason": verdict.reason,
                    "policies": list(verdict.policies),
                    "filters": [required.action for required in verdict.filters],
                    "lat": situation.lat, "lon": situation.lon, "alt": situation.altitude_m,
                },
            )  # fmt: skip
        if not verdict.permits:
            raise denied(verdict)
        return verdict


def situation_of(poses: Iterable[Pose], now: Situation) -> Situation:
    """Return the situation in which an image was taken, at the current time, so that current policies apply.

    Args:
        poses: Stored poses of the exposure.
        now: Current situation.
    """
    exposure = tuple(pose.apply_to(now) for pose in poses)
    return replace(exposure[-1], exposure=exposure)


def combine_verdicts(verdicts: Sequence[Verdict]) -> Verdict:
    """Combine verdicts that permit an image: all their filters are required."""
    filters = combine_filters(required for verdict in verdicts for required in verdict.filters)
    if not filters:
        return verdicts[0]
    names = tuple(dict.fromkeys(name for verdict in verdicts for name in verdict.policies))
    actions = ", ".join(required.action for required in filters)
    reason = f"policy {names[0]} requires {actions}" if names else ""
    return replace(verdicts[0], action="correct", code="PrivacyFilter", reason=reason, policies=names, filters=filters)

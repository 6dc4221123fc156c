"""Judges the calls of the camera service, and writes each decision to the audit log."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace

from fractus_core.policy.decision_types import Call, Situation, Verdict
from fractus_core.policy.engine import judge, judge_denials
from fractus_core.policy.picture_rules import combine_filters, judge_privacy
from fractus_runtime import spans
from fractus_runtime.audit import AuditLog

from fractus_services.camera.face_detection import Detector
from fractus_services.camera.filter_pipeline import FacesNotReliable, FilterPlan, plan_filters
from fractus_services.camera.pose import Pose
from fractus_services.errors import denied
from fractus_services.grant_files import ActiveGrant

log = logging.getLogger(__name__)


class ImageAuthorizer:
    """The policy engine as the camera service asks it: a denial is an exception.

    Args:
        audit: where decisions are recorded.
        detector: finds faces; where it cannot be trusted, policies may deny.
    """

    def __init__(self, audit: AuditLog, detector: Detector) -> None:
        self._audit = audit
        self.detector = detector

    def judge(self, call: Call, grant: ActiveGrant, now: Situation, *, record: bool = True) -> Verdict:
        """The verdict on a call, which permits it.

        Args:
            call: method and arguments.
            grant: the caller's.
            now: where the camera is.
            record: whether a verdict that permits is written down too; later looks at the same call are not.

        Raises:
            Refused: it is denied, or the engine failed.
        """
        with spans.call().child("policy.judge") as span:
            try:
                verdict = judge(call, now, grant.compiled)
            except Exception:
                log.exception("policy: the engine failed, call refused (method=%s)", call.method)
                verdict = Verdict("deny", None, "InternalError", f"the policy engine failed on {call.method}")
            span.verdict(verdict.action, verdict.code, verdict.policies)
        return self.require(call, grant, verdict, now, record=record)

    def judge_view(self, call: Call, grant: ActiveGrant, seen: Situation) -> Verdict:
        """The verdict on what the camera saw in a situation: of privacy policies, and of those that deny the method.

        Raises:
            Refused: no picture may be taken or returned there.
        """
        verdict = judge_denials(call.method, seen, grant.compiled) or judge_privacy(seen, grant.compiled)
        return self.require(call, grant, verdict, seen)

    def judge_stored(
        self, call: Call, grant: ActiveGrant, poses: Sequence[Pose], verdict: Verdict, now: Situation
    ) -> Verdict:
        """A verdict on a call together with that on the place where its picture was taken, under today's policies.

        Raises:
            Refused: no picture of that place may be returned.
        """
        return combined([verdict, self.judge_view(call, grant, taken_at(poses, now))])

    def plan(
        self, call: Call, grant: ActiveGrant, verdict: Verdict, seen: Situation, *, face_px: float, known: Verdict
    ) -> tuple[FilterPlan, Verdict]:
        """The filters that a verdict requires of a picture, and the verdict that names a fallback among them.

        It is written down if these filters are others than the audit log tells by now.

        Args:
            call: method and arguments.
            grant: the caller's.
            verdict: with the required filters.
            seen: where the picture was taken.
            face_px: width of the smallest face that the picture may show; 0 when it is unknown.
            known: the verdict on the call that was written down.

        Raises:
            Refused: faces cannot be hidden reliably, and a policy allows no picture then.
        """
        try:
            plan = plan_filters(verdict.filters, face_px, self.detector)
        except FacesNotReliable as error:
            refusal = Verdict("deny", None, "FacesNotFound", f"{verdict.reason}; {error}", verdict.policies)
            self.require(call, grant, refusal, seen)
            raise AssertionError("a denial always raises") from error
        noted = replace(verdict, reason=f"{verdict.reason}; {plan.note}") if plan.note else verdict
        if (plan.filters, verdict.policies) != (known.filters, known.policies):
            self.require(call, grant, replace(noted, filters=plan.filters), seen, record=True)
        return plan, noted

    def require(
        self, call: Call, grant: ActiveGrant, verdict: Verdict, now: Situation, *, record: bool = False
    ) -> Verdict:
        """A verdict that permits; one that does not is written down and raised.

        Raises:
            Refused: it denies the call.
        """
        if record or not verdict.permits:
            self._audit.append(
                "call",
                {
                    "caller": grant.identity, "method": call.method, "args": asdict(call.args) if call.args else {},
                    "action": verdict.action, "code": verdict.code, "reason": verdict.reason,
                    "policies": list(verdict.policies), "filters": [one.action for one in verdict.filters],
                    "lat": now.lat, "lon": now.lon, "alt": now.altitude_m,
                },
            )  # fmt: skip
        if not verdict.permits:
            raise denied(verdict)
        return verdict


def taken_at(poses: Iterable[Pose], now: Situation) -> Situation:
    """The situation of stored poses, at the present time: policies that are active now apply to a picture from then."""
    way = tuple(pose.at(now) for pose in poses)
    return replace(way[-1], exposure=way)


def combined(verdicts: Sequence[Verdict]) -> Verdict:
    """What several verdicts that permit a picture require together."""
    filters = combine_filters(one for verdict in verdicts for one in verdict.filters)
    if not filters:
        return verdicts[0]
    names = tuple(dict.fromkeys(name for verdict in verdicts for name in verdict.policies))
    reason = f"policy {names[0]} asks for {', '.join(one.action for one in filters)}" if names else ""
    return replace(verdicts[0], action="correct", code="PrivacyFilter", reason=reason, policies=names, filters=filters)

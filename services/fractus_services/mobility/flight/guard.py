"""The engine at the edge: the present situation, the verdict, the audit entry, and the answer to its own failures."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import asdict

from fractus_core.policy.compiled_grant import CompiledGrant
from fractus_core.policy.decision_types import Call, Situation, Verdict
from fractus_core.policy.engine import judge
from fractus_runtime import spans
from fractus_runtime.audit import AuditLog

from fractus_services.grant_files import ActiveGrant

log = logging.getLogger(__name__)

QUIET = frozenset({"GetPosition", "GetSpeed"})
"""Methods that are asked often and change nothing: only their refusals are written down."""


class Guard:
    """Judges calls against the streamed state.

    Args:
        situation: the state of the drone at this moment.
        audit: where verdicts are written.
    """

    def __init__(self, situation: Callable[[], Situation], audit: AuditLog) -> None:
        self.situation = situation
        self._audit = audit

    def judge(
        self,
        call: Call,
        grant: ActiveGrant,
        compiled: CompiledGrant | None = None,
        *,
        kind: str = "call",
        known: Verdict | None = None,
    ) -> Verdict:
        """The verdict on a call, written to the audit log.

        An internal error refuses the call and, for a caller that flies, holds the drone where it is.

        Args:
            call: method and arguments.
            grant: the caller's grant.
            compiled: what it is judged under instead, when the system flies.
            kind: of the audit entry; `check` when the call is not carried out.
            known: the verdict that was written down a moment ago; the same again is not.
        """
        now = self.situation()
        with spans.call().child("policy.judge") as span:
            try:
                verdict = judge(call, now, compiled or grant.compiled)
            except Exception:
                log.exception("guard: policy engine failed, call refused (method=%s)", call.method)
                reason = f"the policy engine failed on {call.method}; nothing was done"
                verdict = Verdict("deny", None, "InternalError", reason, (), "hover")
            span.verdict(verdict.action, verdict.code, verdict.policies)
        if verdict != known and (call.method not in QUIET or not verdict.permits):
            self.record(call, grant.identity, verdict, now, kind=kind)
        return verdict

    def record(self, call: Call, caller: str, verdict: Verdict, now: Situation, *, kind: str = "call") -> None:
        """Write one decision."""
        self._audit.append(
            kind,
            {
                "caller": caller,
                "method": call.method,
                "args": asdict(call.args) if call.args is not None else {},
                "action": verdict.action,
                "code": verdict.code,
                "reason": verdict.reason,
                "policies": list(verdict.policies),
                "takeover": verdict.takeover,
                "result": asdict(verdict.args) if verdict.args is not None and verdict.permits else {},
                "lat": now.lat,
                "lon": now.lon,
                "alt": now.altitude_m,
            },
        )

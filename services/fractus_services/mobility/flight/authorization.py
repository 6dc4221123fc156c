"""Authorization of calls: rate of judgements, order of motions, verdict, and control of the drone."""

from __future__ import annotations

import asyncio
import time

from fractus_core.policy.decision_types import DENY_POSITION_UNKNOWN, Call, Verdict

from fractus_services.errors import Aborted, Unavailable, denied
from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.flight.policy_gate import PolicyGate
from fractus_services.mobility.settings import SETTINGS

DRIVER_METHODS = frozenset(
    {
        "Arm",
        "Disarm",
        "Takeoff",
        "Land",
        "Goto",
        "ReturnToLaunch",
        "Hover",
        "SetSpeed",
        "SetVelocity",
        "ReturnControl",
        "PointGimbal",
    }
)
"""Methods that only a driver may call."""


class CallAuthorizer:
    """Throttles and judges calls.

    Args:
        control: Control state. Takeovers demanded by a verdict are dispatched to it.
        gate: Policy engine.
    """

    def __init__(self, control: ControlStore, gate: PolicyGate) -> None:
        self._control = control
        self._gate = gate
        self._free_at = {True: 0.0, False: 0.0}
        self._motion_calls = 0

    async def throttle(self, grant: ActiveGrant) -> None:
        """Wait until the pause after the previous judgement for this kind of caller is over."""
        wait_s = self._wait_s(grant)
        while wait_s > 0:
            await asyncio.sleep(wait_s)
            # Another waiting call may have gone first, and the caller may have gained or lost control.
            wait_s = self._wait_s(grant)

    async def throttle_motion(self, grant: ActiveGrant) -> None:
        """Wait like `throttle` before a call that moves the drone.

        Raises:
            Aborted: The driver made a later motion call meanwhile.
        """
        number = self.cancel_pending(grant)
        await self.throttle(grant)
        if self._has_control(grant) and number != self._motion_calls:
            raise Aborted("Replaced", "a later motion call replaced this call")

    def cancel_pending(self, grant: ActiveGrant) -> int:
        """Number a motion call, which cancels waiting ones. Calls of callers without control cancel nothing."""
        self._motion_calls += self._has_control(grant)
        return self._motion_calls

    def _wait_s(self, grant: ActiveGrant) -> float:
        return self._free_at[self._has_control(grant)] - self._control.autopilot.now

    def _has_control(self, grant: ActiveGrant) -> bool:
        lease = self._control.lease
        return lease is not None and lease.key == grant.key

    def allow(self, call: Call, grant: ActiveGrant) -> Verdict:
        """Judge a call that does not move the drone.

        Raises:
            Refused: A policy forbids the call.
        """
        verdict = self._gate.judge(call, grant)
        if not verdict.permits:
            raise denied(verdict)
        return verdict

    def check(self, call: Call, grant: ActiveGrant) -> Verdict:
        """Return the verdict on a call that is not carried out (dry run)."""
        if grant.spec.class_ != "driver" and call.method in DRIVER_METHODS:
            return self._deny_passenger(call, grant, kind="check")
        return self._judge(call, grant, kind="check")

    def allow_motion(self, call: Call, grant: ActiveGrant, known: Verdict | None = None) -> Verdict:
        """Judge a call that moves the drone, of a driver that has control. Dispatch a takeover that the verdict demands.

        Raises:
            Refused: A policy forbids the call, or the caller does not have control.
        """
        if grant.spec.class_ != "driver":
            raise denied(self._deny_passenger(call, grant))
        verdict = self._judge(call, grant, known=known)
        if verdict.code == "MethodNotGranted":
            raise denied(verdict)
        # Check control before the verdict has consequences: a call of a driver that waits for the drone must neither brake
        # it nor take it from the driver in control.
        self._control.require_control(grant)
        if verdict.action == "takeover":
            self._control.take_over(verdict)
            raise denied(verdict)
        if verdict.code == DENY_POSITION_UNKNOWN.code and verdict.action == "deny":
            raise Unavailable("AutopilotUnavailable", verdict.reason, retry_after_s=SETTINGS.position_retry_after_s)
        if not verdict.permits:
            if verdict.takeover is not None:
                self._control.brake(verdict)
            raise denied(verdict)
        return verdict

    def _judge(self, call: Call, grant: ActiveGrant, *, kind: str = "call", known: Verdict | None = None) -> Verdict:
        has_control = self._has_control(grant)
        begun = time.perf_counter()
        try:
            return self._gate.judge(call, grant, kind=kind, known=known)
        finally:
            rest_s = (time.perf_counter() - begun) * (
                SETTINGS.driver_rest_factor if has_control else SETTINGS.others_rest_factor
            )
            self._free_at[has_control] = max(self._free_at[has_control], self._control.autopilot.now + rest_s)

    def _deny_passenger(self, call: Call, grant: ActiveGrant, *, kind: str = "call") -> Verdict:
        verdict = Verdict("deny", None, "NotADriver", f"a passenger may not call {call.method}; only a driver may")
        self._gate.record(call, grant.identity, verdict, self._gate.situation(), kind=kind)
        return verdict

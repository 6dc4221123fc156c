"""Authorization of calls and of system flights: current situation, verdict, audit entry, throttling, and control of the drone."""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace

from fractus_core.control.state import CONTACT_LOST
from fractus_core.policy.compiled_grant import CompiledGrant
from fractus_core.policy.decision_types import DENY_POSITION_UNKNOWN, Airframe, Call, Situation, Verdict
from fractus_core.policy.engine import judge
from fractus_core.policy.route_check import after, at_rest
from fractus_runtime import tracing
from fractus_runtime.audit import AuditLog

from fractus_services.errors import Aborted, Unavailable, denied
from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.autopilot import LEG_MPS
from fractus_services.mobility.settings import SETTINGS

log = logging.getLogger(__name__)

REFUSALS_ONLY = frozenset({"GetPosition", "GetSpeed"})
"""Frequent methods that change nothing: only refusals are written to the audit log."""

VERTICAL_MOTIONS = frozenset({"Takeoff", "Land", "ReturnToLaunch"})
"""Motions during which the drone may climb or descend without a leg."""

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

SUSPENDED_METHODS = frozenset({"Takeoff", "Goto", "SetVelocity"})
"""Motions that are refused while the drone flies to a target that a geofence corrected."""

CONTACT_METHODS = SUSPENDED_METHODS | {"Arm"}
"""Methods that are refused while contact with the API server is lost, if the application depends on it."""


class PolicyGate:
    """Judges calls in the current situation.

    Args:
        control: Control state.
        clock: Unix time, for the schedules of policies.
        audit: Audit log for verdicts.
    """

    def __init__(self, control: ControlStore, clock: Callable[[], float], audit: AuditLog) -> None:
        self._control = control
        self._clock = clock
        self._audit = audit

    def situation(self) -> Situation:
        """Return the current state of the drone for the policy engine.

        The position is unknown if it is stale, if the link is too slow, or if home was moved.
        """
        control = self._control
        autopilot = control.autopilot
        vehicle = autopilot.vehicle
        motion = control.motion
        airframe = control.failsafe_status.airframe if control.failsafe_status is not None else Airframe()
        if airframe.retraces and not control.retraces:
            airframe = replace(airframe, retraces=False)
        unlocated = Situation(
            time_s=self._clock(),
            home=vehicle.home,
            armed=vehicle.armed,
            in_air=vehicle.in_air,
            airframe=airframe,
            altitude_m=vehicle.altitude_m,
            speed_setpoint_mps=control.cruise_mps,
        )
        latency_s = autopilot.latency_s
        fresh = vehicle.position_fresh(autopilot.now)
        if not fresh or not math.isfinite(latency_s) or control.home_moved:
            return unlocated
        # Only the direction of a pending leg is known. Its speed is at most its commanded speed.
        leg_mps = (motion.speed_mps or 0.0) if motion is not None else 0.0
        max_mps = max(control.cruise_mps, leg_mps)
        pending: list[tuple[float, float, float]] = []
        for north, east, down in autopilot.pending:
            if max(abs(north), abs(east), abs(down)) < LEG_MPS / 2:
                pending.append((north, east, down))
            else:
                vertical_mps = min(max(down, -max_mps), max_mps)
                pending.append((north * max_mps / LEG_MPS, east * max_mps / LEG_MPS, vertical_mps))
        return replace(
            unlocated,
            lat=vehicle.lat,
            lon=vehicle.lon,
            north_mps=vehicle.north_mps,
            east_mps=vehicle.east_mps,
            down_mps=vehicle.down_mps,
            position_error_m=vehicle.position_error_m,
            latency_s=latency_s,
            forward_mps2=vehicle.forward_mps2,
            pending=tuple(pending),
            vertical=vehicle.mode.comes_down or (motion is not None and motion.kind in VERTICAL_MOTIONS),
        )

    def judge(
        self,
        call: Call,
        grant: ActiveGrant,
        compiled: CompiledGrant | None = None,
        *,
        kind: str = "call",
        known: Verdict | None = None,
        assumed: Situation | None = None,
    ) -> Verdict:
        """Return the verdict on a call and write it to the audit log.

        If the engine fails, the call is denied and a drone that its driver flies hovers.

        Args:
            call: Method and arguments.
            grant: Grant of the caller.
            compiled: Constraints to judge under instead of the grant's, for system flights.
            kind: Kind of the audit entry; `check` if the call is not carried out.
            known: Verdict that was just recorded. An equal verdict is not recorded again.
            assumed: Situation to judge in instead of the current one. Only refusals are recorded then.
        """
        situation = self.situation() if assumed is None else assumed
        with tracing.child_span("policy.judge") as span:
            try:
                verdict = judge(call, situation, compiled or grant.compiled)
            except Exception:
                log.exception("policy: engine failed, call denied (method=%s)", call.method)
                reason = f"the policy engine failed on {call.method}; nothing was done"
                verdict = Verdict("deny", None, "InternalError", reason, (), "hover")
            tracing.set_verdict(span, verdict.action, verdict.code, verdict.policies)
        quiet = assumed is not None or call.method in REFUSALS_ONLY
        if verdict != known and not (quiet and verdict.permits):
            self.record(call, grant.identity, verdict, situation, kind=kind)
        return verdict

    def record(self, call: Call, caller: str, verdict: Verdict, situation: Situation, *, kind: str = "call") -> None:
        """Write one verdict to the audit log."""
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
                "lat": situation.lat,
                "lon": situation.lon,
                "alt": situation.altitude_m,
            },
        )


class CallAuthorizer:
    """Throttles and judges calls.

    Args:
        control: Control state. If a verdict demands a takeover, the takeover is dispatched to the control state.
        gate: Policy engine.
    """

    def __init__(self, control: ControlStore, gate: PolicyGate) -> None:
        self._control = control
        self._gate = gate
        self._free_at = {True: 0.0, False: 0.0}
        self._motion_calls = 0

    async def throttle(self, grant: ActiveGrant) -> None:
        """Wait for the end of the pause that follows each judgement of a call.

        Calls of the driver in control and calls of all other callers have separate pauses.
        """
        while True:
            wait_s = self._free_at[self._has_control(grant)] - self._control.autopilot.now
            if wait_s <= 0:
                return
            # Repeat the check after the sleep. Another waiting call may have been judged first, or the caller may have
            # gained or lost control.
            await asyncio.sleep(wait_s)

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
        """Cancel waiting motion calls of the driver in control, and return the number of this call.

        Calls of callers without control cancel nothing.
        """
        self._motion_calls += self._has_control(grant)
        return self._motion_calls

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

    async def check_route(
        self, calls: Sequence[Call], grant_of: Callable[[], ActiveGrant]
    ) -> list[tuple[int, Verdict]]:
        """Judge calls that would be made one after the other, each for a drone at rest at the place to which the previous call leads.

        Args:
            calls: Calls in order.
            grant_of: Returns the current Grant of the caller.

        Returns:
            Positions and verdicts of the first corrected call and of the refused call, if there are any. The calls after
            a refused call are not judged.

        Raises:
            Refused: The caller is a passenger.
        """
        corrected: list[tuple[int, Verdict]] = []
        grant = self._driver_grant(grant_of)
        now = at_rest(self._gate.situation())
        for position, call in enumerate(calls):
            await self.throttle(grant)
            grant = self._driver_grant(grant_of)
            verdict = self._judge(call, grant, kind="check", assumed=now)
            if not verdict.permits:
                return [*corrected, (position, verdict)]
            if verdict.action != "allow" and not corrected:
                corrected.append((position, verdict))
            now = after(call, verdict, now, grant.compiled)
        return corrected

    def _driver_grant(self, grant_of: Callable[[], ActiveGrant]) -> ActiveGrant:
        """Return the current Grant of a driver that checks a route.

        Raises:
            Refused: The caller is a passenger.
        """
        grant = grant_of()
        if grant.spec.class_ != "driver":
            raise denied(self._deny_passenger(Call("CheckRoute"), grant, kind="check"))
        return grant

    def allow_motion(self, call: Call, grant: ActiveGrant, known: Verdict | None = None) -> Verdict:
        """Judge a call that moves the drone, of a driver that has control. Dispatch a takeover that the verdict demands.

        Args:
            call: Method and arguments.
            grant: Grant of the caller.
            known: Last verdict on the same motion; None for a new call. Only new calls can be suspended.

        Raises:
            Refused: A policy forbids the call, the driver is suspended, or the caller does not have control.
        """
        if grant.spec.class_ != "driver":
            raise denied(self._deny_passenger(call, grant))
        suspension = self._control.suspension
        if suspension is not None and known is None and call.method in CONTACT_METHODS and self._has_control(grant):
            self._suspend(call, grant, suspension)
        verdict = self._judge(call, grant, known=known)
        if verdict.code == "MethodNotGranted":
            raise denied(verdict)
        # Check control before the verdict has consequences: a call of a driver that waits for the drone must neither brake
        # it nor take it from the driver in control.
        self._control.require_control(grant)
        lease = self._control.lease
        if lease is not None and math.isfinite(lease.called_at):
            lease.called_at = self._control.autopilot.now
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

    def _suspend(self, call: Call, grant: ActiveGrant, suspension: Verdict) -> None:
        """Refuse a call that has to wait for contact or for the end of a corrected leg, and record the refusal.

        Raises:
            Unavailable: The call has to wait.
        """
        if suspension.code == CONTACT_LOST:
            verdict = replace(suspension, reason=f"{suspension.reason}; wait until it returns, or land")
        elif call.method in SUSPENDED_METHODS:
            reason = (
                f"the drone first completes its corrected leg ({suspension.reason});"
                " repeat the call when it has arrived, or call Hover, Land or ReturnToLaunch"
            )
            verdict = Verdict("deny", None, "Suspended", reason, suspension.policies)
        else:
            return
        self._gate.record(call, grant.identity, verdict, self._gate.situation())
        self._free_at[True] = max(self._free_at[True], self._control.autopilot.now + SETTINGS.suspended_rest_s)
        raise Unavailable(verdict.code, verdict.reason, verdict=verdict, retry_after_s=SETTINGS.suspended_retry_after_s)

    def _judge(
        self,
        call: Call,
        grant: ActiveGrant,
        *,
        kind: str = "call",
        known: Verdict | None = None,
        assumed: Situation | None = None,
    ) -> Verdict:
        has_control = self._has_control(grant)
        begun = time.perf_counter()
        try:
            return self._gate.judge(call, grant, kind=kind, known=known, assumed=assumed)
        finally:
            factor = SETTINGS.driver_rest_factor if has_control else SETTINGS.others_rest_factor
            rest_s = (time.perf_counter() - begun) * factor
            self._free_at[has_control] = max(self._free_at[has_control], self._control.autopilot.now + rest_s)

    def _deny_passenger(self, call: Call, grant: ActiveGrant, *, kind: str = "call") -> Verdict:
        verdict = Verdict("deny", None, "NotADriver", f"a passenger may not call {call.method}; only a driver may")
        self._gate.record(call, grant.identity, verdict, self._gate.situation(), kind=kind)
        return verdict

"""The policy engine at the border of the service: present situation, verdict, audit entry, and engine failures."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import asdict, replace

from fractus_core.policy.compiled_grant import CompiledGrant
from fractus_core.policy.decision_types import Airframe, Call, Situation, Verdict
from fractus_core.policy.engine import judge
from fractus_runtime import tracing
from fractus_runtime.audit import AuditLog

from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.authority.home import home_moved
from fractus_services.mobility.autopilot import LEG_MPS

log = logging.getLogger(__name__)

REFUSALS_ONLY = frozenset({"GetPosition", "GetSpeed"})
"""Frequent methods that change nothing: only refusals are written to the audit log."""

VERTICAL_MOTIONS = frozenset({"Takeoff", "Land", "ReturnToLaunch"})
"""Motions during which the drone may climb or descend without a leg."""


class PolicyGate:
    """Judges calls against the present situation.

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
        """Return the present state of the drone as the policy engine judges it.

        The position is unknown if it is stale, if the link is too slow, or if home was moved.
        """
        control = self._control
        autopilot = control.autopilot
        vehicle = autopilot.vehicle
        motion = control.motion
        airframe = control.checked.airframe if control.checked is not None else Airframe()
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
        if not fresh or not math.isfinite(latency_s) or home_moved(control.state, vehicle):
            return unlocated
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
            pending=self._pending_velocities(),
            vertical=vehicle.mode.comes_down or (motion is not None and motion.kind in VERTICAL_MOTIONS),
        )

    def _pending_velocities(self) -> tuple[tuple[float, float, float], ...]:
        """Return recently commanded velocities (north, east, down). The speed of a leg is at most its commanded speed."""
        motion = self._control.motion
        leg_mps = (motion.speed_mps or 0.0) if motion is not None else 0.0
        max_mps = max(self._control.cruise_mps, leg_mps)

        def capped(velocity: tuple[float, float, float]) -> tuple[float, float, float]:
            north, east, down = velocity
            if max(map(abs, velocity)) < LEG_MPS / 2:
                return velocity
            return north * max_mps / LEG_MPS, east * max_mps / LEG_MPS, min(max(down, -max_mps), max_mps)

        return tuple(map(capped, self._control.autopilot.pending))

    def judge(
        self,
        call: Call,
        grant: ActiveGrant,
        compiled: CompiledGrant | None = None,
        *,
        kind: str = "call",
        known: Verdict | None = None,
    ) -> Verdict:
        """Return the verdict on a call and write it to the audit log.

        If the engine fails, the call is denied and a drone that its driver flies hovers.

        Args:
            call: Method and arguments.
            grant: Grant of the caller.
            compiled: Constraints to judge under instead of the grant's, for system flights.
            kind: Kind of the audit entry; `check` if the call is not carried out.
            known: Verdict that was just recorded. An equal verdict is not recorded again.
        """
        now = self.situation()
        with tracing.child_span("policy.judge") as span:
            try:
                verdict = judge(call, now, compiled or grant.compiled)
            except Exception:
                log.exception("policy: engine failed, call denied (method=%s)", call.method)
                reason = f"the policy engine failed on {call.method}; nothing was done"
                verdict = Verdict("deny", None, "InternalError", reason, (), "hover")
            tracing.set_verdict(span, verdict.action, verdict.code, verdict.policies)
        if verdict != known and (call.method not in REFUSALS_ONLY or not verdict.permits):
            self.record(call, grant.identity, verdict, now, kind=kind)
        return verdict

    def record(self, call: Call, caller: str, verdict: Verdict, now: Situation, *, kind: str = "call") -> None:
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
                "lat": now.lat,
                "lon": now.lon,
                "alt": now.altitude_m,
            },
        )

"""The engine at the edge: the present situation, the verdict, the audit entry, and the answer to its own failures."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import asdict, replace

from fractus_core.geo import LocalFrame
from fractus_core.policy.compiled import CompiledGrant
from fractus_core.policy.engine import judge
from fractus_core.policy.values import Airframe, Call, Situation, Verdict

from fractus_services.audit import AuditLog
from fractus_services.grants import ActiveGrant
from fractus_services.mobility.authority.control import Control
from fractus_services.mobility.flight.motions import distance_m

log = logging.getLogger(__name__)

STALE_S = 1.0
"""A position older than this is no position."""

QUIET = frozenset({"GetPosition", "GetSpeed"})
"""Methods that are asked often and change nothing: only their refusals are written down."""


class Guard:
    """Judges calls against the streamed state."""

    def __init__(self, control: Control, audit: AuditLog, clock: Callable[[], float]) -> None:
        self._control = control
        self._audit = audit
        self._clock = clock

    def situation(self) -> Situation:
        """The state of the drone at this moment; a stale position counts as unknown."""
        autopilot = self._control.autopilot
        checked = self._control.checked
        airframe = checked.airframe if checked is not None else Airframe()
        if airframe.retraces and not self._control.retraces:
            airframe = replace(airframe, retraces=False)
        speed = self._control.cruise_mps
        motion = self._control.motion
        vertical = motion is not None and motion.kind in {"Takeoff", "Land", "ReturnToLaunch"}
        now = autopilot.vehicle.situation(self._clock(), airframe, speed, vertical)
        if autopilot.now - autopilot.vehicle.position_at <= STALE_S:
            return now
        return Situation(
            time_s=now.time_s,
            home=now.home,
            armed=now.armed,
            in_air=now.in_air,
            airframe=airframe,
            altitude_m=now.altitude_m,
            speed_setpoint_mps=speed,
        )

    def distance_m(self, lat: float, lon: float) -> float:
        """How far away a place is over ground; infinite while the drone's position is unknown."""
        vehicle = self._control.autopilot.vehicle
        return distance_m(LocalFrame(lat, lon), vehicle.lat, vehicle.lon)

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
        try:
            verdict = judge(call, now, compiled or grant.compiled)
        except Exception:
            log.exception("the policy engine failed on %s; refused", call.method)
            verdict = Verdict(
                "deny",
                None,
                "InternalError",
                f"the policy engine failed on {call.method}; nothing was done",
                (),
                "hover",
            )
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

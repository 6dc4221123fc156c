"""Continuous monitor of the flying drone, and flight recorder."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from fractus_core.control import Authority
from fractus_core.control.events import Airborne, PositionFound, PositionLost
from fractus_core.control.machine import CORRECTION
from fractus_core.control.state import ModeKind, TaskKind
from fractus_core.control.state_update import POSITION_UNKNOWN
from fractus_core.policy.compiled_grant import CompiledGrant
from fractus_core.policy.decision_types import GotoArgs, SetSpeedArgs, Verdict
from fractus_core.policy.monitoring import monitor
from fractus_runtime.audit import AuditLog

from fractus_services.errors import Aborted, AutopilotError, Refused
from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.authority.effects import Motion
from fractus_services.mobility.authority.supervisor import Supervisor
from fractus_services.mobility.autopilot import Permit
from fractus_services.mobility.flight.authorization import PolicyGate
from fractus_services.mobility.flight.motions import fly_to
from fractus_services.mobility.flight.return_to_launch import ReturnFlight
from fractus_services.mobility.flight.route_following import REPLAN_CODES, limited_mps
from fractus_services.mobility.settings import SETTINGS

log = logging.getLogger(__name__)


HANDED_BACK_CLIMB_M = 1.0
"""Climb after which a drone that a pilot handed back is known to fly."""

Permits = Callable[[Motion | None], Permit]
"""Returns the permit for the commands of a motion."""


class MotionMonitor:
    """Judges the current state of the flying drone and reacts to violations.

    Args:
        control: Control state.
        gate: Policy engine.
        audit: Audit log for alarms and for the flight recorder.
        supervisor: Supervision that runs in the same loop.
        return_flight: Return flights. A return for which no legal route was found is not interrupted.
    """

    def __init__(
        self,
        control: ControlStore,
        gate: PolicyGate,
        audit: AuditLog,
        supervisor: Supervisor,
        return_flight: ReturnFlight,
    ) -> None:
        self._control = control
        self._gate = gate
        self._audit = audit
        self._supervisor = supervisor
        self._return_flight = return_flight
        self._alarm = ""
        self._alarm_at = 0.0
        self._grant: ActiveGrant | None = None
        self._in_force: tuple[tuple[bool, bool], ...] = ()
        self._changed_at = -math.inf
        self._left_by_pilot_m: float | None = None
        """Last altitude under a pilot's control, until the drone moves under another control."""

    async def run(self) -> None:
        """Monitor until cancelled."""
        autopilot = self._control.autopilot
        while True:
            interval_s = SETTINGS.monitor_idle_interval_s
            if autopilot.vehicle.in_air:
                interval_s = SETTINGS.monitor_interval_s / autopilot.pace
            await autopilot.update(interval_s)
            self._reset_return()
            if autopilot.vehicle.in_air:
                self._control.dispatch(Airborne())
                try:
                    self.check()
                except Exception:
                    log.exception("monitor: check failed, drone brakes")
                    reason = "the motion monitor failed"
                    self._control.brake(Verdict("deny", None, "InternalError", reason, (), "hover"))
            try:
                self._control.check_contact()
                self._control.store_flown_grant()
                self._supervisor.tick()
            except Exception:
                # A failing supervisor stops the heartbeats: within seconds the autopilot brings the drone home.
                log.exception("monitor: supervisor failed, the autopilot's failsafe brings the drone home")

    def _reset_return(self) -> None:
        """Allow another search for a legal return when the drone has landed or carries out another motion in GUIDED."""
        control = self._control
        vehicle = control.autopilot.vehicle
        returns = control.state.returning or (control.motion is not None and control.motion.kind == "ReturnToLaunch")
        if not vehicle.in_air or (vehicle.mode.commanded and not returns):
            self._return_flight.given_up = None

    def check(self) -> None:
        """Judge the current state once and react to a violation."""
        control = self._control
        mode = control.autopilot.vehicle.mode
        piloted = control.authority is Authority.PILOT
        compiled = self._constraints() if mode.comes_down or (mode.commanded and not piloted) else None
        verdict, by_system = self._judge(compiled) if compiled is not None else (None, False)
        untouched = self._stays_where_pilot_left_it(piloted)
        if verdict is not None and verdict.code == "AltitudeBelowLimit" and untouched:
            # The pilot may have landed the drone. Until the autopilot detects the landing, a climb would take off again.
            verdict = None
        problem = control.autopilot.vehicle.position_problem
        if verdict is not None and verdict.code == POSITION_UNKNOWN and problem:
            verdict = replace(verdict, reason=f"the drone's position is not trusted: {problem}")
        if verdict is None or verdict.code != POSITION_UNKNOWN:
            control.dispatch(PositionFound())
        if compiled is None or verdict is None:
            self._alarm = ""
            return
        uncommanded = not mode.commanded or (control.state.returning and control.motion is None)
        may_act = not uncommanded or self._may_take_back(verdict)
        timed_out = control.autopilot.now - self._alarm_at > SETTINGS.correction_timeout_s
        new_alarm = verdict.code != self._alarm or (timed_out and may_act)
        if new_alarm:
            self._alarm = verdict.code
            self._alarm_at = control.autopilot.now
            policies = ",".join(verdict.policies) or "-"
            log.warning(
                "monitor: alarm raised (code=%s mode=%s policies=%s reason=%s)",
                verdict.code, mode.name, policies, verdict.reason,
            )  # fmt: skip
        if uncommanded:
            if new_alarm:
                self._note("takeBack" if may_act else "alarm", verdict)
            if new_alarm and may_act:
                self._take_back(verdict)
        elif verdict.code == POSITION_UNKNOWN:
            self._hover(verdict, new_alarm)
        elif verdict.action == "takeover" and not by_system:
            control.take_over(verdict)
        elif verdict.action in {"takeover", "deny"}:
            self._stop(verdict, new_alarm)
        elif new_alarm:
            self._correct(verdict, compiled)

    def _stays_where_pilot_left_it(self, piloted: bool) -> bool:
        """Return True if the drone has neither moved nor climbed since a pilot handed it back."""
        altitude_m = self._control.autopilot.vehicle.altitude_m
        left_m = self._left_by_pilot_m
        if piloted:
            self._left_by_pilot_m = altitude_m
        elif left_m is not None and (self._control.motion is not None or altitude_m > left_m + HANDED_BACK_CLIMB_M):
            self._left_by_pilot_m = None
        return self._left_by_pilot_m is not None

    def _constraints(self) -> CompiledGrant | None:
        """Return the constraints of the current flight; None if no Grant applies.

        A flight of the system or of the autopilot may be anywhere between home and operation area.
        """
        control = self._control
        if control.constraints is not None:
            return control.constraints.compiled
        autonomous = control.state.returning or control.autopilot.vehicle.mode.comes_down
        if control.authority is Authority.DRIVER or not autonomous:
            return control.mission_grant.compiled if control.mission_grant is not None else None
        return control.for_transit(control.last_grant) if control.last_grant is not None else None

    def _judge(self, compiled: CompiledGrant) -> tuple[Verdict | None, bool]:
        """Return the violation, if any. The second value is True if the system already flies the drone, so that no takeover is needed."""
        control = self._control
        now = self._gate.situation()
        changed = self._has_changed(compiled.fences_in_force(now.time_s))
        motion = control.motion
        # A movement without a motion was never judged: another station commands it, or a motion has just ended. A drone
        # that keeps its position is moved by gusts only, and the position margin covers gusts.
        vehicle = control.autopilot.vehicle
        changed = changed or (motion is None and not vehicle.keeps_place(control.autopilot.now))
        current_leg = motion.leg if motion is not None and motion.under_way and not motion.braking else None
        if control.state.returning or not control.autopilot.vehicle.mode.commanded:
            # The autopilot's own flights were never judged.
            changed = changed or not control.autopilot.vehicle.mode.commanded
            return monitor(now, compiled, system_flies=True, fences_changed=changed, current_leg=current_leg), True
        verdict = monitor(now, compiled, fences_changed=changed, current_leg=current_leg)
        system_correction = control.constraints is not None and verdict is not None and verdict.action == "correct"
        if verdict is None or (
            not system_correction and (verdict.takeover != "hover" or control.authority is Authority.DRIVER)
        ):
            return verdict, False
        return monitor(now, compiled, system_flies=True, fences_changed=changed, current_leg=current_leg), True

    @property
    def _flown_grant(self) -> ActiveGrant | None:
        constraints = self._control.constraints
        return constraints.grant if constraints is not None else self._control.last_grant

    def _may_take_back(self, verdict: Verdict) -> bool:
        """Return True if the system may interrupt a flight of the autopilot.

        The system does not interrupt a mode that a pilot chose, or may have chosen before the service started. It also
        does not interrupt a landing by the system or by a failsafe, or a return flight for which it found no legal
        route.
        """
        control = self._control
        mode = control.autopilot.vehicle.mode
        if mode.commanded or verdict.code == POSITION_UNKNOWN or self._return_flight.given_up is self._flown_grant:
            return False
        if control.authority is Authority.DRIVER:
            return True
        task = control.state.task
        by_system = task is not None and task.kind in {TaskKind.RETURN, TaskKind.LAND_AT} and not task.begun_by_others
        returns = by_system and mode.kind is ModeKind.RETURNING
        return returns and control.authority is Authority.SYSTEM

    def _take_back(self, verdict: Verdict) -> None:
        """Stop the drone in GUIDED. A driver receives the reason. A return flight continues on a legal route."""
        control = self._control
        state = control.state
        control.stop_motion(verdict)

        def permit() -> None:
            now = control.state
            if now.authority is not state.authority or now.task != state.task or now.motion is not None:
                raise AutopilotError("another motion has begun")

        control.tasks.spawn(control.tasks.attempt(control.modes.hold, permit))

    def _has_changed(self, in_force: tuple[tuple[bool, bool], ...]) -> bool:
        """Return True if the current leg may have been judged under other constraints, because a Grant or a schedule changed."""
        control = self._control
        grant = self._flown_grant
        autopilot = control.autopilot
        motion = control.motion
        if grant is not self._grant or in_force != self._in_force:
            self._grant = grant
            self._in_force = in_force
            self._changed_at = autopilot.now
        just_began = autopilot.now - control.state.motion_began_at < SETTINGS.movement_timeout_s
        if (
            (motion is None or motion.kind == "Takeoff")
            and not just_began
            and autopilot.vehicle.keeps_place(autopilot.now)
        ):
            # From now on, every movement is judged under the current constraints or under later constraints.
            self._changed_at = -math.inf
        return autopilot.now - self._changed_at < SETTINGS.grant_change_s

    def _stop(self, verdict: Verdict, new_alarm: bool) -> None:
        """End the motion that causes the violation. A system flight then searches a different route.

        A motion that still brakes before its leg is not ended, because it stops the drone anyway.
        """
        control = self._control
        motion = control.motion
        braking = motion is not None and motion.braking
        if not braking and (new_alarm or motion is not None):
            control.brake(verdict)
        else:
            control.autopilot.stop()

    def _hover(self, verdict: Verdict, new_alarm: bool) -> None:
        """Hover while the position is unknown. The driver keeps control for the grace period."""
        if new_alarm or self._control.motion is not None:
            self._control.dispatch(PositionLost(verdict.reason))
        else:
            self._control.autopilot.stop()

    def _note(self, action: str, verdict: Verdict) -> None:
        """Write an alarm to the audit log."""
        content = {"action": action, "code": verdict.code, "reason": verdict.reason, "policies": list(verdict.policies)}
        self._audit.append("monitor", content | {"mode": self._control.autopilot.vehicle.mode.name})

    def _correct(self, verdict: Verdict, compiled: CompiledGrant) -> None:
        if self._control.constraints is not None and verdict.code in REPLAN_CODES:
            self._stop(verdict, new_alarm=True)  # The system flight then searches a different route.
            return
        self._note(verdict.action, verdict)
        self._control.tasks.spawn(self._carry_out(verdict, self._control.motion, self._permits(), compiled))

    def _permits(self) -> Permits:
        """Return permits for a correction. They are valid while lease, authority and motion do not change."""
        control = self._control
        lease = control.lease
        authority = control.authority

        def permit(motion: Motion | None) -> Permit:
            def check() -> None:
                if control.lease is not lease or control.authority is not authority or control.motion is not motion:
                    raise Aborted("Replaced", "another motion has begun")

            return check

        return permit

    async def _carry_out(
        self, verdict: Verdict, current: Motion | None, permits: Permits, compiled: CompiledGrant
    ) -> None:
        try:
            permits(current)()
        except Aborted:
            self._alarm = ""
            return  # Another motion has begun. The next check judges it.
        try:
            if isinstance(verdict.args, SetSpeedArgs):
                await self._slow_down(verdict.args.speed_mps, permits(current))
            elif isinstance(verdict.args, GotoArgs):
                await self._lead_back(verdict, verdict.args, permits, compiled)
        except (AutopilotError, Refused) as error:
            log.warning("monitor: correction failed (error=%s)", error)

    async def _slow_down(self, speed_mps: float, permit: Permit) -> None:
        """Reduce the speed of the current leg. The next leg is judged separately."""
        motion = self._control.motion
        if motion is not None and motion.speed_mps is not None:
            speed_mps = motion.speed_mps = min(speed_mps, motion.speed_mps)
        await self._control.autopilot.set_speed(speed_mps, permit)

    async def _lead_back(self, verdict: Verdict, target: GotoArgs, permits: Permits, compiled: CompiledGrant) -> None:
        """Fly back into the limits. This motion replaces the motion that violated the limits."""
        control = self._control
        control.stop_motion(verdict)
        motion = control.begin_motion(CORRECTION)
        speed = limited_mps(control.cruise_mps, target, self._gate.situation(), compiled)
        leg = replace(target, speed_mps=speed)
        try:
            async for _ in fly_to(control.autopilot, motion, leg, SETTINGS.reached_m, permits(motion)):
                pass
        except Exception:
            control.fail_motion(motion)
            raise
        control.finish_motion(motion)

    async def record(self) -> None:
        """Record the flight in the audit log until cancelled."""
        while True:
            await asyncio.sleep(SETTINGS.record_interval_s)
            if self._control.autopilot.vehicle.armed:
                self._audit.append("state", flight_record(self._control), now=False)


def flight_record(control: ControlStore) -> dict[str, Any]:
    """Return one entry of the flight recorder."""
    vehicle = control.autopilot.vehicle
    return {
        "lat": vehicle.lat,
        "lon": vehicle.lon,
        "alt": round(vehicle.altitude_m, 2),
        "amsl": round(vehicle.amsl_m, 2),
        "speed": round(vehicle.speed_mps, 2),
        "mode": vehicle.mode.name,
        "battery": round(vehicle.battery_remaining, 3) if math.isfinite(vehicle.battery_remaining) else 0.0,
        "controller": control.state.controller,
        "in_air": vehicle.in_air,
    }

"""The continuous monitor and the flight recorder: what runs while the drone is armed."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from fractus_core.control import Authority
from fractus_core.control.events import Airborne, PositionFound, PositionLost
from fractus_core.control.machine import POSITION_UNKNOWN
from fractus_core.control.state import ModeKind, TaskKind
from fractus_core.policy.compiled_grant import CompiledGrant
from fractus_core.policy.decision_types import GotoArgs, SetSpeedArgs, Verdict
from fractus_core.policy.monitoring import monitor
from fractus_runtime.audit import AuditLog

from fractus_services.errors import Aborted, AutopilotError, Refused
from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.authority.control_store import CORRECTION, ControlStore
from fractus_services.mobility.authority.leases import Motion
from fractus_services.mobility.authority.situation import fences_of
from fractus_services.mobility.authority.supervisor import Supervisor
from fractus_services.mobility.autopilot import Permit
from fractus_services.mobility.flight.courses import STOPPED, WayHome, limited_mps
from fractus_services.mobility.flight.guard import Guard
from fractus_services.mobility.flight.motions import REACHED_M, fly_to

log = logging.getLogger(__name__)

TICK_S = 0.1
"""In the air the monitor runs on every position (20 Hz), and this often when none come."""

IDLE_S = 0.5
RECORD_S = 0.5
CORRECT_AGAIN_S = 3.0
"""How long a correction may take effect before the same alarm asks for it again."""

CHANGED_S = 30.0
"""How long after its grant, or what is in force of it, changed a drone may still speed up on a leg that was judged by the grant before."""

START_S = 2.0
"""How long a drone may take to move after it was told to fly; one that keeps its place longer flies nothing."""


Permits = Callable[[Motion | None], Permit]
"""For a motion, the check that its commands must pass."""


class MotionMonitor:
    """Judges the flying drone's present state, and acts on what it finds."""

    def __init__(
        self, control: ControlStore, guard: Guard, audit: AuditLog, supervisor: Supervisor, way_home: WayHome
    ) -> None:
        self._control = control
        self._guard = guard
        self._audit = audit
        self._supervisor = supervisor
        self._way_home = way_home
        self._alarm = ""
        self._alarm_at = 0.0
        self._grant: ActiveGrant | None = None
        self._in_force: tuple[bool, ...] = ()
        self._changed_at = -math.inf

    async def run(self) -> None:
        """Watch until cancelled."""
        autopilot = self._control.autopilot
        while True:
            await autopilot.update(TICK_S / autopilot.pace if autopilot.vehicle.in_air else IDLE_S)
            self._renew_way_home()
            if autopilot.vehicle.in_air:
                self._control.dispatch(Airborne())
                try:
                    self.look()
                except Exception:
                    log.exception("monitor: failed, the drone holds its position")
                    reason = "the motion monitor failed"
                    self._control.brake(Verdict("deny", None, "InternalError", reason, (), "hover"))
            try:
                self._supervisor.tick()
            except Exception:
                # No heartbeat follows a supervisor that fails: within seconds the autopilot takes the drone home.
                log.exception("monitor: supervisor failed, the autopilot's failsafe brings the drone home")

    def _renew_way_home(self) -> None:
        """What was the last line holds only for the flight home that it ended: not for a drone that stands or flies on."""
        control, vehicle = self._control, self._control.autopilot.vehicle
        homeward = control.state.returning or (control.motion is not None and control.motion.kind == "ReturnToLaunch")
        if not vehicle.in_air or (vehicle.mode.commanded and not homeward):
            self._way_home.given_up = None

    def look(self) -> None:
        """One check."""
        control, mode = self._control, self._control.autopilot.vehicle.mode
        piloted = control.authority is Authority.PILOT
        compiled = fences_of(control) if mode.comes_down or (mode.commanded and not piloted) else None
        verdict, ours = self._judge(compiled) if compiled is not None else (None, False)
        if verdict is None or verdict.code != POSITION_UNKNOWN:
            control.dispatch(PositionFound())
        if compiled is None or verdict is None:
            self._alarm = ""
            return
        watched = not mode.commanded or (control.state.returning and control.motion is None)
        acts = not watched or self._may_take_back(verdict)
        lasting = control.autopilot.now - self._alarm_at > CORRECT_AGAIN_S
        fresh = verdict.code != self._alarm or (lasting and acts)
        if fresh:
            self._alarm, self._alarm_at = verdict.code, control.autopilot.now
            policies = ",".join(verdict.policies) or "-"
            log.warning(
                "monitor: alarm (code=%s mode=%s policies=%s reason=%s)",
                verdict.code, mode.name, policies, verdict.reason,
            )  # fmt: skip
        if watched:
            if fresh:
                self._note("takeBack" if acts else "alarm", verdict)
            if fresh and acts:
                self._take_back(verdict)
        elif verdict.code == POSITION_UNKNOWN:
            self._hover(verdict, fresh)
        elif verdict.action == "takeover" and not ours:
            control.take_over(verdict)
        elif verdict.action in {"takeover", "deny"}:
            self._stop(verdict, fresh)
        elif fresh:
            self._correct(verdict, compiled)

    def _judge(self, compiled: CompiledGrant) -> tuple[Verdict | None, bool]:
        """What is wrong, and whether the system flies the drone already, so that there is no driver to take it from."""
        control, now = self._control, self._guard.situation()
        changed, motion = self._has_changed(compiled.fences_in_force(now.time_s)), control.motion
        # What moves a drone without a motion was judged by no one: another station commands it, or a motion has just ended. One that
        # keeps its place is pushed by gusts alone, which its margin counts.
        vehicle = control.autopilot.vehicle
        changed = changed or (motion is None and not vehicle.keeps_place(control.autopilot.now))
        bound_for = motion.leg if motion is not None and motion.under_way and not motion.braking else None
        if control.state.returning or not control.autopilot.vehicle.mode.commanded:
            # The autopilot's own ways were judged by no one, whatever the grant was.
            changed = changed or not control.autopilot.vehicle.mode.commanded
            return monitor(now, compiled, system_flies=True, fences_changed=changed, current_leg=bound_for), True
        verdict = monitor(now, compiled, fences_changed=changed, current_leg=bound_for)
        alone = control.constraints is not None and verdict is not None and verdict.action == "correct"
        if verdict is None or (not alone and (verdict.takeover != "hover" or control.authority is Authority.DRIVER)):
            return verdict, False
        return monitor(now, compiled, system_flies=True, fences_changed=changed, current_leg=bound_for), True

    @property
    def _flown_grant(self) -> ActiveGrant | None:
        constraints = self._control.constraints
        return constraints.grant if constraints is not None else self._control.last_grant

    def _may_take_back(self, verdict: Verdict) -> bool:
        """Whether the system may end what the autopilot flies by itself.

        Not what a pilot chose or may have chosen before the service began, not a landing of the system or a failsafe, and not the last line behind the system's own ways.
        """
        control, mode = self._control, self._control.autopilot.vehicle.mode
        if mode.commanded or verdict.code == POSITION_UNKNOWN or self._way_home.given_up is self._flown_grant:
            return False
        if control.authority is Authority.DRIVER:
            return True
        task = control.state.task
        ours = task is not None and task.kind is TaskKind.RETURN and not task.found
        returns = ours and mode.kind is ModeKind.RETURNING
        return returns and control.authority is Authority.SYSTEM

    def _take_back(self, verdict: Verdict) -> None:
        """Stop the drone in GUIDED: its driver is told why, the system looks for a legal way home."""
        control, state = self._control, self._control.state
        control.stop_motion(verdict)

        def permit() -> None:
            now = control.state
            if now.authority is not state.authority or now.task != state.task or now.motion is not None:
                raise AutopilotError("something else flies by now")

        control.tasks.spawn(control.tasks.attempt(control.modes.hold, permit))

    def _has_changed(self, in_force: tuple[bool, ...]) -> bool:
        """Whether the drone's way may have been judged by another grant than now, or before a schedule opened or closed a zone."""
        control, grant = self._control, self._flown_grant
        autopilot, motion = control.autopilot, control.motion
        if grant is not self._grant or in_force != self._in_force:
            self._grant, self._in_force, self._changed_at = grant, in_force, autopilot.now
        begins = autopilot.now - control.state.motion_began_at < START_S
        if (motion is None or motion.kind == "Takeoff") and not begins and autopilot.vehicle.keeps_place(autopilot.now):
            # Whatever moves it from here is judged by what holds now, or later.
            self._changed_at = -math.inf
        return autopilot.now - self._changed_at < CHANGED_S

    def _stop(self, verdict: Verdict, fresh: bool) -> None:
        """End the motion that makes things worse; the system then looks for another way.

        A motion that comes to rest before it begins does what is wanted.
        """
        control = self._control
        motion = control.motion
        waits = motion is not None and motion.braking
        if not waits and (fresh or motion is not None):
            control.brake(verdict)
        else:
            control.autopilot.stop()

    def _hover(self, verdict: Verdict, fresh: bool) -> None:
        """Nothing flies on while the position is not known; who has the drone keeps it for the grace time."""
        if fresh or self._control.motion is not None:
            self._control.dispatch(PositionLost(verdict.reason))
        else:
            self._control.autopilot.stop()

    def _note(self, action: str, verdict: Verdict) -> None:
        """Write down what was found."""
        content = {"action": action, "code": verdict.code, "reason": verdict.reason, "policies": list(verdict.policies)}
        self._audit.append("monitor", content | {"mode": self._control.autopilot.vehicle.mode.name})

    def _correct(self, verdict: Verdict, compiled: CompiledGrant) -> None:
        if self._control.constraints is not None and verdict.code in STOPPED:
            self._stop(verdict, fresh=True)  # The system's flights look for another way by themselves.
            return
        self._note(verdict.action, verdict)
        self._control.tasks.spawn(self._carry_out(verdict, self._control.motion, self._permits(), compiled))

    def _permits(self) -> Permits:
        """What corrects a motion is sent only while no one else flies than at this moment."""
        control = self._control
        lease, authority = control.lease, control.authority

        def permit(motion: Motion | None) -> Permit:
            def check() -> None:
                if control.lease is not lease or control.authority is not authority or control.motion is not motion:
                    raise Aborted("Replaced", "something else flies by now")

            return check

        return permit

    async def _carry_out(
        self, verdict: Verdict, seen: Motion | None, permits: Permits, compiled: CompiledGrant
    ) -> None:
        try:
            permits(seen)()
        except Aborted:
            self._alarm = ""
            return  # Another motion has begun: the next look judges that one.
        try:
            if isinstance(verdict.args, SetSpeedArgs):
                await self._slow_down(verdict.args.speed_mps, permits(seen))
            elif isinstance(verdict.args, GotoArgs):
                await self._lead_back(verdict, verdict.args, permits, compiled)
        except (AutopilotError, Refused) as error:
            log.warning("monitor: correction failed (error=%s)", error)

    async def _slow_down(self, speed_mps: float, permit: Permit) -> None:
        """Fly the present leg slower; the next one is judged by itself."""
        motion = self._control.motion
        if motion is not None and motion.speed_mps is not None:
            speed_mps = motion.speed_mps = min(speed_mps, motion.speed_mps)
        await self._control.autopilot.set_speed(speed_mps, permit)

    async def _lead_back(self, verdict: Verdict, place: GotoArgs, permits: Permits, compiled: CompiledGrant) -> None:
        """Fly to where the limits hold, as a motion that follows the one that left them."""
        control = self._control
        control.stop_motion(verdict)
        motion = control.begin_motion(CORRECTION)
        speed = limited_mps(control.cruise_mps, place, self._guard.situation(), compiled)
        leg = replace(place, speed_mps=speed)
        try:
            async for _ in fly_to(control.autopilot, motion, leg, REACHED_M, permits(motion)):
                pass
        except Exception:
            control.fail_motion(motion)
            raise
        control.finish_motion(motion)

    async def record(self) -> None:
        """The flight recorder, until cancelled."""
        while True:
            await asyncio.sleep(RECORD_S)
            if self._control.autopilot.vehicle.armed:
                self._audit.append("state", recorded(self._control), now=False)


def recorded(control: ControlStore) -> dict[str, Any]:
    """One entry of the flight recorder."""
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

"""The continuous monitor and the flight recorder: what runs while the drone is armed."""

from __future__ import annotations

import asyncio
import logging
import math
from dataclasses import replace
from typing import Any

from fractus_core.control import Authority
from fractus_core.control.events import Airborne
from fractus_core.policy.compiled import CompiledGrant
from fractus_core.policy.monitoring import monitor
from fractus_core.policy.values import GotoArgs, SetSpeedArgs, Verdict

from fractus_services.audit import AuditLog
from fractus_services.errors import Aborted, AutopilotError, Refused
from fractus_services.grants import ActiveGrant
from fractus_services.mobility.authority.control import CORRECTION, Control
from fractus_services.mobility.authority.leases import Motion
from fractus_services.mobility.authority.supervisor import Supervisor
from fractus_services.mobility.autopilot import Permit
from fractus_services.mobility.flight.courses import limited_mps
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
"""How long after its grant changed a drone may still speed up on a leg that was judged by the grant before."""

START_S = 2.0
"""How long a drone may take to move after it was told to fly; one that keeps its place longer flies nothing."""


class MotionMonitor:
    """Judges the flying drone's present state, and acts on what it finds."""

    def __init__(self, control: Control, guard: Guard, audit: AuditLog, supervisor: Supervisor) -> None:
        self._control = control
        self._guard = guard
        self._audit = audit
        self._supervisor = supervisor
        self._alarm = ""
        self._alarm_at = 0.0
        self._grant: ActiveGrant | None = None
        self._changed_at = -math.inf
        self._corrections: set[asyncio.Task[None]] = set()

    async def run(self) -> None:
        """Watch until cancelled."""
        autopilot = self._control.autopilot
        while True:
            await autopilot.update(TICK_S if autopilot.vehicle.in_air else IDLE_S)
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

    def look(self) -> None:
        """One check."""
        control, grant = self._control, self._control.mission_grant
        source = control.constraints or grant
        compiled = source.compiled if source is not None else None
        coming = control.state.returning and control.constraints is None
        piloted = control.authority is Authority.PILOT
        if compiled is None or piloted or coming or not control.autopilot.vehicle.mode.commanded:
            self._alarm = ""
            return
        verdict, ours = self._judge(compiled)
        if verdict is None:
            self._alarm = ""
            return
        fresh = verdict.code != self._alarm or control.autopilot.now - self._alarm_at > CORRECT_AGAIN_S
        if fresh:
            self._alarm, self._alarm_at = verdict.code, control.autopilot.now
            log.warning("monitor: alarm (code=%s, reason=%s)", verdict.code, verdict.reason)
        if verdict.action == "takeover" and not ours:
            control.take_over(verdict)
        elif verdict.action in {"takeover", "deny"}:
            self._stop(verdict, fresh)
        elif fresh:
            self._correct(verdict, compiled)

    def _judge(self, compiled: CompiledGrant) -> tuple[Verdict | None, bool]:
        """What is wrong, and whether the system flies the drone already, so that there is no driver to take it from."""
        control, now = self._control, self._guard.situation()
        changed = self._has_changed(
            control.constraints.grant if control.constraints is not None else control.mission_grant
        )
        if control.state.returning:
            return monitor(now, compiled, leaving=True, changed=changed), True
        verdict = monitor(now, compiled, changed=changed)
        if verdict is None or verdict.takeover != "hover" or control.authority is Authority.DRIVER:
            return verdict, False
        return monitor(now, compiled, leaving=True, changed=changed), True

    def _has_changed(self, grant: ActiveGrant | None) -> bool:
        """Whether the drone's way may have been judged by another grant than this."""
        control = self._control
        autopilot, motion = control.autopilot, control.motion
        if grant is not self._grant:
            self._grant, self._changed_at = grant, autopilot.now
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
        waits = motion is not None and motion.braking and verdict.code != "PositionUnknown"
        if not waits and (fresh or motion is not None):
            control.brake(verdict)
        else:
            control.autopilot.stop()

    def _correct(self, verdict: Verdict, compiled: CompiledGrant) -> None:
        self._audit.append(
            "monitor", {"action": verdict.action, "code": verdict.code, "reason": verdict.reason, "policies": list(verdict.policies)}
        )  # fmt: skip
        task = asyncio.get_running_loop().create_task(self._carry_out(verdict, self._control.motion, compiled))
        self._corrections.add(task)
        task.add_done_callback(self._corrections.discard)

    async def _carry_out(self, verdict: Verdict, seen: Motion | None, compiled: CompiledGrant) -> None:
        if self._control.motion is not seen:
            self._alarm = ""
            return  # Another motion has begun: the next look judges that one.
        try:
            if isinstance(verdict.args, SetSpeedArgs):
                await self._slow_down(verdict.args.speed_mps)
            elif isinstance(verdict.args, GotoArgs):
                await self._lead_back(verdict, verdict.args, compiled)
        except (AutopilotError, Refused) as error:
            log.warning("monitor: correction failed (error=%s)", error)

    def _permit(self, motion: Motion | None) -> Permit:
        """What corrects a motion is sent only while no one else flies."""
        control = self._control
        lease, authority = control.lease, control.authority

        def check() -> None:
            if control.lease is not lease or control.authority is not authority or control.motion is not motion:
                raise Aborted("Replaced", "something else flies by now")

        return check

    async def _slow_down(self, speed_mps: float) -> None:
        """Fly the present leg slower; the next one is judged by itself."""
        motion = self._control.motion
        if motion is not None and motion.speed_mps is not None:
            speed_mps = motion.speed_mps = min(speed_mps, motion.speed_mps)
        await self._control.autopilot.set_speed(speed_mps, self._permit(motion))

    async def _lead_back(self, verdict: Verdict, place: GotoArgs, compiled: CompiledGrant) -> None:
        """Fly to where the limits hold, as a motion that follows the one that left them."""
        control = self._control
        control.stop_motion(verdict)
        motion = control.begin(CORRECTION)
        speed = limited_mps(control.cruise_mps, place, self._guard.situation(), compiled)
        leg = replace(place, speed_mps=speed)
        try:
            async for _ in fly_to(control.autopilot, motion, leg, REACHED_M, self._permit(motion)):
                pass
        except Exception:
            control.failed(motion)
            raise
        control.finish(motion)

    async def record(self) -> None:
        """The flight recorder, until cancelled."""
        while True:
            await asyncio.sleep(RECORD_S)
            if self._control.autopilot.vehicle.armed:
                self._audit.append("state", recorded(self._control), now=False)


def recorded(control: Control) -> dict[str, Any]:
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

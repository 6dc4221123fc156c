"""The continuous monitor and the flight recorder: what runs while the drone is armed."""

from __future__ import annotations

import asyncio
import logging

from fractus_core.policy.monitoring import monitor
from fractus_core.policy.values import GotoArgs, SetSpeedArgs, Verdict

from fractus_services.audit import AuditLog
from fractus_services.mobility.autopilot import AutopilotError
from fractus_services.mobility.control import Control
from fractus_services.mobility.guard import Guard
from fractus_services.mobility.supervisor import Supervisor
from fractus_services.mobility.telemetry import recorded
from fractus_services.mobility.vehicle import GUIDED
from fractus_services.replies import Refused, aborted

log = logging.getLogger(__name__)

TICK_S = 0.1
"""In the air the monitor runs on every position (20 Hz), and this often when none come."""

IDLE_S = 0.5
RECORD_S = 0.5
CORRECT_AGAIN_S = 3.0


class Watch:
    """Judges the flying drone's present state, and acts on what it finds."""

    def __init__(self, control: Control, guard: Guard, audit: AuditLog, supervisor: Supervisor) -> None:
        self._control = control
        self._guard = guard
        self._audit = audit
        self._supervisor = supervisor
        self._alarm = ""
        self._alarm_at = 0.0
        self._corrections: set[asyncio.Task[None]] = set()

    async def run(self) -> None:
        """Watch until cancelled."""
        autopilot = self._control.autopilot
        while True:
            await autopilot.update(TICK_S if autopilot.vehicle.in_air else IDLE_S)
            if autopilot.vehicle.in_air:
                self._control.in_air()
                try:
                    self.look()
                except Exception:
                    log.exception("the motion monitor failed; the drone holds its position")
                    self._control.brake(
                        Verdict("deny", None, "InternalError", "the motion monitor failed", (), "hover")
                    )
            try:
                self._supervisor.tick()
            except Exception:
                log.exception("the supervisor failed; the autopilot's own failsafe brings the drone home")

    def look(self) -> None:
        """One check."""
        control, held = self._control, self._control.mission_grant
        grant = control.regime.grant if control.regime is not None else held.compiled if held is not None else None
        coming = control.homeward and control.regime is None
        if grant is None or control.hands == "pilot" or coming or control.autopilot.vehicle.mode != GUIDED:
            self._alarm = ""
            return
        verdict = monitor(self._guard.situation(), grant)
        if verdict is None:
            self._alarm = ""
            return
        fresh = verdict.code != self._alarm or control.autopilot.now - self._alarm_at > CORRECT_AGAIN_S
        if fresh:
            self._alarm, self._alarm_at = verdict.code, control.autopilot.now
            log.warning("%s: %s", verdict.code, verdict.reason)
        ours = control.homeward or (control.hands != "driver" and verdict.takeover == "hover")
        if verdict.action == "takeover" and not ours:
            control.take_over(verdict)
        elif verdict.action in {"takeover", "deny"}:
            self._stop(verdict, fresh)
        elif fresh:
            self._correct(verdict)

    def _stop(self, verdict: Verdict, fresh: bool) -> None:
        """End the motion that makes things worse; the system then looks for another way.

        Where it flies itself and is in a zone already, its way leads out.
        """
        if verdict.action == "takeover" and verdict.code != "ExclusionZoneAhead":
            return
        if fresh:
            self._control.brake(verdict)
        else:
            self._control.autopilot.stop()

    def _correct(self, verdict: Verdict) -> None:
        self._audit.append(
            "monitor", {"action": verdict.action, "code": verdict.code, "reason": verdict.reason, "policies": list(verdict.policies)}
        )  # fmt: skip
        task = asyncio.get_running_loop().create_task(self._carry_out(verdict))
        self._corrections.add(task)
        task.add_done_callback(self._corrections.discard)

    async def _carry_out(self, verdict: Verdict) -> None:
        control = self._control
        motion, lease, hands = control.motion, control.lease, control.hands

        def permit() -> None:
            if control.lease is not lease or control.hands != hands or control.motion not in {motion, None}:
                raise aborted("Replaced", "something else flies by now")

        try:
            if isinstance(verdict.args, SetSpeedArgs):
                control.speed_mps = verdict.args.speed_mps
                await control.autopilot.set_speed(verdict.args.speed_mps, permit)
            elif isinstance(verdict.args, GotoArgs) and verdict.args.alt is not None:
                if control.motion is not None:
                    control.motion.stop(aborted(verdict.code, verdict.reason, verdict.policies))
                await control.autopilot.go_to(verdict.args.lat, verdict.args.lon, verdict.args.alt, None, permit)
        except (AutopilotError, Refused) as error:
            log.warning("cannot correct the motion: %s", error)

    async def record(self) -> None:
        """The flight recorder, until cancelled."""
        while True:
            await asyncio.sleep(RECORD_S)
            if self._control.autopilot.vehicle.armed:
                self._audit.append("state", recorded(self._control), now=False)

"""The mobility service: each call is judged, then carried out by whoever may."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import aclosing
from dataclasses import dataclass

from fractus_core.policy.values import Call, GotoArgs, SetSpeedArgs, TakeoffArgs, Verdict

from fractus_services.grants import Held
from fractus_services.mobility.arming import arm
from fractus_services.mobility.autopilot import Autopilot
from fractus_services.mobility.control import Control
from fractus_services.mobility.guard import Guard
from fractus_services.mobility.leases import Motion
from fractus_services.mobility.motions import REACHED_M, Step, climb, come_down, fly_to
from fractus_services.mobility.permits import driver_permit
from fractus_services.mobility.vehicle import GUIDED, LAND, RTL
from fractus_services.replies import precondition, refused

MAX_REACHED_M = 50.0
JUDGE_AGAIN_S = 0.05
"""A goto whose command waited for longer is judged again, at the place where the drone is by then."""


@dataclass(frozen=True, slots=True)
class Progress:
    """A motion under way: the verdict on it, and where it is."""

    verdict: Verdict
    step: Step


class MobilityService:
    """Table 8.2 of the thesis, for callers whose grant is known."""

    def __init__(self, control: Control, guard: Guard) -> None:
        self._control = control
        self._guard = guard
        self._autopilot: Autopilot = control.autopilot

    def allow(self, call: Call, held: Held) -> Verdict:
        """Judge a call that moves nothing.

        Raises:
            Refused: by policy.
        """
        verdict = self._guard.judge(call, held)
        if not verdict.permits:
            raise refused(verdict)
        return verdict

    def _allow_motion(self, call: Call, held: Held) -> Verdict:
        """Judge a call that moves the drone, of a driver that has it; a takeover happens here."""
        if held.spec.class_ != "driver":
            verdict = Verdict("deny", None, "NotADriver", f"passengers ride along; only a driver may {call.method}")
            self._guard.record(call, held.identity, verdict, self._guard.situation())
            raise refused(verdict)
        verdict = self._guard.judge(call, held)
        if verdict.code == "MethodNotGranted":
            raise refused(verdict)
        self._control.require(held)
        if verdict.action == "takeover":
            self._control.take_over(verdict)
            raise refused(verdict)
        if not verdict.permits:
            if verdict.takeover is not None:
                self._control.brake(verdict)
            raise refused(verdict)
        return verdict

    async def arm(self, held: Held) -> Verdict:
        """Start the motors."""
        verdict = self._allow_motion(Call("Arm"), held)
        if not self._autopilot.vehicle.armed:
            await arm(self._control, held, driver_permit(self._control, held))
        return verdict

    async def disarm(self, held: Held) -> Verdict:
        """Stop the motors on the ground."""
        verdict = self._allow_motion(Call("Disarm"), held)
        await self._autopilot.disarm(driver_permit(self._control, held))
        return verdict

    async def hover(self, held: Held) -> Verdict:
        """Stop and stay."""
        verdict = self._allow_motion(Call("Hover"), held)
        self._flying("Hover")
        self._control.finish(self._control.begin("Hover"))
        await self._control.hold(driver_permit(self._control, held))
        return verdict

    async def set_speed(self, held: Held, args: SetSpeedArgs) -> tuple[Verdict, float]:
        """Change the speed of legs."""
        verdict = self._allow_motion(Call("SetSpeed", args), held)
        speed = verdict.args.speed_mps if isinstance(verdict.args, SetSpeedArgs) else args.speed_mps
        self._control.speed_mps = speed
        await self._autopilot.set_speed(speed, driver_permit(self._control, held))
        return verdict, speed

    def take_off(self, held: Held, args: TakeoffArgs) -> AsyncIterator[Progress]:
        """Climb from the ground."""
        verdict = self._allow_motion(Call("Takeoff", args), held)
        if not self._autopilot.vehicle.armed:
            raise precondition("NotArmed", "the motors are off; arm first")
        if self._autopilot.vehicle.in_air and not self._autopilot.vehicle.standing:
            raise precondition("AlreadyFlying", "the drone is in the air; use goto to climb")
        altitude = verdict.args.altitude_m if isinstance(verdict.args, TakeoffArgs) else args.altitude_m

        async def steps(motion: Motion) -> AsyncIterator[Progress]:
            permit = driver_permit(self._control, held, motion)
            await self._control.helm.change_mode(GUIDED, permit)
            async for step in climb(self._autopilot, motion, altitude, permit):
                yield Progress(verdict, step)

        return self._run("Takeoff", steps)

    def goto(self, held: Held, args: GotoArgs, reached_m: float) -> AsyncIterator[Progress]:
        """Fly straight to a point."""
        verdict = self._allow_motion(Call("Goto", args), held)
        self._flying("Goto")
        target = verdict.args if isinstance(verdict.args, GotoArgs) else args
        radius = min(max(reached_m, 0.3), MAX_REACHED_M) if reached_m > 0 else REACHED_M

        async def steps(motion: Motion) -> AsyncIterator[Progress]:
            permit, final, goal = driver_permit(self._control, held, motion), verdict, target
            begun = self._autopilot.now
            await self._control.helm.change_mode(GUIDED, permit)
            speed = goal.speed_mps or self._control.speed_mps
            if speed is not None:
                await self._autopilot.set_speed(speed, permit)
            if self._autopilot.now - begun > JUDGE_AGAIN_S:
                permit()
                lease = self._control.require(held)
                final = self._allow_motion(Call("Goto", args), lease.held)
                goal = final.args if isinstance(final.args, GotoArgs) else args
            async for step in fly_to(self._autopilot, motion, goal, radius, permit):
                if step.complete:
                    self._control.reached(held, args.lat, args.lon)
                yield Progress(final, step)

        return self._run("Goto", steps)

    def land(self, held: Held) -> AsyncIterator[Progress]:
        """Come down here."""
        return self._descend("Land", LAND, held)

    def return_to_launch(self, held: Held) -> AsyncIterator[Progress]:
        """Fly home and land."""
        return self._descend("ReturnToLaunch", RTL, held)

    def _descend(self, method: str, mode: int, held: Held) -> AsyncIterator[Progress]:
        verdict = self._allow_motion(Call(method), held)
        self._flying(method)

        async def steps(motion: Motion) -> AsyncIterator[Progress]:
            await self._control.helm.change_mode(mode, driver_permit(self._control, held, motion))
            async for step in come_down(self._autopilot, motion):
                yield Progress(verdict, step)

        return self._run(method, steps)

    def _flying(self, method: str) -> None:
        if not self._autopilot.vehicle.in_air:
            raise precondition("NotFlying", f"{method} needs a drone in the air; take off first")

    async def _run(self, kind: str, steps: Callable[[Motion], AsyncIterator[Progress]]) -> AsyncIterator[Progress]:
        motion = self._control.begin(kind)
        try:
            async with aclosing(steps(motion)) as running:  # type: ignore[type-var]
                async for progress in running:
                    yield progress
        except (asyncio.CancelledError, GeneratorExit):
            self._control.cancelled(motion)
            raise
        except Exception:
            self._control.failed(motion)
            raise
        self._control.finish(motion)

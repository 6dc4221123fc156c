"""The mobility service: each call is judged, then carried out if its caller has the drone."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing
from dataclasses import dataclass, replace
from functools import partial

from fractus_core.policy.decision_types import Call, GotoArgs, SetSpeedArgs, TakeoffArgs, VelocityArgs, Verdict

from fractus_services.errors import Aborted, PreconditionFailed, Refused
from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.authority.arming import Arming
from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.authority.leases import Motion
from fractus_services.mobility.autopilot import Autopilot, Permit
from fractus_services.mobility.flight.calls import CallJudge
from fractus_services.mobility.flight.courses import Replans, Trip, WayHome
from fractus_services.mobility.flight.motions import (
    REACHED_M,
    Step,
    climb,
    come_down,
    come_to_rest,
    fly_to,
    rise,
)
from fractus_services.mobility.flight.steering import Steering

MAX_REACHED_M = 50.0
JUDGE_AGAIN_S = 0.05
"""A leg whose command waited for longer is judged again, from where the drone is by then: at 15 m/s that is 0.75 m."""

MAX_JUDGEMENTS = 6
"""How many times a call is judged before it is given up: a drone that does not come to rest cannot begin its leg."""


@dataclass(frozen=True, slots=True)
class Progress:
    """A motion under way: the verdict on it, and how far it is."""

    verdict: Verdict
    step: Step


class _Outdated(Aborted):
    """The leg that was judged is not legal any more, or another one is; carries the verdict that holds now."""

    def __init__(self, verdict: Verdict) -> None:
        super().__init__(
            "NotFollowing", "what is permitted has changed since the autopilot was first told where to fly"
        )
        self.verdict = verdict


class MobilityService:
    """Table 8.2 of the thesis, for callers whose grant is known.

    Args:
        control: who has the drone.
        arming: starts the motors.
        calls: gives calls their turn, before they come here, and judges them.
        way_home: flies home.
    """

    def __init__(
        self,
        control: ControlStore,
        arming: Arming,
        calls: CallJudge,
        way_home: WayHome,
    ) -> None:
        self.calls = calls
        self._control = control
        self._arming = arming
        self._way_home = way_home
        self._steering = Steering(control)
        self._autopilot: Autopilot = control.autopilot

    async def arm(self, grant: ActiveGrant, patience_s: float = 0.0) -> Verdict:
        """Start the motors; what may pass, as that the autopilot is not ready yet, is tried again for so long."""
        permit, call = self._control.driver_permit(grant), Call("Arm")
        async for _ in self._arming.arm(grant, permit, lambda: self.calls.allow_motion(call, grant), patience_s):
            pass
        return Verdict("allow")

    async def disarm(self, grant: ActiveGrant) -> Verdict:
        """Stop the motors on the ground."""
        self.calls.supersede(grant)
        verdict = self.calls.allow_motion(Call("Disarm"), grant)
        await self._autopilot.disarm(self._control.driver_permit(grant))
        return verdict

    async def hover(self, grant: ActiveGrant) -> Verdict:
        """Stop and stay."""
        self.calls.supersede(grant)
        verdict = self.calls.allow_motion(Call("Hover"), grant)
        _require_air(self._autopilot, "Hover")
        self._control.finish_motion(self._control.begin_motion("Hover"))
        await self._control.effects.hover(self._control.driver_permit(grant))
        return verdict

    async def set_speed(self, grant: ActiveGrant, args: SetSpeedArgs) -> tuple[Verdict, float]:
        """Change the speed of legs."""
        verdict = self.calls.allow_motion(Call("SetSpeed", args), grant)
        wanted = verdict.args.speed_mps if isinstance(verdict.args, SetSpeedArgs) else args.speed_mps
        verdict, speed = self._on_leg(grant, verdict, wanted)
        self._control.set_cruise_speed(wanted, speed)
        await self._autopilot.set_speed(speed, self._control.driver_permit(grant))
        return verdict, speed

    def _on_leg(self, grant: ActiveGrant, verdict: Verdict, wanted: float) -> tuple[Verdict, float]:
        """A change of speed as the rest of the leg under way allows it; a leg that is not legal faster gets no faster."""
        motion = self._control.motion
        if motion is None or motion.leg is None or motion.speed_mps is None or wanted <= motion.speed_mps:
            return verdict, wanted
        # The leg was judged with its speed: a faster drone needs a wider margin to every border along the rest of it.
        leg, speed = replace(motion.leg, speed_mps=wanted), motion.speed_mps
        rest = self.calls.check(Call("Goto", leg), grant)
        if rest.permits and not rest.brake_first and isinstance(rest.args, GotoArgs):
            legal_mps = rest.args.speed_mps or wanted
            speed = min(legal_mps, wanted) if replace(rest.args, speed_mps=wanted) == leg else speed
        if speed >= wanted:
            return verdict, wanted
        reason = f"the leg under way is flown with {speed:.1f} m/s: {rest.reason or 'it is not legal faster'}"
        return Verdict("correct", SetSpeedArgs(speed), rest.code or "SpeedAboveLimit", reason, rest.policies), speed

    def take_off(self, grant: ActiveGrant, args: TakeoffArgs) -> AsyncGenerator[Progress, None]:
        """Climb from the ground; in the air, climb to that altitude, or be done above it: a takeoff may be sent again."""
        call = Call("Takeoff", args)
        self._standing_by(call, grant)
        verdict = self.calls.allow_motion(call, grant)

        async def steps(motion: Motion) -> AsyncGenerator[Progress, None]:
            permit, final, vehicle = self._control.driver_permit(grant, motion), verdict, self._autopilot.vehicle
            await self._control.modes.enter_guided(permit)
            climbs: Callable[[Autopilot, Motion, float, Permit], AsyncGenerator[Step, None]] = climb
            if vehicle.in_air and not vehicle.standing:
                await come_to_rest(self._autopilot, motion, permit)
                final = self.calls.allow_motion(call, self._control.require_control(grant).grant, verdict)
                climbs = partial(rise, self._control.cruise_mps, judged=self._judged(call, grant, final, permit))
            altitude_m = final.args.altitude_m if isinstance(final.args, TakeoffArgs) else args.altitude_m
            async with aclosing(climbs(self._autopilot, motion, altitude_m, permit)) as climbing:
                async for step in climbing:
                    yield Progress(final, step)

        return self._run("Takeoff", grant, steps)

    def goto(self, grant: ActiveGrant, args: GotoArgs, reached_m: float) -> AsyncGenerator[Progress, None]:
        """Fly straight to a point."""
        verdict = self.calls.allow_motion(Call("Goto", args), grant)
        _require_air(self._autopilot, "Goto")
        radius = min(max(reached_m, 0.3), MAX_REACHED_M) if reached_m > 0 else REACHED_M

        async def steps(motion: Motion) -> AsyncGenerator[Progress, None]:
            permit = self._control.driver_permit(grant, motion)
            call, final = Call("Goto", args), verdict
            for _ in range(MAX_JUDGEMENTS):
                final = await self._settled(call, grant, final, motion, permit)
                leg, judged = _leg(final, args, self._control.cruise_mps), self._judged(call, grant, final, permit)
                try:
                    async with aclosing(fly_to(self._autopilot, motion, leg, radius, permit, judged=judged)) as flying:
                        async for step in flying:
                            if step.complete:
                                self._control.count_leg(grant, args.lat, args.lon)
                            yield Progress(final, step)
                except _Outdated as outdated:
                    final = outdated.verdict
                else:
                    return
            raise Aborted("NotFollowing", f"the autopilot was told {MAX_JUDGEMENTS} times where to fly, and does not")

        return self._run("Goto", grant, steps)

    def _judged(self, call: Call, grant: ActiveGrant, verdict: Verdict, permit: Permit) -> Permit:
        """A permit that judges the leg again when its command is sent late, from where the drone is by then."""
        judged_at = self._autopilot.now

        def check() -> None:
            nonlocal judged_at
            permit()
            if self._autopilot.now - judged_at <= JUDGE_AGAIN_S / self._autopilot.pace:
                return
            judged_at = self._autopilot.now
            again = self.calls.allow_motion(call, self._control.require_control(grant).grant, verdict)
            if again.brake_first or again.args != verdict.args:
                raise _Outdated(again)

        return check

    async def _settled(
        self, call: Call, grant: ActiveGrant, verdict: Verdict, motion: Motion, permit: Permit
    ) -> Verdict:
        """The verdict to carry out, once the drone is ready for it: in GUIDED, and at rest where the verdict asks for that.

        Changing the mode and braking take time in which the drone moves, so the call is judged again after them.

        Raises:
            Refused: the call is not legal from there, or the drone does not come to rest.
        """
        for _ in range(MAX_JUDGEMENTS):
            begun = self._autopilot.now
            await self._control.modes.enter_guided(permit)
            if verdict.brake_first:
                await come_to_rest(self._autopilot, motion, permit)
            elif self._autopilot.now - begun <= JUDGE_AGAIN_S / self._autopilot.pace:
                return verdict
            permit()
            verdict = self.calls.allow_motion(call, self._control.require_control(grant).grant, verdict)
        raise Aborted("NotStopping", "the drone does not come to rest, and could not begin its leg otherwise")

    async def set_velocity(self, grant: ActiveGrant, args: VelocityArgs) -> tuple[Verdict, VelocityArgs]:
        """Fly with a velocity until the next one, or until its hold is over."""
        verdict = self.calls.allow_motion(Call("SetVelocity", args), grant)
        _require_air(self._autopilot, "SetVelocity")
        motion = self._control.begin_motion("SetVelocity")
        permit = self._control.driver_permit(grant, motion)
        try:
            final = await self._settled(Call("SetVelocity", args), grant, verdict, motion, permit)
            setpoint = final.args if isinstance(final.args, VelocityArgs) else args
            self._steering.steer(setpoint, motion, permit)
            self._control.count_velocity_flight(grant)
        except BaseException:  # a caller that hangs up while the drone brakes leaves it hovering, too
            self._control.fail_motion(motion)
            raise
        return final, setpoint

    def land(self, grant: ActiveGrant) -> AsyncGenerator[Progress, None]:
        """Come down here."""
        self.calls.supersede(grant)
        verdict = self.calls.allow_motion(Call("Land"), grant)
        _require_air(self._autopilot, "Land")

        async def steps(motion: Motion) -> AsyncGenerator[Progress, None]:
            await self._control.modes.change_mode(
                self._control.autopilot.stack.land, self._control.driver_permit(grant, motion)
            )
            async for step in come_down(self._autopilot, motion):
                yield Progress(verdict, step)

        return self._run("Land", grant, steps)

    def return_to_launch(self, grant: ActiveGrant) -> AsyncGenerator[Progress, None]:
        """Fly home on a legal way, and land; a way that becomes illegal under the flying drone is replaced by another."""
        self.calls.supersede(grant)
        verdict = self.calls.allow_motion(Call("ReturnToLaunch"), grant)
        _require_air(self._autopilot, "ReturnToLaunch")
        return self._return(grant, verdict)

    async def _return(self, grant: ActiveGrant, verdict: Verdict) -> AsyncGenerator[Progress, None]:
        control = self._control
        constraints = control.begin_system_flight(control.require_control(grant).grant)
        trip = Trip(constraints, "ReturnToLaunch", lambda motion: control.driver_permit(grant, motion))
        replans, goes_on = Replans(constraints), True
        try:
            while goes_on:
                goes_on = False
                attempt = self._run(trip.kind, grant, lambda motion: self._homeward(trip, motion, verdict))
                try:
                    async with aclosing(attempt) as running:
                        async for progress in running:
                            yield progress
                except Refused as refusal:
                    if not (goes_on := replans.allow(refusal)):
                        raise
        finally:
            control.end_system_flight(constraints)

    async def _homeward(self, trip: Trip, motion: Motion, verdict: Verdict) -> AsyncGenerator[Progress, None]:
        """One attempt to come home."""
        permit, modes = trip.permit(motion), self._control.modes
        await modes.enter_guided(permit)
        async with aclosing(self._way_home.attempt(trip, motion)) as steps:
            async for step in steps:
                yield Progress(verdict, step)
        await modes.change_mode(self._way_home.descent(trip.constraints.grant), permit)
        async for step in come_down(self._autopilot, motion):
            yield Progress(verdict, step)

    def _standing_by(self, call: Call, grant: ActiveGrant) -> None:
        """Refuse a takeoff that cannot be carried out before its costly judgement.

        Methods that are not granted are left to the judgement: it writes their refusal to the audit log.
        """
        if grant.spec.class_ != "driver" or call.method not in grant.compiled.methods:
            return
        self._control.require_control(grant)
        if not self._autopilot.vehicle.armed:
            raise PreconditionFailed("NotArmed", "the motors are off; arm first")

    async def _run(
        self, kind: str, grant: ActiveGrant, steps: Callable[[Motion], AsyncGenerator[Progress, None]]
    ) -> AsyncGenerator[Progress, None]:
        motion = self._control.begin_motion(kind, lambda motion: self._control.driver_permit(grant, motion))
        try:
            async with aclosing(steps(motion)) as running:
                async for progress in running:
                    yield progress
        except (asyncio.CancelledError, GeneratorExit):
            self._control.cancel_motion(motion)
            raise
        except Exception:
            self._control.fail_motion(motion)
            raise
        self._control.finish_motion(motion)


def _leg(verdict: Verdict, args: GotoArgs, cruise_mps: float) -> GotoArgs:
    """What is flown of a goto, with its speed."""
    goal = verdict.args if isinstance(verdict.args, GotoArgs) else args
    return replace(goal, speed_mps=goal.speed_mps or cruise_mps)


def _require_air(autopilot: Autopilot, method: str) -> None:
    if not autopilot.vehicle.in_air:
        raise PreconditionFailed("NotFlying", f"{method} needs a drone in the air; take off first")

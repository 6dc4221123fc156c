"""Methods of the mobility service: each call is authorized, then carried out if its caller has control."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing
from dataclasses import dataclass, replace
from functools import partial

from fractus_core.policy.decision_types import (
    Call,
    GotoArgs,
    PointGimbalArgs,
    SetSpeedArgs,
    TakeoffArgs,
    VelocityArgs,
    Verdict,
)

from fractus_services.errors import Aborted, AutopilotError, PreconditionFailed, Refused
from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.authority.arming import Arming
from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.authority.effects import Motion
from fractus_services.mobility.autopilot import Autopilot, Permit
from fractus_services.mobility.flight.authorization import CallAuthorizer
from fractus_services.mobility.flight.motions import Step, VelocityHold, climb, come_down, come_to_rest, fly_to, rise
from fractus_services.mobility.flight.return_to_launch import ReturnFlight
from fractus_services.mobility.flight.route_following import ReplanBudget, SystemFlight
from fractus_services.mobility.settings import SETTINGS


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of a motion, with the verdict on the motion."""

    verdict: Verdict
    step: Step


class _Outdated(Aborted):
    """The verdict on a leg changed before its command was acknowledged. `verdict` is the new verdict."""

    def __init__(self, verdict: Verdict) -> None:
        super().__init__("NotFollowing", "the verdict on the leg changed before the autopilot acknowledged the command")
        self.verdict = verdict


class MobilityService:
    """Carries out the methods of the mobility API for callers whose grant is known.

    Args:
        control: Control state.
        arming: Starts the motors.
        calls: Authorizes calls. The gRPC handlers throttle calls with it before they reach this class.
        return_flight: Flies home.
    """

    def __init__(
        self,
        control: ControlStore,
        arming: Arming,
        calls: CallAuthorizer,
        return_flight: ReturnFlight,
    ) -> None:
        self.calls = calls
        self._control = control
        self._arming = arming
        self._return_flight = return_flight
        self._velocity_hold = VelocityHold(control)
        self._autopilot: Autopilot = control.autopilot

    async def arm(self, grant: ActiveGrant, patience_s: float = 0.0) -> Verdict:
        """Arm. Retry transient failures, such as an autopilot that is not ready yet, for `patience_s` seconds."""
        permit = self._control.driver_permit(grant)

        def judge() -> None:
            self.calls.allow_motion(Call("Arm"), self._control.latest(grant))

        async for _ in self._arming.arm(grant, permit, judge, patience_s):
            pass
        return Verdict("allow")

    async def disarm(self, grant: ActiveGrant) -> Verdict:
        """Disarm on the ground."""
        self.calls.cancel_pending(grant)
        verdict = self.calls.allow_motion(Call("Disarm"), grant)
        await self._autopilot.disarm(self._control.driver_permit(grant))
        return verdict

    async def hover(self, grant: ActiveGrant) -> Verdict:
        """Stop and hover."""
        self.calls.cancel_pending(grant)
        verdict = self.calls.allow_motion(Call("Hover"), grant)
        _require_in_air(self._autopilot)
        self._control.finish_motion(self._control.begin_motion("Hover"))
        await self._control.effects.hover(self._control.driver_permit(grant))
        return verdict

    async def set_speed(self, grant: ActiveGrant, args: SetSpeedArgs) -> tuple[Verdict, float]:
        """Set the speed of legs. Return the verdict and the speed of the current leg."""
        verdict = self.calls.allow_motion(Call("SetSpeed", args), grant)
        requested_mps = verdict.args.speed_mps if isinstance(verdict.args, SetSpeedArgs) else args.speed_mps
        verdict, speed = self._limit_to_leg(grant, verdict, requested_mps)
        self._control.set_cruise_speed(requested_mps, speed)
        try:
            await self._autopilot.set_speed(speed, self._control.driver_permit(grant))
        except AutopilotError as error:
            # On the ground, most modes reject a speed. Each leg sets its own speed.
            if not error.refused or self._autopilot.vehicle.in_air:
                raise
        return verdict, speed

    def _limit_to_leg(self, grant: ActiveGrant, verdict: Verdict, requested_mps: float) -> tuple[Verdict, float]:
        """Limit a new speed to the speed that is legal on the rest of the current leg. If no higher speed is legal, the leg keeps its speed."""
        motion = self._control.motion
        if motion is None or motion.leg is None or motion.speed_mps is None or requested_mps <= motion.speed_mps:
            return verdict, requested_mps
        # The leg was judged at its speed. A faster drone needs a wider margin to every border along the rest of the leg.
        leg = replace(motion.leg, speed_mps=requested_mps)
        speed = motion.speed_mps
        rest = self.calls.check(Call("Goto", leg), grant)
        if rest.permits and not rest.brake_first and isinstance(rest.args, GotoArgs):
            legal_mps = rest.args.speed_mps or requested_mps
            speed = min(legal_mps, requested_mps) if replace(rest.args, speed_mps=requested_mps) == leg else speed
        if speed >= requested_mps:
            return verdict, requested_mps
        if rest.action == "allow" and not rest.brake_first and speed > motion.speed_mps:
            return replace(verdict, args=SetSpeedArgs(speed)), speed  # Within the overshoot of a limit along the leg.
        reason = f"the current leg is flown with {speed:.1f} m/s: {rest.reason or 'a higher speed is not legal'}"
        return Verdict("correct", SetSpeedArgs(speed), rest.code or "SpeedAboveLimit", reason, rest.policies), speed

    async def point_gimbal(self, grant: ActiveGrant, args: PointGimbalArgs, *, fixed_camera: bool) -> Verdict:
        """Turn the camera, on the ground or in the air. The current motion continues.

        Args:
            grant: Grant of the caller.
            args: Pitch and yaw of the camera.
            fixed_camera: True if the node description declares a camera that does not move. Policies then assume the
                declared attitude.

        Raises:
            Refused: A policy forbids the call, the caller does not have control, or the camera cannot turn.
            AutopilotError: The autopilot did not answer.
        """
        verdict = self.calls.allow_motion(Call("PointGimbal", args), grant)
        if fixed_camera:
            raise PreconditionFailed(
                "CameraFixed",
                "the node's description declares a fixed camera; set services.camera.mount.gimbal of the Drone",
            )
        await self._autopilot.point_gimbal(args.pitch_deg, args.yaw_deg, self._control.driver_permit(grant))
        return verdict

    def take_off(self, grant: ActiveGrant, args: TakeoffArgs) -> AsyncGenerator[Progress, None]:
        """Take off. In the air, climb to the altitude unless the drone is high enough, because clients repeat a takeoff."""
        call = Call("Takeoff", args)
        self._require_armed(call, grant)
        verdict = self.calls.allow_motion(call, grant)

        async def steps(motion: Motion) -> AsyncGenerator[Progress, None]:
            permit = self._control.driver_permit(grant, motion)
            final = verdict
            vehicle = self._autopilot.vehicle
            await self._control.modes.change_mode(self._autopilot.stack.guided, permit)
            climbs: Callable[[Autopilot, Motion, float, Permit], AsyncGenerator[Step, None]] = climb
            if vehicle.in_air and not vehicle.reports_on_ground:
                await come_to_rest(self._autopilot, motion, permit)
                final = self.calls.allow_motion(call, self._control.require_control(grant).grant, verdict)
                climbs = partial(
                    rise, self._control.cruise_mps, judged=self._rejudging_permit(call, grant, final, permit)
                )
            altitude_m = final.args.altitude_m if isinstance(final.args, TakeoffArgs) else args.altitude_m
            async with aclosing(climbs(self._autopilot, motion, altitude_m, permit)) as climbing:
                async for step in climbing:
                    yield Progress(final, step)

        return self._run("Takeoff", grant, steps)

    def goto(self, grant: ActiveGrant, args: GotoArgs, reached_m: float) -> AsyncGenerator[Progress, None]:
        """Fly straight to a point.

        Args:
            grant: Grant of the caller.
            args: Target.
            reached_m: Distance to the target within which the motion is complete; 0 for the default.
        """
        verdict = self.calls.allow_motion(Call("Goto", args), grant)
        _require_in_air(self._autopilot)
        radius_m = SETTINGS.reached_m
        if reached_m > 0:
            radius_m = min(max(reached_m, SETTINGS.min_acceptance_radius_m), SETTINGS.max_acceptance_radius_m)

        binding_until = self._autopilot.now + SETTINGS.binding_timeout_s / self._autopilot.pace

        def bind(motion: Motion, current: Verdict) -> None:
            """Suspend the driver if the verdict moves the target, which only geofences do."""
            result = current.args
            moved = isinstance(result, GotoArgs) and (result.lat, result.lon) != (args.lat, args.lon)
            motion.binding = current if moved else None
            motion.binding_until = binding_until

        async def steps(motion: Motion) -> AsyncGenerator[Progress, None]:
            permit = self._control.driver_permit(grant, motion)
            call = Call("Goto", args)
            final = verdict
            bind(motion, final)
            for _ in range(SETTINGS.max_judgements):
                final = await self._settle(call, grant, final, motion, permit)
                bind(motion, final)
                target = final.args if isinstance(final.args, GotoArgs) else args
                leg = replace(target, speed_mps=target.speed_mps or self._control.cruise_mps)
                judged = self._rejudging_permit(call, grant, final, permit)
                try:
                    async with aclosing(
                        fly_to(self._autopilot, motion, leg, radius_m, permit, judged=judged)
                    ) as flying:
                        async for step in flying:
                            if step.complete:
                                corrected = final.action == "correct"
                                self._control.count_leg(grant, args.lat, args.lon, corrected=corrected)
                            yield Progress(final, step)
                except _Outdated as outdated:
                    final = outdated.verdict
                else:
                    return
            raise Aborted(
                "NotFollowing", f"the autopilot did not begin the leg after {SETTINGS.max_judgements} commands"
            )

        return self._run("Goto", grant, steps)

    def _rejudging_permit(self, call: Call, grant: ActiveGrant, verdict: Verdict, permit: Permit) -> Permit:
        """Return a permit that judges the leg again from the current position if its command is sent late."""
        judged_at = self._autopilot.now

        def check() -> None:
            nonlocal judged_at
            permit()
            if self._autopilot.now - judged_at <= SETTINGS.rejudge_after_s / self._autopilot.pace:
                return
            judged_at = self._autopilot.now
            current = self.calls.allow_motion(call, self._control.require_control(grant).grant, verdict)
            if current.brake_first or current.args != verdict.args:
                raise _Outdated(current)

        return check

    async def _settle(
        self, call: Call, grant: ActiveGrant, verdict: Verdict, motion: Motion, permit: Permit
    ) -> Verdict:
        """Change to GUIDED, and bring the drone to rest if the verdict requires it. Return the verdict to carry out.

        The drone moves during the mode change and while it brakes, so the call is judged again afterwards.

        Raises:
            Refused: The call is not legal from the new position, or the drone does not come to rest.
        """
        for _ in range(SETTINGS.max_judgements):
            begun = self._autopilot.now
            await self._control.modes.change_mode(self._autopilot.stack.guided, permit)
            if verdict.brake_first:
                await come_to_rest(self._autopilot, motion, permit)
            elif self._autopilot.now - begun <= SETTINGS.rejudge_after_s / self._autopilot.pace:
                return verdict
            permit()
            verdict = self.calls.allow_motion(call, self._control.require_control(grant).grant, verdict)
        raise Aborted("NotStopping", "the drone does not come to rest, so it cannot begin its leg")

    async def set_velocity(self, grant: ActiveGrant, args: VelocityArgs) -> tuple[Verdict, VelocityArgs]:
        """Fly with a velocity until the next setpoint, or until its hold time ends."""
        verdict = self.calls.allow_motion(Call("SetVelocity", args), grant)
        _require_in_air(self._autopilot)
        motion = self._control.begin_motion("SetVelocity")
        permit = self._control.driver_permit(grant, motion)
        try:
            final = await self._settle(Call("SetVelocity", args), grant, verdict, motion, permit)
            setpoint = final.args if isinstance(final.args, VelocityArgs) else args
            self._velocity_hold.start(setpoint, motion, permit)
            self._control.count_velocity_flight(grant)
        except BaseException:  # includes cancellation by the caller while the drone brakes
            self._control.fail_motion(motion)
            raise
        return final, setpoint

    def land(self, grant: ActiveGrant) -> AsyncGenerator[Progress, None]:
        """Land at the current position."""
        self.calls.cancel_pending(grant)
        verdict = self.calls.allow_motion(Call("Land"), grant)
        _require_in_air(self._autopilot)

        async def steps(motion: Motion) -> AsyncGenerator[Progress, None]:
            await self._control.modes.change_mode(
                self._control.autopilot.stack.land, self._control.driver_permit(grant, motion)
            )
            async for step in come_down(self._autopilot, motion):
                yield Progress(verdict, step)

        return self._run("Land", grant, steps)

    def return_to_launch(self, grant: ActiveGrant, altitude_m: float | None = None) -> AsyncGenerator[Progress, None]:
        """Fly home on a legal route and land. A route that becomes illegal in flight is replaced.

        Args:
            grant: Grant of the caller.
            altitude_m: Preferred altitude above home. None: the return altitude of the autopilot.
        """
        self.calls.cancel_pending(grant)
        verdict = self.calls.allow_motion(Call("ReturnToLaunch"), grant)
        _require_in_air(self._autopilot)
        return self._return(grant, verdict, altitude_m)

    async def _return(
        self, grant: ActiveGrant, verdict: Verdict, altitude_m: float | None
    ) -> AsyncGenerator[Progress, None]:
        control = self._control
        constraints = control.begin_system_flight(control.require_control(grant).grant)
        flight = SystemFlight(
            constraints, "ReturnToLaunch", lambda motion: control.driver_permit(grant, motion), altitude_m
        )
        replans = ReplanBudget(constraints)
        continues = True
        try:
            while continues:
                continues = False
                attempt = self._run(flight.kind, grant, lambda motion: self._attempt_return(flight, motion, verdict))
                try:
                    async with aclosing(attempt) as running:
                        async for progress in running:
                            yield progress
                except Refused as refusal:
                    if not (continues := replans.allow(refusal)):
                        raise
        finally:
            control.end_system_flight(constraints)

    async def _attempt_return(
        self, flight: SystemFlight, motion: Motion, verdict: Verdict
    ) -> AsyncGenerator[Progress, None]:
        """Try once to fly home and land."""
        permit = flight.permit(motion)
        modes = self._control.modes
        await modes.change_mode(self._autopilot.stack.guided, permit)
        async with aclosing(self._return_flight.attempt(flight, motion)) as steps:
            async for step in steps:
                yield Progress(verdict, step)
        await modes.change_mode(self._return_flight.descent(flight.constraints.grant), permit)
        async for step in come_down(self._autopilot, motion):
            yield Progress(verdict, step)

    def _require_armed(self, call: Call, grant: ActiveGrant) -> None:
        """Refuse a takeoff that cannot be carried out, before the policy engine judges it, because the judgement takes long.

        Calls of a method that is not granted are not refused here: the judgement refuses them and writes the audit log.
        """
        if grant.spec.class_ != "driver" or call.method not in grant.compiled.methods:
            return
        self._control.require_control(grant)
        if not self._autopilot.vehicle.armed:
            raise PreconditionFailed("NotArmed", "the drone is disarmed; arm first")

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


def _require_in_air(autopilot: Autopilot) -> None:
    if not autopilot.vehicle.in_air:
        raise PreconditionFailed("NotFlying", "the drone is on the ground; take off first")

"""Execution of motions: send the command, then report progress from telemetry until the motion is complete."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import AsyncGenerator
from contextlib import aclosing
from dataclasses import dataclass

from fractus_core.policy.decision_types import GotoArgs, VelocityArgs

from fractus_services.errors import Aborted, AutopilotError, Refused, Unavailable
from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.authority.effects import Motion
from fractus_services.mobility.autopilot import Autopilot, Permit, VehicleState
from fractus_services.mobility.settings import SETTINGS

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Step:
    """Progress of a motion: remaining distance in metres, and whether the motion is complete."""

    distance_m: float
    complete: bool


async def climb(autopilot: Autopilot, motion: Motion, altitude_m: float, permit: Permit) -> AsyncGenerator[Step, None]:
    """Take off to an altitude above home in metres."""
    vehicle = autopilot.vehicle
    await autopilot.take_off(altitude_m, permit)
    if vehicle.lat is not None and vehicle.lon is not None:
        # The monitor permits a climb up to the altitude of this leg. The autopilot ends the climb there.
        motion.leg = GotoArgs(vehicle.lat, vehicle.lon, altitude_m)
        motion.under_way = True
    progress_at = autopilot.now
    best_m = -math.inf
    while True:
        remaining_m = altitude_m - vehicle.altitude_m
        complete = remaining_m < SETTINGS.height_reached_m and abs(vehicle.down_mps) < SETTINGS.height_reached_mps
        yield Step(max(remaining_m, 0.0), complete)
        if complete:
            return
        if vehicle.altitude_m > best_m + SETTINGS.climb_progress_m:
            best_m = vehicle.altitude_m
            progress_at = autopilot.now
        if autopilot.now - progress_at > SETTINGS.climb_timeout_s:
            raise Aborted("NotFollowing", f"the drone does not climb above {vehicle.altitude_m:.1f} m")
        if not vehicle.armed:
            raise Aborted("Disarmed", "the autopilot disarmed before the drone took off")
        await _tick(autopilot, motion)


async def fly_to(
    autopilot: Autopilot,
    motion: Motion,
    args: GotoArgs,
    reached_m: float,
    permit: Permit,
    *,
    judged: Permit | None = None,
    settles: bool = False,
) -> AsyncGenerator[Step, None]:
    """Fly straight to a point.

    Args:
        autopilot: Autopilot interface.
        motion: Motion of the leg.
        args: Target of the leg, with the altitude above home and the speed. Without a speed, the autopilot might use its default.
        reached_m: Distance to the target within which the leg is complete.
        permit: Check before each command.
        judged: Check before each transmission of the target, instead of `permit`. It judges the leg from the current position,
            because the drone moves while commands are lost.
        settles: True if the drone lands at the target. The leg is complete when the drone has settled there, because it first
            flies past its target.
    """
    altitude = args.alt if args.alt is not None else autopilot.vehicle.altitude_m
    motion.leg = args
    motion.speed_mps = args.speed_mps

    async def begin() -> None:
        motion.under_way = False
        await autopilot.go_to(args.lat, args.lon, altitude, args.yaw_deg, judged or permit)
        motion.under_way = True
        if not await _speed_acknowledged(autopilot, motion, permit):
            # The speed of the drone is unknown and may exceed a limit. Stop, and start the leg once more.
            motion.under_way = False
            await come_to_rest(autopilot, motion, permit)
            await autopilot.go_to(args.lat, args.lon, altitude, args.yaw_deg, judged or permit)
            motion.under_way = True
            if not await _speed_acknowledged(autopilot, motion, permit):
                raise AutopilotError("the autopilot does not acknowledge the speed of the leg", link=True)
        if args.yaw_deg is not None:
            await autopilot.turn(args.yaw_deg, permit)

    await begin()
    progress_at = autopilot.now
    resends = 0
    best_m = math.inf
    reached_at: float | None = None
    while True:
        vehicle = autopilot.vehicle
        distance_m = vehicle.distance_m(args.lat, args.lon)
        height_m = abs(altitude - vehicle.altitude_m)
        remaining_m = math.hypot(distance_m, height_m)
        complete = distance_m <= reached_m and height_m <= SETTINGS.height_reached_m
        if complete and (settles or args.yaw_deg is not None):
            reached_at = autopilot.now if reached_at is None else reached_at
            progress_at = autopilot.now  # turning on the spot and settling are progress
            turned = args.yaw_deg is None or _heading_reached(vehicle, args.yaw_deg)
            settled = not settles or has_settled(vehicle, distance_m)
            timed_out = autopilot.now - reached_at > SETTINGS.arrival_timeout_s
            complete = (turned and settled) or timed_out
        yield Step(remaining_m, complete)
        if complete:
            return
        if remaining_m < best_m - SETTINGS.leg_progress_m:
            best_m = remaining_m
            progress_at = autopilot.now
        if autopilot.now - progress_at > SETTINGS.stuck_timeout_s:
            if resends == SETTINGS.max_leg_resends:
                raise Aborted("NotFollowing", f"the drone stays {remaining_m:.1f} m away from the target")
            resends += 1
            progress_at = autopilot.now
            await begin()
        await _tick(autopilot, motion)


async def _speed_acknowledged(autopilot: Autopilot, motion: Motion, permit: Permit) -> bool:
    """Set the speed of the leg that the autopilot has begun. Return False if it is not acknowledged in time."""
    if motion.speed_mps is None:
        return True
    try:
        async with asyncio.timeout(SETTINGS.speed_timeout_s):
            await autopilot.set_speed(motion.speed_mps, permit)
    except TimeoutError:
        return False
    return True


async def come_down(autopilot: Autopilot, motion: Motion) -> AsyncGenerator[Step, None]:
    """Follow a landing or the autopilot's return until the motors stop."""
    vehicle = autopilot.vehicle
    while vehicle.armed:
        yield Step(max(vehicle.altitude_m, 0.0), complete=False)
        await _tick(autopilot, motion)
    yield Step(0.0, complete=True)


async def rise(
    speed_mps: float, autopilot: Autopilot, motion: Motion, altitude_m: float, permit: Permit, *, judged: Permit
) -> AsyncGenerator[Step, None]:
    """Climb vertically to an altitude above home, unless the drone is high enough. The drone is at rest; see `fly_to`."""
    vehicle = autopilot.vehicle
    if vehicle.lat is None or vehicle.lon is None or vehicle.altitude_m > altitude_m - SETTINGS.height_reached_m:
        yield Step(0.0, True)
        return
    target = GotoArgs(vehicle.lat, vehicle.lon, altitude_m, speed_mps=speed_mps)
    async with aclosing(fly_to(autopilot, motion, target, SETTINGS.reached_m, permit, judged=judged)) as steps:
        async for step in steps:
            yield step


async def come_to_rest(autopilot: Autopilot, motion: Motion, permit: Permit) -> None:
    """Brake until the drone is at rest, so that its next leg begins at a known position.

    Raises:
        Refused: The motion was stopped, or the drone did not come to rest.
    """
    deadline = autopilot.now + SETTINGS.rest_timeout_s
    sent_at = -math.inf
    motion.braking = True
    try:
        while not autopilot.at_rest:
            if autopilot.now > deadline:
                speed = autopilot.vehicle.speed_mps
                raise Aborted("NotStopping", f"the drone does not stop; it still flies {speed:.1f} m/s")
            if autopilot.now - sent_at >= SETTINGS.stop_resend_s / autopilot.pace:
                permit()
                autopilot.stop()
                sent_at = autopilot.now
            motion.check()
            await _next_message(autopilot)
    finally:
        motion.braking = False
    motion.check()


def has_settled(vehicle: VehicleState, distance_m: float) -> bool:
    """Return True if a drone at this distance from its place of landing may begin to land."""
    return distance_m <= SETTINGS.landing_radius_m and vehicle.speed_mps <= SETTINGS.settled_mps


def _heading_reached(vehicle: VehicleState, yaw_deg: float) -> bool:
    return abs((vehicle.yaw_deg - yaw_deg + 180.0) % 360.0 - 180.0) <= SETTINGS.heading_reached_deg


async def _tick(autopilot: Autopilot, motion: Motion) -> None:
    deadline = autopilot.now + SETTINGS.report_interval_s
    while autopilot.now < deadline:
        motion.check()
        await _next_message(autopilot)
    motion.check()


async def _next_message(autopilot: Autopilot) -> None:
    if not await autopilot.update(SETTINGS.report_interval_s) and not autopilot.connected:
        raise Unavailable(
            "AutopilotUnavailable", "the autopilot is no longer connected; its own failsafe brings the drone home"
        )


class VelocityHold:
    """Keeps one velocity setpoint in force until the next one, until its hold time ends, or until another motion begins.

    When the hold time ends without a new setpoint, the drone hovers.

    Args:
        control: Control state.
    """

    def __init__(self, control: ControlStore) -> None:
        self._control = control
        self._watchdog: asyncio.Task[None] | None = None

    def start(self, setpoint: VelocityArgs, motion: Motion, permit: Permit) -> None:
        """Send a setpoint and repeat it during its hold time.

        Raises:
            Refused: The caller may no longer move the drone.
        """
        permit()
        self._send(setpoint)
        self._control.tasks.drop(self._watchdog)
        self._watchdog = self._control.tasks.spawn(self._watch(setpoint, motion, permit))

    def _send(self, setpoint: VelocityArgs) -> None:
        self._control.autopilot.fly(setpoint.north_mps, setpoint.east_mps, setpoint.down_mps, setpoint.yaw_deg)

    async def _watch(self, setpoint: VelocityArgs, motion: Motion, permit: Permit) -> None:
        """Repeat the setpoint until its hold time ends, then hover, unless another motion has begun."""
        control = self._control
        pace = control.autopilot.pace
        until = control.autopilot.now + setpoint.hold_s / pace
        while control.motion is motion and (remaining_s := until - control.autopilot.now) > SETTINGS.min_hold_s:
            await asyncio.sleep(min(remaining_s, SETTINGS.setpoint_resend_s / pace))
            try:
                permit()
            except Refused as refusal:
                log.info("velocity: setpoint ended early (reason=%s)", refusal)
                break
            if control.motion is motion and control.autopilot.now < until:
                self._send(setpoint)
        if control.motion is motion:
            control.finish_motion(motion)
            await control.tasks.attempt(control.effects.hover, control.effects.require_undisturbed)

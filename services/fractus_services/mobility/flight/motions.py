"""Motions under way: each commands the autopilot, then follows the streamed state until it is complete."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncGenerator
from contextlib import aclosing
from dataclasses import dataclass

from fractus_core.policy.decision_types import GotoArgs

from fractus_services.errors import Aborted, AutopilotError, Unavailable
from fractus_services.mobility.authority.leases import Motion
from fractus_services.mobility.autopilot import Autopilot, Permit, VehicleState

REACHED_M = 1.0
HEIGHT_REACHED_M, HEIGHT_REACHED_MPS = 0.8, 0.6
"""A climb is complete this near to its altitude and this slow: ArduCopter approaches the last metre ever more slowly."""

REPORT_S = 0.2
CLIMB_TIMEOUT_S, CLIMB_PROGRESS_M = 20.0, 0.2
STUCK_TIMEOUT_S, LEG_PROGRESS_M = 6.0, 0.3
MAX_RESENDS = 3
"""A leg on which the drone gets no nearer for that long is sent again: a stop of ours may have overtaken the command, or the
autopilot may have restarted its controller."""

TURNED_DEG, TURN_TIMEOUT_S = 8.0, 8.0
"""A leg with a heading is complete when the nose points there, or had this long to turn."""

SPEED_TIMEOUT_S = 1.3
"""A leg whose speed is not acknowledged in this time, in which it is sent twice, is stopped and begun once more."""

REST_TIMEOUT_S, STOP_RESEND_S = 12.0, 0.1


@dataclass(frozen=True, slots=True)
class Step:
    """Where a motion is."""

    distance_m: float
    complete: bool


async def climb(autopilot: Autopilot, motion: Motion, altitude_m: float, permit: Permit) -> AsyncGenerator[Step, None]:
    """Take off to an altitude above home."""
    vehicle = autopilot.vehicle
    await autopilot.take_off(altitude_m, permit)
    if vehicle.lat is not None and vehicle.lon is not None:
        # The monitor lets it climb to there: the autopilot ends its climb by itself.
        motion.leg, motion.under_way = GotoArgs(vehicle.lat, vehicle.lon, altitude_m), True
    begun, best = autopilot.now, -math.inf
    while True:
        left = altitude_m - vehicle.altitude_m
        done = left < HEIGHT_REACHED_M and abs(vehicle.down_mps) < HEIGHT_REACHED_MPS
        yield Step(max(left, 0.0), done)
        if done:
            return
        if vehicle.altitude_m > best + CLIMB_PROGRESS_M:
            best, begun = vehicle.altitude_m, autopilot.now
        if autopilot.now - begun > CLIMB_TIMEOUT_S:
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
) -> AsyncGenerator[Step, None]:
    """Fly straight to a point; altitude above home.

    Args:
        autopilot: flies.
        motion: what it belongs to.
        args: the leg; with a speed, since the autopilot may not remember the last one.
        reached_m: how near to the point the leg is complete.
        permit: the check that each command must pass before it is sent.
        judged: the check instead of `permit` each time before the leg is begun: the drone moves on while commands are lost,
            and a leg that was legal from there may not be legal from here.
    """
    altitude = args.alt if args.alt is not None else autopilot.vehicle.altitude_m
    motion.leg, motion.speed_mps = args, args.speed_mps

    async def begin() -> None:
        motion.under_way = False
        await autopilot.go_to(args.lat, args.lon, altitude, args.yaw_deg, judged or permit)
        motion.under_way = True
        if not await _hears_speed(autopilot, motion, permit):
            # It flies at an unknown speed, maybe its own default: above a limit that was judged. Stop, and try once more.
            motion.under_way = False
            await come_to_rest(autopilot, motion, permit)
            await autopilot.go_to(args.lat, args.lon, altitude, args.yaw_deg, judged or permit)
            motion.under_way = True
            if not await _hears_speed(autopilot, motion, permit):
                raise AutopilotError("the autopilot does not acknowledge the speed of the leg", link=True)
        if args.yaw_deg is not None:
            await autopilot.turn(args.yaw_deg, permit)

    await begin()
    sent, resends, best = autopilot.now, 0, math.inf
    there: float | None = None
    while True:
        vehicle = autopilot.vehicle
        away = vehicle.distance_m(args.lat, args.lon)
        rise = abs(altitude - vehicle.altitude_m)
        done = away <= reached_m and rise <= HEIGHT_REACHED_M
        if done and args.yaw_deg is not None:
            there = autopilot.now if there is None else there
            sent = autopilot.now  # turning on the spot is progress
            done = _turned(vehicle, args.yaw_deg) or autopilot.now - there > TURN_TIMEOUT_S
        yield Step(math.hypot(away, rise), done)
        if done:
            return
        if math.hypot(away, rise) < best - LEG_PROGRESS_M:
            best, sent = math.hypot(away, rise), autopilot.now
        if autopilot.now - sent > STUCK_TIMEOUT_S:
            if resends == MAX_RESENDS:
                raise Aborted("NotFollowing", f"the drone stays {math.hypot(away, rise):.1f} m away from the target")
            resends, sent = resends + 1, autopilot.now
            await begin()
        await _tick(autopilot, motion)


async def _hears_speed(autopilot: Autopilot, motion: Motion, permit: Permit) -> bool:
    """Tell the autopilot how fast the leg that it has begun is flown; whether it answers soon enough."""
    if motion.speed_mps is None:
        return True
    try:
        async with asyncio.timeout(SPEED_TIMEOUT_S):
            await autopilot.set_speed(motion.speed_mps, permit)
    except TimeoutError:
        return False
    return True


async def come_down(autopilot: Autopilot, motion: Motion) -> AsyncGenerator[Step, None]:
    """Follow a landing or a return to launch until the motors stop."""
    vehicle = autopilot.vehicle
    while vehicle.armed:
        yield Step(max(vehicle.altitude_m, 0.0), complete=False)
        await _tick(autopilot, motion)
    yield Step(0.0, complete=True)


async def rise(
    speed_mps: float, autopilot: Autopilot, motion: Motion, altitude_m: float, permit: Permit, *, judged: Permit
) -> AsyncGenerator[Step, None]:
    """Climb to an altitude above home over the place where the drone rests, unless it is high enough; see `fly_to`."""
    vehicle = autopilot.vehicle
    if vehicle.lat is None or vehicle.lon is None or vehicle.altitude_m > altitude_m - HEIGHT_REACHED_M:
        yield Step(0.0, True)
        return
    place = GotoArgs(vehicle.lat, vehicle.lon, altitude_m, speed_mps=speed_mps)
    async with aclosing(fly_to(autopilot, motion, place, REACHED_M, permit, judged=judged)) as steps:
        async for step in steps:
            yield step


async def come_to_rest(autopilot: Autopilot, motion: Motion, permit: Permit) -> None:
    """Brake until the drone stands, so that its next leg begins on the spot.

    Raises:
        Refused: the motion was stopped, or the drone does not come to rest.
    """
    deadline, sent = autopilot.now + REST_TIMEOUT_S, -math.inf
    motion.braking = True
    try:
        while not autopilot.at_rest:
            if autopilot.now > deadline:
                speed = autopilot.vehicle.speed_mps
                raise Aborted("NotStopping", f"the drone does not stop; it still flies {speed:.1f} m/s")
            if autopilot.now - sent >= STOP_RESEND_S / autopilot.pace:
                permit()
                autopilot.stop()
                sent = autopilot.now
            motion.check()
            await _next_message(autopilot)
    finally:
        motion.braking = False
    motion.check()


def _turned(vehicle: VehicleState, yaw_deg: float) -> bool:
    return abs((vehicle.yaw_deg - yaw_deg + 180.0) % 360.0 - 180.0) <= TURNED_DEG


async def _tick(autopilot: Autopilot, motion: Motion) -> None:
    deadline = autopilot.now + REPORT_S
    while autopilot.now < deadline:
        motion.check()
        await _next_message(autopilot)
    motion.check()


async def _next_message(autopilot: Autopilot) -> None:
    if not await autopilot.update(REPORT_S) and not autopilot.connected:
        raise Unavailable("AutopilotUnavailable", "the autopilot is no longer heard; it flies home by its own failsafe")

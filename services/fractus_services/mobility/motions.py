"""Motions under way: each commands the autopilot, then follows the streamed state until it is complete."""

from __future__ import annotations

import math
from collections.abc import AsyncIterator
from dataclasses import dataclass

from fractus_core.geo import LocalFrame
from fractus_core.policy.values import GotoArgs

from fractus_services.mobility.autopilot import Autopilot, Permit
from fractus_services.mobility.leases import Motion
from fractus_services.replies import aborted, unavailable

REACHED_M = 1.0
HEIGHT_REACHED_M = 0.8
REPORT_S = 0.2
STUCK_S = 6.0
RESENDS = 3


@dataclass(frozen=True, slots=True)
class Step:
    """Where a motion is."""

    distance_m: float
    complete: bool


async def climb(autopilot: Autopilot, motion: Motion, altitude_m: float, permit: Permit) -> AsyncIterator[Step]:
    """Take off to an altitude above home."""
    vehicle = autopilot.vehicle
    await autopilot.take_off(altitude_m, permit)
    begun, best = autopilot.now, -math.inf
    while True:
        left = altitude_m - vehicle.altitude_m
        done = left < HEIGHT_REACHED_M and abs(vehicle.down_mps) < 0.6
        yield Step(max(left, 0.0), done)
        if done:
            return
        if vehicle.altitude_m > best + 0.2:
            best, begun = vehicle.altitude_m, autopilot.now
        if autopilot.now - begun > 20.0:
            raise aborted("NotFollowing", f"the drone does not climb above {vehicle.altitude_m:.1f} m")
        if not vehicle.armed:
            raise aborted("Disarmed", "the autopilot disarmed before the drone took off")
        await _tick(autopilot, motion)


async def fly_to(
    autopilot: Autopilot, motion: Motion, args: GotoArgs, reached_m: float, permit: Permit
) -> AsyncIterator[Step]:
    """Fly straight to a point; altitude above home."""
    altitude = args.alt if args.alt is not None else autopilot.vehicle.altitude_m
    frame = LocalFrame(args.lat, args.lon)
    await autopilot.go_to(args.lat, args.lon, altitude, args.yaw_deg, permit)
    sent, resends, best = autopilot.now, 0, math.inf
    while True:
        vehicle = autopilot.vehicle
        away = distance_m(frame, vehicle.lat, vehicle.lon)
        rise = abs(altitude - vehicle.altitude_m)
        done = away <= reached_m and rise <= HEIGHT_REACHED_M
        yield Step(math.hypot(away, rise), done)
        if done:
            return
        if math.hypot(away, rise) < best - 0.3:
            best, sent = math.hypot(away, rise), autopilot.now
        if autopilot.now - sent > STUCK_S:
            if resends == RESENDS:
                raise aborted("NotFollowing", f"the drone stays {math.hypot(away, rise):.1f} m away from the target")
            resends, sent = resends + 1, autopilot.now
            await autopilot.go_to(args.lat, args.lon, altitude, args.yaw_deg, permit)
        await _tick(autopilot, motion)


async def come_down(autopilot: Autopilot, motion: Motion) -> AsyncIterator[Step]:
    """Follow a landing or a return to launch until the motors stop."""
    vehicle = autopilot.vehicle
    while vehicle.armed:
        yield Step(max(vehicle.altitude_m, 0.0), complete=False)
        await _tick(autopilot, motion)
    yield Step(0.0, complete=True)


def distance_m(frame: LocalFrame, lat: float | None, lon: float | None) -> float:
    """Horizontal distance of a position from a frame's origin."""
    if lat is None or lon is None:
        return math.inf
    return math.hypot(*frame.xy(lat, lon))


async def _tick(autopilot: Autopilot, motion: Motion) -> None:
    deadline = autopilot.now + REPORT_S
    while autopilot.now < deadline:
        motion.check()
        if not await autopilot.update(REPORT_S) and not autopilot.connected:
            raise unavailable("the autopilot is no longer heard; it flies home by its own failsafe")
    motion.check()

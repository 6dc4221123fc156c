"""Velocity setpoints of a driver, and the watchdog that makes the drone hover when no other follows."""

from __future__ import annotations

import asyncio
import logging

from fractus_core.policy.values import VelocityArgs

from fractus_services.errors import Refused
from fractus_services.mobility.authority.control import Control
from fractus_services.mobility.authority.leases import Motion
from fractus_services.mobility.mavlink.autopilot import Permit

log = logging.getLogger(__name__)

AGAIN_S = 0.2
"""A setpoint is sent again so often while it holds: one that is lost on the way must not leave the one before in force."""


class Steering:
    """Keeps one setpoint in force until the next one, until its hold is over, or until somebody else flies."""

    def __init__(self, control: Control) -> None:
        self._control = control
        self._watchdog: asyncio.Task[None] | None = None

    def steer(self, setpoint: VelocityArgs, motion: Motion, permit: Permit) -> None:
        """Put a setpoint in force, as a motion of its own.

        Raises:
            Refused: the caller may not move the drone any more.
        """
        permit()
        self._send(setpoint)
        self._control.tasks.drop(self._watchdog)
        self._watchdog = self._control.tasks.spawn(self._watch(setpoint, motion, permit))

    def _send(self, point: VelocityArgs) -> None:
        self._control.autopilot.fly(point.north_mps, point.east_mps, point.down_mps, point.yaw_deg)

    async def _watch(self, setpoint: VelocityArgs, motion: Motion, permit: Permit) -> None:
        """Keep the setpoint in force to its end, and end it unless somebody else has said what the drone does."""
        control = self._control
        until = control.autopilot.now + setpoint.hold_s
        while control.motion is motion and (left_s := until - control.autopilot.now) > 0:
            await asyncio.sleep(min(left_s, AGAIN_S))
            try:
                permit()
            except Refused as refusal:
                log.info("a velocity ends: %s", refusal)
                break
            if control.motion is motion and control.autopilot.now < until:
                self._send(setpoint)
        if control.motion is motion:
            control.finish(motion)
            await control.tasks.attempt(control.hold, control.still)

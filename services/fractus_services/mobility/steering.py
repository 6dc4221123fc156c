"""Velocity setpoints of a driver, and the watchdog that makes the drone hover when no other follows."""

from __future__ import annotations

import asyncio

from fractus_core.policy.values import VelocityArgs

from fractus_services.mobility.autopilot import Permit
from fractus_services.mobility.control import Control
from fractus_services.mobility.leases import Motion
from fractus_services.replies import Refused

AGAIN_S = 0.2
"""A setpoint is sent again so often while it holds: one that is lost on the way must not leave the one before in force."""


class Steering:
    """Keeps one setpoint in force until the next one, until its hold is over, or until somebody else flies."""

    def __init__(self, control: Control) -> None:
        self._control = control
        self._motion: Motion | None = None
        self._setpoint = VelocityArgs(0.0, 0.0)
        self._until = 0.0
        self._watchdog: asyncio.Task[None] | None = None

    def motion(self) -> Motion:
        """The motion that setpoints belong to: the one under way, or a new one that replaces what the drone did."""
        if self._motion is None or self._control.motion is not self._motion:
            self._motion = self._control.begin("SetVelocity")
        return self._motion

    def steer(self, setpoint: VelocityArgs, motion: Motion, permit: Permit) -> None:
        """Put a setpoint in force.

        Raises:
            Refused: the caller may not move the drone any more.
        """
        permit()
        self._setpoint, self._until = setpoint, self._control.autopilot.now + setpoint.hold_s
        self._send()
        if self._watchdog is None or self._watchdog.done():
            self._watchdog = self._control.tasks.spawn(self._watch(motion, permit))

    def _send(self) -> None:
        point = self._setpoint
        self._control.autopilot.fly(point.north_mps, point.east_mps, point.down_mps, point.yaw_deg)

    async def _watch(self, motion: Motion, permit: Permit) -> None:
        control = self._control
        while (left_s := self._until - control.autopilot.now) > 0:
            await asyncio.sleep(min(left_s, AGAIN_S))
            try:
                permit()
            except Refused:
                return  # whoever flies by now has said what the drone does
            if control.autopilot.now < self._until:
                self._send()
        control.finish(motion)
        await control.tasks.attempt(control.hold(control.still))

"""Velocity setpoints of a driver, and the watchdog that makes the drone hover when none follows in time."""

from __future__ import annotations

import asyncio
import logging

from fractus_core.policy.decision_types import VelocityArgs

from fractus_services.errors import Refused
from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.authority.leases import Motion
from fractus_services.mobility.autopilot import Permit

log = logging.getLogger(__name__)

RESEND_S = 0.2
"""How often, by the vehicle's clock, a setpoint is sent again while it holds. A lost message must not leave the setpoint
before it in force, and ArduCopter itself stops after GUID_TIMEOUT (1 s, set with the failsafes) without one."""

OVER_S = 1e-3
"""A hold that ends this soon is over: the event loop sleeps no shorter."""


class Steering:
    """Keeps one setpoint in force until the next one, until its hold is over, or until another motion begins."""

    def __init__(self, control: ControlStore) -> None:
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
        """Keep the setpoint in force to its end, then hover, unless another motion has begun meanwhile."""
        control, pace = self._control, self._control.autopilot.pace
        until = control.autopilot.now + setpoint.hold_s / pace
        while control.motion is motion and (left_s := until - control.autopilot.now) > OVER_S:
            await asyncio.sleep(min(left_s, RESEND_S / pace))
            try:
                permit()
            except Refused as refusal:
                log.info("steering: setpoint ended early (reason=%s)", refusal)
                break
            if control.motion is motion and control.autopilot.now < until:
                self._send(setpoint)
        if control.motion is motion:
            control.finish_motion(motion)
            await control.tasks.attempt(control.effects.hover, control.effects.require_undisturbed)

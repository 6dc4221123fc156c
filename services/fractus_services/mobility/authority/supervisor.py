"""The last look: an armed drone that nobody is responsible for is brought home, and no fence outlives its mission."""

from __future__ import annotations

import asyncio
import logging
import math

from fractus_core.policy.values import Takeover

from fractus_services.errors import PreconditionFailed
from fractus_services.mobility.authority.control import Control

log = logging.getLogger(__name__)

TICKED_S = 1.0
ORPHAN_S = 3.0
LOWER_AGAIN_S = 10.0


class Supervisor:
    """Runs in every turn of the watch loop, and vouches for the service towards the autopilot.

    The heartbeats that hold off the autopilot's own failsafe are sent only while this is sound.
    """

    def __init__(self, control: Control) -> None:
        self._control = control
        self._ticked_at = -math.inf
        self._orphan_since: float | None = None
        self._lowering: asyncio.Task[None] | None = None
        self._lower_at = -math.inf

    def tick(self) -> None:
        """Find out whether somebody is responsible; act when nobody is. Put back the fence that no mission needs."""
        control = self._control
        now = control.autopilot.now
        mute = not self.alive()
        if control.decided and self._orphaned():
            if self._orphan_since is None:
                self._orphan_since = now
            log.error("nobody is responsible for the armed drone; the system takes it")
            self._adopt()
        if not self._orphaned():
            self._orphan_since = None
        self._ticked_at = now
        if mute and self.alive():
            control.autopilot.beat()
        if now >= self._lower_at and self._idle() and control.fence.raised:
            self._lower_at = now + LOWER_AGAIN_S
            if self._lowering is None or self._lowering.done():
                self._lowering = control.tasks.spawn(self._lower())

    def alive(self) -> bool:
        """Whether the autopilot may rely on this companion."""
        control = self._control
        now = control.autopilot.now
        return (
            control.autopilot.found
            and control.decided
            and now - self._ticked_at <= TICKED_S
            and (self._orphan_since is None or now - self._orphan_since < ORPHAN_S)
        )

    def _idle(self) -> bool:
        """Whether the drone stands, and no mission that began goes on."""
        control, mission = self._control, self._control.journal.flying
        if not (control.decided and control.autopilot.connected) or control.autopilot.vehicle.armed:
            return False
        over = mission is None or bool(mission.outcome) or not mission.flown
        return over and not control.modes.preparing

    async def _lower(self) -> None:
        await self._control.tasks.attempt(self._control.fence.lower, self._idle)

    def _orphaned(self) -> bool:
        """Whether the motors run for nobody: no pilot, no driver, no transit, no tour, no grace, no way home."""
        control, lease = self._control, self._control.lease
        if (
            not control.autopilot.vehicle.armed
            or control.modes.arming
            or control.authority == "pilot"
            or control.graced
        ):
            return False
        if lease is not None and (control.drives(lease) or control.constraints is not None):
            return False
        at_work = control.system is not None and not control.system.done()
        return not (at_work and (control.homeward or control.touring is not None))

    def _adopt(self) -> None:
        control, mission = self._control, self._control.journal.flying
        control.authority = "system"
        control.stop_motion(PreconditionFailed("ControlLost", "the system took the drone"))
        alive = mission is not None and not mission.outcome and control.mission_grant is not None
        action: Takeover = "hover" if alive and control.autopilot.vehicle.in_air else "returnToLaunch"
        control.note(action, "system", "nobody had the drone", "Orphaned", kind="takeover")
        control.start(action)
        if action == "hover" and mission is not None:
            control.begin_grace(mission, "driver lost")

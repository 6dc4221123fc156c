"""The last look: an armed drone without authority is brought home, and no fence outlives its mission."""

from __future__ import annotations

import asyncio
import logging
import math

from fractus_core.control.events import Tick

from fractus_services.mobility.authority.control import Control
from fractus_services.mobility.autopilot import Fence, ReturnLimits

log = logging.getLogger(__name__)

TICK_TIMEOUT_S = 1.0
"""A loop that has not looked for this long may hang: the autopilot must not rely on it."""

UNATTENDED_TIMEOUT_S = 3.0
"""How long an armed drone may be without authority though control tries to take it: then its own failsafe brings it home."""

LOWER_AGAIN_S = 10.0
LOWER_AFTER_S = 5.0
"""How long nothing needs the fence before it is put back: an arming that is tried again finds it as it was."""


class Supervisor:
    """Runs in every turn of the monitor's loop, and tells the autopilot whether it may rely on the service.

    The heartbeats that hold off the autopilot's own failsafe are sent only while this is sound.
    """

    def __init__(self, control: Control, fence: Fence, limits: ReturnLimits) -> None:
        self._control = control
        self._fence = fence
        self._limits = limits
        self._ticked_at = -math.inf
        self._lowering: asyncio.Task[None] | None = None
        self._lower_at = self._needed_at = -math.inf

    def tick(self) -> None:
        """Let control take a drone that no one answers for. Put back the fence and the limits that no mission needs.

        Raises:
            Exception: control failed; the heartbeats end until it works again.
        """
        control, now = self._control, self._control.autopilot.now
        mute = not self.alive()
        control.dispatch(Tick())
        self._ticked_at = now
        if mute and self.alive():
            control.autopilot.beat()
        needed = not self._idle()
        if needed:
            self._needed_at = now
        due = now >= max(self._lower_at, self._needed_at + LOWER_AFTER_S)
        if not needed and due and (self._fence.raised or self._limits.limited):
            self._lower_at = now + LOWER_AGAIN_S
            if self._lowering is None or self._lowering.done():
                self._lowering = control.tasks.spawn(self._lower())

    def alive(self) -> bool:
        """Whether the autopilot may rely on this companion."""
        state, autopilot = self._control.state, self._control.autopilot
        since = state.unattended_since
        return (
            autopilot.found
            and state.decided
            and autopilot.now - self._ticked_at <= TICK_TIMEOUT_S
            and (since is None or autopilot.now - since < UNATTENDED_TIMEOUT_S)
        )

    def _idle(self) -> bool:
        """Whether the drone stands, and no mission that began goes on."""
        state, mission = self._control.state, self._control.state.mission
        if not (state.decided and state.vehicle.connected) or state.vehicle.armed:
            return False
        over = mission is None or mission.outcome is not None or not mission.flown
        return over and not state.preparing

    async def _lower(self) -> None:
        for put_back in (self._fence.lower, self._limits.lift):
            try:
                await self._control.tasks.attempt(put_back, self._idle)
            except Exception:
                log.exception("supervisor: the owner's fence or limits were not put back, trying again")

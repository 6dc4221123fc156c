"""Supervision of the control authority, on which the companion heartbeats depend.

An armed drone without control authority is brought home. The fence and limits of a mission are removed after the mission, and
before the service stops.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable

from fractus_core.control.events import Tick

from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.autopilot import Fence, ReturnLimits
from fractus_services.mobility.settings import SETTINGS

log = logging.getLogger(__name__)


class Supervisor:
    """Supervises the control authority in every iteration of the monitor's loop.

    Heartbeats, which hold off the autopilot's own failsafe, are sent only while `alive` returns True.
    """

    def __init__(self, control: ControlStore, fence: Fence, limits: ReturnLimits) -> None:
        self._control = control
        self._fence = fence
        self._limits = limits
        self._ticked_at = -math.inf
        self._lowering: asyncio.Task[None] | None = None
        self._lower_at = -math.inf
        self._needed_at = -math.inf

    def tick(self) -> None:
        """Take over a drone without control authority, and remove a fence and limits that no mission needs.

        Raises:
            Exception: The control state failed. No heartbeats are sent until it works again.
        """
        control = self._control
        now = control.autopilot.now
        was_alive = self.alive()
        control.dispatch(Tick())
        self._ticked_at = now
        if not was_alive and self.alive():
            control.autopilot.send_heartbeat()
        needed = not self._idle()
        if needed:
            self._needed_at = now
        due = now >= max(self._lower_at, self._needed_at + SETTINGS.lower_after_s)
        if not needed and due and self._restore_pending:
            self._lower_at = now + SETTINGS.lower_retry_s
            if self._lowering is None or self._lowering.done():
                self._lowering = control.tasks.spawn(self._restore(self._idle))

    async def stop(self) -> None:
        """Restore the owner's fence and parameters before the service ends. No drone is armed any more.

        The method waits while a drone stands on the ground with running motors, and until an arming attempt has ended. It returns
        at once if the drone is in the air, because the autopilot's failsafe brings it home, or if the autopilot is silent. Values
        that could not be restored are on disk, and the next start of the service restores them.
        """
        control = self._control
        control.stopping = True
        try:
            async with asyncio.timeout(SETTINGS.stop_timeout_s):
                while control.autopilot.starting.locked() or self._restore_pending:
                    if control.state.vehicle.in_air or not control.state.vehicle.connected:
                        break
                    await self._restore(self._is_disarmed)
                    await asyncio.sleep(SETTINGS.stop_retry_s)
        except TimeoutError:
            pass
        if self._restore_pending:
            log.warning(
                "supervisor: stopping, the owner's fence or parameters are not restored yet; the next start restores them"
            )

    def alive(self) -> bool:
        """Return True if this companion may hold off the autopilot's failsafe."""
        state = self._control.state
        autopilot = self._control.autopilot
        since = state.unattended_since
        return (
            autopilot.found
            and state.decided
            and autopilot.now - self._ticked_at <= SETTINGS.tick_timeout_s
            and (since is None or autopilot.now - since < SETTINGS.unattended_timeout_s)
        )

    def _idle(self) -> bool:
        """Return True if the drone is disarmed, and no mission that has taken off before still runs."""
        state = self._control.state
        mission = state.mission
        ended = mission is None or mission.outcome is not None or not mission.flown
        return state.decided and ended and self._is_disarmed()

    def _is_disarmed(self) -> bool:
        """Return True if the motors are off and nobody is about to start them."""
        state = self._control.state
        return state.vehicle.connected and not state.vehicle.armed and not state.preparing

    @property
    def _restore_pending(self) -> bool:
        """True while the vehicle has a fence or parameters of a mission."""
        return self._fence.raised or self._limits.limited

    async def _restore(self, allowed: Callable[[], bool]) -> None:
        """Try to restore the owner's fence and parameters while `allowed` returns True."""
        for restore in (self._fence.lower, self._limits.lift):
            try:
                await self._control.tasks.attempt(restore, allowed)
            except Exception:
                log.exception("supervisor: cannot restore the owner's fence or limits, retrying")

"""The autopilot's comings and goings: control is told of them, and the failsafes are set."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import replace

from fractus_core.control.events import Heartbeat, VehicleFound

from fractus_services.errors import AutopilotError
from fractus_services.mobility.authority.control import Control
from fractus_services.mobility.autopilot import BEING_SET, Failsafes

log = logging.getLogger(__name__)

RETRY_S, MAX_RETRY_S = 0.5, 30.0


class Observer:
    """Follows the autopilot's link and heartbeats.

    Args:
        control: decides what they mean.
        failsafes: set when the autopilot is there.
    """

    def __init__(self, control: Control, failsafes: Failsafes) -> None:
        self._control = control
        self._failsafes = failsafes
        self._preparing: asyncio.Task[None] | None = None

    def found(self) -> None:
        """The autopilot is there, for the first time or again."""
        checked, flying = self._control.checked, self._control.autopilot.vehicle.armed
        self._control.set_checked(replace(checked, problem=BEING_SET) if flying and checked is not None else None)
        self._control.dispatch(VehicleFound())
        self._control.tasks.drop(self._preparing)
        self._preparing = self._control.tasks.spawn(self._prepare())

    def heartbeat(self) -> None:
        """The autopilot told its mode, and whether it is armed."""
        self._control.dispatch(Heartbeat())

    async def _prepare(self) -> None:
        """Set the failsafes; again, while nothing flies, as long as they are not verified: a message may have been lost."""
        autopilot, again_s = self._control.autopilot, RETRY_S
        while autopilot.found:
            if autopilot.connected and self._unverified():
                try:
                    await autopilot.set_rates(flying=autopilot.vehicle.armed)
                    before = self._control.checked
                    self._control.set_checked(
                        await self._failsafes.configure(flying=autopilot.vehicle.armed, before=before)
                    )
                    self._control.wake()
                    if autopilot.vehicle.home is None:
                        await self._control.tasks.attempt(autopilot.ask_home)
                except AutopilotError as error:
                    log.warning("observer: cannot prepare the autopilot yet (error=%s)", error)
                except Exception:
                    log.exception("observer: preparing the autopilot failed; it is tried again")
                else:
                    again_s = min(2 * again_s, MAX_RETRY_S)
            else:
                again_s = RETRY_S
            await asyncio.sleep(again_s)

    def _unverified(self) -> bool:
        checked, idle = self._control.checked, not self._control.autopilot.vehicle.armed
        if checked is None or checked.problem == BEING_SET:
            return True
        return bool(checked.problem) and idle and not self._control.state.preparing

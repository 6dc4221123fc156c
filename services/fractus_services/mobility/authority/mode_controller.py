"""Mode changes, braking and descent by the system.

Every mode change is dispatched to the control state. Otherwise it would be attributed to a pilot.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import Protocol

from fractus_core.control import ControlState
from fractus_core.control.events import Event, ModeChangeBegan, ModeChangeEnded
from fractus_core.control.state import FlightMode, TaskKind

from fractus_services.errors import AutopilotError
from fractus_services.mobility.autopilot import Approach, Autopilot, Permit, always
from fractus_services.mobility.settings import SETTINGS

log = logging.getLogger(__name__)


class ControlAccess(Protocol):
    """Access to the control state."""

    @property
    def state(self) -> ControlState:
        """The current state."""

    def dispatch(self, event: Event) -> object:
        """Apply an event to the state."""


class ModeController:
    """Changes modes and brakes.

    Args:
        autopilot: Autopilot interface.
        control: Control state, to which every mode change is dispatched.
    """

    def __init__(self, autopilot: Autopilot, control: ControlAccess) -> None:
        self._autopilot = autopilot
        self._control = control

    async def change_mode(self, mode: FlightMode, permit: Permit = always) -> None:
        """Change the flight mode.

        Raises:
            AutopilotError: The autopilot did not change the mode.
        """
        permit()
        before = self._control.state.expected_mode
        if self._autopilot.vehicle.mode == mode and before == mode:
            return
        done = False
        refused = False
        self._control.dispatch(ModeChangeBegan(mode))
        try:
            await self._autopilot.set_mode(mode, permit)
            done = True
        except AutopilotError as error:
            refused = error.refused
            raise
        finally:
            self._control.dispatch(ModeChangeEnded(mode, before, done, refused))

    async def hold(self, permit: Permit = always) -> None:
        """Brake and hover.

        Raises:
            AutopilotError: The autopilot did not change the mode.
        """
        permit()
        self._autopilot.stop()
        await self.change_mode(self._autopilot.stack.guided, permit)
        self._autopilot.stop()

    async def settle(self) -> None:
        """Repeat the stop setpoint until the drone is at rest, because a single setpoint times out in the autopilot."""
        autopilot = self._autopilot
        deadline = autopilot.now + SETTINGS.settle_timeout_s
        while self._control.state.motion is None and autopilot.vehicle.mode.commanded and autopilot.now < deadline:
            speeds = autopilot.vehicle.speed_mps, abs(autopilot.vehicle.down_mps)
            if autopilot.at_rest and max(speeds) < SETTINGS.settled_mps:
                return
            autopilot.stop()
            await asyncio.sleep(SETTINGS.brake_resend_s / autopilot.pace)

    async def disarm(self) -> bool:
        """Disarm. Return False if the autopilot refuses, as it does in the air."""
        try:
            await self._autopilot.disarm()
        except AutopilotError as error:
            if error.link:
                raise
            return False
        return True

    async def carry_out(self, kind: TaskKind, is_current: Callable[[], bool], approach: Approach) -> None:
        """Hover, or bring the drone to the ground. Retry if the link fails.

        Args:
            kind: Kind of the system task.
            is_current: Returns True while the task is current.
            approach: Return flight up to the final descent.
        """
        vehicle = self._autopilot.vehicle
        attempts = 0
        refused = False
        while (vehicle.armed or self._control.state.starting_motors) and is_current():
            try:
                if self._control.state.starting_motors:
                    await self._autopilot.update(SETTINGS.task_retry_s)
                    continue
                if kind is TaskKind.HOVER:
                    await self._hover()
                    return
                if (vehicle.reports_on_ground or not vehicle.in_air) and not refused:
                    refused = not await self.disarm()
                else:
                    await self._come_down(kind, attempts, is_current, approach)
            except AutopilotError as error:
                attempts += not error.link
                log.warning("modes: autopilot does not follow, retrying (task=%s error=%s)", kind.value, error)
            await asyncio.sleep(SETTINGS.task_retry_s)

    async def _come_down(
        self, kind: TaskKind, attempts: int, is_current: Callable[[], bool], approach: Approach
    ) -> None:
        """Land or return. A descent that the autopilot has already begun is only supervised."""
        vehicle = self._autopilot.vehicle
        expected = self._control.state.expected_mode == vehicle.mode
        if kind is TaskKind.LAND or not vehicle.mode.comes_down or not expected:
            await self._brake(is_current)
            mode = self._autopilot.stack.land
            if attempts < SETTINGS.max_return_attempts:
                mode = await approach(kind, is_current, attempts)
            await self.change_mode(mode, lambda: _require(is_current))
        while vehicle.armed and vehicle.mode.comes_down:
            await self._autopilot.update(1.0)

    async def _brake(self, is_current: Callable[[], bool]) -> None:
        """Brake in GUIDED until the drone is at rest, so that it does not fly a wide arc when it turns home."""
        autopilot = self._autopilot
        vehicle = autopilot.vehicle
        deadline = autopilot.now + SETTINGS.brake_timeout_s
        autopilot.stop()
        while is_current() and vehicle.in_air and vehicle.mode.commanded and autopilot.now < deadline:
            if autopilot.at_rest or not vehicle.position_fresh(autopilot.now):
                return
            autopilot.stop()
            await autopilot.update(SETTINGS.brake_resend_s / autopilot.pace)

    async def _hover(self) -> None:
        """Hold the position now. If a takeoff is in progress, hold again when the drone has left the ground."""
        await self.hold()
        while self._autopilot.vehicle.armed and not self._autopilot.vehicle.in_air:
            await self._autopilot.update(SETTINGS.task_retry_s)
        if self._autopilot.vehicle.armed:
            await self.hold()
            await self.settle()


def _require(is_current: Callable[[], bool]) -> None:
    if not is_current():
        raise AutopilotError("the system has lost control of the drone")

"""Modes and stops: what the system itself changes, so that it is not taken for a pilot's doing."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from fractus_core.control import ControlState
from fractus_core.control.events import Event, ModeChangeBegan, ModeChangeEnded
from fractus_core.control.state import FlightMode, TaskKind

from fractus_services.errors import AutopilotError
from fractus_services.mobility.autopilot import Approach, Autopilot, Permit, always

log = logging.getLogger(__name__)

RETRY_S = 0.5
MAX_RETURN_TRIES = 6
"""How many times the autopilot may refuse to turn home; after that the drone lands where it is."""
SETTLE_TIMEOUT_S = 10.0
BRAKE_TIMEOUT_S, BRAKE_AGAIN_S = 8.0, 0.1
SETTLED_MPS = 0.2
"""Well below the speed at which the policy engine takes a drone to stand."""


class ModeController:
    """Changes modes and brakes; control is told of each change, so that it is not taken for a pilot's.

    Args:
        autopilot: the link.
        state: of control, at any moment.
        dispatch: tells control.
    """

    def __init__(
        self, autopilot: Autopilot, state: Callable[[], ControlState], dispatch: Callable[[Event], object]
    ) -> None:
        self._autopilot = autopilot
        self._state = state
        self._dispatch = dispatch

    async def change_mode(self, mode: FlightMode, permit: Permit = always) -> None:
        """Change the flight mode.

        Raises:
            AutopilotError: it does not.
        """
        permit()
        before = self._state().expected_mode
        if self._autopilot.vehicle.mode == mode and before == mode:
            return
        done = refused = False
        self._dispatch(ModeChangeBegan(mode))
        try:
            await self._autopilot.set_mode(mode, permit)
            done = True
        except AutopilotError as error:
            refused = error.refused
            raise
        finally:
            self._dispatch(ModeChangeEnded(mode, before, done, refused))

    async def enter_guided(self, permit: Permit = always) -> None:
        """Change to the mode in which the autopilot obeys.

        Raises:
            AutopilotError: it does not.
        """
        await self.change_mode(self._autopilot.stack.guided, permit)

    async def hold(self, permit: Permit = always) -> None:
        """Brake and hover.

        Raises:
            AutopilotError: the mode cannot be changed.
        """
        permit()
        self._autopilot.stop()
        await self.enter_guided(permit)
        self._autopilot.stop()

    async def settle(self) -> None:
        """Keep braking until the drone stands: a single velocity setpoint times out in the autopilot."""
        autopilot = self._autopilot
        deadline = autopilot.now + SETTLE_TIMEOUT_S
        while self._state().motion is None and autopilot.vehicle.mode.commanded and autopilot.now < deadline:
            speeds = autopilot.vehicle.speed_mps, abs(autopilot.vehicle.down_mps)
            if autopilot.at_rest and max(speeds) < SETTLED_MPS:
                return
            autopilot.stop()
            await asyncio.sleep(BRAKE_AGAIN_S / autopilot.pace)

    async def disarm(self) -> bool:
        """Stop the motors; False when the autopilot refuses, as it does in the air."""
        try:
            await self._autopilot.disarm()
        except AutopilotError as error:
            if error.link:
                raise
            return False
        return True

    async def carry_out(self, kind: TaskKind, wanted: Callable[[], bool], approach: Approach) -> None:
        """Do what the system wants, however often the link fails: hover, or bring the drone to the ground.

        Args:
            kind: what.
            wanted: whether the system still has the drone.
            approach: flies the way home.
        """
        vehicle, tries, refused = self._autopilot.vehicle, 0, False
        while (vehicle.armed or self._state().starting_motors) and wanted():
            try:
                if self._state().starting_motors:
                    await self._autopilot.update(RETRY_S)
                    continue
                if kind is TaskKind.HOVER:
                    await self._hover()
                    return
                if (vehicle.standing or not vehicle.in_air) and not refused:
                    refused = not await self.disarm()
                else:
                    await self._come_down(kind, tries, wanted, approach)
            except AutopilotError as error:
                tries += 0 if error.link else 1
                log.warning("modes: the autopilot does not follow yet (task=%s, error=%s)", kind.value, error)
            await asyncio.sleep(RETRY_S)

    async def _come_down(self, kind: TaskKind, tries: int, wanted: Callable[[], bool], approach: Approach) -> None:
        """Land here, or bring the drone home: by the autopilot's own doing, where that has begun, or else by ours first."""
        vehicle = self._autopilot.vehicle
        expected = self._state().expected_mode == vehicle.mode
        if kind is TaskKind.LAND or not vehicle.mode.comes_down or not expected:
            await self._brake(wanted)
            mode = self._autopilot.stack.land
            if tries < MAX_RETURN_TRIES:
                mode = await approach(kind, wanted, tries)
            await self.change_mode(mode, lambda: _check(wanted))
        while vehicle.armed and vehicle.mode.comes_down:
            await self._autopilot.update(1.0)

    async def _brake(self, wanted: Callable[[], bool]) -> None:
        """Bring the drone to rest where that is ours to do, so that it turns home on the spot and not in a wide arc."""
        autopilot, vehicle = self._autopilot, self._autopilot.vehicle
        deadline = autopilot.now + BRAKE_TIMEOUT_S
        autopilot.stop()
        while wanted() and vehicle.in_air and vehicle.mode.commanded and autopilot.now < deadline:
            if autopilot.at_rest or not vehicle.position_fresh(autopilot.now):
                return
            autopilot.stop()
            await autopilot.update(BRAKE_AGAIN_S / autopilot.pace)

    async def _hover(self) -> None:
        """Hold at once, and again when a takeoff under way gets off the ground."""
        await self.hold()
        while self._autopilot.vehicle.armed and not self._autopilot.vehicle.in_air:
            await self._autopilot.update(RETRY_S)
        if self._autopilot.vehicle.armed:
            await self.hold()
            await self.settle()


def _check(wanted: Callable[[], bool]) -> None:
    if not wanted():
        raise AutopilotError("the system has lost the control of the drone")

"""What others do to the drone: it appears, arms, lands, changes its mode; and who has it then."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import replace

from fractus_services.errors import AutopilotError
from fractus_services.mobility.authority.control import Control
from fractus_services.mobility.authority.journal import Mission
from fractus_services.mobility.mavlink.failsafes import BEING_SET, configure
from fractus_services.mobility.mavlink.flight_stack import FlightMode, ModeKind

log = logging.getLogger(__name__)

RETRY_S, MOST_RETRY_S = 0.5, 30.0

SAID_S = 3.0
"""A mode change this soon after the autopilot spoke of a failsafe is the failsafe's."""


class Observer:
    """Follows the autopilot's heartbeats and decides between failsafe, human pilot and our own doing.

    Args:
        control: the state machine that takes the consequences.
    """

    def __init__(self, control: Control) -> None:
        self._control = control
        self._preparing: asyncio.Task[None] | None = None

    def found(self) -> None:
        """The autopilot is there, for the first time or again."""
        checked, flying = self._control.checked, self._control.autopilot.vehicle.armed
        self._control.checked = replace(checked, problem=BEING_SET) if flying and checked is not None else None
        self._control.decided = False
        self._resume()
        self._control.decided = True
        self._control.tasks.drop(self._preparing)
        self._preparing = self._control.tasks.spawn(self._prepare())

    async def _prepare(self) -> None:
        """Set the failsafes; again, while nothing flies, as long as they are not verified: a message may have been lost."""
        autopilot, again_s = self._control.autopilot, RETRY_S
        while autopilot.found:
            if autopilot.connected and self._unverified():
                try:
                    await autopilot.set_rates(flying=autopilot.vehicle.armed)
                    self._control.checked = await configure(
                        autopilot, flying=autopilot.vehicle.armed, before=self._control.checked
                    )
                    self._control.wake()
                    if autopilot.vehicle.home is None:
                        await self._control.tasks.attempt(autopilot.ask_home)
                except AutopilotError as error:
                    log.warning("cannot prepare the autopilot yet: %s", error)
                except Exception:
                    log.exception("preparing the autopilot failed; it is tried again")
                else:
                    again_s = min(2 * again_s, MOST_RETRY_S)
            else:
                again_s = RETRY_S
            await asyncio.sleep(again_s)

    def _unverified(self) -> bool:
        checked, idle = self._control.checked, not self._control.autopilot.vehicle.armed
        if checked is None or checked.problem == BEING_SET:
            return True
        return bool(checked.problem) and idle and not self._control.modes.preparing

    def _resume(self) -> None:
        """Decide who has a vehicle that was there before us, or comes back from a broken link."""
        vehicle = self._control.autopilot.vehicle
        mission = self._control.journal.flying
        if self._control.was_armed is None:
            self._control.was_armed = vehicle.armed
        lease = self._control.lease
        if lease is not None and (lease.granted or self._control.constraints is not None):
            return
        self._control.modes.expected = vehicle.mode
        if vehicle.armed and self._control.authority == "pilot":
            return
        if not vehicle.armed:
            if mission is not None and mission.flown and not mission.outcome:
                self._control.begin_grace(mission, "driver lost")
            return
        if not vehicle.mode.commanded and (mission is None or not vehicle.mode.comes_down):
            self._pilot(f"is flying in {vehicle.mode.name}")
        elif mission is None:
            self._control.authority = "system"
            self._control.note("returnToLaunch", "system", "found the drone armed, and no mission", kind="takeover")
            self._control.start("returnToLaunch")
        elif vehicle.mode.comes_down:
            self._control.authority, self._control.homeward = "system", True
            if not mission.outcome:
                mission.outcome = "failed: the autopilot flew home by itself while the mobility service was away"
                self._control.journal.save_soon()
            self._control.note("homeward", "system", f"found the drone in {vehicle.mode.name}", kind="takeover")
            self._control.system = self._control.tasks.spawn(
                self._control.act("land" if vehicle.mode.kind is ModeKind.LANDING else "returnToLaunch")
            )
        else:
            self._control.authority = "system"
            self._control.note("hover", "system", "found the drone in the air", kind="takeover")
            self._take_back(mission)

    def _take_back(self, mission: Mission) -> None:
        """Hover and wait for the driver of a mission that goes on; fly home otherwise."""
        if mission.outcome or self._control.mission_grant is None:
            self._revoke_missing(mission)
            self._control.start("returnToLaunch")
        else:
            self._control.start("hover")
            self._control.begin_grace(mission, "driver lost")

    def _revoke_missing(self, mission: Mission) -> None:
        if not mission.outcome:
            mission.outcome = "revoked: the grant was removed"
            self._control.journal.save_soon()

    def heartbeat(self) -> None:
        """Look at mode and arming after each heartbeat."""
        vehicle = self._control.autopilot.vehicle
        if self._control.was_armed is None:
            return
        if vehicle.armed != self._control.was_armed:
            self._control.was_armed = vehicle.armed
            self._armed() if vehicle.armed else self._landed()
        if (
            vehicle.armed
            and not self._control.modes.changing
            and self._control.modes.expected is not None
            and vehicle.mode != self._control.modes.expected
        ):
            self._foreign_mode(vehicle.mode)
        if not vehicle.armed and not self._control.modes.changing:
            self._control.modes.expected = vehicle.mode

    def _armed(self) -> None:
        if self._control.authority != "driver" and not self._control.modes.arming:
            self._pilot("armed the drone")
        self._control.tasks.spawn(self._control.tasks.attempt(self._control.autopilot.set_rates, flying=True))

    def _landed(self) -> None:
        """The motors stopped."""
        mission = self._control.journal.flying
        self._control.tasks.drop(self._control.system)
        self._control.homeward = False
        if self._control.authority == "pilot" and mission is not None and mission.flown and not mission.outcome:
            mission.outcome = "failed: a human pilot took the drone and landed it"
        if self._control.lease is None or not self._control.lease.granted:
            self._control.authority = "system"
            if mission is None or mission.outcome:
                self._control.journal.active = None
        self._control.note("landed", self._control.controller, "the motors are stopped")
        self._control.journal.save_soon()
        self._control.tasks.spawn(self._control.tasks.attempt(self._control.autopilot.set_rates, flying=False))
        self._control.wake()

    def _foreign_mode(self, mode: FlightMode) -> None:
        """Somebody else changed the mode: the autopilot's own failsafe, or a human pilot."""
        vehicle = self._control.autopilot.vehicle
        self._control.modes.expected = mode
        recent = self._control.autopilot.now - vehicle.failsafe_text_at < SAID_S
        said = vehicle.failsafe_text if recent else ""
        if (vehicle.failsafe or said) and mode.comes_down and self._control.authority != "pilot":
            reason = f"the autopilot's own failsafe took the drone ({said or mode.name})"
            self._control.note(mode.name, "system", reason, "AutopilotFailsafe", kind="takeover")
            mission = self._control.journal.flying
            if mission is not None and not mission.outcome:
                mission.outcome = f"failed: {reason}"
                self._control.journal.save_soon()
            self._control.lose(reason)
            self._control.authority, self._control.homeward = "system", True
            self._control.tasks.drop(self._control.system)
            self._control.system = self._control.tasks.spawn(
                self._control.act("land" if mode.kind is ModeKind.LANDING else "returnToLaunch")
            )
        elif self._control.authority == "pilot" and mode.commanded and self._control.journal.flying is not None:
            self._control.note("hover", "system", "the pilot handed the drone back", kind="takeover")
            self._control.authority = "system"
            self._take_back(self._control.journal.flying)
        else:
            self._pilot(f"changed the mode to {mode.name}")

    def _pilot(self, what: str) -> None:
        """A human pilot has the drone: applications lose it at once, and we keep our hands off."""
        reason = f"a human pilot {what}"
        log.warning("%s", reason)
        if self._control.authority != "pilot":
            self._control.note("pilot", "pilot", reason, "PilotTookOver", kind="takeover")
        self._control.tasks.drop(self._control.system)
        self._control.homeward = False
        self._control.lose(reason)
        self._control.authority = "pilot"

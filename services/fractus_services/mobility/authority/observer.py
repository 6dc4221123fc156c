"""The autopilot's comings and goings: control is told of them, and the failsafes are set."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import replace

from fractus_core.control.events import Heartbeat, VehicleFound
from fractus_core.policy.decision_types import Verdict

from fractus_services.errors import AutopilotError
from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.authority.control import Control
from fractus_services.mobility.authority.home import home_moved, keep_home
from fractus_services.mobility.autopilot import BEING_SET, Failsafes, Fence

log = logging.getLogger(__name__)

RETRY_S, MAX_RETRY_S = 0.5, 30.0
VERIFY_S = 10.0
"""In flight the failsafes and the fence are read again after this time: the news of a change by another station may be lost."""

UNVERIFIED_TIMEOUT_S = 60.0
"""How long a flying vehicle that is heard may leave open whether its failsafes still hold; then the system brings it home."""


class Observer:
    """Follows the autopilot's link, heartbeats and parameters.

    Args:
        control: decides what they mean.
        failsafes: set when the autopilot is there, and kept in flight.
        fence: the vehicle's own, kept in flight.
        limit_return: lets the autopilot fly home no higher and no faster than a grant allows, as it is by now.
    """

    def __init__(
        self,
        control: Control,
        failsafes: Failsafes,
        fence: Fence,
        limit_return: Callable[[ActiveGrant], Awaitable[tuple[str, ...]]],
    ) -> None:
        self._control = control
        self._failsafes = failsafes
        self._fence = fence
        self._limit_return = limit_return
        self._preparing: asyncio.Task[None] | None = None
        self._changed = asyncio.Event()
        self._verified_at = -math.inf
        self._unverified_since: float | None = None
        self._moved = False
        self._keeping: asyncio.Task[None] | None = None

    def found(self) -> None:
        """The autopilot is there, for the first time or again."""
        checked, flying = self._control.checked, self._control.autopilot.vehicle.armed
        self._control.set_checked(replace(checked, problem=BEING_SET) if flying and checked is not None else None)
        self._control.dispatch(VehicleFound())
        self._control.tasks.drop(self._preparing)
        self._preparing = self._control.tasks.spawn(self._prepare())
        self._unverified_since = None

    def heartbeat(self) -> None:
        """The autopilot told its mode, and whether it is armed."""
        self._control.dispatch(Heartbeat())
        autopilot, since = self._control.autopilot, self._unverified_since
        if not autopilot.vehicle.armed:
            self._unverified_since = None
        elif since is not None and autopilot.now - since > UNVERIFIED_TIMEOUT_S:
            self._come_home(f"it has not told its parameters for {UNVERIFIED_TIMEOUT_S:.0f} s")
        self._look_after_home()

    def _look_after_home(self) -> None:
        """Set home back when another station has moved it under the flying drone."""
        control, home, known = self._control, self._control.autopilot.vehicle.home, self._moved
        self._moved = home_moved(control.state, control.autopilot.vehicle)
        if not self._moved or home is None:
            return
        if not known:
            where = f"{home.lat:.7f}, {home.lon:.7f}, {home.amsl_m:.1f} m above mean sea level"
            log.warning("observer: another station moved home (home=%s)", where)
            control.note("restored", f"set back in flight: home, which another station moved to {where}", "HomeMoved")
        if self._keeping is None or self._keeping.done():
            self._keeping = control.tasks.spawn(self._keep_home())

    async def _keep_home(self) -> None:
        try:
            await keep_home(self._control.autopilot, lambda: self._control.state)
        except AutopilotError as error:
            log.warning("observer: home is not set back yet (error=%s)", error)
            if not error.link:
                self._come_home(f"another station moved home, and it cannot be set back: {error}")

    def grant_changed(self, _old: ActiveGrant | None, _new: ActiveGrant | None) -> None:
        """Limits may be others by now: what follows for the autopilot's own way home is set at once."""
        if self._control.autopilot.vehicle.armed:
            self._changed.set()

    def parameter(self, name: str) -> None:
        """Another station changed a parameter: what follows from it holds at once, and what must not change is set back."""
        control, checked = self._control, self._control.checked
        if checked is None or not self._failsafes.concerns(name):
            return
        log.warning("observer: another station changed a parameter (name=%s)", name)
        flying = control.autopilot.vehicle.armed
        control.set_checked(self._failsafes.learn(checked) if flying else replace(checked, problem=BEING_SET))
        self._changed.set()

    async def _prepare(self) -> None:
        """Set the failsafes; again, as long as they are not verified, for a message may have been lost, and during flight."""
        autopilot, again_s = self._control.autopilot, RETRY_S
        while autopilot.found:
            if autopilot.connected and self._due():
                self._changed.clear()
                try:
                    await autopilot.set_rates(flying=autopilot.vehicle.armed)
                    await self._verify()
                    self._control.wake()
                    if autopilot.vehicle.home is None:
                        await self._control.tasks.attempt(autopilot.ask_home)
                except AutopilotError as error:
                    log.warning("observer: cannot prepare the autopilot yet (error=%s)", error)
                except Exception:
                    log.exception("observer: preparing the autopilot failed; it is tried again")
                else:
                    again_s = min(2 * again_s, VERIFY_S if autopilot.vehicle.armed else MAX_RETRY_S)
            else:
                again_s = RETRY_S
                if autopilot.connected:
                    await self._control.tasks.attempt(autopilot.set_rates, flying=autopilot.vehicle.armed)
            await asyncio.sleep(RETRY_S)
            with suppress(TimeoutError):
                async with asyncio.timeout(again_s - RETRY_S):
                    await self._changed.wait()

    async def _verify(self) -> None:
        """Set and read the failsafes; in flight the fence, too, and a drone that cannot keep them comes home."""
        control, before = self._control, self._control.checked
        flying = control.autopilot.vehicle.armed
        self._verified_at = -math.inf
        if flying and self._unverified_since is None:
            self._unverified_since = control.autopilot.now
        checked = await self._failsafes.configure(flying=flying, before=before)
        if not checked.lost:
            self._unverified_since = None
        if not flying:
            control.set_checked(checked)
            return
        refused, changed, broken = ["" if checked.lost else checked.problem], checked.changed, None
        for keep in (self._keep_return, self._keep_fence):
            # What one of them finds must not hide what the others do.
            try:
                changed += await keep()
            except AutopilotError as error:
                broken = broken or (error if error.link else None)
                refused.append("" if error.link else str(error))
            except OSError as error:
                refused.append(f"what its owner had cannot be stored: {error}")
        checked = self._failsafes.learn(checked)
        control.set_checked(checked)
        for what in changed:
            control.note("restored", f"set back in flight: {what}", "SettingChanged")
        if before is not None and before.airframe != checked.airframe:
            control.note("airframe", f"the vehicle moves otherwise by now: {checked.airframe}", "SettingChanged")
        if any(refused):
            self._come_home("; ".join(filter(None, refused)))
        if broken is not None:
            raise broken
        self._verified_at = control.autopilot.now

    def _come_home(self, why: str) -> None:
        """Take over a drone whose autopilot alone would not bring it home, unless the system does so already."""
        if not self._control.state.returning:
            reason = f"the autopilot would not keep the drone safe by itself any more: {why}"
            self._control.take_over(Verdict("takeover", None, "FailsafeLost", reason, (), "returnToLaunch"))

    async def _keep_return(self) -> tuple[str, ...]:
        control = self._control
        if control.last_grant is not None:
            for what in await self._limit_return(control.last_grant):
                control.note("limited", f"how the autopilot flies, or flies home: {what}", "ReturnLimited")
        return ()

    async def _keep_fence(self) -> tuple[str, ...]:
        return await self._fence.hold() if self._fence.raised else ()

    def _due(self) -> bool:
        control, checked = self._control, self._control.checked
        if checked is None or checked.problem == BEING_SET or self._changed.is_set():
            return True
        if control.autopilot.vehicle.armed:
            return bool(checked.problem) or control.autopilot.now - self._verified_at >= VERIFY_S
        return bool(checked.problem) and not control.state.preparing

"""Reaction to connections, heartbeats and parameters of the autopilot: set the failsafes, and verify them in flight."""

from __future__ import annotations

import asyncio
import logging
import math
from contextlib import suppress
from dataclasses import replace

from fractus_core.control.events import Heartbeat, VehicleFound
from fractus_core.policy.decision_types import Verdict

from fractus_services.errors import AutopilotError
from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.autopilot import BEING_SET, Safeguards
from fractus_services.mobility.settings import SETTINGS

log = logging.getLogger(__name__)


class VehicleObserver:
    """Dispatches vehicle events to the control state, and keeps failsafes, fence and home as the mission needs them.

    Args:
        control: Control state.
        safeguards: Failsafes, fence and return limits of the autopilot.
    """

    def __init__(self, control: ControlStore, safeguards: Safeguards) -> None:
        self._control = control
        self._safeguards = safeguards
        self._preparing: asyncio.Task[None] | None = None
        self._changed = asyncio.Event()
        self._verified_at = -math.inf
        self._unverified_since: float | None = None
        self._home_moved = False
        self._restoring_home: asyncio.Task[None] | None = None

    def found(self) -> None:
        """Handle the identification of the vehicle on a new connection."""
        status = self._control.failsafe_status
        flying = self._control.autopilot.vehicle.armed
        self._control.failsafe_status = replace(status, problem=BEING_SET) if flying and status is not None else None
        self._control.dispatch(VehicleFound())
        self._control.tasks.drop(self._preparing)
        self._preparing = self._control.tasks.spawn(self._prepare())
        self._unverified_since = None

    def heartbeat(self) -> None:
        """Handle a heartbeat, which reports the mode and the armed state."""
        self._control.dispatch(Heartbeat())
        autopilot = self._control.autopilot
        since = self._unverified_since
        if not autopilot.vehicle.armed:
            self._unverified_since = None
        elif since is not None and autopilot.now - since > SETTINGS.unverified_timeout_s:
            self._bring_home(f"it has not reported its parameters for {SETTINGS.unverified_timeout_s:.0f} s")
        self._check_home()

    def _check_home(self) -> None:
        """Restore home if another station moved it in flight."""
        control = self._control
        home = control.autopilot.vehicle.home
        was_moved = self._home_moved
        self._home_moved = control.home_moved
        if not self._home_moved or home is None:
            return
        if not was_moved:
            position = f"{home.lat:.7f}, {home.lon:.7f}, {home.amsl_m:.1f} m above mean sea level"
            log.warning("observer: home moved by another station (home=%s)", position)
            control.note(
                "restored", f"home is set back, because another station moved it in flight to {position}", "HomeMoved"
            )
        if self._restoring_home is None or self._restoring_home.done():
            self._restoring_home = control.tasks.spawn(self._restore_home())

    async def _restore_home(self) -> None:
        try:
            await self._control.restore_home()
        except AutopilotError as error:
            log.warning("observer: home not restored yet (error=%s)", error)
            if not error.link:
                self._bring_home(f"another station moved home, and it cannot be set back: {error}")

    def grant_changed(self, _old: ActiveGrant | None, _new: ActiveGrant | None) -> None:
        """Apply the limits of a changed grant to the autopilot's own return immediately."""
        if self._control.autopilot.vehicle.armed:
            self._changed.set()

    def parameter(self, name: str) -> None:
        """Handle a parameter change by another station: update the known values and restore required ones."""
        control = self._control
        status = control.failsafe_status
        if status is None or not self._safeguards.failsafes.concerns(name):
            return
        log.warning("observer: parameter changed by another station (name=%s)", name)
        flying = control.autopilot.vehicle.armed
        control.failsafe_status = (
            self._safeguards.failsafes.learn(status) if flying else replace(status, problem=BEING_SET)
        )
        self._changed.set()

    async def _prepare(self) -> None:
        """Set and verify the failsafes. Retry after failures, because messages may be lost, and repeat the verification in flight."""
        autopilot = self._control.autopilot
        retry_s = SETTINGS.verify_min_retry_s
        while autopilot.found:
            if autopilot.connected and self._verification_due():
                self._changed.clear()
                try:
                    await autopilot.set_rates(flying=autopilot.vehicle.armed)
                    await self._verify()
                    self._control.changes.notify()
                    if autopilot.vehicle.home is None:
                        await self._control.tasks.attempt(autopilot.request_home)
                except AutopilotError as error:
                    log.warning("observer: autopilot not prepared yet, retrying (error=%s)", error)
                except Exception:
                    log.exception("observer: preparing the autopilot failed, retrying")
                else:
                    limit_s = SETTINGS.verify_max_retry_s
                    if autopilot.vehicle.armed:
                        limit_s = SETTINGS.verify_interval_s
                    retry_s = min(2 * retry_s, limit_s)
            else:
                retry_s = SETTINGS.verify_min_retry_s
                if autopilot.connected:
                    await self._control.tasks.attempt(autopilot.set_rates, flying=autopilot.vehicle.armed)
            await asyncio.sleep(SETTINGS.verify_min_retry_s)
            with suppress(TimeoutError):
                async with asyncio.timeout(retry_s - SETTINGS.verify_min_retry_s):
                    await self._changed.wait()

    async def _verify(self) -> None:
        """Set the failsafes and read them back. In flight, also check the limits of the return and the fence.

        If a protection is lost in flight, the drone is brought home.
        """
        control = self._control
        before = control.failsafe_status
        flying = control.autopilot.vehicle.armed
        self._verified_at = -math.inf
        if flying and self._unverified_since is None:
            self._unverified_since = control.autopilot.now
        status = await self._safeguards.failsafes.configure(flying=flying, before=before)
        if not status.lost:
            self._unverified_since = None
        if not flying:
            control.failsafe_status = status
            return
        problems = ["" if status.lost else status.problem]
        restored = status.changed
        link_error: AutopilotError | None = None
        for keep in (self._keep_return, self._keep_fence):
            # A failure of one check must not hide the results of the others.
            try:
                restored += await keep()
            except AutopilotError as error:
                link_error = link_error or (error if error.link else None)
                problems.append("" if error.link else str(error))
            except OSError as error:
                problems.append(f"cannot store the owner's settings: {error}")
        status = self._safeguards.failsafes.learn(status)
        control.failsafe_status = status
        for setting in restored:
            control.note("restored", f"set back in flight: {setting}", "SettingChanged")
        if before is not None and before.airframe != status.airframe:
            control.note("airframe", f"the vehicle's flight parameters changed: {status.airframe}", "SettingChanged")
        if any(problems):
            self._bring_home("; ".join(filter(None, problems)))
        if link_error is not None:
            raise link_error
        self._verified_at = control.autopilot.now

    def _bring_home(self, problem: str) -> None:
        """Take over the drone, because its failsafes may not bring it home.

        Do nothing if the system already flies it home.
        """
        if not self._control.state.returning:
            reason = f"the autopilot's own failsafes no longer protect the drone: {problem}"
            self._control.take_over(Verdict("takeover", None, "FailsafeLost", reason, (), "returnToLaunch"))

    async def _keep_return(self) -> tuple[str, ...]:
        control = self._control
        if control.last_grant is not None:
            for setting in await self._safeguards.limit_return(control.last_grant):
                control.note("limited", f"flight and return of the autopilot: {setting}", "ReturnLimited")
        return ()

    async def _keep_fence(self) -> tuple[str, ...]:
        return await self._safeguards.fence.hold() if self._safeguards.fence.raised else ()

    def _verification_due(self) -> bool:
        control = self._control
        status = control.failsafe_status
        if status is None or status.problem == BEING_SET or self._changed.is_set():
            return True
        if control.autopilot.vehicle.armed:
            return bool(status.problem) or control.autopilot.now - self._verified_at >= SETTINGS.verify_interval_s
        return bool(status.problem) and not control.state.preparing

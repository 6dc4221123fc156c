"""Arming: the motors start only with every failsafe in place and while the caller has control."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import AsyncGenerator, Callable

from fractus_core.control import Mission
from fractus_core.control.events import ArmingPrepared, ArmingRequested, MotorStart
from fractus_core.control.state import ended_refusal
from fractus_core.geo import LocalFrame

from fractus_services.errors import AutopilotError, PreconditionFailed, Refused, Unavailable
from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.autopilot import BEING_SET, FailsafeStatus, Permit, Safeguards
from fractus_services.mobility.settings import SETTINGS

_TRANSIENT_CODES = frozenset(
    {"NotReady", "PositionUnknown", "LinkTooSlow", "FailsafesNotVerified", "FenceNotRaised", "ReturnNotLimited"}
)

log = logging.getLogger(__name__)


class Arming:
    """Arms the drone.

    Args:
        control: Control state.
        safeguards: Failsafes, fence and return limits of the autopilot.
    """

    def __init__(self, control: ControlStore, safeguards: Safeguards) -> None:
        self._control = control
        self._safeguards = safeguards

    async def arm(
        self, grant: ActiveGrant, permit: Permit, judge: Callable[[], object], patience_s: float
    ) -> AsyncGenerator[str, None]:
        """Arm in GUIDED, unless the drone is armed already. Retry transient failures.

        Attempts are exclusive. Each attempt is completed even if the caller cancels, so that no drone stays armed without a
        caller.

        Args:
            grant: Grant of the flight.
            permit: Raises if the caller may no longer arm.
            judge: Raises if policies forbid arming. It is called before each attempt.
            patience_s: Seconds for which the caller waits.

        Yields:
            The reason why the drone is not armed yet.

        Raises:
            Refused: A failsafe is not verified, the audit log or the journal cannot be written, or the caller may no longer
                arm.
            AutopilotError: The autopilot refused.
        """
        control = self._control
        until = control.autopilot.now + patience_s
        while True:
            try:
                judge()
                await control.tasks.complete(self._arm_exclusively(grant, permit))
            except (AutopilotError, Refused) as error:
                if not _is_transient(error) or control.autopilot.now + SETTINGS.arming_retry_s > until:
                    raise
                log.warning("arming: attempt failed, retrying (identity=%s error=%s)", grant.identity, error)
                yield str(error)
            else:
                return
            await asyncio.sleep(SETTINGS.arming_retry_s)

    async def _arm_exclusively(self, grant: ActiveGrant, permit: Permit) -> None:
        """Arm the drone. Only one caller at a time can do this.

        Otherwise a caller could still be preparing to arm a drone that another caller has armed and that already flies.
        """
        async with self._control.autopilot.starting:
            permit()
            if not self._control.autopilot.vehicle.armed:
                await self._arm(self._control.latest(grant), permit)

    async def _arm(self, grant: ActiveGrant, permit: Permit) -> None:
        self._require_verified()
        self._require_components(grant)
        autopilot = self._control.autopilot
        if unready := autopilot.vehicle.arming_refusal(autopilot.now):
            raise PreconditionFailed("NotReady", f"the autopilot is not ready to arm: {unready}")
        mission = self._control.mission(grant)
        if mission.outcome is not None:
            raise PreconditionFailed(*ended_refusal(mission.outcome))
        home = self._home_of(grant, mission)
        self._control.dispatch(ArmingRequested(grant.key, grant.identity, home))
        failure = await self._control.save(timeout_s=SETTINGS.arming_timeout_s)
        if failure:
            raise PreconditionFailed("JournalUnavailable", failure)
        permit()
        self._control.dispatch(ArmingPrepared(begins=True))
        try:
            status = await self._prepare_return(grant, home)

            def still_permitted() -> None:
                permit()
                self._require_verified(status)
                self._require_components(grant)

            still_permitted()
            await self._start(home, still_permitted)
        finally:
            self._control.dispatch(ArmingPrepared(begins=False))

    async def _start(self, home: tuple[float, float, float], permit: Permit) -> None:
        """Start the motors. Stop them again if a later step fails before the drone flies."""
        autopilot = self._control.autopilot
        self._control.dispatch(MotorStart(begins=True))
        unanswered = False
        try:
            await self._control.modes.change_mode(autopilot.stack.guided, permit)
            try:
                unanswered = True
                await autopilot.arm(permit)
                deadline = autopilot.now + SETTINGS.arming_timeout_s
                while not autopilot.vehicle.armed:
                    if autopilot.now > deadline:
                        raise AutopilotError("the autopilot acknowledged arming but did not arm")
                    await autopilot.update(SETTINGS.arming_update_timeout_s)
                unanswered = False
                await autopilot.set_home(*home)
                await self._control.tasks.attempt(autopilot.request_home)
                permit()
            except Exception as error:
                unanswered = unanswered and not (isinstance(error, AutopilotError) and error.refused)
                if not autopilot.vehicle.in_air:
                    await self._control.tasks.attempt(autopilot.disarm)
                raise
        finally:
            self._control.dispatch(MotorStart(begins=False, unanswered=unanswered))

    async def _prepare_return(self, grant: ActiveGrant, home: tuple[float, float, float]) -> FailsafeStatus:
        """Choose the autopilot's return mode, raise its fence around the mission, and read the altitude of its return.

        A vehicle records its path from the position where it armed. If this position is not home, the vehicle must not
        return on the path.

        Returns:
            The failsafes that were verified for this flight. If the failsafes are set again later, arming is refused.
        """
        at_home = self._control.autopilot.vehicle.distance_m(home[0], home[1]) <= SETTINGS.at_home_m
        status = self._require_verified()
        status = self._update_status(status, await self._safeguards.failsafes.choose_return(status, retrace=at_home))
        try:
            async with asyncio.timeout(SETTINGS.fence_timeout_s):
                await self._safeguards.fence.raise_around(grant.spec, retraces=self._control.retraces)
        except (AutopilotError, OSError) as error:
            problem = str(error) or f"timeout after {SETTINGS.fence_timeout_s:.0f} s"
            reason = f"the vehicle's own fence cannot be raised around the operation area: {problem}"
            raise PreconditionFailed("FenceNotRaised", reason) from error
        self._require_verified(status)
        try:
            lowered = await self._safeguards.limit_return(self._control.latest(grant))
        except (AutopilotError, OSError) as error:
            reason = f"cannot limit speed and altitude of the autopilot's return: {error}"
            raise PreconditionFailed("ReturnNotLimited", reason) from error
        if lowered or not self._safeguards.fence.missing:
            status = self._update_status(status, await self._safeguards.failsafes.learn_return(status))
        return status

    def _update_status(self, before: FailsafeStatus, after: FailsafeStatus) -> FailsafeStatus:
        """Store an updated status, unless the failsafes were verified again meanwhile."""
        if self._control.failsafe_status is before:
            self._control.failsafe_status = after
        return self._require_verified(after)

    def _require_verified(self, chosen: FailsafeStatus | None = None) -> FailsafeStatus:
        """Return the failsafe status if the drone may arm with it.

        Arming requires verified failsafes, a fast link and a working audit log. If `chosen` is specified, it must still
        be the current status.

        Raises:
            PreconditionFailed: One of these conditions is not met.
            Unavailable: The service is stopping.
        """
        if self._control.stopping:
            raise Unavailable("ServiceStopping", "the mobility service is stopping; arm again when it has started")
        status = self._control.failsafe_status
        if status is None or status.problem or (chosen is not None and status is not chosen):
            problem = (status.problem if status is not None else "") or BEING_SET
            raise PreconditionFailed("FailsafesNotVerified", f"the autopilot's failsafes are not verified: {problem}")
        if self._control.autopilot.link_problem:
            raise PreconditionFailed("LinkTooSlow", self._control.autopilot.link_problem)
        if self._control.audit.failure:
            raise PreconditionFailed("AuditUnavailable", self._control.audit.failure)
        return status

    def _require_components(self, grant: ActiveGrant) -> None:
        """Require that the mission may begin.

        Raises:
            PreconditionFailed: Components for which the application waits are not ready.
        """
        if awaited := self._control.awaited(grant.key):
            raise PreconditionFailed("NotReady", awaited)

    def _home_of(self, grant: ActiveGrant, mission: Mission) -> tuple[float, float, float]:
        """Return the home of the mission: where it armed for its first takeoff.

        If the drone lands on the way and arms again, home does not move. If the previous attempt did not lead to a
        flight, home is the current position. The drone may have been carried since, or its position estimate may have
        become more accurate.
        """
        vehicle = self._control.autopilot.vehicle
        if vehicle.lat is None or vehicle.lon is None:
            raise PreconditionFailed("PositionUnknown", "the position is not known yet")
        origin = mission.home if mission.flown else None
        lat, lon, amsl_m = origin or (vehicle.lat, vehicle.lon, vehicle.amsl_m)
        base = grant.spec.home or grant.spec.depot
        if base is not None:
            distance_m = math.hypot(*LocalFrame(base.lat, base.lon).xy(lat, lon))
            if distance_m > SETTINGS.max_home_distance_m:
                raise PreconditionFailed(
                    "NotAtHome", f"the drone would return to a place {distance_m:.0f} m away from the home of its grant"
                )
        return lat, lon, amsl_m


def _is_transient(error: AutopilotError | Refused) -> bool:
    """Return True if the next attempt may succeed without intervention."""
    return isinstance(error, AutopilotError | Unavailable) or error.verdict.code in _TRANSIENT_CODES

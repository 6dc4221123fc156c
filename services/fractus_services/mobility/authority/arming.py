"""Starting the motors: only with every failsafe in place, and only while the caller may."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import AsyncGenerator, Awaitable, Callable

from fractus_core.control import Mission
from fractus_core.control.events import ArmingPrepared, ArmingRequested, MotorStart
from fractus_core.control.state import ended_refusal
from fractus_core.geo import LocalFrame

from fractus_services.errors import AutopilotError, PreconditionFailed, Refused, Unavailable
from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.authority.control import Control
from fractus_services.mobility.autopilot import BEING_SET, Checked, Failsafes, Fence, Permit

ARMING_TIMEOUT_S = 3.0
AGAIN_S = 2.0
WAIT_S = 0.5
FENCE_TIMEOUT_S = 45.0
HOME_M = 5.0
STRAY_M = 50.0
"""A drone that stands further than this from the home of its grant would be brought to the wrong place."""

_PASSING = frozenset(
    {"NotReady", "PositionUnknown", "LinkTooSlow", "FailsafesNotVerified", "FenceNotRaised", "ReturnNotLimited"}
)

log = logging.getLogger(__name__)


class Arming:
    """Starts the motors.

    Args:
        control: the drone.
        failsafes: the autopilot's own, one by one.
        fence: the vehicle's own.
        limit_return: lets the autopilot fly home no higher and no faster than a grant allows.
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

    async def arm(
        self, grant: ActiveGrant, permit: Permit, judge: Callable[[], object], patience_s: float
    ) -> AsyncGenerator[str, None]:
        """Arm in GUIDED, unless it is armed by then; one caller at a time. What may pass is tried again.

        Each try goes on to its end when the caller hangs up, so that nothing stays armed that no one asks for.

        Args:
            grant: the grant to fly under.
            permit: raises when the caller may not arm any more.
            judge: raises when policies forbid it; asked before each try.
            patience_s: how long the caller waits.

        Yields:
            Why the drone is not armed yet.

        Raises:
            Refused: a failsafe is not verified, audit log or journal cannot be written, or the caller may no more.
            AutopilotError: the autopilot refuses.
        """
        control = self._control
        until = control.autopilot.now + patience_s
        while True:
            try:
                judge()
                await control.tasks.complete(self._in_turn(grant, permit))
            except (AutopilotError, Refused) as error:
                if not _passing(error) or control.autopilot.now + AGAIN_S > until:
                    raise
                log.warning("arming: not yet, trying again (identity=%s, error=%s)", grant.identity, error)
                yield str(error)
            else:
                return
            await asyncio.sleep(AGAIN_S)

    async def _in_turn(self, grant: ActiveGrant, permit: Permit) -> None:
        """Arm when no one else does: what is prepared on the ground must not be prepared under a drone that flies."""
        async with self._control.autopilot.starting:
            permit()
            if not self._control.autopilot.vehicle.armed:
                await self._arm(grant, permit)

    async def _arm(self, grant: ActiveGrant, permit: Permit) -> None:
        self._check()
        autopilot = self._control.autopilot
        if unready := autopilot.vehicle.unready(autopilot.now):
            raise PreconditionFailed("NotReady", f"the autopilot is not ready to arm: {unready}")
        mission = self._control.mission(grant)
        if mission.outcome is not None:
            raise PreconditionFailed(*ended_refusal(mission.outcome))
        home = self._home_of(grant, mission)
        self._control.dispatch(ArmingRequested(grant.key, grant.identity, home))
        failure = await self._control.save(timeout_s=ARMING_TIMEOUT_S)
        if failure:
            raise PreconditionFailed("JournalUnavailable", failure)
        permit()
        self._control.dispatch(ArmingPrepared(begins=True))
        try:
            checked = await self._prepare_ways_home(grant, home)

            def still() -> None:
                permit()
                self._check(checked)

            still()
            await self._start(home, still)
        finally:
            self._control.dispatch(ArmingPrepared(begins=False))

    async def _start(self, home: tuple[float, float, float], permit: Permit) -> None:
        """Start the motors; stop them again when anything fails before the drone flies."""
        autopilot, modes = self._control.autopilot, self._control.modes
        self._control.dispatch(MotorStart(begins=True))
        unanswered = False
        try:
            await modes.enter_guided(permit)
            try:
                unanswered = True
                await autopilot.arm(permit)
                deadline = autopilot.now + ARMING_TIMEOUT_S
                while not autopilot.vehicle.armed:
                    if autopilot.now > deadline:
                        raise AutopilotError("the autopilot accepted to arm and did not")
                    await autopilot.update(WAIT_S)
                unanswered = False
                await autopilot.set_home(*home)
                await self._control.tasks.attempt(autopilot.ask_home)
                permit()
            except Exception as error:
                unanswered = unanswered and not (isinstance(error, AutopilotError) and error.refused)
                if not autopilot.vehicle.in_air:
                    await self._control.tasks.attempt(autopilot.disarm)
                raise
        finally:
            self._control.dispatch(MotorStart(begins=False, unanswered=unanswered))

    async def _prepare_ways_home(self, grant: ActiveGrant, home: tuple[float, float, float]) -> Checked:
        """Choose how the autopilot comes home by itself, raise its own fence around the mission, and learn how high it returns.

        A vehicle remembers its path from where it was armed last: armed elsewhere than at home, it must not go back on it.

        Returns:
            The failsafes to arm with; others that are set meanwhile were not chosen for this flight.
        """
        at_home = self._control.autopilot.vehicle.distance_m(home[0], home[1]) <= HOME_M
        checked = self._check()
        checked = self._learnt(checked, await self._failsafes.choose_return(checked, retrace=at_home))
        try:
            async with asyncio.timeout(FENCE_TIMEOUT_S):
                await self._fence.raise_around(grant.spec, retraces=self._control.retraces)
        except (AutopilotError, OSError) as error:
            said = str(error) or f"it takes longer than {FENCE_TIMEOUT_S:.0f} s"
            why = f"the vehicle's own fence cannot be raised around the operation area: {said}"
            raise PreconditionFailed("FenceNotRaised", why) from error
        self._check(checked)
        try:
            lowered = await self._limit_return(grant)
        except (AutopilotError, OSError) as error:
            why = f"the autopilot would not fly, or fly home, as it must: {error}"
            raise PreconditionFailed("ReturnNotLimited", why) from error
        if lowered or not self._fence.missing:
            checked = self._learnt(checked, await self._failsafes.learn_return(checked))
        return checked

    def _learnt(self, before: Checked, after: Checked) -> Checked:
        """Take over what is known about the failsafes by now, unless they were set again meanwhile."""
        if self._control.checked is before:
            self._control.set_checked(after)
        return self._check(after)

    def _check(self, chosen: Checked | None = None) -> Checked:
        """The failsafes, if they are verified, and are those that were chosen."""
        checked = self._control.checked
        if checked is None or checked.problem or (chosen is not None and checked is not chosen):
            why = (checked.problem if checked is not None else "") or BEING_SET
            raise PreconditionFailed("FailsafesNotVerified", f"the autopilot's failsafes are not verified: {why}")
        if self._control.autopilot.link_problem:
            raise PreconditionFailed("LinkTooSlow", self._control.autopilot.link_problem)
        if self._control.audit.failure:
            raise PreconditionFailed("AuditUnavailable", self._control.audit.failure)
        return checked

    def _home_of(self, grant: ActiveGrant, mission: Mission) -> tuple[float, float, float]:
        """Home is where the mission took off first: landing on the way and arming again does not move it.

        A drone that was carried away, or whose estimate has settled, after an attempt that came to nothing begins where it stands.
        """
        vehicle = self._control.autopilot.vehicle
        if vehicle.lat is None or vehicle.lon is None:
            raise PreconditionFailed("PositionUnknown", "the position is not known yet")
        began = mission.home if mission.flown else None
        lat, lon, amsl_m = began or (vehicle.lat, vehicle.lon, vehicle.amsl_m)
        base = grant.spec.home or grant.spec.depot
        if base is not None:
            away = math.hypot(*LocalFrame(base.lat, base.lon).xy(lat, lon))
            if away > STRAY_M:
                raise PreconditionFailed(
                    "NotAtHome", f"the drone would return to a place {away:.0f} m away from the home of its grant"
                )
        return lat, lon, amsl_m


def _passing(error: AutopilotError | Refused) -> bool:
    """Whether the next try may succeed without anyone's doing."""
    return isinstance(error, AutopilotError | Unavailable) or error.verdict.code in _PASSING

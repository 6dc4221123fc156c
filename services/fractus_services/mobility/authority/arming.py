"""Starting the motors: only with every last line in place, and not a moment longer than somebody may."""

from __future__ import annotations

import asyncio
import math

from fractus_core.control import Mission
from fractus_core.control.events import ArmingPrepared, ArmingRequested, MotorStart
from fractus_core.geo import LocalFrame

from fractus_services.errors import AutopilotError, PreconditionFailed
from fractus_services.grants import ActiveGrant
from fractus_services.mobility.authority.control import Control
from fractus_services.mobility.mavlink.autopilot import Permit
from fractus_services.mobility.mavlink.failsafes import BEING_SET, Checked, choose_return, learn_return

ARMED_S = 3.0
WAIT_S = 0.5
FENCE_S = 15.0
HOME_M = 5.0
STRAY_M = 50.0
"""A drone that stands further than this from the home of its grant would be brought to the wrong place."""


async def arm(control: Control, grant: ActiveGrant, permit: Permit) -> None:
    """Arm in GUIDED, unless it is armed by then; one caller at a time.

    Goes on to its end when the caller hangs up, so that nothing is armed that nobody asks for.

    Args:
        control: the drone.
        grant: the grant to fly under.
        permit: raises when the caller may not arm any more.

    Raises:
        Refused: a failsafe is not verified, audit log or journal cannot be written, or the caller may no more.
        AutopilotError: the autopilot refuses.
    """
    await control.tasks.complete(_in_turn(control, grant, permit))


async def _in_turn(control: Control, grant: ActiveGrant, permit: Permit) -> None:
    """Arm when nobody else is at it: what is prepared on the ground must not be prepared under a drone that flies."""
    async with control.autopilot.starting:
        permit()
        if not control.autopilot.vehicle.armed:
            await _arm(control, grant, permit)


async def _arm(control: Control, grant: ActiveGrant, permit: Permit) -> None:
    _check(control)
    home = _home_of(control, grant, control.mission(grant))
    control.dispatch(ArmingRequested(grant.key, grant.identity, home))
    failure = await control.save(timeout_s=ARMED_S)
    if failure:
        raise PreconditionFailed("JournalUnavailable", failure)
    permit()
    control.dispatch(ArmingPrepared(begins=True))
    try:
        checked = await _prepare_ways_home(control, grant, home)

        def still() -> None:
            permit()
            _check(control, checked)

        still()
        await _start(control, home, still)
    finally:
        control.dispatch(ArmingPrepared(begins=False))


async def _start(control: Control, home: tuple[float, float, float], permit: Permit) -> None:
    """Start the motors; stop them again when anything fails before the drone flies."""
    autopilot, modes = control.autopilot, control.modes
    control.dispatch(MotorStart(begins=True))
    try:
        await modes.enter_guided(permit)
        try:
            await autopilot.arm(permit)
            deadline = autopilot.now + ARMED_S
            while not autopilot.vehicle.armed:
                if autopilot.now > deadline:
                    raise AutopilotError("the autopilot accepted to arm and did not")
                await autopilot.update(WAIT_S)
            await autopilot.set_home(*home)
            await control.tasks.attempt(autopilot.ask_home)
            permit()
        except Exception:
            if not autopilot.vehicle.in_air:
                await control.tasks.attempt(autopilot.disarm)
            raise
    finally:
        control.dispatch(MotorStart(begins=False))


async def _prepare_ways_home(control: Control, grant: ActiveGrant, home: tuple[float, float, float]) -> Checked:
    """Choose how the autopilot comes home by itself, raise its own fence around the mission, and learn how high it returns.

    A vehicle remembers its path from where it was armed last: armed elsewhere than at home, it must not go back on it.

    Returns:
        The failsafes to arm with; others that are set meanwhile were not chosen for this flight.
    """
    autopilot, vehicle = control.autopilot, control.autopilot.vehicle
    at_home = vehicle.distance_m(home[0], home[1]) <= HOME_M
    checked = _check(control)
    checked = _learnt(control, checked, await choose_return(autopilot, checked, retrace=at_home))
    try:
        async with asyncio.timeout(FENCE_S):
            await control.fence.raise_around(grant.spec, retraces=control.retraces)
    except (AutopilotError, OSError) as error:
        said = str(error) or f"it takes longer than {FENCE_S:.0f} s"
        why = f"the vehicle's own fence cannot be raised around the operation area: {said}"
        raise PreconditionFailed("FenceNotRaised", why) from error
    _check(control, checked)
    if not control.fence.missing:
        checked = _learnt(control, checked, await learn_return(autopilot, checked))
    return checked


def _learnt(control: Control, before: Checked, after: Checked) -> Checked:
    """Take over what is known about the failsafes by now, unless they were set anew meanwhile."""
    if control.checked is before:
        control.checked = after
    return _check(control, after)


def _check(control: Control, chosen: Checked | None = None) -> Checked:
    """The failsafes, if they are verified, and are those that were chosen."""
    checked = control.checked
    if checked is None or checked.problem or (chosen is not None and checked is not chosen):
        why = (checked.problem if checked is not None else "") or BEING_SET
        raise PreconditionFailed("FailsafesNotVerified", f"the autopilot's failsafes are not verified: {why}")
    if control.audit.failure:
        raise PreconditionFailed("AuditUnavailable", control.audit.failure)
    return checked


def _home_of(control: Control, grant: ActiveGrant, mission: Mission) -> tuple[float, float, float]:
    """Home is where the mission armed first: landing on the way and arming again does not move it."""
    vehicle = control.autopilot.vehicle
    if vehicle.lat is None or vehicle.lon is None:
        raise PreconditionFailed("PositionUnknown", "the position is not known yet")
    lat, lon, amsl_m = mission.home or (vehicle.lat, vehicle.lon, vehicle.amsl_m)
    base = grant.spec.home or grant.spec.depot
    if base is not None:
        away = math.hypot(*LocalFrame(base.lat, base.lon).xy(lat, lon))
        if away > STRAY_M:
            raise PreconditionFailed(
                "NotAtHome", f"the drone would return to a place {away:.0f} m away from the home of its grant"
            )
    return lat, lon, amsl_m

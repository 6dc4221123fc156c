"""The vehicle: it appears, arms, lands, changes its mode; and whose doing that is: the system's, a failsafe's or a pilot's."""

from __future__ import annotations

import math
from typing import assert_never

from fractus_core.control.actions import SaveJournal, SetStreamRates, WakeWaiters
from fractus_core.control.events import (
    Airborne,
    ArmingEvent,
    ArmingPrepared,
    ArmingRequested,
    Heartbeat,
    ModeChangeBegan,
    ModeChangeEnded,
    MotorStart,
    VehicleEvent,
    VehicleFound,
    VehicleObserved,
)
from fractus_core.control.step import DRIVER_LOST, Step
from fractus_core.control.values import Authority, FlightMode, ModeKind, OutcomeKind, TaskKind

FAILSAFE_TEXT_S = 3.0
"""A mode change this soon after the autopilot spoke of a failsafe is the failsafe's."""

CUT_S = 4.0
"""A link that was cut for so long lets the failsafe act that waits five seconds for the next heartbeat, one a second: unheard,
and cleared as soon as the companion is heard again. Nothing but the mode tells of it."""

UNCONFIRMED_S = 10.0
"""A mode, or motors, that the system asked for may show this long after the answer was given up: only the answers may have been
lost."""

ARMED_BY_OTHERS = "armed the drone"
FLEW_HOME_ALONE = "the autopilot flew home by itself while the mobility service was away"


def on_vehicle(step: Step, event: VehicleEvent) -> None:
    """What the vehicle does, or is told to do."""
    match event:
        case VehicleObserved(vehicle):
            step.state = step.state.observed(vehicle)
        case VehicleFound():
            _found(step)
            step.set(decided=True)
        case Heartbeat():
            _heartbeat(step)
        case Airborne():
            mission = step.state.mission
            if mission is not None and not mission.flown and step.state.authority is not Authority.PILOT:
                step.update_mission(mission, flown=True)
                step.act(SaveJournal())
        case ModeChangeBegan(mode):
            own, late = step.state.own_modes | {step.state.vehicle.mode, mode}, step.state.unconfirmed
            if late is not None and step.now < late[1]:
                own |= {late[0]}
            step.set(expected_mode=mode, mode_changes=step.state.mode_changes + 1, own_modes=own)
        case ModeChangeEnded(mode, before, done, refused):
            changes = max(step.state.mode_changes - 1, 0)
            step.set(mode_changes=changes, own_modes=step.state.own_modes if changes else frozenset())
            # A change that failed is not expected any more; where only the answers were lost, the vehicle may show it after all.
            if done:
                step.set(unconfirmed=None)
            elif step.state.expected_mode == mode and step.state.vehicle.mode != mode:
                step.set(expected_mode=before, unconfirmed=None if refused else (mode, step.now + UNCONFIRMED_S))
            elif not refused and step.state.expected_mode != mode and step.state.authority is Authority.SYSTEM:
                # A failsafe came between: what was sent before it was heard may take effect after it.
                step.set(unconfirmed=(mode, step.now + UNCONFIRMED_S))
        case _:
            assert_never(event)


def on_arming(step: Step, event: ArmingEvent) -> None:
    """What arming changes: the mission that is flown next, and what a heartbeat that shows running motors means."""
    match event:
        case ArmingRequested(key, identity, home):
            step.update_mission(step.mission(key, identity), home=home)
            step.set(active=key)
        case ArmingPrepared(begins):
            step.set(preparing=max(step.state.preparing + (1 if begins else -1), 0))
        case MotorStart(begins, unanswered):
            until = step.now + UNCONFIRMED_S if unanswered else -math.inf
            step.set(starting_motors=begins, start_unconfirmed_until=until)
            if not begins and step.state.vehicle.armed and step.state.armed_seen is False:
                # They run by the system's doing, whenever the heartbeat is looked at that shows it.
                step.set(armed_seen=True, armed_by_others=False)
                step.act(SetStreamRates(flying=True))
        case _:
            assert_never(event)


def _found(step: Step) -> None:
    """Decide who has a vehicle that was there before the service, or comes back from a broken link."""
    vehicle, mission, lease = step.state.vehicle, step.state.mission, step.state.lease
    if step.state.armed_seen is None:
        step.set(armed_seen=vehicle.armed)
    if lease is not None and (lease.granted or step.state.flight is not None):
        return  # the driver, or the transit for one, goes on where the link broke
    task = step.state.task if step.state.returning and step.state.expected_mode == vehicle.mode else None
    step.set(expected_mode=vehicle.mode, failsafe_seen=vehicle.failsafe)
    if vehicle.armed and step.state.authority is Authority.PILOT:
        return
    if not vehicle.armed:
        step.set(armed_by_others=False)
        if mission is not None and mission.flown and mission.outcome is None:
            step.begin_grace(mission, DRIVER_LOST)
        return
    if step.state.armed_by_others:
        step.give_to_pilot(ARMED_BY_OTHERS)
        return
    commanded, comes_down = vehicle.mode.commanded, vehicle.mode.comes_down
    if vehicle.mode.kind is ModeKind.BRAKING and vehicle.failsafe:
        step.seize(TaskKind.RETURN, "AutopilotFailsafe", "found the drone braked by a failsafe", (), OutcomeKind.FAILED)
    elif not (commanded or comes_down) or (mission is None and not commanded and not vehicle.failsafe):
        step.give_to_pilot(f"is flying in {vehicle.mode.name}")
    elif mission is None and comes_down:
        step.audit("takeover", "homeward", "system", f"found the drone in {vehicle.mode.name}, and no mission")
        step.follow_descent(_descent(vehicle.mode))
    elif mission is None:
        step.set(authority=Authority.SYSTEM)
        reason = "found the drone armed, and no mission"
        step.audit("takeover", TaskKind.RETURN.value, "system", reason)
        step.start(TaskKind.RETURN)
    elif comes_down:
        step.end_mission(mission, OutcomeKind.FAILED, FLEW_HOME_ALONE)
        step.audit("takeover", "homeward", "system", f"found the drone in {vehicle.mode.name}")
        # A return without a failsafe may be a pilot's choice.
        found = not vehicle.failsafe and (task is None or task.found)
        step.follow_descent(_descent(vehicle.mode), found=found)
    else:
        step.set(authority=Authority.SYSTEM)
        step.audit("takeover", TaskKind.HOVER.value, "system", "found the drone in the air")
        step.take_back(mission)


def _descent(mode: FlightMode) -> TaskKind:
    return TaskKind.LAND if mode.kind is ModeKind.LANDING else TaskKind.RETURN


def _heartbeat(step: Step) -> None:
    """Look at arming and mode."""
    vehicle = step.state.vehicle
    if step.state.armed_seen is None:
        return
    if vehicle.armed != step.state.armed_seen:
        step.set(armed_seen=vehicle.armed)
        if vehicle.armed:
            _armed(step)
        else:
            _disarmed(step)
    if step.state.mode_changes and not (vehicle.armed and vehicle.mode not in step.state.own_modes):
        return  # until the change is confirmed or given up, either mode is ours; a third one is not, and must not be overruled
    if not vehicle.armed:
        step.set(expected_mode=vehicle.mode)
    elif step.state.expected_mode is not None and vehicle.mode != step.state.expected_mode:
        _foreign_mode(step)
    step.set(failsafe_seen=vehicle.failsafe)


def _armed(step: Step) -> None:
    # Nothing was prepared for a flight of others: neither failsafes nor fence, home or limits. A driver on the ground loses it, too.
    state = step.state
    # In a mode of a pilot's they are a pilot's, whatever was asked for.
    late = step.now < state.start_unconfirmed_until and state.vehicle.mode.commanded
    step.set(armed_by_others=not (state.starting_motors or late), start_unconfirmed_until=-math.inf)
    if step.state.armed_by_others:
        step.give_to_pilot(ARMED_BY_OTHERS)
        step.act(SaveJournal())
    step.act(SetStreamRates(flying=True))


def _disarmed(step: Step) -> None:
    """The motors stopped; a driver that has the vehicle keeps it."""
    mission = step.state.mission
    step.stop_task()
    step.set(returning=False, unattended=0, armed_by_others=False)
    if step.state.authority is Authority.PILOT and mission is not None and mission.flown:
        mission = step.end_mission(mission, OutcomeKind.FAILED, "a human pilot took the drone and landed it")
    if not step.state.granted:
        step.set(authority=Authority.SYSTEM)
        if mission is None or mission.outcome is not None:
            step.set(active=None)
    step.audit("control", "landed", step.state.controller, "the motors are stopped")
    step.act(SaveJournal())
    step.act(SetStreamRates(flying=False))
    step.act(WakeWaiters())


def _foreign_mode(step: Step) -> None:
    """The mode was changed by others: the autopilot's own failsafe, or a human pilot, who may also hand the vehicle back."""
    state, vehicle, mission = step.state, step.state.vehicle, step.state.mission
    step.set(expected_mode=vehicle.mode)
    unconfirmed, piloted = state.unconfirmed, state.authority is Authority.PILOT
    if unconfirmed is not None and vehicle.mode == unconfirmed[0] and step.now < unconfirmed[1] and not piloted:
        step.set(unconfirmed=None)
        if vehicle.mode.comes_down and state.authority is Authority.SYSTEM and not state.returning:
            step.follow_descent(_descent(vehicle.mode))  # what asked for it is over by now
        return  # the system's own change: the autopilot obeyed, and its answers were lost
    # A failsafe stays reported for the rest of the flight: a pilot may choose the mode long after it.
    begins = vehicle.failsafe and not state.failsafe_seen
    said = vehicle.failsafe_text if step.now - vehicle.failsafe_text_at < FAILSAFE_TEXT_S else ""
    if vehicle.silent_s >= CUT_S and vehicle.mode.kind is ModeKind.RETURNING and not said:
        said = f"{vehicle.mode.name}, while the link was cut"
    failed, reason = (
        (begins or said) and not piloted,
        f"the autopilot's own failsafe took the drone ({said or vehicle.mode.name})",
    )
    if failed and vehicle.mode.kind is ModeKind.BRAKING:
        # No pilot has it, and it would hover until its battery is low.
        step.seize(TaskKind.RETURN, "AutopilotFailsafe", reason, (), OutcomeKind.FAILED)
    elif failed and vehicle.mode.comes_down:
        step.audit("takeover", vehicle.mode.name, "system", reason, "AutopilotFailsafe")
        step.end_mission(mission, OutcomeKind.FAILED, reason)
        step.lose_lease(reason)
        step.follow_descent(_descent(vehicle.mode))
    elif piloted and vehicle.mode.commanded and mission is not None and not state.armed_by_others:
        step.audit("takeover", TaskKind.HOVER.value, "system", "the pilot handed the drone back")
        step.set(authority=Authority.SYSTEM)
        step.take_back(mission)
    else:
        step.give_to_pilot(f"changed the mode to {vehicle.mode.name}")

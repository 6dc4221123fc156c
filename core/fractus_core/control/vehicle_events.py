"""Transitions for vehicle events: discovery, arming, landing, mode changes.

Each change is attributed to the system, to a failsafe of the autopilot, or to a human pilot.
"""

from __future__ import annotations

import math
from dataclasses import replace
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
from fractus_core.control.state import Authority, FlightMode, ModeKind, OutcomeKind, TaskKind
from fractus_core.control.state_update import DRIVER_LOST, POSITION_UNKNOWN, StateUpdate

FAILSAFE_TEXT_S = 3.0
"""A mode change within this many seconds after a status text about a failsafe is attributed to the failsafe."""

LINK_CUT_S = 4.0
"""Gap between received heartbeats, in seconds, after which the autopilot's GCS failsafe may have acted.

The failsafe acts when the link is cut for five seconds. The service then misses the status text of the failsafe, and
the autopilot clears the failsafe flag when the link is back. Only the mode shows that the failsafe acted.
"""

UNCONFIRMED_S = 10.0
"""Seconds for which a requested mode or motor start may still take effect after its acknowledgement timed out.

The autopilot may have accepted the request while its acknowledgements were lost.
"""

MOTORS_STOPPED = "stopped"
"""Action of the record that the motors stopped, but no landing was reported."""

STOPPED_IN_AIR = "MotorsStoppedInAir"
"""Code of this record."""

ARMED_BY_OTHERS = "armed the drone"
FLEW_HOME_ALONE = "the autopilot returned by itself while the mobility service was not running"


def on_vehicle(update: StateUpdate, event: VehicleEvent) -> None:
    """Handle a change of the vehicle, or a command of the system to the vehicle."""
    match event:
        case VehicleObserved(vehicle):
            update.state = update.state.observed(vehicle)
        case VehicleFound():
            _find_vehicle(update)
            update.set(decided=True)
        case Heartbeat():
            _on_heartbeat(update)
        case Airborne():
            mission = update.state.mission
            if mission is not None and not mission.flown and update.state.authority is not Authority.PILOT:
                update.update_mission(mission, flown=True)
                update.act(SaveJournal())
        case ModeChangeBegan(mode):
            own_modes = update.state.own_modes | {update.state.vehicle.mode, mode}
            unconfirmed = update.state.unconfirmed
            if unconfirmed is not None and update.now < unconfirmed[1]:
                own_modes |= {unconfirmed[0]}
            update.set(expected_mode=mode, mode_changes=update.state.mode_changes + 1, own_modes=own_modes)
        case ModeChangeEnded(mode, before, done, refused):
            changes = max(update.state.mode_changes - 1, 0)
            update.set(mode_changes=changes, own_modes=update.state.own_modes if changes else frozenset())
            # A failed change is no longer expected. If only its acknowledgements were lost, the vehicle may still report the mode.
            if done:
                update.set(unconfirmed=None)
            elif update.state.expected_mode == mode and update.state.vehicle.mode != mode:
                update.set(expected_mode=before, unconfirmed=None if refused else (mode, update.now + UNCONFIRMED_S))
            elif not refused and update.state.expected_mode != mode and update.state.authority is Authority.SYSTEM:
                # A failsafe changed the mode meanwhile. The autopilot may still carry out the earlier request.
                update.set(unconfirmed=(mode, update.now + UNCONFIRMED_S))
        case _:
            assert_never(event)


def on_arming(update: StateUpdate, event: ArmingEvent) -> None:
    """Handle arming: store the active mission, and who started the motors."""
    match event:
        case ArmingRequested(key, identity, home):
            update.update_mission(update.mission(key, identity), home=home)
            update.set(active=key)
        case ArmingPrepared(begins):
            update.set(preparing=max(update.state.preparing + (1 if begins else -1), 0))
        case MotorStart(begins, unanswered):
            until = update.now + UNCONFIRMED_S if unanswered else -math.inf
            update.set(starting_motors=begins, start_unconfirmed_until=until)
            if not begins and update.state.vehicle.armed and update.state.armed_seen is False:
                # The system started the motors, even if the heartbeat that reports them is handled later.
                update.set(armed_seen=True, armed_by_others=False)
                update.act(SetStreamRates(flying=True))
        case _:
            assert_never(event)


def _find_vehicle(update: StateUpdate) -> None:
    """Decide who has control authority over a vehicle found at the start of the service or after a broken link."""
    vehicle = update.state.vehicle
    mission = update.state.mission
    lease = update.state.lease
    if update.state.armed_seen is None:
        update.set(armed_seen=vehicle.armed)
    if lease is not None and (lease.granted or update.state.flight is not None):
        return  # the driver's flight or transit continues
    task = update.state.task if update.state.returning and update.state.expected_mode == vehicle.mode else None
    update.set(expected_mode=vehicle.mode, failsafe_seen=vehicle.failsafe)
    if vehicle.armed and update.state.authority is Authority.PILOT:
        return
    if not vehicle.armed:
        update.set(armed_by_others=False)
        if mission is not None and mission.flown and mission.outcome is None:
            update.begin_grace(mission, DRIVER_LOST)
        return
    if update.state.armed_by_others:
        update.give_to_pilot(ARMED_BY_OTHERS)
        return
    commanded = vehicle.mode.commanded
    comes_down = vehicle.mode.comes_down
    if vehicle.mode.kind is ModeKind.BRAKING and vehicle.failsafe:
        update.seize(
            TaskKind.RETURN,
            "AutopilotFailsafe",
            "the service found the drone stopped by a failsafe",
            (),
            OutcomeKind.FAILED,
        )
    elif not (commanded or comes_down) or (mission is None and not commanded and not vehicle.failsafe):
        update.give_to_pilot(f"is flying in {vehicle.mode.name}")
    elif mission is None and comes_down:
        update.audit(
            "takeover", "homeward", "system", f"the service found the drone in {vehicle.mode.name}, without a mission"
        )
        update.follow_descent(_descent(vehicle.mode))
    elif mission is None:
        update.set(authority=Authority.SYSTEM)
        reason = "the service found the drone armed, without a mission"
        update.audit("takeover", TaskKind.RETURN.value, "system", reason)
        update.start(TaskKind.RETURN)
    elif comes_down:
        update.end_mission(mission, OutcomeKind.FAILED, FLEW_HOME_ALONE)
        update.audit("takeover", "homeward", "system", f"the service found the drone in {vehicle.mode.name}")
        # Without a failsafe, a pilot may have chosen the return.
        by_pilot = not vehicle.failsafe and (task is None or task.begun_by_others)
        update.follow_descent(_descent(vehicle.mode), begun_by_others=by_pilot)
    else:
        update.set(authority=Authority.SYSTEM)
        update.audit("takeover", TaskKind.HOVER.value, "system", "the service found the drone in the air")
        update.take_back(mission)


def _descent(mode: FlightMode) -> TaskKind:
    return TaskKind.LAND if mode.kind is ModeKind.LANDING else TaskKind.RETURN


def _on_heartbeat(update: StateUpdate) -> None:
    """Handle changes of the armed state and of the mode."""
    vehicle = update.state.vehicle
    if update.state.armed_seen is None:
        return
    if vehicle.armed != update.state.armed_seen:
        update.set(armed_seen=vehicle.armed)
        if vehicle.armed:
            _on_armed(update)
        else:
            _on_disarmed(update)
    if update.state.mode_changes and not (vehicle.armed and vehicle.mode not in update.state.own_modes):
        # During a mode change of the system, its old and its new mode are expected. Only a third mode is handled below.
        return
    if not vehicle.armed:
        update.set(expected_mode=vehicle.mode)
    elif update.state.expected_mode is not None and vehicle.mode != update.state.expected_mode:
        _on_foreign_mode(update)
    update.set(failsafe_seen=vehicle.failsafe)


def _on_armed(update: StateUpdate) -> None:
    # The service prepares failsafes, fence, home and limits before it starts the motors. If another party started them,
    # nothing is prepared, so a driver on the ground loses control.
    state = update.state
    # In a pilot's mode, the pilot started the motors, even if the system had requested a start before.
    late = update.now < state.start_unconfirmed_until and state.vehicle.mode.commanded
    update.set(armed_by_others=not (state.starting_motors or late), start_unconfirmed_until=-math.inf)
    if update.state.armed_by_others:
        update.give_to_pilot(ARMED_BY_OTHERS)
        update.act(SaveJournal())
    update.act(SetStreamRates(flying=True))


def _on_disarmed(update: StateUpdate) -> None:
    """Handle the stop of the motors. A driver that has control keeps control."""
    mission = update.state.mission
    update.stop_task()
    update.set(returning=False, unattended=0, armed_by_others=False)
    if update.state.authority is Authority.PILOT and mission is not None and mission.flown:
        mission = update.end_mission(mission, OutcomeKind.FAILED, "a human pilot took the drone and landed it")
    if not update.state.granted:
        update.set(authority=Authority.SYSTEM)
        if mission is None or mission.outcome is not None:
            update.set(active=None)
    if update.state.vehicle.stopped_in_air:
        _record_stop_in_air(update)
    else:
        update.audit("control", "landed", update.state.controller, "the motors are stopped")
    update.act(SaveJournal())
    update.act(SetStreamRates(flying=False))
    update.act(WakeWaiters())


def _record_stop_in_air(update: StateUpdate) -> None:
    """Record that the motors stopped, but no landing was reported.

    The position is then unknown for that reason, so a mission that fails because of its unknown position gets this reason.
    """
    silent_s = update.state.vehicle.silent_s
    reason = "the motors stopped in flight; the autopilot may have restarted, or a station stopped the motors"
    if silent_s >= LINK_CUT_S:
        reason = (
            f"the motors stopped during {silent_s:.0f} s without a report of the autopilot, which was in flight before;"
            " it may have restarted or landed"
        )
    update.audit("control", MOTORS_STOPPED, update.state.controller, reason, STOPPED_IN_AIR)
    grace = update.state.grace
    if grace is not None and grace.code == POSITION_UNKNOWN:
        update.set(grace=replace(grace, reason=reason, code=STOPPED_IN_AIR))


def _on_foreign_mode(update: StateUpdate) -> None:
    """Handle a mode change by a failsafe or by a human pilot, who may also hand the vehicle back."""
    state = update.state
    vehicle = state.vehicle
    mission = state.mission
    update.set(expected_mode=vehicle.mode)
    unconfirmed = state.unconfirmed
    piloted = state.authority is Authority.PILOT
    if unconfirmed is not None and vehicle.mode == unconfirmed[0] and update.now < unconfirmed[1] and not piloted:
        update.set(unconfirmed=None)
        if vehicle.mode.comes_down and state.authority is Authority.SYSTEM and not state.returning:
            update.follow_descent(_descent(vehicle.mode))  # the task that requested this mode has ended
        return  # the system requested this mode itself, but the acknowledgements were lost
    # The failsafe flag stays set for the rest of the flight. A later mode change may therefore be caused by a pilot.
    begins = vehicle.failsafe and not state.failsafe_seen
    text = vehicle.failsafe_text if update.now - vehicle.failsafe_text_at < FAILSAFE_TEXT_S else ""
    if vehicle.silent_s >= LINK_CUT_S and vehicle.mode.kind is ModeKind.RETURNING and not text:
        text = f"{vehicle.mode.name}, while the link was cut"
    by_failsafe = (begins or text) and not piloted
    reason = f"the autopilot's own failsafe took the drone ({text or vehicle.mode.name})"
    if by_failsafe and vehicle.mode.kind is ModeKind.BRAKING:
        # Return, because no pilot has control. Without the return, the vehicle would hover until its battery is low.
        update.seize(TaskKind.RETURN, "AutopilotFailsafe", reason, (), OutcomeKind.FAILED)
    elif by_failsafe and vehicle.mode.comes_down:
        update.audit("takeover", vehicle.mode.name, "system", reason, "AutopilotFailsafe")
        update.end_mission(mission, OutcomeKind.FAILED, reason)
        update.lose_lease(reason)
        update.follow_descent(_descent(vehicle.mode))
    elif piloted and vehicle.mode.commanded and mission is not None and not state.armed_by_others:
        update.audit("takeover", TaskKind.HOVER.value, "system", "the pilot handed the drone back")
        update.set(authority=Authority.SYSTEM)
        update.take_back(mission)
    else:
        update.give_to_pilot(f"changed the mode to {vehicle.mode.name}")

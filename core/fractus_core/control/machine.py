"""State machine of control authority: `transition(state, event, now) -> (state, actions)`.

The system takes over the vehicle whenever neither a driver nor a pilot may command it. The system keeps a flying
vehicle until the vehicle is home, or until a driver or a pilot has control authority.
"""

from __future__ import annotations

from dataclasses import replace
from typing import assert_never

from fractus_core.control.actions import (
    Action,
    Brake,
    EndStream,
    HoldPosition,
    RefuseStream,
    SaveJournal,
    SendEvent,
    StopKind,
    WakeWaiters,
)
from fractus_core.control.events import (
    ArmingEvent,
    BrakeDemanded,
    ContactLost,
    ContactRestored,
    ControlReturned,
    CruiseSpeedSet,
    DriverEvent,
    DriverUnresponsive,
    Event,
    GrantChanged,
    GrantControl,
    MotionBegan,
    MotionCancelled,
    MotionEvent,
    MotionFailed,
    MotionFinished,
    MotionStopped,
    PassengerBoarded,
    PolicyEvent,
    PositionFound,
    PositionLost,
    StreamClosed,
    StreamOpened,
    SystemEvent,
    SystemFlightBegan,
    SystemFlightEnded,
    SystemTaskEnded,
    TakeoverDemanded,
    Tick,
    TourBegan,
    TourEnded,
    TourInterrupted,
    TourPointVisited,
    TransitBegan,
    TransitFailed,
    TransitRequested,
    VehicleEvent,
    WaypointsDone,
)
from fractus_core.control.state import (
    COMPLETE,
    CONTACT_LOST,
    DRIVER_LOST_CODE,
    NOTHING_FLOWN,
    ActiveFlight,
    ActiveMotion,
    Authority,
    ControlEvent,
    ControlLease,
    ControlState,
    OutcomeKind,
    StreamState,
    SystemTask,
    TaskKind,
    WaypointCounts,
    ended_refusal,
)
from fractus_core.control.state_update import DRIVER_LOST, GRANT_REMOVED, POSITION_UNKNOWN, StateUpdate
from fractus_core.control.vehicle_events import on_arming, on_vehicle
from fractus_core.exhaustive import exhaustive
from fractus_core.policy.decision_types import Takeover

TAKEOVERS: dict[Takeover, tuple[TaskKind, OutcomeKind | None]] = exhaustive(
    Takeover,
    {
        "hover": (TaskKind.HOVER, None),
        "land": (TaskKind.LAND, OutcomeKind.FAILED),
        "returnToLaunch": (TaskKind.RETURN, OutcomeKind.FAILED),
        "abort": (TaskKind.LAND_AT, OutcomeKind.REVOKED),
        "revoke": (TaskKind.RETURN, OutcomeKind.REVOKED),
    },
)
"""System task and mission outcome of each takeover that a policy can demand."""

UNATTENDED = "NoControlAuthority"
"""Code of the takeover of an armed vehicle that no party controls. Only a fault of the service leads to this state."""

MAX_UNATTENDED = 3
"""Maximum number of takeovers with the code `UNATTENDED` in one flight.

Without a maximum, a task that always fails would be restarted forever. After the last takeover, the supervisor stops
the heartbeats, and the autopilot's own failsafe brings the vehicle home.
"""

MAX_REPEATED_TAKEOVERS = 3
"""Number of takeovers in flight for one reason, without a further waypoint, at which the mission ends.

After a takeover with the action `hover`, or of a driver that hangs, the driver gets control again when it requests
control. A driver that then repeats its error would otherwise keep the vehicle in the air until its battery is empty.
"""

MAX_INTERRUPTIONS = 10
"""Number of takeovers and broken streams in flight, for any reasons, without a further waypoint, at which the mission ends.

It is higher than `MAX_REPEATED_TAKEOVERS`, because a driver may lose its connection without an error of its own.
"""

CANCELLED_DESCENT_S = 0.3
"""Seconds for which a cancelled descent continues.

If the driver's stream breaks within this time, the descent is not stopped, because the vehicle must then come down.
"""

SECOND_STREAM = "another process of this component has the control stream; end that process, or wait until it ends"
"""Reason for refusing a second stream of a driver."""

DESCENTS = frozenset({"Land", "ReturnToLaunch"})
"""Motions that end on the ground."""

TAKEOFF = "Takeoff"
"""Kind of the motion that climbs from the ground."""

CORRECTION = "Correction"
"""Kind of the motions with which the monitor flies a driver's drone back into its limits."""


def transition(state: ControlState, event: Event, now: float) -> tuple[ControlState, tuple[Action, ...]]:
    """Return the state after an event and the actions to carry out.

    Every event is defined in every state. A late event, of a lease, motion or task that has ended, changes nothing.

    Args:
        state: State before the event.
        event: The event.
        now: Monotonic seconds, not earlier than in previous events.
    """
    update = StateUpdate(state, now)
    if isinstance(event, DriverEvent):
        _on_driver(update, event)
    elif isinstance(event, MotionEvent):
        _on_motion(update, event)
    elif isinstance(event, PolicyEvent):
        _on_policy(update, event)
    elif isinstance(event, VehicleEvent):
        on_vehicle(update, event)
    elif isinstance(event, ArmingEvent):
        on_arming(update, event)
    elif isinstance(event, SystemEvent):
        _on_system(update, event)
    elif isinstance(event, Tick):
        _on_tick(update)
    else:
        assert_never(event)
    # When a mission has ended, the driver of the mission loses its lease, even if the driver only waits for control.
    # Otherwise the driver could arm the vehicle next to the pilot who landed it.
    lease = update.state.lease
    mission = update.state.missions.get(lease.key) if lease is not None else None
    if mission is not None and mission.outcome is not None:
        update.lose_lease(str(mission.outcome))
    return update.state, tuple(update.actions)


# Drivers


def _on_driver(update: StateUpdate, event: DriverEvent) -> None:
    match event:
        case StreamOpened():
            _open_stream(update, event)
        case StreamClosed():
            _close_stream(update, event)
        case DriverUnresponsive():
            _drop_unresponsive_driver(update, event)
        case TransitRequested(lease_id):
            lease = update.state.lease
            if lease is not None and lease.lease_id == lease_id and update.state.authority is not Authority.PILOT:
                update.set(lease=replace(lease, transit=True))
        case TransitFailed():
            _fail_transit(update, event)
        case GrantControl(lease_id):
            _grant_control(update, lease_id)
        case ControlReturned():
            _return_control(update, event)
        case WaypointsDone():
            _count_waypoints(update, event)
        case CruiseSpeedSet(speed_mps):
            update.set(speed_mps=speed_mps)
        case _:
            assert_never(event)


def _count_waypoints(update: StateUpdate, event: WaypointsDone) -> None:
    """Count a flown leg of the driver, and the waypoints that the driver has completed since the previous event.

    A completed waypoint counts as reached if a leg ended since the previous waypoint. Otherwise it counts as skipped.
    """
    mission = update.state.missions.get(event.key)
    if mission is None or not (event.leg or event.waypoints > mission.waypoints):
        return
    legs = mission.legs + event.leg
    corrected_legs = mission.corrected_legs + (event.leg and event.corrected)
    completed = max(event.waypoints - mission.waypoints, 0)
    if not completed:
        update.update_mission(mission, leg_flown=True, legs=legs, corrected_legs=corrected_legs)
    else:
        reached = min(completed, legs)
        counts = WaypointCounts(
            mission.counts.reached + reached,
            mission.counts.skipped + completed - reached,
            mission.counts.corrected + min(reached, corrected_legs),
        )
        update.update_mission(
            mission,
            waypoints=event.waypoints,
            leg_flown=mission.leg_flown or event.leg,
            takeovers=0,
            interruptions=0,
            counts=counts,
            legs=0,
            corrected_legs=0,
        )
    update.act(SaveJournal())


def _open_stream(update: StateUpdate, event: StreamOpened) -> None:
    """Create a lease for the driver or refuse its stream.

    A second stream of the same driver is refused while the first stream is open. Otherwise two processes of one driver
    would take the vehicle from each other without end.
    """
    mission = update.mission(event.key, event.identity)
    if mission.outcome is not None:
        update.act(RefuseStream(event.lease_id, *ended_refusal(mission.outcome)))
        return
    lease = update.state.lease
    if lease is not None and lease.key != event.key and not lease.granted and update.state.flies_for(event.key):
        update.lose_lease("another application has the drone")
        lease = None
    if (lease is not None and lease.key != event.key) or update.state.armed_for_other(event.key):
        reason = "another application has the drone; try again when the flight of that application has ended"
        update.act(RefuseStream(event.lease_id, "ControlHeld", reason))
        return
    if lease is not None:
        update.act(RefuseStream(event.lease_id, "ControlHeld", SECOND_STREAM))
        return
    update.set(lease=ControlLease(event.lease_id, event.key, event.identity))


def _grant_control(update: StateUpdate, lease_id: int) -> None:
    """Grant control to the driver, unless a pilot, a return flight or another mission has the vehicle."""
    state = update.state
    lease = state.lease
    if lease is None or lease.lease_id != lease_id or lease.granted:
        return
    if (
        state.authority is Authority.PILOT
        or state.contact_lost
        or state.home_for_good
        or not state.decided
        or state.armed_for_other(lease.key)
    ):
        return
    mission = update.mission(lease.key, lease.identity)
    update.stop_task()
    update.set(grace=None, authority=Authority.DRIVER, lease=replace(lease, granted=True), unattended=0)
    update.adopt(mission)
    update.audit("control", "granted", lease.identity, f"control point {mission.points_done + 1}")
    granted = ControlEvent(StreamState.GRANTED, mission.points_done, "", mission.waypoints)
    update.act(SendEvent(lease_id, granted))


def _return_control(update: StateUpdate, event: ControlReturned) -> None:
    """Return home after the last control point. Otherwise hover until the driver requests the next control point."""
    lease = update.state.lease
    if lease is None or lease.key != event.key or not update.state.drives:
        return
    mission = update.mission(lease.key, lease.identity)
    skipped = max(event.waypoints - mission.waypoints, 0)
    counts = replace(mission.counts, skipped=mission.counts.skipped + skipped)
    mission = update.update_mission(
        mission,
        points_done=mission.points_done + 1,
        waypoints=0,
        takeovers=0,
        interruptions=0,
        counts=counts,
        legs=0,
        corrected_legs=0,
    )
    last = mission.points_done >= event.control_points
    update.set(lease=None, authority=Authority.SYSTEM)
    update.stop_motion(StopKind.ABORTED, "ControlReturned", "control was returned")
    outcome = NOTHING_FLOWN if event.paths and not mission.leg_flown else COMPLETE
    update.audit("control", "returned", lease.identity, f"the mission is {outcome}" if last else "")
    if last:
        update.update_mission(mission, outcome=outcome)
        done = ControlEvent(StreamState.COMPLETE, mission.points_done - 1, "every control point is done")
        update.act(SendEvent(lease.lease_id, done))
        update.start(TaskKind.RETURN)
    else:
        update.act(EndStream(lease.lease_id))
        if update.state.vehicle.armed:
            update.start(TaskKind.HOVER)
        update.begin_grace(mission, "the driver did not request its next control point")
    update.act(SaveJournal())


def _close_stream(update: StateUpdate, event: StreamClosed) -> None:
    """Handle the loss of a driver that had control or for which the system was flying.

    The system completes a return that the driver started. It does not interrupt a landing, because a stop in mid-air does
    not help.
    """
    lease = update.state.lease
    if lease is None or lease.lease_id != event.lease_id:
        return
    update.drop_lease()
    mission = update.state.missions.get(lease.key)
    if mission is None or not (lease.granted or lease.transit):
        return
    update.audit("control", DRIVER_LOST, lease.identity, "its stream broke")
    repeated = _count_interruption(update, lease.key) if lease.granted else ""
    reason = f"{DRIVER_LOST}; {repeated}" if repeated else DRIVER_LOST
    if repeated:
        update.audit("takeover", TaskKind.RETURN.value, "system", reason, "DriverLost")
    _leave_driver(update, lease.key, "the driver's stream broke", reason, ends=bool(repeated))


def _drop_unresponsive_driver(update: StateUpdate, event: DriverUnresponsive) -> None:
    """Take the vehicle from a driver whose program hangs, although its connection is intact."""
    lease = update.state.lease
    if lease is None or lease.lease_id != event.lease_id or not update.state.drives:
        return
    update.mission(lease.key, lease.identity)
    reason = f"the driver's program did not respond for {event.waited_s:g} s"
    repeated = _count_interruption(update, lease.key, "DriverUnresponsive")
    if repeated:
        reason = f"{reason}; {repeated}"
    kind = TaskKind.RETURN if repeated else TaskKind.HOVER
    update.audit("takeover", kind.value, "system", reason, "DriverUnresponsive")
    update.drop_lease()
    remedy = "do not block its event loop: use asyncio.sleep and asyncio.to_thread"
    update.act(SendEvent(lease.lease_id, ControlEvent(StreamState.LOST, reason=f"{reason}; {remedy}")))
    _leave_driver(update, lease.key, reason, reason, ends=bool(repeated))


def _count_interruption(update: StateUpdate, key: str, cause: str = "") -> str:
    """Count a takeover in flight, or the loss of a driver.

    Args:
        update: State before the takeover.
        key: Key of the mission.
        cause: Text that is equal for equal causes of takeovers; empty for the loss of a driver.

    Returns:
        Reason why the mission ends, or an empty string if the driver may continue.
    """
    mission = update.state.missions.get(key)
    if mission is None or not update.state.vehicle.armed:
        return ""
    interruptions = mission.interruptions + 1
    takeovers = mission.takeovers
    if cause:
        takeovers = takeovers + 1 if mission.takeover == cause else 1
    update.update_mission(mission, takeover=cause or mission.takeover, takeovers=takeovers, interruptions=interruptions)
    update.act(SaveJournal())
    if cause and takeovers >= MAX_REPEATED_TAKEOVERS:
        return f"the driver caused this takeover {takeovers} times without a further waypoint"
    if interruptions >= MAX_INTERRUPTIONS:
        return f"the driver was interrupted {interruptions} times without a further waypoint"
    return ""


def _leave_driver(update: StateUpdate, key: str, stopped: str, reason: str, *, ends: bool) -> None:
    """Hover without the driver and start its grace period, or return home.

    Args:
        update: State whose lease was dropped.
        key: Key of the driver's mission.
        stopped: Reason for the caller of the current motion.
        reason: Reason with which the mission fails, at once or at the end of the grace period.
        ends: True if the mission ends at once.
    """
    mission = update.state.missions[key]
    if ends:
        update.end_mission(mission, OutcomeKind.FAILED, reason)
    motion = update.state.motion
    update.set(authority=Authority.SYSTEM)
    returns = motion is not None and motion.kind == "ReturnToLaunch"
    lands = motion is not None and motion.kind == "Land" and update.state.vehicle.mode.comes_down
    update.stop_motion(StopKind.LOST, "ControlLost", stopped)
    if lands and ends:
        update.follow_descent(TaskKind.LAND)
    elif update.state.vehicle.armed and not lands:
        update.start(TaskKind.RETURN if returns or ends else TaskKind.HOVER)
    if not ends:
        update.begin_grace(mission, reason)


def _fail_transit(update: StateUpdate, event: TransitFailed) -> None:
    lease = update.state.lease
    if lease is None or lease.lease_id != event.lease_id or update.state.authority is not Authority.SYSTEM:
        return
    mission = update.mission(lease.key, lease.identity)
    if mission.outcome is not None:
        return
    update.end_mission(mission, OutcomeKind.FAILED, event.reason)
    update.audit("takeover", TaskKind.RETURN.value, "system", event.reason, "InternalError")
    update.lose_lease(event.reason)
    update.start(TaskKind.RETURN)


# Motions


def _on_motion(update: StateUpdate, event: MotionEvent) -> None:
    """Handle the beginning or end of a motion. The end of a replaced motion changes nothing."""
    motion = update.state.motion
    match event:
        case MotionBegan(motion_id, kind):
            update.stop_motion(StopKind.ABORTED, "Replaced", f"{kind} replaced it")
            update.set(motion=ActiveMotion(motion_id, kind), motion_began_at=update.now)
        case MotionStopped(code, reason, policies):
            update.stop_motion(StopKind.ABORTED, code, reason, policies)
        case MotionFinished(motion_id):
            if motion is not None and motion.motion_id == motion_id:
                update.set(motion=None)
        case MotionFailed(motion_id):
            if motion is not None and motion.motion_id == motion_id:
                update.set(motion=None)
                if update.state.authority is Authority.DRIVER and update.state.vehicle.in_air:
                    update.act(HoldPosition())
        case MotionCancelled(motion_id):
            if motion is not None and motion.motion_id == motion_id:
                wait_s = CANCELLED_DESCENT_S if motion.kind in DESCENTS else 0.0
                update.set(motion=replace(motion, hover_at=update.now + wait_s))
        case _:
            assert_never(event)


def _hover_after_cancellation(update: StateUpdate) -> None:
    """Hover after a cancelled motion, if the driver still has control."""
    if update.state.authority is Authority.DRIVER:
        update.stop_motion(StopKind.ABORTED, "Cancelled", "the call was cancelled")
        update.act(HoldPosition())
    elif update.state.motion is not None:
        update.set(motion=replace(update.state.motion, hover_at=None))


# Policies and grants


def _on_policy(update: StateUpdate, event: PolicyEvent) -> None:
    match event:
        case TakeoverDemanded():
            if update.state.authority is not Authority.PILOT:  # policies apply to applications, never to a human pilot
                _take_over(update, event)
        case BrakeDemanded(code, reason, policies):
            update.audit("control", "brake", update.state.controller, reason, code, policies=policies)
            update.stop_motion(StopKind.ABORTED, code, reason, policies)
            update.act(Brake())
        case PositionLost(reason):
            _lose_position(update, reason)
        case PositionFound():
            if update.state.grace is not None and update.state.grace.code == POSITION_UNKNOWN:
                update.set(grace=None)
                update.audit("control", "resumed", update.state.controller, "the position is known again")
        case ContactLost():
            _lose_contact(update, event)
        case ContactRestored():
            _restore_contact(update)
        case GrantChanged():
            _change_grant(update, event)
        case _:
            assert_never(event)


def _take_over(update: StateUpdate, event: TakeoverDemanded) -> None:
    """Take the vehicle for a policy. A driver that repeatedly causes the same takeover ends its mission."""
    kind, outcome = TAKEOVERS[event.takeover]
    reason = event.reason
    mission = update.state.mission
    if outcome is None and mission is not None and update.state.drives:
        repeated = _count_interruption(update, mission.key, " ".join((event.code, *event.policies)))
        if repeated:
            kind = TaskKind.RETURN
            outcome = OutcomeKind.FAILED
            reason = f"{reason}; {repeated}"
    if kind is TaskKind.LAND_AT:
        kind = update.plan_landing(mission, event.land_at)
    update.seize(kind, event.code, reason, event.policies, outcome)


def _lose_position(update: StateUpdate, reason: str) -> None:
    """Stop the motion and hover. A driver keeps control during the grace period.

    The driver may fly again if the position is known before the grace period ends. The motion is stopped with an error
    that permits a retry, because the position may be known again in a moment.
    """
    update.audit("control", "brake", update.state.controller, reason, POSITION_UNKNOWN)
    update.stop_motion(StopKind.PASSING, POSITION_UNKNOWN, reason)
    update.act(Brake())
    mission = update.state.mission
    if update.state.drives and update.state.grace is None and mission is not None:
        update.begin_grace(mission, reason, POSITION_UNKNOWN)


def _lose_contact(update: StateUpdate, event: ContactLost) -> None:
    """Hover until contact with the API server returns, or end the mission.

    Neither a descent nor a pilot is interrupted. A takeoff is completed, because the drone must not hover close to the
    ground. On the ground, the mission waits for contact.
    """
    state = update.state
    if not state.contact_lost:
        update.set(contact_lost=True)
        update.audit("control", "contactLost", state.controller, event.reason, CONTACT_LOST)
        update.act(WakeWaiters())
    mission = state.mission
    ends = mission is None or mission.outcome is not None
    if ends or not state.vehicle.in_air or state.authority is Authority.PILOT or state.returning:
        return
    grace = state.grace
    if event.tour and grace is not None and grace.code == DRIVER_LOST_CODE:
        # A tour has no driver that could reconnect. It continues by itself when contact returns.
        update.set(grace=replace(grace, reason=event.reason, code=CONTACT_LOST))
    motion = state.motion
    if motion is not None and motion.kind in DESCENTS:
        return
    if event.action == "abort":
        kind = update.plan_landing(mission, event.land_at)
        update.seize(kind, CONTACT_LOST, event.reason, (), OutcomeKind.FAILED)
    elif motion is not None and motion.kind not in {TAKEOFF, CORRECTION}:
        update.stop_motion(StopKind.PASSING, CONTACT_LOST, event.reason)
        update.act(Brake())


def _restore_contact(update: StateUpdate) -> None:
    """Let the mission continue. A drone that hovers without a driver waits for the driver once more."""
    state = update.state
    if not state.contact_lost:
        return
    if state.waits_for_contact and state.grace is not None:
        update.set(grace=replace(state.grace, until=update.now + state.grace_s))
    update.set(contact_lost=False)
    reason = "there is contact with the API server again"
    update.audit("control", "contactRestored", state.controller, reason, CONTACT_LOST)
    update.act(WakeWaiters())


def _change_grant(update: StateUpdate, event: GrantChanged) -> None:
    """Revoke the mission of a removed grant, even while a pilot has control.

    The mission of a changed grant continues.
    """
    before = event.before
    after = event.after
    removed = frozenset({before.key} if before is not None else ())
    update.set(grants=(update.state.grants - removed) | ({after.key} if after is not None else set()))
    if before is not None and after is not None and before.key == after.key:
        return
    update.act(WakeWaiters())
    if before is None or not before.commands_vehicle:
        return
    lease = update.state.lease
    mission = update.state.missions.get(before.key)
    if mission is not None and mission.outcome is not None and update.state.flies_for(before.key):
        update.set(removed=before.key)  # its constraints apply until the drone has landed
    concerned = (lease is not None and lease.key == before.key) or update.state.active == before.key
    if mission is None or mission.outcome is not None or not concerned:
        return
    if update.state.active not in {None, before.key}:
        # The driver only waited for a vehicle that flies for another mission. That mission continues.
        update.lose_lease(GRANT_REMOVED)
        update.end_mission(mission, OutcomeKind.REVOKED, GRANT_REMOVED)
        return
    update.set(active=before.key, removed=before.key)
    if update.state.authority is Authority.PILOT:
        update.end_mission(mission, OutcomeKind.REVOKED, GRANT_REMOVED)
    else:
        update.seize(TaskKind.RETURN, "GrantRevoked", GRANT_REMOVED, (), OutcomeKind.REVOKED)


# The system


def _on_system(update: StateUpdate, event: SystemEvent) -> None:
    match event:
        case TransitBegan(flight_id, key, identity):
            if update.state.authority is Authority.PILOT or update.state.drives or _has_ended(update, key):
                return  # the system flies only for missions that continue, and while no other party has authority
            if update.state.touring != key:  # a mission over points of interest must not stop its own task
                update.stop_task()
            grace = update.state.grace
            # A transit that is refused repeatedly must not restart the grace period each time.
            kept = grace if grace is not None and grace.key == key else None
            update.set(grace=kept, authority=Authority.SYSTEM)
            update.adopt(update.mission(key, identity))
            update.set(flight=ActiveFlight(flight_id, key))
        case SystemFlightBegan(flight_id, key):
            update.set(flight=ActiveFlight(flight_id, key))
        case SystemFlightEnded(flight_id):
            if update.state.flight is not None and update.state.flight.flight_id == flight_id:
                update.set(flight=None)
        case TourPointVisited(key, visited):
            mission = update.state.missions.get(key)
            if mission is not None:
                update.update_mission(mission, waypoints=visited, counts=WaypointCounts(reached=visited))
            update.act(SaveJournal())
            update.act(WakeWaiters())
        case PassengerBoarded(key, identity):
            update.mission(key, identity)
        case SystemTaskEnded(task_id, finished):
            _end_task(update, task_id, finished)
        case TourBegan() | TourInterrupted() | TourEnded():
            _on_tour(update, event)
        case _:
            assert_never(event)


def _has_ended(update: StateUpdate, key: str) -> bool:
    mission = update.state.missions.get(key)
    return mission is not None and mission.outcome is not None


def _on_tour(update: StateUpdate, event: TourBegan | TourInterrupted | TourEnded) -> None:
    """Handle an event of a mission over points of interest.

    An interruption or the end of the mission is ignored unless the system is flying this mission.
    """
    match event:
        case TourBegan(key):
            if update.state.authority is Authority.PILOT:
                return
            update.stop_task()
            task = SystemTask(update.state.last_task_id + 1, TaskKind.TOUR, key)
            update.set(grace=None, task=task, last_task_id=task.task_id)
        case TourInterrupted(key, reason):
            mission = update.state.missions.get(key)
            if mission is not None and _flies_tour(update, key):
                update.start(TaskKind.HOVER)
                update.begin_grace(mission, reason, CONTACT_LOST if update.state.contact_lost else DRIVER_LOST_CODE)
        case TourEnded(key, outcome):
            mission = update.state.missions.get(key)
            if mission is not None and _flies_tour(update, key):
                update.update_mission(mission, outcome=outcome)
                update.audit("control", TaskKind.RETURN.value, "system", str(outcome))
                update.act(SaveJournal())
                update.start(TaskKind.RETURN)
        case _:
            assert_never(event)


def _flies_tour(update: StateUpdate, key: str) -> bool:
    """Return True if the system still flies this mission. Otherwise an earlier event has ended the flight."""
    mission = update.state.missions.get(key)
    continues = mission is not None and mission.outcome is None
    return continues and update.state.authority is Authority.SYSTEM and update.state.touring == key


def _end_task(update: StateUpdate, task_id: int, finished: bool) -> None:
    task = update.state.task
    if task is None or task.task_id != task_id:
        return
    update.set(task=None)
    if finished and task.kind is not TaskKind.HOVER:
        update.set(returning=False)
        update.act(WakeWaiters())


# The clock


def _on_tick(update: StateUpdate) -> None:
    """Handle expired deadlines, and take over an armed vehicle for which no party is responsible."""
    grace = update.state.grace
    motion = update.state.motion
    waits = update.state.in_transit or update.state.waits_for_contact
    if grace is not None and update.now >= grace.until and not waits:
        _end_grace(update)
    if (
        motion is update.state.motion
        and motion is not None
        and motion.hover_at is not None
        and update.now >= motion.hover_at
    ):
        _hover_after_cancellation(update)
    if update.state.attended:
        update.set(unattended_since=None)
    elif update.state.decided:
        if update.state.unattended_since is None:
            update.set(unattended_since=update.now)
        if update.state.unattended < MAX_UNATTENDED:
            update.set(unattended=update.state.unattended + 1)
            _attend(update)


def _end_grace(update: StateUpdate) -> None:
    """Fail the mission, because the grace period of a lost driver or position has ended."""
    grace = update.state.grace
    update.set(grace=None)
    mission = update.state.missions.get(grace.key) if grace is not None else None
    if grace is None or mission is None or mission.outcome is not None:
        return
    update.end_mission(mission, OutcomeKind.FAILED, grace.reason)
    update.audit("takeover", TaskKind.RETURN.value, "system", grace.reason, grace.code)
    if update.state.drives:
        update.lose_lease(grace.reason)
    if update.state.authority is Authority.SYSTEM and not update.state.returning:
        update.start(TaskKind.RETURN)


def _attend(update: StateUpdate) -> None:
    """Take over a vehicle for which no party has control authority.

    If the vehicle is airborne and its mission continues, hover and wait for a driver. Otherwise, return.
    """
    mission = update.state.mission
    state = update.state
    update.set(authority=Authority.SYSTEM)
    update.stop_motion(StopKind.LOST, "ControlLost", "the system took the drone")
    continues = mission is not None and mission.outcome is None and state.grant_in_force
    kind = TaskKind.HOVER if continues and state.vehicle.in_air else TaskKind.RETURN
    update.audit("takeover", kind.value, "system", "no party had control authority", UNATTENDED)
    update.start(kind)
    if kind is TaskKind.HOVER and mission is not None:
        update.begin_grace(mission, DRIVER_LOST)

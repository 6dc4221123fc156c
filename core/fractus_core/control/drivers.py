"""Drivers: they wait for the vehicle, command it, return it, or are lost; and the motions that they ask for."""

from __future__ import annotations

from dataclasses import replace
from typing import assert_never

from fractus_core.control.actions import EndStream, HoldPosition, RefuseStream, SaveJournal, SendEvent, StopKind
from fractus_core.control.events import (
    ControlReturned,
    CruiseSpeedSet,
    DriverEvent,
    GrantControl,
    MotionBegan,
    MotionCancelled,
    MotionEvent,
    MotionFailed,
    MotionFinished,
    MotionStopped,
    StreamClosed,
    StreamOpened,
    TransitFailed,
    TransitRequested,
    WaypointsDone,
)
from fractus_core.control.step import DRIVER_LOST, Step
from fractus_core.control.values import (
    COMPLETE,
    NOTHING_FLOWN,
    ActiveMotion,
    Authority,
    ControlEvent,
    ControlLease,
    OutcomeKind,
    StreamState,
    TaskKind,
    ended_refusal,
)

CANCELLED_DESCENT_S = 0.3
"""A cancelled descent goes on for so long: the driver's stream may be about to break too, and then the vehicle comes down."""

COMING_DOWN = frozenset({"Land", "ReturnToLaunch"})
"""Motions that end on the ground."""


def on_driver(step: Step, event: DriverEvent) -> None:
    """What a driver's stream or call means."""
    match event:
        case StreamOpened():
            _open(step, event)
        case StreamClosed():
            _close(step, event)
        case TransitRequested(lease_id):
            lease = step.state.lease
            if lease is not None and lease.lease_id == lease_id and step.state.authority is not Authority.PILOT:
                step.set(lease=replace(lease, transit=True))
        case TransitFailed():
            _fail_transit(step, event)
        case GrantControl(lease_id):
            _grant(step, lease_id)
        case ControlReturned():
            _return(step, event)
        case WaypointsDone(key):
            mission = step.state.missions.get(key)
            if mission is not None and (event.waypoints > mission.waypoints or (event.leg and not mission.leg_flown)):
                waypoints, flown = max(event.waypoints, mission.waypoints), mission.leg_flown or event.leg
                step.update_mission(mission, waypoints=waypoints, leg_flown=flown)
                step.act(SaveJournal())
        case CruiseSpeedSet(speed_mps):
            step.set(speed_mps=speed_mps)
        case _:
            assert_never(event)


def _open(step: Step, event: StreamOpened) -> None:
    """Admit a driver, or refuse it; a second stream of the same instance takes the place of the first."""
    mission = step.mission(event.key, event.identity)
    if mission.outcome is not None:
        step.act(RefuseStream(event.lease_id, *ended_refusal(mission.outcome)))
        return
    lease = step.state.lease
    if lease is not None and lease.key != event.key and not lease.granted and step.state.flies_for(event.key):
        step.lose_lease("another application has the drone")
        lease = None
    if (lease is not None and lease.key != event.key) or step.state.taken(event.key):
        reason = "another application has the drone; try again when it is back"
        step.act(RefuseStream(event.lease_id, "ControlHeld", reason))
        return
    if lease is not None:
        lost = ControlEvent(StreamState.LOST, reason="another stream of the same instance took over")
        step.act(SendEvent(lease.lease_id, lost))
    step.set(lease=ControlLease(event.lease_id, event.key, event.identity))


def _grant(step: Step, lease_id: int) -> None:
    """The driver commands from now on; never over a pilot, a way home or another mission's flight."""
    state, lease = step.state, step.state.lease
    if lease is None or lease.lease_id != lease_id or lease.granted:
        return
    if state.authority is Authority.PILOT or state.home_for_good or not state.decided or state.taken(lease.key):
        return
    mission = step.mission(lease.key, lease.identity)
    step.stop_task()
    step.set(grace=None, authority=Authority.DRIVER, lease=replace(lease, granted=True), unattended=0)
    step.adopt(mission)
    step.audit("control", "granted", lease.identity, f"control point {mission.points_done}")
    granted = ControlEvent(StreamState.GRANTED, mission.points_done, "", mission.waypoints)
    step.act(SendEvent(lease_id, granted))


def _return(step: Step, event: ControlReturned) -> None:
    """The driver gives the vehicle back: home after the last control point, else it waits for the next request."""
    lease = step.state.lease
    if lease is None or lease.key != event.key or not step.state.drives:
        return
    mission = step.mission(lease.key, lease.identity)
    mission = step.update_mission(mission, points_done=mission.points_done + 1, waypoints=0)
    last = mission.points_done >= event.control_points
    step.set(lease=None, authority=Authority.SYSTEM)
    step.stop_motion(StopKind.ABORTED, "ControlReturned", "control was returned")
    outcome = NOTHING_FLOWN if event.paths and not mission.leg_flown else COMPLETE
    step.audit("control", "returned", lease.identity, f"the mission is {outcome}" if last else "")
    if last:
        step.update_mission(mission, outcome=outcome)
        done = ControlEvent(StreamState.COMPLETE, mission.points_done - 1, "every control point is done")
        step.act(SendEvent(lease.lease_id, done))
        step.start(TaskKind.RETURN)
    else:
        step.act(EndStream(lease.lease_id))
        if step.state.vehicle.armed:
            step.start(TaskKind.HOVER)
        step.begin_grace(mission, "driver did not ask for its next control point")
    step.act(SaveJournal())


def _close(step: Step, event: StreamClosed) -> None:
    """A stream that ends by itself loses the driver, if it had the vehicle or the system flew for it.

    The way home that it began the system goes on with, and a vehicle that lands for it is left to that: stopping in mid-air
    helps no one.
    """
    lease, motion = step.state.lease, step.state.motion
    if lease is None or lease.lease_id != event.lease_id:
        return
    step.drop_lease()
    mission = step.state.missions.get(lease.key)
    if mission is None or not (lease.granted or lease.transit):
        return
    step.set(authority=Authority.SYSTEM)
    step.audit("control", DRIVER_LOST, lease.identity, "its stream broke")
    returns = motion is not None and motion.kind == "ReturnToLaunch"
    lands = motion is not None and motion.kind == "Land" and step.state.vehicle.mode.comes_down
    step.stop_motion(StopKind.LOST, "ControlLost", "the driver's stream broke")
    if step.state.vehicle.armed and not lands:
        step.start(TaskKind.RETURN if returns else TaskKind.HOVER)
    step.begin_grace(mission, DRIVER_LOST)


def _fail_transit(step: Step, event: TransitFailed) -> None:
    lease, state = step.state.lease, step.state
    if lease is None or lease.lease_id != event.lease_id or state.authority is not Authority.SYSTEM:
        return
    mission = step.mission(lease.key, lease.identity)
    if mission.outcome is not None:
        return
    step.end_mission(mission, OutcomeKind.FAILED, event.reason)
    step.audit("takeover", TaskKind.RETURN.value, "system", event.reason, "InternalError")
    step.lose_lease(event.reason)
    step.start(TaskKind.RETURN)


def on_motion(step: Step, event: MotionEvent) -> None:
    """What the beginning or end of a motion means; events of motions that are over mean nothing."""
    motion = step.state.motion
    match event:
        case MotionBegan(motion_id, kind):
            step.stop_motion(StopKind.ABORTED, "Replaced", f"{kind} replaced it")
            step.set(motion=ActiveMotion(motion_id, kind), motion_began_at=step.now)
        case MotionStopped(code, reason, policies):
            step.stop_motion(StopKind.ABORTED, code, reason, policies)
        case MotionFinished(motion_id):
            if motion is not None and motion.motion_id == motion_id:
                step.set(motion=None)
        case MotionFailed(motion_id):
            if motion is not None and motion.motion_id == motion_id:
                step.set(motion=None)
                if step.state.authority is Authority.DRIVER and step.state.vehicle.in_air:
                    step.act(HoldPosition())
        case MotionCancelled(motion_id):
            if motion is not None and motion.motion_id == motion_id:
                wait_s = CANCELLED_DESCENT_S if motion.kind in COMING_DOWN else 0.0
                step.set(motion=replace(motion, hover_at=step.now + wait_s))
        case _:
            assert_never(event)


def hover_after_cancelled(step: Step) -> None:
    """The caller of the motion under way gave it up a moment ago: hover, if its driver still has the vehicle."""
    if step.state.authority is Authority.DRIVER:
        step.stop_motion(StopKind.ABORTED, "Cancelled", "the call was cancelled")
        step.act(HoldPosition())
    elif step.state.motion is not None:
        step.set(motion=replace(step.state.motion, hover_at=None))

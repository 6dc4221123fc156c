"""Who may command a vehicle: transition(state, event, now) -> (state, actions).

The system takes the vehicle whenever no one else rightly has it, and never lets go of a flying vehicle before it is home or a
driver or a pilot has it.
"""

from __future__ import annotations

from typing import assert_never

from fractus_core.control.actions import Action, Brake, SaveJournal, StopKind, WakeWaiters
from fractus_core.control.drivers import hover_after_cancelled, on_driver, on_motion
from fractus_core.control.events import (
    ArmingEvent,
    BrakeDemanded,
    DriverEvent,
    Event,
    GrantChanged,
    MotionEvent,
    PassengerBoarded,
    PolicyEvent,
    PositionFound,
    PositionLost,
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
    VehicleEvent,
)
from fractus_core.control.step import DRIVER_LOST, GRANT_REMOVED, Step
from fractus_core.control.values import Authority, ControlState, OutcomeKind, SystemFlight, SystemTask, TaskKind
from fractus_core.control.vehicles import on_arming, on_vehicle
from fractus_core.exhaustive import exhaustive
from fractus_core.policy.decision_types import Takeover

TAKEOVERS: dict[Takeover, tuple[TaskKind, OutcomeKind | None]] = exhaustive(
    Takeover,
    {
        "hover": (TaskKind.HOVER, None),
        "land": (TaskKind.LAND, OutcomeKind.FAILED),
        "returnToLaunch": (TaskKind.RETURN, OutcomeKind.FAILED),
        "revoke": (TaskKind.RETURN, OutcomeKind.REVOKED),
    },
)
"""What each takeover that policies name does with the vehicle, and with the mission."""

POSITION_UNKNOWN = "PositionUnknown"
"""Code of a vehicle that hovers, as far as it hears, until its position is known."""

UNATTENDED = "NoControlAuthority"
"""Code of the takeover of a vehicle that no one has: by a fault of the service, and the last line behind all others."""

MAX_UNATTENDED = 3
"""How many times a vehicle that no one has is taken: a task that fails each time would be begun again indefinitely. After that
the supervisor's heartbeats end, and the autopilot's own failsafe brings it home."""


def transition(state: ControlState, event: Event, now: float) -> tuple[ControlState, tuple[Action, ...]]:
    """What an event makes of the state, and what is to be done.

    Every event is defined in every state; one that comes too late, of a lease, motion or task that is over, changes nothing.

    Args:
        state: before.
        event: what happened.
        now: monotonic seconds; never earlier than in the events before.
    """
    step = Step(state, now)
    if isinstance(event, DriverEvent):
        on_driver(step, event)
    elif isinstance(event, MotionEvent):
        on_motion(step, event)
    elif isinstance(event, PolicyEvent):
        _on_policy(step, event)
    elif isinstance(event, VehicleEvent):
        on_vehicle(step, event)
    elif isinstance(event, ArmingEvent):
        on_arming(step, event)
    elif isinstance(event, SystemEvent):
        _on_system(step, event)
    elif isinstance(event, Tick):
        _on_tick(step)
    else:
        assert_never(event)
    _end_lease_of_ended_mission(step)
    return step.state, tuple(step.actions)


def _end_lease_of_ended_mission(step: Step) -> None:
    """No driver has or waits for the vehicle for a mission that is over: it could arm beside the pilot who landed it."""
    lease = step.state.lease
    mission = step.state.missions.get(lease.key) if lease is not None else None
    if mission is not None and mission.outcome is not None:
        step.lose_lease(str(mission.outcome))


# Policies and grants


def _on_policy(step: Step, event: PolicyEvent) -> None:
    match event:
        case TakeoverDemanded(takeover, code, reason, policies):
            kind, outcome = TAKEOVERS[takeover]
            if step.state.authority is not Authority.PILOT:  # policies bind applications, never a human pilot
                step.seize(kind, code, reason, policies, outcome)
        case BrakeDemanded(code, reason, policies):
            step.audit("control", "brake", step.state.controller, reason, code, policies=policies)
            step.stop_motion(StopKind.ABORTED, code, reason, policies)
            step.act(Brake())
        case PositionLost(reason):
            _position_lost(step, reason)
        case PositionFound():
            if step.state.grace is not None and step.state.grace.code == POSITION_UNKNOWN:
                step.set(grace=None)
                step.audit("control", "resumed", step.state.controller, "the position is known again")
        case GrantChanged():
            _grant_changed(step, event)
        case _:
            assert_never(event)


def _position_lost(step: Step, reason: str) -> None:
    """Hover; a driver keeps the vehicle and may fly again when the position is known within the grace.

    The motion may be asked for again: a position that is not known now may be known in a moment.
    """
    step.audit("control", "brake", step.state.controller, reason, POSITION_UNKNOWN)
    step.stop_motion(StopKind.PASSING, POSITION_UNKNOWN, reason)
    step.act(Brake())
    mission = step.state.mission
    if step.state.drives and step.state.grace is None and mission is not None:
        step.begin_grace(mission, reason, POSITION_UNKNOWN)


def _grant_changed(step: Step, event: GrantChanged) -> None:
    """A mission whose grant went away is revoked, even under a pilot; one that only changed goes on."""
    before, after = event.before, event.after
    gone = frozenset({before.key} if before is not None else ())
    step.set(grants=(step.state.grants - gone) | ({after.key} if after is not None else set()))
    if before is not None and after is not None and before.key == after.key:
        return
    step.act(WakeWaiters())
    if before is None or not before.leads:
        return
    lease, mission = step.state.lease, step.state.missions.get(before.key)
    concerned = (lease is not None and lease.key == before.key) or step.state.active == before.key
    if mission is None or mission.outcome is not None or not concerned:
        return
    if step.state.active not in {None, before.key}:
        # It only waited for a vehicle that is another mission's: that one goes on.
        step.lose_lease(GRANT_REMOVED)
        step.end_mission(mission, OutcomeKind.REVOKED, GRANT_REMOVED)
        return
    step.set(active=before.key, removed=before.key)
    if step.state.authority is Authority.PILOT:
        step.end_mission(mission, OutcomeKind.REVOKED, GRANT_REMOVED)
    else:
        step.seize(TaskKind.RETURN, "GrantRevoked", GRANT_REMOVED, (), OutcomeKind.REVOKED)


# The system


def _on_system(step: Step, event: SystemEvent) -> None:
    match event:
        case TransitBegan(flight_id, key, identity):
            if step.state.authority is Authority.PILOT or step.state.drives or _is_over(step, key):
                return  # the system flies only for missions that go on, and where no one else has authority
            if step.state.touring != key:  # a tour begins its own transit, and must not end itself
                step.stop_task()
            grace = step.state.grace
            # A transit that is refused again and again must not begin the grace again each time.
            kept = grace if grace is not None and grace.key == key else None
            step.set(grace=kept, authority=Authority.SYSTEM)
            step.adopt(step.mission(key, identity))
            step.set(flight=SystemFlight(flight_id, key))
        case SystemFlightBegan(flight_id, key):
            step.set(flight=SystemFlight(flight_id, key))
        case SystemFlightEnded(flight_id):
            if step.state.flight is not None and step.state.flight.flight_id == flight_id:
                step.set(flight=None)
        case TourPointVisited(key, visited):
            mission = step.state.missions.get(key)
            if mission is not None:
                step.update_mission(mission, waypoints=visited)
            step.act(SaveJournal())
            step.act(WakeWaiters())
        case PassengerBoarded(key, identity):
            step.mission(key, identity)
        case SystemTaskEnded(task_id, finished):
            _task_ended(step, task_id, finished)
        case TourBegan() | TourInterrupted() | TourEnded():
            _on_tour(step, event)
        case _:
            assert_never(event)


def _is_over(step: Step, key: str) -> bool:
    mission = step.state.missions.get(key)
    return mission is not None and mission.outcome is not None


def _on_tour(step: Step, event: TourBegan | TourInterrupted | TourEnded) -> None:
    """A tour is flown by a task of its own; what it reports counts only while it has the vehicle."""
    match event:
        case TourBegan(key):
            if step.state.authority is Authority.PILOT:
                return
            step.stop_task()
            task = SystemTask(step.state.last_task_id + 1, TaskKind.TOUR, key)
            step.set(grace=None, task=task, last_task_id=task.task_id)
        case TourInterrupted(key, reason):
            mission = step.state.missions.get(key)
            if mission is not None and _tours(step, key):
                step.start(TaskKind.HOVER)
                step.begin_grace(mission, reason)
        case TourEnded(key, outcome):
            mission = step.state.missions.get(key)
            if mission is not None and _tours(step, key):
                step.update_mission(mission, outcome=outcome)
                step.audit("control", TaskKind.RETURN.value, "system", str(outcome))
                step.act(SaveJournal())
                step.start(TaskKind.RETURN)
        case _:
            assert_never(event)


def _tours(step: Step, key: str) -> bool:
    """Whether the system still flies this tour: otherwise others have taken the vehicle, and have said why."""
    mission = step.state.missions.get(key)
    goes_on = mission is not None and mission.outcome is None
    return goes_on and step.state.authority is Authority.SYSTEM and step.state.touring == key


def _task_ended(step: Step, task_id: int, finished: bool) -> None:
    task = step.state.task
    if task is None or task.task_id != task_id:
        return
    step.set(task=None)
    if finished and task.kind is not TaskKind.HOVER:
        step.set(returning=False)
        step.act(WakeWaiters())


# The clock


def _on_tick(step: Step) -> None:
    """Deadlines that have come, and the last look: an armed vehicle that no one answers for is taken by the system."""
    grace, motion = step.state.grace, step.state.motion
    if grace is not None and step.now >= grace.until and not step.state.in_transit:
        _end_grace(step)
    if (
        motion is step.state.motion
        and motion is not None
        and motion.hover_at is not None
        and step.now >= motion.hover_at
    ):
        hover_after_cancelled(step)
    if step.state.attended:
        step.set(unattended_since=None)
    elif step.state.decided:
        if step.state.unattended_since is None:
            step.set(unattended_since=step.now)
        if step.state.unattended < MAX_UNATTENDED:
            step.set(unattended=step.state.unattended + 1)
            _attend(step)


def _end_grace(step: Step) -> None:
    """The driver did not come back, or the position: the mission has failed."""
    grace = step.state.grace
    step.set(grace=None)
    mission = step.state.missions.get(grace.key) if grace is not None else None
    if grace is None or mission is None or mission.outcome is not None:
        return
    step.end_mission(mission, OutcomeKind.FAILED, grace.reason)
    step.audit("takeover", TaskKind.RETURN.value, "system", grace.reason, grace.code)
    if step.state.drives:
        step.lose_lease(grace.reason)
    if step.state.authority is Authority.SYSTEM and not step.state.returning:
        step.start(TaskKind.RETURN)


def _attend(step: Step) -> None:
    """Hover and wait for the driver of a mission that goes on; bring every other vehicle home."""
    mission, state = step.state.mission, step.state
    step.set(authority=Authority.SYSTEM)
    step.stop_motion(StopKind.LOST, "ControlLost", "the system took the drone")
    goes_on = mission is not None and mission.outcome is None and state.grant_in_force
    kind = TaskKind.HOVER if goes_on and state.vehicle.in_air else TaskKind.RETURN
    step.audit("takeover", kind.value, "system", "no one had the drone", UNATTENDED)
    step.start(kind)
    if kind is TaskKind.HOVER and mission is not None:
        step.begin_grace(mission, DRIVER_LOST)

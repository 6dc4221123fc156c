"""Invariants of the control state machine in every reachable state and after every event."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, get_args

from depth import DEEP
from fractus_core.control import Authority, ControlState, Mission, Outcome, OutcomeKind, WaypointCounts, events
from fractus_core.control.actions import (
    Action,
    EndStream,
    RecordAudit,
    SaveJournal,
    SendEvent,
    StartSystemTask,
    StopMotion,
)
from fractus_core.control.machine import transition
from fractus_core.control.state import (
    FlightMode,
    ModeKind,
    TaskKind,
    VehicleFacts,
)
from hypothesis import given
from hypothesis import strategies as st

GUIDED = FlightMode("GUIDED", ModeKind.COMMANDED)
LOITER = FlightMode("LOITER")
RTL = FlightMode("RTL", ModeKind.RETURNING)
LAND = FlightMode("LAND", ModeKind.LANDING)

GROUND = VehicleFacts(connected=True, mode=GUIDED)
ARMED = replace(GROUND, armed=True)
FLYING = replace(ARMED, in_air=True)
FACTS = (
    GROUND, ARMED, FLYING, replace(FLYING, mode=LOITER), replace(FLYING, mode=RTL), replace(FLYING, mode=LAND),
    replace(FLYING, mode=RTL, failsafe=True), replace(FLYING, connected=False),
)  # fmt: skip
DRIVER = events.GrantRef("a", commands_vehicle=True)
TOUR = events.GrantRef("t", commands_vehicle=True)

EVENTS: tuple[events.Event, ...] = (
    events.StreamOpened(1, "a", "A"), events.StreamOpened(2, "b", "B"), events.StreamOpened(3, "a", "A"),
    events.StreamClosed(1), events.StreamClosed(2), events.StreamClosed(3),
    events.DriverUnresponsive(1, 5.0), events.TransitRequested(1), events.TransitFailed(1, "fault"),
    events.GrantControl(1), events.GrantControl(2), events.GrantControl(3),
    events.ControlReturned("a", 1), events.ControlReturned("a", 9), events.ControlReturned("b", 1),
    events.WaypointsDone("a", 1), events.CruiseSpeedSet(3.0),
    events.MotionBegan(1, "Goto"), events.MotionBegan(2, "Land"), events.MotionFinished(1), events.MotionFailed(1),
    events.MotionCancelled(1), events.MotionCancelled(2), events.MotionStopped("Slower", "it is too fast"),
    events.TakeoverDemanded("hover", "X", "x"), events.TakeoverDemanded("land", "X", "x"),
    events.TakeoverDemanded("returnToLaunch", "X", "x"), events.TakeoverDemanded("revoke", "X", "x"),
    events.TakeoverDemanded("abort", "X", "x"), events.TakeoverDemanded("abort", "X", "x", land_at=(39.0, 22.0)),
    events.BrakeDemanded("X", "x"), events.PositionLost("x"), events.PositionFound(),
    events.ContactLost("hover", "x"), events.ContactLost("hover", "x", tour=True), events.ContactLost("abort", "x", (39.0, 22.0)), events.ContactRestored(),
    events.GrantChanged(None, DRIVER), events.GrantChanged(DRIVER, None), events.GrantChanged(DRIVER, DRIVER),
    events.GrantChanged(None, TOUR), events.GrantChanged(TOUR, None),
    *(events.VehicleObserved(facts) for facts in FACTS),
    events.VehicleFound(), events.Heartbeat(), events.Airborne(),
    events.ModeChangeBegan(RTL), events.ModeChangeEnded(RTL, GUIDED, done=False), events.ModeChangeEnded(RTL, GUIDED, done=True),
    events.ArmingRequested("a", "A", (1.0, 2.0, 3.0)), events.ArmingPrepared(begins=True), events.ArmingPrepared(begins=False),
    events.MotorStart(begins=True), events.MotorStart(begins=False),
    events.TransitBegan(1, "a", "A"), events.TransitBegan(2, "t", "T"), events.SystemFlightBegan(3, "a"),
    events.SystemFlightEnded(1), events.SystemFlightEnded(3),
    events.TourBegan("t"), events.TourPointVisited("t", 1), events.TourInterrupted("t", "link"),
    events.TourEnded("t", Outcome(OutcomeKind.COMPLETE)), events.SystemTaskEnded(0, finished=True),
    events.SystemTaskEnded(0, finished=False), events.PassengerBoarded("t", "T"), events.Tick(),
)  # fmt: skip
LATE_S = 60.0
"""Time after the expiry of all deadlines, in seconds."""

FOUND_ON_GROUND = transition(ControlState(vehicle=GROUND), events.VehicleFound(), 0.0)[0]


def normalized(state: ControlState, now: float) -> ControlState:
    """Return a state with normalized times, task ids and counters. Equivalent states become equal."""
    grace = state.grace
    motion = state.motion
    task = state.task
    return replace(
        state,
        grace=replace(grace, until=grace.until - now) if grace is not None else None,
        motion=replace(motion, hover_at=motion.hover_at - now) if motion and motion.hover_at is not None else motion,
        motion_began_at=-math.inf,
        unattended_since=None if state.unattended_since is None else 0.0,
        task=replace(task, task_id=0) if task is not None else None,
        last_task_id=0,
        mode_changes=min(state.mode_changes, 1),
        preparing=min(state.preparing, 1),
        missions={
            key: replace(
                m,
                points_done=min(m.points_done, 1),
                waypoints=0,
                takeover="",
                takeovers=0,
                counts=WaypointCounts(),
                legs=0,
                corrected_legs=0,
            )
            for key, m in state.missions.items()
        },
    )


def key_of(state: ControlState) -> tuple[Any, ...]:
    return (*(getattr(state, name) for name in state.__slots__ if name != "missions"), *sorted(state.missions.items()))


def after(state: ControlState, event: events.Event) -> tuple[ControlState, tuple[Action, ...], ControlState]:
    """Apply an event and check the transition. Return the new state, the actions and the normalized state."""
    now = LATE_S if isinstance(event, events.Tick) else 0.0
    after_state, actions = transition(state, event, now)
    check(state, event, after_state, actions)
    return after_state, actions, normalized(after_state, now)


# Invariants


class TransitionText(tuple[Any, ...]):
    """Text that describes a transition. It is formatted only if an assertion fails, to save time."""

    __slots__ = ()

    def __new__(cls, *parts: object) -> TransitionText:
        return super().__new__(cls, parts)

    def __str__(self) -> str:
        return "".join(
            f"\n{name} {part}" for name, part in zip(("before", "event", "now", "actions"), self, strict=True)
        )


def check(before: ControlState, event: events.Event, now: ControlState, actions: tuple[Action, ...]) -> None:
    """Check all invariants of a transition."""
    transition_text = TransitionText(before, event, now, actions)
    if now.granted:
        assert now.authority is Authority.DRIVER, f"a lease is granted without driver authority{transition_text}"
    if now.authority is Authority.DRIVER:
        assert now.lease is not None, f"a driver commands without a lease{transition_text}"
    if before.authority is Authority.PILOT and now.authority is not Authority.PILOT:
        assert isinstance(event, events.Heartbeat), f"a pilot was overruled{transition_text}"
    if isinstance(event, events.Tick) and now.decided:
        assert now.attended, f"an armed vehicle is unattended{transition_text}"
    if isinstance(event, events.TakeoverDemanded):
        assert now.authority is not Authority.DRIVER, f"a takeover left the driver in command{transition_text}"
    check_tasks(before, event, now, actions, transition_text)
    check_missions(before, now, actions, transition_text)
    check_notifications(before, event, now, actions, transition_text)


def check_tasks(
    before: ControlState,
    event: events.Event,
    now: ControlState,
    actions: tuple[Action, ...],
    transition_text: TransitionText,
) -> None:
    started = [action.task for action in actions if isinstance(action, StartSystemTask)]
    assert len(started) <= 1, f"two tasks fly at once{transition_text}"
    if started:
        assert now.task == started[0], f"the started task is not the current task{transition_text}"
        assert now.authority is Authority.SYSTEM, f"the system flies without authority{transition_text}"
    elif now.task is not None and now.task != before.task:
        assert isinstance(event, events.TourBegan), f"a task became current without being started{transition_text}"
    if now.authority is Authority.PILOT:
        assert now.task is None, f"a system task runs under pilot authority{transition_text}"


def check_missions(
    before: ControlState, now: ControlState, actions: tuple[Action, ...], transition_text: TransitionText
) -> None:
    if now.lease is not None:
        mission = now.missions.get(now.lease.key)
        assert mission is None or mission.outcome is None, f"a lease exists for an ended mission{transition_text}"
    for key, mission in before.missions.items():
        if mission.outcome is not None:
            assert now.missions[key].outcome == mission.outcome, f"an ended mission was continued{transition_text}"
    ended = {
        k for k, m in now.missions.items() if m.outcome and (k not in before.missions or not before.missions[k].outcome)
    }
    assert not ended or SaveJournal() in actions, f"a mission end is not saved to the journal{transition_text}"
    if now.grace is not None and now.grace != before.grace:
        assert now.missions[now.grace.key].outcome is None, (
            f"a grace period is running for an ended mission{transition_text}"
        )


def check_notifications(
    before: ControlState,
    event: events.Event,
    now: ControlState,
    actions: tuple[Action, ...],
    transition_text: TransitionText,
) -> None:
    """Check that each ended stream was notified and each ended motion was stopped."""
    lease = before.lease
    motion = before.motion
    if lease is not None and (now.lease is None or now.lease.lease_id != lease.lease_id):
        notified = any(
            isinstance(action, EndStream) or (isinstance(action, SendEvent) and action.event.final)
            for action in actions
            if isinstance(action, EndStream | SendEvent) and action.lease_id == lease.lease_id
        )
        assert notified or event == events.StreamClosed(lease.lease_id), (
            f"a stream was not notified of its end{transition_text}"
        )
    if motion is not None and (now.motion is None or now.motion.motion_id != motion.motion_id):
        stopped = any(isinstance(action, StopMotion) and action.motion_id == motion.motion_id for action in actions)
        over = event in {events.MotionFinished(motion.motion_id), events.MotionFailed(motion.motion_id)}
        replaced = isinstance(event, events.MotionBegan)
        assert stopped or over or replaced, f"a motion was not stopped{transition_text}"


# Reachable states


def reached(depth: int, every: int = 1) -> Iterator[ControlState]:
    """Yield every state that is reachable with at most `depth` events.

    The initial states are a vehicle on the ground, and a vehicle found in the air after a restart. The last step
    expands only every `every`-th state.
    """
    flying = replace(
        FOUND_ON_GROUND, vehicle=FLYING, armed_seen=True, missions={"a": Mission("a", "A", flown=True)}, active="a"
    )
    frontier = [FOUND_ON_GROUND, replace(flying, grants=frozenset({"a"})), ControlState(vehicle=FLYING)]
    visited = {key_of(state) for state in frontier}
    for step in range(depth):
        following = []
        for state in frontier[:: every if step == depth - 1 else 1]:
            for event in EVENTS:
                _, _, after_state = after(state, event)
                if (key := key_of(after_state)) not in visited:
                    visited.add(key)
                    following.append(after_state)
        yield from frontier
        frontier = following
    yield from frontier


def test_all_control_events_are_tested() -> None:
    kinds = {kind for union in get_args(events.Event) for kind in (get_args(union) or (union,))}
    assert {type(event) for event in EVENTS} == kinds


def test_control_invariants_hold_in_all_states_within_few_events() -> None:
    assert len(list(reached(4) if DEEP else reached(3, every=3))) > 4_000


@given(st.lists(st.tuples(st.sampled_from(EVENTS), st.sampled_from((0.0, 0.1, 1.0, LATE_S))), max_size=60))
def test_control_invariants_hold_in_long_histories(history: list[tuple[events.Event, float]]) -> None:
    state = FOUND_ON_GROUND
    now = 0.0
    for event, passed_s in history:
        now += passed_s
        before = state
        if isinstance(event, events.SystemTaskEnded):
            event = replace(event, task_id=state.last_task_id)  # noqa: PLW2901 - the running task
        state, actions = transition(before, event, now)
        check(before, event, state, actions)
        assert (state, actions) == transition(before, event, now), "the transition is not deterministic"


@given(st.lists(st.sampled_from(EVENTS), max_size=40))
def test_flying_vehicle_returns_home_without_further_events(history: list[events.Event]) -> None:
    state = FOUND_ON_GROUND
    now = 0.0
    for event in history:
        state, _ = transition(state, event, now)
    if not (state.decided and state.vehicle.armed):
        return
    # No further events arrive, except ticks and the end of successful tasks.
    for _ in range(4):
        now += LATE_S
        state, _ = transition(state, events.Tick(), now)
        if state.task is not None and state.task.kind is TaskKind.HOVER:
            state, _ = transition(state, events.SystemTaskEnded(state.task.task_id, finished=True), now)
    answered = state.drives or state.authority is Authority.PILOT or state.starting_motors or state.flight is not None
    assert answered or state.returning or state.touring is not None


def test_motors_that_stop_in_flight_are_not_recorded_as_a_landing() -> None:
    """An autopilot that restarts in flight first loses its position. That is not the reason why the mission fails."""
    state = FOUND_ON_GROUND
    recorded: list[RecordAudit] = []

    def after(event: events.Event, now: float) -> None:
        nonlocal state
        state, actions = transition(state, event, now)
        recorded.extend(action for action in actions if isinstance(action, RecordAudit))

    for event in (
        events.GrantChanged(None, DRIVER), events.StreamOpened(1, "a", "A"), events.GrantControl(1), events.MotorStart(begins=True),
        events.VehicleObserved(FLYING), events.Heartbeat(), events.MotorStart(begins=False), events.Airborne(),
        events.PositionLost("the drone's position is unknown"), events.VehicleObserved(replace(GROUND, stopped_in_air=True, silent_s=6.0)),
        events.Heartbeat(),
    ):  # fmt: skip
        after(event, 1.0)
    assert "landed" not in {entry.action for entry in recorded}
    assert (recorded[-1].action, recorded[-1].code) == ("stopped", "MotorsStoppedInAir")
    assert "may have restarted" in recorded[-1].reason
    after(events.Tick(), 1000.0)
    assert (recorded[-1].kind, recorded[-1].code) == ("takeover", "MotorsStoppedInAir")
    assert "motors stopped" in str(state.missions["a"].outcome)

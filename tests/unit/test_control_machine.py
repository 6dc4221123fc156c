"""The state machine of control: what holds in every state that can be reached, and after every event."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, get_args

from depth import DEEP
from fractus_core.control import Authority, ControlState, Mission, Outcome, OutcomeKind
from fractus_core.control import events as told
from fractus_core.control.actions import (
    Action,
    EndStream,
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
DRIVER, TOUR = told.GrantRef("a", commands_vehicle=True), told.GrantRef("t", commands_vehicle=True)

EVENTS: tuple[told.Event, ...] = (
    told.StreamOpened(1, "a", "A"), told.StreamOpened(2, "b", "B"), told.StreamOpened(3, "a", "A"),
    told.StreamClosed(1), told.StreamClosed(2), told.StreamClosed(3),
    told.TransitRequested(1), told.TransitFailed(1, "fault"),
    told.GrantControl(1), told.GrantControl(2), told.GrantControl(3),
    told.ControlReturned("a", 1), told.ControlReturned("a", 9), told.ControlReturned("b", 1),
    told.WaypointsDone("a", 1), told.CruiseSpeedSet(3.0),
    told.MotionBegan(1, "Goto"), told.MotionBegan(2, "Land"), told.MotionFinished(1), told.MotionFailed(1),
    told.MotionCancelled(1), told.MotionCancelled(2), told.MotionStopped("Slower", "it is too fast"),
    told.TakeoverDemanded("hover", "X", "x"), told.TakeoverDemanded("land", "X", "x"),
    told.TakeoverDemanded("returnToLaunch", "X", "x"), told.TakeoverDemanded("revoke", "X", "x"),
    told.BrakeDemanded("X", "x"), told.PositionLost("x"), told.PositionFound(),
    told.GrantChanged(None, DRIVER), told.GrantChanged(DRIVER, None), told.GrantChanged(DRIVER, DRIVER),
    told.GrantChanged(None, TOUR), told.GrantChanged(TOUR, None),
    *(told.VehicleObserved(facts) for facts in FACTS),
    told.VehicleFound(), told.Heartbeat(), told.Airborne(),
    told.ModeChangeBegan(RTL), told.ModeChangeEnded(RTL, GUIDED, done=False), told.ModeChangeEnded(RTL, GUIDED, done=True),
    told.ArmingRequested("a", "A", (1.0, 2.0, 3.0)), told.ArmingPrepared(begins=True), told.ArmingPrepared(begins=False),
    told.MotorStart(begins=True), told.MotorStart(begins=False),
    told.TransitBegan(1, "a", "A"), told.TransitBegan(2, "t", "T"), told.SystemFlightBegan(3, "a"),
    told.SystemFlightEnded(1), told.SystemFlightEnded(3),
    told.TourBegan("t"), told.TourPointVisited("t", 1), told.TourInterrupted("t", "link"),
    told.TourEnded("t", Outcome(OutcomeKind.COMPLETE)), told.SystemTaskEnded(0, finished=True),
    told.SystemTaskEnded(0, finished=False), told.PassengerBoarded("t", "T"), told.Tick(),
)  # fmt: skip
LATE_S = 60.0
"""Every deadline has come by then."""

FOUND = transition(ControlState(vehicle=GROUND), told.VehicleFound(), 0.0)[0]


def settled(state: ControlState, now: float) -> ControlState:
    """The same state as if it were now zero o'clock, and the task were the first: so that states that differ in nothing else meet."""
    grace, motion, task = state.grace, state.motion, state.task
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
        missions={key: replace(m, points_done=min(m.points_done, 1), waypoints=0) for key, m in state.missions.items()},
    )


def key_of(state: ControlState) -> tuple[Any, ...]:
    return (*(getattr(state, name) for name in state.__slots__ if name != "missions"), *sorted(state.missions.items()))


def after(state: ControlState, event: told.Event) -> tuple[ControlState, tuple[Action, ...], ControlState]:
    """What an event makes of a state: as it is, the actions, and settled."""
    now = LATE_S if isinstance(event, told.Tick) else 0.0
    made, actions = transition(state, event, now)
    check(state, event, made, actions)
    return made, actions, settled(made, now)


# What always holds


class Where(tuple[Any, ...]):
    """A transition, written out only when something is wrong with it."""

    __slots__ = ()

    def __new__(cls, *parts: object) -> Where:
        return super().__new__(cls, parts)

    def __str__(self) -> str:
        return "".join(
            f"\n{name} {part}" for name, part in zip(("before", "event", "now", "actions"), self, strict=True)
        )


def check(before: ControlState, event: told.Event, now: ControlState, actions: tuple[Action, ...]) -> None:
    """Every property of a transition."""
    where = Where(before, event, now, actions)
    if now.granted:
        assert now.authority is Authority.DRIVER, f"a lease is granted without authority{where}"
    if now.authority is Authority.DRIVER:
        assert now.lease is not None, f"a driver commands without a lease{where}"
    if before.authority is Authority.PILOT and now.authority is not Authority.PILOT:
        assert isinstance(event, told.Heartbeat), f"a pilot was overruled{where}"
    if isinstance(event, told.Tick) and now.decided:
        assert now.attended, f"an armed vehicle is left alone{where}"
    if isinstance(event, told.TakeoverDemanded):
        assert now.authority is not Authority.DRIVER, f"a takeover left the driver in command{where}"
    check_tasks(before, event, now, actions, where)
    check_missions(before, now, actions, where)
    check_told(before, event, now, actions, where)


def check_tasks(
    before: ControlState, event: told.Event, now: ControlState, actions: tuple[Action, ...], where: Where
) -> None:
    started = [action.task for action in actions if isinstance(action, StartSystemTask)]
    assert len(started) <= 1, f"two tasks fly at once{where}"
    if started:
        assert now.task == started[0], f"what was started is not what counts{where}"
        assert now.authority is Authority.SYSTEM, f"the system flies without authority{where}"
    elif now.task is not None and now.task != before.task:
        assert isinstance(event, told.TourBegan), f"a task counts that no one started{where}"
    if now.authority is Authority.PILOT:
        assert now.task is None, f"the system works against a pilot{where}"


def check_missions(before: ControlState, now: ControlState, actions: tuple[Action, ...], where: Where) -> None:
    if now.lease is not None:
        mission = now.missions.get(now.lease.key)
        assert mission is None or mission.outcome is None, f"a driver waits for a mission that is over{where}"
    for key, mission in before.missions.items():
        if mission.outcome is not None:
            assert now.missions[key].outcome == mission.outcome, f"a mission that ended goes on{where}"
    ended = {
        k for k, m in now.missions.items() if m.outcome and (k not in before.missions or not before.missions[k].outcome)
    }
    assert not ended or SaveJournal() in actions, f"an end is not written down{where}"
    if now.grace is not None and now.grace != before.grace:
        assert now.missions[now.grace.key].outcome is None, f"a mission that ended is waited for{where}"


def check_told(
    before: ControlState, event: told.Event, now: ControlState, actions: tuple[Action, ...], where: Where
) -> None:
    """Who loses something hears of it."""
    lease, motion = before.lease, before.motion
    if lease is not None and (now.lease is None or now.lease.lease_id != lease.lease_id):
        heard = any(
            isinstance(action, EndStream) or (isinstance(action, SendEvent) and action.event.final)
            for action in actions
            if isinstance(action, EndStream | SendEvent) and action.lease_id == lease.lease_id
        )
        assert heard or event == told.StreamClosed(lease.lease_id), f"a stream was not told of its end{where}"
    if motion is not None and (now.motion is None or now.motion.motion_id != motion.motion_id):
        stopped = any(isinstance(action, StopMotion) and action.motion_id == motion.motion_id for action in actions)
        over = event in {told.MotionFinished(motion.motion_id), told.MotionFailed(motion.motion_id)}
        replaced = isinstance(event, told.MotionBegan)
        assert stopped or over or replaced, f"a motion was not stopped{where}"


# Reaching every state


def reached(depth: int, every: int = 1) -> Iterator[ControlState]:
    """Every state that is some events away from a vehicle that was found on the ground, or in the air after a restart.

    The last event happens in one of `every` states.
    """
    flying = replace(FOUND, vehicle=FLYING, armed_seen=True, missions={"a": Mission("a", "A", flown=True)}, active="a")
    frontier = [FOUND, replace(flying, grants=frozenset({"a"})), ControlState(vehicle=FLYING)]
    seen = {key_of(state) for state in frontier}
    for step in range(depth):
        following = []
        for state in frontier[:: every if step == depth - 1 else 1]:
            for event in EVENTS:
                _, _, made = after(state, event)
                if (key := key_of(made)) not in seen:
                    seen.add(key)
                    following.append(made)
        yield from frontier
        frontier = following
    yield from frontier


def test_control_events_are_all_covered() -> None:
    kinds = {kind for union in get_args(told.Event) for kind in (get_args(union) or (union,))}
    assert {type(event) for event in EVENTS} == kinds


def test_control_invariants_hold_in_all_states_within_few_events() -> None:
    assert len(list(reached(4) if DEEP else reached(3, every=3))) > 4_000


@given(st.lists(st.tuples(st.sampled_from(EVENTS), st.sampled_from((0.0, 0.1, 1.0, LATE_S))), max_size=60))
def test_control_invariants_hold_in_long_histories(history: list[tuple[told.Event, float]]) -> None:
    state, now = FOUND, 0.0
    for event, passed_s in history:
        now += passed_s
        before = state
        if isinstance(event, told.SystemTaskEnded):
            event = replace(event, task_id=state.last_task_id)  # noqa: PLW2901 - the one that runs
        state, actions = transition(before, event, now)
        check(before, event, state, actions)
        assert (state, actions) == transition(before, event, now), "the same again"


@given(st.lists(st.sampled_from(EVENTS), max_size=40))
def test_flying_vehicle_returns_home_without_further_events(history: list[told.Event]) -> None:
    state, now = FOUND, 0.0
    for event in history:
        state, _ = transition(state, event, now)
    if not (state.decided and state.vehicle.armed):
        return
    # Nothing happens any more but time, and what the system started ends as it should.
    for _ in range(4):
        now += LATE_S
        state, _ = transition(state, told.Tick(), now)
        if state.task is not None and state.task.kind is TaskKind.HOVER:
            state, _ = transition(state, told.SystemTaskEnded(state.task.task_id, finished=True), now)
    answered = state.drives or state.authority is Authority.PILOT or state.starting_motors or state.flight is not None
    assert answered or state.returning or state.touring is not None

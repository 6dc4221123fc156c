"""The state machine of control: what holds in every state that can be reached, and after every event."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, get_args

import pytest
from depth import DEEP
from fractus_core.control import Authority, ControlState, Mission, Outcome, OutcomeKind, StreamState, transition
from fractus_core.control import events as told
from fractus_core.control.actions import (
    Action,
    EndStream,
    RecordAudit,
    RefuseStream,
    SaveJournal,
    SendEvent,
    StartSystemTask,
    StopMotion,
)
from fractus_core.control.values import (
    ActiveMotion,
    FlightMode,
    Grace,
    ModeKind,
    SystemTask,
    TaskKind,
    VehicleFacts,
    ended_refusal,
)
from fractus_core.control.vehicles import UNCONFIRMED_S
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
DRIVER, TOUR = told.GrantRef("a", leads=True), told.GrantRef("t", leads=True)

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


def test_every_event_is_walked() -> None:
    kinds = {kind for union in get_args(told.Event) for kind in (get_args(union) or (union,))}
    assert {type(event) for event in EVENTS} == kinds


def test_every_state_within_some_events_keeps_what_always_holds() -> None:
    assert len(list(reached(4) if DEEP else reached(3, every=3))) > 4_000


@given(st.lists(st.tuples(st.sampled_from(EVENTS), st.sampled_from((0.0, 0.1, 1.0, LATE_S))), max_size=60))
def test_long_histories_keep_what_always_holds(history: list[tuple[told.Event, float]]) -> None:
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
def test_a_flying_vehicle_without_events_comes_home_in_the_end(history: list[told.Event]) -> None:
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


# Single rules


def told_of(*events: told.Event, state: ControlState = FOUND) -> tuple[ControlState, tuple[Action, ...]]:
    """A history at one moment, and the actions of its last event."""
    actions: tuple[Action, ...] = ()
    for event in events:
        state, actions = transition(state, event, 0.0)
    return state, actions


ASKS = (told.GrantChanged(None, DRIVER), told.StreamOpened(1, "a", "A"), told.GrantControl(1))
ARMS = (told.MotorStart(begins=True), told.VehicleObserved(ARMED), told.Heartbeat(), told.MotorStart(begins=False))
FLIES = (*ASKS, *ARMS, told.VehicleObserved(FLYING), told.Heartbeat(), told.Airborne())


def test_control_is_granted_and_returned() -> None:
    state, actions = told_of(*FLIES)
    assert state.controller == "A"
    state, actions = told_of(told.ControlReturned("a", 1), state=state)
    assert state.missions["a"].outcome == Outcome(OutcomeKind.COMPLETE)
    assert state.returning
    assert [action.event.state for action in actions if isinstance(action, SendEvent)] == [StreamState.COMPLETE]
    _, actions = told_of(told.StreamOpened(2, "a", "A"), state=state)
    assert actions == (RefuseStream(2, "MissionComplete", "the mission is complete"),)


@pytest.mark.parametrize(
    ("done", "kind"),
    [
        ((), OutcomeKind.FAILED),
        ((told.WaypointsDone("a", 2),), OutcomeKind.FAILED),
        ((told.WaypointsDone("a", 0, leg=True),), OutcomeKind.COMPLETE),
        (
            (told.WaypointsDone("a", 1, leg=True), told.ControlReturned("a", 2, paths=True), *ASKS[1:]),
            OutcomeKind.COMPLETE,
        ),
    ],
)
def test_a_mission_that_flew_nothing_of_its_path_is_not_complete(
    done: tuple[told.Event, ...], kind: OutcomeKind
) -> None:
    state, _ = told_of(*FLIES, *done, told.ControlReturned("a", 1, paths=True))
    outcome = state.missions["a"].outcome
    assert outcome is not None
    assert outcome.kind is kind
    assert state.returning, "the drone comes home all the same"


@pytest.mark.parametrize("action", ["hover", "land", "returnToLaunch", "revoke"])
def test_a_takeover_ends_the_mission_unless_it_only_hovers(action: Any) -> None:
    state, _ = told_of(*FLIES, told.TakeoverDemanded(action, "Code", "why"))
    kinds = {
        "hover": None,
        "land": OutcomeKind.FAILED,
        "returnToLaunch": OutcomeKind.FAILED,
        "revoke": OutcomeKind.REVOKED,
    }
    outcome = state.missions["a"].outcome
    assert (outcome.kind if outcome is not None else None) is kinds[action]
    assert (state.grace is not None) is (action == "hover")
    assert state.lease is None


def test_a_lost_driver_has_its_grace_and_then_the_vehicle_comes_home() -> None:
    state, _ = told_of(*FLIES, told.StreamClosed(1))
    assert state.task == SystemTask(1, TaskKind.HOVER)
    assert state.grace == Grace(5.0, "a", "driver lost")
    assert transition(state, told.Tick(), 4.9)[0].task == state.task
    home, actions = transition(state, told.Tick(), 5.0)
    assert [action.code for action in actions if isinstance(action, RecordAudit)] == ["DriverLost"], (
        "by the deadline alone"
    )
    assert home.task == SystemTask(2, TaskKind.RETURN)
    assert home.missions["a"].outcome == Outcome(OutcomeKind.FAILED, "driver lost")


def refused_transit(state: ControlState, lease_id: int, begins: float, ends: float) -> ControlState:
    """A waiting driver for which the system flies until the way is refused, and its stream ends."""
    for event in (
        told.StreamOpened(lease_id, "a", "A"),
        told.TransitRequested(lease_id),
        told.TransitBegan(lease_id, "a", "A"),
    ):
        state, _ = transition(state, event, begins)
    for event in (told.SystemFlightEnded(lease_id), told.StreamClosed(lease_id)):
        state, _ = transition(state, event, ends)
    return state


def test_transits_that_are_refused_begin_no_grace_again() -> None:
    state, _ = told_of(*FLIES, told.StreamClosed(1))
    for attempt in range(3):
        state = refused_transit(state, 2 + attempt, 1.0 + attempt, 1.5 + attempt)
        assert state.grace == Grace(5.0, "a", "driver lost")
    home, _ = transition(state, told.Tick(), 5.0)
    assert home.task is not None
    assert home.task.kind is TaskKind.RETURN


@pytest.mark.parametrize("again", [told.VehicleFound(), told.TakeoverDemanded("hover", "Code", "why")])
def test_what_is_found_or_taken_again_and_again_gets_no_more_time_for_its_driver(again: told.Event) -> None:
    state, _ = told_of(*FLIES, told.StreamClosed(1))
    for now in (1.0, 3.0, 4.5):
        state, _ = transition(state, again, now)
        assert state.deadline == 5.0
    home, _ = transition(state, told.Tick(), 5.0)
    assert home.task is not None
    assert home.task.kind is TaskKind.RETURN
    assert home.missions["a"].outcome is not None


def test_a_driver_that_waits_for_anothers_vehicle_takes_none_of_its_time() -> None:
    other = told.GrantRef("b", leads=True)
    waits = (told.GrantChanged(None, other), told.StreamOpened(2, "b", "B"))
    landed = (told.VehicleObserved(GROUND), told.Heartbeat(), told.StreamClosed(1))
    waiting, _ = told_of(*FLIES, *landed, *waits)
    assert (waiting.lease is not None, waiting.deadline) == (True, 5.0)
    gone, _ = transition(waiting, told.GrantChanged(other, None), 1.0)
    assert (gone.lease, gone.deadline) == (None, 5.0)


def test_a_grace_waits_for_the_end_of_a_transit_and_a_driver_that_gets_the_vehicle_ends_it() -> None:
    state, _ = told_of(*FLIES, told.StreamClosed(1))
    asks = (told.StreamOpened(2, "a", "A"), told.TransitRequested(2), told.TransitBegan(9, "a", "A"))
    flying, _ = told_of(*asks, state=state)
    assert flying.deadline is None
    later, _ = transition(flying, told.Tick(), 50.0)
    assert later.missions["a"].outcome is None
    arrived, _ = told_of(told.SystemFlightEnded(9), told.GrantControl(2), state=later)
    assert (arrived.grace, arrived.drives) == (None, True)
    refused, _ = transition(later, told.SystemFlightEnded(9), 50.0)
    assert refused.deadline == 5.0
    home, _ = transition(refused, told.Tick(), 50.0)
    assert home.missions["a"].outcome == Outcome(OutcomeKind.FAILED, "driver lost")


def test_a_way_home_that_fails_each_time_is_left_to_the_autopilot() -> None:
    state = replace(ControlState(), decided=True, armed_seen=True, vehicle=FLYING)
    takes = 0
    for tick in range(100):
        state, actions = transition(state, told.Tick(), tick * 0.05)
        takes += any(isinstance(action, RecordAudit) for action in actions)
        if state.task is not None:
            state, _ = transition(state, told.SystemTaskEnded(state.task.task_id, finished=False), tick * 0.05)
    assert takes == 3
    assert state.unattended_since == 0.0, "so that the heartbeats end"
    landed, _ = told_of(told.VehicleObserved(replace(FLYING, armed=False, in_air=False)), told.Heartbeat(), state=state)
    assert (landed.unattended, landed.attended) == (0, True)


def test_a_second_stream_that_leaves_while_it_waits_leaves_no_authority_behind() -> None:
    second = (told.StreamOpened(2, "a", "A"), told.StreamClosed(2))
    state, _ = told_of(*ASKS, *second)
    assert state.authority is Authority.SYSTEM
    armed, _ = told_of(told.VehicleObserved(ARMED), told.Heartbeat(), state=state)
    assert armed.authority is Authority.PILOT, "who arms it is no driver"


@pytest.mark.parametrize("mode", [GUIDED, LOITER])
def test_a_vehicle_that_others_arm_is_no_drivers(mode: FlightMode) -> None:
    chosen = told.VehicleObserved(replace(GROUND, mode=mode)), told.Heartbeat()
    state, _ = told_of(*ASKS, *chosen)
    assert state.controller == "A", "on the ground a mode is no one's"
    state, actions = told_of(told.VehicleObserved(replace(ARMED, mode=mode)), told.Heartbeat(), state=state)
    assert state.authority is Authority.PILOT
    assert state.lease is None
    assert [action.event.state for action in actions if isinstance(action, SendEvent)] == [StreamState.LOST]
    for flown in (LOITER, GUIDED):
        state, _ = told_of(told.VehicleObserved(replace(FLYING, mode=flown)), told.Heartbeat(), *ASKS[1:], state=state)
        assert state.authority is Authority.PILOT, (
            "no fence, home or limits of a mission: it cannot be handed over in flight"
        )
    landed, _ = told_of(told.VehicleObserved(GROUND), told.Heartbeat(), *ASKS[1:], state=state)
    assert landed.controller == "A", "nothing was flown for the mission: it goes on"


def test_a_cancelled_motion_hovers_for_a_driver_that_is_still_there() -> None:
    state, _ = told_of(*FLIES, told.MotionBegan(7, "Land"), told.MotionCancelled(7))
    assert state.motion == ActiveMotion(7, "Land", hover_at=0.3)
    assert not transition(state, told.Tick(), 0.2)[1]
    gone, _ = transition(state, told.StreamClosed(1), 0.2)
    assert gone.motion is None
    _, actions = transition(state, told.Tick(), 0.3)
    assert [type(action).__name__ for action in actions] == ["StopMotion", "HoldPosition"]


def test_a_vehicle_that_a_pilot_hands_back_waits_for_its_driver() -> None:
    loiter, guided = (told.VehicleObserved(replace(FLYING, mode=mode)) for mode in (LOITER, GUIDED))
    state, _ = told_of(*FLIES, loiter, told.Heartbeat(), guided, told.Heartbeat())
    assert state.authority is Authority.SYSTEM
    assert state.task == SystemTask(1, TaskKind.HOVER)
    assert state.grace == Grace(5.0, "a", "driver lost")


def test_a_mode_that_the_system_did_not_ask_for_is_a_pilots() -> None:
    asked = told.VehicleObserved(replace(FLYING, mode=RTL))
    ours, _ = told_of(
        *FLIES, told.ModeChangeBegan(RTL), asked, told.Heartbeat(), told.ModeChangeEnded(RTL, GUIDED, True)
    )
    assert ours.authority is Authority.DRIVER
    assert told_of(told.Heartbeat(), state=ours)[0].authority is Authority.DRIVER
    foreign, _ = told_of(*FLIES, asked, told.Heartbeat())
    assert foreign.authority is Authority.PILOT
    failsafe, _ = told_of(*FLIES, told.VehicleObserved(replace(FLYING, mode=RTL, failsafe=True)), told.Heartbeat())
    assert (failsafe.authority, failsafe.returning) == (Authority.SYSTEM, True)


def test_a_failsafe_that_brakes_leaves_the_vehicle_to_no_pilot() -> None:
    braking = replace(FLYING, mode=FlightMode("BRAKE", ModeKind.BRAKING))
    chosen, _ = told_of(*FLIES, told.VehicleObserved(braking), told.Heartbeat())
    assert chosen.authority is Authority.PILOT
    for facts in (
        replace(braking, failsafe=True),
        replace(braking, failsafe_text="Fence breached", failsafe_text_at=-1.0),
    ):
        failed, _ = told_of(*FLIES, told.VehicleObserved(facts), told.Heartbeat())
        assert failed.authority is Authority.SYSTEM
        assert failed.task == SystemTask(1, TaskKind.RETURN)
        assert str(failed.missions["a"].outcome).startswith("failed: the autopilot's own failsafe")
        later, _ = told_of(told.VehicleObserved(facts), told.Heartbeat(), state=chosen)
        assert later.authority is Authority.PILOT, "who has chosen it has the vehicle"


def test_a_vehicle_that_is_found_braked_by_a_failsafe_comes_home() -> None:
    braking = replace(FLYING, mode=FlightMode("BRAKE", ModeKind.BRAKING))
    for facts, authority, task in (
        (replace(braking, failsafe=True), Authority.SYSTEM, TaskKind.RETURN),
        (braking, Authority.PILOT, None),
    ):
        found, _ = told_of(told.VehicleFound(), state=ControlState(vehicle=facts))
        assert (found.authority, found.task.kind if found.task is not None else None) == (authority, task)


def test_motors_that_were_asked_for_are_ours_whenever_they_are_seen() -> None:
    late = (*ARMS[:2], ARMS[3], told.Heartbeat())
    state, _ = told_of(*ASKS, *late)
    assert (state.authority, state.armed_by_others) == (Authority.DRIVER, False)
    others, _ = told_of(*ASKS, told.VehicleObserved(ARMED), told.Heartbeat())
    assert (others.authority, others.armed_by_others) == (Authority.PILOT, True)


@pytest.mark.parametrize(
    ("facts", "late_s", "unanswered", "authority"),
    [
        (ARMED, UNCONFIRMED_S - 0.1, True, Authority.DRIVER),
        (ARMED, UNCONFIRMED_S + 0.1, True, Authority.PILOT),
        (replace(ARMED, mode=LOITER), 1.0, True, Authority.PILOT),
        (ARMED, 1.0, False, Authority.PILOT),
    ],
)
def test_motors_that_show_after_a_start_without_answers_are_ours_for_a_while(
    facts: VehicleFacts, late_s: float, unanswered: bool, authority: Authority
) -> None:
    start = told.MotorStart(begins=True), told.MotorStart(begins=False, unanswered=unanswered)
    state, _ = told_of(*ASKS, *start, told.VehicleObserved(replace(facts, armed=False)), told.Heartbeat())
    for event in (told.VehicleObserved(facts), told.Heartbeat()):
        state, _ = transition(state, event, late_s)
    assert (state.authority, state.armed_by_others) == (authority, authority is Authority.PILOT)


def test_a_mode_change_whose_answers_were_lost_is_the_systems() -> None:
    flies = replace(FLYING, mode=RTL)
    ours, _ = told_of(*FLIES, told.VehicleObserved(replace(flies, failsafe=True)), told.Heartbeat())
    given_up, _ = told_of(told.ModeChangeBegan(GUIDED), told.ModeChangeEnded(GUIDED, RTL, done=False), state=ours)
    shown = (told.VehicleObserved(FLYING), told.Heartbeat())
    obeyed, _ = told_of(*shown, state=given_up)
    assert (obeyed.authority, obeyed.task, obeyed.returning) == (Authority.SYSTEM, ours.task, True)
    other, _ = told_of(told.VehicleObserved(replace(FLYING, mode=LOITER)), told.Heartbeat(), state=given_up)
    assert other.authority is Authority.PILOT
    observed, _ = told_of(shown[0], state=given_up)
    assert transition(observed, shown[1], LATE_S)[0].authority is Authority.PILOT, "too late to be ours"


def test_a_mode_that_the_autopilot_refused_is_not_the_systems() -> None:
    refused = (told.ModeChangeBegan(RTL), told.ModeChangeEnded(RTL, GUIDED, done=False, refused=True))
    state, _ = told_of(*FLIES, *refused)
    returns = replace(FLYING, mode=RTL)
    assert told_of(told.VehicleObserved(returns), told.Heartbeat(), state=state)[0].authority is Authority.PILOT
    failsafe, _ = told_of(told.VehicleObserved(replace(returns, failsafe=True)), told.Heartbeat(), state=state)
    assert (failsafe.task, failsafe.returning) == (SystemTask(1, TaskKind.RETURN), True)
    assert failsafe.missions["a"].outcome is not None


def test_a_return_that_is_obeyed_late_is_watched_by_the_system() -> None:
    given_up = (told.ModeChangeBegan(RTL), told.ModeChangeEnded(RTL, GUIDED, done=False))
    shown = (told.VehicleObserved(replace(FLYING, mode=RTL)), told.Heartbeat())
    alone, _ = told_of(*FLIES, *given_up, told.StreamClosed(1), *shown)
    assert (alone.task, alone.returning, alone.deadline) == (SystemTask(2, TaskKind.RETURN), True, 5.0)
    driven, _ = told_of(*FLIES, *given_up, *shown)
    assert (driven.authority, driven.task) == (Authority.DRIVER, None)


@pytest.mark.parametrize("mode", [GUIDED, RTL])
def test_a_driver_that_is_lost_on_its_way_home_may_come_back_on_it(mode: FlightMode) -> None:
    homeward = (told.MotionBegan(1, "ReturnToLaunch"), told.ModeChangeBegan(mode))
    turns = (
        told.VehicleObserved(replace(FLYING, mode=mode)),
        told.Heartbeat(),
        told.ModeChangeEnded(mode, GUIDED, True),
    )
    lost, _ = told_of(*FLIES, *homeward, *turns, told.StreamClosed(1))
    assert (lost.task, lost.returning, lost.deadline) == (SystemTask(1, TaskKind.RETURN), True, 5.0)
    back, _ = told_of(told.StreamOpened(2, "a", "A"), told.GrantControl(2), state=lost)
    assert (back.drives, back.returning, back.task, back.grace) == (True, False, None, None)
    late, actions = transition(lost, told.Tick(), 5.0)
    assert late.missions["a"].outcome == Outcome(OutcomeKind.FAILED, "driver lost")
    assert not any(isinstance(action, StartSystemTask) for action in actions), "it is on its way already"
    assert told_of(told.StreamOpened(2, "a", "A"), state=late)[1][0] == RefuseStream(
        2, *ended_refusal(late.outcomes["a"])
    )


def test_a_return_that_a_pilot_chooses_after_a_failsafe_is_the_pilots() -> None:
    flies = replace(FLYING, failsafe=True)
    heard = [(told.VehicleObserved(replace(flies, mode=mode)), told.Heartbeat()) for mode in (RTL, GUIDED, RTL)]
    taken = (told.ModeChangeBegan(GUIDED), *heard[1], told.ModeChangeEnded(GUIDED, RTL, done=True))
    ours, _ = told_of(*FLIES, *heard[0], *taken, told.Heartbeat())
    assert ours.authority is Authority.SYSTEM
    assert told_of(*heard[2], state=ours)[0].authority is Authority.PILOT


@pytest.mark.parametrize(("silent_s", "mode", "authority"), [
    (5.1, RTL, Authority.SYSTEM), (2.0, RTL, Authority.PILOT), (5.1, LOITER, Authority.PILOT),
])  # fmt: skip
def test_a_return_that_began_while_the_link_was_cut_is_the_failsafes(
    silent_s: float, mode: FlightMode, authority: Authority
) -> None:
    heard = told.VehicleObserved(replace(FLYING, mode=mode, silent_s=silent_s))
    state, _ = told_of(*FLIES, heard, told.Heartbeat())
    assert state.authority is authority
    assert state.returning is (authority is Authority.SYSTEM)


def test_a_return_that_is_found_is_told_from_one_of_the_system() -> None:
    known, _ = told_of(told.ArmingRequested("a", "A", (1.0, 2.0, 3.0)), told.VehicleObserved(replace(FLYING, mode=RTL)))
    found, _ = told_of(told.VehicleFound(), state=replace(known, expected_mode=None))
    assert found.task is not None and found.task.found
    again, _ = told_of(told.VehicleFound(), state=found)
    assert again.task is not None and again.task.found, "a broken link makes it no one else's"
    begun, _ = told_of(told.TakeoverDemanded("returnToLaunch", "X", "x"), state=replace(known, expected_mode=RTL))
    again, _ = told_of(told.VehicleFound(), state=begun)
    assert again.task is not None and not again.task.found


def test_a_failsafe_that_is_found_without_a_mission_is_the_systems() -> None:
    for failsafe, authority in ((True, Authority.SYSTEM), (False, Authority.PILOT)):
        flies = replace(FLYING, mode=RTL, failsafe=failsafe)
        found, _ = told_of(told.VehicleFound(), state=ControlState(vehicle=flies))
        assert found.authority is authority
        assert found.attended
        assert found.returning is failsafe


def test_a_mission_that_a_pilot_landed_is_not_granted_again() -> None:
    pilots = FlightMode("LOITER", ModeKind.OTHER)
    taken = (told.VehicleObserved(replace(FLYING, mode=pilots)), told.Heartbeat(), told.StreamOpened(2, "a", "A"))
    waiting, _ = told_of(*FLIES, *taken)
    assert waiting.authority is Authority.PILOT
    assert waiting.lease is not None
    landed, actions = told_of(
        told.VehicleObserved(replace(FLYING, mode=pilots, armed=False, in_air=False)), told.Heartbeat(), state=waiting
    )
    assert landed.missions["a"].outcome is not None
    assert landed.lease is None
    assert [action.event.state for action in actions if isinstance(action, SendEvent)] == [StreamState.LOST]
    again, _ = told_of(told.GrantControl(2), told.TransitBegan(1, "a", "A"), state=landed)
    assert not again.drives
    assert again.flight is None


def test_a_waiting_driver_that_loses_its_grant_ends_no_other_mission() -> None:
    other = told.GrantRef("b", leads=True)
    grounded = (*ASKS, told.StreamClosed(1), told.GrantChanged(None, other), told.StreamOpened(2, "b", "B"))
    state, _ = told_of(*grounded)
    assert (state.active, state.lease is not None) == ("a", True)
    after_, actions = told_of(told.GrantChanged(other, None), state=state)
    assert after_.missions["a"].outcome is None
    assert after_.missions["b"].outcome == Outcome(OutcomeKind.REVOKED, "the grant was removed")
    assert (after_.active, after_.lease, after_.removed) == ("a", None, None)
    assert [action.event.state for action in actions if isinstance(action, SendEvent)] == [StreamState.LOST]


def test_a_mission_that_is_over_is_refused_with_what_begins_another() -> None:
    code, reason = ended_refusal(Outcome(OutcomeKind.FAILED, "the driver did not come back"))
    assert code == "MissionEnded"
    assert reason.endswith("; another flight needs a Grant with another uid")

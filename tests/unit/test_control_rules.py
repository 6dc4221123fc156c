"""Single rules of the control state machine."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from fractus_core.control import Authority, ControlState, Outcome, OutcomeKind, StreamState, WaypointCounts, events
from fractus_core.control.actions import (
    Action,
    RecordAudit,
    RefuseStream,
    SendEvent,
    StartSystemTask,
)
from fractus_core.control.machine import transition
from fractus_core.control.state import (
    ActiveMotion,
    FlightMode,
    Grace,
    ModeKind,
    SystemTask,
    TaskKind,
    VehicleFacts,
    ended_refusal,
)
from fractus_core.control.vehicle_events import UNCONFIRMED_S
from test_control_machine import ARMED, DRIVER, FLYING, FOUND_ON_GROUND, GROUND, GUIDED, LAND, LATE_S, LOITER, RTL


def apply_events(
    *history: events.Event, state: ControlState = FOUND_ON_GROUND
) -> tuple[ControlState, tuple[Action, ...]]:
    """Apply events at time 0. Return the state and the actions of the last event."""
    actions: tuple[Action, ...] = ()
    for event in history:
        state, actions = transition(state, event, 0.0)
    return state, actions


REQUEST_CONTROL = (events.GrantChanged(None, DRIVER), events.StreamOpened(1, "a", "A"), events.GrantControl(1))
ARM = (
    events.MotorStart(begins=True),
    events.VehicleObserved(ARMED),
    events.Heartbeat(),
    events.MotorStart(begins=False),
)
FLY = (*REQUEST_CONTROL, *ARM, events.VehicleObserved(FLYING), events.Heartbeat(), events.Airborne())


def test_control_is_granted_and_returned() -> None:
    state, actions = apply_events(*FLY)
    assert state.controller == "A"
    state, actions = apply_events(events.ControlReturned("a", 1), state=state)
    assert state.missions["a"].outcome == Outcome(OutcomeKind.COMPLETE)
    assert state.returning
    assert [action.event.state for action in actions if isinstance(action, SendEvent)] == [StreamState.COMPLETE]
    _, actions = apply_events(events.StreamOpened(2, "a", "A"), state=state)
    reason = "the mission is complete; another flight needs a Grant with another uid"
    assert actions == (RefuseStream(2, "MissionComplete", reason),)


def test_control_points_of_audit_entries_are_numbered_from_1() -> None:
    state, _ = apply_events(*FLY, events.ControlReturned("a", 2))
    _, actions = apply_events(*REQUEST_CONTROL[1:], state=state)
    assert [action.reason for action in actions if isinstance(action, RecordAudit)] == ["control point 2"]


@pytest.mark.parametrize(
    ("done", "kind"),
    [
        ((), OutcomeKind.FAILED),
        ((events.WaypointsDone("a", 2),), OutcomeKind.FAILED),
        ((events.WaypointsDone("a", 0, leg=True),), OutcomeKind.COMPLETE),
        (
            (events.WaypointsDone("a", 1, leg=True), events.ControlReturned("a", 2, paths=True), *REQUEST_CONTROL[1:]),
            OutcomeKind.COMPLETE,
        ),
    ],
)
def test_mission_fails_if_no_leg_of_its_path_was_flown(done: tuple[events.Event, ...], kind: OutcomeKind) -> None:
    state, _ = apply_events(*FLY, *done, events.ControlReturned("a", 1, paths=True))
    outcome = state.missions["a"].outcome
    assert outcome is not None
    assert outcome.kind is kind
    assert state.returning, "the drone returns home with either outcome"


@pytest.mark.parametrize("action", ["hover", "land", "returnToLaunch", "abort", "revoke"])
def test_takeover_ends_mission_unless_action_is_hover(action: Any) -> None:
    state, _ = apply_events(*FLY, events.TakeoverDemanded(action, "Code", "why"))
    kinds = {
        "hover": None,
        "land": OutcomeKind.FAILED,
        "returnToLaunch": OutcomeKind.FAILED,
        "abort": OutcomeKind.REVOKED,
        "revoke": OutcomeKind.REVOKED,
    }
    outcome = state.missions["a"].outcome
    assert (outcome.kind if outcome is not None else None) is kinds[action]
    assert (state.grace is not None) is (action == "hover")
    assert state.lease is None


@pytest.mark.parametrize(("land_at", "kind"), [((39.1, 22.9), TaskKind.LAND_AT), (None, TaskKind.RETURN)])
def test_abort_leads_to_landing_place_or_home(land_at: tuple[float, float] | None, kind: TaskKind) -> None:
    state, _ = apply_events(*FLY, events.TakeoverDemanded("abort", "Code", "why", land_at=land_at))
    assert (state.task is not None and state.task.kind, state.missions["a"].land_at) == (kind, land_at)
    assert state.home_for_good


def test_vehicle_returns_home_after_grace_of_lost_driver() -> None:
    state, _ = apply_events(*FLY, events.StreamClosed(1))
    assert state.task == SystemTask(1, TaskKind.HOVER)
    assert state.grace == Grace(5.0, "a", "driver lost")
    assert transition(state, events.Tick(), 4.9)[0].task == state.task
    home, actions = transition(state, events.Tick(), 5.0)
    assert [action.code for action in actions if isinstance(action, RecordAudit)] == ["DriverLost"], (
        "the expired grace is the only cause of the return"
    )
    assert home.task == SystemTask(2, TaskKind.RETURN)
    assert home.missions["a"].outcome == Outcome(OutcomeKind.FAILED, "driver lost")


def refused_transit(state: ControlState, lease_id: int, begins: float, ends: float) -> ControlState:
    """Apply a transit that ends without control for the waiting driver. The stream of the driver then ends."""
    for event in (
        events.StreamOpened(lease_id, "a", "A"),
        events.TransitRequested(lease_id),
        events.TransitBegan(lease_id, "a", "A"),
    ):
        state, _ = transition(state, event, begins)
    for event in (events.SystemFlightEnded(lease_id), events.StreamClosed(lease_id)):
        state, _ = transition(state, event, ends)
    return state


def test_refused_transits_do_not_restart_grace() -> None:
    state, _ = apply_events(*FLY, events.StreamClosed(1))
    for attempt in range(3):
        state = refused_transit(state, 2 + attempt, 1.0 + attempt, 1.5 + attempt)
        assert state.grace == Grace(5.0, "a", "driver lost")
    home, _ = transition(state, events.Tick(), 5.0)
    assert home.task is not None
    assert home.task.kind is TaskKind.RETURN


@pytest.mark.parametrize("again", [events.VehicleFound(), events.TakeoverDemanded("hover", "Code", "why")])
def test_repeated_takeover_or_reconnect_does_not_extend_grace(again: events.Event) -> None:
    state, _ = apply_events(*FLY, events.StreamClosed(1))
    for now in (1.0, 3.0, 4.5):
        state, _ = transition(state, again, now)
        assert state.deadline == 5.0
    home, _ = transition(state, events.Tick(), 5.0)
    assert home.task is not None
    assert home.task.kind is TaskKind.RETURN
    assert home.missions["a"].outcome is not None


def test_grace_is_unchanged_by_waiting_driver_of_other_mission() -> None:
    other = events.GrantRef("b", commands_vehicle=True)
    waits = (events.GrantChanged(None, other), events.StreamOpened(2, "b", "B"))
    landed = (events.VehicleObserved(GROUND), events.Heartbeat(), events.StreamClosed(1))
    waiting, _ = apply_events(*FLY, *landed, *waits)
    assert (waiting.lease is not None, waiting.deadline) == (True, 5.0)
    after_removal, _ = transition(waiting, events.GrantChanged(other, None), 1.0)
    assert (after_removal.lease, after_removal.deadline) == (None, 5.0)


def test_grace_is_paused_during_transit_and_ends_when_control_is_granted() -> None:
    state, _ = apply_events(*FLY, events.StreamClosed(1))
    transit_events = (events.StreamOpened(2, "a", "A"), events.TransitRequested(2), events.TransitBegan(9, "a", "A"))
    flying, _ = apply_events(*transit_events, state=state)
    assert flying.deadline is None
    later, _ = transition(flying, events.Tick(), 50.0)
    assert later.missions["a"].outcome is None
    arrived, _ = apply_events(events.SystemFlightEnded(9), events.GrantControl(2), state=later)
    assert (arrived.grace, arrived.drives) == (None, True)
    refused, _ = transition(later, events.SystemFlightEnded(9), 50.0)
    assert refused.deadline == 5.0
    home, _ = transition(refused, events.Tick(), 50.0)
    assert home.missions["a"].outcome == Outcome(OutcomeKind.FAILED, "driver lost")


def test_return_is_left_to_autopilot_after_three_failures() -> None:
    state = replace(ControlState(), decided=True, armed_seen=True, vehicle=FLYING)
    takes = 0
    for tick in range(100):
        state, actions = transition(state, events.Tick(), tick * 0.05)
        takes += any(isinstance(action, RecordAudit) for action in actions)
        if state.task is not None:
            state, _ = transition(state, events.SystemTaskEnded(state.task.task_id, finished=False), tick * 0.05)
    assert takes == 3
    assert state.unattended_since == 0.0, "the service must stop sending heartbeats to the autopilot"
    landed, _ = apply_events(
        events.VehicleObserved(replace(FLYING, armed=False, in_air=False)), events.Heartbeat(), state=state
    )
    assert (landed.unattended, landed.attended) == (0, True)


def test_second_stream_of_a_driver_is_refused_while_the_first_is_open() -> None:
    state, _ = apply_events(*FLY)
    refused, actions = apply_events(events.StreamOpened(2, "a", "A"), state=state)
    assert [(action.code, "another process" in action.reason) for action in actions if isinstance(action, RefuseStream)] == [
        ("ControlHeld", True)
    ]  # fmt: skip
    assert refused == state, "the refused stream changed the state of the first driver"
    closed, _ = apply_events(events.StreamClosed(2), state=refused)
    assert closed.drives
    again, _ = apply_events(
        events.StreamClosed(1), events.StreamOpened(3, "a", "A"), events.GrantControl(3), state=closed
    )
    assert again.drives, "the driver cannot continue after its first stream ended"


@pytest.mark.parametrize(
    ("flown", "counts"),
    [
        ((events.WaypointsDone("a", 1, leg=True), events.WaypointsDone("a", 2, leg=True)), WaypointCounts(2, 0, 0)),
        ((events.WaypointsDone("a", 1, leg=True, corrected=True), events.WaypointsDone("a", 2)), WaypointCounts(1, 1, 1)),
        ((events.WaypointsDone("a", 0, leg=True), events.WaypointsDone("a", 1)), WaypointCounts(1, 1, 0)),
        ((events.WaypointsDone("a", 0, leg=True), events.WaypointsDone("a", 0, leg=True), events.WaypointsDone("a", 2)), WaypointCounts(2, 0, 0)),
        ((events.WaypointsDone("a", 2), events.WaypointsDone("a", 1)), WaypointCounts(0, 2, 0)),
    ],
)  # fmt: skip
def test_outcome_counts_waypoints_with_a_leg_as_reached(
    flown: tuple[events.Event, ...], counts: WaypointCounts
) -> None:
    state, _ = apply_events(*FLY, *flown, events.ControlReturned("a", 1, waypoints=2))
    assert state.outcomes["a"].waypoints == counts


def test_unresponsive_driver_loses_control_and_may_come_back() -> None:
    silent, actions = apply_events(*FLY, events.DriverUnresponsive(1, 5.0))
    assert [(action.action, action.code) for action in actions if isinstance(action, RecordAudit)] == [
        ("hover", "DriverUnresponsive")
    ]
    assert silent.task == SystemTask(1, TaskKind.HOVER)
    assert [action.event.state for action in actions if isinstance(action, SendEvent)] == [StreamState.LOST]
    resumed, _ = apply_events(events.StreamOpened(2, "a", "A"), events.GrantControl(2), state=silent)
    assert (resumed.drives, resumed.grace) == (True, None)
    home, _ = transition(silent, events.Tick(), 5.0)
    assert home.missions["a"].outcome == Outcome(OutcomeKind.FAILED, "the driver's program did not respond for 5 s")


def demand_hover(state: ControlState, lease_id: int, code: str = "Code") -> ControlState:
    """Take control for a driver, then demand a takeover with the action `hover`."""
    state, _ = apply_events(
        events.StreamOpened(lease_id, "a", "A"),
        events.GrantControl(lease_id),
        events.TakeoverDemanded("hover", code, "the leg is too long", ("short",)),
        state=state,
    )
    return state


def test_repeated_takeover_for_one_reason_ends_the_mission_with_that_reason() -> None:
    state, _ = apply_events(*FLY, events.StreamClosed(1))
    for lease_id in (2, 3):
        state = demand_hover(state, lease_id)
        assert state.missions["a"].outcome is None
        assert state.grace is not None
    ended = demand_hover(state, 4)
    outcome = ended.missions["a"].outcome
    assert outcome is not None
    assert outcome.kind is OutcomeKind.FAILED
    assert outcome.reason.startswith("the leg is too long")
    assert "3 times" in outcome.reason
    assert ended.returning
    assert ended.grace is None


@pytest.mark.parametrize("between", ["waypoint", "other reason"])
def test_takeovers_are_not_repeated_after_a_waypoint_or_for_another_reason(between: str) -> None:
    state, _ = apply_events(*FLY, events.StreamClosed(1))
    for attempt in range(5):
        state = demand_hover(state, 2 + attempt, "Code" if between == "waypoint" or attempt % 2 else "Other")
        if between == "waypoint":
            state, _ = apply_events(events.WaypointsDone("a", 1 + attempt), state=state)
    assert state.missions["a"].outcome is None


@pytest.mark.parametrize(("error", "times"), [("hangs", 3), ("crashes", 10)])
def test_driver_that_repeats_its_error_without_a_waypoint_ends_its_mission(error: str, times: int) -> None:
    state, _ = apply_events(*FLY)
    for attempt in range(1, times + 1):
        assert state.drives
        lost: events.Event = events.StreamClosed(attempt)
        if error == "hangs":
            lost = events.DriverUnresponsive(attempt, 5.0)
        again = (events.StreamOpened(attempt + 1, "a", "A"), events.GrantControl(attempt + 1))
        lost_state, _ = apply_events(lost, state=state)
        state, _ = apply_events(*again, state=lost_state)
    outcome = state.missions["a"].outcome
    assert outcome is not None
    assert outcome.reason.endswith(f"{times} times without a further waypoint")
    assert (state.returning, state.grace, state.drives) == (True, None, False)


def test_driver_that_is_interrupted_for_changing_reasons_ends_its_mission() -> None:
    state, _ = apply_events(*FLY, events.StreamClosed(1))
    for attempt in range(8):
        assert state.missions["a"].outcome is None
        state = demand_hover(state, 2 + attempt, f"Code{attempt % 2}")
    state, _ = apply_events(events.StreamOpened(10, "a", "A"), events.GrantControl(10), state=state)
    state, _ = apply_events(events.StreamClosed(10), state=state)
    assert state.missions["a"].outcome == Outcome(
        OutcomeKind.FAILED, "driver lost; the driver was interrupted 10 times without a further waypoint"
    )
    assert state.returning


def test_landing_continues_if_the_last_permitted_loss_ends_the_mission() -> None:
    state, _ = apply_events(*FLY)
    state = replace(state, missions={"a": replace(state.missions["a"], interruptions=9)})
    landing = events.VehicleObserved(replace(FLYING, mode=LAND)), events.Heartbeat()
    began = events.ModeChangeBegan(LAND), events.MotionBegan(1, "Land"), *landing
    state, _ = apply_events(*began, events.ModeChangeEnded(LAND, GUIDED, done=True, refused=False), state=state)
    state, _ = apply_events(events.StreamClosed(1), state=state)
    assert state.missions["a"].outcome is not None
    assert (state.task is not None and state.task.kind, state.attended) == (TaskKind.LAND, True)


def test_takeovers_on_the_ground_are_not_counted() -> None:
    state, _ = apply_events(events.GrantChanged(None, DRIVER))
    for attempt in range(5):
        state = demand_hover(state, 1 + attempt)
    assert state.missions["a"].outcome is None


@pytest.mark.parametrize("mode", [GUIDED, LOITER])
def test_vehicle_armed_by_others_belongs_to_pilot(mode: FlightMode) -> None:
    chosen = events.VehicleObserved(replace(GROUND, mode=mode)), events.Heartbeat()
    state, _ = apply_events(*REQUEST_CONTROL, *chosen)
    assert state.controller == "A", "a mode change on the ground does not change the authority"
    state, actions = apply_events(events.VehicleObserved(replace(ARMED, mode=mode)), events.Heartbeat(), state=state)
    assert state.authority is Authority.PILOT
    assert state.lease is None
    assert [action.event.state for action in actions if isinstance(action, SendEvent)] == [StreamState.LOST]
    for flown in (LOITER, GUIDED):
        state, _ = apply_events(
            events.VehicleObserved(replace(FLYING, mode=flown)), events.Heartbeat(), *REQUEST_CONTROL[1:], state=state
        )
        assert state.authority is Authority.PILOT, (
            "a driver gets no control in this flight, because fence, home and limits were not prepared"
        )
    landed, _ = apply_events(events.VehicleObserved(GROUND), events.Heartbeat(), *REQUEST_CONTROL[1:], state=state)
    assert landed.controller == "A", "the mission has not flown yet, so it can begin after the landing"


def test_cancelled_motion_hovers_if_driver_is_still_connected() -> None:
    state, _ = apply_events(*FLY, events.MotionBegan(7, "Land"), events.MotionCancelled(7))
    assert state.motion == ActiveMotion(7, "Land", hover_at=0.3)
    assert not transition(state, events.Tick(), 0.2)[1]
    after_removal, _ = transition(state, events.StreamClosed(1), 0.2)
    assert after_removal.motion is None
    _, actions = transition(state, events.Tick(), 0.3)
    assert [type(action).__name__ for action in actions] == ["StopMotion", "HoldPosition"]


def test_vehicle_handed_back_by_pilot_hovers_during_driver_grace() -> None:
    loiter, guided = (events.VehicleObserved(replace(FLYING, mode=mode)) for mode in (LOITER, GUIDED))
    state, _ = apply_events(*FLY, loiter, events.Heartbeat(), guided, events.Heartbeat())
    assert state.authority is Authority.SYSTEM
    assert state.task == SystemTask(1, TaskKind.HOVER)
    assert state.grace == Grace(5.0, "a", "driver lost")


def test_unrequested_mode_change_gives_authority_to_pilot() -> None:
    mode_observed = events.VehicleObserved(replace(FLYING, mode=RTL))
    system_state, _ = apply_events(
        *FLY, events.ModeChangeBegan(RTL), mode_observed, events.Heartbeat(), events.ModeChangeEnded(RTL, GUIDED, True)
    )
    assert system_state.authority is Authority.DRIVER
    assert apply_events(events.Heartbeat(), state=system_state)[0].authority is Authority.DRIVER
    foreign, _ = apply_events(*FLY, mode_observed, events.Heartbeat())
    assert foreign.authority is Authority.PILOT
    failsafe, _ = apply_events(
        *FLY, events.VehicleObserved(replace(FLYING, mode=RTL, failsafe=True)), events.Heartbeat()
    )
    assert (failsafe.authority, failsafe.returning) == (Authority.SYSTEM, True)


def test_braking_failsafe_starts_return_instead_of_pilot_authority() -> None:
    braking = replace(FLYING, mode=FlightMode("BRAKE", ModeKind.BRAKING))
    chosen, _ = apply_events(*FLY, events.VehicleObserved(braking), events.Heartbeat())
    assert chosen.authority is Authority.PILOT
    for facts in (
        replace(braking, failsafe=True),
        replace(braking, failsafe_text="Fence breached", failsafe_text_at=-1.0),
    ):
        failed, _ = apply_events(*FLY, events.VehicleObserved(facts), events.Heartbeat())
        assert failed.authority is Authority.SYSTEM
        assert failed.task == SystemTask(1, TaskKind.RETURN)
        assert str(failed.missions["a"].outcome).startswith("failed: the autopilot's own failsafe")
        later, _ = apply_events(events.VehicleObserved(facts), events.Heartbeat(), state=chosen)
        assert later.authority is Authority.PILOT, (
            "a failsafe does not take over a vehicle whose pilot has chosen the mode"
        )


def test_vehicle_found_in_brake_mode_returns_home_if_failsafe_is_active() -> None:
    braking = replace(FLYING, mode=FlightMode("BRAKE", ModeKind.BRAKING))
    for facts, authority, task in (
        (replace(braking, failsafe=True), Authority.SYSTEM, TaskKind.RETURN),
        (braking, Authority.PILOT, None),
    ):
        recovered, _ = apply_events(events.VehicleFound(), state=ControlState(vehicle=facts))
        assert (recovered.authority, recovered.task.kind if recovered.task is not None else None) == (authority, task)


def test_arming_that_appears_late_belongs_to_driver_that_requested_it() -> None:
    late_arming = (*ARM[:2], ARM[3], events.Heartbeat())
    state, _ = apply_events(*REQUEST_CONTROL, *late_arming)
    assert (state.authority, state.armed_by_others) == (Authority.DRIVER, False)
    others, _ = apply_events(*REQUEST_CONTROL, events.VehicleObserved(ARMED), events.Heartbeat())
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
def test_unconfirmed_arming_belongs_to_driver_for_limited_time(
    facts: VehicleFacts, late_s: float, unanswered: bool, authority: Authority
) -> None:
    start = events.MotorStart(begins=True), events.MotorStart(begins=False, unanswered=unanswered)
    state, _ = apply_events(
        *REQUEST_CONTROL, *start, events.VehicleObserved(replace(facts, armed=False)), events.Heartbeat()
    )
    for event in (events.VehicleObserved(facts), events.Heartbeat()):
        state, _ = transition(state, event, late_s)
    assert (state.authority, state.armed_by_others) == (authority, authority is Authority.PILOT)


def test_unconfirmed_mode_change_belongs_to_system_for_limited_time() -> None:
    flies = replace(FLYING, mode=RTL)
    system_state, _ = apply_events(*FLY, events.VehicleObserved(replace(flies, failsafe=True)), events.Heartbeat())
    abandoned, _ = apply_events(
        events.ModeChangeBegan(GUIDED), events.ModeChangeEnded(GUIDED, RTL, done=False), state=system_state
    )
    shown = (events.VehicleObserved(FLYING), events.Heartbeat())
    obeyed, _ = apply_events(*shown, state=abandoned)
    assert (obeyed.authority, obeyed.task, obeyed.returning) == (Authority.SYSTEM, system_state.task, True)
    other, _ = apply_events(events.VehicleObserved(replace(FLYING, mode=LOITER)), events.Heartbeat(), state=abandoned)
    assert other.authority is Authority.PILOT
    observed, _ = apply_events(shown[0], state=abandoned)
    assert transition(observed, shown[1], LATE_S)[0].authority is Authority.PILOT, (
        "a mode change that appears too late counts as a change by the pilot"
    )


def test_late_mode_change_belongs_to_system_while_next_mode_change_is_pending() -> None:
    abandoned = (events.ModeChangeBegan(LAND), events.ModeChangeEnded(LAND, GUIDED, done=False))
    shows = {
        mode: (events.VehicleObserved(replace(FLYING, mode=mode)), events.Heartbeat())
        for mode in (LAND, GUIDED, LOITER)
    }
    next_change = (events.ModeChangeBegan(GUIDED), *shows[LAND])
    done = (*shows[GUIDED], events.ModeChangeEnded(GUIDED, LAND, done=True), events.Heartbeat())
    system_state, _ = apply_events(*FLY, *abandoned, *next_change, *done)
    assert system_state.authority is Authority.DRIVER
    pilots, _ = apply_events(*FLY, *abandoned, *next_change, *shows[LOITER])
    assert pilots.authority is Authority.PILOT
    state, _ = apply_events(*FLY, *abandoned)
    for event in next_change:
        state, _ = transition(state, event, UNCONFIRMED_S + 0.1)
    assert state.authority is Authority.PILOT, "the late mode change counts as a change by the pilot"


def test_late_mode_change_requested_before_failsafe_belongs_to_system() -> None:
    returns = (events.VehicleObserved(replace(FLYING, mode=RTL, failsafe=True)), events.Heartbeat())
    mode_requests = (events.ModeChangeBegan(LAND), *returns, events.ModeChangeEnded(LAND, GUIDED, done=False))
    lands = (events.VehicleObserved(replace(FLYING, mode=LAND, failsafe=True)), events.Heartbeat())
    system_state, _ = apply_events(*FLY, *mode_requests, *lands)
    assert system_state.authority is Authority.SYSTEM
    refused = (*mode_requests[:-1], events.ModeChangeEnded(LAND, GUIDED, done=False, refused=True))
    assert apply_events(*FLY, *refused, *lands)[0].authority is Authority.PILOT


def test_refused_mode_change_does_not_belong_to_system() -> None:
    refused = (events.ModeChangeBegan(RTL), events.ModeChangeEnded(RTL, GUIDED, done=False, refused=True))
    state, _ = apply_events(*FLY, *refused)
    returns = replace(FLYING, mode=RTL)
    assert (
        apply_events(events.VehicleObserved(returns), events.Heartbeat(), state=state)[0].authority is Authority.PILOT
    )
    failsafe, _ = apply_events(events.VehicleObserved(replace(returns, failsafe=True)), events.Heartbeat(), state=state)
    assert (failsafe.task, failsafe.returning) == (SystemTask(1, TaskKind.RETURN), True)
    assert failsafe.missions["a"].outcome is not None


def test_late_return_mode_is_supervised_by_system_without_driver() -> None:
    abandoned = (events.ModeChangeBegan(RTL), events.ModeChangeEnded(RTL, GUIDED, done=False))
    shown = (events.VehicleObserved(replace(FLYING, mode=RTL)), events.Heartbeat())
    without_driver, _ = apply_events(*FLY, *abandoned, events.StreamClosed(1), *shown)
    assert (without_driver.task, without_driver.returning, without_driver.deadline) == (
        SystemTask(2, TaskKind.RETURN),
        True,
        5.0,
    )
    with_driver, _ = apply_events(*FLY, *abandoned, *shown)
    assert (with_driver.authority, with_driver.task) == (Authority.DRIVER, None)


@pytest.mark.parametrize("mode", [GUIDED, RTL])
def test_driver_lost_during_return_can_resume_control(mode: FlightMode) -> None:
    homeward = (events.MotionBegan(1, "ReturnToLaunch"), events.ModeChangeBegan(mode))
    turns = (
        events.VehicleObserved(replace(FLYING, mode=mode)),
        events.Heartbeat(),
        events.ModeChangeEnded(mode, GUIDED, True),
    )
    after_loss, _ = apply_events(*FLY, *homeward, *turns, events.StreamClosed(1))
    assert (after_loss.task, after_loss.returning, after_loss.deadline) == (SystemTask(1, TaskKind.RETURN), True, 5.0)
    resumed, _ = apply_events(events.StreamOpened(2, "a", "A"), events.GrantControl(2), state=after_loss)
    assert (resumed.drives, resumed.returning, resumed.task, resumed.grace) == (True, False, None, None)
    expired, actions = transition(after_loss, events.Tick(), 5.0)
    assert expired.missions["a"].outcome == Outcome(OutcomeKind.FAILED, "driver lost")
    assert not any(isinstance(action, StartSystemTask) for action in actions), "the return flight has already begun"
    assert apply_events(events.StreamOpened(2, "a", "A"), state=expired)[1][0] == RefuseStream(
        2, *ended_refusal(expired.outcomes["a"])
    )


def test_return_mode_chosen_by_pilot_after_failsafe_belongs_to_pilot() -> None:
    flies = replace(FLYING, failsafe=True)
    observations = [
        (events.VehicleObserved(replace(flies, mode=mode)), events.Heartbeat()) for mode in (RTL, GUIDED, RTL)
    ]
    taken = (events.ModeChangeBegan(GUIDED), *observations[1], events.ModeChangeEnded(GUIDED, RTL, done=True))
    system_state, _ = apply_events(*FLY, *observations[0], *taken, events.Heartbeat())
    assert system_state.authority is Authority.SYSTEM
    assert apply_events(*observations[2], state=system_state)[0].authority is Authority.PILOT


@pytest.mark.parametrize(("silent_s", "mode", "authority"), [
    (5.1, RTL, Authority.SYSTEM), (2.0, RTL, Authority.PILOT), (5.1, LOITER, Authority.PILOT),
])  # fmt: skip
def test_return_begun_during_link_outage_counts_as_failsafe(
    silent_s: float, mode: FlightMode, authority: Authority
) -> None:
    observations = events.VehicleObserved(replace(FLYING, mode=mode, silent_s=silent_s))
    state, _ = apply_events(*FLY, observations, events.Heartbeat())
    assert state.authority is authority
    assert state.returning is (authority is Authority.SYSTEM)


def test_return_found_after_restart_is_distinguished_from_return_of_system() -> None:
    known, _ = apply_events(
        events.ArmingRequested("a", "A", (1.0, 2.0, 3.0)), events.VehicleObserved(replace(FLYING, mode=RTL))
    )
    recovered, _ = apply_events(events.VehicleFound(), state=replace(known, expected_mode=None))
    assert recovered.task is not None and recovered.task.begun_by_others
    again, _ = apply_events(events.VehicleFound(), state=recovered)
    assert again.task is not None and again.task.begun_by_others, (
        "after a reconnect, the return flight still counts as a flight that another station began"
    )
    begun, _ = apply_events(
        events.TakeoverDemanded("returnToLaunch", "X", "x"), state=replace(known, expected_mode=RTL)
    )
    again, _ = apply_events(events.VehicleFound(), state=begun)
    assert again.task is not None and not again.task.begun_by_others


def test_found_failsafe_without_mission_belongs_to_system() -> None:
    for failsafe, authority in ((True, Authority.SYSTEM), (False, Authority.PILOT)):
        flies = replace(FLYING, mode=RTL, failsafe=failsafe)
        recovered, _ = apply_events(events.VehicleFound(), state=ControlState(vehicle=flies))
        assert recovered.authority is authority
        assert recovered.attended
        assert recovered.returning is failsafe


def test_mission_landed_by_pilot_is_not_granted_again() -> None:
    pilots = FlightMode("LOITER", ModeKind.OTHER)
    taken = (events.VehicleObserved(replace(FLYING, mode=pilots)), events.Heartbeat(), events.StreamOpened(2, "a", "A"))
    waiting, _ = apply_events(*FLY, *taken)
    assert waiting.authority is Authority.PILOT
    assert waiting.lease is not None
    landed, actions = apply_events(
        events.VehicleObserved(replace(FLYING, mode=pilots, armed=False, in_air=False)),
        events.Heartbeat(),
        state=waiting,
    )
    assert landed.missions["a"].outcome is not None
    assert landed.lease is None
    assert [action.event.state for action in actions if isinstance(action, SendEvent)] == [StreamState.LOST]
    again, _ = apply_events(events.GrantControl(2), events.TransitBegan(1, "a", "A"), state=landed)
    assert not again.drives
    assert again.flight is None


def test_removed_grant_of_waiting_driver_does_not_end_other_mission() -> None:
    other = events.GrantRef("b", commands_vehicle=True)
    grounded = (
        *REQUEST_CONTROL,
        events.StreamClosed(1),
        events.GrantChanged(None, other),
        events.StreamOpened(2, "b", "B"),
    )
    state, _ = apply_events(*grounded)
    assert (state.active, state.lease is not None) == ("a", True)
    after_, actions = apply_events(events.GrantChanged(other, None), state=state)
    assert after_.missions["a"].outcome is None
    assert after_.missions["b"].outcome == Outcome(OutcomeKind.REVOKED, "the grant was removed")
    assert (after_.active, after_.lease, after_.removed) == ("a", None, None)
    assert [action.event.state for action in actions if isinstance(action, SendEvent)] == [StreamState.LOST]


def test_refusal_of_ended_mission_explains_how_to_fly_again() -> None:
    code, reason = ended_refusal(Outcome(OutcomeKind.FAILED, "the driver did not come back"))
    assert code == "MissionEnded"
    assert reason.endswith("; another flight needs a Grant with another uid")

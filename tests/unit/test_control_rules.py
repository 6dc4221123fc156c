"""The rules of the control machine, one by one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from fractus_core.control import Authority, ControlState, Outcome, OutcomeKind, StreamState
from fractus_core.control import events as told
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
from test_control_machine import ARMED, DRIVER, FLYING, FOUND, GROUND, GUIDED, LAND, LATE_S, LOITER, RTL


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
def test_mission_fails_if_no_leg_of_its_path_was_flown(done: tuple[told.Event, ...], kind: OutcomeKind) -> None:
    state, _ = told_of(*FLIES, *done, told.ControlReturned("a", 1, paths=True))
    outcome = state.missions["a"].outcome
    assert outcome is not None
    assert outcome.kind is kind
    assert state.returning, "the drone comes home all the same"


@pytest.mark.parametrize("action", ["hover", "land", "returnToLaunch", "revoke"])
def test_takeover_ends_mission_unless_action_is_hover(action: Any) -> None:
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


def test_vehicle_returns_home_after_grace_of_lost_driver() -> None:
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


def test_refused_transits_do_not_restart_grace() -> None:
    state, _ = told_of(*FLIES, told.StreamClosed(1))
    for attempt in range(3):
        state = refused_transit(state, 2 + attempt, 1.0 + attempt, 1.5 + attempt)
        assert state.grace == Grace(5.0, "a", "driver lost")
    home, _ = transition(state, told.Tick(), 5.0)
    assert home.task is not None
    assert home.task.kind is TaskKind.RETURN


@pytest.mark.parametrize("again", [told.VehicleFound(), told.TakeoverDemanded("hover", "Code", "why")])
def test_repeated_takeover_or_reconnect_does_not_extend_grace(again: told.Event) -> None:
    state, _ = told_of(*FLIES, told.StreamClosed(1))
    for now in (1.0, 3.0, 4.5):
        state, _ = transition(state, again, now)
        assert state.deadline == 5.0
    home, _ = transition(state, told.Tick(), 5.0)
    assert home.task is not None
    assert home.task.kind is TaskKind.RETURN
    assert home.missions["a"].outcome is not None


def test_grace_is_unchanged_by_waiting_driver_of_other_mission() -> None:
    other = told.GrantRef("b", commands_vehicle=True)
    waits = (told.GrantChanged(None, other), told.StreamOpened(2, "b", "B"))
    landed = (told.VehicleObserved(GROUND), told.Heartbeat(), told.StreamClosed(1))
    waiting, _ = told_of(*FLIES, *landed, *waits)
    assert (waiting.lease is not None, waiting.deadline) == (True, 5.0)
    gone, _ = transition(waiting, told.GrantChanged(other, None), 1.0)
    assert (gone.lease, gone.deadline) == (None, 5.0)


def test_grace_is_paused_during_transit_and_ends_when_control_is_granted() -> None:
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


def test_return_is_left_to_autopilot_after_three_failures() -> None:
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


def test_closed_second_stream_leaves_no_driver_authority() -> None:
    second = (told.StreamOpened(2, "a", "A"), told.StreamClosed(2))
    state, _ = told_of(*ASKS, *second)
    assert state.authority is Authority.SYSTEM
    armed, _ = told_of(told.VehicleObserved(ARMED), told.Heartbeat(), state=state)
    assert armed.authority is Authority.PILOT, "who arms it is no driver"


@pytest.mark.parametrize("mode", [GUIDED, LOITER])
def test_vehicle_armed_by_others_belongs_to_pilot(mode: FlightMode) -> None:
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


def test_cancelled_motion_hovers_if_driver_is_still_connected() -> None:
    state, _ = told_of(*FLIES, told.MotionBegan(7, "Land"), told.MotionCancelled(7))
    assert state.motion == ActiveMotion(7, "Land", hover_at=0.3)
    assert not transition(state, told.Tick(), 0.2)[1]
    gone, _ = transition(state, told.StreamClosed(1), 0.2)
    assert gone.motion is None
    _, actions = transition(state, told.Tick(), 0.3)
    assert [type(action).__name__ for action in actions] == ["StopMotion", "HoldPosition"]


def test_vehicle_handed_back_by_pilot_hovers_during_driver_grace() -> None:
    loiter, guided = (told.VehicleObserved(replace(FLYING, mode=mode)) for mode in (LOITER, GUIDED))
    state, _ = told_of(*FLIES, loiter, told.Heartbeat(), guided, told.Heartbeat())
    assert state.authority is Authority.SYSTEM
    assert state.task == SystemTask(1, TaskKind.HOVER)
    assert state.grace == Grace(5.0, "a", "driver lost")


def test_unrequested_mode_change_gives_authority_to_pilot() -> None:
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


def test_braking_failsafe_starts_return_instead_of_pilot_authority() -> None:
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


def test_vehicle_found_in_brake_mode_returns_home_if_failsafe_is_active() -> None:
    braking = replace(FLYING, mode=FlightMode("BRAKE", ModeKind.BRAKING))
    for facts, authority, task in (
        (replace(braking, failsafe=True), Authority.SYSTEM, TaskKind.RETURN),
        (braking, Authority.PILOT, None),
    ):
        found, _ = told_of(told.VehicleFound(), state=ControlState(vehicle=facts))
        assert (found.authority, found.task.kind if found.task is not None else None) == (authority, task)


def test_requested_arming_belongs_to_driver_if_seen_late() -> None:
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
def test_unconfirmed_arming_belongs_to_driver_for_limited_time(
    facts: VehicleFacts, late_s: float, unanswered: bool, authority: Authority
) -> None:
    start = told.MotorStart(begins=True), told.MotorStart(begins=False, unanswered=unanswered)
    state, _ = told_of(*ASKS, *start, told.VehicleObserved(replace(facts, armed=False)), told.Heartbeat())
    for event in (told.VehicleObserved(facts), told.Heartbeat()):
        state, _ = transition(state, event, late_s)
    assert (state.authority, state.armed_by_others) == (authority, authority is Authority.PILOT)


def test_unconfirmed_mode_change_belongs_to_system_for_limited_time() -> None:
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


def test_late_mode_change_belongs_to_system_while_next_one_is_pending() -> None:
    given_up = (told.ModeChangeBegan(LAND), told.ModeChangeEnded(LAND, GUIDED, done=False))
    shows = {
        mode: (told.VehicleObserved(replace(FLYING, mode=mode)), told.Heartbeat()) for mode in (LAND, GUIDED, LOITER)
    }
    next_one = (told.ModeChangeBegan(GUIDED), *shows[LAND])
    done = (*shows[GUIDED], told.ModeChangeEnded(GUIDED, LAND, done=True), told.Heartbeat())
    ours, _ = told_of(*FLIES, *given_up, *next_one, *done)
    assert ours.authority is Authority.DRIVER
    pilots, _ = told_of(*FLIES, *given_up, *next_one, *shows[LOITER])
    assert pilots.authority is Authority.PILOT
    state, _ = told_of(*FLIES, *given_up)
    for event in next_one:
        state, _ = transition(state, event, UNCONFIRMED_S + 0.1)
    assert state.authority is Authority.PILOT, "too late to be ours"


def test_late_mode_change_requested_before_failsafe_belongs_to_system() -> None:
    returns = (told.VehicleObserved(replace(FLYING, mode=RTL, failsafe=True)), told.Heartbeat())
    asked = (told.ModeChangeBegan(LAND), *returns, told.ModeChangeEnded(LAND, GUIDED, done=False))
    lands = (told.VehicleObserved(replace(FLYING, mode=LAND, failsafe=True)), told.Heartbeat())
    ours, _ = told_of(*FLIES, *asked, *lands)
    assert ours.authority is Authority.SYSTEM
    refused = (*asked[:-1], told.ModeChangeEnded(LAND, GUIDED, done=False, refused=True))
    assert told_of(*FLIES, *refused, *lands)[0].authority is Authority.PILOT


def test_refused_mode_change_does_not_belong_to_system() -> None:
    refused = (told.ModeChangeBegan(RTL), told.ModeChangeEnded(RTL, GUIDED, done=False, refused=True))
    state, _ = told_of(*FLIES, *refused)
    returns = replace(FLYING, mode=RTL)
    assert told_of(told.VehicleObserved(returns), told.Heartbeat(), state=state)[0].authority is Authority.PILOT
    failsafe, _ = told_of(told.VehicleObserved(replace(returns, failsafe=True)), told.Heartbeat(), state=state)
    assert (failsafe.task, failsafe.returning) == (SystemTask(1, TaskKind.RETURN), True)
    assert failsafe.missions["a"].outcome is not None


def test_late_return_mode_is_supervised_by_system_without_driver() -> None:
    given_up = (told.ModeChangeBegan(RTL), told.ModeChangeEnded(RTL, GUIDED, done=False))
    shown = (told.VehicleObserved(replace(FLYING, mode=RTL)), told.Heartbeat())
    alone, _ = told_of(*FLIES, *given_up, told.StreamClosed(1), *shown)
    assert (alone.task, alone.returning, alone.deadline) == (SystemTask(2, TaskKind.RETURN), True, 5.0)
    driven, _ = told_of(*FLIES, *given_up, *shown)
    assert (driven.authority, driven.task) == (Authority.DRIVER, None)


@pytest.mark.parametrize("mode", [GUIDED, RTL])
def test_driver_lost_during_return_can_resume_control(mode: FlightMode) -> None:
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


def test_return_mode_chosen_by_pilot_after_failsafe_belongs_to_pilot() -> None:
    flies = replace(FLYING, failsafe=True)
    heard = [(told.VehicleObserved(replace(flies, mode=mode)), told.Heartbeat()) for mode in (RTL, GUIDED, RTL)]
    taken = (told.ModeChangeBegan(GUIDED), *heard[1], told.ModeChangeEnded(GUIDED, RTL, done=True))
    ours, _ = told_of(*FLIES, *heard[0], *taken, told.Heartbeat())
    assert ours.authority is Authority.SYSTEM
    assert told_of(*heard[2], state=ours)[0].authority is Authority.PILOT


@pytest.mark.parametrize(("silent_s", "mode", "authority"), [
    (5.1, RTL, Authority.SYSTEM), (2.0, RTL, Authority.PILOT), (5.1, LOITER, Authority.PILOT),
])  # fmt: skip
def test_return_begun_during_link_outage_counts_as_failsafe(
    silent_s: float, mode: FlightMode, authority: Authority
) -> None:
    heard = told.VehicleObserved(replace(FLYING, mode=mode, silent_s=silent_s))
    state, _ = told_of(*FLIES, heard, told.Heartbeat())
    assert state.authority is authority
    assert state.returning is (authority is Authority.SYSTEM)


def test_found_return_is_distinguished_from_return_of_system() -> None:
    known, _ = told_of(told.ArmingRequested("a", "A", (1.0, 2.0, 3.0)), told.VehicleObserved(replace(FLYING, mode=RTL)))
    found, _ = told_of(told.VehicleFound(), state=replace(known, expected_mode=None))
    assert found.task is not None and found.task.found
    again, _ = told_of(told.VehicleFound(), state=found)
    assert again.task is not None and again.task.found, "a broken link makes it no one else's"
    begun, _ = told_of(told.TakeoverDemanded("returnToLaunch", "X", "x"), state=replace(known, expected_mode=RTL))
    again, _ = told_of(told.VehicleFound(), state=begun)
    assert again.task is not None and not again.task.found


def test_found_failsafe_without_mission_belongs_to_system() -> None:
    for failsafe, authority in ((True, Authority.SYSTEM), (False, Authority.PILOT)):
        flies = replace(FLYING, mode=RTL, failsafe=failsafe)
        found, _ = told_of(told.VehicleFound(), state=ControlState(vehicle=flies))
        assert found.authority is authority
        assert found.attended
        assert found.returning is failsafe


def test_mission_landed_by_pilot_is_not_granted_again() -> None:
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


def test_removed_grant_of_waiting_driver_does_not_end_other_mission() -> None:
    other = told.GrantRef("b", commands_vehicle=True)
    grounded = (*ASKS, told.StreamClosed(1), told.GrantChanged(None, other), told.StreamOpened(2, "b", "B"))
    state, _ = told_of(*grounded)
    assert (state.active, state.lease is not None) == ("a", True)
    after_, actions = told_of(told.GrantChanged(other, None), state=state)
    assert after_.missions["a"].outcome is None
    assert after_.missions["b"].outcome == Outcome(OutcomeKind.REVOKED, "the grant was removed")
    assert (after_.active, after_.lease, after_.removed) == ("a", None, None)
    assert [action.event.state for action in actions if isinstance(action, SendEvent)] == [StreamState.LOST]


def test_refusal_of_ended_mission_explains_how_to_fly_again() -> None:
    code, reason = ended_refusal(Outcome(OutcomeKind.FAILED, "the driver did not come back"))
    assert code == "MissionEnded"
    assert reason.endswith("; another flight needs a Grant with another uid")

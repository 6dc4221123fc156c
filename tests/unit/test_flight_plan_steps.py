"""Decisions on flight plans, their activation, and their state during the flight."""

from dataclasses import replace
from datetime import UTC, datetime

import pytest
from fractus_core.airspace import Airspace
from fractus_core.airspace.plan_status import intent_of
from fractus_core.api import FlightPlan, Policy, Zone
from fractus_core.api.geometry import Position
from fractus_core.api.plans import MissionRecord
from fractus_core.planning import Settings
from fractus_core.planning.inventory import Reservation
from fractus_core.planning.ordered_application import ordered_application
from fractus_operator.flight_matching import SOON_S
from fractus_operator.flight_plan_steps import START_GRACE_S, PlanSituation, plan_step
from fractus_operator.flight_progress import FlownMission
from test_airspace_flights import located
from test_grants import FENCE, policy, zone
from test_ordered_applications import flight, template
from test_planning import at, inventory, manifest

BEGIN_S = 1_800_000_000.0
END_S = BEGIN_S + 600
DAY_BEFORE_S = BEGIN_S - 86_400
DRONE = located("d")
STOCK = inventory([DRONE])
PARAMETERS = {"properties": {"speed": {"type": "number", "maximum": 10}}}


def situation(plan=None, now_s=DAY_BEFORE_S, *, stock=STOCK, airspace=None, mission=None, using=None):
    return PlanSituation(
        plan or flight(),
        template() if using is None else using,
        lambda: stock,
        Settings(),
        airspace or Airspace(),
        mission or FlownMission(),
        now_s,
    )


def stored(plan, step):
    """Return a plan with the status of a step."""
    return FlightPlan.from_body(plan.to_dict() | {"status": step.status.to_dict()})


def changed(plan, generation=2, **fields):
    body = plan.to_dict()
    body["metadata"]["generation"] = generation
    body["spec"] |= fields
    return FlightPlan.from_body(body)


def accepted(plan=None, **more):
    plan = plan or flight()
    step = plan_step(situation(plan, **more))
    assert step.status.state == "Accepted", step.status.message
    return stored(plan, step)


def activated(**spec):
    plan = accepted(flight(**({"use": "InUse"} | spec)))
    return stored(plan, plan_step(situation(plan, BEGIN_S)))


def flown(plan=None, now_s=BEGIN_S + 60, *, stock=STOCK, airspace=None, **mission):
    plan = plan or activated()
    digest = ordered_application(flight(), template()).spec.mission_digest
    present = FlownMission(**({"started": True, "exists": True, "digest": digest} | mission))
    return plan_step(situation(plan, now_s, stock=stock, airspace=airspace, mission=present))


def conditions(step):
    return {update.type: (update.status, update.reason) for update in step.conditions}


def other(name="other", state="Accepted", priority=0):
    """Return the intent of another plan at the same place and time."""
    return replace(intent_of(accepted()), name=f"team/{name}", state=state, priority=priority)


# -- decision --


def test_plan_with_suitable_drone_is_accepted_and_reserves_the_whole_window():
    status = accepted().status
    assert (status.drone, status.decided_for, status.priority_class) == ("d", 1, "normal")
    assert [(v.begin.timestamp(), v.end.timestamp()) for v in status.volumes] == [(BEGIN_S, END_S)]


def test_plan_is_rejected_with_a_sentence_for_each_unsuitable_drone():
    poor = located("p", methods=["Arm"])
    far = located("q", (5000, 0), depot="other")
    step = plan_step(situation(stock=inventory([poor, far])))
    assert step.status.state == "Rejected"
    assert {each.node: each.reason for each in step.status.rejected} == {"p": "MethodMissing", "q": "OtherDepot"}
    assert all(each.message for each in step.status.rejected)
    assert conditions(step)["Accepted"] == ("False", "NoDrone")


def test_plan_without_template_is_rejected_with_the_remedy():
    step = plan_step(replace(situation(), template=None))
    assert step.status.state == "Rejected"
    assert "apply it, or correct spec.template" in step.status.message


def test_plan_whose_parameters_violate_the_schema_is_rejected_with_the_parameter():
    using = template(parameters=PARAMETERS)
    step = plan_step(situation(flight(parameters={"speed": 30}), using=using))
    assert (step.status.state, step.status.refusals[0].reason) == ("Rejected", "ParametersInvalid")
    assert step.status.message.startswith("parameters.speed: 30 is greater than the maximum of 10")
    assert plan_step(situation(flight(parameters={"speed": 3}), using=using)).status.state == "Accepted"


def test_change_to_parameters_that_violate_the_schema_is_refused():
    using = template(parameters=PARAMETERS)
    before = accepted(flight(parameters={"speed": 3}), using=using)
    step = plan_step(situation(changed(before, parameters={"speed": 30}), using=using))
    assert (step.status.state, conditions(step)["ChangeRefused"]) == ("Accepted", ("True", "ParametersInvalid"))


def test_plan_whose_parameters_violate_a_changed_schema_is_rejected_at_its_start():
    plan = accepted(flight(parameters={"speed": 3}, use="InUse"), using=template(parameters=PARAMETERS))
    slower = template(parameters={"properties": {"speed": {"maximum": 2}}})
    step = plan_step(situation(plan, BEGIN_S, using=slower))
    assert (step.status.state, step.start) == ("Rejected", None)


def test_plan_whose_window_is_over_is_rejected():
    step = plan_step(situation(now_s=END_S))
    assert (step.status.state, step.status.refusals[0].reason) == ("Rejected", "WindowOver")


def test_plan_of_unapproved_template_is_rejected():
    step = plan_step(situation(using=template(approved=2)))
    assert (step.status.state, step.status.refusals[0].reason) == ("Rejected", "Invalid")
    assert "not approved" in step.status.message


def fenced(*active):
    """Return an inventory whose zone on the route is active at some times of day."""
    times = [{"start": start, "end": end} for start, end in active]
    body = zone("z", (60, 70), 20).to_dict()
    body["spec"]["schedule"] = times
    zones = {"z": Zone.from_body(body)}
    return inventory([DRONE], zones=zones, policies={"keep-out": policy("keep-out", zones=["z"], **FENCE)})


@pytest.mark.parametrize(
    ("active", "state", "when"),
    [
        ([("07:00", "09:00")], "Rejected", None),
        ([("07:00", "08:01")], "Accepted", "at the begin of the window"),
        ([("08:59", "10:00")], "Accepted", "at the end of the window"),
        ([("08:30", "08:40")], "Accepted", "in a part of the window"),
        ([("07:00", "07:59"), ("20:00", "21:00")], "Accepted", None),
    ],
)
def test_restriction_of_the_next_day_is_judged_at_the_decision(active, state, when):
    plan = flight(window={"start": "2027-01-15T08:00:00Z", "duration": 60})
    step = plan_step(situation(plan, stock=fenced(*active)))
    assert step.status.state == state, step.status.message
    if state == "Rejected":
        assert step.status.refusals[0].reason == "PolicyConflict"
    elif when is None:
        assert step.status.advisories == ()
    else:
        (advisory,) = step.status.advisories
        assert advisory.message.startswith(when)
        assert conditions(step)["Restricted"] == ("True", "PolicyConflict")


def test_plan_that_overlaps_another_plan_is_rejected_with_its_name():
    step = plan_step(situation(airspace=Airspace([other()])))
    (refusal,) = step.status.refusals
    assert (step.status.state, refusal.reason, refusal.plan) == ("Rejected", "Conflict", "team/other")
    assert not step.status.volumes


def test_plan_of_higher_priority_is_accepted_with_an_advisory():
    step = plan_step(situation(flight(priorityClass="elevated"), airspace=Airspace([other()])))
    assert step.status.state == "Accepted"
    assert [each.reason for each in step.status.advisories] == ["OverlapsLowerPriority"]


def test_named_drone_that_does_not_fit_is_rejected_with_an_alternative():
    drones = inventory([located("p", methods=["Arm"]), located("q")])
    step = plan_step(situation(flight(drone="p"), stock=drones))
    assert step.status.state == "Rejected"
    assert step.status.message.startswith("Drone p cannot fly the plan: ")
    assert "Drone q can; name it" in step.status.message
    assert [each.node for each in step.status.rejected] == ["p"]


def test_named_drone_is_selected_although_another_one_is_better():
    drones = inventory([located("a"), located("b", battery=0.5)])
    assert accepted(flight(drone="b"), stock=drones).status.drone == "b"


@pytest.mark.parametrize(("start_s", "expected"), [(END_S + 1, "Accepted"), (END_S, "Rejected"), (BEGIN_S, "Rejected")])
def test_drone_is_not_reserved_twice_for_the_same_time(start_s, expected):
    taken = replace(STOCK, reservations={"d": [Reservation("team/other", start_s, start_s + 60)]})
    step = plan_step(situation(stock=taken))
    assert step.status.state == expected
    if expected == "Rejected":
        assert "flight plan team/other has reserved it from" in step.status.message


def test_present_charge_and_state_matter_only_shortly_before_the_window():
    weak = inventory([located("d", battery=0.05, ready="False")])
    assert plan_step(situation(stock=weak)).status.state == "Accepted"
    assert plan_step(situation(stock=weak, now_s=BEGIN_S - SOON_S + 1)).status.state == "Rejected"


def choices():
    spec = {
        "type": "LimitControl", "kind": "speed", "upperLimit": 15, "action": "enforce", "choices": ["refuse"],
        "selector": {},
    }  # fmt: skip
    return replace(STOCK, policies={"slow": Policy.from_body(manifest("Policy", "slow", spec))})


def test_plan_stays_draft_until_the_user_has_selected_an_action():
    step = plan_step(situation(stock=choices()))
    assert step.status.state == "Draft"
    assert conditions(step) == {"ActionNeeded": ("True", "ChoicesMissing")}
    (restriction,) = step.status.restrictions
    assert (restriction.policy, restriction.choices, restriction.chosen) == ("slow", ("enforce", "refuse"), None)
    assert not step.status.volumes
    plan = changed(stored(flight(), step), policyActions=[{"policy": "slow", "action": "refuse"}])
    step = plan_step(situation(plan, stock=choices()))
    assert (step.status.state, step.status.restrictions[0].chosen) == ("Accepted", "refuse")


def test_rejected_plan_is_decided_again_only_after_a_change():
    plan = stored(flight(), plan_step(situation(airspace=Airspace([other()]))))
    assert plan_step(situation(plan)).status.state == "Rejected"
    assert plan_step(situation(changed(plan))).status.state == "Accepted"


# -- before the flight --


def test_refused_change_leaves_the_earlier_version_in_force():
    plan = accepted()
    moved = changed(plan, window={"start": "2027-01-15T09:00:00Z", "duration": 10})
    blocker = other()
    volumes = tuple(replace(v, begin_s=v.begin_s + 3600, end_s=v.end_s + 3600) for v in blocker.volumes)
    step = plan_step(situation(moved, airspace=Airspace([replace(blocker, volumes=volumes)])))
    assert (step.status.state, step.status.decided_for, step.status.observed_generation) == ("Accepted", 1, 2)
    assert step.status.volumes == plan.status.volumes
    assert conditions(step)["ChangeRefused"] == ("True", "Conflict")


def test_accepted_change_replaces_the_volumes():
    moved = changed(accepted(), window={"start": "2027-01-15T09:00:00Z", "duration": 10})
    step = plan_step(situation(moved))
    assert step.status.decided_for == 2
    assert step.status.volumes[0].begin == datetime(2027, 1, 15, 9, tzinfo=UTC)


def test_lost_drone_is_replaced_before_the_flight():
    plan = accepted()
    lost = FlownMission(drone_exists=False)
    step = plan_step(situation(plan, stock=inventory([located("e")]), mission=lost))
    assert (step.status.state, step.status.drone) == ("Accepted", "e")


def test_drone_that_is_not_ready_shortly_before_the_flight_is_replaced():
    plan = accepted()
    drones = inventory([located("d", ready="False"), located("e")])
    assert plan_step(situation(plan, stock=drones)).status.drone == "d"
    assert plan_step(situation(plan, BEGIN_S - SOON_S, stock=drones)).status.drone == "e"


def test_plan_waits_for_a_drone_until_the_grace_period_ends():
    plan = accepted(flight(use="InUse"))
    unready = inventory([located("d", ready="False")])
    step = plan_step(situation(plan, BEGIN_S + 1, stock=unready))
    assert (step.status.state, conditions(step)["Startable"]) == ("Accepted", ("False", "NoDrone"))
    assert step.start is None
    step = plan_step(situation(plan, BEGIN_S + START_GRACE_S + 1, stock=unready))
    assert step.status.state == "Rejected"
    assert "d" in step.status.message


def test_plan_closed_before_its_flight_ends():
    assert plan_step(situation(changed(accepted(), use="Closed"))).status.state == "Ended"


def test_plan_that_nobody_uses_ends_with_its_window():
    plan = accepted()
    assert plan_step(situation(plan, BEGIN_S + 1)).status.state == "Accepted"
    step = plan_step(situation(plan, END_S + 1))
    assert (step.status.state, step.status.message) == ("Ended", "the window ended without a flight")


def test_plan_learns_of_a_plan_of_higher_priority():
    step = plan_step(situation(accepted(), airspace=Airspace([other(priority=1)])))
    assert step.status.state == "Accepted"
    assert conditions(step)["ConflictArose"] == ("True", "OverlapsHigherPriority")


# -- activation --


@pytest.mark.parametrize("permission", [{"use": "InUse"}, {"autoActivate": True}])
def test_plan_is_activated_at_the_start_of_its_window(permission):
    plan = accepted(flight(**permission))
    early = plan_step(situation(plan, BEGIN_S - 2))
    assert (early.status.state, early.start) == ("Accepted", None)
    assert early.next_s == 2
    step = plan_step(situation(plan, BEGIN_S))
    assert (step.status.state, step.status.application) == ("Activated", "flight-3e0a")
    assert step.start.name == "flight-3e0a"


def test_plan_without_permission_is_not_activated():
    step = plan_step(situation(accepted(), BEGIN_S + 1))
    assert (step.status.state, step.start) == ("Accepted", None)


def test_plan_is_not_activated_in_the_airspace_of_a_higher_priority():
    plan = accepted(flight(use="InUse"))
    step = plan_step(situation(plan, BEGIN_S, airspace=Airspace([other(priority=2)])))
    assert (step.status.state, step.start) == ("Accepted", None)
    assert conditions(step)["Startable"] == ("False", "Conflict")


def test_plan_whose_template_is_no_longer_approved_is_rejected_at_its_start():
    plan = accepted(flight(use="InUse"))
    step = plan_step(situation(plan, BEGIN_S, using=template(approved=2)))
    assert (step.status.state, step.start) == ("Rejected", None)


def test_flight_that_no_longer_fits_into_the_window_is_not_started():
    plan = accepted(flight(use="InUse"))
    step = plan_step(situation(plan, END_S - 1))
    assert (step.status.state, step.start) == ("Rejected", None)
    assert "window" in step.status.message


def test_application_is_created_again_if_the_operator_was_killed_before_its_creation():
    step = plan_step(situation(activated(), BEGIN_S + 5))
    assert (step.status.state, step.start.name) == ("Activated", "flight-3e0a")


def test_application_that_was_created_is_never_created_again():
    step = flown(exists=False, digest=None)
    assert (step.status.state, step.start) == ("Ended", None)


# -- flight --


def position(x, y, alt=25):
    return Position.model_validate(at(x, y, alt))


def test_plan_is_activated_while_its_drone_flies_in_its_volumes():
    step = flown(in_air=True, position=position(60, 70), home_m=30)
    assert step.status.state == "Activated"
    assert conditions(step)["Started"] == ("True", "ApplicationCreated")


@pytest.mark.parametrize("place", [position(500, 70), position(60, 70, 200)])
def test_drone_outside_its_volumes_is_nonconforming_and_reserves_its_surroundings(place):
    step = flown(in_air=True, position=place, home_m=30)
    assert step.status.state == "Nonconforming"
    *_, around = step.status.off_nominal_volumes
    assert (around.lower, around.upper) == (None, None)


def test_drone_back_in_its_volumes_is_activated_again():
    plan = stored(activated(), flown(in_air=True, position=position(500, 70), home_m=30))
    step = flown(plan, in_air=True, position=position(60, 70), home_m=30)
    assert (step.status.state, step.status.off_nominal_volumes) == ("Activated", ())


def test_status_of_nonconforming_plan_is_not_written_at_each_report():
    plan = stored(activated(), flown(in_air=True, position=position(500, 70), home_m=30))
    step = flown(plan, BEGIN_S + 65, in_air=True, position=position(520, 70), home_m=30)
    assert stored(plan, step).status == plan.status


def test_overlap_with_nonconforming_plan_is_reported():
    step = flown(airspace=Airspace([other(state="Nonconforming")]), in_air=True)
    assert conditions(step)["ConflictArose"] == ("True", "OverlapsEqualPriority")


@pytest.mark.parametrize("outcome", ["Revoked", "Failed"])
def test_plan_whose_drone_the_system_has_taken_is_contingent_until_it_has_landed(outcome):
    record = MissionRecord(outcome=outcome, message="battery")
    step = flown(in_air=True, position=position(60, 70), record=record)
    assert step.status.state == "Contingent"
    assert "battery" in step.status.message
    plan = stored(activated(), step)
    assert flown(plan, in_air=True, position=position(60, 70)).status.state == "Contingent"
    assert flown(plan, record=record).status.state == "Ended"


def test_complete_mission_ends_the_plan_after_the_landing():
    record = MissionRecord(outcome="Complete", message="done")
    assert flown(in_air=True, position=position(0, 0), record=record).status.state == "Activated"
    step = flown(record=record)
    assert (step.status.state, step.end, step.status.message) == ("Ended", False, "done")


@pytest.mark.parametrize("in_air", [True, False])
def test_end_of_window_deletes_the_application(in_air):
    step = flown(now_s=END_S + 1, in_air=in_air, position=position(0, 0))
    assert step.end
    assert step.status.state == ("Nonconforming" if in_air else "Activated")


def test_closed_plan_deletes_the_application_and_reserves_until_the_landing():
    plan = changed(activated(), use="Closed")
    step = flown(plan, in_air=True, position=position(0, 0))
    assert (step.end, step.status.state) == (True, "Contingent")
    plan = stored(plan, step)
    step = flown(plan, now_s=END_S + 60, in_air=True, exists=False)
    assert (step.end, step.status.state) == (False, "Contingent")
    assert max(v.end.timestamp() for v in step.status.off_nominal_volumes) > END_S + 60
    assert flown(stored(plan, step), now_s=END_S + 90, exists=False).status.state == "Ended"


def test_place_of_flight_cannot_change_after_its_start():
    moved = changed(activated(), waypoints=[at(10, 10, 20)])
    step = flown(moved, in_air=True, position=position(0, 0))
    assert conditions(step)["ChangeRefused"] == ("True", "ChangeNotPermitted")


def test_undone_change_in_flight_is_no_longer_reported_as_refused():
    moved = changed(activated(), waypoints=[at(10, 10, 20)])
    plan = stored(moved, flown(moved, in_air=True, position=position(0, 0)))
    undone = changed(plan, 3, waypoints=flight().to_dict()["spec"]["waypoints"])
    step = flown(undone, in_air=True, position=position(0, 0))
    assert "ChangeRefused" not in conditions(step)
    assert step.status.decided_for == 3


def test_window_cannot_be_extended_into_another_reservation_of_the_drone():
    stock = replace(STOCK, reservations={"d": [Reservation("team/noon", END_S + 300, END_S + 900)]})
    for minutes, refused in ((14, False), (16, True)):
        longer = changed(activated(), window={"start": "2027-01-15T08:00:00Z", "duration": minutes})
        step = flown(longer, stock=stock, in_air=True, position=position(0, 0))
        assert (conditions(step).get("ChangeRefused") == ("True", "DroneBusy")) == refused
        assert (step.status.volumes[0].end.timestamp() == END_S) == refused


def test_end_of_window_can_change_in_flight():
    longer = changed(activated(), window={"start": "2027-01-15T08:00:00Z", "duration": 20})
    step = flown(longer, in_air=True, position=position(0, 0))
    assert step.status.volumes[0].end.timestamp() == END_S + 600
    assert step.status.decided_for == 2


@pytest.mark.parametrize("now_s", [DAY_BEFORE_S, BEGIN_S - 400, BEGIN_S - 10, BEGIN_S, BEGIN_S + 60])
def test_step_is_repeated_without_a_change(now_s):
    plan = accepted(flight(autoActivate=True))
    first = stored(plan, plan_step(situation(plan, now_s)))
    again = plan_step(situation(first, now_s, mission=FlownMission()))
    assert again.status.state == first.status.state

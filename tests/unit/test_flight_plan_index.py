"""Reservations of flight plans: observed and decided ones, by drone and airspace."""

import pytest
from fractus_core.api import FlightPlan
from fractus_operator.flight_plan_index import FlightPlanIndex, reserved_flight
from fractus_operator.flight_plan_steps import plan_step
from test_flight_plan_steps import BEGIN_S, END_S, accepted, changed, flight, situation, stored

KEY = ("team", "morning")


def index_with(*plans):
    woken = []
    index = FlightPlanIndex(lambda key, volumes: woken.extend(index.overlapping(key, volumes)))
    for plan in plans:
        index.plan_changed((plan.metadata.namespace, plan.name), plan)
    return index, woken


def named(plan, name, uid):
    body = plan.to_dict()
    body["metadata"] |= {"name": name, "uid": uid}
    return FlightPlan.from_body(body)


def reserved(index, without=None):
    return {
        drone: [(r.holder, r.begin_s, r.end_s) for r in held] for drone, held in index.reservations(without).items()
    }


def test_accepted_plan_reserves_its_drone_and_airspace_for_its_window():
    index, _ = index_with(accepted())
    assert reserved(index) == {"d": [("team/morning", BEGIN_S, END_S)]}
    assert index.airspace["team/morning"].state == "Accepted"
    assert index.key_of("team", "3e0a") == KEY


def test_plan_does_not_see_its_own_reservation():
    index, _ = index_with(accepted())
    assert reserved(index, without="3e0a") == {"d": []}


@pytest.mark.parametrize("gone", ["deleted", "ended"])
def test_plan_that_is_over_reserves_nothing(gone):
    index, _ = index_with(accepted())
    over = stored(accepted(), plan_step(situation(changed(accepted(), use="Closed"))))
    index.plan_changed(KEY, None if gone == "deleted" else over)
    assert (reserved(index), len(index.airspace), index.get(KEY)) == ({}, 0, None)
    assert (index.key_of("team", "3e0a") is None) == (gone == "deleted")


def test_dry_run_reserves_nothing():
    assert reserved_flight(accepted(flight(dryRun=True))) is None


def test_decision_reserves_before_its_status_is_observed():
    index, _ = index_with(flight())
    index.decide(KEY, reserved_flight(accepted()))
    assert list(reserved(index)) == ["d"]
    index.plan_changed(KEY, changed(flight()))
    assert list(reserved(index)) == ["d"], "a late event about the old status must not release the reservation"
    index.plan_changed(KEY, accepted())
    index.settle(KEY)
    assert list(reserved(index)) == ["d"]


def test_refused_write_releases_the_decision():
    index, _ = index_with(flight())
    index.decide(KEY, reserved_flight(accepted()))
    index.settle(KEY)
    assert reserved(index) == {}


def test_both_versions_are_reserved_until_the_write_has_ended():
    moved = changed(accepted(), window={"start": "2027-01-15T09:00:00Z", "duration": 10})
    after = stored(moved, plan_step(situation(moved)))
    index, _ = index_with(accepted())
    index.decide(KEY, reserved_flight(after))
    assert reserved(index)["d"] == [("team/morning", BEGIN_S, END_S + 3600)]
    index.plan_changed(KEY, after)
    index.settle(KEY)
    assert reserved(index)["d"] == [("team/morning", BEGIN_S + 3600, END_S + 3600)]


def test_new_plan_under_the_same_name_does_not_inherit_a_decision():
    index, _ = index_with(flight())
    index.decide(KEY, reserved_flight(accepted()))
    index.plan_changed(KEY, named(flight(), "morning", "other"))
    assert reserved(index) == {}


def test_plans_that_overlap_a_changed_plan_are_found():
    index, woken = index_with(accepted())
    index.plan_changed(("team", "rescue"), named(accepted(flight(priorityClass="elevated")), "rescue", "u2"))
    assert woken == [KEY]
    index.plan_changed(("team", "rescue"), None)
    assert woken == [KEY, KEY]

"""Decisions on flight plans: priorities, earlier versions, kept overlaps, off-nominal volumes, and changes of state."""

import itertools
import math
from typing import get_args

import pytest
import shapely
from fractus_core.airspace import (
    Airspace,
    OperationalIntent,
    PlanState,
    Volume4D,
    decide,
    standing_overlaps,
    transition_problem,
)
from fractus_core.airspace.decide import MAX_EXPLAINED, MAX_HORIZON_S, MAX_LISTED
from fractus_core.geo import LocalFrame

NOW_S = 1_800_000_000.0
FRAME = LocalFrame(39.36, 22.93)
STATES = get_args(PlanState)


def at(x, *, begin=NOW_S, minutes=10, side=100.0, frame=FRAME):
    """Return a volume of 100 m that begins x metres east of the origin."""
    shape = shapely.box(x, 0, x + side, side)
    return Volume4D.of_shape(frame, shape, lower_m=0, upper_m=50, begin_s=begin, end_s=begin + minutes * 60)


def intent(name, *volumes, state="Accepted", priority=0, off=()):
    return OperationalIntent(name, state, priority, volumes, tuple(off))


def reasons(findings):
    return [(finding.reason, finding.other) for finding in findings]


def refusals(plan, *others, before=None):
    decision = decide(plan, before, Airspace(others), NOW_S)
    assert decision.accepted == (not decision.refusals)
    return reasons(decision.refusals)


def test_plan_in_free_airspace_is_accepted():
    decision = decide(intent("a", at(0)), None, Airspace([intent("b", at(200))]), NOW_S)
    assert decision.accepted
    assert decision.advisories == ()


@pytest.mark.parametrize("state", ["Accepted", "Activated", "Nonconforming", "Contingent"])
def test_overlap_with_plan_of_equal_priority_is_refused_in_one_sentence(state):
    decision = decide(intent("ns/a", at(0)), None, Airspace([intent("ns/b", at(90), state=state)]), NOW_S)
    (finding,) = decision.refusals
    assert (finding.reason, finding.other) == ("Conflict", "ns/b")
    head, tail = finding.message.split(" near ")
    assert head == f"the plan overlaps flight plan ns/b ({state}, priority 0)"
    assert tail.endswith(
        " between 0.0 and 50.0 m AMSL from 2027-01-15T08:00:00Z to 2027-01-15T08:10:00Z, and its priority 0 is not higher;"
        " choose another time, area or altitude"
    )


def test_every_conflicting_plan_is_named_in_order():
    others = [intent(name, at(x)) for name, x in (("c", 90), ("b", -90), ("far", 500))]
    assert refusals(intent("a", at(0)), *others) == [("Conflict", "b"), ("Conflict", "c")]


def test_plan_of_higher_priority_may_overlap_and_both_are_advised():
    low = intent("low", at(0))
    high = intent("high", at(50), priority=1)
    decision = decide(high, None, Airspace([low]), NOW_S)
    assert decision.accepted
    assert reasons(decision.advisories) == [("OverlapsLowerPriority", "low")]
    (advisory,) = standing_overlaps(low, Airspace([low, high]))
    assert (advisory.reason, advisory.other) == ("OverlapsHigherPriority", "high")
    assert advisory.message.endswith("and its own priority is 0")


def test_plan_of_lower_priority_is_refused():
    assert refusals(intent("low", at(0), priority=-5), intent("b", at(50))) == [("Conflict", "b")]


def test_lower_priority_plan_is_not_activated_below_a_plan_that_was_accepted_later():
    low = intent("low", at(0))
    active = intent("low", at(0), state="Activated")
    assert refusals(active, low, intent("high", at(50), priority=1), before=low) == [("Conflict", "high")]


def test_earlier_version_of_the_plan_is_ignored():
    before = intent("a", at(0))
    assert refusals(intent("a", at(10)), before, before=before) == []


@pytest.mark.parametrize(
    ("mine", "other", "kept"),
    [
        ("Activated", "Activated", True),
        ("Activated", "Accepted", False),
        ("Activated", "Nonconforming", False),
        ("Accepted", "Activated", False),
    ],
)
def test_overlap_is_kept_only_between_activated_plans(mine, other, kept):
    before = intent("a", at(0), state=mine)
    neighbour = intent("b", at(90), state=other)
    decision = decide(intent("a", at(10), state="Activated"), before, Airspace([before, neighbour]), NOW_S)
    assert decision.accepted == kept
    if kept:
        assert reasons(decision.advisories) == [("OverlapKept", "b")]
        assert decision.advisories[0].message.endswith(", as before this change")


def test_change_of_activated_plan_gets_no_new_overlap():
    before = intent("a", at(0), state="Activated")
    others = [intent("b", at(90), state="Activated"), intent("c", at(300), state="Activated")]
    change = intent("a", at(0), at(250), state="Activated")
    assert refusals(change, before, *others, before=before) == [("Conflict", "c")]


def test_off_nominal_volumes_of_other_plans_are_avoided():
    strayed = intent("b", at(500), state="Nonconforming", off=[at(90)])
    assert refusals(intent("a", at(0)), strayed) == [("Conflict", "b")]
    assert refusals(intent("a", at(0)), intent("b", at(500))) == []


@pytest.mark.parametrize("state", ["Nonconforming", "Contingent"])
def test_plan_in_trouble_is_not_refused_and_its_neighbours_are_named(state):
    before = intent("a", at(0), state="Activated")
    others = [intent("b", at(290)), intent("high", at(250), priority=9), intent("low", at(210), priority=-9)]
    decision = decide(
        intent("a", at(0), state=state, off=[at(200)]), before, Airspace([before, *others]), NOW_S + 30 * MAX_HORIZON_S
    )
    assert decision.accepted
    assert reasons(decision.advisories) == [
        ("OverlapsHigherPriority", "high"), ("OverlapsEqualPriority", "b"), ("OverlapsLowerPriority", "low"),
    ]  # fmt: skip


def test_return_to_activated_is_refused_if_another_plan_has_been_accepted_there():
    strayed = intent("a", at(0), state="Nonconforming")
    back = intent("a", at(0), state="Activated")
    assert refusals(back, strayed, intent("b", at(50)), before=strayed) == [("Conflict", "b")]
    assert refusals(back, strayed, before=strayed) == []


@pytest.mark.parametrize("state", ["Draft", "Rejected", "Ended"])
def test_plan_that_uses_no_airspace_is_no_conflict(state):
    assert refusals(intent("a", at(0)), intent("b", at(0), state=state)) == []


def test_ended_plan_releases_its_airspace():
    airspace = Airspace([intent("b", at(0), at(50))])
    assert decide(intent("b", state="Ended"), airspace["b"], airspace, NOW_S).accepted
    airspace.put(intent("b", state="Ended"))
    assert len(airspace) == 0
    assert decide(intent("a", at(0)), None, airspace, NOW_S).accepted


def test_airspace_finds_the_latest_version_of_each_of_many_plans():
    airspace = Airspace(intent(f"p{i:03}", at(1000.0 * i % 20_000)) for i in range(300))
    for i in range(0, 300, 3):
        airspace.remove(f"p{i:03}")
    airspace.remove("unknown")
    for i in range(0, 300, 2):
        airspace.put(intent(f"p{i:03}", at(500.0)))
    assert len(airspace) == 250
    found = airspace.overlapping([at(550.0)], without="p004")
    assert [other.name for other in found] == [f"p{i:03}" for i in range(0, 300, 2) if i != 4]


ALLOWED = {
    "Draft": {"Draft", "Accepted", "Rejected"},
    "Rejected": {"Rejected", "Draft"},
    "Accepted": {"Accepted", "Activated", "Ended", "Rejected"},
    "Activated": {"Activated", "Nonconforming", "Contingent", "Ended"},
    "Nonconforming": {"Nonconforming", "Activated", "Contingent", "Ended"},
    "Contingent": {"Contingent", "Ended"},
    "Ended": {"Ended"},
}


@pytest.mark.parametrize(("before", "after"), list(itertools.product(STATES, STATES)))
def test_states_change_only_as_permitted(before, after):
    problem = transition_problem(before, after)
    assert (problem == "") == (after in ALLOWED[before])
    if problem:
        assert refusals(intent("a", at(0), state=after), before=intent("a", at(0), state=before)) == [
            ("TransitionNotPermitted", "")
        ]


def test_refused_change_of_state_names_the_remedy():
    assert transition_problem("Contingent", "Activated") == (
        "the flight plan is Contingent and cannot become Activated; its next state can be Ended"
    )
    assert transition_problem("Ended", "Accepted").endswith("create another flight plan")
    assert transition_problem("Draft", "Activated").endswith("its next state can be Accepted or Rejected")


@pytest.mark.parametrize(
    ("plan", "reason"),
    [
        (intent("a"), "VolumesMissing"),
        (intent("a", at(0), off=[at(0)]), "VolumesOffNominal"),
        (intent("a", off=[at(0)]), "VolumesOffNominal"),
        (intent("a", at(0, begin=NOW_S - 3600)), "WindowOver"),
        (intent("a", at(0, begin=NOW_S + MAX_HORIZON_S + 1)), "WindowTooFar"),
        (intent("a", *[at(5.0 * i) for i in range(2001)]), "TooManyVertices"),
    ],
)
def test_plan_outside_the_limits_is_refused(plan, reason):
    assert refusals(plan) == [(reason, "")]


@pytest.mark.parametrize(
    "plan",
    [
        intent("a", at(0, begin=NOW_S + MAX_HORIZON_S)),
        intent("a", at(0, begin=NOW_S - 600)),
        intent("a", *[at(5.0 * i) for i in range(2000)]),
    ],
)
def test_plan_at_the_limits_is_accepted(plan):
    assert refusals(plan) == []


def test_plan_is_activated_only_in_its_window():
    volumes = (at(0, begin=NOW_S + 60), at(200, begin=NOW_S + 30))
    before = intent("a", *volumes)
    decision = decide(intent("a", *volumes, state="Activated"), before, Airspace(), NOW_S)
    assert reasons(decision.refusals) == [("WindowNotActive", "")]
    assert "before 2027-01-15T08:00:30Z" in decision.refusals[0].message
    assert decide(intent("a", *volumes, state="Activated"), before, Airspace(), NOW_S + 30).accepted


def test_plan_in_trouble_without_volumes_is_refused():
    before = intent("a", at(0), state="Activated")
    assert refusals(intent("a", state="Contingent"), before=before) == [("VolumesMissing", "")]


def test_unknown_time_refuses_a_plan():
    assert not decide(intent("a", at(0)), None, Airspace(), math.nan).accepted


def test_only_the_first_of_many_conflicts_are_explained():
    others = [intent(f"p{i:03}", at(i), state="Activated") for i in range(50)]
    decision = decide(intent("a", at(0)), None, Airspace(others), NOW_S)
    assert len(decision.refusals) == 50
    assert [" near " in finding.message for finding in decision.refusals] == [i < MAX_EXPLAINED for i in range(50)]


def test_listed_conflicts_are_limited():
    others = [intent(f"p{i:03}", at(0), state="Activated") for i in range(MAX_LISTED + 1)]
    assert len(decide(intent("a", at(0)), None, Airspace(others), NOW_S).refusals) == MAX_LISTED
    advisories = decide(intent("a", at(0), priority=1), None, Airspace(others), NOW_S).advisories
    assert len(advisories) == MAX_LISTED

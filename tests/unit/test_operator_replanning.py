"""Replanning: the operator keeps the active plan while it is feasible."""

from __future__ import annotations

from dataclasses import replace

import pytest
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.planning import Infeasible, Inventory, Settings
from fractus_core.planning.legality import with_legality
from fractus_operator.replanning import Choice, choose_plan
from fractus_operator.status import Blocked, blocked, deployed
from test_plan_legality import FORBID, WARN, fenced
from test_planning import PATH, STORE, VIEWER, application, drone, host, inventory, navigator

APPLICATION = application(navigator(PATH), VIEWER | {"egress": ["DataStore"]}, STORE)
TWO = inventory([drone("one"), drone("two", battery=0.9)])
STUCK: dict[str, str] = {}


def choose(
    previous: DeploymentPlanSpec | None,
    stock: Inventory,
    *,
    stuck: dict[str, str] = STUCK,
    in_flight: str | None = None,
) -> Choice:
    settings = replace(Settings(), excluded=stuck)
    return choose_plan(APPLICATION, previous, stock, settings, stuck=stuck, in_flight=in_flight)


@pytest.fixture
def plan() -> DeploymentPlanSpec:
    first = choose(None, TWO)
    assert first.reason == "NoPlanYet"
    assert first.plan.drone is not None
    assert first.plan.drone.node == "one"
    return first.plan


def test_mavlink_component_needs_a_gateway_unless_its_drone_is_in_flight() -> None:
    over_mavlink = navigator(PATH)
    over_mavlink["services"] = [s | {"interfaces": ["mavlink"]} for s in over_mavlink["services"]]
    program = application(over_mavlink)
    with_gateway = Settings()
    without_gateway = Settings(gateway=False)
    with pytest.raises(Infeasible, match=r"Navigator uses the interface mavlink.*set gateway\.enabled=true") as raised:
        choose_plan(program, None, TWO, without_gateway, stuck={}, in_flight=None)
    assert raised.value.reason == "NoGateway"
    flown = choose_plan(program, None, TWO, with_gateway, stuck={}, in_flight=None).plan
    choose_plan(program, flown, without("two"), without_gateway, stuck={}, in_flight="one")
    assert choose_plan(APPLICATION, None, TWO, without_gateway, stuck={}, in_flight=None).plan.drone is not None


def without(name: str) -> Inventory:
    hosts = {other: value for other, value in TWO.hosts.items() if other != name}
    drones = {other: value for other, value in TWO.drones.items() if other != name}
    return inventory(drones.values(), hosts=hosts.values())


def test_fitting_plan_is_kept(plan: DeploymentPlanSpec) -> None:
    assert choose(plan, TWO) == Choice(plan, fits=True)


def test_deleted_drone_is_replaced_unless_in_flight(plan: DeploymentPlanSpec) -> None:
    replaced = choose(plan, without("one"))
    assert replaced.reason == "NodeGone"
    assert replaced.plan.drone is not None
    assert replaced.plan.drone.node == "two"
    assert choose(plan, without("one"), in_flight="one").plan is plan


def test_cordoned_node_is_left_only_if_another_fits(plan: DeploymentPlanSpec) -> None:
    cordoned = host("one", "drone", schedulable=False)
    other_hosts = [value for name, value in TWO.hosts.items() if name != "one"]
    replanned = choose(plan, inventory(TWO.drones.values(), hosts=[cordoned, *other_hosts]))
    assert replanned.reason == "NodeCordoned"
    alone = inventory([drone("one")], hosts=[cordoned, *(h for h in other_hosts if h.name != "two")])
    assert choose(plan, alone) == Choice(plan)


def test_unschedulable_node_is_not_chosen_again(plan: DeploymentPlanSpec) -> None:
    other = choose(plan, TWO, stuck={"one": "no cpu"})
    assert other.reason == "NodeUnusable"
    assert other.plan.drone is not None
    assert other.plan.drone.node == "two"
    with pytest.raises(Infeasible, match="no cpu"):
        choose(plan, TWO, stuck={"one": "no cpu", "two": "no cpu"})


def test_policy_conflict_changes_plan_only_if_forbidden(plan: DeploymentPlanSpec) -> None:
    fences = fenced(200, 0)
    closed = replace(TWO, policies=fences.policies, zones=fences.zones)
    present = with_legality(APPLICATION, plan, closed, WARN)
    assert present.drone is not None
    assert present.drone.policy_conflict is not None

    def choosing(settings: Settings, in_flight: str | None = None) -> Choice:
        return choose_plan(APPLICATION, present, closed, settings, stuck={}, in_flight=in_flight)

    assert choosing(WARN) == Choice(present, fits=True)
    assert choosing(FORBID, in_flight="one") == Choice(present, fits=True)
    with pytest.raises(Infeasible, match="crosses zone z") as caught:
        choosing(FORBID)
    assert caught.value.reason == "PolicyConflict"


def test_policy_conflict_is_a_warning_condition(plan: DeploymentPlanSpec) -> None:
    fences = fenced(200, 0)
    present = with_legality(APPLICATION, plan, replace(TWO, policies=fences.policies, zones=fences.zones), WARN)
    (condition,) = [c for c in deployed(present, [], 1).conditions if c.type == "PolicyConflict"]
    assert condition.status == "True"
    assert condition.warning
    assert "crosses zone z" in condition.message
    assert not [c for c in deployed(plan, [], 1).conditions if c.type == "PolicyConflict"]
    refused = blocked(Blocked("Pending", "Planned", "PolicyConflict", "no drone may fly"), None)
    assert [(c.type, c.status) for c in refused.conditions] == [
        ("Planned", "False"), ("Ready", "False"), ("PolicyConflict", "True"),
    ]  # fmt: skip

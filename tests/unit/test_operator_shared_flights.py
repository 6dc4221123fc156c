"""Drone claims, shared flights and bookings."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import Any

import pytest
from fractus_core.api import Drone, Grant
from fractus_core.api.plans import DeploymentPlanSpec, DroneChoice, MissionRecord
from fractus_core.control import OutcomeKind
from fractus_core.planning import flight_of, plan
from fractus_core.planning.mission import Flight
from fractus_operator.bookings import Bookings
from fractus_operator.drone_claims import (
    ActiveMission,
    claims,
    offered_flights,
    shared_flight_lost,
    shared_flight_outcome,
)
from fractus_operator.parsing import OwnedPlan
from fractus_operator.pods import PlannedRequest, PodView
from test_planning import PATH, VIEWER, application, at, drone, inventory, manifest, navigator

HOST = application(navigator(PATH))
GUEST = application(VIEWER | {"egress": [], "pointsOfInterest": {"points": [at(120, 0), at(250, 0)]}})
DEPOTS = inventory().depots
HOST_PLAN = DeploymentPlanSpec(application="traffic", drone=DroneChoice(node="d"))
GUEST_PLAN = DeploymentPlanSpec(application="guest", drone=DroneChoice(node="d", shared_with="default/traffic"))


def flown(state: str = "inactive", x: float = 0.0, **more: Any) -> ActiveMission:
    status = {"flightState": state, "position": at(x, 0, 10)}
    flying = Drone.from_body(manifest("Drone", "d", drone("d").spec.to_dict(), status=status))
    return ActiveMission(HOST, HOST_PLAN, flying, in_flight=state != "inactive", **more)


def over(outcome: Any) -> DeploymentPlanSpec:
    return HOST_PLAN.model_copy(update={"flown": MissionRecord(outcome=outcome)})


def test_drone_on_the_ground_offers_complete_flight() -> None:
    assert offered_flights([flown()], DEPOTS, 7.0, None) == {"d": flight_of(HOST, DEPOTS)}


def test_drone_in_flight_offers_remaining_flight() -> None:
    begun = offered_flights([flown("flying", 180)], DEPOTS, 7.0, None)["d"]
    assert begun.legs[0][0].lon == pytest.approx(at(180, 0)["lon"])
    assert offered_flights([flown("flying", 900)], DEPOTS, 7.0, None) == {}
    # If the application already shares the flight, the complete flight is offered.
    assert offered_flights([flown("flying", 900)], DEPOTS, 7.0, GUEST_PLAN) == {"d": flight_of(HOST, DEPOTS)}


def test_flight_of_changed_application_is_not_offered() -> None:
    changed = HOST.model_copy(update={"metadata": HOST.metadata.model_copy(update={"generation": 2})})
    assert offered_flights([replace(flown(), application=changed)], DEPOTS, 7.0, None) == {}


@pytest.mark.parametrize(
    ("host_plan", "done"),
    [(over("Complete"), True), (over("Failed"), False), (over(None), False), (HOST_PLAN, False), (None, False)],
)
def test_guest_is_complete_when_host_is_complete(host_plan: DeploymentPlanSpec | None, done: bool) -> None:
    outcome = shared_flight_outcome(GUEST_PLAN, host_plan)
    assert (outcome is not None and outcome.kind is OutcomeKind.COMPLETE) is done
    assert shared_flight_outcome(HOST_PLAN, over("Complete")) is None


def test_lost_shared_flight_has_a_reason() -> None:
    whole = flight_of(HOST, DEPOTS)
    assert shared_flight_lost(GUEST, GUEST_PLAN, HOST_PLAN, whole, 7.0) is None
    assert shared_flight_lost(GUEST, GUEST_PLAN, HOST_PLAN, None, 7.0) is None
    assert shared_flight_lost(GUEST, HOST_PLAN, None, None, 7.0) is None
    for ended in (None, over("Complete"), over("Failed")):
        assert "no longer flies d" in str(shared_flight_lost(GUEST, GUEST_PLAN, ended, whole, 7.0))
    moved = HOST_PLAN.model_copy(update={"drone": DroneChoice(node="e")})
    assert "now flies e" in str(shared_flight_lost(GUEST, GUEST_PLAN, moved, whole, 7.0))
    elsewhere = Flight(("default", "traffic"), ((*whole.legs[0][:1],),))
    assert "no longer visits pointsOfInterest.points[0]" in str(
        shared_flight_lost(GUEST, GUEST_PLAN, HOST_PLAN, elsewhere, 7.0)
    )


def grant(name: str, uid: str, created: str) -> Grant:
    spec = {"node": "d", "application": {"namespace": "default", "name": name, "uid": uid}, "component": "C"}
    body = manifest("Grant", name, spec | {"instance": name})
    body["metadata"]["creationTimestamp"] = created
    return Grant.from_body(body)


def test_guest_claims_no_drone() -> None:
    plans = {("default", "guest"): OwnedPlan("g", GUEST_PLAN), ("default", "traffic"): OwnedPlan("t", HOST_PLAN)}
    old = grant("guest", "g", "2026-01-01T00:00:00Z")
    new = grant("traffic", "t", "2026-01-02T00:00:00Z")
    assert claims(plans, [old, new])["d"].uid == "t"
    # Without a plan, it is unknown which application shared the flight.
    assert claims({}, [old, new])["d"].uid == "g"


@pytest.mark.parametrize("left_by", [None, "elsewhere"])
def test_remaining_grant_of_guest_claims_no_drone(left_by: str | None) -> None:
    plans = {("default", "traffic"): OwnedPlan("t", HOST_PLAN)}
    if left_by is not None:
        # The guest now has its own drone, but its Grant for the previous drone still exists.
        plans["default", "guest"] = OwnedPlan("g", HOST_PLAN.model_copy(update={"drone": DroneChoice(node="e")}))
    remaining = grant("guest", "g", "2026-01-01T00:00:00Z")
    flown_by = grant("traffic", "t", "2026-01-02T00:00:00Z")
    for grants in ([remaining, flown_by], [flown_by, remaining]):
        assert claims(plans, grants)["d"].uid == "t"
    # A Grant has precedence over a plan of another application that has no Grant yet.
    assert claims(plans, [remaining])["d"].uid == "g"


def test_older_grant_decides_between_two_claims() -> None:
    plans = {("default", "a"): OwnedPlan("a", HOST_PLAN), ("default", "traffic"): OwnedPlan("t", HOST_PLAN)}
    old = grant("traffic", "t", "2026-01-01T00:00:00Z")
    new = grant("a", "a", "2026-01-02T00:00:00Z")
    assert claims(plans, [old, new])["d"].uid == "t"
    assert claims(plans, [])["d"].uid == "a"


# -- bookings --


def pod(name: str, node: str | None, cpu: float, **more: Any) -> PodView:
    labels = {"fractus.dev/application": more.pop("app"), "fractus.dev/instance": name} if "app" in more else {}
    values = {"ready": True, "finished": False, "terminating": False, "ip": None} | more
    return PodView("ns", name, node, labels, {"cpu": cpu}, **values)


def test_bookings_follow_pods() -> None:
    rng = random.Random(4)
    bookings = Bookings()
    pods = {}
    for _ in range(300):
        name = f"p{rng.randrange(20)}"
        new = pod(name, rng.choice([None, "a", "b"]), rng.choice([0.25, 0.5]), finished=rng.random() < 0.2)
        new = None if rng.random() < 0.2 else new
        bookings.pod_changed(pods.get(name), new)
        pods[name] = new
        for node in "ab":
            bound_pods = [p for p in pods.values() if p is not None and p.node == node and not p.finished]
            assert bookings.on(node).get("cpu", 0.0) == sum(p.requests["cpu"] for p in bound_pods)


def test_planned_instance_is_booked_once_and_own_pods_are_not_counted() -> None:
    bookings = Bookings()
    own_pod = pod("own", "a", 1.0, app="me")
    for each in (own_pod, pod("other", "a", 2.0, app="other"), pod("bare", "a", 4.0)):
        bookings.pod_changed(None, each)
    bookings.plan_changed(("ns", "me"), [PlannedRequest("own-2", "b", {"cpu": 8.0})])
    other_requests = [PlannedRequest("other", "a", {"cpu": 2.0}), PlannedRequest("other-2", "a", {"cpu": 16.0})]
    bookings.plan_changed(("ns", "other"), other_requests)
    assert bookings.on("a", ("ns", "me"), [own_pod])["cpu"] == 2.0 + 4.0 + 16.0
    assert bookings.on("b", ("ns", "me")).get("cpu", 0.0) == 0.0
    assert bookings.on("a")["cpu"] == 1.0 + 2.0 + 4.0 + 16.0
    assert bookings.on("b")["cpu"] == 8.0


def test_guest_is_planned_and_checked_with_the_same_flight() -> None:
    shared = inventory(
        [drone("d")],
        claimed={"d": HOST.key},
        flights={"d": replace(flight_of(HOST, DEPOTS), holder=("default", "host"))},
    )
    guest_plan = plan(GUEST, shared)
    assert guest_plan.drone is not None
    assert guest_plan.drone.shared_with == "default/host"
    assert shared_flight_lost(GUEST, guest_plan, HOST_PLAN, shared.flights["d"], 7.0) is None

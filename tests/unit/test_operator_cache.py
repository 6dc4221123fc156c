"""Claims, bookings and active plans: values updated by events must equal values computed from all objects."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any, cast

import hypothesis.strategies as st
import pytest
from depth import examples
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.planning.candidates import requests
from fractus_operator import kinds
from fractus_operator.cache import ClusterCache
from fractus_operator.drone_claims import Claim, claims
from fractus_operator.kinds import Body, Key, Kind, key_of
from fractus_operator.parsing import OwnedPlan, parse_plan
from fractus_operator.store import Informer, Store
from hypothesis import settings
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from test_planning import component, manifest

APPLICATIONS = st.sampled_from([("ns", "a"), ("ns", "b"), ("ms", "a")])
UIDS = st.sampled_from(["1", "2"])
DRONES = ("d", "e")
NODES = ("d", "e", "n")
KINDS = (kinds.APPLICATION, kinds.DEPLOYMENT_PLAN, kinds.GRANT, kinds.DRONE, kinds.POD)
FIRST = "2026-01-01T00:00:00Z"


def labels(key: Key, **more: str) -> dict[str, str]:
    common = {"app.kubernetes.io/managed-by": "fractus", "fractus.dev/application": key[1]}
    return common | {"fractus.dev/namespace": key[0]} | {f"fractus.dev/{name}": value for name, value in more.items()}


def plan_spec(node: str, host: Key | None, generation: int, placed_on: str) -> dict[str, Any]:
    shared = {"sharedWith": "/".join(host)} if host is not None else {}
    placement = {
        "component": "C",
        "instance": "c-1",
        "node": placed_on,
        "placement": "edge",
        "role": "static",
        "location": 0,
    }
    return {
        "application": "any",
        "applicationGeneration": generation,
        "drone": {"node": node, "score": 1.0, **shared},
        "placements": [placement],
    }


class EventsOfTheCluster(RuleBasedStateMachine):
    """State machine with random changes of objects.

    The operator receives the changes late, repeatedly, or by a new list.
    """

    def __init__(self) -> None:
        super().__init__()
        self.cache = ClusterCache(cast(Store, None))
        self.woken: set[Key] = set()
        self.cache.plans._wake = self.woken.add
        self.version = 0
        self.stored: dict[Kind, dict[Key, Body]] = {kind: {} for kind in KINDS}
        self.pending: dict[Kind, list[tuple[str, Body]]] = {kind: [] for kind in KINDS}
        self.decided: dict[Key, OwnedPlan] = {}
        self.last_claims: dict[str, Claim] = {}
        self.returning: set[tuple[str, str]] = set()

    # -- changes at the API server --

    def put(self, kind: Kind, body: Body) -> None:
        self.version += 1
        body["metadata"]["resourceVersion"] = str(self.version)
        self.stored[kind][key_of(body)] = body
        self.pending[kind].append(("MODIFIED", body))

    def remove(self, kind: Kind, key: Key) -> None:
        body = self.stored[kind].pop(key, None)
        if body is not None:
            self.version += 1
            body = copy.deepcopy(body)
            body["metadata"]["resourceVersion"] = str(self.version)
            self.pending[kind].append(("DELETED", body))

    @rule(
        key=APPLICATIONS,
        uid=UIDS,
        generation=st.integers(1, 3),
        cpu=st.integers(1, 3),
        phase=st.sampled_from(["Flying", "Completed"]),
    )
    def application(self, key: Key, uid: str, generation: int, cpu: int, phase: str) -> None:
        container = {"image": "i", "resources": {"limits": {"cpu": str(cpu)}}}
        locations = [{"center": {"lat": 0, "lon": 0}, "radius": 9, "instances": 1}]
        spec = {"components": [component("C", "edge", container=container, locations=locations)]}
        metadata = {"namespace": key[0], "name": key[1], "uid": f"{key}{uid}", "generation": generation}
        # A user may have edited the status, so it changes nothing.
        status = {"phase": phase, "observedGeneration": generation, "drone": "d"}
        self.put(kinds.APPLICATION, {**manifest("Application", key[1], spec), "metadata": metadata, "status": status})

    @rule(
        key=APPLICATIONS,
        uid=UIDS,
        node=st.sampled_from(DRONES),
        host=st.none() | APPLICATIONS,
        generation=st.integers(1, 3),
        placed_on=st.sampled_from(NODES),
        decided=st.booleans(),
        flown=st.sampled_from([None, {}, {"outcome": "Complete"}, {"outcome": "Failed", "landed": True}]),
    )
    def plan(
        self,
        key: Key,
        uid: str,
        node: str,
        host: Key | None,
        generation: int,
        placed_on: str,
        decided: bool,
        flown: Body | None,
    ) -> None:
        spec = plan_spec(node, host, generation, placed_on) | ({"flown": flown} if flown is not None else {})
        if flown == {"outcome": "Complete"} and host is None:
            self.returning.add((f"{key}{uid}", node))
        if decided:
            plan = DeploymentPlanSpec.model_validate(spec)
            self.decided[key] = OwnedPlan(f"{key}{uid}", plan)
            self.cache.plans.decide(key, f"{key}{uid}", plan)
            return
        owner = {"apiVersion": "v1", "kind": "Application", "name": key[1], "uid": f"{key}{uid}"}
        body = manifest("DeploymentPlan", key[1], spec)
        body["metadata"] = {"namespace": key[0], "name": key[1], "ownerReferences": [owner], "labels": labels(key)}
        self.put(kinds.DEPLOYMENT_PLAN, body)

    @rule(key=APPLICATIONS)
    def forget(self, key: Key) -> None:
        self.decided.pop(key, None)
        self.cache.forget(key)

    @rule(
        name=st.sampled_from("gh"),
        key=APPLICATIONS,
        uid=UIDS,
        node=st.sampled_from(DRONES),
        created=st.none() | st.sampled_from([FIRST, "2026-01-02T00:00:00Z"]),
    )
    def grant(self, name: str, key: Key, uid: str, node: str, created: str | None) -> None:
        owner = {"namespace": key[0], "name": key[1], "uid": f"{key}{uid}"}
        body = manifest("Grant", name, {"node": node, "application": owner, "component": "C", "instance": "c-1"})
        body["metadata"] = {"name": name, "labels": labels(key)} | ({"creationTimestamp": created} if created else {})
        self.put(kinds.GRANT, body)

    @rule(name=st.sampled_from(DRONES), flies=st.booleans())
    def drone(self, name: str, flies: bool) -> None:
        status = {"flightState": "flying" if flies else "inactive"}
        spec = {"home": {"lat": 0, "lon": 0}, "services": {}}
        self.put(kinds.DRONE, {**manifest("Drone", name, spec, status=status), "metadata": {"name": name}})

    @rule(
        name=st.sampled_from("pqr"),
        key=APPLICATIONS,
        node=st.none() | st.sampled_from(NODES),
        cpu=st.integers(1, 3),
        ended=st.booleans(),
        managed=st.booleans(),
    )
    def pod(self, name: str, key: Key, node: str | None, cpu: int, ended: bool, managed: bool) -> None:
        container = {"resources": {"requests": {"cpu": str(cpu)}}}
        metadata = {"namespace": key[0], "name": name, "labels": labels(key, instance="c-1") if managed else {}}
        status = {"phase": "Succeeded" if ended else "Running"}
        self.put(
            kinds.POD, {"metadata": metadata, "spec": {"nodeName": node, "containers": [container]}, "status": status}
        )

    @rule(kind=st.sampled_from(KINDS), choice=st.randoms(use_true_random=False))
    def delete(self, kind: Kind, choice: Any) -> None:
        if self.stored[kind]:
            self.remove(kind, choice.choice(sorted(self.stored[kind])))

    # -- received events --

    def informer(self, kind: Kind) -> Informer[Any]:
        return next(r for r in self.cache.informers if r.kind == kind)

    def receive(self, kind: Kind, type_: str, body: Body) -> None:
        key = key_of(body)
        informer = self.informer(kind)
        known = informer.get(key) is not None
        informer._take(type_, copy.deepcopy(body))
        # The response to a write may bring a deleted object back. Its plan is then kept.
        if kind is kinds.APPLICATION and known and informer.get(key) is None:
            self.decided.pop(key, None)

    @rule(kind=st.sampled_from(KINDS), again=st.booleans())
    def deliver_events(self, kind: Kind, again: bool) -> None:
        events = self.pending[kind]
        self.pending[kind] = []
        for type_, body in events:
            for _ in range(1 + again):
                self.receive(kind, type_, body)

    @precondition(lambda self: any(self.pending.values()))
    @rule(kind=st.sampled_from(KINDS))
    def deliver_one_event(self, kind: Kind) -> None:
        if self.pending[kind]:
            self.receive(kind, *self.pending[kind].pop(0))

    @rule(kind=st.sampled_from(KINDS))
    def return_write(self, kind: Kind) -> None:
        """Deliver the response to a write of the operator before the event of the watch."""
        if self.pending[kind] and self.pending[kind][-1][0] != "DELETED":
            body = copy.deepcopy(self.pending[kind][-1][1])
            self.informer(kind).record_write(key_of(body), body)

    @rule(kind=st.sampled_from(KINDS))
    def list_again(self, kind: Kind) -> None:
        """List all objects again.

        Objects that were deleted in the meantime are missing in the list, without an event.
        """
        self.pending[kind] = []
        for body in self.stored[kind].values():
            self.receive(kind, "MODIFIED", body)
        informer = self.informer(kind)
        for key in {key for key, _ in informer.items()} - self.stored[kind].keys():
            informer._drop(key)
            if kind is kinds.APPLICATION:
                self.decided.pop(key, None)

    # -- invariants --

    def plans(self) -> dict[Key, OwnedPlan]:
        """Return the latest plan of each application."""
        stored = {key: parse_plan(body) for key, body in self.cache.children[kinds.DEPLOYMENT_PLAN].items()}
        return {key: plan for key, plan in stored.items() if plan is not None} | self.decided

    def active(self) -> dict[Key, OwnedPlan]:
        active = {}
        for key, plan in self.plans().items():
            submitted = self.cache.applications.get(key)
            over = plan.spec.flown is not None and plan.spec.flown.outcome is not None
            if submitted is not None and submitted.uid == plan.uid and not over:
                active[key] = plan
        return active

    def booked(self, node: str, application: Key) -> float:
        pods = [p for p in self.cache.pods.values() if p.node == node and not p.finished]
        other_pods = [p for p in pods if (p.namespace, p.application) != application]
        bound = {(p.namespace, p.instance) for p in pods if p.application is not None}
        return sum(p.requests["cpu"] for p in other_pods) + sum(self.unbound(node, application, bound))

    def unbound(self, node: str, application: Key, bound: Iterable[tuple[str, str | None]]) -> Iterator[float]:
        for key, plan in self.active().items():
            submitted = self.cache.applications.get(key)
            assert submitted is not None
            assert submitted.application is not None
            for placed in plan.spec.placements:
                if key != application and placed.node == node and (key[0], placed.instance) not in bound:
                    yield requests(submitted.application.spec.components[0])["cpu"]

    @invariant()
    def active_plans_are_those_of_unfinished_missions(self) -> None:
        plans = self.active()
        for key in [("ns", "a"), ("ns", "b"), ("ms", "a")]:
            assert self.cache.plans.active(key) == plans.get(key)
        for node in DRONES:
            on = {key for key, plan in plans.items() if plan.spec.drone is not None and plan.spec.drone.node == node}
            assert set(self.cache.fleet.applications_on(node)) == on

    @invariant()
    def claims_follow_from_plans_and_grants(self) -> None:
        plans = self.active()
        held = claims(plans, self.cache._known_grants.values())
        for drone in self.cache.drones.values():
            if drone is not None and drone.in_air and drone.name not in held:
                last = self.last_claims.get(drone.name)
                if last is None:
                    # No earlier claim is known. Only the plan of an ended mission shows whose flight the drone ends.
                    last = self.cache.fleet.claims()[drone.name]
                    assert (last.uid, drone.name) in self.returning or not last.uid
                held[drone.name] = replace(last, returning=True)
        self.last_claims.update(held)
        assert dict(self.cache.fleet.claims()) == held
        grants = {
            (b["spec"]["application"]["uid"], b["spec"]["node"]) for b in self.cache.children[kinds.GRANT].values()
        }
        drones = [(plan.uid, plan.spec.drone) for plan in plans.values() if plan.spec.drone is not None]
        sharing = {(uid, drone.node) for uid, drone in drones if drone.shared_with is not None}
        assert {node for _, node in grants - sharing} <= set(held), (
            "the drone of a Grant is claimed unless the application shares the flight"
        )
        owners = {(claim.uid, node) for node, claim in held.items() if not claim.returning}
        flown_by = {
            plan.spec.drone.node
            for plan in plans.values()
            if plan.spec.drone is not None
            and plan.spec.drone.shared_with is None
            and (plan.uid, plan.spec.drone.node) in owners
            and self.cache.drone(plan.spec.drone.node) is not None
        }
        assert {flown.drone.name for flown in self.cache.fleet.active_missions()} == flown_by
        flying = {key for key, plan in plans.items() if self.cache.fleet.drone_in_flight(plan.spec) is not None}
        assert set(self.cache.fleet.applications_in_flight()) == flying

    @invariant()
    def bookings_follow_from_pods_and_plans(self) -> None:
        for name in NODES:
            for application in [("ns", "a"), ("ns", "z")]:
                booked = self.cache._bookings.on(
                    name, application, [p for p in self.cache.pods_of(application) if p.node == name]
                )
                assert booked.get("cpu", 0.0) == pytest.approx(self.booked(name, application))

    @invariant()
    def wake_guests_wakes_applications_that_share_the_flight(self) -> None:
        for host in [("ns", "a"), ("ns", "b"), ("ms", "a")]:
            self.woken.clear()
            self.cache.plans.wake_guests(host)
            named = "/".join(host)
            assert self.woken == {
                key for key, p in self.plans().items() if p.spec.drone and p.spec.drone.shared_with == named
            }


TestEventsOfTheCluster = EventsOfTheCluster.TestCase
TestEventsOfTheCluster.settings = settings(max_examples=examples(60), stateful_step_count=40, deadline=None)

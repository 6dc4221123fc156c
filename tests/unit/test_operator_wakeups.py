"""Wake-ups of Applications by changes of other objects, and the state kept for each Application."""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any, cast

import pytest
from fractus_core.api import Application, InvalidObject
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.identity.authority import Authority
from fractus_core.planning.inventory import Inventory
from fractus_operator import kinds
from fractus_operator.application_controller import ApplicationController, _ApplicationState
from fractus_operator.cache import ClusterCache
from fractus_operator.owned_objects import GroupedObjects
from fractus_operator.parsing import parse_application
from fractus_operator.status import StatusUpdate
from fractus_operator.store import Store
from fractus_operator.work_queue import Subscription, Subscriptions
from test_planning import at, component, edge, host, inventory, manifest

V1 = "fractus.dev/v1alpha1"
NOW = datetime(2026, 6, 1, 12, 0, tzinfo=UTC)


def drone_body(version: int, state: str) -> dict[str, Any]:
    spec = {"home": {"lat": 0, "lon": 0}, "services": {}}
    metadata = {"name": "d", "resourceVersion": str(version)}
    return {"apiVersion": V1, "kind": "Drone", "metadata": metadata, "spec": spec, "status": {"flightState": state}}


async def test_released_drone_wakes_applications_without_suitable_plan() -> None:
    cache = ClusterCache(cast(Store, None))
    cache.drones.record_write(("", "d"), drone_body(1, "flying"))
    with cache.subscriptions.subscribe(("ns", "placed")) as placed, cache.subscriptions.subscribe(("ns", "new")) as new:
        cache.subscriptions.set_placed(("ns", "placed"), placed=True)
        cache.drones.record_write(("", "d"), drone_body(2, "inactive"))
        assert await new.changed(1)
        assert not await placed.changed(0)
        cache.subscriptions.set_placed(("ns", "placed"), placed=False)
        cache.drones.record_write(("", "d"), drone_body(3, "flying"))
        assert not await placed.changed(0), "a takeoff releases no capacity"
        assert not await new.changed(0)
        cache.drones.record_write(("", "d"), drone_body(4, "inactive"))
        assert await placed.changed(1)


async def test_wake_all_wakes_applications_in_flight_first() -> None:
    subscriptions = Subscriptions()
    order: list[str] = []

    async def reconciler(name: str, inputs: Subscription) -> None:
        await inputs.changed(5)
        order.append(name)

    names = [f"a{i}" for i in range(6)]
    with contextlib.ExitStack() as stack:
        each = [(name, stack.enter_context(subscriptions.subscribe(("ns", name)))) for name in names]
        async with asyncio.TaskGroup() as group:
            for name, inputs in each:
                group.create_task(reconciler(name, inputs))
            await asyncio.sleep(0)
            subscriptions.wake_all(urgent=True, first=[("ns", "a4"), ("ns", "deleted"), ("ns", "a3")])
        assert order == ["a4", "a3", "a0", "a1", "a2", "a5"]
        assert all(inputs._urgent.is_set() for _, inputs in each)
        for _, inputs in each:
            assert not await inputs.changed(0), "each Application is woken once"


async def test_changed_spec_ends_pause_but_changed_status_does_not() -> None:
    cache = ClusterCache(cast(Store, None))

    def deliver(version: int, generation: int, phase: str) -> None:
        names = {"namespace": "ns", "name": "a", "uid": "a"}
        metadata = {**names, "resourceVersion": str(version), "generation": generation}
        cache.applications.record_write(("ns", "a"), {**APPLICATION, "metadata": metadata, "status": {"phase": phase}})

    deliver(1, 1, "Deploying")
    with cache.subscriptions.subscribe(("ns", "a")) as inputs:
        deliver(2, 1, "Running")
        assert await inputs.changed(0)
        assert not inputs._urgent.is_set()
        deliver(3, 2, "Running")
        assert await inputs.changed(0)
        assert inputs._urgent.is_set(), "a changed spec is urgent"


async def test_planning_inputs_of_node_wake_all_applications_but_labels_do_not() -> None:
    """Labels must not wake Applications, because the geohash label of a flying drone changes every minute."""
    cache = ClusterCache(cast(Store, None))
    version = iter(range(1, 100))

    def deliver(labels: dict[str, str], ready: str = "True", unschedulable: bool = False, cpu: str = "4") -> None:
        metadata = {"name": "n", "labels": labels, "resourceVersion": str(next(version))}
        status = {"conditions": [{"type": "Ready", "status": ready}], "allocatable": {"cpu": cpu}}
        cache.hosts.record_write(
            ("", "n"), {"metadata": metadata, "spec": {"unschedulable": unschedulable}, "status": status}
        )

    edge_class = {"fractus.dev/class": "edge"}
    deliver(edge_class)
    with cache.subscriptions.subscribe(("ns", "a")) as inputs:
        deliver({**edge_class, "fractus.dev/geohash": "u1"})
        deliver({**edge_class, "fractus.dev/geohash": "u2", "some": "label"})
        assert not await inputs.changed(0)
        deliver({**edge_class, "fractus.dev/cloud": "true"})
        assert await inputs.changed(0)
        deliver(edge_class)
        assert await inputs.changed(0)
        for change in ({"ready": "False"}, {"unschedulable": True}, {"cpu": "8"}):
            deliver(edge_class, **cast(Any, change))
            assert await inputs.changed(0), change
            deliver(edge_class)
            assert await inputs.changed(0)
        cache.hosts._drop(("", "n"))
        assert await inputs.changed(0)


def pod_body(version: int, node: str | None, phase: str = "Running") -> dict[str, Any]:
    metadata = {"namespace": "ns", "name": "p", "uid": "p", "resourceVersion": str(version)}
    return {"metadata": metadata, "spec": {"nodeName": node, "containers": []}, "status": {"phase": phase}}


async def test_released_capacity_wakes_applications_that_need_the_node() -> None:
    cache = ClusterCache(cast(Store, None))
    key = ("ns", "p")
    with (
        cache.subscriptions.subscribe(("ns", "here")) as woken,
        cache.subscriptions.subscribe(("ns", "there")) as unaffected,
    ):
        cache.subscriptions.set_placed(("ns", "here"), placed=False, full={"n", "m"})
        cache.subscriptions.set_placed(("ns", "there"), placed=False, full={"m"})
        cache.pods.record_write(key, pod_body(1, None, "Pending"))
        cache.pods.record_write(key, pod_body(2, "n"))
        assert not await woken.changed(0), "a new pod releases no capacity"
        cache.pods.record_write(key, pod_body(3, "n", "Succeeded"))
        assert await woken.changed(0)
        cache.pods._drop(key)
        assert not await woken.changed(0), "deletion of a finished pod releases no capacity"
        cache.pods.record_write(key, pod_body(4, "n"))
        cache.pods._drop(key)
        assert await woken.changed(0), "deletion of a running pod releases capacity"
        cache.subscriptions.set_placed(("ns", "here"), placed=True)
        cache.pods.record_write(key, pod_body(5, "n"))
        cache.pods._drop(key)
        assert not await woken.changed(0), "a completely placed Application needs no capacity"
        assert not await unaffected.changed(0)
    assert not cache.subscriptions._full_nodes


def test_application_is_validated_again_when_application_or_rules_change() -> None:
    def applied(generation: int, uid: str) -> Application:
        points = [{"point": {"depot": "base"}, "path": [at(100, 0, 10)], "navigation": "pathBased"}]
        services = [{"service": "mobility", "methods": ["Goto"]}]
        driver = component("Navigator", "drone", **{"class": "driver", "services": services, "controlPoints": points})
        body = manifest("Application", "a", {"components": [driver]})
        body["metadata"] |= {"namespace": "ns", "uid": uid, "generation": generation}
        return Application.from_body(body)

    memory = _ApplicationState()
    known = inventory()
    lacking = replace(known, depots={})
    memory.check(applied(1, "a"), known, 1)
    memory.check(applied(1, "a"), lacking, 1)
    for application, rules in ((applied(1, "a"), 2), (applied(2, "a"), 1), (applied(1, "b"), 1)):
        for _ in range(2):
            with pytest.raises(InvalidObject):
                memory.check(application, lacking, rules)


def full_node() -> Inventory:
    """Return an inventory with one edge node. Its free capacity is too small for the test components."""
    return inventory([], [edge("e1", (0, 0))], [host("e1", "edge", cpu=0.01)])


async def test_infeasible_application_wakes_when_capacity_is_released(monkeypatch: pytest.MonkeyPatch) -> None:
    cache = ClusterCache(cast(Store, None))
    applications = ApplicationController(cast(Store, None), cache, Authority.generate(NOW), lambda: NOW)
    viewer = component("Viewer", "edge", locations=[{"center": at(0, 0), "radius": 100}])
    body = {**manifest("Application", "waits", {"components": [viewer]}), "status": {}}
    submitted = parse_application(body)
    cache.applications.record_write(submitted.key, body)
    monkeypatch.setattr(cache, "snapshot", lambda *_: full_node())
    updates: list[StatusUpdate] = []

    async def report(_submitted: object, update: StatusUpdate, *_: object) -> None:
        updates.append(update)

    monkeypatch.setattr(applications._reporter, "report", report)
    with cache.subscriptions.subscribe(submitted.key) as waits:
        await applications._step(cache.observe(submitted), _ApplicationState())
        assert [update.phase for update in updates] == ["Pending"]
        cache.subscriptions.wake_for_capacity("e2")
        assert not await waits.changed(0)
        cache.subscriptions.wake_for_capacity("e1")
        assert await waits.changed(0)


APPLICATION = {"apiVersion": V1, "kind": "Application", "spec": {}}
HOST = ("ns", "host")
SHARING = ("ns", "sharing")


def plan_body(node: str, version: int) -> dict[str, Any]:
    owner = {"apiVersion": V1, "kind": "Application", "name": "host", "uid": "host"}
    labels = {"app.kubernetes.io/managed-by": "fractus", "fractus.dev/application": "host"}
    return {
        "apiVersion": V1,
        "kind": "DeploymentPlan",
        "metadata": {
            "namespace": "ns",
            "name": "host",
            "uid": "plan",
            "resourceVersion": str(version),
            "labels": labels,
            "ownerReferences": [owner],
        },
        "spec": {"application": "host", "applicationGeneration": 1, "drone": {"node": node, "score": 1.0}},
    }


def decide(cache: ClusterCache, key: tuple[str, str], **drone: Any) -> None:
    plan = {"application": key[1], "applicationGeneration": 1, "drone": {"score": 1.0, **drone}}
    cache.plans.decide(key, key[1], DeploymentPlanSpec.model_validate(plan))


@pytest.fixture
def shared() -> ClusterCache:
    """Two applications that share one drone."""
    cache = ClusterCache(cast(Store, None))
    cache.drones.record_write(("", "d"), drone_body(1, "flying"))
    for namespace, name in (HOST, SHARING):
        metadata = {"namespace": namespace, "name": name, "uid": name, "resourceVersion": "1", "generation": 1}
        cache.applications.record_write((namespace, name), APPLICATION | {"metadata": metadata})
    decide(cache, HOST, node="d")
    decide(cache, SHARING, node="d", sharedWith="ns/host")
    cache.subscriptions.set_placed(SHARING, placed=True)
    return cache


async def test_drone_change_wakes_its_application_and_guests(shared: ClusterCache) -> None:
    with shared.subscriptions.subscribe(SHARING) as sharing:
        shared.drones.record_write(("", "d"), drone_body(2, "inactive"))
        assert await sharing.changed(1)
        shared.plans.decide(
            HOST,
            "host",
            DeploymentPlanSpec.model_validate(
                {"application": "host", "drone": {"node": "d"}, "flown": {"outcome": "Complete"}}
            ),
        )
        assert await sharing.changed(1)


async def test_guest_wakes_when_plan_of_host_changes(shared: ClusterCache) -> None:
    stored = shared.children[kinds.DEPLOYMENT_PLAN]
    with shared.subscriptions.subscribe(SHARING) as sharing:
        decide(shared, HOST, node="other")
        assert await sharing.changed(0), "the guest wakes after the decision for a plan"
        shared.forget(HOST)
        assert await sharing.changed(0), "the guest wakes after the decision is dropped"
        stored.record_write(HOST, plan_body("d", 1))
        assert await sharing.changed(0), "the guest wakes after the plan is stored"
        stored.record_write(HOST, plan_body("other", 2))
        assert await sharing.changed(0), "the guest is woken because the stored plan has another drone"
        stored._drop(HOST)
        assert await sharing.changed(0), "the guest wakes after the plan is deleted"
        decide(shared, ("ns", "stranger"), node="e")
        shared.forget(("ns", "stranger"))
        assert not await sharing.changed(0)


async def test_deleted_plan_wakes_waiting_applications(shared: ClusterCache) -> None:
    stored = shared.children[kinds.DEPLOYMENT_PLAN]
    shared.drones.record_write(("", "d"), drone_body(2, "inactive"))
    stored.record_write(HOST, plan_body("d", 1))
    with shared.subscriptions.subscribe(("ns", "waiting")) as waiting:
        # The decided plan is dropped first. The stored plan claims the drone until the watch reports its deletion.
        shared.forget(HOST)
        assert await waiting.changed(0)
        assert "d" in shared.fleet.claims()
        stored._drop(HOST)
        assert await waiting.changed(0)
        assert "d" not in shared.fleet.claims()


@pytest.mark.parametrize(("instances", "listens"), [(1, False), (2, True), ("*", True)])
async def test_placed_application_wakes_only_for_capacity(instances: int | str, listens: bool) -> None:
    cache = ClusterCache(cast(Store, None))
    applications = ApplicationController(cast(Store, None), cache, Authority.generate(NOW), lambda: NOW)
    viewer = component("Viewer", "edge", locations=[{"center": at(0, 0), "radius": 100, "instances": instances}])
    body = {**manifest("Application", "grows", {"components": [viewer]}), "status": {}}
    submitted = parse_application(body)
    cache.applications.record_write(submitted.key, body)
    assert submitted.application is not None
    hosts = [host("e1", "edge"), host("e2", "edge", cpu=0.01)]
    stock = inventory([], [edge("e1", (0, 0)), edge("e2", (0, 0))], hosts)
    with cache.subscriptions.subscribe(submitted.key) as grows:
        for _ in range(2):
            observation = cache.observe(submitted)
            applications._plan(submitted.application, observation, stock, _ApplicationState())
            cache.subscriptions.wake_waiting()
            assert not await grows.changed(0)
            cache.subscriptions.wake_for_capacity("e2")
            assert await grows.changed(0) is listens


async def test_deleted_plan_without_pods_releases_capacity() -> None:
    cache = ClusterCache(cast(Store, None))
    spec = {"components": [component("Viewer", "edge", locations=[{"center": at(0, 0), "radius": 9}])]}
    metadata = {"namespace": "ns", "name": "gone", "uid": "gone", "resourceVersion": "1"}
    cache.applications.record_write(("ns", "gone"), {**manifest("Application", "gone", spec), "metadata": metadata})
    placement = {"component": "Viewer", "instance": "viewer-1", "node": "n", "placement": "edge", "role": "static"}
    plan = DeploymentPlanSpec.model_validate({"application": "gone", "placements": [placement]})
    with cache.subscriptions.subscribe(("ns", "waits")) as waits:
        cache.subscriptions.set_placed(("ns", "waits"), placed=True, full={"n"})
        cache.plans.decide(("ns", "gone"), "gone", plan)
        assert not await waits.changed(0)
        cache.plans.decide(("ns", "gone"), "gone", plan.model_copy(update={"placements": ()}))
        assert await waits.changed(0)


async def test_new_application_wakes_no_other_application() -> None:
    cache = ClusterCache(cast(Store, None))
    with cache.subscriptions.subscribe(("ns", "waits")) as waits:
        metadata = {"namespace": "ns", "name": "new", "uid": "new", "resourceVersion": "1"}
        cache.applications.record_write(("ns", "new"), APPLICATION | {"metadata": metadata})
        assert not await waits.changed(0)
        cache.applications._drop(("ns", "new"))
        assert await waits.changed(0)


def test_grouped_objects_are_found_by_group() -> None:
    grouped: GroupedObjects[str] = GroupedObjects()
    grouped.put(("a", "x"), ("a", "1"), "old")
    grouped.put(("a", "x"), ("a", "1"), "one")
    grouped.put(("a", "y"), ("a", "2"), "two")
    assert (list(grouped.of(("a", "x"))), list(grouped.of(("a", "y")))) == (["one"], ["two"])
    grouped.drop(("a", "y"), ("a", "1"))
    grouped.drop(("a", "x"), ("a", "1"))
    assert (list(grouped.of(("a", "x"))), list(grouped.of(("a", "y")))) == ([], ["two"])
    assert list(grouped._groups) == [("a", "y")]


def test_teardown_is_forgotten_with_the_application() -> None:
    cache = ClusterCache(cast(Store, None))
    metadata = {"namespace": "ns", "name": "app", "uid": "u", "resourceVersion": "1"}
    cache.applications.record_write(
        ("ns", "app"), {"apiVersion": V1, "kind": "Application", "metadata": metadata, "spec": {}}
    )
    cache.torn_down["ns", "app"] = "u"
    cache.applications._drop(("ns", "app"))
    assert not cache.torn_down

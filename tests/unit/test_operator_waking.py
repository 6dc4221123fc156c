"""Which applications are woken by what others do, and what is kept of each."""

from __future__ import annotations

from typing import Any, cast

from fractus_core.api.plans import DeploymentPlanSpec
from fractus_operator.cluster.store import Store
from fractus_operator.inventory.grouped import Grouped
from fractus_operator.inventory.live import LiveInventory

V1 = "fractus.dev/v1alpha1"


def drone_body(version: int, state: str) -> dict[str, Any]:
    spec = {"home": {"lat": 0, "lon": 0}, "services": {}}
    metadata = {"name": "d", "resourceVersion": str(version)}
    return {"apiVersion": V1, "kind": "Drone", "metadata": metadata, "spec": spec, "status": {"flightState": state}}


async def test_what_another_application_leaves_wakes_only_those_without_a_plan_that_fits() -> None:
    live = LiveInventory(cast(Store, None))
    live.drones.note(("", "d"), drone_body(1, "flying"))
    with live.subscriptions.subscribe(("ns", "placed")) as placed, live.subscriptions.subscribe(("ns", "new")) as new:
        live.subscriptions.placed(("ns", "placed"), placed=True)
        live.drones.note(("", "d"), drone_body(2, "inactive"))
        assert await new.changed(1)
        assert not await placed.changed(0)
        live.subscriptions.placed(("ns", "placed"), placed=False)
        live.drones.note(("", "d"), drone_body(3, "flying"))
        assert await placed.changed(1)


async def test_an_application_hears_of_its_own_drone_and_of_the_flight_that_it_shares() -> None:
    live = LiveInventory(cast(Store, None))
    live.drones.note(("", "d"), drone_body(1, "flying"))
    plan = {"application": "guest", "drone": {"node": "d", "score": 1.0, "sharedWith": "ns/host"}}
    submitted_body = {"apiVersion": V1, "kind": "Application", "spec": {}}
    for name in ("guest", "host"):
        metadata = {"namespace": "ns", "name": name, "uid": name, "resourceVersion": "1", "generation": 1}
        live.applications.note(("ns", name), submitted_body | {"metadata": metadata})
    live.plans.decide(("ns", "guest"), "guest", DeploymentPlanSpec.model_validate(plan | {"applicationGeneration": 1}))
    with live.subscriptions.subscribe(("ns", "guest")) as guest:
        live.subscriptions.placed(("ns", "guest"), placed=True)
        live.drones.note(("", "d"), drone_body(2, "inactive"))
        assert await guest.changed(1)
        over = submitted_body | {"metadata": {"namespace": "ns", "name": "host", "uid": "host", "resourceVersion": "2"}}
        live.applications.note(("ns", "host"), over | {"status": {"phase": "Completed", "observedGeneration": 1}})
        assert await guest.changed(1)


def test_objects_are_found_by_their_group_alone() -> None:
    grouped: Grouped[str] = Grouped()
    grouped.put(("a", "x"), ("a", "1"), "old")
    grouped.put(("a", "x"), ("a", "1"), "one")
    grouped.put(("a", "y"), ("a", "2"), "two")
    assert (list(grouped.of(("a", "x"))), list(grouped.values())) == (["one"], ["one", "two"])
    grouped.drop(("a", "y"), ("a", "1"))
    grouped.drop(("a", "x"), ("a", "1"))
    assert (list(grouped.of(("a", "x"))), list(grouped.values())) == ([], ["two"])


def test_what_is_remembered_of_a_teardown_goes_with_the_application() -> None:
    live = LiveInventory(cast(Store, None))
    metadata = {"namespace": "ns", "name": "app", "uid": "u", "resourceVersion": "1"}
    live.applications.note(("ns", "app"), {"apiVersion": V1, "kind": "Application", "metadata": metadata, "spec": {}})
    live.torn_down["ns", "app"] = "u"
    live.applications._drop(("ns", "app"))
    assert not live.torn_down

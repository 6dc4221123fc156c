"""Flight plans on a real API server: decision, start at their time, end, and permissions of the operator."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

import chart as fractus_chart
import pytest
from control_plane import ControlPlane, wait_for
from fractus_runtime.kubernetes import KubeError
from operator_world import (
    FRACTUS,
    OperatorProcess,
    World,
    approved_template,
    at,
    component,
    fractus_object,
    navigator,
    traffic,
)

Body = dict[str, Any]


def submit(world: World, namespace: str, name: str = "flight", *, in_s: float = 3600, **more: Any) -> None:
    start = datetime.now(UTC) + timedelta(seconds=in_s)
    window = {"start": start.strftime("%Y-%m-%dT%H:%M:%SZ"), "duration": 15}
    spec = {"template": "survey", "waypoints": [at(50, 50, alt=20)], "window": window, **more}
    world.put(fractus_object("FlightPlan", name, spec, namespace))


def status(world: World, namespace: str, name: str = "flight") -> Body:
    plan = world.api.get(f"{FRACTUS}/namespaces/{namespace}/flightplans/{name}")
    return (plan or {}).get("status") or {}


def started(world: World, namespace: str) -> bool:
    """Return True if the operator has recorded that the Application of the plan was created."""
    conditions = status(world, namespace).get("conditions") or ()
    return any((each["type"], each["status"]) == ("Started", "True") for each in conditions)


def reaches(world: World, namespace: str, state: str, name: str = "flight") -> Body:
    wait_for(
        lambda: status(world, namespace, name).get("state") == state,
        lambda: f"{name} to be {state}: {status(world, namespace, name)}",
    )
    return status(world, namespace, name)


def test_second_plan_at_the_same_place_and_time_is_rejected(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    approved_template(world)
    submit(world, namespace)
    assert reaches(world, namespace, "Accepted")["drone"] == "drone-1"
    submit(world, namespace, "second")
    rejected = reaches(world, namespace, "Rejected", "second")["rejected"]
    assert [(each["node"], each["reason"]) for each in rejected] == [("drone-1", "Reserved")]


def test_plan_flies_at_its_time_and_ends_with_its_mission(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    approved_template(world)
    submit(world, namespace, in_s=4, autoActivate=True)
    reaches(world, namespace, "Accepted")
    world.put(traffic(namespace, "traffic", component("Navigator", "drone", **_driver())))
    wait_for(lambda: world.status(namespace).get("phase") == "Queued", "the Application to wait for the reserved drone")
    name = reaches(world, namespace, "Activated")["application"]
    wait_for(lambda: world.grants(namespace, name), "the Grant of the flight")
    assert world.grants(namespace, name)[0]["spec"]["node"] == "drone-1"
    path = f"{FRACTUS}/grants/{world.grants(namespace, name)[0]['metadata']['name']}/status"
    world.api.merge(path, {"status": {"phase": "Complete", "message": "all waypoints reached"}})
    assert "all waypoints reached" in reaches(world, namespace, "Ended")["message"]
    wait_for(lambda: world.status(namespace).get("drone") == "drone-1", "the other Application to get the drone")


def _driver() -> Body:
    body = navigator()
    return {name: body[name] for name in ("class", "services", "controlPoints")}


@pytest.fixture
def flight_owner(world: World, chart: None, namespace: str) -> Body:
    """Return the owner reference of a flight plan."""
    submit(world, namespace)
    plan = world.api.get(f"{FRACTUS}/namespaces/{namespace}/flightplans/flight")
    assert plan is not None
    return {
        "apiVersion": plan["apiVersion"], "kind": "FlightPlan", "name": "flight", "uid": plan["metadata"]["uid"],
        "controller": True, "blockOwnerDeletion": True,
    }  # fmt: skip


def created(client: Any, namespace: str, name: str, *owners: Body) -> str:
    """Return why an account may not create an Application, or an empty string."""
    body = traffic(namespace, name)
    body["metadata"]["ownerReferences"] = list(owners)
    try:
        client.call("POST", f"{FRACTUS}/namespaces/{namespace}/applications", body, params={"dryRun": "All"})
    except KubeError as error:
        return str(error)
    return ""


def test_only_the_operator_creates_applications_of_flight_plans(
    control_plane: ControlPlane, world: World, namespace: str, flight_owner: Body
) -> None:
    operator = control_plane.with_token(fractus_chart.operator_token(world))
    name = f"flight-{flight_owner['uid']}"
    try:
        assert created(operator, namespace, name, flight_owner) == ""
        assert "only Applications of FlightPlans" in created(operator, namespace, name)
        assert "only Applications of FlightPlans" in created(operator, namespace, "other", flight_owner)
        assert f"metadata.name: {name} is reserved" in created(world.api, namespace, name)
        assert f"metadata.name: {name} is reserved" in created(world.api, namespace, name, flight_owner)
        assert "belongs to a FlightPlan" in created(world.api, namespace, "other", flight_owner)
        assert created(world.api, namespace, "flight-1") == ""
        with pytest.raises(KubeError, match="may delete only dry runs"):
            operator.delete(f"{FRACTUS}/namespaces/{namespace}/flightplans/flight")
        with pytest.raises(KubeError, match="may not write the spec of FlightPlans"):
            operator.merge(f"{FRACTUS}/namespaces/{namespace}/flightplans/flight", {"spec": {"use": "Closed"}})
        finalizers = {"metadata": {"finalizers": ["fractus.dev/landing"]}}
        operator.merge(f"{FRACTUS}/namespaces/{namespace}/flightplans/flight", finalizers)
        operator.merge(f"{FRACTUS}/namespaces/{namespace}/flightplans/flight", {"metadata": {"finalizers": []}})
    finally:
        operator.close()

"""Changes after planning: shared flights, new, deleted and cordoned nodes, another release, a second operator."""

from __future__ import annotations

import signal
import time
import urllib.request
from pathlib import Path
from typing import Any

import pytest
from control_plane import ControlPlane, wait_for
from operator_world import FRACTUS, OperatorProcess, World, at, component, fractus_object, traffic
from test_operator import deployed, end_mission, events, running

Body = dict[str, Any]
VISITS = [at(15, 15, alt=12), at(45, 45, alt=17)]


def guest(namespace: str, name: str = "guest", points: list[Body] | None = None) -> Body:
    """Return a guest Application. It takes pictures at some points from any drone that passes the points."""
    services = [{"service": "camera", "methods": ["CaptureImage"]}]
    camera = component("Camera", "drone", **{"class": "passenger"}, services=services)
    camera["pointsOfInterest"] = {"points": points or VISITS}
    return fractus_object("Application", name, {"components": [camera]}, namespace)


def instances(world: World, namespace: str, prefix: str) -> set[str]:
    """Return the names of the Deployments that begin with a prefix."""
    names = {n.removeprefix("deployments/") for n in world.children(namespace) if n.startswith("deployments/")}
    return {name for name in names if name.startswith(prefix)}


def drone_of(world: World, namespace: str, name: str) -> Body:
    plan = world.api.get(f"{FRACTUS}/namespaces/{namespace}/deploymentplans/{name}") or {"spec": {}}
    return plan["spec"].get("drone") or {}


# -- shared flights --


def test_guest_shares_flight_and_completes_with_host(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    world.put(guest(namespace))
    world.phase(namespace, "Deploying", "guest")
    assert drone_of(world, namespace, "guest")["sharedWith"] == f"{namespace}/traffic"
    (grant,) = wait_for(lambda: world.grants(namespace, "guest"), "the Grant of the guest")
    assert (grant["spec"]["node"], grant["spec"].get("tour")) == ("drone-1", None)
    # The guest's Grant does not assign the drone to the guest, so the host keeps it, also after a restart.
    operator.stop()
    operator.start()
    world.drone_status("drone-1", "flying")
    world.put(guest(namespace, "late", [at(90, 90)]))
    world.phase(namespace, "Queued", "late")
    assert f"{namespace}/traffic" in world.status(namespace, "late")["message"]
    world.phase(namespace, "Flying")
    end_mission(world, namespace, "Complete", "done")
    world.phase(namespace, "Returning", "guest")
    wait_for(lambda: not world.grants(namespace, "guest"), "the Grants of the guest to be deleted")
    world.drone_status("drone-1", "inactive")
    status = world.phase(namespace, "Completed", "guest")
    assert status["message"] == f"{namespace}/traffic has flown drone-1 past all points of interest"


def test_guest_gets_another_drone_when_shared_flight_fails(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    running(world, namespace)
    world.put(guest(namespace))
    world.phase(namespace, "Deploying", "guest")
    world.drone_status("drone-1", "flying")
    world.phase(namespace, "Flying")
    end_mission(world, namespace, "Failed", "driver lost")
    world.phase(namespace, "Returning")
    wait_for(lambda: world.status(namespace, "guest").get("phase") == "Queued", "the guest to be Queued")
    wait_for(lambda: "SharedFlightLost" in events(world, namespace), "an Event")
    wait_for(lambda: not world.grants(namespace, "guest"), "the Grants of the guest to be deleted")
    world.add_drone("drone-2")
    assert world.phase(namespace, "Deploying", "guest")["drone"] == "drone-2"
    assert "sharedWith" not in drone_of(world, namespace, "guest")
    (grant,) = wait_for(lambda: world.grants(namespace, "guest"), "the Grant of the guest")
    assert [(round(p["lat"], 6), p["alt"]) for p in grant["spec"]["tour"]] == [
        (round(p["lat"], 6), p["alt"]) for p in VISITS
    ]
    # The guest now has a separate flight without a driver. The node reports its result in the guest's Grant.
    report = {"status": {"phase": "Complete", "message": "all points were visited"}}
    world.api.merge(f"{FRACTUS}/grants/{namespace}.guest-camera/status", report)
    assert world.phase(namespace, "Completed", "guest")["message"] == "all points were visited"


def test_guest_leaves_host_with_changed_path(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    world.put(guest(namespace))
    world.phase(namespace, "Deploying", "guest")
    world.add_drone("drone-2")
    manifest = traffic(namespace)
    manifest["spec"]["components"][0]["controlPoints"][0]["path"] = [at(0, 0, alt=10), at(60, 0, alt=20)]
    world.put(manifest)
    wait_for(lambda: drone_of(world, namespace, "guest").get("node") == "drone-2", "the guest to have drone-2")
    assert world.status(namespace)["drone"] == "drone-1"


# -- deleted, cordoned and new nodes --


def test_deleted_or_cordoned_node_is_replaced(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    assert instances(world, namespace, "traffic-ground") == {
        "traffic-ground-viewer-edge-2",
        "traffic-ground-viewer-edge-3",
    }
    world.add_edge("edge-4", at(30, 60))
    world.api.delete(f"{FRACTUS}/edgenodes/edge-2")
    wait_for(
        lambda: (
            instances(world, namespace, "traffic-ground")
            == {"traffic-ground-viewer-edge-4", "traffic-ground-viewer-edge-3"}
        ),
        lambda: f"an instance on the remaining node: {instances(world, namespace, 'traffic-ground')}",
    )
    world.api.merge("/api/v1/nodes/edge-4", {"spec": {"unschedulable": True}})
    wait_for(
        lambda: (
            instances(world, namespace, "traffic-ground")
            == {"traffic-ground-viewer-edge-1", "traffic-ground-viewer-edge-3"}
        ),
        lambda: f"the instance to be moved from the cordoned node: {instances(world, namespace, 'traffic-ground')}",
    )
    assert world.status(namespace)["drone"] == "drone-1"


def test_cordoned_drone_is_kept_in_flight_and_replaced_on_ground(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    running(world, namespace)
    world.api.merge("/api/v1/nodes/drone-1", {"spec": {"unschedulable": True}})
    # No other drone exists, so the plan is kept.
    wait_for(lambda: world.status(namespace).get("drone") == "drone-1", "drone-1 in the status")
    world.drone_status("drone-1", "flying")
    world.add_drone("drone-2")
    world.put(traffic(namespace, "second"))
    assert world.phase(namespace, "Deploying", "second")["drone"] == "drone-2"
    assert world.status(namespace)["drone"] == "drone-1"
    world.drone_status("drone-1", "inactive")
    world.add_drone("drone-3")
    wait_for(lambda: world.status(namespace).get("drone") == "drone-3", lambda: f"{world.status(namespace)}")
    wait_for(lambda: "drone-3" in {g["spec"]["node"] for g in world.grants(namespace)}, "the Grants of drone-3")


# Unit tests plan with both numbers of instances (test_plan_changes.py).
@pytest.mark.parametrize("count", ["*", pytest.param(3, marks=pytest.mark.slow)])
def test_new_node_scales_up_the_plan(world: World, operator: OperatorProcess, namespace: str, count: Any) -> None:
    viewer = component("GroundViewer", "edge", locations=[{"center": at(40, 30), "radius": 15, "instances": count}])
    world.put(traffic(namespace, "traffic", viewer))
    deployed(world, namespace, pods=1)
    before = {n: b["metadata"]["uid"] for n, b in world.children(namespace).items()}
    world.add_edge("edge-9", at(45, 30))
    wait_for(lambda: "traffic-ground-viewer-edge-9" in instances(world, namespace, ""), "the new node")
    after = {n: b["metadata"]["uid"] for n, b in world.children(namespace).items()}
    assert before.items() <= after.items()
    deployed(world, namespace, pods=2)
    wait_for(
        lambda: world.status(namespace)["pods"] == "2/2", lambda: f"both pods in the status: {world.status(namespace)}"
    )


def test_policy_conflict_is_reported_before_takeoff_until_policy_is_deleted(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    running(world, namespace)
    fence = {"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": ["across"]}}
    world.put(fractus_object("Zone", "across", {"area": {"circle": {"center": at(30, 30), "radius": 5}}}))
    policy = fractus_object("Policy", "across", fence)
    world.put(policy)
    conflict = wait_for(lambda: world.condition(namespace, "PolicyConflict"), "the condition PolicyConflict")
    assert conflict["status"] == "True"
    assert "crosses zone across for 10.0 m of policy across" in conflict["message"]
    wait_for(lambda: "policyConflict" in drone_of(world, namespace, "traffic"), "the conflict in the plan")
    leg = drone_of(world, namespace, "traffic")["legality"][0]
    assert (leg["flownBy"], leg["outcome"], leg["policies"]) == ("driver", "Denied", ["across"])
    assert world.status(namespace)["phase"] == "Waiting"
    wait_for(lambda: "PolicyConflict" in events(world, namespace), "the Event")
    world.api.delete(world.path(policy))
    wait_for(lambda: not world.condition(namespace, "PolicyConflict"), "the condition to be removed")


# -- releases --


def test_grants_serialized_by_another_release_are_kept(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    operator.stop()
    for grant in world.grants(namespace):
        # Simulate a release that writes default values, and an annotation with a digest of what it applied.
        old = {"metadata": {"annotations": {"fractus.dev/applied": "of-old"}}, "spec": {"tour": [], "policies": []}}
        world.api.merge(f"{FRACTUS}/grants/{grant['metadata']['name']}", old)
    before = {g["metadata"]["name"]: g["metadata"]["resourceVersion"] for g in world.grants(namespace)}
    world.api.merge(f"{FRACTUS}/namespaces/{namespace}/deploymentplans/traffic", {"spec": {"application": "traffic"}})
    operator.start()
    path = f"/apis/apps/v1/namespaces/{namespace}/deployments/traffic-data-store"
    world.api.merge(path, {"spec": {"replicas": 3}})
    wait_for(lambda: (world.api.get(path) or {})["spec"]["replicas"] == 1, "the end of a reconciliation")
    assert {g["metadata"]["name"]: g["metadata"]["resourceVersion"] for g in world.grants(namespace)} == before


# -- two operators --


def test_second_operator_takes_over_from_frozen_leader(
    control_plane: ControlPlane, world: World, namespace: str, tmp_path: Path
) -> None:
    brief = {"FRACTUS_LEASE": "3"}
    first, second = (
        OperatorProcess(control_plane.kubeconfig, tmp_path / f"{name}.log", name, **brief) for name in ("one", "two")
    )
    first.start()
    try:
        wait_for(lambda: "became leader (identity=one)" in first.log(), first.log)
        second.start()
        wait_for(lambda: "waiting for the leader to end" in second.log(), second.log)
        world.put(traffic(namespace))
        world.phase(namespace, "Deploying")
        # Freeze the leader, as on a paused machine, and resume it while the other operator is the leader.
        first.signal(signal.SIGSTOP)
        world.add_drone("drone-2")
        world.put(traffic(namespace, "second"))
        world.phase(namespace, "Deploying", "second")
        assert f"planned (application={namespace}/second " in second.log()
        first.signal(signal.SIGCONT)
        wait_for(lambda: not first.running, "the first operator to exit")
        assert "two has acted since one last held the Lease" in first.log()
        assert f"planned (application={namespace}/second " not in first.log()
    finally:
        if first.running:
            first.stop(signal.SIGKILL)
        if second.running:
            # The operator releases the Lease, so that the next test's operator need not wait for its expiry.
            second.stop()


def test_second_operator_takes_over_within_15_s_of_killed_leader(
    control_plane: ControlPlane, world: World, namespace: str, tmp_path: Path
) -> None:
    first, second = (
        OperatorProcess(control_plane.kubeconfig, tmp_path / f"{name}.log", name) for name in ("lost", "next")
    )
    first.start()
    try:
        wait_for(lambda: "became leader" in first.log(), first.log)
        second.start()
        wait_for(lambda: "waiting for the leader to end" in second.log(), second.log)
        for operator in (first, second):
            wait_for(lambda operator=operator: healthy(operator), operator.log)  # type: ignore[misc]
        assert "became leader" not in second.log()
        first.stop(signal.SIGKILL)
        lost_s = time.monotonic()
        wait_for(lambda: "became leader (identity=next)" in second.log(), second.log)
        assert time.monotonic() - lost_s < 15
        world.put(traffic(namespace))
        world.phase(namespace, "Deploying")
        wait_for(lambda: healthy(second), second.log)
    finally:
        if first.running:
            first.stop(signal.SIGKILL)
        if second.running:
            second.stop()


def healthy(operator: OperatorProcess) -> bool:
    try:
        with urllib.request.urlopen(operator.health, timeout=5) as response:
            return bool(response.status == 200)
    except OSError:
        return False

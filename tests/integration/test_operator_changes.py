"""What changes around a plan: nodes that come, go or are cordoned, shared flights, releases that serialize differently."""

from __future__ import annotations

import signal
import time
import urllib.request
from pathlib import Path
from typing import Any

import pytest
from control_plane import ControlPlane, wait_for
from operator_world import FRACTUS, OperatorProcess, World, at, component, ours, traffic
from test_operator import deployed, end_mission, events, running

Body = dict[str, Any]
VISITS = [at(15, 15, alt=12), at(45, 45, alt=17)]


def guest(namespace: str, name: str = "guest", points: list[Body] | None = None) -> Body:
    """An application that only wants pictures of some places, wherever the drone that passes them belongs."""
    services = [{"service": "camera", "methods": ["CaptureImage"]}]
    camera = component("Camera", "drone", **{"class": "passenger"}, services=services)
    camera["pointsOfInterest"] = {"points": points or VISITS}
    return ours("Application", name, {"components": [camera]}, namespace)


def instances(world: World, namespace: str, prefix: str) -> set[str]:
    """Names of the Deployments that begin so."""
    names = {n.removeprefix("deployments/") for n in world.children(namespace) if n.startswith("deployments/")}
    return {name for name in names if name.startswith(prefix)}


def drone_of(world: World, namespace: str, name: str) -> Body:
    plan = world.api.get(f"{FRACTUS}/namespaces/{namespace}/deploymentplans/{name}") or {"spec": {}}
    return plan["spec"].get("drone") or {}


# -- coming along --


def test_a_guest_comes_along_and_is_done_when_its_host_is(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    running(world, namespace)
    world.put(guest(namespace))
    world.phase(namespace, "Deploying", "guest")
    assert drone_of(world, namespace, "guest")["sharedWith"] == f"{namespace}/traffic"
    (grant,) = world.grants(namespace, "guest")
    assert (grant["spec"]["node"], grant["spec"].get("tour")) == ("drone-1", None)
    # Its grant claims nothing: the host keeps its drone, also for an operator that knows only what is written.
    operator.stop()
    operator.start()
    world.drone_status("drone-1", "flying")
    world.put(guest(namespace, "late", [at(90, 90)]))
    world.phase(namespace, "Queued", "late")
    assert f"{namespace}/traffic" in world.status(namespace, "late")["message"]
    world.phase(namespace, "Flying")
    end_mission(world, namespace, "Complete", "done")
    world.phase(namespace, "Returning", "guest")
    wait_for(lambda: not world.grants(namespace, "guest"), "the guest's grants to go")
    world.drone_status("drone-1", "inactive")
    status = world.phase(namespace, "Completed", "guest")
    assert status["message"] == f"{namespace}/traffic has flown drone-1 past all points of interest"


def test_a_guest_whose_ride_fails_gets_another_drone(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    world.put(guest(namespace))
    world.phase(namespace, "Deploying", "guest")
    world.drone_status("drone-1", "flying")
    end_mission(world, namespace, "Failed", "driver lost")
    world.phase(namespace, "Returning")
    wait_for(lambda: world.status(namespace, "guest").get("phase") == "Queued", "the guest to wait")
    wait_for(lambda: "SharedFlightLost" in events(world, namespace), "an Event")
    wait_for(lambda: not world.grants(namespace, "guest"), "the guest's grants to go")
    world.add_drone("drone-2")
    assert world.phase(namespace, "Deploying", "guest")["drone"] == "drone-2"
    assert "sharedWith" not in drone_of(world, namespace, "guest")
    (grant,) = world.grants(namespace, "guest")
    assert [(round(p["lat"], 6), p["alt"]) for p in grant["spec"]["tour"]] == [
        (round(p["lat"], 6), p["alt"]) for p in VISITS
    ]
    # It has no driver: the node says of its own grant how the tour ended.
    report = {"status": {"phase": "Complete", "message": "all points were visited"}}
    world.api.merge(f"{FRACTUS}/grants/{namespace}.guest-camera/status", report)
    assert world.phase(namespace, "Completed", "guest")["message"] == "all points were visited"


def test_a_guest_leaves_a_host_that_turns_elsewhere(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    world.put(guest(namespace))
    world.phase(namespace, "Deploying", "guest")
    world.add_drone("drone-2")
    manifest = traffic(namespace)
    manifest["spec"]["components"][0]["controlPoints"][0]["path"] = [at(0, 0, alt=10), at(60, 0, alt=20)]
    world.put(manifest)
    wait_for(lambda: drone_of(world, namespace, "guest").get("node") == "drone-2", "a drone of its own")
    assert world.status(namespace)["drone"] == "drone-1"


# -- nodes that come and go --


def test_a_node_that_goes_or_is_cordoned_is_left(world: World, operator: OperatorProcess, namespace: str) -> None:
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
        lambda: f"the node that is left: {instances(world, namespace, 'traffic-ground')}",
    )
    world.api.merge("/api/v1/nodes/edge-4", {"spec": {"unschedulable": True}})
    wait_for(
        lambda: (
            instances(world, namespace, "traffic-ground")
            == {"traffic-ground-viewer-edge-1", "traffic-ground-viewer-edge-3"}
        ),
        lambda: f"the cordoned node to be left: {instances(world, namespace, 'traffic-ground')}",
    )
    assert world.status(namespace)["drone"] == "drone-1"


def test_a_cordoned_drone_flies_on_and_one_on_the_ground_is_replaced(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    running(world, namespace)
    world.api.merge("/api/v1/nodes/drone-1", {"spec": {"unschedulable": True}})
    # There is no other: what runs goes on.
    wait_for(lambda: world.status(namespace).get("drone") == "drone-1", "the plan to stand")
    world.drone_status("drone-1", "flying")
    world.add_drone("drone-2")
    world.put(traffic(namespace, "second"))
    assert world.phase(namespace, "Deploying", "second")["drone"] == "drone-2"
    assert world.status(namespace)["drone"] == "drone-1"
    world.drone_status("drone-1", "inactive")
    world.add_drone("drone-3")
    wait_for(lambda: world.status(namespace).get("drone") == "drone-3", lambda: f"{world.status(namespace)}")
    assert {g["spec"]["node"] for g in world.grants(namespace)} >= {"drone-3"}


@pytest.mark.parametrize("count", ["*", 3])
def test_new_nodes_make_a_plan_grow(world: World, operator: OperatorProcess, namespace: str, count: Any) -> None:
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
        lambda: world.status(namespace)["pods"] == "2/2", lambda: f"both pods to be told: {world.status(namespace)}"
    )


def test_a_zone_across_the_way_is_told_before_takeoff_until_it_goes(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    running(world, namespace)
    fence = {"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": ["across"]}}
    world.put(ours("Zone", "across", {"area": {"circle": {"center": at(30, 30), "radius": 5}}}))
    policy = ours("Policy", "across", fence)
    world.put(policy)
    told = wait_for(lambda: world.condition(namespace, "PolicyConflict"), "the condition PolicyConflict")
    assert told["status"] == "True"
    assert "crosses zone across for 10.0 m of policy across" in told["message"]
    wait_for(lambda: "policyConflict" in drone_of(world, namespace, "traffic"), "the plan to say so")
    leg = drone_of(world, namespace, "traffic")["legality"][0]
    assert (leg["flownBy"], leg["outcome"], leg["policies"]) == ("driver", "Denied", ["across"])
    assert world.status(namespace)["phase"] == "Waiting"
    wait_for(lambda: "PolicyConflict" in events(world, namespace), "the Event")
    world.api.delete(world.path(policy))
    wait_for(lambda: not world.condition(namespace, "PolicyConflict"), "the condition to go")


# -- releases --


def test_a_release_that_spells_grants_in_another_way_leaves_those_in_use(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    running(world, namespace)
    operator.stop()
    for grant in world.grants(namespace):
        # As a release would that writes defaults, and stamps what it wrote.
        old = {"metadata": {"annotations": {"fractus.dev/applied": "of-old"}}, "spec": {"tour": [], "policies": []}}
        world.api.merge(f"{FRACTUS}/grants/{grant['metadata']['name']}", old)
    before = {g["metadata"]["name"]: g["metadata"]["resourceVersion"] for g in world.grants(namespace)}
    world.api.merge(f"{FRACTUS}/namespaces/{namespace}/deploymentplans/traffic", {"spec": {"application": "traffic"}})
    operator.start()
    path = f"/apis/apps/v1/namespaces/{namespace}/deployments/traffic-data-store"
    world.api.merge(path, {"spec": {"replicas": 3}})
    wait_for(lambda: (world.api.get(path) or {})["spec"]["replicas"] == 1, "the end of a reconcile")
    assert {g["metadata"]["name"]: g["metadata"]["resourceVersion"] for g in world.grants(namespace)} == before


# -- two operators --


def test_of_two_operators_one_acts_and_the_other_takes_over(
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
        # Frozen, as on a machine that was paused, and then thawed beside the one that acts meanwhile.
        first.signal(signal.SIGSTOP)
        world.add_drone("drone-2")
        world.put(traffic(namespace, "second"))
        world.phase(namespace, "Deploying", "second")
        assert f"planned (application={namespace}/second " in second.log()
        first.signal(signal.SIGCONT)
        wait_for(lambda: not first.running, "the first one to end")
        assert "two has acted since one last held the Lease" in first.log()
        assert f"planned (application={namespace}/second " not in first.log()
    finally:
        if first.running:
            first.stop(signal.SIGKILL)
        if second.running:
            # It gives the Lease back: the next test's operator need not wait until that has run out.
            second.stop()


def test_the_second_operator_is_healthy_and_acts_within_15_s_of_the_end_of_the_first(
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
        world.put(traffic(namespace))
        world.phase(namespace, "Deploying")
        assert time.monotonic() - lost_s < 15
        assert healthy(second)
    finally:
        if first.running:
            first.stop(signal.SIGKILL)
        if second.running:
            second.stop()


def healthy(operator: OperatorProcess) -> bool:
    try:
        with urllib.request.urlopen(operator.health, timeout=5) as answer:
            return bool(answer.status == 200)
    except OSError:
        return False

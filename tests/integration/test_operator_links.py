"""DirectLinks on a real API server: created from a plan, updated with pods and nodes, deleted with the Application."""

from __future__ import annotations

import copy
from typing import Any

import pytest
from control_plane import wait_for
from fractus_runtime.kubernetes import ContentType
from operator_world import FRACTUS, OperatorProcess, World, at, component, fractus_object, traffic
from test_operator import deployed, end_mission, events, gone, running

Body = dict[str, Any]


def targets(world: World, namespace: str, name: str = "traffic") -> dict[str, Any]:
    """Return the target address of each DirectLink by node: the IP of a pod, or None if the link has no target."""
    links = world.links(namespace, name).items()
    return {node: (body["spec"]["services"][0].get("target") or {}).get("address") for node, body in links}


def checkers(world: World, namespace: str) -> dict[str, Body]:
    """Return the pods of the hybrid component on edge nodes, by node."""
    pods = [p for p in world.pods(namespace) if p["metadata"]["labels"]["fractus.dev/component"] == "ImageChecker"]
    return {pod["spec"]["nodeName"]: pod for pod in pods if pod["spec"]["nodeName"] != "cloud-1"}


def addresses(world: World, namespace: str) -> dict[str, Any]:
    return {node: pod["status"]["podIP"] for node, pod in checkers(world, namespace).items()}


def test_direct_links_target_pods_usable_by_drone(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    links = world.links(namespace)
    assert links, "no links"
    assert targets(world, namespace) == addresses(world, namespace)
    service = world.api.get(f"/api/v1/namespaces/{namespace}/services/traffic-image-checker")
    assert service is not None
    for node, body in links.items():
        spec = body["spec"]
        assert (spec["drone"], spec["range"], spec["pairing"]["networkId"]) == ("drone-1", 80, node)
        assert spec["services"][0]["virtual"] == {
            "address": service["spec"]["clusterIP"], "port": 8080, "protocol": "TCP",
        }  # fmt: skip
        assert [place.get("alt") for place in spec["path"]] == [None, 10, 20]


def restarted(world: World, namespace: str, pod: Body, ip: str) -> None:
    """Delete a pod, and bind and start its successor like scheduler and kubelet."""
    pods = f"/api/v1/namespaces/{namespace}/pods"
    world.api.delete(f"{pods}/{pod['metadata']['name']}", grace_s=0)

    def unbound() -> str | None:
        return next((p["metadata"]["name"] for p in world.pods(namespace) if not p["spec"].get("nodeName")), None)

    name = wait_for(unbound, "the pod's successor")
    target = {"kind": "Node", "name": pod["spec"]["nodeName"]}
    world.api.call("POST", f"{pods}/{name}/binding", {"metadata": {"name": name}, "target": target})
    ready = {"type": "Ready", "status": "True", "lastTransitionTime": "2026-01-01T00:00:00Z"}
    status = {"phase": "Running", "podIP": ip, "podIPs": [{"ip": ip}], "conditions": [ready]}
    world.api.merge(f"{pods}/{name}/status", {"status": status})


def base_addresses(world: World, namespace: str) -> list[str]:
    """Return the pod addresses to which calls of the hybrid component go over the cloud path."""
    path = f"/apis/discovery.k8s.io/v1/namespaces/{namespace}/endpointslices/traffic-image-checker"
    return [a for endpoint in (world.api.get(path) or {}).get("endpoints") or () for a in endpoint["addresses"]]


@pytest.mark.parametrize(
    "change",
    # While a change is pending or cannot be planned, `Rollout.update_addresses` changes the addresses. `make test` runs one case.
    ["none", pytest.param("waits for the landing", marks=pytest.mark.slow), "cannot be planned"],
)
def test_direct_links_and_cloud_path_follow_restarted_pods(
    world: World, operator: OperatorProcess, namespace: str, change: str
) -> None:
    running(world, namespace)
    world.drone_status("drone-1", "flying")
    world.phase(namespace, "Flying")
    manifest = traffic(namespace)
    if change == "waits for the landing":
        manifest["spec"]["components"][0]["container"]["image"] = "registry.test/component:2"
        world.put(manifest)
        wait_for(
            lambda: "WaitsForLanding" in str(world.status(namespace)),
            lambda: f"the status to contain WaitsForLanding; {world.status(namespace)}",
        )
    elif change == "cannot be planned":
        manifest["spec"]["updatePolicy"] = "Immediate"
        manifest["spec"]["components"][0]["controlPoints"][0]["point"]["depot"] = "nowhere"
        world.put(manifest)
        world.phase(namespace, "Invalid")
    ((node, pod),) = checkers(world, namespace).items()
    restarted(world, namespace, pod, "10.1.9.9")
    wait_for(lambda: targets(world, namespace)[node] == "10.1.9.9", "the new address of the edge pod in the DirectLink")
    base = next(
        p for p in world.pods(namespace) if p["metadata"]["labels"]["fractus.dev/instance"] == "traffic-image-checker"
    )
    restarted(world, namespace, base, "10.1.9.8")
    wait_for(
        lambda: base_addresses(world, namespace) == ["10.1.9.8"], "the new address of the base pod in the EndpointSlice"
    )


def test_direct_link_status_survives_operator_restart(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    link = next(iter(world.links(namespace).values()))
    path = f"{FRACTUS}/directlinks/{link['metadata']['name']}"
    reported = world.api.merge(f"{path}/status", {"status": {"phase": "Up", "traffic": "direct", "switches": 3}})
    operator.stop()
    operator.start()
    # When the new operator has created this Service again, it has processed all objects.
    service = f"/api/v1/namespaces/{namespace}/services/traffic-data-store"
    world.api.delete(service)
    wait_for(lambda: world.api.get(service), "the Service to be created again")
    wait_for(lambda: world.condition(namespace, "Ready").get("status") == "True", "the Application to be Ready")
    assert world.api.get(path) == reported


def test_direct_link_transitions_have_events(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    path = f"{FRACTUS}/directlinks/{next(iter(world.links(namespace).values()))['metadata']['name']}"
    direct = {"phase": "Up", "traffic": "direct", "switches": 1, "message": "it is faster"}
    world.api.merge(f"{path}/status", {"status": direct})
    wait_for(lambda: {"LinkUp", "TrafficDirect"} <= set(events(world, namespace)), "both Events")
    reasons = events(world, namespace)
    assert reasons.count("LinkUp") == reasons.count("TrafficDirect") == 1
    world.api.merge(f"{path}/status", {"status": {"switches": 2, "traffic": "cloud"}})
    wait_for(lambda: "TrafficCloud" in events(world, namespace), "an Event")
    assert events(world, namespace).count("LinkUp") == 1


def test_direct_links_of_another_release_are_corrected(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    operator.stop()
    node, link = next(iter(world.links(namespace).items()))
    name = link["metadata"]["name"]
    old = copy.deepcopy(link["spec"])
    del old["path"]
    old["range"] = 5
    left_over = fractus_object("DirectLink", f"{namespace}.traffic-drone-1-long-ago", {**old, "node": "long-ago"})
    left_over["metadata"]["labels"] = link["metadata"]["labels"]
    steps = [{"op": "replace", "path": "/spec", "value": old}, {"op": "remove", "path": "/metadata/annotations"}]
    world.api.call("PATCH", f"{FRACTUS}/directlinks/{name}", steps, content_type=ContentType.JSON_PATCH)
    world.put(left_over)
    operator.start()
    wait_for(lambda: world.links(namespace)[node]["spec"] == link["spec"], "the DirectLink to be corrected")
    wait_for(lambda: "long-ago" not in world.links(namespace), "the DirectLink without a plan to be deleted")


def test_direct_links_follow_drone_and_end_with_mission(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    running(world, namespace)
    nodes = set(world.links(namespace))
    world.add_drone("drone-2")
    world.api.delete(f"{FRACTUS}/drones/drone-1")
    world.api.delete("/api/v1/nodes/drone-1")

    def moved() -> bool:
        links = world.links(namespace)
        return set(links) == nodes and {body["spec"]["drone"] for body in links.values()} == {"drone-2"}

    wait_for(moved, lambda: f"the DirectLinks of drone-2; {world.links(namespace)}")
    world.api.delete(f"{FRACTUS}/edgenodes/{min(nodes)}")
    wait_for(lambda: min(nodes) not in world.links(namespace), "the DirectLink of the deleted node to be deleted")
    world.drone_status("drone-2", "flying")
    end_mission(world, namespace, "Complete", "done")
    wait_for(lambda: not world.links(namespace), "the DirectLinks to be deleted")


# `make test` shows this with test_deleted_application_leaves_no_objects.
@pytest.mark.slow
def test_direct_links_are_deleted_with_application(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    world.api.delete(world.path(traffic(namespace)))
    wait_for(
        lambda: gone(world, namespace), lambda: f"all child objects to be deleted; {world.children(namespace).keys()}"
    )


# `make test` shows this with test_grant_is_deleted_if_finalizer_was_removed_by_hand.
@pytest.mark.slow
def test_direct_links_without_application_are_deleted(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    operator.stop()
    path = world.path(traffic(namespace))
    world.api.delete(path)
    world.api.merge(path, {"metadata": {"finalizers": None}})
    assert world.links(namespace)
    operator.start()
    wait_for(lambda: not world.links(namespace), "the DirectLinks to be deleted")


def test_direct_links_of_two_applications_on_one_drone_are_separate(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    running(world, namespace)
    services = [{"service": "camera", "methods": ["CaptureImage"]}]
    camera = component("Camera", "drone", **{"class": "passenger"}, services=services, egress=["Sorter"])
    camera["pointsOfInterest"] = {"points": [at(15, 15, alt=12), at(45, 45, alt=17)]}
    sorter = component("Sorter", "hybrid", hybridTo=["Camera"], ingress=["Camera"])
    world.put(fractus_object("Application", "guest", {"components": [camera, sorter]}, namespace))
    wait_for(lambda: world.links(namespace, "guest"), lambda: f"links; {world.status(namespace, 'guest')}")
    plan = (world.api.get(f"{FRACTUS}/namespaces/{namespace}/deploymentplans/guest") or {})["spec"]
    deployed(world, namespace, "guest", pods=7 + len(plan["placements"]))
    guests = world.links(namespace, "guest")
    hosts = world.links(namespace)
    assert {body["spec"]["drone"] for body in [*guests.values(), *hosts.values()]} == {"drone-1"}
    # Both Applications share the flight of the host, so the DirectLinks of both contain its path.
    assert next(iter(guests.values()))["spec"]["path"] == next(iter(hosts.values()))["spec"]["path"]
    world.api.delete(f"{FRACTUS}/namespaces/{namespace}/applications/guest")
    wait_for(lambda: not world.links(namespace, "guest"), "the DirectLinks of the guest to be deleted")
    assert {n: b["metadata"]["uid"] for n, b in world.links(namespace).items()} == {
        n: b["metadata"]["uid"] for n, b in hosts.items()
    }

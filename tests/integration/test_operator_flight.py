"""Protection of services and nodes of a drone in flight: changes that the API server refuses to every client."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from chart import operator_token, render
from control_plane import ControlPlane, wait_for
from docs_pages import shell_lines
from docs_shell import Shell
from fractus_runtime.kubernetes import KubeError
from operator_world import FRACTUS, NODES, SYSTEM, OperatorProcess, World, traffic

Body = dict[str, Any]
PODS = f"/api/v1/namespaces/{SYSTEM}/pods"
DAEMON_SETS = f"/apis/apps/v1/namespaces/{SYSTEM}/daemonsets"
NODE = "/api/v1/nodes/drone-1"
CLASS_TAINT = {"key": "fractus.dev/class", "value": "drone", "effect": "NoExecute"}


@pytest.fixture
def guarded(world: World, chart: None) -> Iterator[World]:
    """Two drones with their services, and the chart's admission policies. Drone-1 flies."""
    world.add_drone("drone-2")
    world.drone_status("drone-1", "flying")
    for body in (*render(), *render("--set=drone=drone-1", chart="fractus-demo")):
        if body["kind"] == "DaemonSet":
            world.api.apply(f"{DAEMON_SETS}/{body['metadata']['name']}", body)
    for drone in ("drone-1", "drone-2"):
        world.api.merge(f"/api/v1/nodes/{drone}", {"spec": {"taints": [CLASS_TAINT]}})
        for part in ("agent", "camera", "mobility"):
            service(world, part, drone)
    wait_for(lambda: refusal(lambda: try_delete(world, f"{PODS}/fractus-mobility-drone-1")), "the policies")
    yield world
    world.clear()
    for body in world.api.list(DAEMON_SETS):
        world.api.delete(f"{DAEMON_SETS}/{body['metadata']['name']}")


def service(world: World, part: str, node: str, revision: str = "old") -> None:
    name = f"fractus-{part}-{node}"
    owner = (world.api.get(f"{DAEMON_SETS}/fractus-{part}") or {})["metadata"]["uid"]
    reference = {
        "apiVersion": "apps/v1",
        "kind": "DaemonSet",
        "name": f"fractus-{part}",
        "uid": owner,
        "controller": True,
    }
    labels = {"app.kubernetes.io/name": "fractus", "app.kubernetes.io/component": part}
    metadata = {"name": name, "labels": labels | {"controller-revision-hash": revision}, "ownerReferences": [reference]}
    spec = {"nodeName": node, "containers": [{"name": part, "image": "services:1"}]}
    world.api.apply(f"{PODS}/{name}", {"apiVersion": "v1", "kind": "Pod", "metadata": metadata, "spec": spec})
    state = {"running": {"startedAt": "2026-01-01T00:00:00Z"}}
    container = {"name": part, "image": "services:1", "imageID": "", "ready": True, "restartCount": 0, "state": state}
    ready = {"type": "Ready", "status": "True"}
    status = {"phase": "Running", "conditions": [ready], "containerStatuses": [container]}
    world.api.merge(f"{PODS}/{name}/status", {"status": status})


def refusal(attempt: Callable[[], object]) -> str:
    """Return the API server's reason for refusing a request, or an empty string if it accepts the request."""
    try:
        attempt()
    except KubeError as error:
        assert error.status == 403, error
        return str(error)
    return ""


def whole(world: World, path: str) -> Body:
    return world.api.get(path) or {}


def try_delete(world: World, path: str, **options: object) -> object:
    return world.api.call("DELETE", path, {"dryRun": ["All"], **options})


def evict(world: World, pod: str) -> object:
    body = {"apiVersion": "policy/v1", "kind": "Eviction", "metadata": {"name": pod, "namespace": SYSTEM}}
    return world.api.call("POST", f"{PODS}/{pod}/eviction?dryRun=All", body)


def attempts(world: World, drone: str) -> dict[str, Callable[[], object]]:
    """Return requests (dry runs) that would remove or end a service of a drone."""
    api = world.api
    pod = f"{PODS}/fractus-mobility-{drone}"
    node = f"/api/v1/nodes/{drone}"
    dry = "?dryRun=All"
    # This container shares the process namespace of the service, so it could kill the service.
    debugger = {"name": "debugger", "image": "tools:1", "targetContainerName": "mobility"}
    return {
        "delete a pod": lambda: try_delete(world, pod),
        "delete a pod by force": lambda: try_delete(world, pod, gracePeriodSeconds=0),
        "delete the agent's pod": lambda: try_delete(world, f"{PODS}/fractus-agent-{drone}"),
        "delete all pods": lambda: try_delete(world, PODS),
        "change a pod's image": lambda: api.merge(
            pod + dry, {"spec": {"containers": [{**whole(world, pod)["spec"]["containers"][0], "image": "bad"}]}}
        ),
        "add a debug container to a pod": lambda: api.merge(
            f"{pod}/ephemeralcontainers{dry}", {"spec": {"ephemeralContainers": [debugger]}}
        ),
        "give a pod a deadline": lambda: api.merge(pod + dry, {"spec": {"activeDeadlineSeconds": 1}}),
        "change the component label of a pod": lambda: api.merge(
            pod + dry, {"metadata": {"labels": {"app.kubernetes.io/component": "x"}}}
        ),
        "remove the node's label": lambda: api.merge(node + dry, {"metadata": {"labels": {"fractus.dev/class": None}}}),
        "change the node's label": lambda: api.merge(
            node + dry, {"metadata": {"labels": {"fractus.dev/class": "edge"}}}
        ),
        "taint the node": lambda: api.merge(
            node + dry, {"spec": {"taints": [CLASS_TAINT, {"key": "x", "effect": "NoExecute"}]}}
        ),
        "remove the node's taint": lambda: api.merge(node + dry, {"spec": {"taints": []}}),
        "weaken the node's taint": lambda: api.merge(
            node + dry, {"spec": {"taints": [{**CLASS_TAINT, "effect": "NoSchedule"}]}}
        ),
        "change the value of the node's taint": lambda: api.merge(
            node + dry, {"spec": {"taints": [{**CLASS_TAINT, "value": "edge"}]}}
        ),
        "delete the node": lambda: try_delete(world, node),
        "delete the Drone": lambda: try_delete(world, f"{FRACTUS}/drones/{drone}"),
    }


def together(world: World) -> dict[str, Callable[[], object]]:
    """Return requests (dry runs) that would remove services of all drones together."""
    api = world.api
    dry = "?dryRun=All"
    camera = f"{DAEMON_SETS}/fractus-camera{dry}"

    def pods(**spec: object) -> Body:
        return {"spec": {"template": {"spec": spec}}}

    return {
        "evict a pod": lambda: evict(world, "fractus-mobility-drone-1"),
        "delete a DaemonSet": lambda: try_delete(world, f"{DAEMON_SETS}/fractus-mobility"),
        "move a DaemonSet": lambda: api.merge(camera, pods(nodeSelector={"a": "b"})),
        "move a DaemonSet to a node": lambda: api.merge(camera, pods(nodeName="drone-2")),
        "remove the tolerations of a DaemonSet": lambda: api.merge(camera, pods(tolerations=[])),
        "let a DaemonSet roll out updates": lambda: api.merge(
            f"{DAEMON_SETS}/fractus-agent{dry}", {"spec": {"updateStrategy": {"type": "RollingUpdate"}}}
        ),
        "delete the namespace": lambda: try_delete(world, f"/api/v1/namespaces/{SYSTEM}"),
        "delete the namespace of nodes": lambda: try_delete(world, f"/api/v1/namespaces/{NODES}"),
        "delete all DaemonSets": lambda: try_delete(world, DAEMON_SETS),
        **{
            f"delete a DaemonSet with --cascade={policy}": lambda policy=policy: try_delete(
                world, f"{DAEMON_SETS}/fractus-mobility", propagationPolicy=policy
            )
            for policy in ("Orphan", "Foreground")
        },
        **{
            f"delete the demo's vehicle with --cascade={policy}": lambda policy=policy: try_delete(
                world, f"{DAEMON_SETS}/fractus-demo-vehicle", propagationPolicy=policy
            )
            for policy in ("Orphan", "Foreground", "Background")
        },
    }


def test_services_of_drone_in_flight_cannot_be_removed(guarded: World) -> None:
    for name, attempt in {**attempts(guarded, "drone-1"), **together(guarded)}.items():
        # Each policy receives the state of the drones on its own.
        wait_for(
            lambda attempt=attempt: "drone-1 is in the air: wait until it has landed" in refusal(attempt),
            f"the refusal to {name}",
        )
    for name, attempt in attempts(guarded, "drone-2").items():
        if name != "delete all pods":
            assert not refusal(attempt), name


def test_harmless_changes_are_allowed_in_flight(control_plane: ControlPlane, guarded: World) -> None:
    api = guarded.api
    dry = "?dryRun=All"
    api.merge(f"{NODE}{dry}", {"spec": {"unschedulable": True}})
    api.merge(f"{NODE}{dry}", {"metadata": {"labels": {"fractus.dev/geohash": "u1"}}})
    unreachable = [CLASS_TAINT, {"key": "node.kubernetes.io/unreachable", "effect": "NoExecute"}]
    api.merge(f"{NODE}{dry}", {"spec": {"taints": unreachable}})
    api.merge(f"{PODS}/fractus-mobility-drone-1{dry}", {"metadata": {"annotations": {"a": "b"}}})
    template = {"spec": {"template": {"metadata": {"annotations": {"a": "b"}}}}}
    api.merge(f"{DAEMON_SETS}/fractus-agent{dry}", template)
    # A service pod that does not run may be deleted.
    waiting = {"name": "camera", "image": "bad", "imageID": "", "ready": False, "restartCount": 9}
    waiting["state"] = {"waiting": {"reason": "CrashLoopBackOff"}}
    kubelet = control_plane.as_user("kubelet", "system:node:drone-1", ("system:nodes",))
    with kubelet:
        kubelet.merge(f"{PODS}/fractus-camera-drone-1/status", {"status": {"containerStatuses": [waiting]}})
        kubelet.merge(f"{NODE}/status", {"status": {"images": []}})
    try_delete(guarded, f"{PODS}/fractus-camera-drone-1")


def test_services_of_drone_on_ground_can_be_removed(guarded: World) -> None:
    guarded.drone_status("drone-1", "inactive")
    wait_for(
        lambda: not refusal(attempts(guarded, "drone-1")["delete a pod"]), "the admission policies to know the landing"
    )
    for name, attempt in {**attempts(guarded, "drone-1"), **together(guarded)}.items():
        assert not refusal(attempt), name


def test_stale_drone_counts_as_in_flight_until_annotated_as_grounded(guarded: World, tmp_path: Path) -> None:
    (line,) = (typed for typed in shell_lines("docs/upgrades.md") if "fractus.dev/grounded" in typed)
    path = f"{FRACTUS}/drones/drone-1"
    last_seen = "2026-01-01T00:00:00Z"
    status = {"flightState": "unknown", "lastFlightState": "landing", "lastSeen": last_seen}
    guarded.api.merge(f"{path}/status", {"status": status})
    attempt = attempts(guarded, "drone-1")["delete a pod"]
    message = wait_for(
        lambda: "at its last report" in refusal(attempt) and refusal(attempt),
        "the admission policies to know the unknown flight state",
    )
    assert line in message
    guarded.api.merge(path, {"metadata": {"annotations": {"fractus.dev/grounded": "2025-12-31T00:00:00Z"}}})
    assert refusal(attempt), "the annotation of an earlier flight was accepted"
    Shell(tmp_path, guarded.plane).type(line)
    wait_for(lambda: not refusal(attempt), "the annotation to take effect")
    guarded.api.merge(f"{path}/status", {"status": {"lastSeen": "2026-01-01T00:00:05Z"}})
    wait_for(lambda: refusal(attempt), "a new report to invalidate the annotation")


def test_node_class_cannot_be_changed_through_status(guarded: World) -> None:
    change = {"metadata": {"labels": {"fractus.dev/class": None}}}
    message = wait_for(lambda: refusal(lambda: guarded.api.merge(f"{NODE}/status?dryRun=All", change)), "the policy")
    assert "kubectl label node" in message


@pytest.mark.parametrize("drone", ["drone-1", "drone-2"])
def test_service_pod_status_is_written_only_by_its_kubelet(
    control_plane: ControlPlane, guarded: World, drone: str
) -> None:
    """The rule also applies on the ground. Otherwise each status update of a kubelet would look up the Drone."""
    path = f"{PODS}/fractus-mobility-{drone}/status?dryRun=All"
    failed = {"status": {"phase": "Failed"}}
    ended = {"status": {"containerStatuses": []}}
    for change in (failed, ended):
        assert "only the kubelet of the node" in refusal(lambda change=change: guarded.api.merge(path, change))
    hidden = {"metadata": {"labels": {"app.kubernetes.io/component": "x"}}}
    assert "labels of services" in refusal(lambda: guarded.api.merge(path, hidden))
    guarded.api.merge(path, {"status": {"conditions": [{"type": "Ready", "status": "False"}]}})
    with control_plane.as_user(f"kubelet-{drone}", f"system:node:{drone}", ("system:nodes",)) as kubelet:
        kubelet.merge(path, failed)
        kubelet.merge(path, ended)
    # Kubernetes binds the rights of this controller to its user name.
    collector = "system:serviceaccount:kube-system:pod-garbage-collector"
    with control_plane.as_user("collector", collector, ()) as client:
        client.merge(path, failed)
        assert "only the kubelet of the node" in refusal(lambda: client.merge(path, ended))


def test_crds_cannot_be_deleted_while_chart_is_installed(guarded: World) -> None:
    kinds = "/apis/apiextensions.k8s.io/v1/customresourcedefinitions"
    for path in (f"{kinds}/drones.fractus.dev", f"{kinds}/zones.fractus.dev", kinds):
        assert "uninstall that first (helm -n fractus-system uninstall fractus)" in refusal(
            lambda path=path: try_delete(guarded, path)
        )


def test_services_of_drone_with_mission_cannot_be_removed(guarded: World) -> None:
    guarded.drone_status("drone-1", "inactive")
    attempt = attempts(guarded, "drone-1")["delete a pod"]
    wait_for(lambda: not refusal(attempt), "the admission policies to know the landing")
    last_seen = "2026-01-01T00:00:00Z"
    for on_mission in ("True", "Unknown"):
        mission = {"type": "OnMission", "status": on_mission, "reason": "Granted", "lastTransitionTime": last_seen}
        status = {"conditions": [mission], "lastSeen": last_seen}
        guarded.api.merge(f"{FRACTUS}/drones/drone-1/status", {"status": status})
        message = wait_for(lambda: refusal(attempt), "the admission policies to know the mission")
        assert f"drone-1 has a mission and may have taken off since {last_seen}" in message
    annotation = {"metadata": {"annotations": {"fractus.dev/grounded": last_seen}}}
    guarded.api.merge(f"{FRACTUS}/drones/drone-1", annotation)
    wait_for(lambda: not refusal(attempt), "the annotation to take effect")


def test_services_of_drone_without_reports_can_be_replaced(guarded: World) -> None:
    guarded.api.merge(
        f"{FRACTUS}/drones/drone-1/status", {"status": {"flightState": "unknown", "lastFlightState": None}}
    )
    wait_for(
        lambda: not refusal(attempts(guarded, "drone-1")["delete a pod"]), "the admission policies to know the status"
    )


# -- the operator --


def condition(world: World, drone: str, type_: str) -> Body:
    body = world.api.get(f"{FRACTUS}/drones/{drone}") or {}
    return next((c for c in body.get("status", {}).get("conditions", ()) if c["type"] == type_), {})


def has_event(world: World, name: str, reason: str) -> bool:
    """Return whether namespace default has an Event with this reason about an object with this name."""
    events = world.api.list("/api/v1/namespaces/default/events")
    return any((e["involvedObject"].get("name"), e["reason"]) == (name, reason) for e in events)


@pytest.fixture
def permitted(control_plane: ControlPlane, guarded: World, tmp_path: Path) -> Iterator[OperatorProcess]:
    """The operator with only the permissions that the chart gives its account."""
    config = yaml.safe_load(control_plane.kubeconfig.read_text())
    config["users"][0]["user"] = {"token": operator_token(guarded)}
    kubeconfig = tmp_path / "operator.kubeconfig"
    kubeconfig.write_text(yaml.safe_dump(config))
    process = OperatorProcess(kubeconfig, tmp_path / "operator.log")
    process.start()
    yield process
    process.stop()
    print(process.log())
    assert "ERROR" not in process.log()


def release(world: World, number: int, revision: str) -> None:
    """Create a ControllerRevision for a new template, as the DaemonSet controller does."""
    owner = world.api.get(f"{DAEMON_SETS}/fractus-mobility") or {}
    reference = {"apiVersion": "apps/v1", "kind": "DaemonSet", "name": "fractus-mobility", "controller": True}
    metadata = {
        "name": f"fractus-mobility-{revision}",
        "labels": {"controller-revision-hash": revision},
        "ownerReferences": [{**reference, "uid": owner["metadata"]["uid"]}],
    }
    path = f"/apis/apps/v1/namespaces/{SYSTEM}/controllerrevisions/{metadata['name']}"
    body = {"apiVersion": "apps/v1", "kind": "ControllerRevision", "metadata": metadata, "revision": number, "data": {}}
    world.api.apply(path, body)


def test_services_are_replaced_on_ground_one_drone_at_a_time(guarded: World, permitted: OperatorProcess) -> None:
    release(guarded, 1, "old")
    release(guarded, 2, "new")

    def alive() -> set[str]:
        pods = guarded.api.list(PODS)
        return {
            p["metadata"]["name"]
            for p in pods
            if "mobility" in p["metadata"]["name"] and "deletionTimestamp" not in p["metadata"]
        }

    wait_for(lambda: alive() == {"fractus-mobility-drone-1"}, permitted.log)
    wait_for(lambda: condition(guarded, "drone-1", "ServicesCurrent").get("reason") == "InTheAir", permitted.log)
    waits = condition(guarded, "drone-1", "ServicesCurrent")
    assert waits["status"] == "False"
    assert "fractus-mobility-drone-1: drone-1 is in the air" in waits["message"]
    wait_for(lambda: condition(guarded, "drone-2", "ServicesCurrent").get("reason") == "Starting", permitted.log)
    guarded.api.delete(f"{PODS}/fractus-mobility-drone-2", grace_s=0)
    service(guarded, "mobility", "drone-2", revision="new")
    wait_for(lambda: condition(guarded, "drone-2", "ServicesCurrent").get("reason") == "Current", permitted.log)
    assert alive() == {"fractus-mobility-drone-1", "fractus-mobility-drone-2"}
    guarded.drone_status("drone-1", "inactive")
    wait_for(lambda: alive() == {"fractus-mobility-drone-2"}, permitted.log)


def test_stale_drone_has_unknown_state(guarded: World, permitted: OperatorProcess) -> None:
    path = f"{FRACTUS}/drones/drone-1"
    guarded.api.merge(f"{path}/status", {"status": {"lastSeen": "2026-01-01T00:00:00Z", "controller": "system"}})
    wait_for(lambda: condition(guarded, "drone-1", "Ready").get("status") == "Unknown", permitted.log)
    assert condition(guarded, "drone-1", "Ready")["reason"] == "AgentSilent"
    assert (
        "its agent last reported at 2026-01-01 00:00:00 UTC, when the drone was flying"
        in condition(guarded, "drone-1", "Ready")["message"]
    )
    status = (guarded.api.get(path) or {})["status"]
    assert (status["flightState"], status["lastFlightState"]) == ("unknown", "flying")
    assert "controller" not in status
    wait_for(lambda: has_event(guarded, "drone-1", "AgentSilent"), permitted.log)
    assert "drone-1" in refusal(attempts(guarded, "drone-1")["delete a pod"])


def test_operator_cannot_report_landing(control_plane: ControlPlane, guarded: World) -> None:
    with control_plane.with_token(operator_token(guarded)) as client:
        path = f"{FRACTUS}/drones/drone-1"
        for lie in ({"flightState": "inactive"}, {"flightState": "unknown", "lastFlightState": "inactive"}):
            body = guarded.api.get(path) or {}
            body["status"] |= lie
            assert "may not change the flight state" in refusal(
                lambda body=body: client.call("PUT", f"{path}/status", body)
            )
        # The operator may set a stale drone to unknown. After that, it must not report a landing.
        client.merge(f"{path}/status", {"status": {"flightState": "unknown", "lastFlightState": "flying"}})
        for last in ("unknown", "inactive", None):
            assert "may not change the flight state" in refusal(
                lambda last=last: client.merge(f"{path}/status", {"status": {"lastFlightState": last}})
            )
        assert "fractus-flight-pods" in refusal(lambda: client.delete(f"{PODS}/fractus-mobility-drone-1"))


def test_operator_cannot_reset_time_of_last_report(control_plane: ControlPlane, guarded: World) -> None:
    """Otherwise the grounded annotation, which names the last report before this flight, would become valid again."""
    path = f"{FRACTUS}/drones/drone-1"
    last_seen = "2026-01-01T00:00:00Z"
    guarded.api.merge(path, {"metadata": {"annotations": {"fractus.dev/grounded": last_seen}}})
    guarded.api.merge(f"{path}/status", {"status": {"lastSeen": "2026-01-02T00:00:00Z"}})
    with control_plane.with_token(operator_token(guarded)) as client:
        for time in (last_seen, None):
            assert "report time of a drone" in refusal(
                lambda time=time: client.merge(f"{path}/status", {"status": {"lastSeen": time}})
            )
        assert "drone-1 is in the air" in refusal(lambda: client.delete(f"{PODS}/fractus-mobility-drone-1"))


def test_on_mission_condition_follows_mission(guarded: World, permitted: OperatorProcess, namespace: str) -> None:
    path = f"{FRACTUS}/drones/drone-2"
    guarded.api.merge(f"{path}/status", {"status": {"lastSeen": "2026-01-01T00:00:00Z"}})
    guarded.put(traffic(namespace))
    wait_for(lambda: condition(guarded, "drone-2", "OnMission").get("status") == "True", permitted.log)
    guarded.api.delete(f"{FRACTUS}/namespaces/{namespace}/applications/traffic")
    wait_for(lambda: condition(guarded, "drone-2", "OnMission").get("status") == "Unknown", permitted.log)
    minutes = itertools.count(1)

    def reported() -> bool:
        guarded.api.merge(f"{path}/status", {"status": {"lastSeen": f"2026-01-01T00:{next(minutes) % 60:02}:00Z"}})
        return condition(guarded, "drone-2", "OnMission").get("status") == "False"

    wait_for(reported, permitted.log)


def test_grounded_annotation_allows_replacement_and_is_recorded(guarded: World, permitted: OperatorProcess) -> None:
    last_seen = "2026-01-01T00:00:00Z"
    path = f"{FRACTUS}/drones/drone-1"
    release(guarded, 1, "old")
    release(guarded, 2, "new")
    guarded.api.merge(f"{path}/status", {"status": {"lastSeen": last_seen}})
    wait_for(lambda: condition(guarded, "drone-1", "ServicesCurrent").get("reason") == "InTheAir", permitted.log)
    guarded.api.merge(path, {"metadata": {"annotations": {"fractus.dev/grounded": last_seen}}})
    wait_for(lambda: condition(guarded, "drone-1", "ServicesCurrent").get("reason") != "InTheAir", permitted.log)
    wait_for(lambda: has_event(guarded, "drone-1", "GroundedByHand"), permitted.log)

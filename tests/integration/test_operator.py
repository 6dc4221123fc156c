"""The operator against a real API server: child objects, restarts, missions and deletion of an Application."""

from __future__ import annotations

import base64
import signal
from datetime import datetime
from typing import Any

import pytest
from control_plane import wait_for
from cryptography import x509
from fractus_core.api import Grant
from fractus_core.policy.grant_signatures import SIGNATURE_ANNOTATION, BadSignature, read_authorities, verify
from operator_world import FRACTUS, OperatorProcess, World, at, component, fractus_object, navigator, traffic, viewer

INSTANCES = {
    "traffic-navigator": "drone-1",
    "traffic-aerial-viewer": "drone-1",
    "traffic-ground-viewer-edge-2": "edge-2",
    "traffic-ground-viewer-edge-3": "edge-3",
    "traffic-image-checker-edge-1": "edge-1",
    "traffic-image-checker": None,
    "traffic-data-store": None,
}


def deployed(world: World, namespace: str, name: str = "traffic", pods: int = 7) -> dict[str, Any]:
    """Bind and start the pods like scheduler and kubelet. Return the status when the Application is Ready."""

    def created() -> bool:
        world.end_pods(namespace)
        return len(world.pods(namespace)) >= pods

    wait_for(created, lambda: f"{pods} pods; {world.status(namespace, name)}")
    world.run_pods(namespace)
    wait_for(lambda: world.condition(namespace, "Ready", name).get("status") == "True", "the condition Ready")
    return world.status(namespace, name)


def running(world: World, namespace: str) -> dict[str, Any]:
    world.put(traffic(namespace))
    return deployed(world, namespace)


def versions(world: World, namespace: str) -> dict[str, str]:
    """Return the resource version (of Deployments: the generation) of each object that the operator writes, by name."""
    versions_by_name = {name: body["metadata"]["resourceVersion"] for name, body in world.children(namespace).items()}
    versions_by_name = {
        name: version for name, version in versions_by_name.items() if not name.startswith("deployments/")
    }
    for name, body in world.children(namespace).items():
        if name.startswith("deployments/"):
            versions_by_name[name] = str(body["metadata"]["generation"])
    application = world.application(namespace)
    assert application is not None
    return versions_by_name | {"application": application["metadata"]["resourceVersion"]}


def end_mission(world: World, namespace: str, phase: str, message: str) -> None:
    """Write the end of the mission to the status of the driver's Grant, like the agent."""
    name = f"{namespace}.traffic-navigator"
    world.api.merge(f"{FRACTUS}/grants/{name}/status", {"status": {"phase": phase, "message": message}})


def gone(world: World, namespace: str) -> bool:
    children = world.children(namespace)
    return world.application(namespace) is None and not children


def test_application_gets_plan_grants_and_pods(world: World, operator: OperatorProcess, namespace: str) -> None:
    status = running(world, namespace)
    application = world.application(namespace)
    assert application is not None
    assert (status["drone"], status["pods"], status["observedGeneration"]) == ("drone-1", "7/7", 1)
    assert {c["type"]: c["status"] for c in status["conditions"]} == {
        "Planned": "True", "Granted": "True", "Deployed": "True", "Ready": "True", "MissionComplete": "False",
    }  # fmt: skip
    children = world.children(namespace)
    deployments = {n.split("/")[1]: b for n, b in children.items() if n.startswith("deployments/")}
    assert set(deployments) == set(INSTANCES)
    for name, node in INSTANCES.items():
        terms = deployments[name]["spec"]["template"]["spec"]["affinity"]["nodeAffinity"]
        term = terms["requiredDuringSchedulingIgnoredDuringExecution"]["nodeSelectorTerms"][0]
        if node is None:
            assert term["matchExpressions"][0]["values"] == ["cloud"]
        else:
            assert term["matchFields"] == [{"key": "metadata.name", "operator": "In", "values": [node]}]
    grants = {n: b for n, b in children.items() if n.startswith("grants/")}
    assert {b["spec"]["instance"] for b in grants.values()} == {
        "traffic-navigator", "traffic-aerial-viewer", "traffic-ground-viewer-edge-2", "traffic-ground-viewer-edge-3",
    }  # fmt: skip
    for name, body in children.items():
        if "namespace" in body["metadata"]:
            assert [o["uid"] for o in body["metadata"]["ownerReferences"]] == [application["metadata"]["uid"]], name
    slices = [b for n, b in children.items() if n.startswith("endpointslices/")]
    base = next(
        p for p in world.pods(namespace) if p["metadata"]["labels"]["fractus.dev/instance"] == "traffic-image-checker"
    )
    assert [s["endpoints"][0]["addresses"] for s in slices if s["metadata"]["name"] == "traffic-image-checker"] == [
        [base["status"]["podIP"]]
    ]
    assert "selector" not in children["services/traffic-image-checker"]["spec"]
    wait_for(lambda: events(world, namespace) == ["Planned", "PodsReady"], "one Event for all stages of the rollout")
    found = world.api.list(f"/api/v1/namespaces/{namespace}/events")
    (planned,) = (e["message"] for e in found if e["reason"] == "Planned")
    for stage in ("Planned", "Granted", "Deployed"):
        assert world.condition(namespace, stage)["message"] in planned, "the Event lacks the message of a condition"


def events(world: World, namespace: str) -> list[str]:
    """Return the reasons of the Events on Applications of the namespace."""
    found = world.api.list(f"/api/v1/namespaces/{namespace}/events")
    return sorted(e["reason"] for e in found if e["involvedObject"]["kind"] == "Application")


def test_certificate_names_only_its_instance(world: World, operator: OperatorProcess, namespace: str) -> None:
    world.put(traffic(namespace))
    world.phase(namespace, "Deploying")
    secret = world.children(namespace)["secrets/traffic-navigator-tls"]
    certificate = x509.load_pem_x509_certificate(base64.b64decode(secret["data"]["tls.crt"]))
    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    identity = f"spiffe://fractus.dev/ns/{namespace}/app/traffic/component/Navigator/instance/traffic-navigator"
    assert [name.value for name in names] == [identity]
    authority = world.api.get("/api/v1/namespaces/fractus-system/configmaps/fractus-ca")
    assert authority is not None
    assert base64.b64decode(secret["data"]["ca.crt"]).decode() == authority["data"]["ca.crt"]
    certificate.verify_directly_issued_by(x509.load_pem_x509_certificate(authority["data"]["ca.crt"].encode()))


def test_unchanged_application_causes_no_writes(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    before = versions(world, namespace)
    # These changes wake the reconciler. The new location label of edge-1 shows that it has processed them.
    world.api.merge(f"{FRACTUS}/depots/base", {"spec": {"radius": 31}})
    world.api.merge(f"{FRACTUS}/edgenodes/edge-1", {"spec": {"location": at(21, 30)}})
    world.api.merge("/api/v1/nodes/cloud-1", {"metadata": {"labels": {"some": "label"}}})
    wait_for(lambda: _geohash(world, "edge-1"), "the location label of edge-1")
    after = versions(world, namespace)
    stored = world.api.get(world.path(traffic(namespace)))
    assert stored is not None
    assert not [name for name in stored["metadata"].get("annotations", {}) if "kopf" in name], (
        "kopf stored annotations, which costs additional requests"
    )
    # The depot's radius is part of the drone's corridor, so only the Grants change.
    changed = {name for name in before if before[name] != after[name]}
    assert changed <= {f"grants/{namespace}.traffic-navigator", f"grants/{namespace}.traffic-aerial-viewer"}


def _geohash(world: World, node: str) -> str | None:
    labels = (world.api.get(f"/api/v1/nodes/{node}") or {})["metadata"]["labels"]
    return labels.get("fractus.dev/geohash")


@pytest.mark.parametrize("number", [signal.SIGKILL, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_restarted_operator_changes_nothing(
    world: World, operator: OperatorProcess, namespace: str, number: int
) -> None:
    running(world, namespace)
    before = versions(world, namespace)
    operator.stop(number)
    operator.start()
    # When the restarted operator has set the condition of a new zone, it has also received the Application.
    world.put(fractus_object("Zone", "beacon", {"area": {"circle": {"center": at(0, 0), "radius": 10}}}))
    wait_for(lambda: _ready(world, "zones", "beacon") == "True", "the restarted operator")
    world.put(fractus_object("Application", "second", traffic(namespace)["spec"], namespace))
    world.phase(namespace, "Queued", "second")
    assert versions(world, namespace) == before


def test_killed_operator_completes_rollout_after_restart(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    world.put(traffic(namespace))
    wait_for(lambda: world.grants(namespace), "the first grant")
    operator.stop(signal.SIGKILL)
    # The plan records that the drone belongs to this Application. The next operator reads it.
    assert "deploymentplans/traffic" in world.children(namespace)
    operator.start()
    deployed(world, namespace)
    deployments = [n for n in world.children(namespace) if n.startswith("deployments/")]
    assert len(deployments) == len(INSTANCES)


def _ready(world: World, plural: str, name: str) -> str | None:
    conditions = ((world.api.get(f"{FRACTUS}/{plural}/{name}") or {}).get("status") or {}).get("conditions") or ()
    return next((c["status"] for c in conditions if c["type"] == "Ready"), None)


def test_deleted_or_modified_child_is_restored(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    path = f"/apis/apps/v1/namespaces/{namespace}/deployments/traffic-data-store"
    uid = (world.api.get(path) or {})["metadata"]["uid"]
    world.api.delete(path)
    wait_for(lambda: (world.api.get(path) or {}).get("metadata", {}).get("uid", uid) != uid, "the Deployment's return")
    world.api.merge(path, {"spec": {"replicas": 3}})
    wait_for(
        lambda: (world.api.get(path) or {})["spec"]["replicas"] == 1, "the operator to reset the number of replicas"
    )


def test_complete_mission_keeps_only_its_plan(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    world.drone_status("drone-1", "flying")
    world.phase(namespace, "Flying")
    wait_for(lambda: len(flight_events(world)) >= 2, "the Events of the takeoff")
    end_mission(world, namespace, "Complete", "all control points were returned")
    status = world.phase(namespace, "Returning")
    assert status["message"] == "all control points were returned; drone-1 is returning"
    wait_for(lambda: not granted(world, namespace), "all Grants and DirectLinks to be deleted")
    assert len([name for name in world.children(namespace) if name.startswith("deployments/")]) == 7
    world.drone_status("drone-1", "inactive")
    status = world.phase(namespace, "Completed")
    assert world.condition(namespace, "MissionComplete")["status"] == "True"
    assert status["message"] == "all control points were returned"
    wait_for(
        lambda: set(world.children(namespace)) == {"deploymentplans/traffic"},
        "all child objects except the plan to be deleted",
    )
    wait_for(lambda: len(flight_events(world)) >= 4, "the Events of the flight")
    assert flight_events(world) == [
        "TookOff: drone-1 took off",
        f"MissionBegun: {namespace}/traffic flies drone-1",
        f"MissionOver: {namespace}/traffic no longer flies drone-1: all control points were returned",
        "Landed: drone-1 landed",
    ], "Events of planning and deploying, or repeated Events, would cost requests in vain"


def granted(world: World, namespace: str) -> set[str]:
    """Return the names of the child objects that permit a flight, a call or a direct link."""
    return {name for name in world.children(namespace) if name.startswith(("grants/", "directlinks/"))}


def test_components_end_as_declared_after_the_mission(world: World, operator: OperatorProcess, namespace: str) -> None:
    manifest = traffic(namespace)
    del manifest["spec"]["components"][4]["endsWith"]
    manifest["spec"]["afterFlight"] = 3600
    world.put(manifest)
    deployed(world, namespace)
    store = {pod["metadata"]["uid"] for pod in world.pods(namespace) if component_of(pod) == "DataStore"}
    world.drone_status("drone-1", "flying")
    end_mission(world, namespace, "Failed", "driver lost")
    world.drone_status("drone-1", "inactive")
    world.phase(namespace, "Failed")
    wait_for(lambda: not granted(world, namespace), "all Grants and DirectLinks to be deleted")
    operator.stop(signal.SIGKILL)
    operator.start()
    # A changed mission does not begin before the components of the last flight have stopped.
    manifest["spec"]["components"][0]["container"]["env"] = [{"name": "COLOUR", "value": "red"}]
    world.put(manifest)
    wait_for(lambda: world.condition(namespace, "Updated"), "the change to wait")
    assert world.condition(namespace, "Updated")["reason"] == "WaitsForComponents"
    assert world.status(namespace)["phase"] == "Landed"
    assert len(world.pods(namespace)) == 7
    assert not any("fractus.dev/finished" in labels_of(pod) for pod in world.pods(namespace))
    del manifest["spec"]["components"][0]["container"]["env"]
    manifest["spec"]["afterFlight"] = 1
    world.put(manifest)
    wait_for(
        lambda: (
            {p["metadata"]["uid"] for p in world.pods(namespace) if "fractus.dev/finished" not in labels_of(p)} == store
        ),
        "the pods of all components except DataStore to stop",
    )
    remaining = {f"{kind}/traffic-data-store" for kind in ("services", "deployments")}
    remaining |= {"deploymentplans/traffic", "secrets/traffic-data-store-tls"}
    wait_for(
        lambda: {n for n in world.children(namespace) if not n.startswith("networkpolicies/")} == remaining,
        "the child objects of the other components to be deleted",
    )
    assert "networkpolicies/traffic-data-store" in world.children(namespace)
    # The component that ends with the Application continues to run in the next mission.
    before = {pod["metadata"]["uid"] for pod in world.pods(namespace)}
    manifest["spec"]["components"][0]["container"]["env"] = [{"name": "COLOUR", "value": "red"}]
    world.put(manifest)
    wait_for(lambda: len(fresh(world, namespace, before)) == 6, "the pods of the next mission")
    deployed(world, namespace)
    assert store <= {pod["metadata"]["uid"] for pod in world.pods(namespace)}
    world.api.delete(f"{FRACTUS}/namespaces/{namespace}/applications/traffic")
    wait_for(lambda: not world.pods(namespace), "all pods to be deleted")


def test_application_is_deleted_while_its_components_transfer_data(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    manifest = traffic(namespace)
    manifest["spec"]["afterFlight"] = 3600
    world.put(manifest)
    deployed(world, namespace)
    end_mission(world, namespace, "Complete", "done")
    world.phase(namespace, "Completed")
    assert len(world.pods(namespace)) == 7
    world.api.delete(f"{FRACTUS}/namespaces/{namespace}/applications/traffic")
    wait_for(lambda: not world.pods(namespace), "all pods to be deleted")
    wait_for(lambda: not world.children(namespace), "all child objects to be deleted")


def component_of(pod: dict[str, Any]) -> str:
    return labels_of(pod)["fractus.dev/component"]


def flight_events(world: World) -> list[str]:
    """Return the Events of the Drone object drone-1 that exists now, in the order of their creation."""
    drone = world.api.get("/apis/fractus.dev/v1alpha1/drones/drone-1") or {}
    all_events = world.api.list("/api/v1/namespaces/default/events")
    drone_events = [e for e in all_events if e["involvedObject"].get("uid") == drone["metadata"]["uid"]]
    drone_events.sort(key=lambda event: int(event["metadata"]["resourceVersion"]))
    return [f"{event['reason']}: {event['message']}" for event in drone_events]


def test_finished_pods_stay_stopped_for_their_logs(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    before = {pod["metadata"]["uid"] for pod in world.pods(namespace)}
    end_mission(world, namespace, "Complete", "done")
    world.phase(namespace, "Completed")
    uid = (world.application(namespace) or {})["metadata"]["uid"]
    workloads = [f"/apis/apps/v1/namespaces/{namespace}/{kind}" for kind in ("deployments", "replicasets")]
    wait_for(
        lambda: not any(world.api.list(path) for path in workloads), "the Deployments and ReplicaSets to be deleted"
    )
    wait_for(
        lambda: all("fractus.dev/finished" in labels_of(pod) for pod in world.pods(namespace)),
        "the label fractus.dev/finished on all pods",
    )
    stopped = world.pods(namespace)
    assert {pod["metadata"]["uid"] for pod in stopped} == before
    for pod in stopped:
        assert pod["spec"]["activeDeadlineSeconds"] == 1
        assert [(o["kind"], o["uid"]) for o in pod["metadata"]["ownerReferences"]] == [("Application", uid)]
    # A finish time in the future is invalid. The operator deletes the pod.
    first = stopped[0]["metadata"]
    path = f"/api/v1/namespaces/{namespace}/pods/{first['name']}"
    world.api.merge(path, {"metadata": {"labels": {"fractus.dev/finished": "29990101T000000Z"}}})
    wait_for(
        lambda: first["uid"] not in {p["metadata"]["uid"] for p in world.pods(namespace)}, "that pod to be deleted"
    )
    # The next mission has new pods and ignores labels of finished pods.
    manifest = traffic(namespace)
    manifest["spec"]["ttlAfterFinished"] = 0
    manifest["spec"]["components"][0]["container"]["env"] = [{"name": "COLOUR", "value": "red"}]
    world.put(manifest)
    wait_for(lambda: len(fresh(world, namespace, before)) == 7, "the pods of the next mission")
    wait_for(
        lambda: not before & {pod["metadata"]["uid"] for pod in world.pods(namespace)},
        "the pods of the previous mission to be deleted",
    )
    deployed(world, namespace)
    end_mission(world, namespace, "Complete", "done")
    world.phase(namespace, "Completed")
    wait_for(lambda: not world.pods(namespace), "all pods to be deleted")


def test_changed_ttl_of_finished_pods_starts_no_mission(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    manifest = traffic(namespace, "traffic", navigator())
    world.put(manifest)
    deployed(world, namespace, pods=1)
    world.drone_status("drone-1", "flying")
    world.phase(namespace, "Flying")
    before = versions(world, namespace)

    def keep_for(seconds: int) -> None:
        manifest["spec"]["ttlAfterFinished"] = seconds
        world.put(manifest)
        wait_for(lambda: world.status(namespace)["observedGeneration"] == generation(), "the change to be processed")

    def generation() -> int:
        return int((world.application(namespace) or {})["metadata"]["generation"])

    keep_for(3600)
    assert not world.condition(namespace, "Updated"), "the change of the time to live waits for the landing"
    after = versions(world, namespace)
    assert {name for name in before if before[name] != after[name]} <= {"application", "deploymentplans/traffic"}, (
        "the change restarts pods in flight"
    )
    end_mission(world, namespace, "Complete", "done")
    world.phase(namespace, "Returning")
    keep_for(1800)
    world.drone_status("drone-1", "inactive")
    world.phase(namespace, "Completed")
    keep_for(3)
    wait_for(lambda: not world.pods(namespace), "the pods to be deleted")
    operator.stop(signal.SIGKILL)
    # Plans of an earlier release do not contain the digest of their mission.
    plan = f"{FRACTUS}/namespaces/{namespace}/deploymentplans/traffic"
    world.api.merge(plan, {"spec": {"applicationDigest": None}})
    operator.start()
    wait_for(
        lambda: "applicationDigest" in world.children(namespace)["deploymentplans/traffic"]["spec"],
        "the digest in the plan",
    )
    keep_for(600)
    assert world.status(namespace)["phase"] == "Completed"
    assert set(world.children(namespace)) == {"deploymentplans/traffic"}
    manifest["spec"]["components"][0]["container"]["env"] = [{"name": "COLOUR", "value": "red"}]
    world.put(manifest)
    deployed(world, namespace, pods=1)


def test_finished_pods_are_removed_in_time(world: World, operator: OperatorProcess, namespace: str) -> None:
    manifest = traffic(namespace, "traffic", navigator())
    manifest["spec"]["ttlAfterFinished"] = 5
    world.put(manifest)
    deployed(world, namespace, pods=1)
    end_mission(world, namespace, "Failed", "driver lost")
    wait_for(
        lambda: any("fractus.dev/finished" in labels_of(pod) for pod in world.pods(namespace)),
        "the label fractus.dev/finished",
    )
    operator.stop(signal.SIGKILL)
    operator.start()
    wait_for(lambda: not world.pods(namespace), "the pod to be deleted")
    assert world.status(namespace)["phase"] == "Failed"


def labels_of(pod: dict[str, Any]) -> dict[str, str]:
    return dict(pod["metadata"]["labels"])


def fresh(world: World, namespace: str, before: set[str]) -> set[str]:
    """End the stopped pods, and return the uids of the pods that were created since."""
    world.end_pods(namespace)
    return {pod["metadata"]["uid"] for pod in world.pods(namespace)} - before


def test_phase_follows_drone(world: World, operator: OperatorProcess, namespace: str) -> None:
    status = running(world, namespace)
    assert "flies" not in status["message"]
    assert "drone-1 is on the ground and its mission has not begun" in status["message"]
    assert world.condition(namespace, "MissionComplete")["reason"] == "MissionWaiting"
    path = f"{FRACTUS}/drones/drone-1/status"
    world.api.merge(path, {"status": {"flightState": "takingOff", "controller": "Navigator"}})
    assert world.phase(namespace, "TakingOff")["controller"] == "Navigator"
    world.drone_status("drone-1", "flying")
    assert world.condition(namespace, "MissionComplete")["reason"] == "MissionBegun"
    world.phase(namespace, "Flying")
    world.api.merge(path, {"status": {"controller": "system"}})
    wait_for(
        lambda: world.status(namespace).get("controller") == "system", "the system as the controller in the status"
    )
    world.api.merge(path, {"status": {"flightState": "unknown", "lastFlightState": "flying", "controller": None}})
    lost = world.phase(namespace, "Unknown")
    assert "controller" not in lost
    ready = world.condition(namespace, "Ready")
    assert (ready["status"], ready["reason"]) == ("Unknown", "TelemetryLost")
    assert "(at its last report: flying)" in ready["message"]
    world.drone_status("drone-1", "inactive")
    assert "has landed" in world.phase(namespace, "Landed")["message"]
    assert {"MissionBegun", "TelemetryLost"} <= set(events(world, namespace))


# A unit test contains every outcome (test_status_reports_every_mission_outcome).
@pytest.mark.parametrize(
    ("phase", "reason"),
    [("Failed", "MissionFailed"), pytest.param("Revoked", "MissionRevoked", marks=pytest.mark.slow)],
)
def test_failed_mission_is_reported(
    world: World, operator: OperatorProcess, namespace: str, phase: str, reason: str
) -> None:
    running(world, namespace)
    end_mission(world, namespace, phase, "driver lost")
    status = world.phase(namespace, "Failed")
    condition = world.condition(namespace, "MissionComplete")
    assert (condition["status"], condition["reason"], status["message"]) == ("False", reason, "driver lost")
    wait_for(lambda: not world.grants(namespace), "the Grants to be deleted")


def test_failed_component_is_reported_with_last_log_lines(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    running(world, namespace)
    pod = next(pod for pod in world.pods(namespace) if labels_of(pod)["fractus.dev/component"] == "Navigator")
    (container,) = pod["spec"]["containers"]
    assert container["terminationMessagePolicy"] == "FallbackToLogsOnError", (
        "the kubelet does not report the last output"
    )
    ended = {"exitCode": 1, "reason": "Error", "message": "flies\nno route to the river\n"}
    told = {
        "name": container["name"], "image": container["image"], "imageID": "", "ready": False, "restartCount": 1,
        "state": {"waiting": {"reason": "CrashLoopBackOff"}}, "lastState": {"terminated": ended},
    }  # fmt: skip
    status = {"conditions": [{"type": "Ready", "status": "False"}], "containerStatuses": [told]}
    world.api.merge(f"/api/v1/namespaces/{namespace}/pods/{pod['metadata']['name']}/status", {"status": status})
    wait_for(lambda: world.condition(namespace, "Ready")["reason"] == "ComponentFailed", "the failure in the status")
    last_words = "traffic-navigator failed with exit code 1: no route to the river (before: flies)"
    assert last_words in world.condition(namespace, "Ready")["message"]
    path = f"/api/v1/namespaces/{namespace}/events"
    wait_for(lambda: any(last_words in event["message"] for event in world.api.list(path)), "the Event")


def test_refused_pods_are_reported(world: World, operator: OperatorProcess, namespace: str) -> None:
    """A quota, a LimitRange or Pod Security may refuse pods. No pod then exists whose status contains the reason."""
    path = f"/api/v1/namespaces/{namespace}/limitranges/small"
    limits = {"limits": [{"type": "Container", "max": {"cpu": "50m"}}]}
    head = {"apiVersion": "v1", "kind": "LimitRange", "metadata": {"name": "small", "namespace": namespace}}
    world.api.apply(path, head | {"spec": limits})
    world.put(traffic(namespace))
    wait_for(lambda: world.condition(namespace, "Ready").get("reason") == "PodsRefused", "the refusal in the status")
    message = world.condition(namespace, "Ready")["message"]
    assert "pods of traffic-" in message
    assert "50m" in message
    assert "50m" in world.status(namespace)["message"]
    world.api.delete(path)
    wait_for(lambda: world.condition(namespace, "Ready")["reason"] == "PodsNotReady", "all pods to be created")
    deployed(world, namespace)


# `make test` shows this with test_finished_pods_stay_stopped_for_their_logs.
@pytest.mark.slow
def test_changed_spec_flies_again_after_completion(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    end_mission(world, namespace, "Complete", "done")
    world.phase(namespace, "Completed")
    manifest = traffic(namespace)
    manifest["spec"]["components"][4]["replicas"] = 2
    world.put(manifest)
    deployed(world, namespace, pods=8)
    assert world.status(namespace)["observedGeneration"] == 2


def test_drone_is_held_by_one_application_until_it_has_returned(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    world.put(traffic(namespace))
    world.put(traffic(namespace, "second"))
    names = {"traffic", "second"}
    wait_for(
        lambda: {world.status(namespace, n).get("phase") for n in names} == {"Deploying", "Queued"},
        "one of the two Applications to be Queued",
    )
    first = next(n for n in names if world.status(namespace, n)["phase"] == "Deploying")
    second = (names - {first}).pop()
    assert f"{namespace}/{first}" in world.status(namespace, second)["message"]
    assert not world.grants(namespace, second)
    world.drone_status("drone-1", "flying")
    world.phase(namespace, "Flying", first)
    name = f"{namespace}.{first}-navigator"
    world.api.merge(f"{FRACTUS}/grants/{name}/status", {"status": {"phase": "Complete"}})
    world.phase(namespace, "Returning", first)
    wait_for(lambda: not world.grants(namespace, first), "the Grants of the first Application to be deleted")
    assert world.status(namespace, second)["phase"] == "Queued"
    world.drone_status("drone-1", "inactive")
    world.phase(namespace, "Deploying", second)


def test_application_waits_for_a_drone(world: World, operator: OperatorProcess, namespace: str) -> None:
    world.api.delete(f"{FRACTUS}/drones/drone-1")
    wait_for(lambda: not world.is_labelled("drone-1"), "the operator to receive the deletion")
    world.put(traffic(namespace))
    world.phase(namespace, "Pending")
    assert world.condition(namespace, "Ready")["reason"] == "NoDrone"
    assert world.children(namespace) == {}
    world.add_drone("drone-9")
    assert world.phase(namespace, "Deploying")["drone"] == "drone-9"


def test_plan_avoids_unschedulable_node(world: World, operator: OperatorProcess, namespace: str) -> None:
    world.put(traffic(namespace))
    deployed(world, namespace)
    victim = next(
        p for p in world.pods(namespace) if p["metadata"]["labels"]["fractus.dev/instance"].endswith("viewer-edge-2")
    )
    path = f"/api/v1/namespaces/{namespace}/pods/{victim['metadata']['name']}"
    refused = {"type": "PodScheduled", "status": "False", "reason": "Unschedulable", "message": "Insufficient cpu",
               "lastTransitionTime": "2026-01-01T00:00:00Z"}  # fmt: skip
    world.api.merge(f"{path}/status", {"status": {"conditions": [refused]}})
    wait_for(lambda: "deployments/traffic-ground-viewer-edge-1" in world.children(namespace), "the remaining node")
    children = world.children(namespace)
    assert "deployments/traffic-ground-viewer-edge-2" not in children
    assert "secrets/traffic-ground-viewer-edge-2-tls" not in children
    assert f"grants/{namespace}.traffic-ground-viewer-edge-2" not in children
    assert "deployments/traffic-ground-viewer-edge-3" in children


def test_unreachable_node_keeps_its_instances(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    before = versions(world, namespace)
    for name in ("drone-1", "edge-2"):
        lost = {
            "type": "Ready",
            "status": "Unknown",
            "reason": "NodeStatusUnknown",
            "lastTransitionTime": "2026-01-01T00:00:00Z",
        }
        world.api.merge(f"/api/v1/nodes/{name}/status", {"status": {"conditions": [lost]}})
    world.put(traffic(namespace, "second"))
    world.phase(namespace, "Queued", "second")
    assert versions(world, namespace) == before


def test_upgraded_operator_restarts_no_pod_in_flight(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    world.drone_status("drone-1", "flying")
    operator.stop()
    # Simulate Deployments of an older operator, which differ from those of this operator.
    root = f"/apis/apps/v1/namespaces/{namespace}/deployments"
    for name in ("traffic-navigator", "traffic-data-store"):
        world.api.merge(f"{root}/{name}", {"spec": {"template": {"spec": {"terminationGracePeriodSeconds": 11}}}})
    operator.start()

    def grace_s(name: str) -> int:
        return int((world.api.get(f"{root}/{name}") or {})["spec"]["template"]["spec"]["terminationGracePeriodSeconds"])

    wait_for(lambda: grace_s("traffic-data-store") == 10, "the new template of the cloud component")
    assert grace_s("traffic-navigator") == 11
    world.drone_status("drone-1", "inactive")
    wait_for(lambda: grace_s("traffic-navigator") == 10, "the new template of the drone component after the landing")


def test_longest_valid_name_is_deployed_and_reported(world: World, operator: OperatorProcess, namespace: str) -> None:
    name = "a" + ".b" * 126
    assert len(name) == 253
    world.put(traffic(namespace, name))
    deployed(world, namespace, name)
    wait_for(lambda: "PodsReady" in events(world, namespace), "the Events")
    world.api.delete(world.path(traffic(namespace, name)))
    wait_for(
        lambda: world.application(namespace, name) is None and not world.children(namespace),
        "the Application and its child objects to be deleted",
    )


def test_deleted_application_leaves_no_objects(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    world.api.delete(world.path(traffic(namespace)))
    wait_for(lambda: gone(world, namespace), "the Application and its child objects to be deleted")
    assert not world.grants(namespace)


@pytest.mark.parametrize(
    "noted",
    # The unit tests contain more annotations (test_operator_handlers.py).
    [
        '{"success":true}',
        pytest.param('{"delayed":"9999-12-31T00:00:00+00:00"}', marks=pytest.mark.slow),
        pytest.param("no JSON", marks=pytest.mark.slow),
    ],
)
def test_editor_of_application_cannot_keep_its_drone(
    world: World, operator: OperatorProcess, namespace: str, noted: str
) -> None:
    """An editor sets annotations in which kopf stores the progress of a teardown. Another user deletes the object."""
    running(world, namespace)
    path = world.path(traffic(namespace))
    world.api.merge(path, {"metadata": {"annotations": {"kopf.fractus.dev/teardown": noted}}})
    world.api.delete(path)
    wait_for(lambda: gone(world, namespace), "the Application and its child objects to be deleted")
    assert not world.grants(namespace)


def test_deletion_while_operator_is_down_leaves_no_objects(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    running(world, namespace)
    operator.stop(signal.SIGKILL)
    world.api.delete(world.path(traffic(namespace)))
    assert world.application(namespace) is not None, (
        "the Application was deleted without the operator, in spite of its finalizer"
    )
    operator.start()
    wait_for(lambda: gone(world, namespace), "the Application and its child objects to be deleted")


def test_grant_is_deleted_if_finalizer_was_removed_by_hand(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    running(world, namespace)
    operator.stop(signal.SIGKILL)
    world.api.delete(world.path(traffic(namespace)))
    world.api.merge(world.path(traffic(namespace)), {"metadata": {"finalizers": None}})
    assert granted(world, namespace)
    operator.start()
    wait_for(lambda: not granted(world, namespace), "the orphaned Grants and DirectLinks to be deleted")


def test_recreated_application_gets_new_plan(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    old = (world.application(namespace) or {})["metadata"]["uid"]
    world.api.delete(world.path(traffic(namespace)))
    wait_for(lambda: world.application(namespace) is None, "the Application to be deleted")
    world.put(traffic(namespace, "traffic", navigator()))
    world.phase(namespace, "Deploying")
    wait_for(
        lambda: (
            [n for n in world.children(namespace) if n.startswith("deployments/")] == ["deployments/traffic-navigator"]
        ),
        "one instance",
    )
    new = (world.application(namespace) or {})["metadata"]["uid"]
    assert new != old
    wait_for(
        lambda: {g["spec"]["application"]["uid"] for g in world.grants(namespace)} == {new}, "the Grants of the new one"
    )


def test_object_of_another_owner_is_not_taken_over(world: World, operator: OperatorProcess, namespace: str) -> None:
    foreign = {"apiVersion": "v1", "kind": "Service", "metadata": {"name": "traffic-data-store", "namespace": namespace},
              "spec": {"ports": [{"port": 1}]}}  # fmt: skip
    world.api.apply(f"/api/v1/namespaces/{namespace}/services/traffic-data-store", foreign)
    world.put(traffic(namespace))
    wait_for(lambda: world.condition(namespace, "Ready").get("reason") == "NameTaken", "the conflict")
    service = world.api.get(f"/api/v1/namespaces/{namespace}/services/traffic-data-store")
    assert service is not None
    assert service["spec"]["ports"][0]["port"] == 1
    world.api.delete(f"/api/v1/namespaces/{namespace}/services/traffic-data-store")
    world.phase(namespace, "Deploying")


def test_policy_with_missing_zone_grants_nothing(world: World, operator: OperatorProcess, namespace: str) -> None:
    spec = {"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": ["school"]}}
    world.put(fractus_object("Policy", "no-school", spec))
    wait_for(lambda: _ready(world, "policies", "no-school") == "False", "the policy's condition")
    world.put(traffic(namespace))
    wait_for(lambda: world.condition(namespace, "Granted").get("status") == "False", "the refusal")
    assert "school" in world.condition(namespace, "Granted")["message"]
    assert world.children(namespace) == {}
    world.put(fractus_object("Zone", "school", {"area": {"circle": {"center": at(30, 30), "radius": 5}}}))
    world.phase(namespace, "Deploying")
    wait_for(lambda: _ready(world, "policies", "no-school") == "True", "the policy's condition")
    wait_for(
        lambda: "no-school" in [p["name"] for g in world.grants(namespace) for p in g["spec"].get("policies", [])],
        "the policy in the Grants",
    )


def test_new_policy_updates_grants_of_running_application(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    running(world, namespace)
    world.put(fractus_object("Policy", "low", {"type": "LimitControl", "kind": "altitude", "upperLimit": 15}))
    wait_for(
        lambda: all("low" in [p["name"] for p in g["spec"].get("policies", [])] for g in world.grants(namespace)),
        "the policy",
    )
    assert world.status(namespace)["phase"] == "Waiting"


def test_grant_with_modified_signature_is_signed_again(world: World, operator: OperatorProcess, namespace: str) -> None:
    def sound() -> bool:
        try:
            return all(verify(Grant.from_body(body), authorities) for body in world.grants(namespace))
        except BadSignature:
            return False

    running(world, namespace)
    published = world.api.get("/api/v1/namespaces/fractus-system/configmaps/fractus-ca") or {}
    authorities = read_authorities(published["data"]["ca.crt"].encode())
    assert world.grants(namespace)
    assert sound()
    path = f"{FRACTUS}/grants/{namespace}.traffic-navigator"

    def issued() -> datetime:
        observed.append(world.api.get(path) or {})
        return datetime.fromisoformat(observed[-1]["spec"]["issuedAt"])

    observed: list[dict[str, Any]] = []
    first = issued()
    world.api.merge(path, {"metadata": {"annotations": {SIGNATURE_ANNOTATION: "bm9uc2Vuc2U="}}})
    assert not sound()
    wait_for(sound, "a new signature")
    second = issued()
    assert second > first
    world.api.merge(path, {"spec": {"limits": {"maxSpeed": 300}}})
    wait_for(lambda: issued() > second and sound(), "the operator to restore and sign the Grant")
    assert observed[-1]["spec"]["limits"]["maxSpeed"] < 300, "the operator signed a change of another client"


def test_nodes_get_location_labels(world: World, operator: OperatorProcess) -> None:
    wait_for(lambda: _geohash(world, "drone-1") and _geohash(world, "edge-1"), "labels")
    labels = (world.api.get("/api/v1/nodes/drone-1") or {})["metadata"]["labels"]
    assert labels["fractus.dev/depot"] == "base"
    assert labels["fractus.dev/interface-wifi"] == labels["fractus.dev/interface-4g"] == "true"
    assert labels["fractus.dev/class"] == "drone"
    world.api.delete(f"{FRACTUS}/drones/drone-1")
    wait_for(lambda: _geohash(world, "drone-1") is None, "the location label to be removed")
    labels = (world.api.get("/api/v1/nodes/drone-1") or {})["metadata"]["labels"]
    assert set(labels) == {"fractus.dev/class"}


def test_node_has_guarded_label_while_tainted(world: World, operator: OperatorProcess) -> None:
    node = "/api/v1/nodes/edge-1"

    def taint(*effects: str) -> None:
        taints = [{"key": "fractus.dev/class", "value": "edge", "effect": effect} for effect in effects]
        world.api.merge(node, {"spec": {"taints": taints}})

    def guarded() -> bool:
        return "fractus.dev/guarded" in (world.api.get(node) or {})["metadata"]["labels"]

    try:
        taint("NoSchedule", "NoExecute")
        wait_for(guarded, "the node's label")
        taint("NoSchedule")
        wait_for(lambda: not guarded(), "the label to be removed")
        assert _geohash(world, "edge-1")
    finally:
        taint()


def test_small_change_restarts_no_other_pod(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    before = versions(world, namespace)
    manifest = traffic(namespace)
    manifest["spec"]["components"][4]["container"]["image"] = "registry.test/component:2"
    world.put(manifest)
    wait_for(lambda: world.status(namespace)["observedGeneration"] == 2, "the new generation")
    after = versions(world, namespace)
    changed = {name for name in before if before[name] != after.get(name)}
    assert changed <= {"deployments/traffic-data-store", "deploymentplans/traffic", "application"}
    assert "deployments/traffic-data-store" in changed


def driver_env(world: World, namespace: str) -> dict[str, Any]:
    path = f"/apis/apps/v1/namespaces/{namespace}/deployments/traffic-navigator"
    spec = (world.api.get(path) or {})["spec"]["template"]["spec"]
    return {v["name"]: v.get("value") for v in spec["containers"][0]["env"]}


def test_change_in_flight_waits_for_landing(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    world.drone_status("drone-1", "flying")
    world.phase(namespace, "Flying")
    before = {n: v for n, v in versions(world, namespace).items() if n != "application"}
    manifest = traffic(namespace)
    manifest["spec"]["components"][0]["container"]["env"] = [{"name": "COLOUR", "value": "red"}]
    world.put(manifest)
    waits = wait_for(lambda: world.condition(namespace, "Updated"), "the condition Updated")
    assert (waits["status"], waits["reason"]) == ("False", "WaitsForLanding")
    assert "when drone-1 has landed" in waits["message"]
    assert world.status(namespace)["phase"] == "Flying"
    world.put(fractus_object("Policy", "low", {"type": "LimitControl", "kind": "altitude", "upperLimit": 15}))
    wait_for(
        lambda: all("low" in [p["name"] for p in g["spec"].get("policies", [])] for g in world.grants(namespace)),
        "the new policy in all Grants during the flight",
    )
    after = versions(world, namespace)
    assert {n for n in before if before[n] != after[n] and not n.startswith("grants/")} == set()
    world.drone_status("drone-1", "inactive")
    wait_for(lambda: driver_env(world, namespace).get("COLOUR") == "red", "the change")
    wait_for(lambda: not world.condition(namespace, "Updated"), "the condition Updated to be removed")


def test_immediate_change_is_applied_in_flight(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    world.drone_status("drone-1", "flying")
    world.phase(namespace, "Flying")
    manifest = traffic(namespace)
    manifest["spec"]["updatePolicy"] = "Immediate"
    manifest["spec"]["components"][0]["container"]["env"] = [{"name": "COLOUR", "value": "red"}]
    world.put(manifest)
    wait_for(lambda: driver_env(world, namespace).get("COLOUR") == "red", "the change")


def test_change_pending_at_end_of_mission_starts_another_mission(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    running(world, namespace)
    world.drone_status("drone-1", "flying")
    world.phase(namespace, "Flying")
    manifest = traffic(namespace)
    manifest["spec"]["components"][0]["container"]["env"] = [{"name": "COLOUR", "value": "red"}]
    world.put(manifest)
    wait_for(lambda: world.condition(namespace, "Updated"), "the condition Updated")
    end_mission(world, namespace, "Complete", "done")
    status = world.phase(namespace, "Returning")
    assert (
        "the changed manifest is applied when the components that end with the flight have stopped" in status["message"]
    )
    world.drone_status("drone-1", "inactive")

    def begins() -> bool:
        world.end_pods(namespace)
        return bool(world.status(namespace)["phase"] == "Deploying")

    wait_for(begins, "the next mission")
    assert driver_env(world, namespace).get("COLOUR") == "red"
    wait_for(lambda: world.grants(namespace), "the Grants of the next mission")


def test_field_removed_from_spec_is_removed(world: World, operator: OperatorProcess, namespace: str) -> None:
    """The operator created the field by POST. A later apply without the field must remove it."""
    manifest = traffic(namespace)
    container = manifest["spec"]["components"][4]["container"]
    container["env"] = [{"name": "COLOUR", "value": "red"}, {"name": "SIZE", "value": "large"}]
    container["args"] = ["--verbose"]
    world.put(manifest)
    deployed(world, namespace)
    path = f"/apis/apps/v1/namespaces/{namespace}/deployments/traffic-data-store"

    def made() -> dict[str, Any]:
        found: dict[str, Any] = (world.api.get(path) or {})["spec"]["template"]["spec"]["containers"][0]
        return found

    world.api.merge(path, {"metadata": {"annotations": {"their.org/note": "kept"}}})
    assert made()["args"] == ["--verbose"]
    generation = (world.api.get(path) or {})["metadata"]["generation"]
    container["env"] = container["env"][1:]
    del container["args"]
    world.put(manifest)
    wait_for(lambda: "args" not in made(), "the arguments to be removed")
    assert {"COLOUR", "SIZE"} & {variable["name"] for variable in made()["env"]} == {"SIZE"}
    metadata = (world.api.get(path) or {})["metadata"]
    assert metadata["generation"] == generation + 1
    assert metadata["annotations"]["their.org/note"] == "kept"
    operator_entries = [e for e in metadata["managedFields"] if e["manager"] == "fractus-operator"]
    assert [entry["operation"] for entry in operator_entries] == ["Apply"]


def test_removed_passenger_is_deleted(world: World, operator: OperatorProcess, namespace: str) -> None:
    store = component("DataStore", "cloud")
    passenger = viewer(egress=["DataStore"])
    world.put(traffic(namespace, "traffic", navigator(), passenger, store))
    deployed(world, namespace, pods=3)
    world.put(traffic(namespace, "traffic", navigator(), store))
    wait_for(
        lambda: "deployments/traffic-aerial-viewer" not in world.children(namespace),
        "the Deployment of the passenger to be deleted",
    )
    wait_for(
        lambda: [g["spec"]["component"] for g in world.grants(namespace)] == ["Navigator"],
        "the Grant of the passenger to be deleted",
    )

"""A user with the role `edit` in a namespace can run pods on a drone, but gets no access to the node itself."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator

import pytest
import yaml
from conftest import DRONE
from kubectl import Kube, Object

NAMESPACE = "isolation"
ALICE = "alice"
IMAGE = "localhost/fractus/example-traffic-monitoring:dev"


@pytest.fixture(scope="module")
def alices(kube: Kube) -> Iterator[Kube]:
    """The cluster with an additional namespace, in which the user Alice has the role edit."""
    binding = {
        "apiVersion": "rbac.authorization.k8s.io/v1",
        "kind": "RoleBinding",
        "metadata": {"name": ALICE, "namespace": NAMESPACE},
        "roleRef": {"apiGroup": "rbac.authorization.k8s.io", "kind": "ClusterRole", "name": "edit"},
        "subjects": [{"apiGroup": "rbac.authorization.k8s.io", "kind": "User", "name": ALICE}],
    }
    kube.apply({"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": NAMESPACE}}, binding)
    kube.wait("the namespace has its default service account", lambda: kube.get("serviceaccount", "default", NAMESPACE))
    yield kube
    kube.run("delete", "namespace", NAMESPACE, "--wait=true", "--timeout=90s", timeout_s=120)


def pod(name: str) -> Object:
    """Return a pod that tolerates the taint of drones and needs no access to its node."""
    container = {
        "name": "main",
        "image": IMAGE,
        "imagePullPolicy": "IfNotPresent",
        "command": ["python3", "-c", "import signal; signal.pause()"],
        "resources": {"requests": {"cpu": "1m", "memory": "8Mi"}},
        "securityContext": {"allowPrivilegeEscalation": False, "capabilities": {"drop": ["ALL"]}},
    }
    return {
        "apiVersion": "v1",
        "kind": "Pod",
        "metadata": {"name": name, "namespace": NAMESPACE},
        "spec": {
            "terminationGracePeriodSeconds": 0,
            "securityContext": {"runAsNonRoot": True, "runAsUser": 10001, "seccompProfile": {"type": "RuntimeDefault"}},
            "nodeSelector": {"fractus.dev/class": "drone"},
            "tolerations": [{"key": "fractus.dev/class", "operator": "Exists"}],
            "containers": [container],
        },
    }


def host_network_pod(name: str) -> Object:
    """Return a pod that uses the network of its node."""
    body = pod(name)
    body["spec"]["hostNetwork"] = True
    return body


def create(kube: Kube, obj: Object) -> str:
    """Create an object as Alice. Return the refusal, or an empty string if the object was accepted."""
    result = kube.run("create", "-f", "-", "--as", ALICE, stdin=yaml.safe_dump(obj))
    return result.stderr if result.returncode else ""


def host_network(spec: Object, _main: Object) -> None:
    spec["hostNetwork"] = True


def host_network_by_wildcard(spec: Object, _main: Object) -> None:
    spec["hostNetwork"] = True
    spec["tolerations"] = [{"operator": "Exists"}]


def host_network_by_value(spec: Object, _main: Object) -> None:
    spec["hostNetwork"] = True
    spec["tolerations"] = [{"key": "fractus.dev/class", "value": "drone", "effect": "NoExecute"}]


def host_processes(spec: Object, _main: Object) -> None:
    spec["hostPID"] = True


def host_ipc(spec: Object, _main: Object) -> None:
    spec["hostIPC"] = True


def host_path(spec: Object, _main: Object) -> None:
    spec["volumes"] = [{"name": "state", "hostPath": {"path": "/var/lib/fractus"}}]


def node_name(spec: Object, _main: Object) -> None:
    spec["nodeName"] = DRONE


def privileged(_spec: Object, main: Object) -> None:
    main["securityContext"] = {"privileged": True, "capabilities": {"drop": ["ALL"]}}


def privileged_init_container(spec: Object, main: Object) -> None:
    first = {**copy.deepcopy(main), "name": "first"}
    privileged(spec, first)
    spec["initContainers"] = [first]


def escalation(_spec: Object, main: Object) -> None:
    del main["securityContext"]["allowPrivilegeEscalation"]


def capability(_spec: Object, main: Object) -> None:
    main["securityContext"]["capabilities"]["add"] = ["NET_RAW"]


def default_capabilities(_spec: Object, main: Object) -> None:
    del main["securityContext"]["capabilities"]


def host_port(_spec: Object, main: Object) -> None:
    main["ports"] = [{"containerPort": 5760, "hostPort": 5761}]


def probe_of_the_autopilot(_spec: Object, main: Object) -> None:
    main["livenessProbe"] = {"tcpSocket": {"host": "127.0.0.1", "port": 5760}}


def hook_to_the_autopilot(_spec: Object, main: Object) -> None:
    main["lifecycle"] = {"postStart": {"httpGet": {"host": "127.0.0.1", "port": 5760}}}


def root(_spec: Object, main: Object) -> None:
    main["securityContext"]["runAsUser"] = 0


def unconfined(_spec: Object, main: Object) -> None:
    main["securityContext"]["seccompProfile"] = {"type": "Unconfined"}


def critical_priority(spec: Object, _main: Object) -> None:
    spec["priorityClassName"] = "system-node-critical"


ESCALATIONS: dict[Callable[[Object, Object], None], str] = {
    host_network: "remove hostNetwork",
    host_network_by_wildcard: "remove hostNetwork",
    host_network_by_value: "remove hostNetwork",
    host_processes: "remove hostNetwork",
    host_ipc: "remove hostNetwork",
    host_path: "use volumes of the types",
    node_name: "instead of nodeName",
    privileged: "allowPrivilegeEscalation to false",
    privileged_init_container: "allowPrivilegeEscalation to false",
    escalation: "allowPrivilegeEscalation to false",
    capability: "remove add",
    default_capabilities: "capabilities.drop to [ALL]",
    host_port: "remove hostPort",
    probe_of_the_autopilot: "remove host from httpGet",
    hook_to_the_autopilot: "remove host from httpGet",
    root: "must not run as root",
    unconfined: "RuntimeDefault",
    critical_priority: "PriorityClass below",
}


@pytest.mark.parametrize("escalate", ESCALATIONS, ids=lambda escalate: escalate.__name__)
def test_pods_with_access_to_the_node_are_refused(alices: Kube, escalate: Callable[[Object, Object], None]) -> None:
    body = pod("escalation")
    escalate(body["spec"], body["spec"]["containers"][0])
    refusal = create(alices, body)
    assert "fractus-pods" in refusal
    assert ESCALATIONS[escalate] in refusal


def test_pods_without_access_to_the_node_run_on_drones(alices: Kube) -> None:
    assert create(alices, pod("modest")) == ""
    running = alices.wait("the pod runs", lambda: phase(alices, "modest") == "Running" and get(alices, "modest"))
    assert running["spec"]["nodeName"] == DRONE
    # Alice can still label and delete the admitted pod.
    alices.must("label", "pod", "modest", "-n", NAMESPACE, "--as", ALICE, "seen=yes")
    alices.must("delete", "pod", "modest", "-n", NAMESPACE, "--as", ALICE, "--timeout=30s")


def test_debug_containers_get_no_access_to_the_node(alices: Kube) -> None:
    assert create(alices, pod("debugged")) == ""
    alices.wait("the pod runs", lambda: phase(alices, "debugged") == "Running")
    debug = {"name": "debug", "image": IMAGE, "securityContext": {"privileged": True}}
    patch = yaml.safe_dump({"spec": {"ephemeralContainers": [debug]}})
    # The administrator adds the container, because the role edit does not permit it.
    result = alices.run(
        "patch", "pod", "debugged", "-n", NAMESPACE, "--subresource=ephemeralcontainers", "--patch", patch
    )
    assert "allowPrivilegeEscalation to false" in result.stderr


def test_deployments_create_no_pods_with_access_to_the_node(alices: Kube) -> None:
    template = host_network_pod("unused")["spec"]
    deployment = {
        "apiVersion": "apps/v1",
        "kind": "Deployment",
        "metadata": {"name": "grasps", "namespace": NAMESPACE},
        "spec": {
            "selector": {"matchLabels": {"app": "grasps"}},
            "template": {"metadata": {"labels": {"app": "grasps"}}, "spec": {**template, "nodeName": DRONE}},
        },
    }
    assert create(alices, deployment) == ""

    def failure() -> str:
        conditions = (alices.get("deployment", "grasps", NAMESPACE) or {}).get("status", {}).get("conditions", [])
        return next((c["message"] for c in conditions if c["type"] == "ReplicaFailure"), "")

    assert "fractus-pods" in alices.wait("the deployment reports a ReplicaFailure", failure)
    assert not alices.all("pods", NAMESPACE, "app=grasps")


def test_toleration_of_drones_cannot_be_added_to_pending_pod(alices: Kube) -> None:
    waiting = host_network_pod("waiting")
    waiting["spec"]["schedulingGates"] = [{"name": "example.com/later"}]
    tolerations = waiting["spec"].pop("tolerations")
    assert create(alices, waiting) == ""
    patch = yaml.safe_dump({"spec": {"tolerations": tolerations}})
    result = alices.run("patch", "pod", "waiting", "-n", NAMESPACE, "--as", ALICE, "--type=merge", "--patch", patch)
    assert "remove hostNetwork" in result.stderr


def test_node_name_does_not_place_a_pod_on_a_drone(alices: Kube) -> None:
    named = host_network_pod("named")
    del named["spec"]["tolerations"]
    named["spec"]["nodeName"] = DRONE
    assert create(alices, named) == ""
    observed: list[Object] = []

    def rejected() -> bool:
        current = get(alices, "named")
        observed.extend([current] if current else [])
        return current is None or current["status"]["phase"] == "Failed"

    alices.wait("the pod is rejected", rejected, timeout_s=60)
    statuses = [s for body in observed for s in body["status"].get("containerStatuses", [])]
    assert not [s for s in statuses if s.get("started") or "running" in s["state"] or "terminated" in s["state"]]
    events = [e for e in alices.all("events", NAMESPACE) if e["involvedObject"]["name"] == "named"]
    assert not {"Pulled", "Created", "Started"} & {e["reason"] for e in events}


def get(kube: Kube, name: str) -> Object | None:
    """Return one of Alice's pods."""
    return kube.get("pod", name, NAMESPACE)


def phase(kube: Kube, name: str) -> str:
    """Return the phase of one of Alice's pods."""
    return str(((get(kube, name) or {}).get("status") or {}).get("phase"))

"""Test inventory (one depot, drones, edge nodes, a cloud node) and the operator as a process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from control_plane import ControlPlane, wait_for
from fractus_cluster.ports import free_port
from fractus_runtime.kubernetes import BlockingClient, KubeError

Body = dict[str, Any]
FRACTUS = "/apis/fractus.dev/v1alpha1"
SYSTEM = "fractus-system"
NODES = "fractus-nodes"
NODE_OBJECTS = (
    f"{FRACTUS}/namespaces/{NODES}/nodegrants",
    f"/apis/rbac.authorization.k8s.io/v1/namespaces/{NODES}/rolebindings",
    f"/apis/rbac.authorization.k8s.io/v1/namespaces/{NODES}/roles",
    f"/api/v1/namespaces/{NODES}/serviceaccounts",
)
"""Paths of the collections in which the operator creates an object for each node."""
LAT = 39.3606
LON = 22.9307
MOBILITY = [
    "Arm",
    "Disarm",
    "Takeoff",
    "Land",
    "SetSpeed",
    "GetSpeed",
    "Goto",
    "Hover",
    "GetPosition",
    "ReturnToLaunch",
]
CAMERA = ["CaptureImage", "RetrieveImage", "ListImages"]


def at(north_m: float, east_m: float, **more: float) -> Body:
    """Return a position at an offset in metres from the depot (flat Earth, accurate to a centimetre)."""
    return {"lat": LAT + north_m / 111_030, "lon": LON + east_m / 86_200, **more}


def fractus_object(kind: str, name: str, spec: Body, namespace: str | None = None) -> Body:
    metadata: Body = {"name": name, **({"namespace": namespace} if namespace else {})}
    return {"apiVersion": "fractus.dev/v1alpha1", "kind": kind, "metadata": metadata, "spec": spec}


def component(name: str, placement: str, **more: Any) -> Body:
    container = {
        "image": "registry.test/component:1",
        "ports": [{"port": 8080}],
        "resources": {"requests": {"cpu": "0.1"}},
    }
    return {"name": name, "placement": placement, "container": container, **more}


def navigator(**more: Any) -> Body:
    services = [{"service": "mobility", "methods": ["Arm", "Takeoff", "Goto", "Land"]}]
    points = [{"point": {"depot": "base"}, "navigation": "pathBased", "path": [at(0, 0, alt=10), at(60, 60, alt=20)]}]
    return component("Navigator", "drone", **{"class": "driver", "services": services, "controlPoints": points, **more})


def viewer(**more: Any) -> Body:
    services = [{"service": "camera", "methods": ["CaptureImage", "RetrieveImage"]}]
    return component(
        "AerialViewer", "drone", **{"class": "passenger", "services": services, "egress": ["ImageChecker"], **more}
    )


def traffic(namespace: str, name: str = "traffic", *components: Body) -> Body:
    """Return an Application. Its components stop at the landing."""
    parts = components or (
        navigator(),
        viewer(),
        component(
            "GroundViewer",
            "edge",
            locations=[{"center": at(50, 50), "radius": 200, "instances": 2}],
            services=[{"service": "camera", "methods": ["CaptureImage"]}],
            egress=["ImageChecker"],
        ),
        component("ImageChecker", "hybrid", hybridTo=["AerialViewer"], egress=["DataStore"]),
        component("DataStore", "cloud", endsWith="flight"),
    )
    return fractus_object("Application", name, {"components": list(parts), "afterFlight": 0}, namespace)


class World:
    """Objects of drones, edge nodes and applications at the API server, with shortcuts for reading and writing them."""

    def __init__(self, plane: ControlPlane) -> None:
        self.plane = plane
        self.api: BlockingClient = plane.admin

    def furnish(self, drones: int = 1, edges: int = 3) -> None:
        self.clear()
        for name in (SYSTEM, NODES):
            self.api.apply(f"/api/v1/namespaces/{name}", _namespace(name))
        self.put(fractus_object("Depot", "base", {"location": at(0, 0), "radius": 30}))
        for i in range(1, drones + 1):
            self.add_drone(f"drone-{i}")
        for i in range(1, edges + 1):
            self.add_edge(f"edge-{i}", at(20.0 * i, 30))
        self.add_node("cloud-1", "cloud")

    def add_node(self, name: str, node_class: str) -> None:
        labels = {"fractus.dev/class": node_class}
        body = {"apiVersion": "v1", "kind": "Node", "metadata": {"name": name, "labels": labels}}
        self.api.apply(f"/api/v1/nodes/{name}", body)
        status = {
            "allocatable": {"cpu": "8", "memory": "2Gi", "pods": "110"},
            "capacity": {"cpu": "8", "memory": "2Gi", "pods": "110"},
            "conditions": [_condition("Ready", "True", "KubeletReady")],
        }
        self.api.merge(f"/api/v1/nodes/{name}/status", {"status": status})

    def add_drone(self, name: str) -> None:
        self.add_node(name, "drone")
        interfaces = [
            {"technology": "WiFi", "device": "wlan0", "range": 80, "pairing": {"networkId": "x"}},
            {"technology": "4G"},
        ]
        mobility = {"maxAltitude": 80, "maxFlightTime": 20, "maxSpeed": 15, "methods": MOBILITY}
        services = {"mobility": mobility, "camera": {"methods": CAMERA}}
        spec = {"depot": "base", "home": at(0, 0, alt=12), "interfaces": interfaces, "services": services}
        self.put(fractus_object("Drone", name, spec))
        self.drone_status(name, "inactive")

    def drone_status(self, name: str, state: str, ready: str = "True") -> None:
        status = {"flightState": state, "battery": {"remaining": 1.0}, "position": at(0, 0)}
        status["conditions"] = [_condition("Ready", ready, "AutopilotConnected")]
        self.api.merge(f"{FRACTUS}/drones/{name}/status", {"status": status})

    def add_edge(self, name: str, place: Body) -> None:
        self.add_node(name, "edge")
        interfaces = [{"technology": "WiFi", "device": "wlan0", "range": 80, "pairing": {"networkId": name}}]
        spec = {"location": place, "interfaces": interfaces, "services": {"camera": {"methods": CAMERA}}}
        self.put(fractus_object("EdgeNode", name, spec))

    def is_labelled(self, *nodes: str) -> bool:
        """Return True if the operator has labelled nodes with their location, because it has received their objects.

        Args:
            nodes: Names of the nodes. Default: all drones and edge nodes.
        """
        labels = {node["metadata"]["name"]: node["metadata"]["labels"] for node in self.api.list("/api/v1/nodes")}
        names = nodes or [name for name in labels if labels[name].get("fractus.dev/class") != "cloud"]
        return all("fractus.dev/geohash" in labels[name] for name in names)

    def path(self, body: Body) -> str:
        plural = "policies" if body["kind"] == "Policy" else f"{body['kind'].lower()}s"
        namespace = body["metadata"].get("namespace")
        scope = f"/namespaces/{namespace}" if namespace else ""
        return f"{FRACTUS}{scope}/{plural}/{body['metadata']['name']}"

    def put(self, body: Body) -> Body:
        return self.api.apply(self.path(body), body)

    def bound_pod(
        self, namespace: str, name: str, node: str, labels: dict[str, str] | None = None, **spec: Any
    ) -> Body:
        """Create a pod, and bind it to a node like the scheduler."""
        path = f"/api/v1/namespaces/{namespace}/pods"
        pod_spec = {"containers": [{"name": "main", "image": "a"}], **spec}
        metadata = {"name": name, "namespace": namespace, "labels": labels or {}}
        pod = self.api.call("POST", path, {"apiVersion": "v1", "kind": "Pod", "metadata": metadata, "spec": pod_spec})
        target = {"apiVersion": "v1", "kind": "Node", "name": node}
        binding = {"apiVersion": "v1", "kind": "Binding", "metadata": {"name": name}, "target": target}
        self.api.call("POST", f"{path}/{name}/binding", binding)
        return pod

    def application(self, namespace: str, name: str = "traffic") -> Body | None:
        return self.api.get(f"{FRACTUS}/namespaces/{namespace}/applications/{name}")

    def status(self, namespace: str, name: str = "traffic") -> Body:
        return (self.application(namespace, name) or {}).get("status") or {}

    def condition(self, namespace: str, type_: str, name: str = "traffic") -> Body:
        conditions = self.status(namespace, name).get("conditions") or ()
        return next((c for c in conditions if c["type"] == type_), {})

    def phase(self, namespace: str, phase: str, name: str = "traffic") -> Body:
        def reached() -> Body | None:
            status = self.status(namespace, name)
            return status if status.get("phase") == phase else None

        return wait_for(reached, lambda: f"{name} to be {phase}, but it is {self.status(namespace, name)}")

    def grants(self, namespace: str, name: str = "traffic") -> list[Body]:
        selector = f"fractus.dev/namespace={namespace},fractus.dev/application={name}"
        return self.api.list(f"{FRACTUS}/grants", labelSelector=selector)

    def children(self, namespace: str) -> dict[str, Body]:
        """Return the objects that the operator created in a namespace, by `PLURAL/NAME`."""
        objects = {}
        for path in (
            f"{FRACTUS}/namespaces/{namespace}/deploymentplans",
            f"/api/v1/namespaces/{namespace}/secrets",
            f"/api/v1/namespaces/{namespace}/services",
            f"/apis/apps/v1/namespaces/{namespace}/deployments",
            f"/apis/discovery.k8s.io/v1/namespaces/{namespace}/endpointslices",
            f"/apis/networking.k8s.io/v1/namespaces/{namespace}/networkpolicies",
        ):
            for item in self.api.list(path, labelSelector="app.kubernetes.io/managed-by=fractus"):
                objects[f"{path.rsplit('/', 1)[1]}/{item['metadata']['name']}"] = item
        for item in self.grants(namespace):
            objects[f"grants/{item['metadata']['name']}"] = item
        for item in self.links(namespace).values():
            objects[f"directlinks/{item['metadata']['name']}"] = item
        return objects

    def links(self, namespace: str, name: str = "traffic") -> dict[str, Body]:
        """Return the DirectLinks of an application by node."""
        selector = f"fractus.dev/namespace={namespace},fractus.dev/application={name}"
        return {body["spec"]["node"]: body for body in self.api.list(f"{FRACTUS}/directlinks", labelSelector=selector)}

    def pods(self, namespace: str) -> list[Body]:
        """Return the pods without a deletion timestamp. Deleted pods do not disappear, because there is no kubelet."""
        pods = self.api.list(f"/api/v1/namespaces/{namespace}/pods")
        return [pod for pod in pods if "deletionTimestamp" not in pod["metadata"]]

    def run_pods(self, namespace: str) -> None:
        """Bind every pod and mark it as ready, as scheduler and kubelet do."""
        for number, pod in enumerate(self.pods(namespace)):
            name = pod["metadata"]["name"]
            if not pod["spec"].get("nodeName"):
                terms = pod["spec"]["affinity"]["nodeAffinity"]["requiredDuringSchedulingIgnoredDuringExecution"]
                term = terms["nodeSelectorTerms"][0]
                node = term["matchFields"][0]["values"][0] if "matchFields" in term else "cloud-1"
                binding = {"metadata": {"name": name}, "target": {"kind": "Node", "name": node}}
                self.api.call("POST", f"/api/v1/namespaces/{namespace}/pods/{name}/binding", binding)
            status = {
                "phase": "Running",
                "podIP": f"10.1.0.{number + 1}",
                "podIPs": [{"ip": f"10.1.0.{number + 1}"}],
                "conditions": [_condition("Ready", "True", ""), _condition("PodScheduled", "True", "")],
            }
            self.api.merge(f"/api/v1/namespaces/{namespace}/pods/{name}/status", {"status": status})

    def end_pods(self, namespace: str) -> None:
        """End the pods that were deleted or stopped, as a kubelet does. They do not disappear."""
        for pod in self.api.list(f"/api/v1/namespaces/{namespace}/pods"):
            ends = "deletionTimestamp" in pod["metadata"] or "activeDeadlineSeconds" in pod["spec"]
            if ends and pod["status"].get("phase") != "Failed":
                path = f"/api/v1/namespaces/{namespace}/pods/{pod['metadata']['name']}/status"
                self.api.merge(path, {"status": {"phase": "Failed"}})

    def clear(self) -> None:
        """Remove cluster-scoped objects of tests. Also remove all pods, because no kubelet removes them."""
        for drone in self.api.list(f"{FRACTUS}/drones"):
            state = {"status": {"flightState": "inactive", "conditions": []}}
            self.api.merge(f"{FRACTUS}/drones/{drone['metadata']['name']}/status", state)
        for pod in self.api.list("/api/v1/pods"):
            path = f"/api/v1/namespaces/{pod['metadata']['namespace']}/pods/{pod['metadata']['name']}"
            self._delete(path, grace_s=0)
        for plural in (
            "drones",
            "edgenodes",
            "depots",
            "zones",
            "policies",
            "grants",
            "directlinks",
            "applicationtemplates",
        ):
            for item in self.api.list(f"{FRACTUS}/{plural}"):
                self._delete(f"{FRACTUS}/{plural}/{item['metadata']['name']}")
        for path in NODE_OBJECTS:
            for item in self.api.list(path, labelSelector="app.kubernetes.io/managed-by=fractus"):
                self._delete(f"{path}/{item['metadata']['name']}")
        for node in self.api.list("/api/v1/nodes"):
            self._delete(f"/api/v1/nodes/{node['metadata']['name']}")

    def _delete(self, path: str, grace_s: int | None = None) -> None:
        """Delete an object. Retry, because the API server first needs to receive that the drones have landed."""

        def deleted() -> bool:
            try:
                self.api.delete(path, grace_s)
            except KubeError as error:
                if error.status != 403:
                    raise
                return False
            return True

        wait_for(deleted, f"{path} to be deleted")


def approved_template(world: World, name: str = "survey") -> None:
    """Publish and approve a template of a flight along waypoints."""
    leader = navigator()
    leader["container"]["image"] = "registry.test/component@sha256:" + "0" * 64
    spec = {"navigation": "path", "altitudes": {"upper": 60}, "template": {"components": [leader]}}
    body = world.put(fractus_object("ApplicationTemplate", name, spec))
    approval = {"generation": body["metadata"]["generation"], "by": "admin", "at": "2026-01-01T00:00:00Z"}
    world.api.merge(f"{FRACTUS}/applicationtemplates/{name}/status", {"status": {"approval": approval}})


def approved_region_template(world: World) -> None:
    """Publish and approve the template `patrol` of a flight in a region."""
    area = {"circle": {"center": at(0, 0), "radius": 50}}
    points = [{"point": {"depot": "base"}, "navigation": "regionBased", "region": area, "duration": 1}]
    driver = navigator(controlPoints=points)
    driver["container"]["image"] = "registry.test/component@sha256:" + "0" * 64
    spec = {"navigation": "region", "altitudes": {"upper": 60}, "template": {"components": [driver]}}
    body = world.put(fractus_object("ApplicationTemplate", "patrol", spec))
    approval = {"generation": body["metadata"]["generation"], "by": "admin", "at": "2026-01-01T00:00:00Z"}
    world.api.merge(f"{FRACTUS}/applicationtemplates/patrol/status", {"status": {"approval": approval}})


def _namespace(name: str) -> Body:
    return {"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": name}}


def _condition(type_: str, status: str, reason: str) -> Body:
    return {"type": type_, "status": status, "reason": reason, "lastTransitionTime": "2026-01-01T00:00:00Z"}


class OperatorProcess:
    """The operator, as `python -m fractus_operator`."""

    def __init__(self, kubeconfig: Path, log: Path, identity: str = "operator", **settings: str) -> None:
        self._kubeconfig = kubeconfig
        # The process keeps its identity when it is restarted, like a pod.
        self._settings = {"FRACTUS_IDENTITY": identity, **settings}
        self._log = log
        self._log_begin = 0
        self.health = f"http://127.0.0.1:{free_port()}/healthz"
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        env = {
            **os.environ,
            "KUBECONFIG": str(self._kubeconfig),
            "FRACTUS_HEALTH": self.health,
            **self._settings,
        }
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "fractus_operator"], env=env, stdout=log, stderr=log
            )

    def stop(self, number: int = signal.SIGTERM) -> int:
        assert self._process is not None
        self._process.send_signal(number)
        code = self._process.wait(20)
        self._process = None
        return code

    def kill(self) -> None:
        """Kill the process. This may be called from any thread."""
        if self._process is not None:
            self._process.kill()

    @property
    def running(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def signal(self, number: int) -> None:
        assert self._process is not None
        self._process.send_signal(number)

    def begin_log(self) -> None:
        """Let `log` return only what the operator writes from now on."""
        self._log_begin = self._log.stat().st_size if self._log.exists() else 0

    def log(self) -> str:
        return self._log.read_bytes()[self._log_begin :].decode()


@contextmanager
def fresh_namespace(world: World, name: str) -> Iterator[str]:
    """Create a namespace for one test, and delete it with its Applications at the end."""
    world.api.apply(f"/api/v1/namespaces/{name}", _namespace(name))
    # Pods are refused until the controller manager has created this account.
    account = f"/api/v1/namespaces/{name}/serviceaccounts/default"
    wait_for(lambda: world.api.get(account), "the default service account of the namespace")
    try:
        yield name
    finally:
        for item in world.api.list(f"{FRACTUS}/namespaces/{name}/applications"):
            path = f"{FRACTUS}/namespaces/{name}/applications/{item['metadata']['name']}"
            world.api.delete(path)
            try:
                world.api.merge(path, {"metadata": {"finalizers": None}})
            except KubeError as error:
                if error.status != 404:
                    raise
        world.api.delete(f"/api/v1/namespaces/{name}")


def denied(attempt: Callable[[], object], words: str) -> None:
    """Assert that the API server refuses a request with this message."""
    with pytest.raises(KubeError) as refusal:
        attempt()
    assert refusal.value.status == 403, refusal.value
    assert words in str(refusal.value)

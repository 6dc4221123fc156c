"""Control plane on loopback with any number of nodes simulated by kwok, and the operator as a process, for measurements.

The scheduler binds pods, but no containers run. Unlike the embedded cluster (`fractus_cluster`), this cluster needs no
root, and a node consists only of a few objects. Pods become Running one second after they are bound, as with a fast
kubelet.

The nodes send no heartbeats, because the heartbeats of 5,000 nodes would use more than two cores. Lists, watches,
planning and scheduling still cost as much as with real nodes. The Go garbage collector of the API server runs a quarter
as often as by default. Otherwise it would use a third of the server's processor time.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "integration"))

from control_plane import PROGRAMS, ControlPlane
from fractus_cluster.binaries import ensure_binaries
from fractus_cluster.ports import free_port
from fractus_core.api import KINDS
from fractus_runtime.kubernetes import BlockingClient, Client, Kind, KubeError, with_certificate
from harness import ROOT, Processes, wait_until

EXAMPLE = ROOT / "examples" / "traffic-monitoring"
API = "/apis/fractus.dev/v1alpha1"
NODES_NAMESPACE = "fractus-nodes"
OPERATOR = "fractus-operator"
"""User of the operator."""

_NAMESPACES = ("fractus-system", NODES_NAMESPACE)
_ALLOCATABLE = {"cpu": "64", "memory": "64Gi", "pods": "500"}
_READY = {"type": "Ready", "status": "True", "reason": "Simulated", "lastTransitionTime": "2026-01-01T00:00:00Z"}
_LEASE_S = 40_000
"""Duration of a node's Lease in seconds.

kwok renews it after a quarter of this time, when the measurement has ended.
"""

Body = dict[str, Any]
OnEvent = Callable[[str, Body], None]


class SimulatedCluster(ControlPlane):
    """etcd, API server, controller manager, scheduler and kwok, with the CRDs of Fractus.

    Args:
        directory: Directory of data, keys and logs.
        audit: True to record the requests of the operator in `audit_log`, one JSON object per line.
    """

    def __init__(self, directory: Path, *, audit: bool = False) -> None:
        self.audit_log = directory / "audit.log"
        binaries = ensure_binaries((*PROGRAMS, "kube-scheduler", "kwok"), report=print)
        arguments = {
            "kube-controller-manager": (
                "--controllers=endpointslice-controller,node-lifecycle-controller",
                f"--node-monitor-grace-period={_LEASE_S // 2}s", "--kube-api-qps=200", "--kube-api-burst=400",
            ),
            "kube-apiserver": self._audit_arguments(directory) if audit else (),
        }  # fmt: skip
        self._logs = directory
        super().__init__(binaries, directory, arguments)
        credential = self.authority.issue("admin", common_name="admin", organizations=("system:masters",))
        self._access = with_certificate(self.server, self.ca, (credential.certificate, credential.key))
        self.operator_kubeconfig = self.write_kubeconfig("operator", OPERATOR, ("system:masters",))

    def start(self, kinds: bool = True) -> None:
        """Start all processes, and create the namespaces of the operator."""
        os.environ["GOGC"] = "400"
        super().start(kinds)
        config = f"--kubeconfig={self.kubeconfig}"
        self._run("kube-scheduler", config, "--secure-port=0", "--leader-elect=false")
        stages = self._logs / "stages.yaml"
        stages.write_text(yaml.safe_dump_all(STAGES))
        self._run(
            "kwok", config, f"--config={stages}", "--manage-nodes-with-label-selector=type=kwok",
            f"--node-lease-duration-seconds={_LEASE_S}", "--node-ip=127.0.0.1",
        )  # fmt: skip
        for name in _NAMESPACES:
            create_namespace(self.admin, name)

    def check(self) -> None:
        """Check that all processes are running.

        Raises:
            SystemExit: A process has ended.
        """
        for program, process in self._processes.items():
            if process.poll() is not None:
                raise SystemExit(f"bench: {program} has ended; see {self._logs / program}.log")

    def watch(self, callbacks: Mapping[Kind, OnEvent]) -> None:
        """Call the callback of each kind for every new event, in a separate thread."""
        version = self.admin.call("GET", "/api/v1/pods?limit=1")["metadata"]["resourceVersion"]
        threading.Thread(target=lambda: asyncio.run(self._watch_all(callbacks, version)), daemon=True).start()

    async def _watch_all(self, callbacks: Mapping[Kind, OnEvent], version: str) -> None:
        async with contextlib.aclosing(Client(self._access, "bench")) as client:
            await asyncio.gather(*(self._watch(client, *item, version) for item in callbacks.items()))

    async def _watch(self, client: Client, kind: Kind, on_event: OnEvent, version: str) -> None:
        with contextlib.suppress(KubeError):
            async for type_, body in client.watch(kind, resource_version=version, timeout_s=7200, silence_s=600.0):
                if type_ != "BOOKMARK":
                    on_event(type_, body)

    @staticmethod
    def _audit_arguments(directory: Path) -> tuple[str, ...]:
        policy = directory / "audit-policy.yaml"
        rules = [{"level": "Metadata", "users": [OPERATOR], "omitStages": ["RequestReceived"]}, {"level": "None"}]
        policy.write_text(yaml.safe_dump({"apiVersion": "audit.k8s.io/v1", "kind": "Policy", "rules": rules}))
        # The maximum size is large, because requests in a rotated log would not be counted.
        return (
            f"--audit-policy-file={policy}", f"--audit-log-path={directory / 'audit.log'}", "--audit-log-maxsize=10000",
        )  # fmt: skip


class Operator(Processes):
    """The operator as a process. It can be started again after `stop`."""

    pid = 0

    def __init__(self, cluster: SimulatedCluster, directory: Path) -> None:
        super().__init__(directory)
        self._kubeconfig = cluster.operator_kubeconfig

    def start_operator(self) -> None:
        """Start the operator."""
        environment = {
            "KUBECONFIG": str(self._kubeconfig), "FRACTUS_IDENTITY": "bench", "FRACTUS_LOG_FORMAT": "json",
            "FRACTUS_HEALTH": f"http://127.0.0.1:{free_port()}/healthz",
        }  # fmt: skip
        self.pid = self.start("operator", sys.executable, "-m", "fractus_operator", **environment)


def documents(name: str) -> list[Body]:
    """Return the manifests of a file of the traffic-monitoring example."""
    return [d for d in yaml.safe_load_all((EXAMPLE / name).read_text()) if d]


def path_of(body: Body) -> str:
    """Return the API path of an object of Fractus."""
    kind = next(k for k in KINDS if body["kind"] == k.KIND)
    scope = f"/namespaces/{body['metadata']['namespace']}" if kind.NAMESPACED else ""
    return f"{API}{scope}/{kind.PLURAL}/{body['metadata']['name']}"


def manifest(kind: str, name: str, spec: Body) -> Body:
    """Return an object of Fractus."""
    return {"apiVersion": "fractus.dev/v1alpha1", "kind": kind, "metadata": {"name": name}, "spec": spec}


def create_namespace(api: BlockingClient, name: str) -> None:
    """Create a namespace unless it exists."""
    api.apply(f"/api/v1/namespaces/{name}", {"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": name}})


def add_node(api: BlockingClient, node_class: str, name: str, spec: Body | None) -> None:
    """Create a node that kwok keeps Ready, and its Drone or EdgeNode if there is a spec."""
    labels = {"type": "kwok", "fractus.dev/class": node_class, "kubernetes.io/hostname": name}
    metadata = {"name": name, "labels": labels, "annotations": {"kwok.x-k8s.io/node": "fake"}}
    node_status = {"allocatable": _ALLOCATABLE, "capacity": _ALLOCATABLE}
    node = {"apiVersion": "v1", "kind": "Node", "metadata": metadata, "status": node_status}
    api.call("POST", "/api/v1/nodes", node)
    if spec is None:
        return
    body = manifest("Drone" if node_class == "drone" else "EdgeNode", name, spec)
    api.apply(path_of(body), body)
    if node_class == "drone":
        status = {"flightState": "inactive", "battery": {"remaining": 1.0}, "conditions": [_READY]}
        api.merge(path_of(body) + "/status", {"status": status})


def wait_for_ready_nodes(api: BlockingClient) -> None:
    """Wait until every node is Ready."""

    def ready() -> bool:
        nodes = api.list("/api/v1/nodes", resourceVersion="0")
        conditions = [c for n in nodes for c in n["status"].get("conditions", ()) if c["type"] == "Ready"]
        return len(conditions) == len(nodes) and all(c["status"] == "True" for c in conditions)

    wait_until(ready, "all nodes to be Ready", timeout_s=300, pause_s=1.0)


def wait_for_prepared_nodes(api: BlockingClient) -> None:
    """Wait until the operator has labelled every node with its location and created its NodeGrants."""

    def count(*paths: str) -> int:
        return sum(len(api.list(f"{API}/{path}", resourceVersion="0")) for path in paths)

    def prepared() -> bool:
        nodes = api.list("/api/v1/nodes", resourceVersion="0")
        outside = [n for n in nodes if n["metadata"]["labels"]["fractus.dev/class"] != "cloud"]
        labelled = all("fractus.dev/geohash" in n["metadata"]["labels"] for n in outside)
        return labelled and count(f"namespaces/{NODES_NAMESPACE}/nodegrants") == count("drones", "edgenodes")

    wait_until(prepared, "the operator to prepare all nodes", timeout_s=600, pause_s=1.0)


@contextlib.contextmanager
def simulated_cluster(directory: Path, *, audit: bool = False) -> Iterator[SimulatedCluster]:
    """Run a simulated cluster until the end of the `with` block."""
    cluster = SimulatedCluster(directory, audit=audit)
    try:
        cluster.start()
        yield cluster
    finally:
        cluster.stop()


def _stage(name: str, kind: str, selector: list[Body], status: str = "", **more: Any) -> Body:
    return {
        "apiVersion": "kwok.x-k8s.io/v1alpha1", "kind": "Stage", "metadata": {"name": name},
        "spec": {
            "resourceRef": {"apiGroup": "v1", "kind": kind},
            "selector": {"matchExpressions": selector},
            "next": {"statusTemplate": status} if status else {"delete": True},
            **more,
        },
    }  # fmt: skip


_IS_READY = '.status.conditions.[] | select( .type == "Ready" ) | .status'
_NOT_READY = {"key": _IS_READY, "operator": "NotIn", "values": ["True"]}
_NODE_STATUS = """
{{ $now := Now }}
conditions:
{{ range NodeConditions }}
- {lastHeartbeatTime: {{ $now | Quote }}, lastTransitionTime: {{ $now | Quote }}, message: {{ .message | Quote }}, reason: {{ .reason | Quote }}, status: {{ .status | Quote }}, type: {{ .type | Quote }}}
{{ end }}
phase: Running
"""
_POD_STATUS = """
{{ $now := Now }}
conditions:
- {lastTransitionTime: {{ $now | Quote }}, status: "True", type: Initialized}
- {lastTransitionTime: {{ $now | Quote }}, status: "True", type: Ready}
- {lastTransitionTime: {{ $now | Quote }}, status: "True", type: ContainersReady}
containerStatuses:
{{ range .spec.containers }}
- {image: {{ .image | Quote }}, name: {{ .name | Quote }}, ready: true, restartCount: 0, state: {running: {startedAt: {{ $now | Quote }}}}}
{{ end }}
{{ with PodIPsWith .spec.nodeName false ( or .metadata.uid "" ) ( or .metadata.name "" ) ( or .metadata.namespace "" ) }}
podIP: {{ index . 0 | Quote }}
podIPs: [{ip: {{ index . 0 | Quote }}}]
{{ end }}
phase: Running
startTime: {{ $now | Quote }}
"""
STAGES = (
    _stage("node-ready", "Node", [_NOT_READY], _NODE_STATUS),
    _stage(
        "pod-ready", "Pod",
        [
            {"key": ".metadata.deletionTimestamp", "operator": "DoesNotExist"},
            {"key": ".status.phase", "operator": "In", "values": ["Pending"]},
            _NOT_READY,
        ],
        _POD_STATUS, delay={"durationMilliseconds": 1000},
    ),
    _stage("pod-delete", "Pod", [{"key": ".metadata.deletionTimestamp", "operator": "Exists"}]),
)  # fmt: skip
"""Simulation by kwok: new nodes and bound pods become Ready, and deleted pods are removed."""

"""Deployment on 100 to 5,000 simulated nodes: the operator against a real API server, scheduler and kwok.

The traffic-monitoring example is applied in a cluster with thousands of nodes at other places. The benchmark measures
the time until every pod is bound, the time until the application is Waiting with all its children, the operator's
processor time and memory, and the time from the operator's start to the first plan. Then it applies 50 applications at
the same time. The pods of each application must be bound, or the application must be Queued. The comparator creates the
same Deployments without Fractus.

Takes about a quarter of an hour, or four minutes with --quick. Needs no root. simulated_cluster.py describes the nodes.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import math
import random
import statistics
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from fractus_runtime.kubernetes import Kind
from harness import Report, cpu_percent, cpu_s, memory_mb, parser, print_table, quantile, wait_until
from simulated_cluster import (
    API,
    Body,
    Operator,
    SimulatedCluster,
    add_node,
    create_namespace,
    documents,
    path_of,
    simulated_cluster,
    wait_for_prepared_nodes,
    wait_for_ready_nodes,
)  # fmt: skip

CLOUD_NODES = 3
AT_DEPOT = 40
AT_ONCE = 50
NODES_PER_DRONE = 6
SEED = 5000
PODS = Kind("v1", "Pod", "pods", namespaced=True)


def place_elsewhere(rng: random.Random, depot: Body) -> Body:
    """Return a place 5 to 100 km from the depot of the example."""
    bearing = rng.uniform(0, 2 * math.pi)
    distance_m = math.sqrt(rng.uniform(5e3**2, 1e5**2))
    lat = depot["lat"] + distance_m * math.cos(bearing) / 111_000
    lon = depot["lon"] + distance_m * math.sin(bearing) / (111_000 * math.cos(math.radians(lat)))
    return {"lat": round(lat, 6), "lon": round(lon, 6)}


@dataclass
class Measurement:
    """Measurements for one number of nodes. Durations are in seconds, memory in megabytes."""

    nodes: int
    first_plan_s: float = 0.0
    bound_s: list[float] = field(default_factory=list)
    waiting_s: list[float] = field(default_factory=list)
    plain_s: list[float] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)
    idle_percent: float = 0.0
    memory_mb: float = 0.0
    peak_mb: float = 0.0
    at_once_s: float = 0.0
    faults: list[str] = field(default_factory=list)


class Bench:
    """Measures deployments on one control plane while the number of nodes grows."""

    def __init__(self, cluster: SimulatedCluster, operator: Operator) -> None:
        self._api = cluster.admin
        self._operator = operator
        self._rng = random.Random(SEED)
        self._namespaces = 0
        self._templates: list[Body] = []
        self._bound_at: dict[str, dict[str, float]] = collections.defaultdict(dict)
        cluster.watch({PODS: self._note_pod})
        (self._depot,) = documents("depot.yaml")
        self._drone = documents("drone.yaml")[0]["spec"]
        self._edge = documents("edge-nodes.yaml")[0]["spec"]
        for body in (self._depot, *documents("zones.yaml"), *documents("policies.yaml")):
            self._api.apply(path_of(body), body)
        edges = documents("edge-nodes.yaml")
        for edge in edges:
            add_node(self._api, "edge", edge["metadata"]["name"], edge["spec"])
        for i in range(CLOUD_NODES):
            add_node(self._api, "cloud", f"cloud-{i}", None)
        self._nodes = CLOUD_NODES + len(edges)

    def _note_pod(self, type_: str, pod: Body) -> None:
        if type_ != "DELETED" and pod.get("spec", {}).get("nodeName"):
            metadata = pod["metadata"]
            self._bound_at[metadata["namespace"]].setdefault(metadata["name"], time.monotonic())

    def measure(self, nodes: int, times: int) -> Measurement:
        """Add nodes up to the given number, and measure deployments."""
        self._grow(nodes)
        result = Measurement(nodes)
        # The first operator process prepares the nodes, so that the measured process starts in a prepared cluster.
        with self._operator:
            self._operator.start_operator()
            wait_for_prepared_nodes(self._api)
        with self._operator:
            result.first_plan_s = self._first_plan()
            self._templates = self._deployments()
            self._idle_percent()
            # Deployments with and without Fractus alternate, so that both run under the same machine load.
            for _ in range(times):
                before_s = cpu_s(self._operator.pid)
                self._deploy(result)
                result.cpu_s.append(cpu_s(self._operator.pid) - before_s)
                result.plain_s.append(self._deploy_without_fractus())
            result.idle_percent = self._idle_percent()
            result.memory_mb = memory_mb(self._operator.pid)["resident"]
            self._deploy_at_once(result)
            result.peak_mb = memory_mb(self._operator.pid)["peak"]
        return result

    def _grow(self, nodes: int) -> None:
        """Add nodes up to the given number. One in six is a drone. The first 40 drones are at the example's depot."""
        nodes_to_add = []
        depot = self._depot["spec"]["location"]
        for i in range(self._nodes, nodes):
            if i % NODES_PER_DRONE:
                spec = self._edge | {"location": place_elsewhere(self._rng, depot)}
                nodes_to_add.append(("edge", f"edge-{i:05d}", spec))
                continue
            spec = self._drone | {"depot": self._depot["metadata"]["name"]}
            if i // NODES_PER_DRONE >= AT_DEPOT:
                spec |= {"home": place_elsewhere(self._rng, depot)}
                del spec["depot"]
            nodes_to_add.append(("drone", f"drone-{i:05d}", spec))
        with ThreadPoolExecutor(8) as pool:
            list(pool.map(lambda node: add_node(self._api, *node), nodes_to_add))
        self._nodes = nodes
        wait_for_ready_nodes(self._api)

    def _first_plan(self) -> float:
        """Apply an application, start the operator, and return the seconds until the plan of the application exists."""
        namespace = self._namespace()
        self._apply(namespace, "first")
        plan = f"{API}/namespaces/{namespace}/deploymentplans/first"
        begun_s = time.monotonic()
        self._operator.start_operator()
        wait_until(lambda: self._api.get(plan) is not None, "the first plan", timeout_s=120, pause_s=0.02)
        taken_s = time.monotonic() - begun_s
        self._delete_applications(namespace)
        return taken_s

    def _idle_percent(self) -> float:
        """Wait two seconds, and return the operator's share of one core in percent."""
        time.sleep(2.0)
        return cpu_percent(self._operator.pid, 5.0)

    def _deploy(self, result: Measurement) -> None:
        """Measure the time until the last pod is bound, and until the application is Waiting with all its children."""
        namespace = self._namespace()
        begun_s = time.monotonic()
        self._apply(namespace, "traffic")
        result.bound_s.append(self._wait_for_bound_pods(namespace, begun_s))
        self._wait_for_phase(namespace, {"traffic"}, {"Waiting"}, pause_s=0.02)
        result.waiting_s.append(time.monotonic() - begun_s)
        if len(self._bound_at[namespace]) != self._pods_planned():
            raise RuntimeError(f"{namespace}: {len(self._bound_at[namespace])} pods, not {self._pods_planned()}")
        self._delete_applications(namespace)

    def _deployments(self) -> list[Body]:
        """Return the Deployments that the operator creates for the example."""
        namespace = self._namespace()
        self._apply(namespace, "traffic")
        self._wait_for_phase(namespace, {"traffic"}, {"Waiting"})
        deployments = self._api.list(f"/apis/apps/v1/namespaces/{namespace}/deployments")
        self._delete_applications(namespace)
        return deployments

    def _deploy_without_fractus(self) -> float:
        """Create the Deployments of the example directly, and return the time until the last pod is bound."""
        namespace = self._namespace()
        path = f"/apis/apps/v1/namespaces/{namespace}/deployments"
        bodies = [
            {"apiVersion": "apps/v1", "kind": "Deployment", "metadata": {"name": d["metadata"]["name"]}, "spec": d["spec"]}
            for d in self._templates
        ]  # fmt: skip
        begun_s = time.monotonic()
        with ThreadPoolExecutor(8) as pool:
            list(pool.map(lambda body: self._api.call("POST", path, body), bodies))
        taken_s = self._wait_for_bound_pods(namespace, begun_s)
        self._delete_namespace(namespace)
        return taken_s

    def _deploy_at_once(self, result: Measurement) -> None:
        """Apply 50 applications at the same time, and record how the cluster differs from the expected result."""
        namespace = self._namespace()
        names = {f"app-{i:02d}" for i in range(AT_ONCE)}
        begun_s = time.monotonic()
        with ThreadPoolExecutor(8) as pool:
            list(pool.map(lambda name: self._apply(namespace, name), sorted(names)))
        self._wait_for_phase(namespace, names, {"Waiting", "Queued"})
        result.at_once_s = max(self._bound_at[namespace].values()) - begun_s
        result.faults = self._faults(namespace, names)
        self._delete_applications(namespace)

    def _faults(self, namespace: str, names: set[str]) -> list[str]:
        faults = []
        applications = self._api.list(f"{API}/namespaces/{namespace}/applications")
        plans = [p["spec"] for p in self._api.list(f"{API}/namespaces/{namespace}/deploymentplans")]
        if {a["metadata"]["name"] for a in applications} != names:
            faults.append("applications were lost")
        waiting = sum(a["status"]["phase"] == "Waiting" for a in applications)
        drones = [plan["drone"]["node"] for plan in plans]
        if len(drones) != len(set(drones)) or len(drones) != waiting:
            faults.append(f"{waiting} applications are Waiting, {len(drones)} plans use {len(set(drones))} drones")
        expected = {(p["instance"], p.get("node")): p.get("replicas", 1) for plan in plans for p in plan["placements"]}
        actual: collections.Counter[tuple[str, str | None]] = collections.Counter()
        for pod in self._api.list(f"/api/v1/namespaces/{namespace}/pods"):
            instance = pod["metadata"]["labels"]["fractus.dev/instance"]
            node = pod["spec"].get("nodeName")
            actual[(instance, node) if (instance, node) in expected else (instance, None)] += 1
            if node is None:
                faults.append(f"{instance} is not bound")
        if actual != expected:
            faults.append(f"{actual.total()} pods exist, {sum(expected.values())} are planned")
        at_depot = min(AT_ONCE, AT_DEPOT, len(range(0, self._nodes, NODES_PER_DRONE)))
        if waiting < at_depot - 1:
            faults.append(f"{waiting} applications are Waiting, {at_depot} drones are available")
        return faults

    def _pods_planned(self) -> int:
        return sum(int(body["spec"]["replicas"]) for body in self._templates)

    def _wait_for_bound_pods(self, namespace: str, begun_s: float) -> float:
        """Wait for the pods of the example without requests to the busy API server.

        Return the seconds until all are bound.
        """
        bound_at = self._bound_at[namespace]
        wait_until(lambda: len(bound_at) >= self._pods_planned(), "bound pods", timeout_s=60, pause_s=0.01)
        return max(bound_at.values()) - begun_s

    def _apply(self, namespace: str, name: str) -> None:
        (body,) = documents("application.yaml")
        body["metadata"] = {"name": name, "namespace": namespace}
        self._api.apply(path_of(body), body)

    def _namespace(self) -> str:
        self._namespaces += 1
        name = f"bench-{self._namespaces}"
        create_namespace(self._api, name)
        # Kubernetes creates pods only when the default service account exists.
        account = f"/api/v1/namespaces/{name}/serviceaccounts/default"
        wait_until(lambda: self._api.get(account) is not None, "the service account", timeout_s=60)
        time.sleep(0.5)
        return name

    def _wait_for_phase(self, namespace: str, names: set[str], phases: set[str], pause_s: float = 0.1) -> None:
        def reached() -> bool:
            items = self._api.list(f"{API}/namespaces/{namespace}/applications", resourceVersion="0")
            return {a["metadata"]["name"] for a in items if a.get("status", {}).get("phase") in phases} == names

        wait_until(reached, f"phases of applications in {namespace}", timeout_s=180, pause_s=pause_s)

    def _delete_applications(self, namespace: str) -> None:
        """Delete the applications of a namespace, wait until their pods are removed, and delete the namespace."""
        applications = f"{API}/namespaces/{namespace}/applications"
        for body in self._api.list(applications):
            self._api.delete(f"{applications}/{body['metadata']['name']}")
        paths = (applications, f"/api/v1/namespaces/{namespace}/pods")
        wait_until(lambda: not any(map(self._api.list, paths)), "deletion", timeout_s=180, pause_s=0.2)
        self._delete_namespace(namespace)

    def _delete_namespace(self, namespace: str) -> None:
        """Delete a namespace, and wait so that the deletion does not disturb the next measurement."""
        path = f"/api/v1/namespaces/{namespace}"
        self._api.delete(path)
        wait_until(lambda: self._api.get(path) is None, "deletion of the namespace", timeout_s=180, pause_s=0.2)
        time.sleep(1.0)


def print_results(results: list[Measurement]) -> None:
    """Print the table with a row for each number of nodes."""
    headers = (
        "nodes", "first plan s", "bound p50 s", "p95 s", "Waiting s", "plain p50 s", "CPU s each", "idle %", "RSS MB",
        "peak MB", f"{AT_ONCE} at once s",
    )  # fmt: skip
    rows = [
        (
            r.nodes, r.first_plan_s, statistics.median(r.bound_s), quantile(r.bound_s, 0.95),
            statistics.median(r.waiting_s), statistics.median(r.plain_s), statistics.fmean(r.cpu_s), r.idle_percent,
            r.memory_mb, r.peak_mb, r.at_once_s,
        )
        for r in results
    ]  # fmt: skip
    print_table(headers, rows)


def run(options: argparse.Namespace, directory: Path) -> list[Measurement]:
    """Measure deployments for each number of nodes."""
    sizes = options.nodes or ((100, 1_000) if options.quick else (100, 1_000, 5_000))
    results = []
    with simulated_cluster(directory) as cluster:
        bench = Bench(cluster, Operator(cluster, directory))
        for size in sizes:
            results.append(bench.measure(size, 5 if options.quick else 11))
            print_results(results[-1:])
            cluster.check()
    return results


def main() -> int:
    arguments = parser(__doc__, quick="100 and 1,000 nodes, and fewer repetitions")
    arguments.add_argument("--nodes", type=int, nargs="+", help="growing numbers of nodes (default: 100 1000 5000)")
    arguments.add_argument("--keep", type=Path, help="keep logs in this directory")
    options = arguments.parse_args()
    with contextlib.ExitStack() as stack:
        directory = options.keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        directory.mkdir(parents=True, exist_ok=True)
        results = run(options, directory)
    print_results(results)
    last = results[-1]
    faults = [f"{r.nodes} nodes: {fault}" for r in results for fault in r.faults]
    for fault in faults:
        print(f"FAULT {fault}")
    report = Report("deploy", options)
    report.add("bound", statistics.median(last.bound_s), statistics.median(last.plain_s), nodes=last.nodes)
    report.add("first_plan", last.first_plan_s, nodes=last.nodes)
    report.add("memory", last.memory_mb, nodes=last.nodes)
    report.add("at_once", len(faults), count=AT_ONCE)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())

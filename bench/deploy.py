"""Deploying on 100 to 5,000 simulated nodes: the operator against a real API server, scheduler and kwok.

The traffic-monitoring example is applied as it stands, beside thousands of nodes elsewhere: how long until every pod is
bound, until the application is Waiting with all that was made for it, what the operator takes in CPU and memory, how soon
after its start it plans, and that 50 applications applied at once all end bound or queued. The comparator creates the same
Deployments without Fractus: what Kubernetes takes anyway.

The simulated nodes send no heartbeats while this runs: at kubelet's rate those of 5,000 would take more than the two cores that
it is meant for. The cost of nodes is in what is listed, watched, planned over and scheduled on. Their pods run a second after they
are bound, and the control plane collects its garbage a quarter as often as Go does by default; all of it holds for the comparator
as well.

Takes about a quarter of an hour; --quick, with 100 and 1,000 nodes, about four minutes. Needs no root.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import math
import os
import pathlib
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import yaml
from fractus_cluster.ports import free_port
from fractus_core.api import KINDS
from fractus_core.api.crd import crd
from fractus_runtime.kubernetes import BlockingClient, Client, Kind, KubeError, with_certificate
from loopback import LoopbackCluster, simulated_node, wait_until

EXAMPLE = pathlib.Path(__file__).parents[1] / "examples" / "traffic-monitoring"
API = "/apis/fractus.dev/v1alpha1"
SYSTEM = "fractus-system"
NODES = "fractus-nodes"
READY = {"type": "Ready", "status": "True", "reason": "Simulated", "lastTransitionTime": "2026-01-01T00:00:00Z"}
AT_DEPOT = 40
AT_ONCE = 50
SEED = 5000
NODE = {"cpu": "64", "memory": "64Gi", "pods": "500"}

Body = dict[str, Any]
PODS = Kind("v1", "Pod", "pods", namespaced=True)


class Api(BlockingClient):
    """The API server, for many threads."""

    def __init__(self, cluster: LoopbackCluster) -> None:
        self.access = with_certificate(cluster.server, cluster.ca, cluster.credential)
        super().__init__(self.access, "bench")


# -- the scene --


def documents(name: str) -> list[Body]:
    """The manifests of a file of the example."""
    return [d for d in yaml.safe_load_all((EXAMPLE / name).read_text()) if d]


def path_of(body: Body, namespace: str = "default") -> str:
    """Where the API server keeps an object of ours."""
    kind = next(k for k in KINDS if body["kind"] == k.KIND)
    scope = f"/namespaces/{namespace}" if kind.NAMESPACED else ""
    return f"{API}{scope}/{kind.PLURAL}/{body['metadata']['name']}"


def elsewhere(rng: random.Random, depot: Body) -> Body:
    """A place 5 to 100 km from the example's."""
    bearing = rng.uniform(0, 2 * math.pi)
    distance_m = math.sqrt(rng.uniform(5e3**2, 1e5**2))
    lat = depot["lat"] + distance_m * math.cos(bearing) / 111_000
    lon = depot["lon"] + distance_m * math.sin(bearing) / (111_000 * math.cos(math.radians(lat)))
    return {"lat": round(lat, 6), "lon": round(lon, 6)}


class Scene:
    """Nodes, drones and edge nodes; it only grows."""

    def __init__(self, api: Api) -> None:
        self._api = api
        self._rng = random.Random(SEED)
        self._drone = documents("drone.yaml")[0]
        (self._depot,) = documents("depot.yaml")
        self._edges = documents("edge-nodes.yaml")
        self.nodes = 0
        for name in (SYSTEM, NODES, "plain"):
            self._api.apply(
                f"/api/v1/namespaces/{name}", {"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": name}}
            )
        for body in (self._depot, *documents("zones.yaml"), *documents("policies.yaml")):
            self._api.apply(path_of(body), body)
        self._add([("cloud", f"cloud-{i}", None) for i in range(3)])
        self._add([("edge", e["metadata"]["name"], e["spec"]) for e in self._edges])

    def grow(self, nodes: int) -> None:
        """Grow to N nodes in all: up to 40 drones in the example's depot, and the rest elsewhere, one drone for five."""
        made = []
        for i in range(self.nodes, nodes):
            if i % 6 == 0:
                near = i // 6 < AT_DEPOT
                place = (
                    {"depot": self._depot["metadata"]["name"]}
                    if near
                    else {"depot": None, "home": elsewhere(self._rng, self._depot["spec"]["location"])}
                )
                made.append(("drone", f"drone-{i:05d}", {k: v for k, v in (self._drone["spec"] | place).items() if v}))
            else:
                spec = self._edges[0]["spec"] | {"location": elsewhere(self._rng, self._depot["spec"]["location"])}
                made.append(("edge", f"edge-{i:05d}", spec))
        self._add(made)

    def _add(self, made: list[tuple[str, str, Body | None]]) -> None:
        with ThreadPoolExecutor(8) as pool:
            for _ in pool.map(self._add_one, made):
                pass
        self.nodes += len(made)
        names = {name for _, name, _ in made}
        wait_until(lambda: names <= self._ready(), "nodes to be Ready", timeout_s=300, pause_s=1.0)

    def _ready(self) -> set[str]:
        return {
            n["metadata"]["name"]
            for n in self._api.list("/api/v1/nodes", resourceVersion="0")
            if any(c["type"] == "Ready" and c["status"] == "True" for c in n["status"].get("conditions", ()))
        }

    def _add_one(self, made: tuple[str, str, Body | None]) -> None:
        node_class, name, spec = made
        self._api.call("POST", "/api/v1/nodes", simulated_node(name, node_class, NODE))
        if spec is None:
            return
        kind = "Drone" if node_class == "drone" else "EdgeNode"
        body = {"apiVersion": "fractus.dev/v1alpha1", "kind": kind, "metadata": {"name": name}, "spec": spec}
        self._api.apply(path_of(body), body)
        if kind == "Drone":
            status = {"flightState": "inactive", "battery": {"remaining": 1.0}, "conditions": [READY]}
            self._api.merge(path_of(body) + "/status", {"status": status})


# -- the operator --


@dataclass
class Operator:
    """The operator as a process."""

    kubeconfig: pathlib.Path
    log: pathlib.Path
    settings: dict[str, str] = field(default_factory=dict)
    started: float = 0.0
    _process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it."""
        env = {**os.environ, "KUBECONFIG": str(self.kubeconfig), "FRACTUS_IDENTITY": "bench", **self.settings}
        env["FRACTUS_HEALTH"] = f"http://127.0.0.1:{free_port()}/healthz"
        self.started = time.monotonic()
        with self.log.open("ab") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "fractus_operator"], env=env, stdout=log, stderr=log
            )

    def stop(self) -> None:
        """End it."""
        if self._process is not None:
            self._process.send_signal(signal.SIGTERM)
            self._process.wait(30)
            self._process = None

    def cpu_s(self) -> float:
        """Seconds of CPU that it has taken."""
        assert self._process is not None
        fields = pathlib.Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def proportional_mb(self) -> float:
        """Its proportional set size."""
        assert self._process is not None
        text = pathlib.Path(f"/proc/{self._process.pid}/smaps_rollup").read_text()
        return next(int(line.split()[1]) / 1024 for line in text.splitlines() if line.startswith("Pss:"))

    def memory_mb(self, what: str = "VmRSS") -> float:
        """Resident memory, or its peak (VmHWM)."""
        assert self._process is not None
        text = pathlib.Path(f"/proc/{self._process.pid}/status").read_text()
        return next(int(line.split()[1]) / 1024 for line in text.splitlines() if line.startswith(what))


class Bound:
    """When each pod was seen to be bound, by namespace; follows the API server in a thread of its own."""

    def __init__(self, api: Api) -> None:
        self._access = api.access
        self.at: dict[str, dict[str, float]] = {}
        version = api.call("GET", "/api/v1/pods?limit=1")["metadata"]["resourceVersion"]
        threading.Thread(target=lambda: asyncio.run(self._follow(version)), daemon=True).start()

    async def _follow(self, version: str) -> None:
        async with contextlib.aclosing(Client(self._access, "bench")) as client:
            with contextlib.suppress(KubeError):
                async for type_, pod in client.watch(PODS, resource_version=version, timeout_s=3600, silence_s=600.0):
                    if type_ not in ("BOOKMARK", "DELETED") and pod.get("spec", {}).get("nodeName"):
                        seen = self.at.setdefault(pod["metadata"]["namespace"], {})
                        seen.setdefault(pod["metadata"]["name"], time.monotonic())


# -- measuring --


@dataclass
class Measured:
    """Measurements for one cluster size."""

    nodes: int
    first_plan_s: float = 0.0
    fractus_s: list[float] = field(default_factory=list)
    running_s: list[float] = field(default_factory=list)
    plain_s: list[float] = field(default_factory=list)
    cpu_per_deploy_s: float = 0.0
    idle_cpu: float = 0.0
    memory_mb: float = 0.0
    peak_mb: float = 0.0
    at_once_s: float = 0.0
    at_once_cpu_s: float = 0.0
    at_once: dict[str, int] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)


def application(name: str, namespace: str) -> Body:
    """The example's application."""
    (body,) = documents("application.yaml")
    return body | {"metadata": {"name": name, "namespace": namespace}}


class Bench:
    """Measures one number of nodes after another on one control plane."""

    def __init__(self, cluster: LoopbackCluster, directory: pathlib.Path) -> None:
        self._api = Api(cluster)
        for kind in KINDS:
            body = crd(kind)
            self._api.apply(f"/apis/apiextensions.k8s.io/v1/customresourcedefinitions/{body['metadata']['name']}", body)
        wait_until(self._kinds_served, "the kinds to be served", timeout_s=60)
        self.scene = Scene(self._api)
        self.operator = Operator(cluster.kubeconfig, directory / "operator.log")
        self._bound = Bound(self._api)
        self._count = 0
        self._templates: list[Body] = []

    def _kinds_served(self) -> bool:
        try:
            return all(self._api.get(f"{API}/{kind.PLURAL}?limit=1") is not None for kind in KINDS)
        except KubeError:
            return False

    def close(self) -> None:
        self.operator.stop()
        self._api.close()

    def measure(self, nodes: int, times: int) -> Measured:
        """Measure at N nodes."""
        self.scene.grow(nodes)
        found = Measured(self.scene.nodes)
        # Once, so that nodes have their location labels and accounts, as they have where the operator is only started again.
        self.operator.start()
        self._labelled()
        self.operator.stop()
        found.first_plan_s = self._first_plan()
        self._templates = self._deployments()
        self._quiet()
        # In turn, so that both meet the same machine.
        for _ in range(times):
            cpu = self.operator.cpu_s()
            bound_s, running_s = self._deploy()
            found.fractus_s.append(bound_s)
            found.running_s.append(running_s)
            found.cpu_per_deploy_s += (self.operator.cpu_s() - cpu) / times
            found.plain_s.append(self._plainly())
        found.idle_cpu = self._quiet()
        found.memory_mb = self.operator.memory_mb()
        self._at_once(found)
        found.peak_mb = self.operator.memory_mb("VmHWM")
        self.operator.stop()
        return found

    def _labelled(self) -> None:
        def all_labelled() -> bool:
            nodes = self._api.list("/api/v1/nodes", resourceVersion="0")
            return all(
                "fractus.dev/geohash" in n["metadata"]["labels"]
                for n in nodes
                if n["metadata"]["labels"]["fractus.dev/class"] != "cloud"
            )

        wait_until(all_labelled, "nodes to be labelled", timeout_s=300, pause_s=1.0)
        described = sum(
            len(self._api.list(f"{API}/{plural}", resourceVersion="0")) for plural in ("drones", "edgenodes")
        )
        objects = f"{API}/namespaces/{NODES}/nodegrants"
        wait_until(
            lambda: len(self._api.list(objects, resourceVersion="0")) == described,
            "nodes to have their objects",
            timeout_s=600,
            pause_s=1.0,
        )

    def _first_plan(self) -> float:
        """From the start of the operator to the plan of an application that waits for it."""
        namespace = self._namespace()
        self._api.apply(path_of(application("first", namespace), namespace), application("first", namespace))
        plan = f"{API}/namespaces/{namespace}/deploymentplans/first"
        self.operator.start()
        wait_until(lambda: self._api.get(plan) is not None, "the first plan", timeout_s=120, pause_s=0.02)
        taken = time.monotonic() - self.operator.started
        self._gone(namespace, ["first"])
        return taken

    def _quiet(self, seconds: float = 5.0) -> float:
        """Let what was begun come to rest; the share of a core that the operator takes when nothing happens."""
        time.sleep(2.0)
        before = self.operator.cpu_s()
        time.sleep(seconds)
        return (self.operator.cpu_s() - before) / seconds

    def _deploy(self) -> tuple[float, float]:
        """From apply to the last pod bound, and to the phase Waiting, with every Grant, Service and Secret."""
        namespace = self._namespace()
        began = time.monotonic()
        self._api.apply(path_of(application("traffic", namespace), namespace), application("traffic", namespace))
        taken = self._all_bound(namespace, began)
        self._phase(namespace, {"traffic"}, {"Waiting"}, pause_s=0.02)
        running = time.monotonic() - began
        if len(self._bound.at[namespace]) != self._pods():
            raise RuntimeError(f"{namespace}: {len(self._bound.at[namespace])} pods, expected {self._pods()}")
        self._gone(namespace, ["traffic"])
        return taken, running

    def _pods(self) -> int:
        return sum(int(body["spec"]["replicas"]) for body in self._templates)

    def _all_bound(self, namespace: str, began: float) -> float:
        """Seconds until every pod of the example is bound; the API server is not asked meanwhile: it has enough to do."""
        wait_until(lambda: len(self._bound.at.get(namespace, ())) >= self._pods(), "pods", timeout_s=60, pause_s=0.01)
        return max(self._bound.at[namespace].values()) - began

    def _deployments(self) -> list[Body]:
        """What the operator makes of the example."""
        namespace = self._namespace()
        self._api.apply(path_of(application("traffic", namespace), namespace), application("traffic", namespace))
        self._phase(namespace, {"traffic"}, {"Waiting"})
        made = self._api.list(f"/apis/apps/v1/namespaces/{namespace}/deployments")
        self._gone(namespace, ["traffic"])
        return made

    def _plainly(self) -> float:
        """The same Deployments, created at once by hand: from the first to the last pod bound."""
        namespace = self._namespace()
        bodies = [
            {
                "apiVersion": "apps/v1",
                "kind": "Deployment",
                "metadata": {"name": d["metadata"]["name"]},
                "spec": d["spec"],
            }
            for d in self._templates
        ]
        began = time.monotonic()
        with ThreadPoolExecutor(8) as pool:
            list(
                pool.map(
                    lambda b: self._api.call("POST", f"/apis/apps/v1/namespaces/{namespace}/deployments", b), bodies
                )
            )
        taken = self._all_bound(namespace, began)
        self._remove(namespace)
        return taken

    def _at_once(self, found: Measured) -> None:
        """Fifty applications at once: who ends bound, who waits, and whether anything was lost or made twice."""
        namespace = self._namespace()
        names = [f"app-{i:02d}" for i in range(AT_ONCE)]
        cpu = self.operator.cpu_s()
        began = time.monotonic()
        with ThreadPoolExecutor(8) as pool:
            for _ in pool.map(
                lambda n: self._api.apply(path_of(application(n, namespace), namespace), application(n, namespace)),
                names,
            ):
                pass
        self._phase(namespace, set(names), {"Waiting", "Queued"})
        found.at_once_s = max(self._bound.at[namespace].values()) - began
        found.at_once_cpu_s = self.operator.cpu_s() - cpu
        found.faults = self._audit(namespace, names, found)
        self._gone(namespace, names)

    def _audit(self, namespace: str, names: list[str], found: Measured) -> list[str]:
        faults = []
        applications = {
            a["metadata"]["name"]: a["status"] for a in self._api.list(f"{API}/namespaces/{namespace}/applications")
        }
        plans = {
            p["metadata"]["name"]: p["spec"] for p in self._api.list(f"{API}/namespaces/{namespace}/deploymentplans")
        }
        pods = self._api.list(f"/api/v1/namespaces/{namespace}/pods")
        phases = [status["phase"] for status in applications.values()]
        found.at_once = {phase: phases.count(phase) for phase in sorted(set(phases))}
        if set(applications) != set(names):
            faults.append("applications were lost")
        drones = [plan["drone"]["node"] for plan in plans.values()]
        if len(drones) != len(set(drones)) or len(drones) != found.at_once.get("Waiting", 0):
            faults.append(f"{len(drones)} plans have {len(set(drones))} drones")
        wanted = {
            (p["instance"], p.get("node")): p.get("replicas", 1) for plan in plans.values() for p in plan["placements"]
        }
        seen: dict[tuple[str, str | None], int] = {}
        for pod in pods:
            instance = pod["metadata"]["labels"]["fractus.dev/instance"]
            node = pod["spec"].get("nodeName")
            key = (instance, node) if (instance, node) in wanted else (instance, None)
            seen[key] = seen.get(key, 0) + 1
            if node is None:
                faults.append(f"{instance} is not bound")
        if seen != wanted:
            faults.append(f"{sum(seen.values())} pods for {sum(wanted.values())} planned")
        expected = min(AT_ONCE, sum(i % 6 == 0 for i in range(self.scene.nodes)), AT_DEPOT)
        if found.at_once.get("Waiting", 0) < expected - 1:
            faults.append(f"{found.at_once} with {expected} drones")
        return faults

    # -- waiting --

    def _namespace(self) -> str:
        self._count += 1
        name = f"bench-{self._count}"
        self._api.apply(
            f"/api/v1/namespaces/{name}", {"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": name}}
        )
        # Without it no pod is made.
        account = f"/api/v1/namespaces/{name}/serviceaccounts/default"
        wait_until(lambda: self._api.get(account) is not None, "the service account", timeout_s=60)
        time.sleep(0.5)
        return name

    def _phase(self, namespace: str, names: set[str], phases: set[str], pause_s: float = 0.1) -> None:
        def reached() -> bool:
            items = self._api.list(f"{API}/namespaces/{namespace}/applications", resourceVersion="0")
            there = {a["metadata"]["name"] for a in items if a.get("status", {}).get("phase") in phases}
            return there == names

        wait_until(reached, f"{len(names)} applications of {namespace}", timeout_s=180, pause_s=pause_s)

    def _gone(self, namespace: str, names: Iterable[str]) -> None:
        """Delete applications, and wait until nothing is left of them."""
        for name in names:
            self._api.delete(f"{API}/namespaces/{namespace}/applications/{name}")
        collections = (f"{API}/namespaces/{namespace}/applications", f"/api/v1/namespaces/{namespace}/pods")
        wait_until(lambda: not any(self._api.list(c) for c in collections), "deletion", timeout_s=180, pause_s=0.2)
        self._remove(namespace)

    def _remove(self, namespace: str) -> None:
        """Delete a namespace, and let the control plane come to rest: what one run leaves is no load on the next."""
        path = f"/api/v1/namespaces/{namespace}"
        self._api.delete(path)
        wait_until(lambda: self._api.get(path) is None, "the namespace to go", timeout_s=180, pause_s=0.2)
        time.sleep(1.0)


# -- reporting --


def table(rows: Iterable[Measured]) -> Iterator[str]:
    """The figures as text."""
    yield f"{'nodes':>6} {'first plan':>10} {'bound p50':>10} {'p95':>7} {'running':>9} {'plain p50':>10} {'CPU each':>9} {'idle':>6} {'RSS MB':>7} {'peak MB':>8} {'50 at once':>11} {'CPU':>6}  ended"
    for r in rows:
        p95 = sorted(r.fractus_s)[max(0, math.ceil(0.95 * len(r.fractus_s)) - 1)]
        yield (
            f"{r.nodes:6d} {r.first_plan_s:8.2f} s {statistics.median(r.fractus_s):8.3f} s {p95:6.2f}s"
            f" {statistics.median(r.running_s):7.3f} s"
            f" {statistics.median(r.plain_s):8.3f} s {r.cpu_per_deploy_s:7.2f} s {r.idle_cpu:6.1%} {r.memory_mb:7.0f}"
            f" {r.peak_mb:8.0f} {r.at_once_s:9.1f} s {r.at_once_cpu_s:5.1f}s  {r.at_once}"
        )


def claims(rows: list[Measured]) -> list[dict[str, object]]:
    """What must hold at the largest number of nodes, and whether it does."""
    last = rows[-1]
    bound = statistics.median(last.fractus_s)
    plain = statistics.median(last.plain_s)
    faults = [f"{r.nodes} nodes: {fault}" for r in rows for fault in r.faults]
    for fault in faults:
        print(f"FAULT {fault}")

    def claim(
        name: str, ours: float, theirs: float | None, unit: str, target: str, *, holds: bool
    ) -> dict[str, object]:
        ratio = theirs / ours if theirs and ours else None
        return {
            "name": name,
            "ours": ours,
            "theirs": theirs,
            "unit": unit,
            "ratio": ratio,
            "target": target,
            "holds": holds,
        }

    at = f"at {last.nodes} nodes"
    return [
        claim(f"apply to all pods bound, p50 {at} (theirs: the same Deployments by hand)", bound, plain, "s", "< 0.5 s", holds=bound < 0.5),
        claim(f"operator start to first plan {at}", last.first_plan_s, None, "s", "< 5 s", holds=last.first_plan_s < 5),
        claim(f"operator memory {at}, one application after the other", last.memory_mb, None, "MB", "< 200 MB", holds=last.memory_mb < 200),
        claim(f"{AT_ONCE} applications at once: lost, doubled or unbound", float(len(faults)), None, "faults", "0", holds=not faults),
    ]  # fmt: skip


def main() -> int:
    """Run and print; 1 if a claim does not hold."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="100 and 1,000 nodes, and few repetitions")
    parser.add_argument(
        "--nodes", type=int, nargs="+", help="other numbers of nodes than 100, 1,000 and 5,000, growing"
    )
    parser.add_argument("--json", type=pathlib.Path, help="write the claims to this file")
    parser.add_argument("--keep", type=pathlib.Path, help="directory for logs, instead of one that is removed")
    arguments = parser.parse_args()
    sizes, times = ((100, 1_000), 5) if arguments.quick else ((100, 1_000, 5_000), 11)
    sizes = arguments.nodes or sizes
    with contextlib.ExitStack() as stack:
        directory = arguments.keep or pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory()))
        directory.mkdir(parents=True, exist_ok=True)
        cluster = LoopbackCluster(directory, report=print)
        stack.callback(cluster.stop)
        cluster.start()
        bench = Bench(cluster, directory)
        stack.callback(bench.close)
        rows = []
        for size in sizes:
            rows.append(bench.measure(size, times))
            print("\n".join(table(rows[-1:])), flush=True)
            cluster.check()
    found = claims(rows)
    for c in found:
        ratio = f" {c['ratio']:.2f}x" if c["ratio"] is not None else ""
        print(f"{'holds ' if c['holds'] else 'FAILS '} {c['name']}: {c['ours']:.4g} {c['unit']} ({c['target']}){ratio}")
    if arguments.json:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps({"claims": found}, indent=2) + "\n")
    return 0 if all(c["holds"] for c in found) else 1


if __name__ == "__main__":
    sys.exit(main())

"""Applications created, changed and deleted without a pause: the operator against a real API server, scheduler and kwok.

200 applications run on 1,000 simulated nodes at 100 sites. Each site has a depot, drones, edge nodes, a zone and a
policy. Three of five applications are the traffic-monitoring example, moved to their site. The remaining applications
have no driver or no drone. After all applications are created, one change per second is made for ten minutes. A change
creates or deletes an application, changes its path, memory limit or label, or changes a policy of its site. Some sites
have fewer drones than applications, so that some applications are Queued.

The requests of the operator are counted in the audit log of the API server. The operator's memory is its proportional
set size. After the last change, every application must be planned or Queued, every Grant must contain the current
policy, and no object of a deleted application may exist. Then the operator must be idle for half a minute: without a
warning and without a request that writes or is refused.

Takes about 14 minutes, or three with --quick. Needs no root. simulated_cluster.py describes the nodes.
"""

from __future__ import annotations

import collections
import contextlib
import copy
import json
import math
import random
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fractus_core.api import Application, DeploymentPlan
from fractus_runtime.kubernetes import BlockingClient, Kind
from harness import Report, cpu_s, memory_mb, parser, quantile, wait_until
from simulated_cluster import (
    API,
    Body,
    Operator,
    SimulatedCluster,
    add_node,
    create_namespace,
    documents,
    manifest,
    path_of,
    simulated_cluster,
    wait_for_prepared_nodes,
    wait_for_ready_nodes,
)  # fmt: skip

SEED = 200
CLOUD_NODES = 3
NODES_PER_SITE = 10
SITES_PER_ROW = 10
SITE_DISTANCE_DEG = 0.1
WORKERS = 8
ANSWER_TIMEOUT_S = 60.0
CONVERGE_TIMEOUT_S = 300.0
QUIET_S = 30.0
SETTLE_S = 5.0
"""Time to wait after a change for delayed writes, such as Events."""

SAMPLE_S = 2.0
SINGLE_CHANGES = 5
"""Number of changes of each kind that are made before the load, to count the requests for one change."""

EXAMPLES = ("application.yaml", "passenger-only.yaml", None)
"""Manifests of the example from which applications are created. None: application.yaml without its drone components."""

_MIX = (0, 0, 1, 0, 2)
_PLANS = Kind("fractus.dev/v1alpha1", DeploymentPlan.KIND, DeploymentPlan.PLURAL, namespaced=True)
_APPLICATIONS = Kind("fractus.dev/v1alpha1", Application.KIND, Application.PLURAL, namespaced=True)

Key = tuple[str, str]
"""Namespace and name of an application."""


def key_of(body: Body) -> Key:
    """Return namespace and name of an object."""
    return body["metadata"]["namespace"], body["metadata"]["name"]


def moved(body: Any, lat: float, lon: float) -> Any:
    """Return a copy of a manifest with every position moved by some degrees."""
    if isinstance(body, list):
        return [moved(each, lat, lon) for each in body]
    if not isinstance(body, dict):
        return body
    copied = {name: moved(value, lat, lon) for name, value in body.items()}
    if "lat" in copied and "lon" in copied:
        copied |= {"lat": round(copied["lat"] + lat, 6), "lon": round(copied["lon"] + lon, 6)}
    return copied


@dataclass(frozen=True)
class Site:
    """A place with a depot, drones and edge nodes, far from all other sites."""

    number: int

    @property
    def depot(self) -> str:
        return f"depot-{self.number}"

    def move(self, body: Any) -> Any:
        """Return a manifest of the example with its positions moved to the site."""
        row, column = divmod(self.number, SITES_PER_ROW)
        return moved(body, row * SITE_DISTANCE_DEG, column * SITE_DISTANCE_DEG)

    def objects(self) -> Iterator[Body]:
        """Return depot, zone and policy."""
        (depot,) = documents("depot.yaml")
        yield self.move(depot) | {"metadata": {"name": self.depot}}
        area = {"circle": {"center": depot["spec"]["location"], "radius": 1000}}
        yield manifest("Zone", f"zone-{self.number}", self.move({"area": area}))
        yield self.policy(60)

    def policy(self, upper_m: float) -> Body:
        """Return the policy that limits the altitude."""
        selector = {"zones": [f"zone-{self.number}"]}
        limit = {"type": "LimitControl", "kind": "altitude", "upperLimit": upper_m, "action": "enforce"}
        return manifest("Policy", f"altitude-{self.number}", {**limit, "selector": selector})

    def nodes(self) -> Iterator[tuple[str, str, Body]]:
        """Yield class, name and spec of each node: drones, the edge nodes of the example, and more nodes near these."""
        rng = random.Random(SEED + self.number)
        drone = documents("drone.yaml")[0]["spec"]
        edges = documents("edge-nodes.yaml")
        drones = 2 - self.number % 2
        for i in range(NODES_PER_SITE):
            name = f"site-{self.number}-{i}"
            if i < drones:
                yield "drone", f"drone-{name}", self.move(drone) | {"depot": self.depot}
                continue
            spec = copy.deepcopy(edges[min(i - drones, len(edges) - 1)]["spec"])
            if i - drones >= len(edges):
                spec = moved(spec, rng.uniform(-0.01, 0.01), rng.uniform(-0.01, 0.01))
            yield "edge", f"edge-{name}", self.move(spec)


class Slot:
    """A fixed application name. The application with this name is created, changed, deleted and created again.

    Attributes:
        body: Applied manifest. None if the application does not exist.
    """

    def __init__(self, number: int, site: Site) -> None:
        self.key: Key = (f"team-{number % 10}", f"app-{number:03d}")
        self.site = site
        self.busy = False
        self.body: Body | None = None
        self._example = EXAMPLES[_MIX[number % len(_MIX)]]

    @property
    def path(self) -> str:
        namespace, name = self.key
        return f"{API}/namespaces/{namespace}/applications/{name}"

    @property
    def waypoints(self) -> list[Body]:
        """Positions that the driver or the system flies to."""
        assert self.body is not None
        for component in self.body["spec"]["components"]:
            if component.get("controlPoints"):
                return list(component["controlPoints"][0]["path"])
            if component.get("pointsOfInterest"):
                return list(component["pointsOfInterest"]["points"])
        return []

    def manifest(self) -> Body:
        """Return the initial manifest of the application."""
        namespace, name = self.key
        (body,) = documents(self._example or "application.yaml")
        body = self.site.move(body) | {"metadata": {"name": name, "namespace": namespace}}
        if self._example is None:
            body["spec"]["components"] = [c for c in body["spec"]["components"] if c["placement"] in {"edge", "cloud"}]
            for component in body["spec"]["components"]:
                component.pop("ingress", None)
                component.pop("egress", None)
        for component in body["spec"]["components"]:
            for point in component.get("controlPoints", ()):
                point["point"] = {"depot": self.site.depot}
        return body


class Scene:
    """Creates the sites, their nodes, and the namespaces of applications."""

    def __init__(self, api: BlockingClient, nodes: int, applications: int) -> None:
        self.sites = [Site(i) for i in range(nodes // NODES_PER_SITE)]
        self.slots = [Slot(i, self.sites[i % len(self.sites)]) for i in range(applications)]
        for name in {slot.key[0] for slot in self.slots}:
            create_namespace(api, name)
        bodies = [body for site in self.sites for body in site.objects()]
        all_nodes = [node for site in self.sites for node in site.nodes()]
        with ThreadPoolExecutor(WORKERS) as pool:
            list(pool.map(lambda body: api.apply(path_of(body), body), bodies))
            list(pool.map(lambda node: add_node(api, *node), all_nodes))
            list(pool.map(lambda i: add_node(api, "cloud", f"cloud-{i}", None), range(CLOUD_NODES)))
        wait_for_ready_nodes(api)


class Observed:
    """Applications and plans on the API server, updated in another thread."""

    def __init__(self, cluster: SimulatedCluster) -> None:
        self._changed = threading.Condition()
        self.applications: dict[Key, Body] = {}
        self.plans: dict[Key, Body] = {}
        cluster.watch(
            {
                _APPLICATIONS: lambda type_, body: self._update(self.applications, type_, body),
                _PLANS: lambda type_, body: self._update(self.plans, type_, body),
            }
        )

    def _update(self, objects: dict[Key, Body], type_: str, body: Body) -> None:
        with self._changed:
            objects[key_of(body)] = body
            if type_ == "DELETED":
                del objects[key_of(body)]
            self._changed.notify_all()

    def wait(self, condition: Callable[[], bool]) -> bool:
        """Wait until a condition is true. Return False after the timeout."""
        with self._changed:
            return self._changed.wait_for(condition, ANSWER_TIMEOUT_S)

    def answered(self, body: Body) -> bool:
        """Return True if the applied version of an application has a plan, or a condition that explains why not."""
        metadata = body["metadata"]
        plan = self.plans.get(key_of(body))
        if plan is not None:
            owned = plan["metadata"]["ownerReferences"][0]["uid"] == metadata["uid"]
            if owned and plan["spec"].get("applicationGeneration", 0) >= metadata["generation"]:
                return True
        present = self.applications.get(key_of(body))
        if present is None or present["metadata"]["uid"] != metadata["uid"]:
            return False
        status = present.get("status") or {}
        current = status.get("observedGeneration", 0) >= metadata["generation"]
        return current and any(c["type"] == "Planned" and c["status"] == "False" for c in status.get("conditions", ()))


def read_requests(log: Path, since: datetime) -> list[Body]:
    """Return the operator's requests since a time from the audit log, without duplicates."""
    events: dict[str, Body] = {}
    with log.open() as lines:
        for line in lines:
            # The API server may still be writing the last line.
            with contextlib.suppress(ValueError):
                event = json.loads(line)
                if since <= datetime.fromisoformat(event["requestReceivedTimestamp"]):
                    events[event["auditID"]] = event
    return list(events.values())


def request_name(event: Body) -> str:
    """Return verb and resource of a request."""
    reference = event.get("objectRef") or {}
    resource = reference.get("resource", event["requestURI"].partition("?")[0])
    subresource = reference.get("subresource")
    return f"{event['verb']} {resource}{'/' + subresource if subresource else ''}"


def without_upkeep(events: list[Body]) -> collections.Counter[str]:
    """Count requests by name. Watches and Lease requests are omitted, because an idle operator also sends them."""
    names = (request_name(event) for event in events if event["verb"] != "watch")
    return collections.Counter(name for name in names if not name.endswith(" leases"))


class Load:
    """Changes applications, and measures the time until the operator has processed each change.

    Attributes:
        answers_s: Seconds until each change was processed, by kind of change. NaN if the change needs no new plan.
        faults: Changes that failed or were not processed in time.
    """

    def __init__(self, api: BlockingClient, observed: Observed, scene: Scene) -> None:
        self._api = api
        self._observed = observed
        self._scene = scene
        self._rng = random.Random(SEED)
        self._lock = threading.Lock()
        self._limits: dict[Site, float] = {}
        self.answers_s: dict[str, list[float]] = collections.defaultdict(list)
        self.faults: list[str] = []

    def create_all(self) -> None:
        """Create every application, a few at a time."""
        with ThreadPoolExecutor(WORKERS) as pool:
            list(pool.map(lambda slot: self._attempt(slot, self.create), self._scene.slots))

    def run(self, duration_s: float, period_s: float) -> None:
        """Start one change per period, even if earlier changes are still in progress."""
        begun_s = time.monotonic()
        with ThreadPoolExecutor(2 * WORKERS) as pool:
            for i in range(math.ceil(duration_s / period_s)):
                time.sleep(max(begun_s + i * period_s - time.monotonic(), 0))
                idle = [slot for slot in self._scene.slots if not slot.busy]
                if not idle:
                    continue
                slot = self._rng.choice(idle)
                slot.busy = True
                pool.submit(self._attempt, slot, self._choose(slot))

    def _choose(self, slot: Slot) -> Callable[[Slot], None]:
        if slot.body is None:
            return self.create
        kinds: tuple[Callable[[Slot], None], ...] = (self.path, self.limit, self.label, self.policy, self.delete)
        return self._rng.choices(kinds, (30, 20, 15, 10, 25))[0]

    def _attempt(self, slot: Slot, change: Callable[[Slot], None]) -> None:
        try:
            change(slot)
        except Exception as error:  # a failed change is recorded and must not stop later changes
            self.faults.append(f"{slot.key[1]}: {change.__name__}: {type(error).__name__}: {error}")
        finally:
            slot.busy = False

    def create(self, slot: Slot) -> None:
        """Create the application."""
        slot.body = slot.manifest()
        self._apply(slot, "create")

    def path(self, slot: Slot) -> None:
        """Change the altitude of a waypoint, or a memory limit if the application has no waypoints."""
        if not slot.waypoints:
            self.limit(slot)
            return
        waypoint = self._rng.choice(slot.waypoints)
        waypoint["alt"] = 20 + (waypoint["alt"] - 20 + self._rng.randint(1, 20)) % 21
        self._apply(slot, "path")

    def limit(self, slot: Slot) -> None:
        """Change the memory limit of a component."""
        assert slot.body is not None
        component = self._rng.choice(slot.body["spec"]["components"])
        component["container"]["resources"]["limits"]["memory"] = f"{self._rng.randint(100, 400)}Mi"
        self._apply(slot, "limit")

    def label(self, slot: Slot) -> None:
        """Change a label. This needs no new plan."""
        assert slot.body is not None
        slot.body["metadata"]["labels"] = {"tier": f"t{self._rng.randint(0, 10**6)}"}
        self._api.apply(slot.path, slot.body)
        self.answers_s["label"].append(math.nan)

    def policy(self, slot: Slot) -> None:
        """Change the altitude limit of the site. This needs no new plan."""
        with self._lock:
            limit = self._limits[slot.site] = 50.0 + (self._limits.get(slot.site, 60.0) - 50.0 + 1) % 30
            body = slot.site.policy(limit)
            self._api.apply(path_of(body), body)
        self.answers_s["policy"].append(math.nan)

    def delete(self, slot: Slot) -> None:
        """Delete the application, and wait until it is removed."""
        begun_s = time.monotonic()
        self._api.delete(slot.path)
        if not self._observed.wait(lambda: slot.key not in self._observed.applications):
            raise TimeoutError("not removed in time")
        slot.body = None
        self.answers_s["delete"].append(time.monotonic() - begun_s)

    def _apply(self, slot: Slot, change: str) -> None:
        begun_s = time.monotonic()
        applied = self._api.apply(slot.path, slot.body or {})
        if not self._observed.wait(lambda: self._observed.answered(applied)):
            raise TimeoutError("no plan in time, and no condition that explains it")
        self.answers_s[change].append(time.monotonic() - begun_s)

    def differences(self) -> list[str]:
        """Return every difference between the cluster and the applied applications and policies."""
        expected = {slot.key for slot in self._scene.slots if slot.body is not None}
        different = [f"{name} was lost" for _, name in expected - self._observed.applications.keys()]
        for key, body in self._observed.applications.items():
            status = body.get("status") or {}
            phase = status.get("phase")
            planned = key in self._observed.plans and phase in {"Waiting", "Running"}
            queued = phase == "Queued" and any(c["reason"] == "DroneBusy" for c in status["conditions"])
            if key not in expected or not (planned or queued) or not self._observed.answered(body):
                different.append(f"{key[1]} is {phase}: {status.get('message')}")
        drones = [p["spec"]["drone"] for p in self._observed.plans.values() if p["spec"].get("drone")]
        owners = collections.Counter(drone["node"] for drone in drones if not drone.get("sharedWith"))
        different += [f"{node} has {n} applications" for node, n in owners.items() if n > 1]
        return different + self._wrong_children() + self._wrong_pods()

    def _wrong_children(self) -> list[str]:
        """Return Grants and links of deleted applications, and Grants with an old policy."""
        wrong = []
        uids = {body["metadata"]["uid"] for body in self._observed.applications.values()}
        for plural in ("grants", "directlinks"):
            for body in self._api.list(f"{API}/{plural}", resourceVersion="0"):
                name = f"{plural}/{body['metadata']['name']}"
                if body["spec"]["application"]["uid"] not in uids:
                    wrong.append(f"{name} has no application")
                for policy in body["spec"].get("policies", ()):
                    site = Site(int(policy["name"].rpartition("-")[2]))
                    if policy["spec"]["upperLimit"] != self._limits.get(site, 60.0):
                        wrong.append(f"{name} has an old {policy['name']}")
        return wrong

    def _wrong_pods(self) -> list[str]:
        """Return instances whose number of bound pods differs from the plan."""
        planned: collections.Counter[tuple[str, str]] = collections.Counter()
        for (namespace, _), plan in self._observed.plans.items():
            for placed in plan["spec"]["placements"]:
                planned[namespace, placed["instance"]] += placed.get("replicas", 1)
        bound = collections.Counter(
            (p["metadata"]["namespace"], p["metadata"]["labels"]["fractus.dev/instance"])
            for p in self._api.list("/api/v1/pods", resourceVersion="0")
            if p["spec"].get("nodeName")
        )
        wrong = sorted(key for key in planned | bound if planned[key] != bound[key])
        return [f"{key[1]} has {bound[key]} pods on nodes, not {planned[key]}" for key in wrong]


@dataclass
class Results:
    """Results of one run."""

    nodes: int
    applications: int
    changes: int = 0
    requests: collections.Counter[str] = field(default_factory=collections.Counter)
    refused: collections.Counter[str] = field(default_factory=collections.Counter)
    single: dict[str, float] = field(default_factory=dict)
    at_rest: collections.Counter[str] = field(default_factory=collections.Counter)
    memory_mb: list[float] = field(default_factory=list)
    lasting: list[str] = field(default_factory=list)

    @property
    def memory_growth(self) -> float:
        """Mean memory in the last third of the run, divided by the mean memory in the first third."""
        third = max(len(self.memory_mb) // 3, 1)
        return statistics.fmean(self.memory_mb[-third:]) / statistics.fmean(self.memory_mb[:third])


class Bench:
    """The operator under load."""

    def __init__(self, cluster: SimulatedCluster, directory: Path, nodes: int, applications: int) -> None:
        self._api = cluster.admin
        self._audit_log = cluster.audit_log
        self._scene = Scene(self._api, nodes, applications)
        self._log = directory / "operator.log"
        self._operator = Operator(cluster, directory)
        self.load = Load(self._api, Observed(cluster), self._scene)
        self.results = Results(nodes, applications)

    def measure(self, duration_s: float, period_s: float) -> None:
        """Create all applications, change them for some time, wait until the cluster is at rest, and examine it."""
        results = self.results
        with self._operator:
            self._operator.start_operator()
            begun_s = time.monotonic()
            self.load.create_all()
            self._converge()
            taken_s = time.monotonic() - begun_s
            print(f"{results.applications} applications created and running after {taken_s:.0f} s", flush=True)
            # The operator may still be preparing nodes. Its requests for this must not count as cost of changes.
            wait_for_prepared_nodes(self._api)
            self._count_single_changes()
            self.load.answers_s.clear()
            since = datetime.now(UTC)
            before_s = cpu_s(self._operator.pid)
            begun_s = time.monotonic()
            self._run(duration_s, period_s)
            taken_s = time.monotonic() - begun_s
            cpu = (cpu_s(self._operator.pid) - before_s) / taken_s
            converged_s = self._converge()
            for event in read_requests(self._audit_log, since):
                results.requests[request_name(event)] += 1
                code = (event.get("responseStatus") or {}).get("code", 0)
                if code >= 400:
                    results.refused[f"{code} {request_name(event)}"] += 1
            results.changes = sum(map(len, self.load.answers_s.values()))
            print(
                f"{results.changes} changes in {taken_s:.0f} s with {cpu:.0%} of a core; at rest {converged_s:.0f} s later"
            )
            self._observe_rest()
            results.lasting += self.load.differences()

    def _run(self, duration_s: float, period_s: float) -> None:
        """Make changes, and sample the memory of the operator in another thread."""
        ended = threading.Event()

        def sample() -> None:
            while not ended.wait(SAMPLE_S):
                self.results.memory_mb.append(memory_mb(self._operator.pid)["proportional"])

        sampling = threading.Thread(target=sample)
        sampling.start()
        try:
            self.load.run(duration_s, period_s)
        finally:
            ended.set()
            sampling.join()

    def _converge(self) -> float:
        """Wait until the cluster matches the applied objects, or until the timeout.

        Return the waiting time in seconds.
        """
        begun_s = time.monotonic()
        try:
            wait_until(lambda: not self.load.differences(), "rest", timeout_s=CONVERGE_TIMEOUT_S, pause_s=1.0)
        except TimeoutError as error:
            # `measure` reports the differences that still exist at its end.
            print(f"{error}: {', '.join(self.load.differences()[:5])}", flush=True)
        return time.monotonic() - begun_s

    def _count_single_changes(self) -> None:
        """Count the requests for each kind of change. No other changes are made at the same time."""
        # Each of these applications is the whole example. No other application of its site waits for its drone.
        load = self.load
        slots = self._scene.slots[:: 2 * len(_MIX)][:SINGLE_CHANGES]
        for change in (load.path, load.limit, load.label, load.policy, load.delete, load.create):
            since = datetime.now(UTC)
            for slot in slots:
                change(slot)
            self._converge()
            time.sleep(SETTLE_S)
            requests = without_upkeep(read_requests(self._audit_log, since))
            self.results.single[change.__name__] = requests.total() / len(slots)
            print(f"{change.__name__}: {requests.total() / len(slots):.1f} requests: {listed(requests, len(slots))}")

    def _observe_rest(self) -> None:
        """Count requests and warnings of an idle operator."""
        print(f"warnings: {dict(self._warnings(0)[0]) or 'none'}")
        time.sleep(SETTLE_S)
        offset = self._log.stat().st_size
        since = datetime.now(UTC)
        time.sleep(QUIET_S)
        self.results.at_rest = without_upkeep(read_requests(self._audit_log, since))
        self.results.lasting += [f"still logged: {text} ({n} times)" for text, n in self._warnings(offset)[0].items()]
        self.results.lasting += [f"bug: {error}" for error in self._warnings(0)[1]]

    def _warnings(self, offset: int) -> tuple[collections.Counter[str], list[str]]:
        """Return warnings of the operator's log without their details, and the last lines of its tracebacks."""
        warnings: collections.Counter[str] = collections.Counter()
        bugs = []
        with self._log.open() as lines:
            lines.seek(offset)
            for line in lines:
                try:
                    record = json.loads(line)
                except ValueError:
                    bugs.append(line.strip())
                    continue
                if record["level"] not in {"DEBUG", "INFO"}:
                    text = record["message"].partition("(")[0].strip()
                    warnings[f"{record['level']} {record['logger']}: {text}"] += 1
                if "exception" in record:
                    bugs.append(f"{record['message']}: {record['exception'].strip().splitlines()[-1]}")
        return warnings, bugs


def listed(counts: collections.Counter[str], divisor: int) -> str:
    """Return counts divided by a number, the most frequent first."""
    return ", ".join(f"{name} {n / divisor:.1f}" for name, n in counts.most_common())


def print_results(results: Results, load: Load) -> None:
    """Print results for which there is no claim."""
    for change, values in sorted(load.answers_s.items()):
        answered = [value for value in values if not math.isnan(value)]
        times = f", p50 {statistics.median(answered):.2f} s, p99 {quantile(answered, 0.99):.2f} s" if answered else ""
        print(f"{change}: {len(values)} changes{times}; {results.single.get(change, math.nan):.1f} requests each")
    print(f"requests per change: {listed(results.requests, max(results.changes, 1))}")
    print(f"refused requests: {dict(results.refused) or 'none'}")
    print(f"requests at rest in {QUIET_S:.0f} s: {dict(results.at_rest) or 'none'}")
    print(f"peak memory: {max(results.memory_mb, default=math.nan):.1f} MB")
    for text in (*load.faults[:20], *results.lasting[:20]):
        print(f"FAULT {text}")


def main() -> int:
    arguments = parser(__doc__, quick="100 nodes, 20 applications, one minute")
    arguments.add_argument("--nodes", type=int, help="number of nodes (default: 1000)")
    arguments.add_argument("--applications", type=int, help="number of applications (default: 200)")
    arguments.add_argument("--minutes", type=float, help="duration of the changes in minutes (default: 10)")
    arguments.add_argument("--period", type=float, default=1.0, help="seconds between two changes")
    arguments.add_argument("--keep", type=Path, help="keep logs in this directory")
    options = arguments.parse_args()
    nodes = options.nodes or (100 if options.quick else 1_000)
    applications = options.applications or (20 if options.quick else 200)
    minutes = options.minutes or (1.0 if options.quick else 10.0)
    with contextlib.ExitStack() as stack:
        directory = options.keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        directory.mkdir(parents=True, exist_ok=True)
        cluster = stack.enter_context(simulated_cluster(directory, audit=True))
        bench = Bench(cluster, directory, nodes, applications)
        bench.measure(60.0 * minutes, options.period)
        cluster.check()
    results = bench.results
    load = bench.load
    print_results(results, load)
    answers_s = [value for change in ("create", "path", "limit") for value in load.answers_s.get(change, ())]
    costliest = max(results.single, key=lambda change: results.single[change])
    report = Report("load", options)
    report.add("lasting", len(results.lasting), applications=applications, nodes=nodes)
    report.add("faults", len(load.faults))
    report.add("growth", results.memory_growth)
    report.add("requests", results.requests.total() / max(results.changes, 1))
    report.add("costliest", results.single[costliest], change=costliest)
    report.add("rest", results.at_rest.total())
    report.add("answer", statistics.median(answers_s))
    report.add("answer_tail", quantile(answers_s, 0.99))
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())

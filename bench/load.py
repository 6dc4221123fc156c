"""Applications created, changed and deleted without a pause: the operator against a real API server, scheduler and kwok.

200 applications on 1,000 simulated nodes at 100 places, each place with a depot, drones, edge nodes, a zone and a policy. Three in
five are the traffic-monitoring example at their place, the others have no driver or no drone at all. All are created, then for ten
minutes one a second is created, given another path, limit of memory, or label, gets another policy, or is deleted. Some places have
fewer drones than applications that want one: those are Queued.

What the operator asks of the API server is counted by the server's own audit log, its memory by the kernel (proportional set size).
Whether errors stay is looked at once nothing changes any more: every application planned or Queued, every Grant as its
policy says, nothing left of what was deleted, and half a minute without a warning, a refused request, or any write at all.

The nodes send no heartbeats and their drones do not fly, as in bench/deploy.py. Takes about 14 minutes; --quick, with 100 nodes
and 20 applications, about three. Needs no root.
"""

from __future__ import annotations

import argparse
import asyncio
import collections
import contextlib
import copy
import json
import math
import pathlib
import random
import signal
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from deploy import API, NODE, NODES, READY, SYSTEM, Api, Body, Operator, documents, path_of
from fractus_cluster.errors import ClusterError
from fractus_core.api import KINDS, Application, DeploymentPlan
from fractus_core.api.crd import crd
from fractus_runtime.kubernetes import Client, Kind, KubeError
from loopback import LoopbackCluster, simulated_node, wait_until

USER = "fractus-operator"
SEED = 200
CLOUD_NODES = 3
NODES_PER_SITE = 10
SITES_PER_ROW = 10
APART_DEG = 0.1
WORKERS = 8
ANSWER_TIMEOUT_S = 60.0
CONVERGE_TIMEOUT_S = 300.0
QUIET_S = 30.0
SETTLE_S = 5.0
"""For what follows once all is there, such as Events."""
SAMPLE_S = 2.0
ALONE = 5
"""How often each change is made while nothing else happens, to count what it costs."""
MAX_REQUESTS = 40
MAX_GROWTH = 1.10

EXAMPLES = ("application.yaml", "passenger-only.yaml", None)
"""The examples that applications are made of; None: application.yaml without what flies."""
_MIX = (0, 0, 1, 0, 2)
_PLANS = Kind("fractus.dev/v1alpha1", DeploymentPlan.KIND, DeploymentPlan.PLURAL, namespaced=True)
_APPLICATIONS = Kind("fractus.dev/v1alpha1", Application.KIND, Application.PLURAL, namespaced=True)

Key = tuple[str, str]


# -- the scene --


def moved(body: Any, lat: float, lon: float) -> Any:
    """A copy of manifest parts with every place moved by some degrees."""
    if isinstance(body, dict):
        found = {name: moved(value, lat, lon) for name, value in body.items()}
        if "lat" in found and "lon" in found:
            found |= {"lat": round(found["lat"] + lat, 6), "lon": round(found["lon"] + lon, 6)}
        return found
    return [moved(each, lat, lon) for each in body] if isinstance(body, list) else body


@dataclass(frozen=True)
class Site:
    """A place with a depot, drones and edge nodes, far from all others."""

    number: int

    @property
    def depot(self) -> str:
        return f"depot-{self.number}"

    @property
    def policy(self) -> str:
        return f"altitude-{self.number}"

    def place(self, body: Any) -> Any:
        """What the example has at its own place, here."""
        row, column = divmod(self.number, SITES_PER_ROW)
        return moved(body, row * APART_DEG, column * APART_DEG)

    def objects(self) -> Iterator[Body]:
        """Its depot, zone and policy."""
        (depot,) = documents("depot.yaml")
        yield self.place(depot) | {"metadata": {"name": self.depot}}
        area = {"circle": {"center": depot["spec"]["location"], "radius": 1000}}
        yield ours("Zone", f"zone-{self.number}", self.place({"area": area}))
        yield self.limit(60)

    def limit(self, upper_m: float) -> Body:
        """Its policy."""
        spec = {"type": "LimitControl", "kind": "altitude", "upperLimit": upper_m, "action": "enforce"}
        return ours("Policy", self.policy, spec | {"selector": {"zones": [f"zone-{self.number}"]}})

    def nodes(self) -> Iterator[tuple[str, str, Body]]:
        """Class, name and spec of its nodes: one drone or two, the example's edge nodes, and others about."""
        rng = random.Random(SEED + self.number)
        drone = documents("drone.yaml")[0]["spec"]
        edges = documents("edge-nodes.yaml")
        drones = 2 - self.number % 2
        for i in range(NODES_PER_SITE):
            name = f"site-{self.number}-{i}"
            if i < drones:
                yield "drone", f"drone-{name}", self.place(drone) | {"depot": self.depot}
            else:
                spec = copy.deepcopy(edges[min(i - drones, len(edges) - 1)]["spec"])
                if i - drones >= len(edges):
                    spec = moved(spec, rng.uniform(-0.01, 0.01), rng.uniform(-0.01, 0.01))
                yield "edge", f"edge-{name}", self.place(spec)


def ours(kind: str, name: str, spec: Body) -> Body:
    """An object of a kind of Fractus."""
    return {"apiVersion": "fractus.dev/v1alpha1", "kind": kind, "metadata": {"name": name}, "spec": spec}


class Slot:
    """A name under which an application comes, changes and goes."""

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
    def flown(self) -> list[Body]:
        """The positions that its driver or the system flies to."""
        assert self.body is not None
        for component in self.body["spec"]["components"]:
            if component.get("controlPoints"):
                return list(component["controlPoints"][0]["path"])
            if component.get("pointsOfInterest"):
                return list(component["pointsOfInterest"]["points"])
        return []

    def manifest(self) -> Body:
        """Its application as it is first applied."""
        namespace, name = self.key
        (body,) = documents(self._example or EXAMPLES[0] or "")
        body = self.site.place(body) | {"metadata": {"name": name, "namespace": namespace}}
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
    """Places with their nodes, and the namespaces of applications."""

    def __init__(self, api: Api, nodes: int, applications: int) -> None:
        self._api = api
        self.sites = [Site(i) for i in range(nodes // NODES_PER_SITE)]
        self.slots = [Slot(i, self.sites[i % len(self.sites)]) for i in range(applications)]
        for name in {SYSTEM, NODES, *(slot.key[0] for slot in self.slots)}:
            body = {"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": name}}
            api.apply(f"/api/v1/namespaces/{name}", body)
        made = [("cloud", f"cloud-{i}", None) for i in range(CLOUD_NODES)]
        with ThreadPoolExecutor(WORKERS) as pool:
            list(pool.map(lambda body: api.apply(path_of(body), body), [o for s in self.sites for o in s.objects()]))
            list(pool.map(lambda node: self._add(*node), [*made, *(n for s in self.sites for n in s.nodes())]))
        wait_until(self._ready, "nodes to be Ready", timeout_s=300, pause_s=1.0)

    def _add(self, node_class: str, name: str, spec: Body | None) -> None:
        self._api.call("POST", "/api/v1/nodes", simulated_node(name, node_class, NODE))
        if spec is None:
            return
        body = ours("Drone" if node_class == "drone" else "EdgeNode", name, spec)
        self._api.apply(path_of(body), body)
        if node_class == "drone":
            status = {"flightState": "inactive", "battery": {"remaining": 1.0}, "conditions": [READY]}
            self._api.merge(path_of(body) + "/status", {"status": status})

    def _ready(self) -> bool:
        nodes = self._api.list("/api/v1/nodes", resourceVersion="0")
        conditions = [c for n in nodes for c in n["status"].get("conditions", ()) if c["type"] == "Ready"]
        return len(conditions) == len(nodes) and all(c["status"] == "True" for c in conditions)


# -- what is seen --


class Seen:
    """Applications and plans as the API server tells of them, in a thread of its own."""

    def __init__(self, api: Api) -> None:
        self._access = api.access
        self._changed = threading.Condition()
        self.applications: dict[Key, Body] = {}
        self.plans: dict[Key, Body] = {}
        version = api.call("GET", f"{API}/applications?limit=1")["metadata"]["resourceVersion"]
        threading.Thread(target=lambda: asyncio.run(self._follow(version)), daemon=True).start()

    async def _follow(self, version: str) -> None:
        async with contextlib.aclosing(Client(self._access, "bench")) as client:
            await asyncio.gather(
                self._watch(client, _APPLICATIONS, version, self.applications),
                self._watch(client, _PLANS, version, self.plans),
            )

    async def _watch(self, client: Client, kind: Kind, version: str, known: dict[Key, Body]) -> None:
        with contextlib.suppress(KubeError):
            async for type_, body in client.watch(kind, resource_version=version, timeout_s=7200, silence_s=600.0):
                if type_ == "BOOKMARK":
                    continue
                metadata = body["metadata"]
                with self._changed:
                    known[metadata["namespace"], metadata["name"]] = body
                    if type_ == "DELETED":
                        del known[metadata["namespace"], metadata["name"]]
                    self._changed.notify_all()

    def wait(self, question: Callable[[], bool], timeout_s: float) -> bool:
        """Wait until the answer is yes; False where that takes too long."""
        with self._changed:
            return self._changed.wait_for(question, timeout_s)

    def answered(self, body: Body) -> bool:
        """Whether an application as it was applied has a plan, or was told why it has none yet."""
        metadata = body["metadata"]
        key = (metadata["namespace"], metadata["name"])
        plan = self.plans.get(key)
        present = self.applications.get(key)
        if plan is not None and self._says(plan, metadata):
            return True
        if present is None or present["metadata"]["uid"] != metadata["uid"]:
            return False
        status = present.get("status") or {}
        told = status.get("observedGeneration", 0) >= metadata["generation"]
        return told and any(c["type"] == "Planned" and c["status"] == "False" for c in status.get("conditions", ()))

    def _says(self, plan: Body, metadata: Body) -> bool:
        own = plan["metadata"]["ownerReferences"][0]["uid"] == metadata["uid"]
        return own and plan["spec"].get("applicationGeneration", 0) >= metadata["generation"]


class Requests:
    """What the API server recorded of the operator's requests."""

    def __init__(self, log: pathlib.Path) -> None:
        self._log = log

    def between(self, since: datetime, until: datetime) -> list[Body]:
        """Each request that began in a span of time, once."""
        found: dict[str, Body] = {}
        with self._log.open() as lines:
            for line in lines:
                # The last one may still be written.
                with contextlib.suppress(ValueError):
                    event = json.loads(line)
                    if since <= datetime.fromisoformat(event["requestReceivedTimestamp"]) < until:
                        found[event["auditID"]] = event
        return list(found.values())


def named(event: Body) -> str:
    """Verb and resource of a request."""
    reference = event.get("objectRef") or {}
    resource = reference.get("resource", event["requestURI"].partition("?")[0])
    below = reference.get("subresource")
    return f"{event['verb']} {resource}{'/' + below if below else ''}"


def is_upkeep(event: Body) -> bool:
    """Whether a request is made at rest, too: the Lease, and watches."""
    return event["verb"] == "watch" or named(event).endswith(" leases")


# -- changing --


class Load:
    """Changes applications, and remembers how long each took to be answered.

    Attributes:
        done: Seconds from each change to its plan, by what was changed.
        faults: What was not answered in time, or not as it should be.
    """

    def __init__(self, api: Api, seen: Seen, scene: Scene) -> None:
        self._api = api
        self._seen = seen
        self._scene = scene
        self._rng = random.Random(SEED)
        self._lock = threading.Lock()
        self._limits: dict[Site, float] = {}
        self.done: dict[str, list[float]] = collections.defaultdict(list)
        self.faults: list[str] = []

    @property
    def changes(self) -> int:
        """How many were made."""
        return sum(map(len, self.done.values()))

    def create_all(self) -> None:
        """Create every application, a few at a time."""
        with ThreadPoolExecutor(WORKERS) as pool:
            list(pool.map(lambda slot: self._attempt(slot, self.create), self._scene.slots))

    def run(self, duration_s: float, period_s: float) -> None:
        """Make one change after the other, also while others are not answered yet."""
        began = time.monotonic()
        with ThreadPoolExecutor(2 * WORKERS) as pool:
            for i in range(math.ceil(duration_s / period_s)):
                time.sleep(max(began + i * period_s - time.monotonic(), 0))
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
        except Exception as error:  # a change that fails is a finding, and must not end the others
            self.faults.append(f"{slot.key[1]}: {change.__name__}: {type(error).__name__}: {error}")
        finally:
            slot.busy = False

    def create(self, slot: Slot) -> None:
        """Create it."""
        slot.body = slot.manifest()
        self._apply(slot, "create")

    def path(self, slot: Slot) -> None:
        """Let it fly elsewhere; one that does not fly gets another limit."""
        if not slot.flown:
            self.limit(slot)
            return
        place = self._rng.choice(slot.flown)
        place["alt"] = 20 + (place["alt"] - 20 + self._rng.randint(1, 20)) % 21
        self._apply(slot, "path")

    def limit(self, slot: Slot) -> None:
        """Give a component another limit of memory."""
        assert slot.body is not None
        component = self._rng.choice(slot.body["spec"]["components"])
        component["container"]["resources"]["limits"]["memory"] = f"{self._rng.randint(100, 400)}Mi"
        self._apply(slot, "limit")

    def label(self, slot: Slot) -> None:
        """Give it a label, which changes nothing of it."""
        assert slot.body is not None
        slot.body["metadata"]["labels"] = {"tier": f"t{self._rng.randint(0, 10**6)}"}
        self._api.apply(slot.path, slot.body)
        self.done["label"].append(math.nan)

    def policy(self, slot: Slot) -> None:
        """Let everything at its place fly lower or higher."""
        with self._lock:
            limit = self._limits[slot.site] = 50.0 + (self._limits.get(slot.site, 60.0) - 50.0 + 1) % 30
            body = slot.site.limit(limit)
            self._api.apply(path_of(body), body)
        self.done["policy"].append(math.nan)

    def delete(self, slot: Slot) -> None:
        """Delete it, and wait until it is gone."""
        began = time.monotonic()
        self._api.delete(slot.path)
        if not self._seen.wait(lambda: slot.key not in self._seen.applications, ANSWER_TIMEOUT_S):
            raise TimeoutError("not gone in time")
        slot.body = None
        self.done["delete"].append(time.monotonic() - began)

    def _apply(self, slot: Slot, what: str) -> None:
        began = time.monotonic()
        applied = self._api.apply(slot.path, slot.body or {})
        if not self._seen.wait(lambda: self._seen.answered(applied), ANSWER_TIMEOUT_S):
            raise TimeoutError("not planned in time, and not told why")
        self.done[what].append(time.monotonic() - began)

    # -- the end --

    def converged(self) -> bool:
        """Whether every application has what it is to have."""
        return not self.differences()

    def differences(self) -> list[str]:
        """What is not as the applications and policies say."""
        there = {slot.key: slot for slot in self._scene.slots if slot.body is not None}
        found = [f"{name} was lost" for namespace, name in there.keys() - self._seen.applications.keys()]
        for key, body in self._seen.applications.items():
            status = body.get("status") or {}
            phase = status.get("phase")
            message = status.get("message")
            planned = key in self._seen.plans and phase in {"Waiting", "Running"}
            refused = phase == "Queued" and any(c["reason"] == "DroneBusy" for c in status["conditions"])
            if key not in there or not (planned or refused) or not self._seen.answered(body):
                found.append(f"{key[1]} is {phase}: {message}")
        drones = [p["spec"]["drone"] for p in self._seen.plans.values() if p["spec"].get("drone")]
        own = [drone["node"] for drone in drones if not drone.get("sharedWith")]
        found += [f"{node} has {n} applications" for node, n in collections.Counter(own).items() if n > 1]
        return found + self._children() + self._pods()

    def _children(self) -> list[str]:
        """What is left of applications that are gone, and Grants that do not say what their policy says."""
        found = []
        uids = {body["metadata"]["uid"] for body in self._seen.applications.values()}
        for plural in ("grants", "directlinks"):
            for body in self._api.list(f"{API}/{plural}", resourceVersion="0"):
                if body["spec"]["application"]["uid"] not in uids:
                    found.append(f"{plural}/{body['metadata']['name']} has no application")
                for policy in body["spec"].get("policies", ()):
                    site = Site(int(policy["name"].rpartition("-")[2]))
                    if policy["spec"]["upperLimit"] != self._limits.get(site, 60.0):
                        found.append(f"{plural}/{body['metadata']['name']} has an old {policy['name']}")
        return found

    def _pods(self) -> list[str]:
        """Whether there is each pod that is planned, and no other."""
        planned: collections.Counter[tuple[str, str]] = collections.Counter()
        for (namespace, _), plan in self._seen.plans.items():
            for placed in plan["spec"]["placements"]:
                planned[namespace, placed["instance"]] += placed.get("replicas", 1)
        there = collections.Counter(
            (p["metadata"]["namespace"], p["metadata"]["labels"]["fractus.dev/instance"])
            for p in self._api.list("/api/v1/pods", resourceVersion="0")
            if p["spec"].get("nodeName")
        )
        wrong = {name for name in planned | there if planned[name] != there[name]}
        return [f"{n[1]} has {there[n]} pods on nodes, not {planned[n]}" for n in sorted(wrong)]


# -- measuring --


@dataclass
class Measured:
    """What was found."""

    nodes: int
    applications: int
    created_s: float = 0.0
    duration_s: float = 0.0
    changes: int = 0
    requests: collections.Counter[str] = field(default_factory=collections.Counter)
    refused: collections.Counter[str] = field(default_factory=collections.Counter)
    alone: dict[str, float] = field(default_factory=dict)
    answers: dict[str, list[float]] = field(default_factory=dict)
    memory_mb: list[float] = field(default_factory=list)
    cpu: float = 0.0
    converged_s: float = 0.0
    warnings: collections.Counter[str] = field(default_factory=collections.Counter)
    bugs: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    lasting: list[str] = field(default_factory=list)
    at_rest: collections.Counter[str] = field(default_factory=collections.Counter)

    @property
    def per_change(self) -> float:
        """Requests for each change, those at rest included."""
        return self.requests.total() / max(self.changes, 1)

    @property
    def thirds_mb(self) -> tuple[float, float]:
        """Mean memory in the first and in the last third."""
        n = max(len(self.memory_mb) // 3, 1)
        return statistics.fmean(self.memory_mb[:n]), statistics.fmean(self.memory_mb[-n:])


class Bench:
    """The operator under load."""

    def __init__(self, cluster: LoopbackCluster, directory: pathlib.Path, nodes: int, applications: int) -> None:
        self._api = Api(cluster)
        for kind in KINDS:
            body = crd(kind)
            self._api.apply(f"/apis/apiextensions.k8s.io/v1/customresourcedefinitions/{body['metadata']['name']}", body)
        wait_until(self._kinds_served, "the kinds to be served", timeout_s=60)
        self._scene = Scene(self._api, nodes, applications)
        self._log = directory / "operator.log"
        kubeconfig = cluster.kubeconfig_of(USER)
        settings = {"FRACTUS_LOG_FORMAT": "json"}
        self._operator = Operator(kubeconfig, self._log, settings)
        self._requests = Requests(cluster.audit_log)
        self._seen = Seen(self._api)
        self._load = Load(self._api, self._seen, self._scene)
        self.found = Measured(len(self._scene.sites) * NODES_PER_SITE, applications)

    def _kinds_served(self) -> bool:
        try:
            return all(self._api.get(f"{API}/{kind.PLURAL}?limit=1") is not None for kind in KINDS)
        except KubeError:
            return False

    def _nodes_furnished(self) -> bool:
        described, given = (
            sum(len(self._api.list(f"{API}/{path}", resourceVersion="0")) for path in paths)
            for paths in (("drones", "edgenodes"), (f"namespaces/{NODES}/nodegrants",))
        )
        return given == described

    def close(self) -> None:
        self._operator.stop()
        self._api.close()

    def measure(self, duration_s: float, period_s: float) -> Measured:
        """Create all, change for some time, let it come to rest, look."""
        found = self.found
        load = self._load
        self._operator.start()
        began = time.monotonic()
        load.create_all()
        self._converge()
        found.created_s = time.monotonic() - began
        print(f"{found.applications} applications created and running after {found.created_s:.0f} s", flush=True)
        # What a new node is given once is no change of an application.
        wait_until(self._nodes_furnished, "nodes to have their objects", timeout_s=600, pause_s=1.0)
        self._alone()
        load.done.clear()
        began = time.monotonic()
        cpu = self._operator.cpu_s()
        since = datetime.now(UTC)
        stop = threading.Event()
        sampling = threading.Thread(target=self._sample, args=(stop,))
        sampling.start()
        load.run(duration_s, period_s)
        stop.set()
        sampling.join()
        found.duration_s = time.monotonic() - began
        found.cpu = (self._operator.cpu_s() - cpu) / found.duration_s
        found.converged_s = self._converge()
        self._count(since, datetime.now(UTC))
        found.changes = load.changes
        found.answers = dict(load.done)
        self._rest()
        found.faults = load.faults
        found.lasting += load.differences()
        return found

    def _sample(self, stop: threading.Event) -> None:
        while not stop.wait(SAMPLE_S):
            self.found.memory_mb.append(self._operator.proportional_mb())

    def _converge(self) -> float:
        """Seconds until everything is as it is to be; goes on without that where it takes too long."""
        began = time.monotonic()
        try:
            wait_until(self._load.converged, "rest", timeout_s=CONVERGE_TIMEOUT_S, pause_s=1.0)
        except ClusterError as late:
            # What is not as it is to be at the end is named there; here it may come right yet.
            print(f"{late}: {', '.join(self._load.differences()[:5])}", flush=True)
        return time.monotonic() - began

    def _alone(self) -> None:
        """Count what one change costs, each alone."""
        # The whole example, where there is a drone for each, so that no other application takes what a deletion leaves.
        load = self._load
        slots = self._scene.slots[:: 2 * len(_MIX)][:ALONE]
        for change in (load.path, load.limit, load.label, load.policy, load.delete, load.create):
            since = datetime.now(UTC)
            for slot in slots:
                change(slot)
            self._converge()
            time.sleep(SETTLE_S)
            events = self._requests.between(since, datetime.now(UTC))
            made = collections.Counter(named(event) for event in events if not is_upkeep(event))
            self.found.alone[change.__name__] = made.total() / len(slots)
            print(f"{change.__name__}: {made.total() / len(slots):.1f} requests: {spelt(made, len(slots))}", flush=True)

    def _count(self, since: datetime, until: datetime) -> None:
        for event in self._requests.between(since, until):
            self.found.requests[named(event)] += 1
            code = (event.get("responseStatus") or {}).get("code", 0)
            if code >= 400:
                self.found.refused[f"{code} {named(event)}"] += 1

    def _rest(self) -> None:
        """Count the API requests of an idle cluster."""
        self.found.warnings, _ = self._warnings(0)
        time.sleep(SETTLE_S)
        read = self._log.stat().st_size
        since = datetime.now(UTC)
        time.sleep(QUIET_S)
        events = self._requests.between(since, datetime.now(UTC))
        self.found.at_rest = collections.Counter(named(event) for event in events if not is_upkeep(event))
        later, _ = self._warnings(read)
        self.found.lasting += [f"still logged: {message} ({n} times)" for message, n in later.items()]
        self.found.bugs = self._warnings(0)[1]

    def _warnings(self, offset: int) -> tuple[collections.Counter[str], list[str]]:
        """Warnings and errors of the operator's log by their kind, and its tracebacks."""
        found: collections.Counter[str] = collections.Counter()
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
                    found[f"{record['level']} {record['logger']}: {record['message'].partition('(')[0].strip()}"] += 1
                if "exception" in record:
                    bugs.append(f"{record['message']}: {record['exception'].strip().splitlines()[-1]}")
        return found, bugs


# -- reporting --


def spelt(counted: collections.Counter[str], of: int) -> str:
    """Counts for each of some, the most frequent first."""
    return ", ".join(f"{name} {n / of:.1f}" for name, n in counted.most_common())


def report(found: Measured) -> Iterator[str]:
    """The figures as text."""
    first, last = found.thirds_mb
    yield f"{found.changes} changes in {found.duration_s:.0f} s on {found.nodes} nodes; at rest {found.converged_s:.0f} s later"
    for what, taken in sorted(found.answers.items()):
        known = sorted(t for t in taken if not math.isnan(t))
        times = f" p50 {statistics.median(known):.2f} s, p99 {quantile(known, 0.99):.2f} s" if known else ""
        yield f"  {what}: {len(taken)}{times}; alone {found.alone.get(what, math.nan):.1f} requests each"
    yield f"  requests a change: {found.per_change:.1f} ({spelt(found.requests, max(found.changes, 1))})"
    yield f"  refused requests: {dict(found.refused) or 'none'}"
    yield f"  warnings: {dict(found.warnings) or 'none'}"
    yield f"  at rest, in {QUIET_S:.0f} s: {dict(found.at_rest) or 'no request'}"
    peak = max(found.memory_mb, default=math.nan)
    yield f"  memory {first:.1f} MB in the first third, {last:.1f} MB in the last, at most {peak:.1f} MB; {found.cpu:.0%} of a core"
    for kind, those in (("FAULT", found.faults), ("BUG", found.bugs), ("LASTING", found.lasting)):
        yield from (f"{kind} {each}" for each in those[:20])


def quantile(values: list[float], share: float) -> float:
    """The value that a share of sorted values does not exceed."""
    return values[max(math.ceil(share * len(values)) - 1, 0)]


def claims(found: Measured) -> list[dict[str, object]]:
    """What must hold, and whether it does."""
    first, last = found.thirds_mb
    answers = sorted(t for what in ("create", "path", "limit") for t in found.answers.get(what, ()))
    lasting = found.lasting + found.bugs
    most = max(found.alone.items(), key=lambda item: item[1])

    def claim(name: str, ours: float, unit: str, target: str, *, holds: bool) -> dict[str, object]:
        about = {"name": name, "ours": ours, "theirs": None, "unit": unit, "ratio": None}
        return {**about, "target": target, "holds": holds}

    at = f"{found.applications} applications on {found.nodes} nodes"
    return [
        claim(f"{at}: errors that stay, of any kind", len(lasting), "errors", "0", holds=not lasting),
        claim("changes not answered in 60 s", len(found.faults), "changes", "0", holds=not found.faults),
        claim("memory, last third over first", last / first, "times", f"<= {MAX_GROWTH}", holds=last / first <= MAX_GROWTH),
        claim("API requests a change, all counted", found.per_change, "requests", f"< {MAX_REQUESTS}", holds=found.per_change < MAX_REQUESTS),
        claim(f"API requests of the costliest change alone ({most[0]})", most[1], "requests", f"< {MAX_REQUESTS}", holds=most[1] < MAX_REQUESTS),
        claim("API requests in half a minute at rest", found.at_rest.total(), "requests", "0", holds=not found.at_rest),
        claim("from change to plan, p50", statistics.median(answers), "s", "< 1 s", holds=statistics.median(answers) < 1),
        claim("from change to plan, p99", quantile(answers, 0.99), "s", "< 5 s", holds=quantile(answers, 0.99) < 5),
    ]  # fmt: skip


def main() -> int:
    """Run and print; 1 if a claim does not hold."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="100 nodes, 20 applications, one minute")
    parser.add_argument("--nodes", type=int, help="another number of nodes than 1,000")
    parser.add_argument("--applications", type=int, help="another number of applications than 200")
    parser.add_argument("--minutes", type=float, help="for how long to change them, instead of 10 minutes")
    parser.add_argument("--period", type=float, default=1.0, help="seconds between two changes")
    parser.add_argument("--json", type=pathlib.Path, help="write the claims to this file")
    parser.add_argument("--keep", type=pathlib.Path, help="directory for logs, instead of one that is removed")
    arguments = parser.parse_args()
    # Who is told to end leaves no process behind.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    nodes = arguments.nodes or (100 if arguments.quick else 1_000)
    applications = arguments.applications or (20 if arguments.quick else 200)
    minutes = arguments.minutes or (1.0 if arguments.quick else 10.0)
    with contextlib.ExitStack() as stack:
        directory = arguments.keep or pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory()))
        directory.mkdir(parents=True, exist_ok=True)
        cluster = LoopbackCluster(directory, report=print, audited=USER)
        stack.callback(cluster.stop)
        cluster.start()
        bench = Bench(cluster, directory, nodes, applications)
        stack.callback(bench.close)
        found = bench.measure(60.0 * minutes, arguments.period)
        cluster.check()
    print("\n".join(report(found)))
    held = claims(found)
    for c in held:
        print(f"{'holds ' if c['holds'] else 'FAILS '} {c['name']}: {c['ours']:.4g} {c['unit']} ({c['target']})")
    if arguments.json:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps({"claims": held}, indent=2) + "\n")
    return 0 if all(c["holds"] for c in held) else 1


if __name__ == "__main__":
    sys.exit(main())

"""Planning at 100 to 100,000 edge nodes, against the linear method of the thesis (Fig. 8.14).

The application is the traffic monitoring of thesis 8.2, with a path of 20 waypoints. There is one drone for five edge
nodes. In the first series, the number of candidate nodes is fixed. In the second series, 15 % of the nodes are
candidates. Both planners get the same inventory and must make the same plan. Algorithm 8 of the thesis searches around
every candidate of a static component. The linear method of this benchmark searches around the selected nodes only.
Otherwise it would be too slow for the large sizes.

Durations are processor time of the whole process, so that other programs do not affect them.
"""

from __future__ import annotations

import math
import random
import statistics
import sys
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import shapely
from fractus_core.api import Application, Depot, Drone, EdgeNode
from fractus_core.api.components import Component
from fractus_core.api.geometry import Position
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.geo import LocalFrame, distance_m
from fractus_core.planning import Host, Inventory, NodeLocations, Settings, operation_area
from fractus_core.planning.candidates import direct_reach_m, requests
from fractus_core.planning.coverage import Samples
from fractus_core.planning.planner import plan_in_steps
from harness import Report, parser, print_table, quantile

FRAME = LocalFrame(39.3606, 22.9307)
BLOCK_M = (600.0, 540.0)
"""Width and height of the block of streets."""

CLEAR_M = 3_000.0
"""Distance from the depot. All nodes within this distance are candidates."""

FIXED = 40
SHARE = 0.15
PER_DEPOT = 50
LARGEST = 100_000
SEED = 814
PHASES = {
    "area": ("area",),
    "drone search": ("drone.candidates",),
    "static search": ("static.candidates",),
    "hybrid search": ("hybrid-edge", "hybrid-drone.candidates"),
    "selection": ("drone.host", "static.host", "hybrid-drone.host", "cloud.host", "report"),
}
"""Phases of the thesis, each with the planner steps that it contains."""

WIFI = {"technology": "WiFi", "device": "wlan0", "range": 80, "pairing": {"networkId": "fractus"}}
CAMERA = {"methods": ["CaptureImage", "RetrieveImage"]}
MOBILITY_METHODS = ["Arm", "Takeoff", "Goto", "SetSpeed", "Land"]

Decision = tuple[str | None, tuple[tuple[str, str | None, str, float | None], ...]]


def position(x: float, y: float, alt: float | None = None) -> dict[str, float]:
    """Return a position some metres east and north of the depot."""
    lat, lon = FRAME.latlon(x, y)
    return {"lat": lat, "lon": lon} | ({"alt": alt} if alt is not None else {})


def manifest(kind: str, name: str, spec: dict[str, object], **more: object) -> dict[str, object]:
    """Return the manifest of an object."""
    return {"apiVersion": "fractus.dev/v1alpha1", "kind": kind, "metadata": {"name": name}, "spec": spec, **more}


def component(name: str, placement: str, **more: object) -> dict[str, object]:
    """Return a component of the application."""
    container = {"image": name.lower(), "ports": [{"port": 8080}], "resources": {"requests": {"cpu": "100m"}}}
    return {"name": name, "placement": placement, "container": container, **more}


def traffic_monitoring() -> Application:
    """Return Listing 12 of the thesis over a block of streets: ten rows, twenty waypoints."""
    width, height = BLOCK_M
    rows = 10
    path = []
    for row in range(rows):
        y = height * row / (rows - 1)
        ends = [position(0, y, 20), position(width, y, 20)]
        path += ends if row % 2 == 0 else ends[::-1]
    middle = position(width / 2, height / 2)
    camera = [{"service": "camera", **CAMERA}]
    control = {"point": {"depot": "base"}, "navigation": "pathBased", "path": path}
    mobility = [{"service": "mobility", "methods": MOBILITY_METHODS}]
    locations = [{"center": middle, "radius": 300, "instances": 1}, {"center": middle, "radius": 330, "instances": 10}]
    components = [
        component("Navigator", "drone", **{"class": "driver"}, services=mobility, controlPoints=[control]),
        component("AerialViewer", "drone", **{"class": "passenger"}, services=camera, egress=["ImageChecker"]),
        component("GroundViewer", "edge", services=camera, locations=locations, egress=["ImageChecker"]),
        component("ImageChecker", "hybrid", hybridTo=["GroundViewer", "AerialViewer"], egress=["DataStore"]),
        component("DataStore", "cloud", replicas=3),
    ]
    return Application.from_body(manifest("Application", "traffic", {"components": components}))


def inventory(nodes: int, candidates: int) -> Inventory:
    """Return an inventory with edge nodes and one drone for five edge nodes.

    Only the candidates are among the streets.
    """
    rng = random.Random(SEED)
    services = {"camera": CAMERA}
    edge_spec = {"location": position(0, 0), "interfaces": [WIFI], "services": services}
    edge = EdgeNode.from_body(manifest("EdgeNode", "edge", edge_spec))
    mobility = {"maxAltitude": 80, "maxFlightTime": 60, "maxSpeed": 15, "methods": MOBILITY_METHODS}
    drone_spec = {"depot": "base", "interfaces": [WIFI], "services": {"mobility": mobility, **services}}
    ready = {"type": "Ready", "status": "True", "reason": "Ready", "lastTransitionTime": "2026-01-01T00:00:00Z"}
    status = {"battery": {"remaining": 1.0}, "conditions": [ready]}
    drone = Drone.from_body(manifest("Drone", "drone", drone_spec, status=status))
    edges = {}
    for i in range(nodes):
        if i < candidates:
            x = rng.uniform(-60, BLOCK_M[0] + 60)
            y = rng.uniform(-60, BLOCK_M[1] + 60)
        else:
            x, y = _outside(rng, nodes)
        lat, lon = FRAME.latlon(x, y)
        edges[f"edge-{i:06d}"] = _copy(edge, f"edge-{i:06d}", location=Position(lat=lat, lon=lon))
    depots = {"base": Depot.from_body(manifest("Depot", "base", {"location": position(0, 0), "radius": 30}))}
    drones = {}
    at_base = max(1, candidates // 5)
    for i in range(max(1, nodes // 5)):
        depot = "base" if i < at_base else f"depot-{(i - at_base) // PER_DEPOT}"
        if depot not in depots:
            depots[depot] = Depot.from_body(manifest("Depot", depot, {"location": position(*_outside(rng, nodes))}))
        place = depots[depot].spec.location
        home = Position(lat=place.lat, lon=place.lon)
        drones[f"drone-{i:06d}"] = _copy(drone, f"drone-{i:06d}", depot=depot, home=home)
    amounts = {"cpu": 4.0}
    hosts = {n: Host(n, {"fractus.dev/class": "edge"}, amounts) for n in edges}
    hosts |= {n: Host(n, {"fractus.dev/class": "drone"}, amounts) for n in drones}
    hosts |= {n: Host(n, {"fractus.dev/class": "cloud"}, amounts) for n in ("cloud-1", "cloud-2")}
    return Inventory(hosts=hosts, drones=drones, edge_nodes=edges, depots=depots)


def _outside(rng: random.Random, nodes: int) -> tuple[float, float]:
    """Return a random point outside of the streets. The area of the points grows with the number of nodes."""
    bearing = rng.uniform(0, 2 * math.pi)
    reach = 50.0 * math.sqrt(nodes)
    distance = math.sqrt(rng.uniform(CLEAR_M**2, (CLEAR_M + reach) ** 2))
    return distance * math.cos(bearing), distance * math.sin(bearing)


def _copy(model, name: str, **spec: object):
    metadata = model.metadata.model_copy(update={"name": name})
    return model.model_copy(update={"metadata": metadata, "spec": model.spec.model_copy(update=spec)})


class Linear:
    """Algorithms 5 to 10 of the thesis with their errata: every search examines every node."""

    def __init__(self, application: Application, stock: Inventory, settings: Settings) -> None:
        self.spec = application.spec
        self.stock = stock
        self.settings = settings
        self.booked: dict[str, dict[str, float]] = {}
        self.placed: list[tuple[str, str | None, str, float | None]] = []
        self.drone: str | None = None

    def steps(self) -> Generator[str, None, Decision]:
        """Plan, and yield the name of each completed step."""
        area = operation_area(self.spec, self.stock.depots, self.settings.safety_radius_m)
        assert area is not None
        yield "area"
        fleet = self._drones_at("base")
        yield "drone.candidates"
        self._choose(fleet)
        yield "drone.host"
        for component in self.spec.on("edge"):
            near = [self._within(spot.center, spot.radius) for spot in component.locations]
            yield "static.candidates"
            self._place_static(component, near)
            yield "static.host"
        for component in self.spec.on("hybrid"):
            self.placed.append((component.name, None, "cloud", None))
            hosts: set[str] = set()
            for name in component.hybrid_to:
                if self.spec.component(name).placement == "edge":
                    for host in [p[1] for p in self.placed if p[0] == name]:
                        self._place_beside(component, host or "", hosts)
                    yield "hybrid-edge"
                else:
                    samples = Samples(area.shape)
                    reached = self._footprints(area.frame, area.shape, samples)
                    yield "hybrid-drone.candidates"
                    self._cover(component, reached, hosts, len(samples))
                    yield "hybrid-drone.host"
        for component in self.spec.on("cloud"):
            self.placed.append((component.name, None, "cloud", None))
            yield "cloud.host"
        return self.drone, tuple(self.placed)

    def _drones_at(self, depot: str) -> list[Drone]:
        place = self.stock.depots[depot].spec
        return [
            d for d in self.stock.drones.values()
            if d.spec.depot == depot or (d.spec.home and distance_m(d.spec.home, place.location) <= place.radius)
        ]  # fmt: skip

    def _choose(self, fleet: Iterable[Drone]) -> None:
        ranked = sorted((-(d.status.battery.remaining), d.name) for d in fleet)  # type: ignore[union-attr]
        self.drone = ranked[0][1]
        for component in self.spec.on("drone"):
            self._take(component, self.drone, "drone")

    def _within(self, centre: Position, radius_m: float) -> list[str]:
        near = []
        for node in self.stock.edge_nodes.values():
            distance = distance_m(centre, node.spec.location)
            if distance <= radius_m:
                near.append((round(distance * 1000), node.name))
        return [name for _, name in sorted(near)]

    def _place_static(self, component: Component, near: list[list[str]]) -> None:
        taken: set[str] = set()
        for spot, names in zip(component.locations, near, strict=True):
            suitable = [n for n in names if n not in taken and self._fits(component, n)]
            for name in suitable[: len(suitable) if spot.instances == "*" else spot.instances]:
                taken.add(name)
                self._take(component, name, "static")

    def _place_beside(self, component: Component, host: str, hosts: set[str]) -> None:
        origin = self.stock.edge_nodes[host].spec
        in_range = [(-1, host)]
        for node in self.stock.edge_nodes.values():
            reach = direct_reach_m(origin.interfaces, node.spec.interfaces)
            distance = distance_m(origin.location, node.spec.location)
            if reach is not None and distance <= reach:
                in_range.append((round(distance * 1000), node.name))
        for _, name in sorted(in_range):
            if name in hosts:
                return
            if self._fits(component, name):
                hosts.add(name)
                self._take(component, name, "hybrid-edge")
                return

    def _footprints(self, frame: LocalFrame, shape: shapely.Geometry, samples: Samples) -> dict[str, np.ndarray]:
        points = samples.xy()
        interfaces = self.stock.drones[self.drone or ""].spec.interfaces
        reached = {}
        for node in self.stock.edge_nodes.values():
            reach = direct_reach_m(interfaces, node.spec.interfaces)
            x, y = frame.xy(node.spec.location.lat, node.spec.location.lon)
            if reach is None or shape.distance(shapely.Point(x, y)) > reach:
                continue
            reached[node.name] = np.hypot(points[:, 0] - x, points[:, 1] - y) <= reach
        return reached

    def _cover(self, component: Component, reached: dict[str, np.ndarray], hosts: set[str], total: int) -> None:
        covered = np.zeros(total, dtype=bool)
        for name in hosts & reached.keys():
            covered |= reached[name]
        left = sorted(reached.keys() - hosts)
        while left and covered.sum() < self.settings.coverage_share * total:
            missing = ~covered
            gains = [int(np.count_nonzero(reached[name] & missing)) for name in left]
            best = max(gains)
            if best == 0:
                return
            name = left.pop(gains.index(best))
            if self._fits(component, name):
                covered |= reached[name]
                hosts.add(name)
                self._take(component, name, "hybrid-drone", round(best / total, 6))

    def _fits(self, component: Component, name: str) -> bool:
        host = self.stock.hosts[name]
        booked = self.booked.get(name, {})
        return host.ready and all(
            booked.get(r, 0.0) + amount <= host.allocatable.get(r, 0.0) + 1e-9
            for r, amount in requests(component).items()
        )

    def _take(self, component: Component, name: str, role: str, share: float | None = None) -> None:
        booked = self.booked.setdefault(name, {})
        for resource, amount in requests(component).items():
            booked[resource] = booked.get(resource, 0.0) + amount
        self.placed.append((component.name, name, role, share))


@dataclass(frozen=True)
class Measurement:
    """Durations of both planners at one size.

    Attributes:
        nodes: Number of edge nodes.
        candidates: Number of edge nodes among the streets.
        measured_s: Median duration of the planner, in seconds.
        reference_s: Duration of the linear method, in seconds.
        phases_ms: Duration of each phase, of the planner and of the linear method, in milliseconds.
        same: True if both made the same plan.
    """

    nodes: int
    candidates: int
    measured_s: float
    reference_s: float
    phases_ms: tuple[list[float], list[float]]
    same: bool


def decision_of(plan: DeploymentPlanSpec) -> Decision:
    """Return the drone and placements of a plan, which must be equal for both planners."""
    placed = tuple((p.component, p.node, p.role, p.coverage) for p in plan.placements)
    return plan.drone.node if plan.drone is not None else None, placed


def timed(steps: Generator[str, None, object]) -> tuple[object, dict[str, float]]:
    """Run a planner to its end. Return its result and the duration of each step in seconds."""
    durations_s: dict[str, float] = {}
    while True:
        started = time.process_time()
        try:
            name = next(steps)
        except StopIteration as done:
            return done.value, durations_s
        durations_s[name] = durations_s.get(name, 0.0) + time.process_time() - started


def repeated(make: Callable[[], Generator[str, None, object]], times: int) -> tuple[object, float, list[float]]:
    """Run a planner several times. Return its result, the median duration (s), and the median of each phase (ms)."""
    runs = [timed(make()) for _ in range(times)]
    phases_ms = [
        1e3 * statistics.median(sum(durations.get(step, 0.0) for step in steps) for _, durations in runs)
        for steps in PHASES.values()
    ]
    return runs[0][0], statistics.median(sum(durations.values()) for _, durations in runs), phases_ms


def measure(nodes: int, candidates: int, times: int, application: Application) -> Measurement:
    """Measure both planners on one inventory."""
    stock = inventory(nodes, candidates)
    settings = Settings()
    stock.located()
    plan, measured_s, measured_phases = repeated(lambda: plan_in_steps(application, stock, settings), times)
    decision, reference_s, their_phases = repeated(lambda: Linear(application, stock, settings).steps(), 1)
    assert isinstance(plan, DeploymentPlanSpec)
    same = decision_of(plan) == decision
    return Measurement(nodes, candidates, measured_s, reference_s, (measured_phases, their_phases), same)


def index_update_ms(nodes: int, moves: int = 1000) -> tuple[float, float]:
    """Return the duration of an index update for one moved node (99th percentile), and of building the index."""
    stock = inventory(nodes, FIXED)
    started = time.process_time()
    index = NodeLocations.of(edge_nodes=stock.edge_nodes, drones=stock.drones, depots=stock.depots, cloud=())
    built_s = time.process_time() - started
    rng = random.Random(SEED)
    taken_s = []
    for name in rng.choices(sorted(stock.edge_nodes), k=moves):
        lat, lon = FRAME.latlon(*_outside(rng, nodes))
        moved = _copy(stock.edge_nodes[name], name, location=Position(lat=lat, lon=lon))
        started = time.process_time()
        index.upsert_edge_node(moved)
        taken_s.append(time.process_time() - started)
    return 1e3 * quantile(taken_s, 0.99), 1e3 * built_s


def rows_of(measurements: Iterable[Measurement]) -> Iterator[tuple[object, ...]]:
    """Return the rows of the table: two for each size."""
    for m in measurements:
        methods = (("planner", m.measured_s, m.phases_ms[0]), ("linear", m.reference_s, m.phases_ms[1]))
        for method, total_s, phases_ms in methods:
            yield m.nodes, m.candidates, method, 1e3 * total_s, *phases_ms


def main() -> int:
    options = parser(__doc__, quick="two sizes and fewer repetitions").parse_args()
    sizes = (1_000, LARGEST) if options.quick else (100, 1_000, 10_000, LARGEST)
    times = 7 if options.quick else 15
    application = traffic_monitoring()
    measure(1_000, FIXED, 3, application)  # warm-up
    fixed = {n: measure(n, FIXED, times, application) for n in sizes}
    share = {n: measure(n, max(20, round(SHARE * n)), min(times, 5), application) for n in sizes}
    print_table(
        ("nodes", "candidates", "method", "total ms", *(f"{name} ms" for name in PHASES)),
        list(rows_of([*fixed.values(), *share.values()])),
    )
    report = Report("planning", options)
    large = fixed[LARGEST]
    small = fixed[1_000]
    report.add("fixed", 1e3 * large.measured_s, 1e3 * large.reference_s)
    report.add("growth", large.measured_s / small.measured_s, large.reference_s / small.reference_s)
    report.add("speed", large.reference_s / large.measured_s)
    report.add("share", 1e3 * share[LARGEST].measured_s, 1e3 * share[LARGEST].reference_s)
    report.add("index", *index_update_ms(LARGEST))
    report.add("same", sum(not m.same for m in (*fixed.values(), *share.values())))
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())

"""Planning at 100 to 100,000 edge nodes, against the thesis' linear method written straightforwardly (Fig. 8.14).

The traffic-monitoring application of thesis 8.2 with a path of 20 waypoints; one drone for five edge nodes. In one
series a fixed number of nodes are candidates, in the other 15 % are. Both planners get the same inventory and must
make the same plan. Where the thesis' Algorithm 8 looks around every candidate of a static component, the linear method
here looks around the chosen ones only: that flatters it, and lets it finish.

Times are those of the CPU, of the whole process: by the clock on a quiet core, and the same on a busy one.
"""

from __future__ import annotations

import argparse
import json
import math
import pathlib
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

FRAME = LocalFrame(39.3606, 22.9307)
BLOCK_M = (600.0, 540.0)
CLEAR_M = 3_000.0
FIXED = 40
SHARE = 0.15
PER_DEPOT = 50
SEED = 814

Phases = dict[str, float]
Decision = tuple[str | None, tuple[tuple[str, str | None, str, float | None], ...]]


# -- the scene --


def at(x: float, y: float, alt: float | None = None) -> dict[str, float]:
    """A position some metres east and north of the depot."""
    lat, lon = FRAME.latlon(x, y)
    return {"lat": lat, "lon": lon} | ({"alt": alt} if alt is not None else {})


def manifest(kind: str, name: str, spec: dict[str, object], **more: object) -> dict[str, object]:
    """An object as it is applied."""
    return {"apiVersion": "fractus.dev/v1alpha1", "kind": kind, "metadata": {"name": name}, "spec": spec, **more}


def traffic_monitoring() -> Application:
    """Thesis Listing 12 over a block of streets: ten rows, twenty waypoints."""
    width, height = BLOCK_M
    rows = 10
    path = []
    for row in range(rows):
        y = height * row / (rows - 1)
        ends = [at(0, y, 20), at(width, y, 20)]
        path += ends if row % 2 == 0 else ends[::-1]
    middle = at(width / 2, height / 2)
    camera = [{"service": "camera", "methods": ["CaptureImage", "RetrieveImage"]}]

    def component(name: str, placement: str, **more: object) -> dict[str, object]:
        container = {"image": name.lower(), "ports": [{"port": 8080}], "resources": {"requests": {"cpu": "100m"}}}
        return {"name": name, "placement": placement, "container": container, **more}

    control = {"point": {"depot": "base"}, "navigation": "pathBased", "path": path}
    mobility = [{"service": "mobility", "methods": ["Arm", "Takeoff", "Goto", "SetSpeed", "Land"]}]
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
    """A count of edge nodes, candidates of them among the streets and the others elsewhere, and a drone for five."""
    rng = random.Random(SEED)
    wifi = {"technology": "WiFi", "device": "wlan0", "range": 80, "pairing": {"networkId": "fractus"}}
    camera = {"methods": ["CaptureImage", "RetrieveImage"]}
    edge = EdgeNode.from_body(
        manifest("EdgeNode", "edge", {"location": at(0, 0), "interfaces": [wifi], "services": {"camera": camera}})
    )
    mobility = {
        "maxAltitude": 80,
        "maxFlightTime": 60,
        "maxSpeed": 15,
        "methods": ["Arm", "Takeoff", "Goto", "SetSpeed", "Land"],
    }
    ready = {"type": "Ready", "status": "True", "reason": "Ready", "lastTransitionTime": "2026-01-01T00:00:00Z"}
    drone = Drone.from_body(
        manifest(
            "Drone",
            "drone",
            {"depot": "base", "interfaces": [wifi], "services": {"mobility": mobility, "camera": camera}},
            status={"battery": {"remaining": 1.0}, "conditions": [ready]},
        )
    )
    edges = {}
    for i in range(nodes):
        inside = i < candidates
        x, y = (
            (rng.uniform(-60, BLOCK_M[0] + 60), rng.uniform(-60, BLOCK_M[1] + 60)) if inside else _outside(rng, nodes)
        )
        lat, lon = FRAME.latlon(x, y)
        edges[f"edge-{i:06d}"] = _renamed(edge, f"edge-{i:06d}", location=Position(lat=lat, lon=lon))
    depots = {"base": Depot.from_body(manifest("Depot", "base", {"location": at(0, 0), "radius": 30}))}
    drones = {}
    at_base = max(1, candidates // 5)
    for i in range(max(1, nodes // 5)):
        depot = "base" if i < at_base else f"depot-{(i - at_base) // PER_DEPOT}"
        if depot not in depots:
            depots[depot] = Depot.from_body(manifest("Depot", depot, {"location": at(*_outside(rng, nodes))}))
        place = depots[depot].spec.location
        drones[f"drone-{i:06d}"] = _renamed(
            drone, f"drone-{i:06d}", depot=depot, home=Position(lat=place.lat, lon=place.lon)
        )
    amounts = {"cpu": 4.0}
    hosts = {n: Host(n, {"fractus.dev/class": "edge"}, amounts) for n in edges}
    hosts |= {n: Host(n, {"fractus.dev/class": "drone"}, amounts) for n in drones}
    hosts |= {n: Host(n, {"fractus.dev/class": "cloud"}, amounts) for n in ("cloud-1", "cloud-2")}
    return Inventory(hosts=hosts, drones=drones, edge_nodes=edges, depots=depots)


def _outside(rng: random.Random, nodes: int) -> tuple[float, float]:
    """Somewhere in a land that grows with the number of nodes, but not near the streets."""
    bearing = rng.uniform(0, 2 * math.pi)
    reach = 50.0 * math.sqrt(nodes)
    distance = math.sqrt(rng.uniform(CLEAR_M**2, (CLEAR_M + reach) ** 2))
    return distance * math.cos(bearing), distance * math.sin(bearing)


def _renamed(model, name: str, **spec: object):
    metadata = model.metadata.model_copy(update={"name": name})
    return model.model_copy(update={"metadata": metadata, "spec": model.spec.model_copy(update=spec)})


# -- the thesis' method --


class Linear:
    """Algorithms 5 to 10 as they stand (with the errata): every search looks at every node."""

    def __init__(self, application: Application, stock: Inventory, settings: Settings) -> None:
        self.spec = application.spec
        self.stock = stock
        self.settings = settings
        self.booked: dict[str, dict[str, float]] = {}
        self.placed: list[tuple[str, str | None, str, float | None]] = []
        self.drone: str | None = None

    def steps(self) -> Generator[str, None, Decision]:
        """Plan, naming each phase when it is done."""
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
            d
            for d in self.stock.drones.values()
            if d.spec.depot == depot or (d.spec.home and distance_m(d.spec.home, place.location) <= place.radius)
        ]

    def _choose(self, fleet: Iterable[Drone]) -> None:
        ranked = sorted((-(d.status.battery.remaining), d.name) for d in fleet)  # type: ignore[union-attr]
        self.drone = ranked[0][1]
        for component in self.spec.on("drone"):
            self._take(component, self.drone, "drone")

    def _within(self, centre: Position, radius_m: float) -> list[str]:
        found = []
        for node in self.stock.edge_nodes.values():
            distance = distance_m(centre, node.spec.location)
            if distance <= radius_m:
                found.append((round(distance * 1000), node.name))
        return [name for _, name in sorted(found)]

    def _place_static(self, component: Component, near: list[list[str]]) -> None:
        taken: set[str] = set()
        for spot, names in zip(component.locations, near, strict=True):
            suitable = [n for n in names if n not in taken and self._fits(component, n)]
            for name in suitable[: len(suitable) if spot.instances == "*" else spot.instances]:
                taken.add(name)
                self._take(component, name, "static")

    def _place_beside(self, component: Component, host: str, hosts: set[str]) -> None:
        here = self.stock.edge_nodes[host]
        found = [(-1, host)]
        for node in self.stock.edge_nodes.values():
            reach = direct_reach_m(here.spec.interfaces, node.spec.interfaces)
            distance = distance_m(here.spec.location, node.spec.location)
            if reach is not None and distance <= reach:
                found.append((round(distance * 1000), node.name))
        for _, name in sorted(found):
            if name in hosts:
                return
            if self._fits(component, name):
                hosts.add(name)
                self._take(component, name, "hybrid-edge")
                return

    def _footprints(self, frame: LocalFrame, shape: shapely.Geometry, samples: Samples) -> dict[str, np.ndarray]:
        points = samples.xy()
        ours = self.stock.drones[self.drone or ""].spec.interfaces
        reached = {}
        for node in self.stock.edge_nodes.values():
            reach = direct_reach_m(ours, node.spec.interfaces)
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


# -- measuring --


@dataclass(frozen=True)
class Measured:
    """Times of one planner at one size."""

    nodes: int
    candidates: int
    total_s: float
    phases_s: Phases


def decision_of(plan: DeploymentPlanSpec) -> Decision:
    """What two planners must agree on."""
    placed = tuple((p.component, p.node, p.role, p.coverage) for p in plan.placements)
    return plan.drone.node if plan.drone is not None else None, placed


def timed(steps: Generator[str, None, object]) -> tuple[object, Phases]:
    """Run a planner to its end; its result and the seconds of each phase."""
    phases: Phases = {}
    while True:
        started = time.process_time()
        try:
            name = next(steps)
        except StopIteration as done:
            return done.value, phases
        phases[name] = phases.get(name, 0.0) + time.process_time() - started


def repeated(make: Callable[[], Generator[str, None, object]], times: int) -> tuple[object, float, Phases]:
    """The result, the median of the whole and of each phase."""
    runs = [timed(make()) for _ in range(times)]
    phases = {name: statistics.median(run[1].get(name, 0.0) for run in runs) for name in runs[0][1]}
    return runs[0][0], statistics.median(sum(run[1].values()) for run in runs), phases


def measure(nodes: int, candidates: int, times: int, application: Application) -> tuple[Measured, Measured, bool]:
    """Ours, the linear method, and whether they made the same plan."""
    stock = inventory(nodes, candidates)
    settings = Settings()
    stock.located()
    plan, total, phases = repeated(lambda: plan_in_steps(application, stock, settings), times)
    ours = Measured(nodes, candidates, total, phases)
    decided, total, phases = repeated(lambda: Linear(application, stock, settings).steps(), 1)
    theirs = Measured(nodes, candidates, total, phases)
    assert isinstance(plan, DeploymentPlanSpec)
    return ours, theirs, decision_of(plan) == decided


def index_updates(nodes: int, moves: int = 1000) -> tuple[float, float]:
    """Seconds to note one moved node (99th percentile), and to build the index again."""
    stock = inventory(nodes, FIXED)
    started = time.process_time()
    where = NodeLocations.of(edge_nodes=stock.edge_nodes, drones=stock.drones, depots=stock.depots, cloud=())
    built = time.process_time() - started
    rng = random.Random(SEED)
    names = rng.choices(sorted(stock.edge_nodes), k=moves)
    taken = []
    for name in names:
        lat, lon = FRAME.latlon(*_outside(rng, nodes))
        moved = _renamed(stock.edge_nodes[name], name, location=Position(lat=lat, lon=lon))
        started = time.process_time()
        where.upsert_edge_node(moved)
        taken.append(time.process_time() - started)
    return sorted(taken)[int(0.99 * moves)], built


def claim(name: str, ours: float, theirs: float | None, *, unit: str, target: str, holds: bool) -> dict[str, object]:
    """One line of the report."""
    ratio = theirs / ours if theirs is not None and ours else None
    return {
        "name": name,
        "ours": ours,
        "theirs": theirs,
        "unit": unit,
        "ratio": ratio,
        "target": target,
        "holds": holds,
    }


# -- reporting --

GROUPS = {
    "T_area": ("area",),
    "T_loc drone": ("drone.candidates",),
    "T_loc static": ("static.candidates",),
    "T_loc hybrid": ("hybrid-edge", "hybrid-drone.candidates"),
    "T_host": ("drone.host", "static.host", "hybrid-drone.host", "cloud.host", "report"),
}


def grouped(measured: Measured) -> dict[str, float]:
    """The thesis' phases in milliseconds."""
    return {g: 1e3 * sum(measured.phases_s.get(n, 0.0) for n in names) for g, names in GROUPS.items()}


def table(series: str, rows: Iterable[tuple[Measured, Measured, bool]]) -> Iterator[str]:
    """The figures as text."""
    yield f"\n{series}"
    yield f"{'nodes':>8} {'cand.':>7} {'method':>7} {'total ms':>10} " + " ".join(f"{g:>13}" for g in GROUPS)
    for ours, theirs, same in rows:
        for method, m in (("ours", ours), ("linear", theirs)):
            phases = " ".join(f"{v:13.2f}" for v in grouped(m).values())
            yield f"{m.nodes:8d} {m.candidates:7d} {method:>7} {1e3 * m.total_s:10.2f} {phases}"
        yield f"{'':8} {'':7} {'ratio':>7} {theirs.total_s / ours.total_s:10.0f}   {'same plan' if same else 'PLANS DIFFER'}"


def draw(series: dict[str, list[tuple[Measured, Measured, bool]]], file: pathlib.Path) -> None:
    """Each phase over the number of nodes, both methods, as in thesis Fig. 8.14."""
    import matplotlib as mpl  # noqa: PLC0415  (slow to import, and only needed here)

    mpl.use("Agg")
    from matplotlib import pyplot  # noqa: PLC0415

    figure, axes = pyplot.subplots(1, len(series), figsize=(6.5 * len(series), 5), sharey=True, squeeze=False)
    for axis, (title, rows) in zip(axes[0], series.items(), strict=True):
        sizes = [ours.nodes for ours, _, _ in rows]
        for i, group in enumerate(GROUPS):
            for which, style in ((0, "-o"), (1, ":s")):
                values = [max(grouped(row[which])[group], 1e-3) for row in rows]
                label = f"{group}, {'ours' if which == 0 else 'linear'}"
                axis.loglog(sizes, values, style, color=f"C{i}", markersize=4, label=label)
        axis.set_title(title)
        axis.set_xlabel("edge nodes (one drone for five)")
        axis.grid(visible=True, which="both", alpha=0.2)
    axes[0][0].set_ylabel("milliseconds (median)")
    axes[0][-1].legend(fontsize=7, ncols=2)
    figure.tight_layout()
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=130)


def claims(
    series: dict[str, list[tuple[Measured, Measured, bool]]], update_s: float, build_s: float
) -> list[dict[str, object]]:
    """What must hold, and whether it does."""
    fixed, share = series.values()
    by_size = {ours.nodes: (ours, theirs) for ours, theirs, _ in fixed}
    ours, theirs = by_size[100_000]
    growth = ours.total_s / by_size[1_000][0].total_s
    linear_growth = theirs.total_s / by_size[1_000][1].total_s
    wide, wide_linear, _ = share[-1]
    same = all(same for rows in series.values() for _, _, same in rows)
    slower = theirs.total_s / ours.total_s
    return [
        claim("plan at 10^5 edge nodes, fixed candidates", 1e3 * ours.total_s, 1e3 * theirs.total_s, unit="ms", target="< 50 ms", holds=ours.total_s < 0.05),
        claim("plan at 10^5 over plan at 10^3, fixed candidates", growth, linear_growth, unit="times", target="<= 3", holds=growth <= 3),
        claim("linear method over ours at 10^5", slower, None, unit="times", target=">= 50", holds=slower >= 50),
        claim("plan at 10^5 with 15 % candidates", 1e3 * wide.total_s, 1e3 * wide_linear.total_s, unit="ms", target="< 1000 ms", holds=wide.total_s < 1),
        claim("index update of one moved node at 10^5 (p99; theirs: build again)", 1e3 * update_s, 1e3 * build_s, unit="ms", target="< 1 ms", holds=update_s < 1e-3),
        claim("same plan as the linear method, all sizes", float(same), 1.0, unit="yes", target="1", holds=same),
    ]  # fmt: skip


def main() -> int:
    """Run, print, draw; 1 if a claim does not hold."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="two sizes and few repetitions")
    parser.add_argument("--json", type=pathlib.Path, help="write the claims to this file")
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out/bench"), help="where the plot goes")
    arguments = parser.parse_args()
    sizes = (1_000, 100_000) if arguments.quick else (100, 1_000, 10_000, 100_000)
    times = 7 if arguments.quick else 15
    application = traffic_monitoring()
    measure(1_000, FIXED, 3, application)  # warm up
    series = {
        f"{FIXED} candidates": [measure(n, FIXED, times, application) for n in sizes],
        f"{SHARE:.0%} candidates": [measure(n, max(20, round(SHARE * n)), min(times, 5), application) for n in sizes],
    }
    for title, rows in series.items():
        print("\n".join(table(title, rows)))
    found = claims(series, *index_updates(sizes[-1]))
    print()
    for c in found:
        ratio = f"{c['ratio']:.1f}x" if c["ratio"] is not None else ""
        print(
            f"{'holds ' if c['holds'] else 'FAILS '} {c['name']}: {c['ours']:.4g} {c['unit']} ({c['target']}) {ratio}"
        )
    plot = arguments.out / "planning.png"
    draw(series, plot)
    print(f"\nplot: {plot}")
    if arguments.json:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps({"claims": found}, indent=2) + "\n")
    return 0 if all(c["holds"] for c in found) else 1


if __name__ == "__main__":
    sys.exit(main())

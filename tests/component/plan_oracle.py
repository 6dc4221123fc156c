"""Exhaustive oracle for plans of random fleets, applications and policies.

The oracle applies the rules (thesis chapter 8.5 and its errata, docs/policies.md) without the indexes, searches and
geometry of the planner:

- Distances are geodesics, and flights are sampled at short intervals.
- Zones are circles, and a flood fill of a grid finds the routes around them.
- An exhaustive search assigns the instances.

If a comparison is so close that rounding errors may decide it, the oracle raises `Undecided`.
"""

from __future__ import annotations

import itertools
import math
import random
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

import numpy as np
import shapely
from fractus_core.api import Application, Depot, Drone, EdgeNode, Policy, Zone
from fractus_core.api.geometry import Position
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.geo import LocalFrame, geodesic_m
from fractus_core.planning import Flight, Host, Infeasible, Inventory, Settings, operation_area, plan
from fractus_core.planning.coverage import Samples
from policy_world import commanded_mps

NOW_S = 1_780_000_000.0
FLOWN_M = 10.0
"""Altitude of all waypoints in metres."""
SAFETY_M = 7.0
NEAR_M = 800.0
RESERVE = 0.2
CRUISE_MPS = 5.0
CLIMB_MPS = 1.5
MARGIN_M = 2.5
"""Margin around zones for a leg from standstill: sum of position error and path deviation of the autopilot."""
STEP_M = 3.0
CPU = 0.1
ROOMS = (0.05, 0.1, 0.2, 0.2, 4.0, 4.0)
OTHER = ("default", "other")


class Undecided(Exception):
    """A comparison of this scene is so close that rounding errors may decide it."""


# -- scenes --


@dataclass
class Scene:
    """The application to plan, the inventory, and the zones as circles for the oracle."""

    application: Application
    inventory: Inventory
    settings: Settings
    frame: LocalFrame
    zones: dict[str, tuple[float, float, float]] = field(default_factory=dict)

    def xy(self, place: Any) -> tuple[float, float]:
        return self.frame.xy(place.lat, place.lon)


class SceneBuilder:
    """Builds the random scene of a seed."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        self.frame = LocalFrame(self.rng.choice([0.0, 39.36, -33.9, 64.1]), self.rng.choice([22.93, 179.9995, -0.0004]))

    def at(self, x: float, y: float, alt: float | None = None) -> dict[str, float]:
        lat, lon = self.frame.latlon(x, y)
        return {"lat": lat, "lon": lon} | ({"alt": alt} if alt is not None else {})

    def somewhere(self, size: float) -> tuple[float, float]:
        return self.rng.uniform(-size, size), self.rng.uniform(-size, size)

    def scene(self) -> Scene:
        rng = self.rng
        self.depots = {
            f"depot-{i}": {"location": self.at(*self.somewhere(500 * i)), "radius": rng.choice([20, 60, 300])}
            for i in range(rng.randint(1, 3))
        }
        path = [self.somewhere(250) for _ in range(rng.randint(1, 4))]
        drones = self.drones()
        edges = self.edges()
        components = self.drone_components(path)
        components += self.ground_components([c["name"] for c in components if c["name"] == "Viewer"])
        application = Application.from_body(body("Application", "app", {"components": components}))
        zones, policies = self.policies(path)
        hosts = [self.host(d.name, "drone") for d in drones] + [self.host(e.name, "edge") for e in edges]
        hosts += [self.host(f"cloud-{i}", "cloud") for i in range(rng.randint(0, 2) or 1)]
        flights = self.flights(path, drones) if rng.random() < 0.7 else {}
        claimed = {name: flight.holder for name, flight in flights.items()}
        inventory = Inventory(
            hosts={h.name: h for h in hosts},
            drones={d.name: d for d in drones},
            edge_nodes={e.name: e for e in edges},
            depots={n: Depot.from_body(body("Depot", n, s)) for n, s in self.depots.items()},
            zones={n: Zone.from_body(body("Zone", n, z)) for n, z in zones.items()},
            policies={n: Policy.from_body(body("Policy", n, p)) for n, p in policies.items()},
            claimed=claimed,
            flights=flights,
        )
        settings = Settings(
            depot_radius_m=NEAR_M, time_s=NOW_S, policy_conflicts=rng.choice(["warn", "forbid"]), near_misses=3
        )
        circles = {
            n: (*self.frame.xy(*z["area"]["circle"]["center"].values()), z["area"]["circle"]["radius"])
            for n, z in zones.items()
        }
        return Scene(application, inventory, settings, self.frame, circles)

    def host(self, name: str, node_class: str) -> Host:
        rng = self.rng
        usable = rng.random() < 0.92
        return Host(
            name,
            {"fractus.dev/class": node_class},
            {"cpu": rng.choice(ROOMS) if node_class != "cloud" or rng.random() < 0.1 else 4.0},
            ready=usable or rng.random() < 0.5,
            schedulable=usable or rng.random() < 0.5,
        )

    def interfaces(self) -> list[dict[str, Any]]:
        reach = self.rng.choice([None, 80, 80, 150, 150])
        wifi = (
            [{"technology": "WiFi", "device": "wlan0", "range": reach, "pairing": {"networkId": "n"}}] if reach else []
        )
        return [{"technology": "4G"}, *wifi]

    def drones(self) -> list[Drone]:
        rng = self.rng
        drones = []
        for i in range(rng.randint(1, 6)):
            depot = rng.choice([*self.depots, "depot-0", "depot-0", None])
            home = self.at(*self.somewhere(rng.choice([30, 300, 900]))) if depot is None or rng.random() < 0.2 else None
            if rng.random() < 0.03:
                depot = None
                home = None
            mobility = {
                "maxAltitude": rng.choice([8, *[80] * 9]),
                "maxFlightTime": rng.choice([4, 15, 30, 30, 60]),
                "maxSpeed": rng.choice([2, 15, 15]),
                "methods": ["Arm", "Takeoff", "Goto"] if rng.random() < 0.97 else ["Arm"],
            }
            services = {"camera": {"methods": ["CaptureImage"]}} if rng.random() < 0.95 else {}
            services |= {"mobility": mobility} if rng.random() < 0.98 else {}
            ready = {
                "type": "Ready",
                "status": "True" if rng.random() < 0.95 else "False",
                "reason": "R",
                "lastTransitionTime": "2026-01-01T00:00:00Z",
            }
            status = {
                "battery": {"remaining": rng.choice([0.4, 0.9, 1.0])},
                "flightState": rng.choice(["inactive", "inactive", "charging"]),
                "conditions": [ready],
            }
            spec = {"interfaces": self.interfaces(), "services": services}
            spec |= {k: v for k, v in (("depot", depot), ("home", home)) if v is not None}
            drones.append(Drone.from_body(body("Drone", f"d{i}", spec, status=status)))
        return drones

    def edges(self) -> list[EdgeNode]:
        return [
            EdgeNode.from_body(
                body("EdgeNode", f"e{i}", {"location": self.at(*self.somewhere(300)), "interfaces": self.interfaces()})
            )
            for i in range(self.rng.choice([0, 3, 5, 7, 9]))
        ]

    def drone_components(self, path: Sequence[tuple[float, float]]) -> list[dict[str, Any]]:
        rng = self.rng
        path_points = [self.at(x, y, FLOWN_M) for x, y in path]
        camera = [{"service": "camera", "methods": ["CaptureImage"]}] if rng.random() < 0.7 else []
        viewer = component("Viewer", "drone", services=camera, **{"class": "passenger"})
        kind = rng.choice(["none", "tour", "tour", "full", "full", "partial", "partial"])
        if kind == "none":
            return []
        if kind == "tour":
            return [viewer | {"pointsOfInterest": {"points": path_points, "ordered": True}}]
        starts: list[dict[str, Any]] = [
            {},
            {"point": {"depot": "depot-0"}},
            {"point": {"position": self.at(*path[0], FLOWN_M)}},
        ]
        points = [{**rng.choice(starts), "navigation": "pathBased", "path": path_points}]
        if kind == "partial" and len(path_points) > 1 and rng.random() < 0.5:
            points = [points[0] | {"path": path_points[:1]}, {"navigation": "pathBased", "path": path_points[1:]}]
        mobility = [{"service": "mobility", "methods": ["Arm", "Takeoff", "Goto"]}]
        driver = component(
            "Driver", "drone", services=mobility, control=kind, controlPoints=points, **{"class": "driver"}
        )
        return [driver, *([viewer] if rng.random() < 0.5 else [])]

    def ground_components(self, viewers: list[str]) -> list[dict[str, Any]]:
        rng = self.rng
        components = []
        for i in range(rng.choice([0, 0, 1, 1, 2])):
            locations = [
                {
                    "center": self.at(*self.somewhere(150)),
                    "radius": rng.choice([100, 200, 300]),
                    "instances": rng.choice([1, 1, 2, "*"]),
                }
                for _ in range(rng.choice([1, 1, 2, 3]))
            ]
            components.append(component(f"Static{i}", "edge", locations=locations))
        targets = [c["name"] for c in components[:1]] + viewers
        components += [component("Checker", "hybrid", hybridTo=targets)] if targets else []
        components.append(component("Store", "cloud"))
        return components

    def policies(self, path: Sequence[tuple[float, float]]) -> tuple[dict[str, Any], dict[str, Any]]:
        rng = self.rng
        zones: dict[str, Any] = {}
        policies: dict[str, Any] = {}
        for i in range(rng.choice([0, 1, 1, 2, 3])):
            x, y = rng.choice([*path, self.somewhere(400)])
            centre = self.at(x + rng.uniform(-60, 60), y + rng.uniform(-60, 60))
            zones[f"z{i}"] = {"area": {"circle": {"center": centre, "radius": rng.choice([5, 15, 40])}}}
            policies[f"keep-out-{i}"] = {"type": "GeofenceControl", "kind": "exclusion"} | self.scope([f"z{i}"])
        if rng.random() < 0.25:
            limit = {"type": "LimitControl", "kind": "speed", "upperLimit": rng.choice([0.5, 1.5, 4])}
            policies["slow"] = limit | self.scope([])
        if rng.random() < 0.25:
            edge = rng.choice([{"upperLimit": 6}, {"lowerLimit": 20}, {"upperLimit": 6, "action": "refuse"}])
            policies["height"] = {"type": "LimitControl", "kind": "altitude"} | edge | self.scope([])
        return zones, policies

    def scope(self, zones: list[str]) -> dict[str, Any]:
        """Return a random selector and validity window of a policy."""
        rng = self.rng
        selector: dict[str, Any] = {"zones": zones}
        if rng.random() < 0.6:
            names = rng.sample([f"d{i}" for i in range(5)], 2)
            selector["nodes"] = [{"key": "name", "operator": rng.choice(["In", "NotIn"]), "values": names}]
        if rng.random() < 0.15:
            selector["applications"] = {"names": [rng.choice(["app", "another"])]}
        begin, end = rng.choice(
            [(None, None)] * 6 + [(NOW_S + 5, None), (NOW_S + 1e6, None), (None, NOW_S - 5), (None, NOW_S + 5)]
        )
        window = {k: stamp(t) for k, t in (("validFrom", begin), ("validUntil", end)) if t is not None}
        return {"selector": selector} | window

    def flights(self, path: Sequence[tuple[float, float]], drones: list[Drone]) -> dict[str, Flight]:
        """Return flights of another application.

        Each follows the path, reverses it, misses some points, or is elsewhere.
        """
        rng = self.rng
        flights = {}
        for drone in rng.sample(drones, rng.randint(0, min(2, len(drones)))):
            waypoints = list(path)
            match rng.choice(["along", "against", "past", "elsewhere"]):
                case "along":
                    waypoints = [
                        self.somewhere(300),
                        *((x + rng.uniform(-4, 4), y) for x, y in waypoints),
                        self.somewhere(300),
                    ]
                case "against":
                    waypoints = waypoints[::-1]
                case "past":
                    waypoints = [(x, y + rng.choice([0, 30])) for x, y in waypoints]
                case _:
                    waypoints = [self.somewhere(400) for _ in range(3)]
            flights[drone.name] = Flight(
                OTHER, (tuple(Position.model_validate(self.at(x, y, FLOWN_M)) for x, y in waypoints),)
            )
        return flights


def body(kind: str, name: str, spec: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {"apiVersion": "fractus.dev/v1alpha1", "kind": kind, "metadata": {"name": name}, "spec": spec, **more}


def component(name: str, placement: str, **more: Any) -> dict[str, Any]:
    container = {"image": "app", "ports": [{"port": 80}], "resources": {"requests": {"cpu": f"{1000 * CPU:.0f}m"}}}
    return {"name": name, "placement": placement, "container": container, **more}


def stamp(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).isoformat()


# -- oracle --


class Oracle:
    """Expected plan of a scene."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.spec = scene.application.spec
        self.inventory = scene.inventory
        self.free_cpu = {name: host.allocatable["cpu"] for name, host in scene.inventory.hosts.items()}
        self.reasons: dict[str, str] = {}

    def near(self, a: Any, b: Any, limit_m: float) -> bool:
        distance = geodesic_m(a, b)
        if abs(distance - limit_m) < 0.02:
            raise Undecided
        return distance <= limit_m

    def is_host_usable(self, name: str, count: int = 1) -> bool:
        host = self.inventory.hosts[name]
        return host.ready and host.schedulable and self.free_cpu[name] >= count * CPU - 1e-9

    # -- the drone --

    def expected_drone(self) -> str | None:
        """Return the drone that the planner must choose, or None if no drone is suitable."""
        leader = self.spec.leader
        assert leader is not None
        candidates = []
        for name, drone in self.inventory.drones.items():
            flight = self.inventory.flights.get(name)
            shared = self.spec.driver is None and flight is not None and self.visits(flight)
            if not shared and not self.is_at_start(drone):
                continue
            reason = self.reason(drone, shared=shared)
            if reason:
                self.reasons[name] = reason
            else:
                minutes = drone.spec.services.mobility.max_flight_time if drone.spec.services.mobility else 0.0
                assert drone.status is not None
                assert drone.status.battery is not None
                readiness = 2.0 if shared else 0.0 if drone.status.flight_state == "charging" else 1.0
                score = readiness + min(minutes * drone.status.battery.remaining / 1440, 0.999)
                candidates.append((-score, name, shared))
        candidates.sort()
        for _, name, shared in candidates:
            if shared or self.legal(self.inventory.drones[name]):
                return name
            self.reasons[name] = "PolicyConflict"
        if candidates and self.scene.settings.policy_conflicts == "warn":
            for _, name, _ in candidates:
                del self.reasons[name]
            return candidates[0][1]
        return None

    def home(self, drone: Drone) -> Any:
        depot = self.inventory.depots.get(drone.spec.depot or "")
        return drone.spec.home or (depot.spec.location if depot is not None else None)

    def is_at_start(self, drone: Drone) -> bool:
        home = self.home(drone)
        driver = self.spec.driver
        if home is None:
            return False
        first = driver.control_points[0] if driver is not None else None
        point = first.point if first is not None else None
        in_depot = point is not None and point.depot is not None and drone.spec.depot == point.depot
        if point is not None and point.depot is not None:
            named = self.inventory.depots[point.depot].spec
            limit = max(NEAR_M, named.radius) if driver is not None and driver.control == "partial" else named.radius
            return in_depot or self.near(named.location, home, limit)
        if driver is not None and driver.control == "full" and point is not None:
            depot = self.inventory.depots.get(drone.spec.depot or "")
            around = depot is not None and self.near(depot.spec.location, point.position, depot.spec.radius)
            return around or self.near(point.position, home, SAFETY_M)
        return self.near(self.route()[0], home, NEAR_M)

    def route(self) -> list[Any]:
        if self.spec.driver is None:
            assert self.spec.points_of_interest is not None
            return list(self.spec.points_of_interest.points)
        points: list[Any] = []
        for point in self.spec.driver.control_points:
            if point.point is not None:
                points.append(
                    self.inventory.depots[point.point.depot].spec.location
                    if point.point.depot
                    else point.point.position
                )
            points += point.path or ()
        return points

    def reason(self, drone: Drone, *, shared: bool) -> str:
        """Return the rejection reason of the first rule that a drone breaks.

        Return an empty text if it breaks no rule.
        """
        return next((reason for reason, broken in self.rules(drone, shared=shared) if broken), "")

    def rules(self, drone: Drone, *, shared: bool) -> Iterator[tuple[str, bool]]:
        """Yield the rejection reason of each rule in order, and True if the drone breaks the rule."""
        services = drone.spec.services
        mobility = drone.spec.services.mobility
        status = drone.status
        assert status is not None
        drone_components = list(self.spec.on("drone"))
        for request in (request for item in drone_components for request in item.services):
            offered = getattr(services, request.service)
            yield "ServiceMissing", offered is None
            yield "MethodMissing", not set(request.methods) <= set(offered.methods)
        needed = 0.0
        if not shared:
            yield "ServiceMissing", mobility is None
            assert mobility is not None
            yield "TooHigh", mobility.max_altitude < FLOWN_M
            needed = self.flight_min(drone, self.requested_distance_m(drone), CRUISE_MPS, FLOWN_M)
            yield "FlightTooLong", _exceeds(needed, (1 - RESERVE) * mobility.max_flight_time)
            yield "Claimed", drone.name in self.inventory.claimed
        host = self.inventory.hosts[drone.name]
        yield "NodeNotReady", not host.ready
        yield "NodeUnschedulable", not host.schedulable
        yield "DroneNotReady", status.conditions[0].status != "True"
        yield "FlightTooLong", not shared and _exceeds(needed, self.available_min(drone))
        yield "InsufficientResources", self.free_cpu[drone.name] < len(drone_components) * CPU - 1e-9

    def requested_distance_m(self, drone: Drone) -> float:
        stops = [self.home(drone), *self.route(), self.home(drone)]
        return sum(geodesic_m(a, b) for a, b in itertools.pairwise(stops))

    def flight_min(self, drone: Drone, distance_m: float, speed_mps: float, height_m: float) -> float:
        assert drone.spec.services.mobility is not None
        speed = min(speed_mps, commanded_mps(drone.spec.services.mobility.max_speed))
        return (distance_m / speed + 2 * height_m / CLIMB_MPS) / 60

    def available_min(self, drone: Drone) -> float:
        mobility = drone.spec.services.mobility
        status = drone.status
        assert mobility is not None
        assert status is not None
        assert status.battery is not None
        return mobility.max_flight_time * (status.battery.remaining - RESERVE)

    def visits(self, flight: Flight) -> bool:
        """Return True if a flight passes all points in order. The flight is sampled every 0.25 m."""
        xy = [self.scene.xy(p) for leg in flight.legs for p in leg]
        samples = [np.array(xy[0])]
        for a, b in itertools.pairwise(xy):
            count = max(int(math.dist(a, b) / 0.25), 1)
            samples += [np.array(a) + (np.array(b) - np.array(a)) * k / count for k in range(1, count + 1)]
        track = np.array(samples)
        at = 0
        for point in self.route():
            distances = np.hypot(*(track - np.array(self.scene.xy(point))).T)
            if np.abs(distances[at:].min() - SAFETY_M) < 0.3:
                raise Undecided
            inside = np.flatnonzero(distances[at:] <= SAFETY_M)
            if not len(inside):
                # Because of rounding, the planner may count a point just behind the current sample as ahead.
                if (distances[max(at - 4, 0) :] <= SAFETY_M).any():
                    raise Undecided
                return False
            at += int(inside[0])
        return True

    # -- policies --

    def active_policies(self, drone: Drone, minutes: float) -> Iterator[Policy]:
        for policy in self.inventory.policies.values():
            selector = policy.spec.selector
            applications = selector.applications
            if applications is not None and "app" not in applications.names:
                continue
            if any((drone.name in e.values) != (e.operator == "In") for e in selector.nodes):
                continue
            begin, end = policy.spec.window_s
            if begin <= NOW_S + minutes * 60 and end > NOW_S:
                yield policy

    def legal(self, drone: Drone) -> bool:
        requested_min = self.flight_min(drone, self.requested_distance_m(drone), CRUISE_MPS, FLOWN_M)
        policies = list(self.active_policies(drone, requested_min))
        circles = [self.scene.zones[z] for p in policies for z in p.spec.selector.zones]
        speed = CRUISE_MPS
        height = FLOWN_M
        changed = False
        for policy in policies:
            spec = policy.spec
            if spec.kind == "speed" and spec.upper_limit is not None:
                assert drone.spec.services.mobility is not None
                changed |= spec.upper_limit < min(CRUISE_MPS, commanded_mps(drone.spec.services.mobility.max_speed))
                speed = min(speed, commanded_mps(spec.upper_limit))
            elif spec.kind == "altitude":
                if spec.action == "refuse":
                    return False
                height = (
                    min(height, spec.upper_limit or math.inf)
                    if spec.upper_limit
                    else max(height, spec.lower_limit or 0)
                )
                changed = True
        home = self.scene.xy(self.home(drone))
        if _blocked([home, home], circles):
            return False
        stops = [home, *map(self.scene.xy, self.route()), home]
        systems = self.flown_by_system(len(stops) - 1)
        detour = False
        for (a, b), system in zip(itertools.pairwise(stops), systems, strict=True):
            if _blocked([a, b], circles):
                if not system or not self.has_detour(a, b, circles, drone):
                    return False
                detour = True
        if detour or not changed:
            if detour and (0.4 * self.available_min(drone) < requested_min or changed):
                raise Undecided  # The oracle knows that a detour exists, but not its length.
            return True
        return not _exceeds(
            self.flight_min(drone, self.requested_distance_m(drone), speed, height), self.available_min(drone)
        )

    def flown_by_system(self, legs: int) -> list[bool]:
        """Return True for each leg that the system flies.

        These are all legs of a POI mission, legs to control points under partial control, and the last leg.
        """
        driver = self.spec.driver
        if driver is None:
            return [True] * legs
        by_system = []
        for point in driver.control_points:
            places = (point.point is not None) + len(point.path or ())
            by_system += [driver.control == "partial"] + [False] * (places - 1)
        return [*by_system, True]

    def has_detour(self, a: tuple[float, float], b: tuple[float, float], circles: Any, drone: Drone) -> bool:
        """Return True if a grid over the convex hull of operation area and depot has a route between two points."""
        if any(abs(math.dist(p, (x, y)) - r - MARGIN_M) < 3 * STEP_M for p in (a, b) for x, y, r in circles):
            raise Undecided  # The grid is too coarse if a point is near a zone.
        area = operation_area(self.spec, self.inventory.depots, SAFETY_M)
        assert area is not None
        depot = self.inventory.depots.get(drone.spec.depot or "")
        # The origins of the planner's and the oracle's frame are a few hundred metres apart. The error is below a
        # millimetre.
        coordinates = shapely.get_coordinates(area.shape)
        points = [self.scene.frame.xy(*area.frame.latlon(x, y)) for x, y in coordinates]
        depot_area = shapely.Point(self.scene.xy(self.home(drone))).buffer(
            depot.spec.radius if depot is not None else 30.0
        )
        hull = shapely.union(shapely.MultiPoint(points), depot_area).convex_hull
        results = {self.is_connected(a, b, circles, hull, MARGIN_M + slack) for slack in (1.5 * STEP_M, -1.5 * STEP_M)}
        if len(results) > 1:
            raise Undecided
        return results.pop()

    def is_connected(
        self, a: tuple[float, float], b: tuple[float, float], circles: Any, hull: Any, margin_m: float
    ) -> bool:
        if _blocked([b, b], circles):
            return False
        west, south, east, north = hull.bounds
        columns = int((east - west) / STEP_M) + 1
        rows = int((north - south) / STEP_M) + 1
        x, y = np.meshgrid(west + STEP_M * np.arange(columns), south + STEP_M * np.arange(rows), indexing="ij")
        inner = hull.buffer(-margin_m)
        passable = shapely.contains_xy(inner, x, y) if not inner.is_empty else np.zeros_like(x, dtype=bool)
        for cx, cy, radius in circles:
            passable &= np.hypot(x - cx, y - cy) > radius + margin_m
        reach = 2 * STEP_M + max(margin_m, 0)
        begin, goal = (np.hypot(x - p[0], y - p[1]) <= reach for p in (a, b))
        pending = deque(map(tuple, np.argwhere(begin & passable).tolist()))
        visited = begin & passable
        while pending:
            i, j = pending.popleft()
            if goal[i, j]:
                return True
            for di, dj in itertools.product((-1, 0, 1), repeat=2):
                k = i + di
                m = j + dj
                if 0 <= k < columns and 0 <= m < rows and passable[k, m] and not visited[k, m]:
                    visited[k, m] = True
                    pending.append((k, m))
        return False

    # -- edge nodes --

    def check_statics(self, planned: DeploymentPlanSpec | None) -> bool:
        """Check the placements of static components. Without a plan, return True if no plan is possible."""
        slots = [(c.name, i, spot) for c in self.spec.on("edge") for i, spot in enumerate(c.locations)]
        inside = {
            (name, i): sorted(
                (n for n in self.inventory.edge_nodes if self.near(spot.center, self.place(n), spot.radius)),
                key=lambda n, spot=spot: geodesic_m(spot.center, self.place(n)),
            )
            for name, i, spot in slots
        }
        for nodes, (_, _, spot) in zip(inside.values(), slots, strict=True):
            away = [geodesic_m(spot.center, self.place(n)) for n in nodes]
            if any(b - a < 0.01 for a, b in itertools.pairwise(away)):
                raise Undecided
        rooms = {
            n: int(self.free_cpu[n] / CPU + 1e-9) if self.is_host_usable(n) else 0 for n in self.inventory.edge_nodes
        }
        numbered = [(name, i, int(spot.instances)) for name, i, spot in slots if spot.instances != "*"]
        greedy = self.greedy(numbered, inside, rooms)
        most = most_instances(numbered, inside, rooms)
        if planned is None:
            return most is None
        assert most is not None, "the planner returned a plan although no instance is possible at one location"
        self.check_placed(planned, inside, rooms, greedy, most)
        return True

    def check_placed(
        self,
        planned: DeploymentPlanSpec,
        inside: dict[tuple[str, int], list[str]],
        rooms: dict[str, int],
        greedy: dict[tuple[str, int], list[str]],
        most: int,
    ) -> None:
        """Check that the plan has the maximum number of instances.

        They must be on the nearest nodes if these have room.
        """
        slots = [(c.name, i, spot) for c in self.spec.on("edge") for i, spot in enumerate(c.locations)]
        numbered = [(name, i, int(spot.instances)) for name, i, spot in slots if spot.instances != "*"]
        placed: dict[tuple[str, int], list[str]] = {key: [] for key in inside}
        for p in planned.placements:
            if p.role == "static":
                placed[p.component, p.location or 0].append(p.node or "")
        if sum(map(len, greedy.values())) == sum(count for _, _, count in numbered):
            assert {k: placed[k] for k in greedy} == greedy, "instances are not on the nearest nodes"
        assert sum(len(placed[name, i]) for name, i, _ in numbered) == most, (
            "the plan has fewer instances than possible"
        )
        for (name, i), nodes in placed.items():
            assert set(nodes) <= set(inside[name, i]), "an instance is outside its location"
        for name, i, count in numbered:
            assert 1 <= len(placed[name, i]) <= count, "a location has a wrong number of instances"
        for name in {name for name, _, _ in slots}:
            nodes = [n for (c, _), chosen in placed.items() if c == name for n in chosen]
            assert len(nodes) == len(set(nodes)), "two instances of a component are on one node"
        for chosen in placed.values():
            for node in chosen:
                rooms[node] -= 1
                self.free_cpu[node] -= CPU
        assert min(rooms.values(), default=0) >= 0, "a node is overbooked"
        for name, i, spot in slots:
            if spot.instances == "*":
                hosts = {n for (c, _), chosen in placed.items() if c == name for n in chosen}
                assert all(rooms[n] == 0 or n in hosts for n in inside[name, i]), "a suitable node has no instance"

    def place(self, node: str) -> Any:
        return self.inventory.edge_nodes[node].spec.location

    def greedy(self, slots: Any, inside: Any, rooms: dict[str, int]) -> dict[tuple[str, int], list[str]]:
        """Return the nodes of each location as in the thesis: each location in turn gets the nearest free nodes."""
        room_left = dict(rooms)
        taken = set()
        chosen_nodes = {}
        for name, i, count in slots:
            chosen = [n for n in inside[name, i] if room_left[n] > 0 and (name, n) not in taken][:count]
            chosen_nodes[name, i] = chosen
            taken |= {(name, n) for n in chosen}
            for n in chosen:
                room_left[n] -= 1
        return chosen_nodes

    def reach_m(self, a: Any, b: Any) -> float | None:
        ranges = [[i.range for i in node.spec.interfaces if i.range] for node in (a, b)]
        return min(ranges[0][0], ranges[1][0]) if all(ranges) else None

    def expected_hybrids(self, planned: DeploymentPlanSpec) -> list[tuple[str, str]]:
        """Return the expected instances of component Checker as (role, node), in the order of the plan."""
        checker = self.spec.find("Checker")
        placed: list[tuple[str, str]] = []
        for target in checker.hybrid_to if checker is not None else ():
            if self.spec.component(target).placement == "edge":
                for static in [p.node or "" for p in planned.placements if p.component == target]:
                    self.place_beside(static, placed)
            elif planned.drone is not None:
                self.place_along(self.inventory.drones[planned.drone.node], placed)
        return placed

    def place_instance(self, name: str, role: str, placed: list[tuple[str, str]]) -> None:
        self.free_cpu[name] -= CPU
        placed.append((role, name))

    def place_beside(self, static: str, placed: list[tuple[str, str]]) -> None:
        edges = self.inventory.edge_nodes
        static_node = self.inventory.edge_nodes[static]
        in_range = []
        for n in edges:
            reach = self.reach_m(static_node, edges[n])
            if (
                n != static_node.name
                and reach is not None
                and self.near(static_node.spec.location, self.place(n), reach)
            ):
                in_range.append(n)
        in_range.sort(key=lambda n: geodesic_m(static_node.spec.location, self.place(n)))
        for n in [static_node.name, *in_range]:
            if n in {node for _, node in placed}:
                return
            if self.is_host_usable(n):
                self.place_instance(n, "hybrid-edge", placed)
                return

    def place_along(self, drone: Drone, placed: list[tuple[str, str]]) -> None:
        area = operation_area(self.spec, self.inventory.depots, SAFETY_M)
        assert area is not None
        xy = Samples(area.shape).xy()
        covers = {}
        for n, node in sorted(self.inventory.edge_nodes.items()):
            reach = self.reach_m(drone, node)
            if reach is not None:
                distances = np.hypot(*(xy - np.array(area.frame.xy(node.spec.location.lat, node.spec.location.lon))).T)
                covers[n] = distances <= reach
        uncovered = np.ones(len(xy), dtype=bool)
        for n in {node for _, node in placed} & covers.keys():
            uncovered &= ~covers[n]
        free = [n for n in covers if n not in {node for _, node in placed}]
        while free and uncovered.sum() > (1 - 0.95) * len(xy):
            gains = [int((covers[n] & uncovered).sum()) for n in free]
            if max(gains) == 0:
                return
            best = free.pop(gains.index(max(gains)))
            if self.is_host_usable(best):
                self.place_instance(best, "hybrid-drone", placed)
                uncovered &= ~covers[best]


def most_instances(slots: Any, inside: Any, rooms: dict[str, int]) -> int | None:
    """Return the maximum number of instances, by exhaustive search.

    Return None if no instance is possible at one location.
    """

    def best(i: int, used: frozenset[tuple[str, str]]) -> int | None:
        if i == len(slots):
            return 0
        name, index, count = slots[i]
        candidates = [
            n for n in inside[name, index] if (name, n) not in used and sum(m == n for _, m in used) < rooms[n]
        ]
        most: int | None = None
        for k in range(1, count + 1):
            for chosen in itertools.combinations(candidates, k):
                rest = best(i + 1, used | {(name, n) for n in chosen})
                if rest is not None:
                    most = max(most or 0, k + rest)
        return most

    return best(0, frozenset())


def _blocked(leg: Sequence[tuple[float, float]], circles: Sequence[tuple[float, float, float]]) -> bool:
    line = shapely.LineString(leg) if leg[0] != leg[1] else shapely.Point(leg[0])
    for x, y, radius in circles:
        distance = line.distance(shapely.Point(x, y)) - radius - MARGIN_M
        if abs(distance) < 0.05 + 0.02 * radius:  # The planner uses a slightly larger polygon instead of the circle.
            raise Undecided
        if distance < 0:
            return True
    return False


def _exceeds(needed: float, available: float) -> bool:
    if abs(needed - available) < 1e-3 * max(needed, 1):
        raise Undecided
    return needed > available


def deviation(seed: int) -> str | None:
    """Return the difference between plan and oracle for the scene of a seed, or None.

    Raises:
        Undecided: Rounding may decide a comparison.
    """
    scene = SceneBuilder(seed).scene()
    oracle = Oracle(scene)
    problem: Infeasible | None = None
    planned: DeploymentPlanSpec | None = None
    try:
        planned = plan(scene.application, scene.inventory, scene.settings)
    except Infeasible as error:
        problem = error
    try:
        if scene.application.spec.leader is not None and not _compare_drone(oracle, planned, problem):
            return None
        _compare_nodes(oracle, planned, problem)
    except AssertionError as error:
        return str(error) or "asserts"
    return None


def _compare_drone(oracle: Oracle, planned: DeploymentPlanSpec | None, problem: Infeasible | None) -> bool:
    """Compare the chosen drone and the reasons of rejected drones. Return True if the oracle expects a drone."""
    reason = problem.reason if problem is not None else ""
    spec = oracle.spec
    expected = oracle.expected_drone()
    assert (expected is None) == (reason in {"NoDrone", "DroneBusy", "PolicyConflict"}), (
        f"expected drone: {expected}, result of the planner: {reason or 'a plan'}"
    )
    leader = (spec.driver or next(spec.on("drone"))).name
    rejected = problem.rejected if problem is not None else planned.rejected if planned is not None else ()
    reported = {r.node: r.reason for r in rejected if r.component == leader}
    if planned is not None or expected is None:
        wrong = {n: (r, reported.get(n)) for n, r in oracle.reasons.items() if reported.get(n) != r}
        assert not wrong, f"wrong rejection reasons (expected, reported): {wrong}"
    if expected is None:
        return False
    assert planned is None or (planned.drone is not None and planned.drone.node == expected), (
        f"the plan does not use drone {expected}"
    )
    oracle.free_cpu[expected] -= CPU * len(list(spec.on("drone")))
    return True


def _compare_nodes(oracle: Oracle, planned: DeploymentPlanSpec | None, problem: Infeasible | None) -> None:
    """Compare the placements of the components that do not fly."""
    if problem is not None and problem.reason == "NoEdgeNode":
        assert oracle.check_statics(None), "an instance is possible at every location"
        return
    clouds = [
        n
        for n, h in oracle.inventory.hosts.items()
        if h.labels["fractus.dev/class"] == "cloud" and oracle.is_host_usable(n)
    ]
    assert (planned is None) == (not clouds), f"cloud {clouds}, {problem}"
    if planned is None:
        return
    oracle.check_statics(planned)
    placed = [(p.role, p.node) for p in planned.placements if p.component == "Checker" and p.node is not None]
    expected = oracle.expected_hybrids(planned)
    assert placed == expected, f"hybrids {placed}, not {expected}"

"""From an application and an inventory to a deployment plan that explains itself (thesis 8.5, with its errata)."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence

import shapely

from fractus_core.api.applications import Application, Component
from fractus_core.api.geometry import Point
from fractus_core.api.nodes import Drone, EdgeNode
from fractus_core.api.plans import (
    Alternative,
    DeploymentPlanSpec,
    DroneChoice,
    PlannedInstance,
    Rejection,
    Role,
    Serves,
)
from fractus_core.geo import geodesic_m, geojson, ground
from fractus_core.planning.area import OperationArea, length_m, operation_area, start_of
from fractus_core.planning.candidates import (
    SUITABLE,
    Check,
    Ledger,
    check_host,
    check_resources,
    check_services,
    direct_reach_m,
    requests,
)
from fractus_core.planning.inventory import Inventory, Settings


class Infeasible(Exception):
    """No plan exists for the application; says which component has no host and why each node was dropped."""

    def __init__(self, component: str, reason: str, message: str, rejected: Iterable[Rejection] = ()) -> None:
        self.component = component
        self.reason = reason
        self.message = message
        self.rejected = tuple(rejected)
        super().__init__(message)


def plan(
    application: Application,
    inventory: Inventory,
    settings: Settings | None = None,
    previous: DeploymentPlanSpec | None = None,
) -> DeploymentPlanSpec:
    """Choose a host for every instance of every component.

    Ties go by name, so that the same inventory always gives the same plan; hosts of the previous plan come first as
    long as they are suitable, so that a new plan moves as little as it can.

    Raises:
        Infeasible: some component has no suitable node.
        InvalidObject: the application names an unknown depot or its geometry is broken.
    """
    return _Planning(application, inventory, settings or Settings(), previous).run()


def instance_name(application: str, component: Component, node: str | None = None) -> str:
    """Name of an instance: at most 63 characters, a DNS label; long names end in a hash instead."""
    name = "-".join(filter(None, (application, component.slug, node))).replace(".", "-")
    if len(name) <= 57:
        return name
    return name[:48].rstrip("-") + "-" + hashlib.sha256(name.encode()).hexdigest()[:8]


class _Planning:
    """One run of the planner: the inputs, what is booked so far, and what was rejected."""

    def __init__(
        self, application: Application, inventory: Inventory, settings: Settings, previous: DeploymentPlanSpec | None
    ) -> None:
        self.application = application
        self.spec = application.spec
        self.inventory = inventory
        self.settings = settings
        self.rejected: list[Rejection] = []
        self.placements: list[PlannedInstance] = []
        self.previous = previous
        self.used_before = {(p.component, p.node) for p in previous.placements} if previous else set()
        self.ledger = Ledger(inventory.hosts, _own_requests(application, previous))

    def run(self) -> DeploymentPlanSpec:
        area = operation_area(self.spec, self.inventory.depots, self.settings.safety_radius_m)
        on_drone = list(self.spec.on("drone"))
        choice = self._choose_drone(on_drone, area) if on_drone and area is not None else None
        for component in self.spec.on("edge"):
            self._place_static(component)
        for component in self.spec.on("hybrid"):
            self._place_hybrid(component, area, choice)
        for component in self.spec.on("cloud"):
            self._place_cloud(component, component.replicas or 1)
        return DeploymentPlanSpec(
            application=self.application.name,
            application_generation=self.application.metadata.generation,
            operation_area=geojson(area.frame, area.shape) if area is not None else None,
            drone=choice,
            placements=tuple(self.placements),
            rejected=tuple(self.rejected),
        )

    # -- the drone (Algorithms 6 and 9) --

    def _choose_drone(self, components: list[Component], area: OperationArea) -> DroneChoice:
        leader = self.spec.driver or components[0]
        ranked: list[tuple[tuple[bool, bool, float, str], Drone, float]] = []
        dropped: list[Rejection] = []
        before = self.previous.drone.node if self.previous is not None and self.previous.drone is not None else None
        for drone in self.inventory.drones.values():
            kept = drone.name == before
            check = self._check_drone(drone, components, area, kept=kept)
            if not check:
                dropped.append(check.rejection(leader, drone.name))
                continue
            minutes = _remaining_minutes(drone)
            charging = drone.status is not None and drone.status.flight_state == "charging"
            ranked.append(((not kept, charging, -minutes, drone.name), drone, minutes))
        dropped.sort(key=lambda r: r.node)
        if not ranked:
            why = "; ".join(f"{r.node}: {r.message}" for r in dropped[:5]) or "there is no drone"
            busy = [r for r in dropped if r.reason == "Claimed"]
            reason = "DroneBusy" if busy else "NoDrone"
            raise Infeasible(leader.name, reason, f"no drone can fly {leader.name}: {why}", dropped)
        self.rejected += dropped
        ranked.sort(key=lambda entry: entry[0])
        best = ranked[0][1]
        for component in components:
            self.ledger.take(best.name, component)
            self._add(component, "drone", best.name, instance_name(self.application.name, component))
        return DroneChoice(
            node=best.name,
            alternatives=tuple(Alternative(node=d.name, score=round(m, 2)) for _, d, m in ranked[1:11]),
        )

    def _check_drone(self, drone: Drone, components: list[Component], area: OperationArea, *, kept: bool) -> Check:
        """Whether the drone can fly the application.

        A drone that already has it (kept) is not given up for what passes or comes with the mission: a lost link, a
        restarted service, a battery that the flight has drained.
        """
        owner = self.inventory.claimed.get(drone.name)
        if owner is not None and owner != self.application.key:
            return Check("Claimed", f"{owner[0]}/{owner[1]} has it")
        lasting = self._check_stand(drone, area) and check_services(drone.spec.services, components)
        if kept:
            return check_host(self.inventory.hosts, drone.name, self.settings, kept=True) and lasting
        return (
            check_host(self.inventory.hosts, drone.name, self.settings)
            and _check_state(drone)
            and lasting
            and self._check_flight_time(drone, area)
            and check_resources(self.ledger, drone.name, components)
        )

    def _check_stand(self, drone: Drone, area: OperationArea) -> Check:
        """Whether the drone stands where the application wants it to start."""
        home = self._home(drone)
        if home is None:
            return Check(
                "NoHome", f"{drone.name} has neither a depot that exists nor a home; set spec.depot or spec.home"
            )
        driver = self.spec.driver
        first = driver.control_points[0] if driver is not None else None
        if first is not None and first.point is not None and first.point.depot is not None:
            name = first.point.depot
            depot = self.inventory.depots[name].spec
            if drone.spec.depot == name or geodesic_m(home, depot.location) <= depot.radius:
                return SUITABLE
            return Check("OtherDepot", f"{drone.name} is kept in {drone.spec.depot or 'no depot'}, not in {name}")
        distance = geodesic_m(home, area.start)
        limit = self.settings.depot_radius_m
        if first is not None and (driver is None or driver.control != "partial"):
            start = start_of(first, self.inventory.depots)
            if start is not None:
                limit = self.settings.safety_radius_m
        if distance > limit:
            return Check("TooFar", f"{drone.name} is {distance:.0f} m from the start, more than {limit:.0f} m")
        return SUITABLE

    def _home(self, drone: Drone) -> Point | None:
        if drone.spec.home is not None:
            return ground(drone.spec.home)
        depot = self.inventory.depots.get(drone.spec.depot or "")
        return depot.spec.location if depot is not None else None

    def _check_flight_time(self, drone: Drone, area: OperationArea) -> Check:
        home = self._home(drone)
        mobility = drone.spec.services.mobility
        if home is None or mobility is None:
            return SUITABLE
        way = [home, *(ground(p) for p in area.route), home]
        speed = min(self.settings.cruise_speed_mps, mobility.max_speed)
        height = max((p.alt or 0.0 for p in area.route), default=0.0)
        needed = (length_m(area.frame, way) / speed + 2 * height / self.settings.climb_speed_mps) / 60
        available = _remaining_minutes(drone) - self.settings.battery_reserve * mobility.max_flight_time
        if needed > available:
            return Check(
                "FlightTooLong",
                f"{drone.name} can fly {max(available, 0):.1f} min with its reserve kept; the mission takes {needed:.1f} min",
            )
        return SUITABLE

    # -- static edge components (Algorithms 7 and 9) --

    def _place_static(self, component: Component) -> None:
        rejected: dict[str, Rejection] = {}
        placed: set[str] = set()
        for i, location in enumerate(component.locations):
            near = []
            for node in self.inventory.edge_nodes.values():
                distance = geodesic_m(ground(node.spec.location), location.center)
                if distance > location.radius:
                    message = f"{node.name} is {distance:.0f} m from the centre of locations[{i}], more than {location.radius:.0f} m"
                    rejected.setdefault(node.name, Check("OutsideLocation", message).rejection(component, node.name))
                    continue
                near.append(((component.name, node.name) not in self.used_before, distance, node.name))
            wanted = len(near) if location.instances == "*" else location.instances
            count = 0
            for _, _, name in sorted(near):
                if count == wanted:
                    break
                if name in placed:
                    continue
                check = self._check_edge(self.inventory.edge_nodes[name], [component])
                if not check:
                    rejected[name] = check.rejection(component, name)
                    continue
                count += 1
                placed.add(name)
                rejected.pop(name, None)
                self.ledger.take(name, component)
                self._add(component, "static", name, instance_name(self.application.name, component, name))
            if count == 0 and location.instances != "*":
                why = "; ".join(r.message for r in list(rejected.values())[:5]) or "there is no edge node"
                raise Infeasible(
                    component.name,
                    "NoEdgeNode",
                    f"no node can host {component.name} at locations[{i}]: {why}",
                    rejected.values(),
                )
        self.rejected += sorted((r for n, r in rejected.items() if n not in placed), key=lambda r: r.node)

    def _check_edge(self, node: EdgeNode, components: Sequence[Component]) -> Check:
        kept = all((c.name, node.name) in self.used_before for c in components)
        return (
            check_host(self.inventory.hosts, node.name, self.settings, kept=kept)
            and check_services(node.spec.services, components)
            and check_resources(self.ledger, node.name, components)
        )

    # -- hybrid components (Algorithms 8 and 10) --

    def _place_hybrid(self, component: Component, area: OperationArea | None, choice: DroneChoice | None) -> None:
        self._place_cloud(component, 1)
        hosts: set[str] = set()
        for other_name in component.hybrid_to:
            other = self.spec.component(other_name)
            if other.placement == "edge":
                for instance in [p for p in self.placements if p.component == other_name and p.node is not None]:
                    self._place_beside(component, instance, hosts)
            elif area is not None and choice is not None:
                self._cover(component, other_name, area, choice, hosts)

    def _place_beside(self, component: Component, instance: PlannedInstance, hosts: set[str]) -> None:
        """The static instance's own node first, then the nearest node within its direct reach."""
        here = self.inventory.edge_nodes[instance.node or ""]
        reachable = []
        for node in self.inventory.edge_nodes.values():
            distance = geodesic_m(ground(here.spec.location), ground(node.spec.location))
            reach = direct_reach_m(here.spec.interfaces, node.spec.interfaces)
            if node.name == here.name or (reach is not None and distance <= reach):
                kept = (component.name, node.name) in self.used_before
                reachable.append((node.name != here.name, not kept, distance, node.name))
        serves = Serves(component=instance.component, node=here.name)
        for _, _, _, name in sorted(reachable):
            if name in hosts:
                return
            check = self._check_edge(self.inventory.edge_nodes[name], [component])
            if check:
                hosts.add(name)
                self.ledger.take(name, component)
                self._add(
                    component, "hybrid-edge", name, instance_name(self.application.name, component, name), serves=serves
                )
                return
            self.rejected.append(check.rejection(component, name))

    def _cover(
        self, component: Component, other: str, area: OperationArea, choice: DroneChoice, hosts: set[str]
    ) -> None:
        """Greedily add the node that covers most of what is still uncovered, until the share is reached."""
        drone = self.inventory.drones[choice.node]
        footprints: dict[str, shapely.Geometry] = {}
        for node in sorted(self.inventory.edge_nodes.values(), key=lambda n: n.name):
            reach = direct_reach_m(drone.spec.interfaces, node.spec.interfaces)
            if reach is None:
                check = Check("NoDirectInterface", f"{node.name} has no interface that pairs with {drone.name}'s")
            else:
                x, y = area.frame.xy(node.spec.location.lat, node.spec.location.lon)
                footprint = shapely.Point(x, y).buffer(reach, quad_segs=32).intersection(area.shape)
                if footprint.area > 0:
                    footprints[node.name] = footprint
                    continue
                check = Check(
                    "NoCoverage", f"{node.name} reaches {reach:.0f} m and covers nothing of the operation area"
                )
            self.rejected.append(check.rejection(component, node.name))
        total = area.shape.area
        covered: shapely.Geometry = shapely.union_all([footprints[n] for n in hosts if n in footprints])
        while footprints and covered.area < self.settings.coverage_share * total:
            gains = {n: f.difference(covered).area for n, f in footprints.items() if n not in hosts}
            if not gains:
                break
            name = min(gains, key=lambda n: (-round(gains[n], 3), (component.name, n) not in self.used_before, n))
            if gains[name] <= 1e-6 * total:
                break
            footprint = footprints.pop(name)
            check = self._check_edge(self.inventory.edge_nodes[name], [component])
            if not check:
                self.rejected.append(check.rejection(component, name))
                continue
            covered = covered.union(footprint)
            hosts.add(name)
            self.ledger.take(name, component)
            self._add(
                component,
                "hybrid-drone",
                name,
                instance_name(self.application.name, component, name),
                serves=Serves(component=other, node=choice.node),
                coverage=round(gains[name] / total, 6),
            )

    # -- the cloud --

    def _place_cloud(self, component: Component, replicas: int) -> None:
        rejected: list[Rejection] = []
        for host in sorted(self.inventory.hosts.values(), key=lambda h: h.name):
            if host.node_class != "cloud":
                continue
            check = check_host(self.inventory.hosts, host.name, self.settings) and check_resources(
                self.ledger, host.name, [component]
            )
            if check:
                self._add(component, "cloud", None, instance_name(self.application.name, component), replicas=replicas)
                self.rejected += rejected
                return
            rejected.append(check.rejection(component, host.name))
        why = "; ".join(r.message for r in rejected[:5]) or "no Node has the label fractus.dev/class=cloud"
        raise Infeasible(component.name, "NoCloudNode", f"no cloud node can host {component.name}: {why}", rejected)

    def _add(
        self,
        component: Component,
        role: Role,
        node: str | None,
        instance: str,
        *,
        replicas: int = 1,
        serves: Serves | None = None,
        coverage: float | None = None,
    ) -> None:
        self.placements.append(
            PlannedInstance(
                component=component.name,
                instance=instance,
                node=node,
                placement=component.placement,
                role=role,
                replicas=replicas,
                serves=serves,
                coverage=coverage,
            )
        )


def _own_requests(application: Application, previous: DeploymentPlanSpec | None) -> dict[str, dict[str, float]]:
    """What the application's own pods of the previous plan hold: it is theirs to use again."""
    held: dict[str, dict[str, float]] = {}
    components = {c.name: c for c in application.spec.components}
    for placed in previous.placements if previous else ():
        if placed.node is None or placed.component not in components:
            continue
        for resource, amount in requests(components[placed.component]).items():
            on_node = held.setdefault(placed.node, {})
            on_node[resource] = on_node.get(resource, 0.0) + amount
    return held


def _check_state(drone: Drone) -> Check:
    status = drone.status
    ready = next((c for c in status.conditions if c.type == "Ready"), None) if status else None
    if ready is None:
        return Check("DroneUnknown", f"{drone.name} has not reported yet")
    if ready.status != "True":
        return Check("DroneNotReady", ready.message or f"{drone.name} is not Ready ({ready.reason})")
    return SUITABLE


def _remaining_minutes(drone: Drone) -> float:
    mobility = drone.spec.services.mobility
    if mobility is None:
        return 0.0
    battery = drone.status.battery if drone.status else None
    return mobility.max_flight_time * (battery.remaining if battery else 1.0)

"""What planning looks at: hosts, drones, edge nodes, depots, who has which drone, and what may be tuned."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from fractus_core.api.geometry import Position
from fractus_core.api.model import InvalidObject, quantity
from fractus_core.api.names import CLASS_LABEL, CLOUD_LABEL
from fractus_core.api.nodes import Depot, Drone, EdgeNode
from fractus_core.api.policies import Policy, Zone
from fractus_core.planning.coverage import CoverStrategy
from fractus_core.planning.spatial_index import NodeLocations


@dataclass(frozen=True, slots=True)
class Host:
    """A Kubernetes Node.

    Attributes:
        allocatable: what it offers to pods, resource name to quantity in base units (cores, bytes, pieces).
        requested: what the pods on it have asked for, the same way; those of the application that is planned do not count.
        guarded: whether its kubelet turns away pods that do not tolerate the taint of drones and edge nodes, also those that name it.
    """

    name: str
    labels: Mapping[str, str] = field(default_factory=dict)
    allocatable: Mapping[str, float] = field(default_factory=dict)
    requested: Mapping[str, float] = field(default_factory=dict)
    ready: bool = True
    schedulable: bool = True
    guarded: bool = False

    @property
    def is_cloud(self) -> bool:
        """Whether it takes the cloud's pods, as a node of that class or beside another one."""
        return self.labels.get(CLASS_LABEL) == "cloud" or self.labels.get(CLOUD_LABEL) == "true"


@dataclass(frozen=True, slots=True)
class Flight:
    """Where a drone flies, or will fly, for the application that has it; others may come along.

    Attributes:
        holder: (namespace, name) of the application that has the drone.
        legs: polylines flown in order; between them nothing is known of the way (a driver's region).
        reached: how many points of the legs, counted in order, lie behind the drone already.
    """

    holder: tuple[str, str]
    legs: tuple[tuple[Position, ...], ...]
    reached: int = 0


@dataclass(frozen=True, slots=True)
class Inventory:
    """All that a plan and its grants are made from; every mapping is by object name.

    Attributes:
        unreadable_policies: policies that exist but cannot be read, with what is wrong: they may hold for every component.
        unreadable_zones: zones that exist but cannot be read, with what is wrong.
        claimed: drones that an application has, by drone: (namespace, name) of the application.
        flights: what claimed drones fly, by drone, as far as it is known; without it no application can come along.
        locations: indexes of these very mappings, kept current by the caller; None: built when first needed.
    """

    hosts: Mapping[str, Host] = field(default_factory=dict)
    drones: Mapping[str, Drone] = field(default_factory=dict)
    edge_nodes: Mapping[str, EdgeNode] = field(default_factory=dict)
    depots: Mapping[str, Depot] = field(default_factory=dict)
    zones: Mapping[str, Zone] = field(default_factory=dict)
    policies: Mapping[str, Policy] = field(default_factory=dict)
    unreadable_policies: Mapping[str, str] = field(default_factory=dict)
    unreadable_zones: Mapping[str, str] = field(default_factory=dict)
    claimed: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    flights: Mapping[str, Flight] = field(default_factory=dict)
    locations: NodeLocations | None = field(default=None, compare=False, repr=False)
    _built: list[NodeLocations] = field(default_factory=list, init=False, compare=False, repr=False)

    def located(self) -> NodeLocations:
        """The indexes: those given, or built once from the mappings."""
        if self.locations is not None:
            return self.locations
        if not self._built:
            cloud = (host.name for host in self.hosts.values() if host.is_cloud)
            self._built.append(
                NodeLocations.of(edge_nodes=self.edge_nodes, drones=self.drones, depots=self.depots, cloud=cloud)
            )
        return self._built[0]


@dataclass(frozen=True, slots=True)
class DroneFacts:
    """What ranks a drone that can fly an application.

    Attributes:
        used: it flies for another application already, and this one would come along.
        charging: it stands at its charger.
        remaining_min: minutes it can fly with what its battery holds.
        needed_min: minutes that the application takes of them; 0 when it comes along.
        distance_m: from where it stands to where the work starts.
    """

    drone: Drone
    used: bool
    charging: bool
    remaining_min: float
    needed_min: float
    distance_m: float


DroneScore = Callable[[DroneFacts], float]
"""Scores a drone, higher is better; equals go by name."""


PolicyConflicts = Literal["warn", "forbid"]

_BOUNDS = {
    "safety_radius_m": ("safety radius", 0.1, 10_000.0),
    "depot_radius_m": ("depot radius", 0.0, math.inf),
    "coverage_share": ("coverage", 0.0, 1.0),
    "cruise_speed_mps": ("cruise speed", 0.1, 1000.0),
    "climb_speed_mps": ("climb speed", 0.1, 1000.0),
    "battery_reserve": ("battery reserve", 0.0, 1.0),
}


@dataclass(frozen=True, slots=True)
class Settings:
    """What an installation may tune.

    Attributes:
        safety_radius_m: how far paths are dilated (thesis 8.9.2: 7 m).
        depot_radius_m: how far a depot may be from an open or partial start.
        coverage_share: share of the operation area that hybrid instances should cover with direct links.
        cruise_speed_mps: ground speed assumed for flight times, unless the drone is slower.
        climb_speed_mps: vertical speed assumed for flight times.
        battery_reserve: share of a full charge that must be left after landing.
        excluded: hosts not to use, with the reason, such as one the scheduler refused.
        near_misses: how many nodes a plan lists that were too far away to be candidates, for each place asked for.
        near_miss_m: how far from there they may be to be listed.
        rejections_listed: how many rejected nodes a plan lists at most, so that it fits into an object of Kubernetes.
        time_s: when the flight begins, in seconds since 1970; None: what policies say of its way is not asked.
        policy_conflicts: what becomes of a mission whose way policies do not let be flown, where no drone has another one:
            the plan warns, or there is none.
        flat_terrain: whether the ground counts as level with home everywhere, as for the mobility service.
        score_drone: replaces the ranking of drones.
        cover: replaces the choice of nodes that cover the operation area.
    """

    safety_radius_m: float = 7.0
    depot_radius_m: float = 2000.0
    coverage_share: float = 0.95
    cruise_speed_mps: float = 5.0
    climb_speed_mps: float = 1.5
    battery_reserve: float = 0.2
    excluded: Mapping[str, str] = field(default_factory=dict)
    near_misses: int = 20
    near_miss_m: float = 100_000.0
    rejections_listed: int = 5000
    time_s: float | None = None
    policy_conflicts: PolicyConflicts = "warn"
    flat_terrain: bool = False
    score_drone: DroneScore | None = None
    cover: CoverStrategy | None = None

    def __post_init__(self) -> None:
        """Refuse numbers that no plan can be made with.

        Raises:
            InvalidObject: naming the setting.
        """
        for name, (spelled, minimum, maximum) in _BOUNDS.items():
            value = getattr(self, name)
            if not minimum <= value <= maximum:
                raise InvalidObject(spelled, f"must be {minimum:g} to {maximum:g}, not {value:g}")


_RARE_SCALE = {"n": 1e-9, "u": 1e-6, "E": 1e18, "Ei": 2.0**60}


def amount_of(text: str | float) -> float:
    """Value of any quantity that the API server may hold, also those that manifests of ours may not use.

    Raises:
        ValueError: it is not a quantity.
    """
    try:
        return quantity(text)
    except ValueError:
        digits = str(text)
        for suffix, scale in _RARE_SCALE.items():
            if digits.endswith(suffix):
                return float(digits.removesuffix(suffix)) * scale
        return float(digits)

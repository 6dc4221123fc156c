"""Input of planning: hosts, drones, edge nodes, depots, claimed drones, and settings."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
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
        allocatable: Resources for pods, by resource name, in base units (cores, bytes, items).
        requested: Resource requests of its pods in the same units, except for pods of the planned application.
        guarded: True if its kubelet rejects pods that do not tolerate the taint of drones and edge nodes, even with nodeName.
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
        """True if the node accepts cloud pods, because of its class or of the label `CLOUD_LABEL`."""
        return self.labels.get(CLASS_LABEL) == "cloud" or self.labels.get(CLOUD_LABEL) == "true"


@dataclass(frozen=True, slots=True)
class Flight:
    """Flight of a drone for the application that uses it. Other applications may share it.

    Attributes:
        holder: (namespace, name) of the application that uses the drone.
        legs: Polylines flown in order. The route between them is unknown (regions of a driver).
        reached: Number of points of the legs, counted in order, that the drone has passed.
    """

    holder: tuple[str, str]
    legs: tuple[tuple[Position, ...], ...]
    reached: int = 0


@dataclass(frozen=True, slots=True)
class Reservation:
    """Time for which a flight plan has reserved a drone.

    Attributes:
        holder: namespace/name of the flight plan.
        begin_s: First moment in seconds since 1970 UTC.
        end_s: Last moment in seconds since 1970 UTC.
    """

    holder: str
    begin_s: float
    end_s: float


@dataclass(frozen=True, slots=True)
class Inventory:
    """All objects that a plan and its Grants depend on; every mapping is by object name.

    Attributes:
        unreadable_policies: Invalid policies with their problems. They may apply to every component.
        unreadable_zones: Invalid zones with their problems.
        claimed: (namespace, name) of the application that uses a drone, by drone.
        flights: Known flights of claimed drones, by drone. Only known flights can be shared.
        reservations: Reservations of other flight plans, by drone.
        locations: Indexes of these mappings that the caller keeps current, or None to build them when needed.
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
    reservations: Mapping[str, Sequence[Reservation]] = field(default_factory=dict)
    locations: NodeLocations | None = field(default=None, compare=False, repr=False)
    _built: list[NodeLocations] = field(default_factory=list, init=False, compare=False, repr=False)

    def located(self) -> NodeLocations:
        """Return `locations`, or build the indexes once from the mappings."""
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
    """Properties that rank a suitable drone.

    Attributes:
        used: True if the application would share the flight of another application.
        charging: True if the drone is charging.
        remaining_min: Flight time in minutes with the present charge.
        needed_min: Flight time of the mission in minutes; 0 for a shared flight.
        distance_m: Distance from the parking position to the start of the mission.
    """

    drone: Drone
    used: bool
    charging: bool
    remaining_min: float
    needed_min: float
    distance_m: float


DroneScore = Callable[[DroneFacts], float]
"""Scores a drone; higher is better. Ties are resolved by name."""


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
    """Planning settings of an installation.

    Attributes:
        safety_radius_m: Distance by which paths are dilated (thesis 8.9.2: 7 m).
        depot_radius_m: Maximum distance between a depot and an open or partial start.
        coverage_share: Share of the operation area that hybrid instances should cover with direct links, 0 to 1.
        cruise_speed_mps: Assumed ground speed, unless the drone is slower.
        climb_speed_mps: Assumed vertical speed.
        battery_reserve: Share of the full charge that must remain after landing, 0 to 1.
        excluded: Hosts that must not be used, with the reason (such as a refusal of the scheduler).
        near_misses: Number of nodes out of range that a plan lists for each requested location.
        near_miss_m: Maximum distance of these nodes from the location.
        rejections_listed: Maximum number of rejected nodes in a plan, so that it fits into a Kubernetes object.
        time_s: Start of the flight in seconds since 1970, or None to skip the legality check of the route and the check of
            reservations.
        until_s: End of the time in which the drone is needed, or None for the estimated end of the mission.
        begins_later: True if the flight begins so much later that the present state, charge and links of nodes do not matter.
        policy_conflicts: Handling of a mission whose route the policies allow for no drone: `warn` plans it with a warning,
            `forbid` does not plan it.
        flat_terrain: True to assume terrain level with home everywhere, as in the mobility service.
        gateway: False if the drones have no gateway for MAVLink programs.
        score_drone: Replacement for the ranking of drones.
        cover: Replacement for the selection of nodes that cover the operation area.
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
    until_s: float | None = None
    begins_later: bool = False
    policy_conflicts: PolicyConflicts = "warn"
    flat_terrain: bool = False
    gateway: bool = True
    score_drone: DroneScore | None = None
    cover: CoverStrategy | None = None

    def __post_init__(self) -> None:
        """Validate the settings.

        Raises:
            InvalidObject: A setting is out of range.
        """
        for name, (label, minimum, maximum) in _BOUNDS.items():
            value = getattr(self, name)
            if not minimum <= value <= maximum:
                raise InvalidObject(label, f"must be {minimum:g} to {maximum:g}, not {value:g}")


_RARE_SCALE = {"n": 1e-9, "u": 1e-6, "E": 1e18, "Ei": 2.0**60}


def amount_of(text: str | float) -> float:
    """Convert any Kubernetes quantity to its base unit, including the suffixes that Fractus manifests may not use.

    Raises:
        ValueError: The text is not a quantity.
    """
    try:
        return quantity(text)
    except ValueError:
        digits = str(text)
        for suffix, scale in _RARE_SCALE.items():
            if digits.endswith(suffix):
                return float(digits.removesuffix(suffix)) * scale
        return float(digits)

"""What planning looks at: hosts, drones, edge nodes, depots, and who has which drone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from fractus_core.api.nodes import Depot, Drone, EdgeNode
from fractus_core.api.policies import Policy, Zone

CLASS_LABEL = "fractus.dev/class"


@dataclass(frozen=True, slots=True)
class Host:
    """A Kubernetes Node.

    Attributes:
        allocatable: what it offers to pods, resource name to quantity in base units (cores, bytes, pieces).
        requested: what the pods on it have asked for, the same way.
    """

    name: str
    labels: Mapping[str, str] = field(default_factory=dict)
    allocatable: Mapping[str, float] = field(default_factory=dict)
    requested: Mapping[str, float] = field(default_factory=dict)
    ready: bool = True
    schedulable: bool = True

    @property
    def node_class(self) -> str | None:
        """drone, edge or cloud; None for a node that Fractus does not use."""
        return self.labels.get(CLASS_LABEL)


@dataclass(frozen=True, slots=True)
class Inventory:
    """All that a plan and its grants are made from; every mapping is by object name.

    Attributes:
        claimed: drones that an application has, by drone: (namespace, name) of the application.
    """

    hosts: Mapping[str, Host] = field(default_factory=dict)
    drones: Mapping[str, Drone] = field(default_factory=dict)
    edge_nodes: Mapping[str, EdgeNode] = field(default_factory=dict)
    depots: Mapping[str, Depot] = field(default_factory=dict)
    zones: Mapping[str, Zone] = field(default_factory=dict)
    policies: Mapping[str, Policy] = field(default_factory=dict)
    claimed: Mapping[str, tuple[str, str]] = field(default_factory=dict)


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
    """

    safety_radius_m: float = 7.0
    depot_radius_m: float = 2000.0
    coverage_share: float = 0.95
    cruise_speed_mps: float = 5.0
    climb_speed_mps: float = 1.5
    battery_reserve: float = 0.2
    excluded: Mapping[str, str] = field(default_factory=dict)

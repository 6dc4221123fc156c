"""Flight plans and restrictions of virtual drones, and the manifests that are created from them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from fractus_core.api import API_VERSION
from fractus_core.api.methods import Interface
from fractus_sim.errors import ExperimentError

Waypoint = tuple[float, float, float]
"""Latitude and longitude in degrees, altitude in metres above home."""

Action = Literal["ignore", "adjust", "hover", "land", "returnToLaunch", "abort", "revoke"]
Manifest = dict[str, Any]

_MOBILITY_METHODS = (
    "Arm", "Disarm", "Takeoff", "Land", "Goto", "Hover", "SetSpeed", "GetSpeed", "SetVelocity", "GetPosition",
    "ReturnToLaunch",
)  # fmt: skip
_CAMERA_METHODS = ("CaptureImage", "RetrieveImage", "ListImages", "DeleteImage")
_DEPOT_RADIUS_M = 10.0
_REGION_MINUTES = 15


def polygon(*corners: tuple[float, float]) -> Manifest:
    """Return a polygonal area. Corners are latitude and longitude in degrees, in order."""
    return {"polygon": {"exterior": [{"lat": lat, "lon": lon} for lat, lon in corners]}}


def circle(lat: float, lon: float, radius: float) -> Manifest:
    """Return an area around a position in degrees. The radius is in metres."""
    return {"circle": {"center": {"lat": lat, "lon": lon}, "radius": radius}}


@dataclass(frozen=True)
class Restriction:
    """A policy, and the zone in which it applies.

    Attributes:
        name: Name of the policy and of its zone: lower-case letters, digits and hyphens.
        policy: Spec of the Policy manifest, without zones in its selector.
        area: Area of the zone, as `polygon` or `circle` returns it. None: the policy applies everywhere.
    """

    name: str
    policy: Mapping[str, Any]
    area: Mapping[str, Any] | None = None

    def manifests(self) -> list[Manifest]:
        """Return the Policy and its Zone."""
        selector = dict(self.policy.get("selector", {}))
        if self.area is None:
            return [_manifest("Policy", self.name, {**self.policy, "selector": selector})]
        selector["zones"] = [self.name]
        return [
            _manifest("Zone", self.name, {"area": self.area}),
            _manifest("Policy", self.name, {**self.policy, "selector": selector}),
        ]


def no_fly(
    name: str,
    area: Mapping[str, Any],
    action: Action = "ignore",
    *,
    land_at: tuple[float, float] | None = None,
    priority: int = 100,
) -> Restriction:
    """Forbid flights above an area.

    Args:
        name: Name of the policy and of its zone.
        area: Area, as `polygon` or `circle` returns it.
        action: Repair action on a violation. `ignore` refuses the request, and the flight continues.
        land_at: Latitude and longitude where the drone lands after an `abort`. None: at home.
        priority: Precedence among equally restrictive policies.
    """
    policy: Manifest = {"type": "GeofenceControl", "kind": "exclusion", "action": action, "priority": priority}
    if land_at is not None:
        policy["landAt"] = {"lat": land_at[0], "lon": land_at[1]}
    return Restriction(name, policy, area)


def stay_inside(name: str, area: Mapping[str, Any], action: Action = "adjust") -> Restriction:
    """Forbid flights outside of an area. `adjust` ends a leg at the last legal point."""
    return Restriction(name, {"type": "GeofenceControl", "kind": "inclusion", "action": action}, area)


def no_photo(name: str, area: Mapping[str, Any], action: str = "refuse") -> Restriction:
    """Refuse pictures that show an area, or filter them (`black`, `blurAverage`, `blurFaces`, ...)."""
    return Restriction(name, {"type": "PrivacyControl", "kind": "camera", "action": action}, area)


def max_altitude(metres: float, *, refuse: bool = False) -> Restriction:
    """Limit the altitude above home. Higher requests are corrected, or refused."""
    return Restriction("max-altitude", _limit("altitude", metres, refuse=refuse))


def max_speed(mps: float, *, refuse: bool = False) -> Restriction:
    """Limit the speed in metres per second. Faster requests are corrected, or refused."""
    return Restriction("max-speed", _limit("speed", mps, refuse=refuse))


def _limit(kind: str, upper: float, *, refuse: bool) -> Manifest:
    return {"type": "LimitControl", "kind": kind, "upperLimit": upper, "action": "refuse" if refuse else "enforce"}


@dataclass(frozen=True)
class FlightPlan:
    """Approved flight of one drone: the permitted area, the waypoints and the restrictions.

    Attributes:
        path: Waypoints in order. Without `region`, the drone must stay in the corridor along them.
        region: Permitted area, in which the program chooses its own route.
        restrictions: Policies that apply to the flight.
    """

    path: Sequence[Waypoint] = ()
    region: Mapping[str, Any] | None = None
    restrictions: Sequence[Restriction] = field(default=())

    def control_point(self, depot: str) -> Manifest:
        """Return the control point of the Application, which starts at a depot."""
        start = {"point": {"depot": depot}}
        if self.region is not None:
            return {**start, "navigation": "regionBased", "region": self.region, "duration": _REGION_MINUTES}
        path = [{"lat": lat, "lon": lon, "alt": alt} for lat, lon, alt in self.path]
        return {**start, "navigation": "pathBased", "path": path}


@dataclass(frozen=True)
class Resources:
    """Resources that an application declares, as Kubernetes quantities.

    Attributes:
        cpu: Processor time, such as `500m` for half a core.
        memory: Memory, such as `128Mi`.
    """

    cpu: str = "1"
    memory: str = "256Mi"


MIN_RESOURCES = Resources(cpu="500m", memory="128Mi")
"""Resources that an application with a simple program needs."""


def drone_manifests(
    name: str,
    component: str,
    home: tuple[float, float, float],
    plan: FlightPlan,
    *,
    resources: Resources,
    camera: bool,
    interface: Interface = "grpc",
) -> list[Manifest]:
    """Return the Depot, Drone and Application of a drone, and the restrictions of its flight plan.

    Args:
        name: Name of the node.
        component: Component of the program that flies the drone.
        home: Latitude and longitude in degrees, ground height in metres above mean sea level.
        plan: Flight plan.
        resources: Resources that the component declares.
        camera: True if the drone has a camera.
        interface: Protocol over which the program flies the drone.
    """
    services: Manifest = {
        "mobility": {
            "autopilot": "ardupilot", "connection": "tcp:127.0.0.1:5760", "maxAltitude": 120, "maxSpeed": 15,
            "maxFlightTime": 30, "methods": list(_MOBILITY_METHODS),
        }
    }  # fmt: skip
    uses: list[Manifest] = [{"service": "mobility", "methods": list(_MOBILITY_METHODS), "interfaces": [interface]}]
    if camera:
        services["camera"] = {
            "resolution": "1280x720", "sensorType": "RGB", "horizontalFieldOfView": 62.2, "lens": {"model": "pinhole"},
            "mount": {"pitch": -90, "stabilised": True}, "methods": list(_CAMERA_METHODS),
        }  # fmt: skip
        uses.append({"service": "camera", "methods": list(_CAMERA_METHODS)})
    limits = {"cpu": resources.cpu, "memory": resources.memory}
    program = {
        "name": component, "placement": "drone", "class": "driver", "control": "full",
        "controlPoints": [plan.control_point(name)], "services": uses,
        "container": {"image": "localhost/program-under-test", "resources": {"limits": limits}},
    }  # fmt: skip
    drone = {
        "mobilityType": "quadcopter", "class": "C2", "depot": name, "interfaces": [{"technology": "4G"}],
        "physicalFeatures": {"dimensions": {"height": 300, "length": 650, "width": 650}, "mtom": 1800},
        "services": services,
    }  # fmt: skip
    location = {"lat": home[0], "lon": home[1]}
    return [
        _manifest("Depot", name, {"location": location, "radius": _DEPOT_RADIUS_M}),
        _manifest("Drone", name, drone),
        _manifest("Application", name, {"components": [program]}),
        *(manifest for restriction in plan.restrictions for manifest in restriction.manifests()),
    ]


def merged(manifests: Iterable[Manifest]) -> list[Manifest]:
    """Return manifests without repetitions. Drones may share the restrictions of their flight plans.

    Raises:
        ExperimentError: Two manifests have the same kind and name, and different content.
    """
    merged_manifests: dict[tuple[str, str], Manifest] = {}
    for body in manifests:
        kind = body["kind"]
        name = body["metadata"]["name"]
        if merged_manifests.setdefault((kind, name), body) != body:
            raise ExperimentError(f"two restrictions are named {name}, but their {kind} differs; use different names")
    return list(merged_manifests.values())


def _manifest(kind: str, name: str, spec: Mapping[str, Any]) -> Manifest:
    return {"apiVersion": API_VERSION, "kind": kind, "metadata": {"name": name}, "spec": dict(spec)}

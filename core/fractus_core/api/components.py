"""The components of an application: container, placement, flight, services, traffic (thesis Listings 12 and 13)."""

from __future__ import annotations

import re
from collections.abc import Hashable, Iterable
from typing import Annotated, Any, Literal, Self, assert_never

from pydantic import Field, WithJsonSchema, model_validator

from fractus_core.api.formats import IMAGE, MOUNT_PATH, VARIABLE
from fractus_core.api.geometry import Area, Circle, Point, Position
from fractus_core.api.methods import METHODS_OF, Interface, Method, Service
from fractus_core.api.model import InvalidObject, Model, Quantity, keyed, quantity
from fractus_core.api.names import ComponentName, HeuristicKind, Name, PortName, slug
from fractus_core.api.rules import Violation, one_of, rule

_LEAST_MEMORY = "4Mi"
"""Minimum memory of a container. No container starts with less, so the unit of a smaller amount is probably missing."""
_RESOURCES = ("cpu", "memory", "ephemeral-storage")
_EXTENDED = (
    r"^[a-z0-9]([-a-z0-9]*[a-z0-9])?([.][a-z0-9]([-a-z0-9]*[a-z0-9])?)*/[A-Za-z0-9]([-A-Za-z0-9_.]*[A-Za-z0-9])?$"
)
_NAME_LENGTH = 317
TLS_DIR = "/var/run/fractus/tls"
"""Directory with the certificate of a component."""
TMP_DIR = "/tmp"  # nosec B108  # noqa: S108  (private to the pod)
"""Directory that a component may write to."""
_OWN_VOLUMES = {"tls": TLS_DIR, "tmp": TMP_DIR}


class ContainerPort(Model):
    """A port the component listens on."""

    port: int = Field(ge=1, le=65535, description="Port number.")
    name: PortName | None = Field(default=None, description="Port name; default: port- and the number.")
    protocol: Literal["TCP", "UDP"] = Field(default="TCP", description="Transport protocol (TCP or UDP).")

    @rule(
        "!has(self.name) || !self.name.startsWith('port-')",
        "names that begin with port- are reserved for ports without a name; choose another name or remove it",
    )
    def _own_name(self) -> Violation:
        return "name" if self.name is not None and self.name.startswith("port-") else None

    @property
    def label(self) -> str:
        """Name of the port, declared or generated."""
        return self.name or f"port-{self.port}{'-udp' if self.protocol == 'UDP' else ''}"


class EnvVar(Model):
    """An environment variable."""

    name: str = Field(pattern=VARIABLE, max_length=128, description="Name of the variable.")
    value: str = Field(default="", max_length=32768, description="Value as a string; put numbers in quotes.")

    @rule("!self.name.startsWith('FRACTUS_')", "names that begin with FRACTUS_ are reserved; choose another name")
    def _own_name(self) -> Violation:
        return "name" if self.name.startswith("FRACTUS_") else None


class Resources(Model):
    """Resource requests and limits: cpu, memory, ephemeral-storage and extended resources such as fractus.dev/gpu."""

    requests: dict[str, Quantity] = Field(
        default_factory=dict,
        max_length=32,
        description="Resources that the node must have available, as Kubernetes quantities.",
    )
    limits: dict[str, Quantity] = Field(
        default_factory=dict, max_length=32, description="Maximum resource usage, as Kubernetes quantities."
    )

    @rule(
        "[has(self.requests) ? self.requests : {}, has(self.limits) ? self.limits : {}]"
        f".all(m, m.all(k, k in {list(_RESOURCES)} || (k.size() <= {_NAME_LENGTH} && k.matches('{_EXTENDED}'))))",
        f"a resource must be {', '.join(_RESOURCES)}, or an extended resource such as fractus.dev/gpu",
    )
    def _known(self) -> Violation:
        for field, amounts in (("requests", self.requests), ("limits", self.limits)):
            for name in amounts:
                if name not in _RESOURCES and (len(name) > _NAME_LENGTH or not re.fullmatch(_EXTENDED, name)):
                    return field, f"not {name!r:.60}"
        return None

    @rule(
        "[has(self.requests) ? self.requests : {}, has(self.limits) ? self.limits : {}]"
        ".all(m, m.all(k, k != 'memory' || !isQuantity(string(m[k])) ||"
        f" quantity(string(m[k])).compareTo(quantity('{_LEAST_MEMORY}')) >= 0))",
        f"memory must be at least {_LEAST_MEMORY}; without a unit it is in bytes, so write for example 128Mi",
    )
    def _enough_memory(self) -> Violation:
        for field, amounts in (("requests", self.requests), ("limits", self.limits)):
            if quantity(amounts.get("memory", _LEAST_MEMORY)) < quantity(_LEAST_MEMORY):
                return f"{field}.memory", f"not {amounts['memory']}"
        return None

    @rule(
        "!has(self.requests) || !has(self.limits) || self.requests.all(k, !(k in self.limits) ||"
        " !isQuantity(string(self.requests[k])) || !isQuantity(string(self.limits[k])) ||"
        " quantity(string(self.requests[k])).compareTo(quantity(string(self.limits[k]))) <= 0)",
        "a request must not be above the limit of the same resource",
    )
    def _within_limits(self) -> Violation:
        for name, amount in self.requests.items():
            if name in self.limits and quantity(amount) > quantity(self.limits[name]):
                return f"requests.{name}", f"{amount} is above {self.limits[name]}"
        return None

    @rule(
        "!has(self.requests) || self.requests.all(k, !k.contains('/') || (has(self.limits) && k in self.limits &&"
        " (!isQuantity(string(self.requests[k])) || !isQuantity(string(self.limits[k])) ||"
        " quantity(string(self.requests[k])).compareTo(quantity(string(self.limits[k]))) == 0)))",
        "an extended resource needs a limit that is equal to its request",
    )
    def _not_overcommitted(self) -> Violation:
        for name, amount in self.requests.items():
            if "/" in name and (name not in self.limits or quantity(amount) != quantity(self.limits[name])):
                return f"limits.{name}"
        return None

    @rule(
        "!has(self.limits) || self.limits.all(k, !k.contains('/') || !isQuantity(string(self.limits[k])) ||"
        " quantity(string(self.limits[k])).isInteger())",
        "limits of extended resources must be whole numbers",
    )
    def _whole(self) -> Violation:
        parts = (name for name, amount in self.limits.items() if "/" in name and not quantity(amount).is_integer())
        return next((f"limits.{name}" for name in parts), None)


class EmptyDirectory(Model):
    """A directory that is empty at the start of the pod and deleted with it."""

    size_limit: Quantity | None = Field(
        default=None, description="Maximum size as a Kubernetes quantity, such as 256Mi; unset: limit of the node."
    )
    medium: Literal["disk", "memory"] = Field(
        default="disk", description="Storage medium; files in memory count as memory of the pod."
    )


class Volume(Model):
    """Files for a component: an empty directory, a ConfigMap, a Secret or a PersistentVolumeClaim."""

    name: Name = Field(description="Name of the volume, unique in the component.")
    mount_path: str = Field(
        pattern=MOUNT_PATH, max_length=512, description="Absolute path of the volume in the container."
    )
    read_only: bool = Field(
        default=False, description="Mount without write access. ConfigMaps and Secrets are always read-only."
    )
    empty_dir: EmptyDirectory | None = None
    config_map: Name | None = Field(
        default=None, description="Name of a ConfigMap in the namespace of the application."
    )
    secret: Name | None = Field(default=None, description="Name of a Secret in the namespace of the application.")
    claim: Name | None = Field(
        default=None, description="Name of a PersistentVolumeClaim in the namespace of the application."
    )

    @rule(
        "[has(self.emptyDir), has(self.configMap), has(self.secret), has(self.claim)].filter(x, x).size() == 1",
        "give exactly one of emptyDir, configMap, secret and claim",
    )
    def _one_source(self) -> Violation:
        sources = [s for s in (self.empty_dir, self.config_map, self.secret, self.claim) if s is not None]
        return "" if len(sources) != 1 else None

    @rule(
        "!has(self.secret) || !self.secret.endsWith('-tls')",
        "Secrets with names ending in -tls are reserved for component certificates; choose another name",
    )
    def _own_secret(self) -> Violation:
        return "secret" if self.secret is not None and self.secret.endswith("-tls") else None

    @rule(
        f"!(self.name in {list(_OWN_VOLUMES)}) && !(self.mountPath in {list(_OWN_VOLUMES.values())})",
        f"the volumes {' and '.join(_OWN_VOLUMES)} at {' and '.join(_OWN_VOLUMES.values())} are reserved;"
        " choose another name and path",
    )
    def _apart(self) -> Violation:
        if self.name in _OWN_VOLUMES:
            return "name"
        return "mountPath" if self.mount_path in _OWN_VOLUMES.values() else None

    def pod_volume(self) -> dict[str, Any]:
        """Return the entry for `volumes` of the pod."""
        if self.empty_dir is not None:
            source: dict[str, Any] = {}
            if self.empty_dir.size_limit is not None:
                source["sizeLimit"] = self.empty_dir.size_limit
            if self.empty_dir.medium == "memory":
                source["medium"] = "Memory"
            return {"name": self.name, "emptyDir": source}
        if self.config_map is not None:
            return {"name": self.name, "configMap": {"name": self.config_map}}
        if self.secret is not None:
            return {"name": self.name, "secret": {"secretName": self.secret, "defaultMode": 0o440}}
        return {"name": self.name, "persistentVolumeClaim": {"claimName": self.claim}}

    def mount(self) -> dict[str, Any]:
        """Return the entry for `volumeMounts` of the container."""
        fixed = self.config_map is not None or self.secret is not None
        return {"name": self.name, "mountPath": self.mount_path, "readOnly": self.read_only or fixed}


class Container(Model):
    """The container of a component."""

    image: str = Field(
        min_length=1, max_length=512, pattern=IMAGE, description="Image reference such as registry.example/app:1.2."
    )
    command: tuple[str, ...] = Field(
        default=(), max_length=64, description="Command of the container; default: the entry point of the image."
    )
    args: tuple[str, ...] = Field(default=(), max_length=64, description="Arguments of the command.")
    env: tuple[EnvVar, ...] = Field(
        default=(), max_length=256, json_schema_extra=keyed("name"), description="Environment variables."
    )
    ports: tuple[ContainerPort, ...] = Field(
        default=(),
        max_length=32,
        json_schema_extra=keyed("port", "protocol"),
        description="Ports that the component listens on. Components that name this component in egress connect to the first port.",
    )
    resources: Resources = Field(default_factory=Resources)
    volumes: tuple[Volume, ...] = Field(
        default=(),
        max_length=16,
        json_schema_extra=keyed("name"),
        description="Volumes of the component.",
    )

    @model_validator(mode="after")
    def _distinct_keys(self) -> Self:
        """Reject duplicate list keys, as the API server does."""
        for i in _repeated(v.name for v in self.env):
            raise InvalidObject(f"env[{i}].name", f"{self.env[i].name} is duplicated; remove one of the entries")
        for i in _repeated((p.port, p.protocol) for p in self.ports):
            raise InvalidObject(f"ports[{i}].port", f"{self.ports[i].port} is duplicated; remove one of the entries")
        for i in _repeated(v.name for v in self.volumes):
            raise InvalidObject(f"volumes[{i}].name", f"{self.volumes[i].name} is duplicated; choose another name")
        return self

    @rule(
        "!has(self.ports) || self.ports.all(p, !has(p.name) || self.ports.exists_one(q, has(q.name) && q.name == p.name))",
        "port names must be unique; choose another name",
    )
    def _distinct_ports(self) -> Violation:
        return next((f"ports[{i}].name" for i in _repeated(p.label for p in self.ports)), None)

    @rule(
        "!has(self.volumes) || self.volumes.all(v, self.volumes.exists_one(w, w.mountPath == v.mountPath))",
        "mountPath must be unique; choose another path",
    )
    def _distinct_paths(self) -> Violation:
        return next((f"volumes[{i}].mountPath" for i in _repeated(v.mount_path for v in self.volumes)), None)


def _repeated(keys: Iterable[Hashable]) -> list[int]:
    """Return the indexes of keys that repeat an earlier key."""
    seen: set[Hashable] = set()
    repeated = []
    for i, key in enumerate(keys):
        if key in seen:
            repeated.append(i)
        seen.add(key)
    return repeated


Placement = Literal["drone", "edge", "hybrid", "cloud"]
ComponentClass = Literal["driver", "passenger"]
ControlScope = Literal["full", "partial"]
Lifetime = Literal["flight", "application"]
ReferenceField = Literal["ingress", "egress", "hybridTo"]
"""A field of a component that names other components."""


def default_lifetime(placement: Placement) -> Lifetime:
    """Return the default of `endsWith` for a placement."""
    return "application" if placement == "cloud" else "flight"


def _belong(service: Service) -> Any:
    """Return the rule that a request for a service contains methods of that service only."""
    known = sorted(METHODS_OF[service])

    @rule(
        f"self.service != '{service}' || self.methods.all(m, m in {known})",
        f"the methods of the {service} service are {', '.join(known)}",
    )
    def belong(self: ServiceRequest) -> Violation:
        foreign = (i for i, m in enumerate(self.methods) if self.service == service and m not in known)
        return next((f"methods[{i}]" for i in foreign), None)

    return belong


class ContactLoss(Model):
    """Reaction of the drone when its agent loses contact with the API server in flight."""

    after: int = Field(
        default=30, ge=10, le=86_400, description="Seconds without contact after which the action begins, at least 10."
    )
    action: Literal["continue", "hover", "abort"] = Field(
        default="continue",
        description="continue: fly on under the stored Grants. hover: hover until contact returns. abort: end the mission, and"
        " land at landAt.",
    )
    land_at: Point | None = Field(
        default=None,
        description="For abort: place on the ground at which the system lands the drone; unset, or if it cannot be reached"
        " legally: home.",
    )

    @rule(
        "!has(self.landAt) || (has(self.action) && self.action == 'abort')",
        "landAt is only allowed with action abort",
    )
    def _landing(self) -> Violation:
        return "landAt" if self.land_at is not None and self.action != "abort" else None


class ServiceRequest(Model):
    """A system service that a component uses, with the methods that it calls."""

    service: Service = Field(description="System service of the node on which the component runs.")
    methods: tuple[Method, ...] = Field(min_length=1, max_length=32, description="Methods that the component calls.")
    interfaces: tuple[Interface, ...] = Field(
        default=("grpc",),
        min_length=1,
        max_length=2,
        description="Protocols over which the component calls the service: grpc (the SDK), mavlink (an unmodified MAVLink"
        " program, through the gateway of the node; mobility service only).",
    )

    _mobility_methods = _belong("mobility")
    _camera_methods = _belong("camera")

    @rule(
        "self.service == 'mobility' || !has(self.interfaces) || !('mavlink' in self.interfaces)",
        "only the mobility service can be called over mavlink; use grpc for other services",
    )
    def _mavlink_service(self) -> Violation:
        return "interfaces" if self.service != "mobility" and "mavlink" in self.interfaces else None


class Start(Model):
    """Start of a control point: a depot or a position."""

    depot: Name | None = Field(default=None, description="Name of a Depot.")
    position: Position | None = None

    _one_start = one_of("depot", "position")


class ControlPoint(Model):
    """Place where a driver gets control, and the area in which it then flies."""

    point: Start | None = Field(
        default=None,
        description="Start location; default: the first waypoint of path, or the centre of region.",
    )
    navigation: Literal["pathBased", "regionBased"] = Field(
        description="pathBased: the driver follows the waypoints of path. regionBased: the driver flies freely in region."
    )
    path: tuple[Position, ...] | None = Field(
        default=None, min_length=1, max_length=1000, description="Waypoints in flight order."
    )
    region: Area | None = Field(default=None, description="Area in which the driver flies freely.")
    duration: float | None = Field(
        default=None,
        gt=0,
        le=1440,
        description="Flight time in the region in minutes, for which the battery must suffice.",
    )

    @rule("self.navigation != 'pathBased' || has(self.path)", "pathBased navigation needs path")
    def _path_given(self) -> Violation:
        return "path" if self.navigation == "pathBased" and self.path is None else None

    @rule("self.navigation != 'regionBased' || has(self.region)", "regionBased navigation needs region")
    def _region_given(self) -> Violation:
        return "region" if self.navigation == "regionBased" and self.region is None else None

    @rule("!(has(self.path) && has(self.region))", "give either path or region, and only one of them")
    def _one_way(self) -> Violation:
        return "region" if self.path is not None and self.region is not None else None

    @rule("!has(self.region) || has(self.duration)", "a region needs duration: the flight time in it in minutes")
    def _duration_given(self) -> Violation:
        return "duration" if self.region is not None and self.duration is None else None

    @rule("!has(self.duration) || has(self.region)", "duration is for regionBased navigation")
    def _stay_in_region(self) -> Violation:
        return "duration" if self.duration is not None and self.region is None else None


class PointsOfInterest(Model):
    """Places that the drone visits for an application without a driver."""

    points: tuple[Position, ...] = Field(min_length=1, max_length=1000, description="Positions to visit.")
    ordered: bool = Field(default=True, description="True to visit the points in the given order.")
    service_access: Literal["points", "path"] = Field(
        default="path", description="Use of services: only at the points (points), or along the whole path (path)."
    )


_InstanceCount = Annotated[
    int | Literal["*"],
    WithJsonSchema({"anyOf": [{"type": "integer", "minimum": 1, "maximum": 10000}, {"type": "string", "enum": ["*"]}]}),
]


class EdgeLocation(Circle):
    """Area in which instances of a static edge component are placed."""

    instances: _InstanceCount = Field(
        default=1, description='Number of instances, 1 to 10000, or "*" for one on every suitable node.'
    )

    @rule(
        "!has(self.instances) || self.instances == '*' || (type(self.instances) == int && self.instances >= 1"
        " && self.instances <= 10000)",
        'instances must be a whole number from 1 to 10000, or "*" for as many as possible',
    )
    def _positive(self) -> Violation:
        return "instances" if self.instances != "*" and not 1 <= self.instances <= 10000 else None


class Heuristic(Model):
    """Rule that selects the active instance of a hybrid component."""

    kind: HeuristicKind = Field(
        description="max or min: the instance with the largest or smallest metric. preferDirect: an instance with a direct"
        " link. Other values: name of a plug-in in the agent image (entry point group fractus.linking)."
    )
    metric: Literal["ingress-bandwidth", "egress-bandwidth", "ingress-latency", "egress-latency"] | None = Field(
        default=None,
        description="Metric for max and min: bandwidth or latency of the traffic from (ingress) or to (egress) its peers.",
    )

    @rule(
        "(self.kind in ['max', 'min']) == has(self.metric)",
        "kinds max and min require a metric; other kinds must not have a metric",
    )
    def _measured(self) -> Violation:
        return "metric" if (self.kind in {"max", "min"}) != (self.metric is not None) else None


class Component(Model):
    """One component of an application."""

    name: ComponentName = Field(
        description="Name of the component, unique in the application, CamelCase or with hyphens."
    )
    placement: Placement = Field(
        description="drone: on the drone. edge: at the given locations. hybrid: near the components in hybridTo, and in the"
        " cloud. cloud: in the cloud."
    )
    class_: ComponentClass | None = Field(
        default=None,
        alias="class",
        description="Class of a drone component: driver (commands the drone) or passenger (does not).",
    )
    control: ControlScope | None = Field(
        default=None,
        description="Control of a driver: full (from arming to landing, the default) or partial (only at its control points).",
    )
    control_points: tuple[ControlPoint, ...] = Field(
        default=(), max_length=30, description="Places where the driver gets control, in flight order."
    )
    points_of_interest: PointsOfInterest | None = None
    locations: tuple[EdgeLocation, ...] = Field(
        default=(),
        max_length=100,
        description="For placement edge: areas to serve, with the number of instances for each.",
    )
    hybrid_to: tuple[ComponentName, ...] = Field(
        default=(),
        max_length=50,
        description="For placement hybrid: instances of this component are placed near instances of these components.",
    )
    heuristic: Heuristic | None = None
    replicas: int | None = Field(
        default=None, ge=1, le=1000, description="For placement cloud: number of pods; default: 1."
    )
    ends_with: Lifetime | None = Field(
        default=None,
        description="End of the component. flight: it stops spec.afterFlight seconds after the landing. application: it runs"
        " until the application is deleted; not on a drone. Default: application for placement cloud, otherwise flight.",
    )
    services: tuple[ServiceRequest, ...] = Field(
        default=(), max_length=8, description="System services that the component calls, with the methods."
    )
    ingress: tuple[ComponentName, ...] = Field(
        default=(), max_length=50, description="Components that connect to this component."
    )
    egress: tuple[ComponentName, ...] = Field(
        default=(), max_length=50, description="Components that this component connects to."
    )
    container: Container

    def references(self, field: ReferenceField) -> tuple[str, ...]:
        """Return the components that a field names."""
        match field:
            case "ingress":
                return self.ingress
            case "egress":
                return self.egress
            case "hybridTo":
                return self.hybrid_to
            case _:
                assert_never(field)

    @property
    def lifetime(self) -> Lifetime:
        """The declared or default end of the component."""
        return self.ends_with or default_lifetime(self.placement)

    @property
    def slug(self) -> str:
        """Kebab-case name for Kubernetes objects: GroundViewer becomes ground-viewer."""
        return slug(self.name)

    @rule(
        "!(self.name.lowerAscii() in ['pilot', 'system'])",
        "a drone is also controlled by a pilot or by the system; choose another name",
    )
    def _not_a_controller(self) -> Violation:
        return "name" if self.name.lower() in {"pilot", "system"} else None

    @rule(
        "self.placement == 'drone' ? has(self.class) : !has(self.class)",
        "class (driver or passenger) is required for placement drone, and not allowed otherwise",
    )
    def _classed(self) -> Violation:
        return "class" if (self.placement == "drone") != (self.class_ is not None) else None

    @rule(
        "!has(self.class) || self.class != 'driver' || (has(self.controlPoints) && size(self.controlPoints) > 0)",
        "a driver requires controlPoints",
    )
    def _driver_has_points(self) -> Violation:
        return "controlPoints" if self.class_ == "driver" and not self.control_points else None

    @rule(
        "!has(self.controlPoints) || size(self.controlPoints) == 0 || (has(self.class) && self.class == 'driver')",
        "controlPoints are only allowed for class driver",
    )
    def _points_have_driver(self) -> Violation:
        return "controlPoints" if self.control_points and self.class_ != "driver" else None

    @rule(
        "!has(self.controlPoints) || size(self.controlPoints) <= 1 || (has(self.control) && self.control == 'partial')",
        "a driver with full control has one control point; put the whole path into it, or set control: partial to let the"
        " system fly between the control points",
    )
    def _full_control_has_one_point(self) -> Violation:
        return "controlPoints" if len(self.control_points) > 1 and self.control != "partial" else None

    @rule(
        "!has(self.control) || (has(self.class) && self.class == 'driver')",
        "control is only allowed for class driver",
    )
    def _controls(self) -> Violation:
        return "control" if self.control is not None and self.class_ != "driver" else None

    @rule(
        "!has(self.pointsOfInterest) || (has(self.class) && self.class == 'passenger')",
        "pointsOfInterest are only allowed for class passenger",
    )
    def _passenger_guides(self) -> Violation:
        return "pointsOfInterest" if self.points_of_interest is not None and self.class_ != "passenger" else None

    @rule(
        "self.placement == 'edge' ? has(self.locations) && size(self.locations) > 0 :"
        " !has(self.locations) || size(self.locations) == 0",
        "locations are required for placement edge, and not allowed otherwise",
    )
    def _located(self) -> Violation:
        return "locations" if (self.placement == "edge") != bool(self.locations) else None

    @rule(
        "self.placement == 'hybrid' ? has(self.hybridTo) && size(self.hybridTo) > 0 :"
        " !has(self.hybridTo) || size(self.hybridTo) == 0",
        "hybridTo is required for placement hybrid, and not allowed otherwise",
    )
    def _hybrid(self) -> Violation:
        return "hybridTo" if (self.placement == "hybrid") != bool(self.hybrid_to) else None

    @rule("!has(self.replicas) || self.placement == 'cloud'", "replicas are for placement cloud")
    def _replicated(self) -> Violation:
        return "replicas" if self.replicas is not None and self.placement != "cloud" else None

    @rule(
        "!has(self.endsWith) || self.endsWith != 'application' || self.placement != 'drone'",
        "a component on a drone ends with the flight, so that other applications can use the drone; remove endsWith",
    )
    def _leaves_the_drone(self) -> Violation:
        return "endsWith" if self.ends_with == "application" and self.placement == "drone" else None

    @rule("!has(self.heuristic) || self.placement == 'hybrid'", "heuristic is for placement hybrid")
    def _choosing(self) -> Violation:
        return "heuristic" if self.heuristic is not None and self.placement != "hybrid" else None

    @rule(
        "self.placement in ['drone', 'edge'] || !has(self.services) || size(self.services) == 0",
        "services are only allowed for placements drone and edge",
    )
    def _served(self) -> Violation:
        return "services" if self.services and self.placement not in {"drone", "edge"} else None

    @rule(
        "self.placement == 'drone' || !has(self.services) || !self.services.exists(s, s.service == 'mobility')",
        "the mobility service is only available on drones; use placement drone",
    )
    def _mobile(self) -> Violation:
        return "services" if self.placement != "drone" and self._uses("mobility") else None

    @rule(
        "!has(self.services) || self.services.all(s, self.services.exists_one(t, t.service == s.service))",
        "services must be unique; list all methods of a service in one entry",
    )
    def _services_once(self) -> Violation:
        return "services" if len({s.service for s in self.services}) < len(self.services) else None

    @rule(
        "!has(self.class) || self.class != 'driver' ||"
        " (has(self.services) && self.services.exists(s, s.service == 'mobility'))",
        "a driver requires the mobility service with the methods that it calls",
    )
    def _driver_moves(self) -> Violation:
        return "services" if self.class_ == "driver" and not self._uses("mobility") else None

    @property
    def uses_mavlink(self) -> bool:
        """True if the component calls a service over MAVLink, through the gateway of its drone."""
        return any("mavlink" in service.interfaces for service in self.services)

    def _uses(self, service: Service) -> bool:
        return any(s.service == service for s in self.services)

"""The components of an application: placement, flight, services, traffic (thesis Listings 12 and 13)."""

from __future__ import annotations

from typing import Annotated, Any, Literal, assert_never

from pydantic import Field, WithJsonSchema

from fractus_core.api.containers import Container
from fractus_core.api.geometry import Area, Circle, Position
from fractus_core.api.methods import METHODS_OF, Method, Service
from fractus_core.api.model import Model
from fractus_core.api.names import ComponentName, HeuristicKind, Name, slug
from fractus_core.api.rules import Violation, one_of, rule

Placement = Literal["drone", "edge", "hybrid", "cloud"]
ComponentClass = Literal["driver", "passenger"]
ControlScope = Literal["full", "partial"]
ReferenceField = Literal["ingress", "egress", "hybridTo"]
"""A field of a component that names other components."""


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


class ServiceRequest(Model):
    """A system service that a component uses, with the methods that it calls."""

    service: Service = Field(description="System service of the node on which the component runs.")
    methods: tuple[Method, ...] = Field(min_length=1, max_length=32, description="Methods that the component calls.")

    _mobility_methods = _belong("mobility")
    _camera_methods = _belong("camera")


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
        description="pathBased: the driver follows the waypoints of path. regionBased: it flies freely in region."
    )
    path: tuple[Position, ...] | None = Field(
        default=None, min_length=1, max_length=1000, description="Waypoints in flight order."
    )
    region: Area | None = Field(default=None, description="Area in which the driver flies freely.")
    duration: float | None = Field(
        default=None,
        gt=0,
        le=1440,
        description="Flight time in the region in minutes; the battery must suffice for it. Unset: not considered.",
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
        'instances is a whole number of 1 to 10000, or "*" for as many as possible',
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

    @rule("(self.kind in ['max', 'min']) == has(self.metric)", "kinds max and min need a metric, all others take none")
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
        description="Control of a driver: full (from arming to landing, the default) or partial (at its control points).",
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
        description="For placement hybrid: components near whose instances this component gets instances.",
    )
    heuristic: Heuristic | None = None
    replicas: int | None = Field(
        default=None, ge=1, le=1000, description="For placement cloud: number of pods; default: 1."
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
    def slug(self) -> str:
        """Kebab-case name for Kubernetes objects: GroundViewer becomes ground-viewer."""
        return slug(self.name)

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
        "a driver with full control has one control point; put the whole path there, or set control: partial to let the"
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

    def _uses(self, service: Service) -> bool:
        return any(s.service == service for s in self.services)

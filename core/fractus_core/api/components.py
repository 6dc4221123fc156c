"""The components of an application: where each goes, how it flies, what it uses (thesis Listings 12 and 13)."""

from __future__ import annotations

from typing import Annotated, Any, Literal, assert_never

from pydantic import Field, WithJsonSchema

from fractus_core.api.containers import Container
from fractus_core.api.geometry import Area, Circle, Position
from fractus_core.api.methods import METHODS_OF, Method, Service
from fractus_core.api.model import Model
from fractus_core.api.names import ComponentName, HeuristicKind, Name, slug
from fractus_core.api.rules import Broken, one_of, rule

Placement = Literal["drone", "edge", "hybrid", "cloud"]
ComponentClass = Literal["driver", "passenger"]
ControlScope = Literal["full", "partial"]
Reference = Literal["ingress", "egress", "hybridTo"]
"""A field of a component that names other components."""


def _belong(service: Service) -> Any:
    """The rule that a service is asked for its own methods only."""
    known = sorted(METHODS_OF[service])

    @rule(
        f"self.service != '{service}' || self.methods.all(m, m in {known})",
        f"the {service} service has {', '.join(known)}",
    )
    def belong(self: ServiceRequest) -> Broken:
        foreign = (i for i, m in enumerate(self.methods) if self.service == service and m not in known)
        return next((f"methods[{i}]" for i in foreign), None)

    return belong


class ServiceRequest(Model):
    """A system service a component uses, and the methods it will call."""

    service: Service = Field(description="The system service of the component's node.")
    methods: tuple[Method, ...] = Field(min_length=1, max_length=32, description="The methods that it will call.")

    _mobility_methods = _belong("mobility")
    _camera_methods = _belong("camera")


class Start(Model):
    """Where a control point begins: a depot or a position."""

    depot: Name | None = Field(default=None, description="Name of a Depot.")
    position: Position | None = None

    _one_start = one_of("depot", "position")


class ControlPoint(Model):
    """Where a driver takes over, and how it will navigate from there."""

    point: Start | None = Field(
        default=None, description="Start location; unset: open (the first waypoint, or the region's middle)."
    )
    navigation: Literal["pathBased", "regionBased"] = Field(
        description="How the driver will move: pathBased along the waypoints of path, regionBased anywhere in region."
    )
    path: tuple[Position, ...] | None = Field(
        default=None, min_length=1, max_length=1000, description="Waypoints in the order flown."
    )
    region: Area | None = Field(default=None, description="Where the driver will move freely.")
    duration: float | None = Field(
        default=None,
        gt=0,
        le=1440,
        description="Minutes that the driver will move in the region; the drone must have them. Unset: not counted.",
    )

    @rule("self.navigation != 'pathBased' || has(self.path)", "pathBased navigation needs path")
    def _path_given(self) -> Broken:
        return "path" if self.navigation == "pathBased" and self.path is None else None

    @rule("self.navigation != 'regionBased' || has(self.region)", "regionBased navigation needs region")
    def _region_given(self) -> Broken:
        return "region" if self.navigation == "regionBased" and self.region is None else None

    @rule("!(has(self.path) && has(self.region))", "give either path or region, and only one of them")
    def _one_way(self) -> Broken:
        return "region" if self.path is not None and self.region is not None else None

    @rule("!has(self.duration) || has(self.region)", "duration is for regionBased navigation")
    def _stay_in_region(self) -> Broken:
        return "duration" if self.duration is not None and self.region is None else None


class PointsOfInterest(Model):
    """What a passenger-only application wants the drone to visit."""

    points: tuple[Position, ...] = Field(min_length=1, max_length=1000, description="The places to visit.")
    ordered: bool = Field(default=True, description="Visit the points in the order given.")
    service_access: Literal["points", "path"] = Field(
        default="path", description="Whether services are used only at the points, or along the whole path."
    )


_InstanceCount = Annotated[
    int | Literal["*"],
    WithJsonSchema({"anyOf": [{"type": "integer", "minimum": 1, "maximum": 10000}, {"type": "string", "enum": ["*"]}]}),
]


class EdgeLocation(Circle):
    """Where instances of a static edge component go, and how many."""

    instances: _InstanceCount = Field(default=1, description='How many; "*": every suitable node.')

    @rule(
        "!has(self.instances) || self.instances == '*' || (type(self.instances) == int && self.instances >= 1"
        " && self.instances <= 10000)",
        'instances is a whole number of 1 to 10000, or "*" for as many as possible',
    )
    def _positive(self) -> Broken:
        return "instances" if self.instances != "*" and not 1 <= self.instances <= 10000 else None


class Heuristic(Model):
    """How the active instance of a hybrid component is chosen."""

    kind: HeuristicKind = Field(
        description="max and min: the instance whose metric is largest or smallest; preferDirect: one with a direct link;"
        " else the name of a plug-in in the agents' image (entry point of the group fractus.linking)."
    )
    metric: Literal["ingress-bandwidth", "egress-bandwidth", "ingress-latency", "egress-latency"] | None = Field(
        default=None, description="What max and min compare: of the traffic from (ingress) or to (egress) its peers."
    )

    @rule("(self.kind in ['max', 'min']) == has(self.metric)", "kinds max and min need a metric, all others take none")
    def _measured(self) -> Broken:
        return "metric" if (self.kind in {"max", "min"}) != (self.metric is not None) else None


class Component(Model):
    """One component of an application."""

    name: ComponentName = Field(description="Its name in the application, CamelCase or with hyphens.")
    placement: Placement = Field(
        description="Where it runs: on the drone, at the edge (locations), where hybridTo says, or in the cloud."
    )
    class_: ComponentClass | None = Field(
        default=None, alias="class", description="On a drone: a driver flies it, a passenger comes along."
    )
    control: ControlScope | None = Field(
        default=None,
        description="For a driver: control from arming to landing (full, the default), or only at its control points (partial).",
    )
    control_points: tuple[ControlPoint, ...] = Field(
        default=(), max_length=30, description="Where a driver takes over, in the order flown."
    )
    points_of_interest: PointsOfInterest | None = None
    locations: tuple[EdgeLocation, ...] = Field(
        default=(),
        max_length=100,
        description="For placement edge: the places to serve, and how many instances each gets.",
    )
    hybrid_to: tuple[ComponentName, ...] = Field(
        default=(),
        max_length=50,
        description="For placement hybrid: the components beside whose instances it gets instances of its own.",
    )
    heuristic: Heuristic | None = None
    replicas: int | None = Field(default=None, ge=1, le=1000, description="For placement cloud; unset: 1.")
    services: tuple[ServiceRequest, ...] = Field(
        default=(), max_length=8, description="The system services that it calls, with the methods."
    )
    ingress: tuple[ComponentName, ...] = Field(default=(), max_length=50, description="Components that call this one.")
    egress: tuple[ComponentName, ...] = Field(default=(), max_length=50, description="Components this one calls.")
    container: Container

    def references(self, field: Reference) -> tuple[str, ...]:
        """The components that a field names."""
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
        """The name as Kubernetes objects carry it: GroundViewer becomes ground-viewer."""
        return slug(self.name)

    @rule(
        "self.placement == 'drone' ? has(self.class) : !has(self.class)",
        "class (driver or passenger) is needed for placement drone, and only there",
    )
    def _classed(self) -> Broken:
        return "class" if (self.placement == "drone") != (self.class_ is not None) else None

    @rule(
        "!has(self.class) || self.class != 'driver' || (has(self.controlPoints) && size(self.controlPoints) > 0)",
        "a driver needs controlPoints",
    )
    def _driver_has_points(self) -> Broken:
        return "controlPoints" if self.class_ == "driver" and not self.control_points else None

    @rule(
        "!has(self.controlPoints) || size(self.controlPoints) == 0 || (has(self.class) && self.class == 'driver')",
        "controlPoints are for a component of class driver",
    )
    def _points_have_driver(self) -> Broken:
        return "controlPoints" if self.control_points and self.class_ != "driver" else None

    @rule(
        "!has(self.controlPoints) || size(self.controlPoints) <= 1 || (has(self.control) && self.control == 'partial')",
        "a driver with full control has one control point; give its whole path there, or set control: partial, so that"
        " the system flies between the control points",
    )
    def _full_control_has_one_point(self) -> Broken:
        return "controlPoints" if len(self.control_points) > 1 and self.control != "partial" else None

    @rule(
        "!has(self.control) || (has(self.class) && self.class == 'driver')",
        "control is for a component of class driver",
    )
    def _controls(self) -> Broken:
        return "control" if self.control is not None and self.class_ != "driver" else None

    @rule(
        "!has(self.pointsOfInterest) || (has(self.class) && self.class == 'passenger')",
        "pointsOfInterest are for a component of class passenger",
    )
    def _passenger_guides(self) -> Broken:
        return "pointsOfInterest" if self.points_of_interest is not None and self.class_ != "passenger" else None

    @rule(
        "self.placement == 'edge' ? has(self.locations) && size(self.locations) > 0 :"
        " !has(self.locations) || size(self.locations) == 0",
        "locations are needed for placement edge, and only there",
    )
    def _located(self) -> Broken:
        return "locations" if (self.placement == "edge") != bool(self.locations) else None

    @rule(
        "self.placement == 'hybrid' ? has(self.hybridTo) && size(self.hybridTo) > 0 :"
        " !has(self.hybridTo) || size(self.hybridTo) == 0",
        "hybridTo is needed for placement hybrid, and only there",
    )
    def _hybrid(self) -> Broken:
        return "hybridTo" if (self.placement == "hybrid") != bool(self.hybrid_to) else None

    @rule("!has(self.replicas) || self.placement == 'cloud'", "replicas are for placement cloud")
    def _replicated(self) -> Broken:
        return "replicas" if self.replicas is not None and self.placement != "cloud" else None

    @rule("!has(self.heuristic) || self.placement == 'hybrid'", "heuristic is for placement hybrid")
    def _choosing(self) -> Broken:
        return "heuristic" if self.heuristic is not None and self.placement != "hybrid" else None

    @rule(
        "self.placement in ['drone', 'edge'] || !has(self.services) || size(self.services) == 0",
        "services are for placements drone and edge",
    )
    def _served(self) -> Broken:
        return "services" if self.services and self.placement not in {"drone", "edge"} else None

    @rule(
        "self.placement == 'drone' || !has(self.services) || !self.services.exists(s, s.service == 'mobility')",
        "the mobility service is on drones only; use placement drone",
    )
    def _mobile(self) -> Broken:
        return "services" if self.placement != "drone" and self._uses("mobility") else None

    @rule(
        "!has(self.services) || self.services.all(s, self.services.exists_one(t, t.service == s.service))",
        "name each service once, with all its methods",
    )
    def _services_once(self) -> Broken:
        return "services" if len({s.service for s in self.services}) < len(self.services) else None

    @rule(
        "!has(self.class) || self.class != 'driver' ||"
        " (has(self.services) && self.services.exists(s, s.service == 'mobility'))",
        "a driver needs the mobility service with the methods it will call",
    )
    def _driver_moves(self) -> Broken:
        return "services" if self.class_ == "driver" and not self._uses("mobility") else None

    def _uses(self, service: Service) -> bool:
        return any(s.service == service for s in self.services)

"""Application: what the user submits (thesis Listings 12 and 13)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Annotated, ClassVar, Literal, Self

from pydantic import ConfigDict, Field, WithJsonSchema, model_validator

from fractus_core.api.containers import Container
from fractus_core.api.geometry import Area, Circle, Position
from fractus_core.api.methods import METHODS_OF, Method, Service
from fractus_core.api.model import (
    ComponentName,
    Condition,
    InvalidObject,
    Model,
    Name,
    OpenModel,
    Resource,
    rules,
)

Placement = Literal["drone", "edge", "hybrid", "cloud"]


class ServiceRequest(Model):
    """A system service a component uses, and the methods it will call."""

    model_config = ConfigDict(
        json_schema_extra=rules(
            *(
                (
                    f"self.service != '{service}' || self.methods.all(m, m in {sorted(methods)})",
                    f"the {service} service has {', '.join(sorted(methods))}",
                )
                for service, methods in METHODS_OF.items()
            )
        )
    )

    service: Service
    methods: tuple[Method, ...] = Field(min_length=1, max_length=32)

    @model_validator(mode="after")
    def _methods_belong(self) -> Self:
        for i, method in enumerate(self.methods):
            if method not in METHODS_OF[self.service]:
                known = ", ".join(sorted(METHODS_OF[self.service]))
                raise InvalidObject(f"methods[{i}]", f"the {self.service} service has no {method}; it has {known}")
        return self


class Start(Model):
    """Where a control point begins: a depot or a position."""

    model_config = ConfigDict(
        json_schema_extra=rules(
            ("has(self.depot) != has(self.position)", "give either depot or position, and only one of them")
        )
    )

    depot: Name | None = Field(default=None, description="Name of a Depot.")
    position: Position | None = None

    @model_validator(mode="after")
    def _one_start(self) -> Self:
        if (self.depot is None) == (self.position is None):
            raise InvalidObject("", "give either depot or position, and only one of them")
        return self


class ControlPoint(Model):
    """Where a driver takes over, and how it will navigate from there."""

    model_config = ConfigDict(
        json_schema_extra=rules(
            ("self.navigation != 'pathBased' || has(self.path)", "pathBased navigation needs path"),
            ("self.navigation != 'regionBased' || has(self.region)", "regionBased navigation needs region"),
            ("!(has(self.path) && has(self.region))", "give either path or region, and only one of them"),
            ("!has(self.duration) || has(self.region)", "duration is for regionBased navigation"),
        )
    )

    point: Start | None = Field(
        default=None, description="Start location; unset: open (the first waypoint, or the region's middle)."
    )
    navigation: Literal["pathBased", "regionBased"]
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

    @model_validator(mode="after")
    def _navigable(self) -> Self:
        if self.navigation == "pathBased":
            if not self.path:
                raise InvalidObject("path", "pathBased navigation needs at least one waypoint")
            if self.region is not None:
                raise InvalidObject("region", "is for regionBased navigation; remove it")
            if self.duration is not None:
                raise InvalidObject("duration", "is for regionBased navigation; remove it")
        else:
            if self.region is None:
                raise InvalidObject("region", "regionBased navigation needs a region")
            if self.path is not None:
                raise InvalidObject("path", "is for pathBased navigation; remove it")
        return self


class PointsOfInterest(Model):
    """What a passenger-only application wants the drone to visit."""

    points: tuple[Position, ...] = Field(min_length=1, max_length=1000)
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

    model_config = ConfigDict(
        json_schema_extra=rules(
            (
                "!has(self.instances) || self.instances == '*' || (type(self.instances) == int && self.instances >= 1)",
                'instances is a whole number of at least 1, or "*" for as many as possible',
            )
        )
    )

    instances: _InstanceCount = Field(default=1, description='How many; "*": every suitable node.')

    @model_validator(mode="after")
    def _positive(self) -> Self:
        if isinstance(self.instances, int) and not 1 <= self.instances <= 10000:
            raise InvalidObject("instances", f"must be 1 to 10000 or '*', not {self.instances}")
        return self


class Heuristic(Model):
    """How the active instance of a hybrid component is chosen."""

    model_config = ConfigDict(
        json_schema_extra=rules(
            ("self.kind == 'preferDirect' || has(self.metric)", "kinds max and min need a metric"),
        )
    )

    kind: Literal["max", "min", "preferDirect"]
    metric: Literal["ingress-bandwidth", "egress-bandwidth", "ingress-latency", "egress-latency"] | None = None

    @model_validator(mode="after")
    def _measured(self) -> Self:
        if self.kind != "preferDirect" and self.metric is None:
            raise InvalidObject("metric", f"kind {self.kind} needs a metric")
        return self


_COMPONENT_RULES = rules(
    (
        "self.placement == 'drone' ? has(self.class) : !has(self.class)",
        "class (driver or passenger) is needed for placement drone, and only there",
    ),
    (
        "!has(self.class) || self.class != 'driver' || (has(self.controlPoints) && size(self.controlPoints) > 0)",
        "a driver needs controlPoints",
    ),
    (
        "!has(self.controlPoints) || size(self.controlPoints) == 0 || (has(self.class) && self.class == 'driver')",
        "controlPoints are for a component of class driver",
    ),
    (
        "!has(self.pointsOfInterest) || (has(self.class) && self.class == 'passenger')",
        "pointsOfInterest are for a component of class passenger",
    ),
    (
        "self.placement == 'edge' ? has(self.locations) && size(self.locations) > 0 :"
        " !has(self.locations) || size(self.locations) == 0",
        "locations are needed for placement edge, and only there",
    ),
    (
        "self.placement == 'hybrid' ? has(self.hybridTo) && size(self.hybridTo) > 0 :"
        " !has(self.hybridTo) || size(self.hybridTo) == 0",
        "hybridTo is needed for placement hybrid, and only there",
    ),
    ("!has(self.replicas) || self.placement == 'cloud'", "replicas are for placement cloud"),
    ("!has(self.heuristic) || self.placement == 'hybrid'", "heuristic is for placement hybrid"),
    (
        "self.placement in ['drone', 'edge'] || !has(self.services) || size(self.services) == 0",
        "services are for placements drone and edge",
    ),
    (
        "self.placement == 'drone' || !has(self.services) || !self.services.exists(s, s.service == 'mobility')",
        "the mobility service is on drones only; use placement drone",
    ),
    (
        "!has(self.services) || self.services.all(s, self.services.exists_one(t, t.service == s.service))",
        "name each service once, with all its methods",
    ),
    (
        "!has(self.class) || self.class != 'driver' ||"
        " (has(self.services) && self.services.exists(s, s.service == 'mobility'))",
        "a driver needs the mobility service with the methods it will call",
    ),
)


class Component(Model):
    """One component of an application."""

    model_config = ConfigDict(json_schema_extra=_COMPONENT_RULES)

    name: ComponentName
    placement: Placement
    class_: Literal["driver", "passenger"] | None = Field(default=None, alias="class")
    control: Literal["full", "partial"] | None = Field(
        default=None,
        description="For a driver: control from arming to landing (full, the default), or only at its control points.",
    )
    control_points: tuple[ControlPoint, ...] = Field(default=(), max_length=100)
    points_of_interest: PointsOfInterest | None = None
    locations: tuple[EdgeLocation, ...] = Field(default=(), max_length=100)
    hybrid_to: tuple[ComponentName, ...] = Field(default=(), max_length=50)
    heuristic: Heuristic | None = None
    replicas: int | None = Field(default=None, ge=1, le=1000, description="For placement cloud; unset: 1.")
    services: tuple[ServiceRequest, ...] = Field(default=(), max_length=8)
    ingress: tuple[ComponentName, ...] = Field(default=(), max_length=50, description="Components that call this one.")
    egress: tuple[ComponentName, ...] = Field(default=(), max_length=50, description="Components this one calls.")
    container: Container

    @property
    def slug(self) -> str:
        """The name as Kubernetes objects carry it: GroundViewer becomes ground-viewer."""
        return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "-", self.name).lower()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        _check_drone_part(self)
        for field, placement, value in (
            ("locations", "edge", self.locations),
            ("hybridTo", "hybrid", self.hybrid_to),
        ):
            if (self.placement == placement) != bool(value):
                raise InvalidObject(field, f"is needed for placement {placement}, and only there")
        if self.heuristic is not None and self.placement != "hybrid":
            raise InvalidObject("heuristic", "is for placement hybrid; remove it")
        if self.replicas is not None and self.placement != "cloud":
            raise InvalidObject("replicas", "are for placement cloud; remove them")
        wants_mobility = [s for s in self.services if s.service == "mobility"]
        if wants_mobility and self.placement != "drone":
            raise InvalidObject("services", "the mobility service is on drones only; use placement drone")
        if self.services and self.placement not in {"drone", "edge"}:
            raise InvalidObject("services", f"placement {self.placement} has no system services; use drone or edge")
        if len({s.service for s in self.services}) < len(self.services):
            raise InvalidObject("services", "name each service once, with all its methods")
        return self


def _check_drone_part(component: Component) -> None:
    if (component.placement == "drone") != (component.class_ is not None):
        raise InvalidObject("class", "driver or passenger is needed for placement drone, and only there")
    if component.class_ == "driver":
        if not component.control_points:
            raise InvalidObject("controlPoints", "a driver needs at least one control point")
        if component.points_of_interest is not None:
            raise InvalidObject("pointsOfInterest", "are for passengers; a driver's controlPoints say where it flies")
        if not any(s.service == "mobility" for s in component.services):
            raise InvalidObject("services", "a driver needs the mobility service with the methods it will call")
    elif component.control_points:
        raise InvalidObject("controlPoints", "are for a component of class driver; remove them")
    elif component.class_ is None and component.points_of_interest is not None:
        raise InvalidObject("pointsOfInterest", "are for a component of class passenger; remove them")


_APPLICATION_RULES = rules(
    (
        "self.components.filter(c, has(c.class) && c.class == 'driver').size() <= 1",
        "an application has at most one driver",
    ),
    (
        "!self.components.exists(c, c.placement == 'drone') ||"
        " self.components.exists(c, (has(c.class) && c.class == 'driver') || has(c.pointsOfInterest))",
        "an application with drone components needs a driver, or one passenger with pointsOfInterest",
    ),
    *(
        (
            f"self.components.all(c, !has(c.{field}) || c.{field}.all(n, self.components.exists(d, d.name == n)))",
            f"{field} names a component that the application does not have",
        )
        for field in ("ingress", "egress", "hybridTo")
    ),
    *(
        (
            f"self.components.all(c, !has(c.{field}) || !c.{field}.exists(n, n == c.name))",
            f"{field} names the component itself; remove it",
        )
        for field in ("ingress", "egress", "hybridTo")
    ),
    (
        "self.components.all(c, !has(c.hybridTo) || c.hybridTo.all(n, self.components.exists(d, d.name == n &&"
        " d.placement in ['drone', 'edge'])))",
        "hybridTo takes components placed on a drone or at the edge",
    ),
    (
        "self.components.all(c, !has(c.egress) || c.egress.all(n, self.components.exists(d, d.name == n &&"
        " has(d.container.ports) && size(d.container.ports) > 0)))",
        "egress names a component without container.ports; give it the port it listens on",
    ),
    (
        "self.components.filter(c, has(c.pointsOfInterest)).size() <= 1",
        "only one passenger gives pointsOfInterest",
    ),
    (
        "!self.components.exists(c, has(c.pointsOfInterest)) ||"
        " !self.components.exists(c, has(c.class) && c.class == 'driver')",
        "the driver says where the drone flies; remove pointsOfInterest",
    ),
)


class ApplicationSpec(Model):
    """The components of an application and how they interact."""

    model_config = ConfigDict(json_schema_extra=_APPLICATION_RULES)

    components: tuple[Component, ...] = Field(
        min_length=1,
        max_length=50,
        json_schema_extra={"x-kubernetes-list-type": "map", "x-kubernetes-list-map-keys": ["name"]},
    )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        self._check_names()
        self._check_drone()
        by_name = {c.name: c for c in self.components}
        for i, component in enumerate(self.components):
            for field in ("ingress", "egress", "hybrid_to"):
                _check_references(component, i, field, by_name)
        return self

    def _check_names(self) -> None:
        seen: dict[str, int] = {}
        for i, component in enumerate(self.components):
            if component.slug in seen:
                raise InvalidObject(
                    f"components[{i}].name",
                    f"{component.name} and {self.components[seen[component.slug]].name} get the same object name; rename one",
                )
            seen[component.slug] = i

    def _check_drone(self) -> None:
        drivers = [i for i, c in enumerate(self.components) if c.class_ == "driver"]
        if len(drivers) > 1:
            raise InvalidObject(
                f"components[{drivers[1]}].class", "an application has at most one driver; make this one a passenger"
            )
        guided = [i for i, c in enumerate(self.components) if c.points_of_interest is not None]
        on_drone = [i for i, c in enumerate(self.components) if c.placement == "drone"]
        if on_drone and not drivers and not guided:
            raise InvalidObject(
                f"components[{on_drone[0]}].pointsOfInterest",
                "an application with drone components needs a driver, or one passenger with pointsOfInterest",
            )
        if drivers and guided:
            raise InvalidObject(
                f"components[{guided[0]}].pointsOfInterest", "the driver says where the drone flies; remove this"
            )
        if len(guided) > 1:
            raise InvalidObject(
                f"components[{guided[1]}].pointsOfInterest", "only one passenger gives pointsOfInterest; remove this"
            )

    @property
    def driver(self) -> Component | None:
        """The component that flies the drone, if the application has one."""
        return next((c for c in self.components if c.class_ == "driver"), None)

    @property
    def points_of_interest(self) -> PointsOfInterest | None:
        """The points of the one passenger that gives some."""
        return next((c.points_of_interest for c in self.components if c.points_of_interest is not None), None)

    def on(self, placement: Placement) -> Iterator[Component]:
        """The components with this placement, in order."""
        return (c for c in self.components if c.placement == placement)

    def component(self, name: str) -> Component:
        """The component with this name.

        Raises:
            KeyError: there is none.
        """
        for component in self.components:
            if component.name == name:
                return component
        raise KeyError(name)


def _check_references(component: Component, index: int, field: str, by_name: dict[str, Component]) -> None:
    alias = {"hybrid_to": "hybridTo"}.get(field, field)
    for j, other in enumerate(getattr(component, field)):
        path = f"components[{index}].{alias}[{j}]"
        if other not in by_name:
            known = ", ".join(n for n in by_name if n != component.name) or "no other component"
            raise InvalidObject(path, f"there is no component {other}; the application has {known}")
        if other == component.name:
            raise InvalidObject(path, "a component does not refer to itself; remove it")
        if field == "hybrid_to" and by_name[other].placement not in {"drone", "edge"}:
            raise InvalidObject(
                path, f"{other} is placed in {by_name[other].placement}; hybridTo takes drone or edge components"
            )
        if field == "egress" and not by_name[other].container.ports:
            raise InvalidObject(path, f"{other} has no container.ports; give it the port it listens on")


class ApplicationStatus(OpenModel):
    """Where the application stands."""

    observed_generation: int | None = None
    phase: Literal["Pending", "Queued", "Deploying", "Running", "Completed", "Failed", "Invalid"] | None = None
    drone: str | None = Field(default=None, description="The drone that flies it.")
    pods: str | None = Field(default=None, description="Ready pods of all pods, such as 6/7.")
    message: str | None = Field(default=None, description="One sentence on what is going on.")
    conditions: tuple[Condition, ...] = ()


class Application(Resource):
    """An application whose components run on a drone, at the edge and in the cloud."""

    KIND: ClassVar[str] = "Application"
    PLURAL: ClassVar[str] = "applications"
    SHORT: ClassVar[str] = "fapp"
    NAMESPACED: ClassVar[bool] = True
    COLUMNS = (
        ("Phase", "string", ".status.phase"),
        ("Drone", "string", ".status.drone"),
        ("Pods", "string", ".status.pods"),
        ("Ready", "string", ".status.conditions[?(@.type=='Ready')].status"),
        ("Age", "date", ".metadata.creationTimestamp"),
        ("Message", "string", ".status.message"),
    )

    kind: Literal["Application"] = "Application"
    spec: ApplicationSpec
    status: ApplicationStatus | None = None

    @property
    def key(self) -> tuple[str, str]:
        """(namespace, name)."""
        return (self.metadata.namespace or "default", self.metadata.name)

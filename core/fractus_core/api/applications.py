"""Application: the kind that users submit (thesis Listings 12 and 13)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from typing import Any, Literal

from pydantic import Field

from fractus_core.api.components import Component, ContactLoss, Placement, PointsOfInterest, ReferenceField
from fractus_core.api.model import AGE, READY, Conditions, Model, ObservedGeneration, OpenModel, Resource, keyed
from fractus_core.api.policies import PolicyAction, one_action_for_each_policy
from fractus_core.api.rules import Violation, rule


def _each(
    field: ReferenceField, cel: str, message: str, fits: Callable[[ApplicationSpec, Component, str], bool]
) -> Any:
    """Return a rule for a field of components that lists names: every name must be valid.

    `cel` tests the name n in the component c.
    """

    @rule(f"self.components.all(c, !has(c.{field}) || c.{field}.all(n, {cel}))", f"{field} {message}")
    def each(self: ApplicationSpec) -> Violation:
        for i, component in enumerate(self.components):
            for j, name in enumerate(component.references(field)):
                if not fits(self, component, name):
                    return f"components[{i}].{field}[{j}]", name
        return None

    return each


def _known(field: ReferenceField) -> Any:
    return _each(
        field,
        "self.components.exists(d, d.name == n)",
        "names a component that is not in the application; correct the name or add the component",
        lambda spec, _, name: spec.find(name) is not None,
    )


def _other(field: ReferenceField) -> Any:
    return _each(field, "n != c.name", "names the component itself; remove it", lambda _, c, name: name != c.name)


_NOT_MISSION: dict[str, Any] = {
    "start": True,
    "update_policy": True,
    "after_flight": True,
    "ttl_after_finished": True,
    "components": {"__all__": {"ends_with"}},
}
"""Fields that may change without starting another mission."""


class ApplicationSpec(Model):
    """The components of an application and how they interact."""

    components: tuple[Component, ...] = Field(
        min_length=1,
        max_length=50,
        json_schema_extra=keyed("name"),
        description="Components of the application; each has a container image and a placement.",
    )
    start: Literal["immediately", "whenReady"] = Field(
        default="immediately",
        description="When the mission may begin. immediately: as soon as the drone is ready. whenReady: the motors do not start"
        " while a pod of a component is not ready. After the takeoff, the mission continues without it.",
    )
    policy_actions: tuple[PolicyAction, ...] = Field(
        default=(),
        max_length=100,
        description="Repair actions that the application selects for policies with choices. For other policies, their own"
        " action applies.",
    )
    contact_lost: ContactLoss | None = Field(
        default=None,
        description="Reaction when the drone loses contact with the API server; unset: the mission continues.",
    )
    max_altitude: float | None = Field(
        default=None,
        gt=0,
        le=20_000,
        description="Maximum altitude of the flight in metres above home; unset: that of the drone.",
    )
    update_policy: Literal["OnGround", "Immediate"] = Field(
        default="OnGround",
        description="When changes of a running application take effect. OnGround: after the drone has landed. Immediate: also"
        " in flight, which restarts the changed components, including the driver.",
    )
    after_flight: int = Field(
        default=30,
        ge=0,
        le=3600,
        description="Seconds for which components that end with the flight continue to run after the landing, for example to"
        " transfer their data. They have no control and no access to services of nodes in this time.",
    )
    ttl_after_finished: int = Field(
        default=600,
        ge=0,
        le=604_800,
        description="Seconds for which the stopped pods are kept after the mission, so that their logs can be read."
        " Stopped pods reserve no resources on their nodes.",
    )

    @rule(
        "self.components.all(c, self.components.exists_one(d,"
        " d.name.replace('-', '').lowerAscii() == c.name.replace('-', '').lowerAscii()))",
        "component names must differ in more than capitalisation and hyphens; rename one of them",
    )
    def _distinct_objects(self) -> Violation:
        seen: dict[str, str] = {}
        for i, component in enumerate(self.components):
            plain = component.name.replace("-", "").lower()
            if plain in seen:
                return f"components[{i}].name", f"{component.name} and {seen[plain]}"
            seen[plain] = component.name
        return None

    _distinct_policies = one_action_for_each_policy()

    @rule(
        "self.components.filter(c, has(c.class) && c.class == 'driver').size() <= 1",
        "an application has at most one driver",
    )
    def _one_driver(self) -> Violation:
        drivers = self._where(lambda c: c.class_ == "driver")
        return f"components[{drivers[1]}].class" if len(drivers) > 1 else None

    @rule(
        "!self.components.exists(c, c.placement == 'drone') ||"
        " self.components.exists(c, (has(c.class) && c.class == 'driver') || has(c.pointsOfInterest))",
        "an application with drone components needs a driver, or one passenger with pointsOfInterest",
    )
    def _flown(self) -> Violation:
        aboard = self._where(lambda c: c.placement == "drone")
        flown = self.driver is not None or self.points_of_interest is not None
        return f"components[{aboard[0]}].pointsOfInterest" if aboard and not flown else None

    @rule(
        "!has(self.start) || self.start != 'whenReady' || self.components.exists(c, c.placement == 'drone')",
        "start: whenReady delays the flight of a drone, and no component runs on a drone; remove it",
    )
    def _start_needs_drone(self) -> Violation:
        return "start" if self.start == "whenReady" and not any(self.on("drone")) else None

    _known_ingress = _known("ingress")
    _known_egress = _known("egress")
    _known_hybrid = _known("hybridTo")
    _other_ingress = _other("ingress")
    _other_egress = _other("egress")
    _other_hybrid = _other("hybridTo")

    _hybrid_hosts = _each(
        "hybridTo",
        "self.components.exists(d, d.name == n && d.placement in ['drone', 'edge'])",
        "takes components placed on a drone or at the edge",
        lambda spec, _, name: spec.component(name).placement in {"drone", "edge"},
    )
    _egress_ports = _each(
        "egress",
        "self.components.exists(d, d.name == n && has(d.container.ports) && size(d.container.ports) > 0)",
        "names a component without container.ports; give it the port it listens on",
        lambda spec, _, name: bool(spec.component(name).container.ports),
    )

    @rule(
        "self.components.filter(c, has(c.pointsOfInterest)).size() <= 1",
        "only one passenger may have pointsOfInterest",
    )
    def _one_guide(self) -> Violation:
        guides = self._where(lambda c: c.points_of_interest is not None)
        return f"components[{guides[1]}].pointsOfInterest" if len(guides) > 1 else None

    @rule(
        "!self.components.exists(c, has(c.pointsOfInterest)) ||"
        " !self.components.exists(c, has(c.class) && c.class == 'driver')",
        "an application with a driver cannot have pointsOfInterest; remove them",
    )
    def _driver_or_guide(self) -> Violation:
        guides = self._where(lambda c: c.points_of_interest is not None)
        return f"components[{guides[0]}].pointsOfInterest" if guides and self.driver is not None else None

    def _where(self, test: Callable[[Component], bool]) -> list[int]:
        return [i for i, component in enumerate(self.components) if test(component)]

    @property
    def mission_digest(self) -> str:
        """Hash of the fields that define the mission: all fields except those of `_NOT_MISSION`."""
        mission = self.model_dump(mode="json", by_alias=True, exclude_defaults=True, exclude=_NOT_MISSION)
        return hashlib.sha256(json.dumps(mission, sort_keys=True).encode()).hexdigest()

    @property
    def driver(self) -> Component | None:
        """The driver, or None if the application has none."""
        return next((c for c in self.components if c.class_ == "driver"), None)

    @property
    def leader(self) -> Component | None:
        """The component that determines the flight: the driver, or the passenger with points of interest."""
        return self.driver or next((c for c in self.components if c.points_of_interest is not None), None)

    @property
    def points_of_interest(self) -> PointsOfInterest | None:
        """The points of interest of the application."""
        return self.leader.points_of_interest if self.leader is not None else None

    def on(self, placement: Placement) -> Iterator[Component]:
        """Return the components with a placement, in order."""
        return (c for c in self.components if c.placement == placement)

    def find(self, name: str) -> Component | None:
        """Return the component with a name, or None."""
        return next((c for c in self.components if c.name == name), None)

    def component(self, name: str) -> Component:
        """Return the component with a name.

        Raises:
            KeyError: The application has no such component.
        """
        component = self.find(name)
        if component is None:
            raise KeyError(name)
        return component

    def callers(self, name: str) -> set[str]:
        """Return the declared callers of a component, from its `ingress` and their `egress`.

        If no caller is declared, all components may call it.
        """
        return {other.name for other in self.components if name in other.egress}.union(self.component(name).ingress)


class ApplicationStatus(OpenModel):
    """Observed state of an application."""

    observed_generation: ObservedGeneration = None
    phase: (
        Literal[
            "Pending",
            "Queued",
            "Deploying",
            "Running",
            "Waiting",
            "TakingOff",
            "Flying",
            "Returning",
            "Landed",
            "Unknown",
            "Completed",
            "Failed",
            "Invalid",
        ]
        | None
    ) = Field(default=None, description="Current phase of the application.")
    drone: str | None = Field(default=None, description="Name of the drone that flies the application.")
    controller: str | None = Field(
        default=None, description="Control authority of the airborne drone: system, pilot, or the name of the driver."
    )
    pods: str | None = Field(default=None, description="Number of ready pods and of all pods, such as 6/7.")
    message: str | None = Field(default=None, description="Human-readable description of the current state.")
    conditions: Conditions = ()


class Application(Resource, plural="applications", short="fapp", namespaced=True):
    """An application whose components run on a drone, at the edge and in the cloud."""

    COLUMNS = (
        ("Phase", "string", ".status.phase"),
        ("Drone", "string", ".status.drone"),
        ("Controller", "string", ".status.controller"),
        ("Pods", "string", ".status.pods"),
        READY,
        ("Reason", "string", ".status.conditions[?(@.type=='Ready')].reason"),
        AGE,
        ("Message", "string", ".status.message"),
    )

    kind: Literal["Application"] = "Application"
    spec: ApplicationSpec
    status: ApplicationStatus | None = None

    @property
    def key(self) -> tuple[str, str]:
        """(namespace, name)."""
        return (self.metadata.namespace or "default", self.metadata.name)

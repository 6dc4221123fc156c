"""DeploymentPlan: the result of planning an application."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal, Self

from pydantic import Field, WithJsonSchema, model_validator

from fractus_core.api.components import (
    ComponentClass,
    ControlPoint,
    ControlScope,
    Placement,
    PointsOfInterest,
    ServiceRequest,
)
from fractus_core.api.geometry import Area, Point, Position
from fractus_core.api.model import AGE, Conditions, InvalidObject, Model, ObservedGeneration, OpenModel, Resource
from fractus_core.api.names import component_identity
from fractus_core.api.policies import PolicySpec, ZoneShape

Role = Literal["drone", "static", "hybrid-edge", "hybrid-drone", "cloud"]
GeoJson = Annotated[dict[str, Any], WithJsonSchema({"type": "object", "x-kubernetes-preserve-unknown-fields": True})]


class Alternative(Model):
    """A drone that could also fly the application."""

    node: str = Field(description="Name of the drone.")
    score: float = Field(description="Score; higher is better, comparable only within one plan.")


class TransitLeg(Model):
    """A straight leg of a transit flight, which the system flies."""

    start: Position
    end: Position


class LegLegality(Model):
    """A leg that policies do not allow as requested, judged by the policy engine for a start from hover."""

    start: Position
    end: Position
    flown_by: Literal["system", "driver"] = Field(description="Control authority on the leg.")
    outcome: Literal["Detour", "Corrected", "Denied"] = Field(
        description="Detour: the system flies around. Corrected: altitude or speed is changed. Denied: the leg is not flown"
        " (completely)."
    )
    reason: str = Field(description="Machine-readable CamelCase reason.")
    message: str = Field(description="Human-readable explanation.")
    policies: tuple[str, ...] = Field(default=(), description="Names of the deciding policies, most restrictive first.")


class Mission(Model):
    """Estimated flight of the application, including the approach from and the return to the home position."""

    distance: float = Field(ge=0, description="Ground distance in metres.")
    duration: float = Field(ge=0, description="Flight time in minutes.")
    available: float = Field(description="Available flight time of the drone in minutes, without the battery reserve.")


class DroneChoice(Model):
    """The selected drone, and the alternatives in order of preference."""

    node: str = Field(description="Name of the drone.")
    score: float | None = Field(default=None, description="Score; higher is better, comparable only within one plan.")
    shared_with: str | None = Field(
        default=None,
        description="namespace/name of the application that flies the drone, if this application shares its flight.",
    )
    mission: Mission | None = Field(
        default=None, description="Estimated flight; unset if the application shares the flight of another one."
    )
    transit: tuple[TransitLeg, ...] = Field(default=(), description="Legs that the system flies, in order.")
    legality: tuple[LegLegality, ...] = Field(
        default=(),
        description="Legs that policies deny, correct or divert, in order, according to the latest policies and zones;"
        " empty: all legs are allowed as requested.",
    )
    legality_omitted: int | None = Field(
        default=None, ge=1, description="Number of such legs omitted from `legality` because of its size limit."
    )
    policy_conflict: str | None = Field(
        default=None, description="Reason why policies do not allow the mission as planned; unset: they allow it."
    )
    alternatives: tuple[Alternative, ...] = Field(
        default=(), description="Other drones that could fly the application, best first."
    )


class Serves(Model):
    """The instance near which a hybrid instance is placed."""

    component: str = Field(description="Component of that instance.")
    node: str = Field(description="Node of that instance.")


class PlannedInstance(Model):
    """One instance of a component on a node."""

    component: str = Field(description="Name of the component.")
    instance: str = Field(
        description="Name of the instance, unique in the namespace and used by its pods and its Grant."
    )
    node: str | None = Field(description="Name of the node; unset: any cloud node.", default=None)
    placement: Placement = Field(description="Placement declared by the component.")
    role: Role = Field(
        description="Role of the instance: drone, static (at a location), hybrid-edge (near another edge instance),"
        " hybrid-drone (along the flight path) or cloud."
    )
    replicas: int = Field(default=1, ge=1, description="Number of pods; greater than 1 only in the cloud.")
    serves: Serves | None = None
    coverage: float | None = Field(
        default=None,
        ge=0,
        le=1,
        description="Share of the operation area that this instance adds to the coverage, 0 to 1.",
    )
    location: int | None = Field(
        default=None, ge=0, description="For role static: index of the location in the component's locations."
    )


class Rejection(Model):
    """A node that was considered for a component and rejected."""

    component: str = Field(description="Name of the component.")
    node: str = Field(description="Name of the node.")
    reason: str = Field(description="Machine-readable CamelCase reason.")
    message: str = Field(description="Human-readable explanation.")


class DeploymentPlanSpec(Model):
    """Decisions of the planner, with reasons."""

    application: str = Field(description="Name of the application, in this namespace.")
    application_generation: int | None = Field(
        default=None, description="metadata.generation of the application that was planned."
    )
    application_digest: str | None = Field(
        default=None,
        description="Hash of the mission fields of the application. If it is unchanged, the plan is still valid.",
    )
    operation_area: GeoJson | None = Field(
        default=None, description="Operation area as a GeoJSON MultiPolygon (longitude, latitude)."
    )
    drone: DroneChoice | None = None
    placements: tuple[PlannedInstance, ...] = Field(default=(), description="Instances and their nodes.")
    rejected: tuple[Rejection, ...] = Field(
        default=(), description="Rejected nodes, each with the first failed requirement."
    )
    rejected_omitted: int | None = Field(
        default=None,
        ge=1,
        description="Number of rejected nodes omitted from `rejected` (out of range, or above the list limit).",
    )


class DeploymentPlan(Resource, plural="deploymentplans", short="fplan", namespaced=True, written_by_operator=True):
    """The plan of an application: operation area, placements, scores, and rejected nodes with reasons."""

    COLUMNS = (
        ("Application", "string", ".spec.application"),
        ("Drone", "string", ".spec.drone.node"),
        AGE,
    )

    kind: Literal["DeploymentPlan"] = "DeploymentPlan"
    spec: DeploymentPlanSpec


class GrantedZone(ZoneShape):
    """A zone of a granted policy with its geometry, so that the node can enforce it offline."""

    name: str = Field(description="Name of the Zone.")


class GrantedPolicy(Model):
    """A policy that applies to the instance, with its zones resolved."""

    name: str = Field(description="Name of the Policy.")
    spec: PolicySpec
    zones: tuple[GrantedZone, ...] = Field(
        default=(),
        description="Zones of spec.selector.zones with their areas; empty if the policy applies everywhere.",
    )

    @model_validator(mode="after")
    def _resolved(self) -> Self:
        """Reject a policy without the areas of all its zones: a zone without area would restrict nothing."""
        missing = sorted(set(self.spec.selector.zones) - {zone.name for zone in self.zones})
        if missing:
            raise InvalidObject(
                "zones", f"policy {self.name} selects {', '.join(missing)}; add the area of each selected zone"
            )
        return self


class ApplicationReference(Model):
    """Reference to an application. The uid distinguishes it from other applications of the same name."""

    namespace: str = Field(description="Namespace of the application.")
    name: str = Field(description="Name of the application.")
    uid: str = Field(description="metadata.uid of the application.")


class GrantedLimits(Model):
    """Performance limits of the airframe."""

    max_altitude: float = Field(gt=0, description="Maximum altitude in metres above home.")
    max_speed: float = Field(gt=0, description="Maximum ground speed in metres per second.")


class GrantSpec(Model):
    """The policy configuration of one component instance on one node."""

    node: str = Field(description="Name of the node whose services the instance may call.")
    application: ApplicationReference
    component: str = Field(description="Name of the component.")
    instance: str = Field(description="Name of the instance, unique in the namespace.")
    class_: ComponentClass | None = Field(
        default=None,
        alias="class",
        description="Class of a drone component: driver (commands the drone) or passenger (does not); unset for other nodes.",
    )
    control: ControlScope | None = Field(
        default=None, description="Control of a driver: full (the whole flight) or partial (at its control points)."
    )
    control_points: tuple[ControlPoint, ...] = Field(
        default=(), description="Control points of the driver, in flight order."
    )
    points_of_interest: PointsOfInterest | None = None
    tour: tuple[Position, ...] = Field(
        default=(),
        description="Positions that the system visits in this order before it returns home: the mission of an application"
        " without a driver. Empty: a driver flies, or the application shares the flight of another one.",
    )
    services: tuple[ServiceRequest, ...] = Field(
        default=(), description="System services that the instance may call, with the methods."
    )
    operation_area: tuple[Area, ...] = Field(
        default=(),
        description="Area in which services may be used; required on a drone. Empty: no bounds (fixed nodes).",
    )
    corridor: tuple[Area, ...] = Field(
        default=(), description="Area in which the drone may fly between its depot and the operation area."
    )
    depot: Point | None = None
    home: Position | None = None
    limits: GrantedLimits | None = None
    policies: tuple[GrantedPolicy, ...] = Field(default=(), description="Policies that apply to the instance.")
    mission: str | None = Field(
        default=None,
        max_length=253,
        description="Identifier of the mission, set when the Grant is signed. The drone remembers finished missions, so a new"
        " mission needs a new identifier.",
    )
    issued_at: datetime | None = Field(
        default=None,
        description="Time of signing. If there are several Grants for an instance, the latest one applies.",
    )

    @property
    def identity(self) -> str:
        """SPIFFE ID of the instance."""
        return component_identity(self.application.namespace, self.application.name, self.component, self.instance)

    @property
    def unsigned(self) -> Self:
        """The specification without the fields that signing adds."""
        return self.model_copy(update={"mission": None, "issued_at": None})

    @property
    def mission_key(self) -> str:
        """Identifier of the mission that includes the instance, so that no Grant can claim the mission of another instance."""
        return f"{self.identity}#{self.mission or ''}"

    @property
    def unbounded(self) -> str:
        """Reason why no drone may fly under the Grant; empty if the flight is bounded.

        A missing operation area must not allow flight anywhere, so unlimited flight needs an explicit, large area.
        """
        flies = self.class_ or ("tour" if self.tour else "")
        return f"a {flies} needs operationArea" if flies and not self.operation_area else ""

    def methods(self, service: str) -> frozenset[str]:
        """Return the granted methods of a service. A driver may always get and return control."""
        granted = {m for s in self.services if s.service == service for m in s.methods}
        if service == "mobility" and self.class_ == "driver":
            granted |= {"GetControl", "ReturnControl"}
        return frozenset(granted)


GrantPhase = Literal["Pending", "Active", "Complete", "Revoked", "Failed"]
ENDED: frozenset[GrantPhase] = frozenset({"Complete", "Revoked", "Failed"})
"""Final phases: a Grant never leaves them."""


class GrantStatus(OpenModel):
    """State of the Grant on its node."""

    phase: GrantPhase | None = Field(
        default=None,
        description="Pending until the node has stored the Grant; then the state of its mission.",
    )
    message: str | None = Field(default=None, description="Human-readable explanation.")
    observed_generation: ObservedGeneration = None
    conditions: Conditions = ()


class Grant(Resource, plural="grants", short="fgr", written_by_operator=True, selectable=(".spec.node",)):
    """The policy configuration of one component instance on one node."""

    COLUMNS = (
        ("Node", "string", ".spec.node"),
        ("Application", "string", ".spec.application.name"),
        ("Component", "string", ".spec.component"),
        ("Phase", "string", ".status.phase"),
        AGE,
    )

    kind: Literal["Grant"] = "Grant"
    spec: GrantSpec
    status: GrantStatus | None = None

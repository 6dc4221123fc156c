"""DeploymentPlan and Grant: what the operator decided, and what a node needs to enforce it offline."""

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
    """A drone that could fly the application, with what ranks it."""

    node: str = Field(description="The drone.")
    score: float = Field(description="Higher is better; comparable within one plan only.")


class TransitLeg(Model):
    """A straight piece of a transit, that is of flight by the system."""

    start: Position
    end: Position


class LegLegality(Model):
    """A leg that policies do not let be flown as it was asked for, as the policy engine judges it from standstill."""

    start: Position
    end: Position
    flown_by: Literal["system", "driver"] = Field(description="Whose leg it is.")
    outcome: Literal["Detour", "Corrected", "Denied"] = Field(
        description="The system flies around; altitude or speed are corrected; it is not flown, or not to its end."
    )
    reason: str = Field(description="CamelCase, for programs.")
    message: str = Field(description="One sentence for people.")
    policies: tuple[str, ...] = Field(default=(), description="Those that decided, the most restrictive first.")


class Mission(Model):
    """What the application takes of the drone, with the way to its start and home, and what the drone has."""

    distance: float = Field(ge=0, description="Metres over ground.")
    duration: float = Field(ge=0, description="Minutes of flight.")
    available: float = Field(description="Minutes the drone can fly with its reserve kept.")


class DroneChoice(Model):
    """The drone that flies, and the runners-up in order."""

    node: str = Field(description="The drone.")
    score: float | None = Field(default=None, description="Higher is better; comparable within one plan only.")
    shared_with: str | None = Field(
        default=None, description="namespace/name of the application that flies the drone; this one comes along."
    )
    mission: Mission | None = Field(default=None, description="Unset when the application comes along.")
    transit: tuple[TransitLeg, ...] = Field(default=(), description="The legs that the system flies, in order.")
    legality: tuple[LegLegality, ...] = Field(
        default=(),
        description="The legs that policies deny, correct or lead around, in order, as of the last change of policies and"
        " zones; empty: all are legal as asked.",
    )
    legality_omitted: int | None = Field(
        default=None, ge=1, description="How many such legs are not listed, for there are too many."
    )
    policy_conflict: str | None = Field(
        default=None, description="Why the policies do not let the mission be flown as planned; unset: they do."
    )
    alternatives: tuple[Alternative, ...] = Field(default=(), description="The next best drones, best first.")


class Serves(Model):
    """Which instance a hybrid instance is near to."""

    component: str = Field(description="Its component.")
    node: str = Field(description="Its node.")


class PlannedInstance(Model):
    """One instance of a component on a node."""

    component: str = Field(description="Name of the component.")
    instance: str = Field(description="Name of the instance, unique in the namespace; pods and grants carry it.")
    node: str | None = Field(description="Name of the node; null: any cloud node.", default=None)
    placement: Placement = Field(description="As the component declares it.")
    role: Role = Field(
        description="What it is there for: on the drone, at a location, near another instance, in the cloud."
    )
    replicas: int = Field(default=1, ge=1, description="Pods of it; more than one only in the cloud.")
    serves: Serves | None = None
    coverage: float | None = Field(default=None, ge=0, le=1, description="Share of the operation area it adds.")
    location: int | None = Field(
        default=None, ge=0, description="For role static: which of the component's locations, counted from 0."
    )


class Rejection(Model):
    """A node that was considered for a component and dropped."""

    component: str = Field(description="Name of the component.")
    node: str = Field(description="Name of the node.")
    reason: str = Field(description="CamelCase, for programs.")
    message: str = Field(description="One sentence for people.")


class DeploymentPlanSpec(Model):
    """What was decided and why."""

    application: str = Field(description="Name of the application, in this namespace.")
    application_generation: int | None = Field(default=None, description="metadata.generation of it that was planned.")
    application_digest: str | None = Field(
        default=None, description="Hash of what it says of the mission: a change elsewhere needs no other plan."
    )
    operation_area: GeoJson | None = Field(default=None, description="GeoJSON (lon, lat) MultiPolygon.")
    drone: DroneChoice | None = None
    placements: tuple[PlannedInstance, ...] = Field(default=(), description="Which instance runs where.")
    rejected: tuple[Rejection, ...] = Field(default=(), description="Nodes that were dropped, with the first reason.")
    rejected_omitted: int | None = Field(
        default=None,
        ge=1,
        description="How many rejected nodes are not listed: most of those too far away, and what is too much.",
    )


class DeploymentPlan(Resource, plural="deploymentplans", short="fplan", namespaced=True, written_by_operator=True):
    """The plan of an application: areas, placements, scores, rejected nodes with reasons."""

    COLUMNS = (
        ("Application", "string", ".spec.application"),
        ("Drone", "string", ".spec.drone.node"),
        AGE,
    )

    kind: Literal["DeploymentPlan"] = "DeploymentPlan"
    spec: DeploymentPlanSpec


class GrantedZone(ZoneShape):
    """A zone of a granted policy, with its geometry, so that the node needs nothing else."""

    name: str = Field(description="Name of the Zone.")


class GrantedPolicy(Model):
    """A policy that holds for the instance, with its zones resolved."""

    name: str = Field(description="Name of the Policy.")
    spec: PolicySpec
    zones: tuple[GrantedZone, ...] = Field(
        default=(),
        description="Those of spec.selector.zones with their areas; empty where that names none: everywhere.",
    )

    @model_validator(mode="after")
    def _resolved(self) -> Self:
        """A zone without its area would restrict nothing: such a grant must not be flown under."""
        missing = sorted(set(self.spec.selector.zones) - {zone.name for zone in self.zones})
        if missing:
            raise InvalidObject(
                "zones", f"policy {self.name} selects {', '.join(missing)}; give the area of each zone that it selects"
            )
        return self


class ApplicationReference(Model):
    """The application that it is for; its uid tells it from another one of its name."""

    namespace: str = Field(description="Its namespace.")
    name: str = Field(description="Its name.")
    uid: str = Field(description="Its metadata.uid.")


class GrantedLimits(Model):
    """What the airframe can do."""

    max_altitude: float = Field(gt=0, description="Metres above home.")
    max_speed: float = Field(gt=0, description="Metres per second.")


class GrantSpec(Model):
    """The policy configuration of one component instance on one node."""

    node: str = Field(description="The node whose services it is for.")
    application: ApplicationReference
    component: str = Field(description="Name of the component.")
    instance: str = Field(description="Name of the instance, unique in the namespace.")
    class_: ComponentClass | None = Field(
        default=None, alias="class", description="driver flies the drone, passenger comes along; unset: on no drone."
    )
    control: ControlScope | None = Field(
        default=None, description="What a driver has of the flight: all of it, or a part."
    )
    control_points: tuple[ControlPoint, ...] = Field(default=(), description="Where a driver flies, in this order.")
    points_of_interest: PointsOfInterest | None = None
    tour: tuple[Position, ...] = Field(
        default=(),
        description="Places that the system flies the drone to, in this order, and home from the last: the mission of an"
        " application without a driver. Empty: a driver flies, or the application comes along with another.",
    )
    services: tuple[ServiceRequest, ...] = Field(
        default=(), description="The system services that it may call, with the methods."
    )
    operation_area: tuple[Area, ...] = Field(
        default=(), description="Where services may be used; needed on a drone. Empty: anywhere (fixed nodes)."
    )
    corridor: tuple[Area, ...] = Field(
        default=(), description="Where the drone may be to get from its depot to the operation area and back."
    )
    depot: Point | None = None
    home: Position | None = None
    limits: GrantedLimits | None = None
    policies: tuple[GrantedPolicy, ...] = Field(default=(), description="Those that hold for it.")
    mission: str | None = Field(
        default=None,
        max_length=253,
        description="Set when it is signed: names the mission. A drone remembers which missions are over; another one begins"
        " with another name.",
    )
    issued_at: datetime | None = Field(
        default=None, description="Set when it is signed; of two Grants for one instance the later one counts."
    )

    @property
    def identity(self) -> str:
        """The SPIFFE id of the instance that the grant is for."""
        return component_identity(self.application.namespace, self.application.name, self.component, self.instance)

    @property
    def unsigned(self) -> Self:
        """The same without what signing adds."""
        return self.model_copy(update={"mission": None, "issued_at": None})

    @property
    def mission_key(self) -> str:
        """Tells the mission from all others: by what is signed, so that no grant can take another instance's drone."""
        return f"{self.identity}#{self.mission or ''}"

    @property
    def unbounded(self) -> str:
        """Why no drone may be flown under it; empty when it has bounds.

        An area that was left out by mistake must not let a drone fly anywhere: "everywhere" is said by an area that large.
        """
        flies = self.class_ or ("tour" if self.tour else "")
        return f"a {flies} needs operationArea" if flies and not self.operation_area else ""

    def methods(self, service: str) -> frozenset[str]:
        """The methods granted on a service; a driver may always get and return control."""
        granted = {m for s in self.services if s.service == service for m in s.methods}
        if service == "mobility" and self.class_ == "driver":
            granted |= {"GetControl", "ReturnControl"}
        return frozenset(granted)


GrantPhase = Literal["Pending", "Active", "Complete", "Revoked", "Failed"]
ENDED: frozenset[GrantPhase] = frozenset({"Complete", "Revoked", "Failed"})
"""Of these none is taken back once it was reported."""


class GrantStatus(OpenModel):
    """What became of the grant on its node."""

    phase: GrantPhase | None = Field(
        default=None, description="Pending until the node has it; then how its mission stands."
    )
    message: str | None = Field(default=None, description="One sentence for people.")
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

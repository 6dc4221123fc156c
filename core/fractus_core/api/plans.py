"""DeploymentPlan: the result of planning an application."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import Field, WithJsonSchema

from fractus_core.api.components import (
    Placement,
)
from fractus_core.api.geometry import Position
from fractus_core.api.grants import ReportedPictures, ReportedWaypoints
from fractus_core.api.model import AGE, Model, Resource

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
        description="Detour: the system flies a longer way. Corrected: altitude or speed is changed. Denied: the leg"
        " or a part of it is not flown."
    )
    reason: str = Field(description="Machine-readable CamelCase reason.")
    message: str = Field(description="Human-readable explanation.")
    policies: tuple[str, ...] = Field(default=(), description="Names of the deciding policies, most restrictive first.")


class PlannedMission(Model):
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
    mission: PlannedMission | None = Field(
        default=None, description="Estimated flight; unset if the application shares the flight of another application."
    )
    transit: tuple[TransitLeg, ...] = Field(default=(), description="Legs that the system flies, in order.")
    legality: tuple[LegLegality, ...] = Field(
        default=(),
        description="Legs that policies deny, correct or divert, in order, according to the latest policies and zones;"
        " empty: all legs are allowed as requested.",
    )
    legality_omitted: int | None = Field(
        default=None, ge=1, description="Number of legs omitted from `legality` because of its size limit."
    )
    policy_conflict: str | None = Field(
        default=None, description="Reason why policies do not allow the mission as planned; unset: they allow it."
    )
    alternatives: tuple[Alternative, ...] = Field(
        default=(), description="Other drones that could fly the application, best first."
    )


class Serves(Model):
    """The instance near which a hybrid instance is placed."""

    component: str = Field(description="Component of the served instance.")
    node: str = Field(description="Node of the served instance.")


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


class MissionRecord(Model):
    """The mission of a plan, as the operator observed it."""

    outcome: Literal["Complete", "Revoked", "Failed"] | None = Field(
        default=None, description="Outcome of the mission; unset: the mission has begun and is not over."
    )
    message: str | None = Field(default=None, description="Human-readable explanation of the outcome.")
    waypoints: ReportedWaypoints | None = Field(
        default=None,
        description="Numbers of reached, skipped and corrected waypoints. Missing if the node has not reported them.",
    )
    pictures: ReportedPictures | None = Field(
        default=None,
        description="Pictures that the Application requested from the drone's camera. Missing without a request.",
    )
    landed: bool = Field(
        default=False, description="True if the drone was on the ground at the outcome, or has landed since."
    )
    landed_at: datetime | None = Field(
        default=None, description="Time at which the operator first observed the drone on the ground after the outcome."
    )


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
    flown: MissionRecord | None = Field(
        default=None,
        description="The mission of this plan, as the operator observed it; unset before the takeoff.",
    )

    @property
    def is_over(self) -> bool:
        """True if the mission of this plan is over, even if the drone is still returning."""
        return self.flown is not None and self.flown.outcome is not None


class DeploymentPlan(Resource, plural="deploymentplans", short="fplan", namespaced=True, written_by_operator=True):
    """The plan of an application: operation area, placements, scores, and rejected nodes with reasons."""

    COLUMNS = (
        ("Application", "string", ".spec.application"),
        ("Drone", "string", ".spec.drone.node"),
        AGE,
    )

    kind: Literal["DeploymentPlan"] = "DeploymentPlan"
    spec: DeploymentPlanSpec

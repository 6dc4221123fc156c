"""ApplicationTemplate and FlightPlan: flights that a user orders without writing an Application (thesis Listings 2 and 4)."""

from __future__ import annotations

import re
from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import Field, WithJsonSchema

from fractus_core.api.applications import ApplicationSpec
from fractus_core.api.components import ContactLoss
from fractus_core.api.geometry import Area, Position
from fractus_core.api.model import (
    AGE,
    READY,
    Conditions,
    Model,
    ObservedGeneration,
    OpenModel,
    Resource,
    Timestamp,
)
from fractus_core.api.names import Name
from fractus_core.api.plans import Alternative, Rejection
from fractus_core.api.policies import PolicyAction, one_action_for_each_policy
from fractus_core.api.rules import Violation, one_of, referenced_by, rule

_DIGEST = r"@sha256:[0-9a-f]{64}$"

Navigation = Literal["path", "region"]
PlanState = Literal["Draft", "Rejected", "Accepted", "Activated", "Nonconforming", "Contingent", "Ended"]
"""State of a flight plan.

Draft: not decided. Rejected: not permitted. Accepted: reserves its volumes. Activated: may fly. Nonconforming: outside its
volumes, or late. Contingent: the system has taken the drone and ends the flight. Ended: over.
"""

PARAMETERS_INVALID = "ParametersInvalid"
"""Reason of a refusal: the parameters of the plan do not fit the schema of the template."""

PriorityClass = Literal["normal", "elevated", "emergency"]

FreeObject = Annotated[dict[str, Any], WithJsonSchema({"type": "object", "x-kubernetes-preserve-unknown-fields": True})]
"""A JSON object whose fields the schema of the kind does not define."""


class FlightAltitudes(Model):
    """Altitudes of a flight in metres above home."""

    lower: float = Field(
        default=0,
        ge=0,
        le=20_000,
        description="Lowest altitude away from depot and landing places; default: the ground.",
    )
    upper: float = Field(gt=0, le=20_000, description="Highest altitude.")

    @rule("!has(self.lower) || self.lower < self.upper", "lower must be below upper")
    def _ordered(self) -> Violation:
        return "lower" if self.lower >= self.upper else None


class ApplicationTemplateSpec(Model):
    """An application without its place and time."""

    description: str = Field(default="", max_length=2000, description="Purpose of the application, for its users.")
    class_: Name | None = Field(
        default=None, alias="class", description="Class of the application, such as surveillance; unset: no class."
    )
    navigation: Navigation = Field(
        description="path: a plan gives waypoints that are visited in order. region: a plan gives an area in which the driver"
        " flies freely."
    )
    altitudes: FlightAltitudes
    parameters: FreeObject = Field(
        default_factory=dict,
        description="JSON schema (2020-12) of the parameters of a plan, at most 16 KiB; empty: no parameters. The keywords $ref,"
        " $dynamicRef, pattern, patternProperties, unevaluatedItems, unevaluatedProperties and uniqueItems are not permitted.",
    )
    template: ApplicationSpec = Field(
        description="Application that flies. The waypoints or the region of a plan replace those of its driver or of its points"
        " of interest."
    )

    @rule(
        f"self.template.components.all(c, c.container.image.matches('{_DIGEST}'))",
        "every image needs a digest, because the approval is for its content; write IMAGE@sha256:DIGEST",
    )
    def _images_by_digest(self) -> Violation:
        for i, component in enumerate(self.template.components):
            if re.search(_DIGEST, component.container.image) is None:
                return f"template.components[{i}].container.image", component.container.image
        return None

    @rule(
        "self.template.components.exists(c, has(c.pointsOfInterest) || (has(c.controlPoints) && size(c.controlPoints) == 1))",
        "the template needs one component that leads the flight: a driver with one control point, or a passenger with"
        " pointsOfInterest",
    )
    def _one_leader(self) -> Violation:
        leader = self.template.leader
        if leader is None:
            return "template.components"
        driven = leader.points_of_interest is None
        return "template.components" if driven and len(leader.control_points) != 1 else None

    @rule(
        "self.navigation != 'region' || self.template.components.exists(c, has(c.controlPoints)"
        " && c.controlPoints.exists(p, has(p.region)))",
        "navigation region needs a driver with a control point that has a region",
    )
    def _region(self) -> Violation:
        leader = self.template.leader
        points = leader.control_points if leader is not None else ()
        return "navigation" if self.navigation == "region" and not any(p.region for p in points) else None


class Approval(OpenModel):
    """Approval of one generation of a template."""

    generation: int = Field(ge=1, description="metadata.generation that is approved. Later generations are not.")
    by: str = Field(max_length=253, description="User who approved the template.")
    at: datetime = Field(description="Time of the approval.")
    note: str = Field(default="", max_length=2000, description="Remark of the authority.")


class ApplicationTemplateStatus(OpenModel):
    """Approval of a template, written by an authority, and conditions, written by the operator."""

    observed_generation: ObservedGeneration = None
    approval: Approval | None = Field(default=None, description="Approval by the authority; unset: not approved.")
    conditions: Conditions = ()


class ApplicationTemplate(Resource, plural="applicationtemplates", short="ftpl"):
    """An application that users may order with a FlightPlan after an authority has approved it."""

    COLUMNS = (
        ("Class", "string", ".spec.class"),
        ("Navigation", "string", ".spec.navigation"),
        ("Approved", "integer", ".status.approval.generation"),
        READY,
        AGE,
    )

    kind: Literal["ApplicationTemplate"] = "ApplicationTemplate"
    spec: ApplicationTemplateSpec
    status: ApplicationTemplateStatus | None = None

    _nameable = referenced_by("ApplicationTemplate", "flight plans")

    @property
    def approved(self) -> bool:
        """True if the present generation is approved."""
        approval = self.status.approval if self.status is not None else None
        return approval is not None and approval.generation == self.metadata.generation


class FlightWindow(Model):
    """Time in which a flight begins and ends."""

    start: Timestamp = Field(description="Earliest takeoff (RFC 3339).")
    duration: float = Field(
        gt=0, le=1440, description="Minutes from start until the drone is home again, including the way home."
    )

    # The schema also permits lists. The comparison with a timestamp rejects lists.
    @rule("self.start >= timestamp(0)", "start must be an RFC 3339 time after 1970")
    def _after_1970(self) -> Violation:
        return "start" if self.start.timestamp() < 0 else None

    @property
    def begin_s(self) -> float:
        """Start in seconds since 1970 UTC."""
        return self.start.timestamp()

    @property
    def end_s(self) -> float:
        """End in seconds since 1970 UTC."""
        return self.begin_s + self.duration * 60


def application_name(uid: str) -> str:
    """Return the name of the Application that flies the flight plan with a uid."""
    return f"flight-{uid}"


class FlightPlanSpec(Model):
    """A flight that a user orders."""

    template: Name = Field(description="Name of the ApplicationTemplate.")
    parameters: FreeObject = Field(
        default_factory=dict, description="Parameters of the application, as the schema of the template defines them."
    )
    waypoints: tuple[Position, ...] | None = Field(
        default=None, min_length=1, max_length=1000, description="Positions to visit in order, for navigation path."
    )
    region: Area | None = Field(default=None, description="Area in which the driver flies, for navigation region.")
    stay: float | None = Field(default=None, gt=0, le=1440, description="Flight time in the region in minutes.")
    window: FlightWindow
    drone: Name | None = Field(default=None, description="Name of the drone; unset: any suitable drone.")
    priority_class: PriorityClass = Field(
        default="normal",
        description="Plans may overlap plans of a lower class. elevated and emergency need the permission prioritize.",
    )
    policy_actions: tuple[PolicyAction, ...] = Field(
        default=(),
        max_length=100,
        description="Selected repair action for each policy that has several.",
    )
    contact_lost: ContactLoss | None = Field(
        default=None,
        description="Reaction when the drone loses contact with the API server; unset: that of the template.",
    )
    use: Literal["Planned", "InUse", "Closed"] = Field(
        default="Planned",
        description="Planned: the airspace is reserved. InUse: the drone may take off in the window. Closed: the flight is"
        " over, or ends now.",
    )
    auto_activate: bool = Field(
        default=False, description="True to treat Planned as InUse from the start of the window."
    )
    dry_run: bool = Field(
        default=False, description="True to decide the plan without a reservation, and to delete it after a minute."
    )
    change_of: Name | None = Field(
        default=None,
        description="Dry runs only: name of the plan in this namespace whose change is decided. The plan does not conflict with"
        " its own change. Unset: a new plan is decided.",
    )

    _one_place = one_of("waypoints", "region")
    _distinct_policies = one_action_for_each_policy()

    @rule(
        "!has(self.changeOf) || (has(self.dryRun) && self.dryRun)",
        "only a dry run may have changeOf; change the plan itself, or set dryRun: true",
    )
    def _checked_change(self) -> Violation:
        return "changeOf" if self.change_of is not None and not self.dry_run else None

    @rule(
        "has(self.region) == has(self.stay)",
        "a region needs stay: the flight time in it in minutes; waypoints have none",
    )
    def _stay_in_region(self) -> Violation:
        return "stay" if (self.region is None) != (self.stay is None) else None


class ReservedVolume(OpenModel):
    """Airspace that a plan reserves."""

    areas: tuple[Area, ...] = Field(description="Ground area.")
    lower: float | None = Field(default=None, description="Metres above mean sea level; unset: the ground.")
    upper: float | None = Field(default=None, description="Metres above mean sea level; unset: unlimited.")
    begin: datetime = Field(description="First moment.")
    end: datetime = Field(description="Last moment.")


class PlanFinding(OpenModel):
    """A reason of the decision on a plan."""

    reason: str = Field(description="Machine-readable CamelCase reason.")
    message: str = Field(description="Human-readable explanation.")
    plan: str | None = Field(default=None, description="namespace/name of the other plan; unset: none.")


class PlanRestriction(OpenModel):
    """A policy that applies to the flight."""

    policy: Name = Field(description="Name of the Policy.")
    choices: tuple[str, ...] = Field(default=(), description="Repair actions among which the plan selects.")
    chosen: str | None = Field(default=None, description="Repair action in force; unset: the plan must select one.")


class FlightPlanStatus(OpenModel):
    """Decision on a plan and progress of its flight."""

    observed_generation: ObservedGeneration = None
    decided_for: int | None = Field(
        default=None, description="metadata.generation that state and volumes result from; unset: not decided."
    )
    state: PlanState | None = Field(default=None, description="State of the plan; unset: Draft.")
    message: str | None = Field(default=None, description="Human-readable description of the state.")
    priority_class: PriorityClass | None = Field(
        default=None,
        description="Priority class of the version that state and volumes result from; unset: not decided.",
    )
    drone: str | None = Field(default=None, description="Name of the reserved drone.")
    candidates: tuple[Alternative, ...] = Field(
        default=(), description="Drones that fit, best first. Only dry runs list them."
    )
    rejected: tuple[Rejection, ...] = Field(default=(), description="Drones that do not fit, each with the reason.")
    volumes: tuple[ReservedVolume, ...] = Field(default=(), description="Volumes in which the flight stays.")
    off_nominal_volumes: tuple[ReservedVolume, ...] = Field(
        default=(), description="Volumes in which the drone may be because it does not keep to the plan."
    )
    restrictions: tuple[PlanRestriction, ...] = Field(default=(), description="Policies that apply to the flight.")
    refusals: tuple[PlanFinding, ...] = Field(default=(), description="Reasons why the latest version is refused.")
    advisories: tuple[PlanFinding, ...] = Field(default=(), description="Overlaps with other plans that are permitted.")
    application: str | None = Field(default=None, description="Name of the Application that flies.")
    conditions: Conditions = ()


class FlightPlan(Resource, plural="flightplans", short="fpl", namespaced=True, selectable=(".status.drone",)):
    """A flight of an approved application at a place, in a time window."""

    COLUMNS = (
        ("Template", "string", ".spec.template"),
        ("State", "string", ".status.state"),
        ("Drone", "string", ".status.drone"),
        ("Start", "string", ".spec.window.start"),
        ("Minutes", "number", ".spec.window.duration"),
        AGE,
        ("Message", "string", ".status.message"),
    )

    kind: Literal["FlightPlan"] = "FlightPlan"
    spec: FlightPlanSpec
    status: FlightPlanStatus | None = None

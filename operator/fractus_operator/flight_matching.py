"""Matching of a flight plan with a drone: the Application, the drone, the volumes and the policies of its flight. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from fractus_core.airspace import Volume4D, flight_volumes
from fractus_core.api import Application, ApplicationTemplate, Drone, FlightPlan, InvalidObject
from fractus_core.api.flight_plans import PlanFinding, PlanRestriction
from fractus_core.api.plans import Alternative, DeploymentPlanSpec, Rejection
from fractus_core.planning.grant_compiler import compile_grants
from fractus_core.planning.inventory import Inventory, Settings
from fractus_core.planning.legality import with_legality
from fractus_core.planning.ordered_application import ordered_application
from fractus_core.planning.planner import Infeasible, plan
from fractus_core.policy.decision_types import distinct
from fractus_core.validation import check_application

SOON_S = 300.0
"""Seconds before the window of a plan from which the present state and charge of drones matter."""

POLICY_CONFLICT = "PolicyConflict"
"""Reason of a rejection or an advisory: policies do not allow the route."""

_MAX_REJECTED = 100
"""Maximum number of rejected drones in a status, so that it fits into a Kubernetes object."""


class Unfit(Exception):
    """No drone can fly a plan, or its flight is not permitted.

    Attributes:
        reason: CamelCase.
        message: One sentence.
        rejected: Drones that do not fit, each with the reason.
    """

    def __init__(self, reason: str, message: str, rejected: tuple[Rejection, ...] = ()) -> None:
        self.reason = reason
        self.message = message
        self.rejected = rejected
        super().__init__(message)


@dataclass(frozen=True, slots=True)
class Match:
    """A flight plan with the drone that flies it.

    Attributes:
        application: Application that flies.
        drone: Name of the drone.
        volumes: Airspace of the whole flight.
        candidates: Drones that fit, best first.
        rejected: Drones that do not fit, each with the reason.
        restrictions: Policies that apply to the flight.
        advisories: Permitted conflicts with policies.
    """

    application: Application
    drone: str
    volumes: tuple[Volume4D, ...]
    candidates: tuple[Alternative, ...] = ()
    rejected: tuple[Rejection, ...] = ()
    restrictions: tuple[PlanRestriction, ...] = ()
    advisories: tuple[PlanFinding, ...] = ()

    @property
    def undecided(self) -> tuple[str, ...]:
        """Policies for which the user must select an action."""
        return tuple(each.policy for each in self.restrictions if each.chosen is None)

    @property
    def choices_problem(self) -> str:
        """Sentence about the policies for which the user must select an action, or an empty string."""
        if not self.undecided:
            return ""
        return f"select an action in spec.policyActions for each policy with choices: {', '.join(self.undecided)}"


def match_flight(
    flight: FlightPlan,
    template: ApplicationTemplate | None,
    inventory: Inventory,
    settings: Settings,
    now_s: float,
    *,
    preferred: str | None = None,
) -> Match:
    """Return the drone and the volumes of a flight in the rest of its window.

    If the window begins later than `SOON_S`, the present state and charge of drones do not matter. The caller gives an
    inventory without bookings then.

    Args:
        flight: The flight plan.
        template: Its template, or None if the template does not exist.
        inventory: Current inventory. `claimed` contains only claims that last until the window.
        settings: Settings of planning.
        now_s: Time in seconds since 1970 UTC.
        preferred: Drone that is selected if it is suitable. A drone that the plan names comes first.

    Raises:
        Unfit: No drone is suitable, or the plan or its template is invalid.
    """
    window = flight.spec.window
    if not now_s < window.end_s:
        raise Unfit("WindowOver", "the window of the plan is over; choose a later time")
    begin_s = max(window.begin_s, now_s)
    settings = replace(settings, time_s=begin_s, until_s=window.end_s, begins_later=window.begin_s - now_s > SOON_S)
    try:
        application = application_of(flight, template)
        check_application(application, inventory.depots)
        planned = _planned(application, inventory, settings, flight.spec.drone, preferred)
        if planned.drone is None:
            raise Unfit("Invalid", f"no component of ApplicationTemplate {flight.spec.template} runs on a drone")
        drone = inventory.drones[planned.drone.node]
        # Grants have a maximum altitude but no minimum altitude, so the volumes begin at the ground.
        volumes = flight_volumes(application, drone, inventory, settings, begin_s=begin_s, end_s=window.end_s)
        return Match(
            application,
            drone.name,
            volumes,
            (Alternative(node=drone.name, score=planned.drone.score or 0), *planned.drone.alternatives),
            _drones(planned.rejected, inventory),
            _restrictions(application, planned, inventory, settings),
            _policy_conflicts(application, planned, inventory, settings),
        )
    except InvalidObject as error:
        raise Unfit("Invalid", str(error)) from error


def application_of(flight: FlightPlan, template: ApplicationTemplate | None) -> Application:
    """Return the Application that flies a plan.

    Raises:
        Unfit: The template does not exist.
        InvalidObject: The template is not approved, or does not fit the plan.
    """
    if template is None:
        name = flight.spec.template
        raise Unfit("TemplateMissing", f"there is no ApplicationTemplate {name}; apply it, or correct spec.template")
    return ordered_application(flight, template)


def _planned(
    application: Application,
    inventory: Inventory,
    settings: Settings,
    named: str | None,
    preferred: str | None,
) -> DeploymentPlanSpec:
    """Return the deployment of an Application on the named drone, otherwise on the preferred or the best drone."""
    try:
        if named is not None:
            return _on_drone(application, inventory, settings, named)
        if preferred is not None and preferred in inventory.drones:
            try:
                return _on_drone(application, inventory, settings, preferred)
            except Infeasible:
                pass
        return plan(application, inventory, settings)
    except Infeasible as infeasible:
        message = infeasible.message
        rejected = infeasible.rejected
        if named is not None:
            rejected = tuple(each for each in rejected if each.node == named)
            details = [each.message for each in rejected] or ["it is not near the start, or does not exist"]
            message = f"Drone {named} cannot fly the plan: {details[0]}"
            others = _suitable(application, inventory, settings)
            message += f"; {others} can; name it, or remove spec.drone" if others else "; no other drone can"
        raise Unfit(infeasible.reason, message, _drones(rejected, inventory)) from infeasible


def _drones(rejected: Sequence[Rejection], inventory: Inventory) -> tuple[Rejection, ...]:
    """Return the rejected drones, up to `_MAX_REJECTED`, without those that were excluded in favour of the selected one."""
    drones = [each for each in rejected if each.node in inventory.drones and each.reason != "Excluded"]
    return tuple(drones[:_MAX_REJECTED])


def _on_drone(application: Application, inventory: Inventory, settings: Settings, name: str) -> DeploymentPlanSpec:
    excluded = dict(settings.excluded) | other_drones(inventory.drones, name, f"the flight plan has Drone {name}")
    return plan(application, inventory, replace(settings, excluded=excluded))


def _suitable(application: Application, inventory: Inventory, settings: Settings) -> str | None:
    """Return the name of a suitable drone, or None."""
    try:
        found = plan(application, inventory, settings).drone
    except (Infeasible, InvalidObject):
        return None
    return f"Drone {found.node}" if found is not None else None


def other_drones(drones: Mapping[str, Drone], name: str, reason: str) -> dict[str, str]:
    """Return a reason to exclude each drone except one."""
    return {other: reason for other in drones if other != name}


def _restrictions(
    application: Application, planned: DeploymentPlanSpec, inventory: Inventory, settings: Settings
) -> tuple[PlanRestriction, ...]:
    """Return the policies that apply to the flight, with the selected actions."""
    grants = compile_grants(application, planned, inventory, settings)
    selected = {each.policy: str(each.action) for each in application.spec.policy_actions}
    restrictions = []
    for name in sorted({policy.name for grant in grants for policy in grant.policies}):
        policy = inventory.policies.get(name)
        if policy is None:
            continue
        own = str(policy.spec.action) if policy.spec.action is not None else None
        if not policy.spec.choices:
            restrictions.append(PlanRestriction(policy=name, chosen=own or policy.spec.type))
            continue
        choices = distinct(each for each in (own, *map(str, policy.spec.choices)) if each is not None)
        chosen = selected.get(name)
        restrictions.append(PlanRestriction(policy=name, choices=tuple(choices), chosen=chosen))
    return tuple(restrictions)


def _policy_conflicts(
    application: Application, planned: DeploymentPlanSpec, inventory: Inventory, settings: Settings
) -> tuple[PlanFinding, ...]:
    """Return the conflicts of the route with policies at the begin, at the end, or in between in the window.

    Raises:
        Unfit: The policies do not allow the route at the begin and at the end, or conflicts are forbidden.
    """
    mission = planned.drone.mission if planned.drone is not None else None
    assert settings.time_s is not None and settings.until_s is not None, "the window of a flight plan"
    # The latest flight ends with the window.
    last_s = max(settings.until_s - mission.duration * 60, settings.time_s) if mission is not None else settings.time_s
    later = with_legality(application, planned, inventory, replace(settings, time_s=last_s))
    conflicts = [
        (when, checked.drone.policy_conflict)
        for when, checked in (("at the begin of", planned), ("at the end of", later))
        if checked.drone is not None and checked.drone.policy_conflict is not None
    ]
    if not conflicts:
        always = with_legality(application, planned, inventory, settings, throughout=True)
        if always.drone is not None and always.drone.policy_conflict is not None:
            conflicts = [("in a part of", always.drone.policy_conflict)]
    if len(conflicts) == 2 or (conflicts and settings.policy_conflicts == "forbid"):
        raise Unfit(POLICY_CONFLICT, conflicts[0][1])
    return tuple(
        PlanFinding(reason=POLICY_CONFLICT, message=f"{when} the window, {message}") for when, message in conflicts
    )

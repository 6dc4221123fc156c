"""The Application of a flight plan: a template with the place, actions and parameters of the plan."""

from __future__ import annotations

import json
from typing import Any

from fractus_core.api.applications import Application, ApplicationSpec
from fractus_core.api.components import Component
from fractus_core.api.flight_plans import ApplicationTemplate, FlightPlan, FlightPlanSpec, application_name
from fractus_core.api.model import API_VERSION, InvalidObject

PARAMETERS = "FLIGHT_PARAMETERS"
"""Environment variable of every container with the parameters of the plan as JSON."""


def ordered_application(plan: FlightPlan, template: ApplicationTemplate) -> Application:
    """Return the Application that flies a plan. Its name contains the uid of the plan, so it is created at most once.

    Raises:
        InvalidObject: The template is not approved, its navigation does not match the plan, or the result is invalid.
    """
    if not template.approved:
        raise InvalidObject(
            "spec.template",
            f"generation {template.metadata.generation} of ApplicationTemplate {template.name} is not approved; ask the"
            " authority for an approval, or choose another template",
        )
    given = "region" if plan.spec.region is not None else "path"
    if given != template.spec.navigation:
        wanted = "a region" if template.spec.navigation == "region" else "waypoints"
        raise InvalidObject(
            "spec", f"ApplicationTemplate {template.name} has navigation {template.spec.navigation}; give {wanted}"
        )
    spec = template.spec.template
    leader = spec.leader
    components = [
        _with_parameters(_led(each, plan.spec) if each is leader else each, plan.spec) for each in spec.components
    ]
    selected = {action.policy: action for action in (*spec.policy_actions, *plan.spec.policy_actions)}
    highest_m = template.spec.altitudes.upper
    changed = spec.model_copy(
        update={
            "max_altitude": highest_m if spec.max_altitude is None else min(highest_m, spec.max_altitude),
            "components": tuple(components),
            "policy_actions": tuple(selected.values()),
            "contact_lost": plan.spec.contact_lost or spec.contact_lost,
        }
    )
    return Application.from_body(_body(plan, changed))


def _body(plan: FlightPlan, spec: ApplicationSpec) -> dict[str, Any]:
    uid = plan.metadata.uid or ""
    owner = {
        "apiVersion": API_VERSION, "kind": FlightPlan.KIND, "name": plan.name, "uid": uid,
        "controller": True, "blockOwnerDeletion": True,
    }  # fmt: skip
    return {
        "apiVersion": API_VERSION,
        "kind": Application.KIND,
        "metadata": {
            "name": application_name(uid),
            "namespace": plan.metadata.namespace or "default",
            "ownerReferences": [owner],
        },
        "spec": spec.to_dict(),
    }


def _led(leader: Component, plan: FlightPlanSpec) -> Component:
    """Return the component that leads the flight with the waypoints or the region of the plan."""
    if leader.points_of_interest is not None:
        points = leader.points_of_interest.model_copy(update={"points": plan.waypoints})
        return leader.model_copy(update={"points_of_interest": points})
    (point,) = leader.control_points
    place: dict[str, Any] = {"path": plan.waypoints, "region": plan.region, "duration": plan.stay}
    return leader.model_copy(update={"control_points": (point.model_copy(update=place),)})


def _with_parameters(component: Component, plan: FlightPlanSpec) -> Component:
    if not plan.parameters:
        return component
    container = component.container.to_dict()
    entry = {"name": PARAMETERS, "value": json.dumps(plan.parameters, sort_keys=True)}
    container["env"] = [*(each for each in container.get("env", ()) if each["name"] != PARAMETERS), entry]
    return component.model_copy(update={"container": type(component.container).model_validate(container)})

"""Conversion between InterUSS' flights and FlightPlans. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime, timedelta
from typing import Any, cast

import shapely
from fractus_core.airspace import Volume4D as ReservedAirspace
from fractus_core.airspace.conflicts import first_overlap
from fractus_core.airspace.plan_status import volume_of
from fractus_core.api import FlightPlan, InvalidObject
from fractus_core.api.flight_plans import FlightPlanSpec, PriorityClass
from fractus_core.api.geometry import Area
from fractus_core.geo import LocalFrame, area_center, area_polygon, areas_of_shape, center_of
from fractus_runtime.kubernetes import Body

from fractus_management.interuss.flight_authorisation import authorisation_problems
from fractus_management.interuss.messages import (
    FlightPlanMessage,
    PlanningResponse,
    PlanningResult,
    PlanStatus,
    Volume4D,
)
from fractus_management.request_bodies import parsed_spec

STAY_MIN = 1.0
"""Flight time in the area in minutes, unless the flight states `additional_information.fractus.stay`."""

ELEVATED_PRIORITY = 1
EMERGENCY_PRIORITY = 100
"""Lowest ASTM F3548 priorities of the priority classes elevated and emergency."""

_OWN_FIELDS = frozenset({"template", "stay", "drone", "parameters", "policyActions", "contactLost"})
"""Fields of a FlightPlan that `additional_information.fractus` may contain."""

_STATUSES: dict[str, PlanStatus] = {
    "Draft": "NotPlanned",
    "Rejected": "NotPlanned",
    "Accepted": "Planned",
    "Activated": "OkToFly",
    "Nonconforming": "OffNominal",
    "Contingent": "OffNominal",
    "Ended": "Closed",
}


class Unplannable(Exception):
    """A flight cannot become a FlightPlan.

    Attributes:
        result: Planning result of the response.
    """

    def __init__(self, result: PlanningResult, message: str) -> None:
        self.result = result
        super().__init__(message)


# -- requests --


def flight_plan_spec(flight: FlightPlanMessage, template: str, now_s: float) -> FlightPlanSpec:
    """Return the specification of the FlightPlan of a flight.

    The region is the outline of the area, or the convex hull of several volumes. The window is their time span. Altitudes
    are not part of a FlightPlan (`altitude_problem`).

    Args:
        flight: The flight.
        template: ApplicationTemplate, unless the flight names one.
        now_s: Time in seconds since 1970 UTC.

    Raises:
        Unplannable: The flight is invalid, or Fractus does not support it.
    """
    basic = flight.basic_information
    if basic.uas_state in {"OffNominal", "Contingent"}:
        raise Unplannable(
            "NotSupported", "Fractus observes the drone itself, so users cannot report an off-nominal state"
        )
    problems = list(authorisation_problems(flight.uspace_flight_authorisation or {}))
    if flight.uspace_flight_authorisation is not None and problems:
        raise Unplannable("Rejected", f"uspace_flight_authorisation: {'; '.join(problems)}")
    volumes = basic.area or ()
    if not volumes:
        raise Unplannable("Rejected", "basic_information.area is empty; give at least one volume")
    starts = [each.time_start.value for each in volumes if each.time_start is not None]
    ends = [each.time_end.value for each in volumes if each.time_end is not None]
    if len(starts) < len(volumes) or len(ends) < len(volumes):
        raise Unplannable("Rejected", "a volume has no time_start or time_end; give both")
    if basic.usage_state == "InUse" and min(starts).timestamp() > now_s:
        raise Unplannable("Rejected", "the time of the flight has not begun; activate it later")
    priority = flight.astm_f3548_21.priority if flight.astm_f3548_21 is not None else None
    spec = {
        "template": template,
        "stay": STAY_MIN,
        **_own_fields(flight.additional_information or {}),
        "window": {
            "start": min(starts).isoformat(timespec="microseconds"),
            "duration": (max(ends) - min(starts)).total_seconds() / 60,
        },
        "use": "InUse" if basic.usage_state == "InUse" else "Planned",
        "priorityClass": priority_class(priority or 0),
    }
    try:
        spec["region"] = _outline(volumes).to_dict()
        return cast(FlightPlanSpec, parsed_spec(FlightPlan, spec))
    except InvalidObject as error:
        raise Unplannable("Rejected", str(error)) from None


def priority_class(priority: int) -> PriorityClass:
    """Return the priority class of an ASTM F3548 priority."""
    if priority < ELEVATED_PRIORITY:
        return "normal"
    return "elevated" if priority < EMERGENCY_PRIORITY else "emergency"


def _own_fields(information: Mapping[str, Any]) -> dict[str, Any]:
    own = information.get("fractus") or {}
    if not isinstance(own, dict) or not _OWN_FIELDS.issuperset(own):
        raise Unplannable(
            "Rejected", f"additional_information.fractus may have the fields {', '.join(sorted(_OWN_FIELDS))} only"
        )
    return own


def _outline(volumes: Sequence[Volume4D]) -> Area:
    """Return the ground area of volumes: that of a single volume, or the convex hull of several.

    Raises:
        InvalidObject: A volume has no outline or two, or its outline is invalid.
    """
    areas = [_area(each) for each in volumes]
    if len(areas) == 1:
        return areas[0]
    frame = LocalFrame.at(center_of(map(area_center, areas)))
    hull = shapely.convex_hull(shapely.union_all([area_polygon(frame, area) for area in areas]))
    return areas_of_shape(frame, hull)[0]


def _area(volume: Volume4D) -> Area:
    circle = volume.volume.outline_circle
    polygon = volume.volume.outline_polygon
    if (circle is None) == (polygon is None):
        raise InvalidObject("area", "a volume has either outline_circle or outline_polygon")
    if circle is not None:
        center = {"lat": circle.center.lat, "lon": circle.center.lng}
        return Area.model_validate({"circle": {"center": center, "radius": circle.radius.value}})
    assert polygon is not None
    corners = [{"lat": each.lat, "lon": each.lng} for each in polygon.vertices]
    return Area.model_validate({"polygon": {"exterior": corners}})


# -- altitudes --


def altitude_problem(
    volumes: Sequence[Volume4D], reserved: Sequence[Mapping[str, Any]], home_m: float | None, geoid_m: float
) -> str:
    """Return why reserved volumes do not reach the altitudes of a flight, or an empty string if they do.

    A FlightPlan reserves all altitudes from the ground to the limit of its template.

    Args:
        volumes: Area of the flight.
        reserved: `status.volumes` of the FlightPlan.
        home_m: Ground elevation of the home of the drone above mean sea level, in metres; None: unknown.
        geoid_m: Height of the geoid above the ellipsoid, in metres.
    """
    highest_m = max((each.get("upper", math.inf) for each in reserved), default=-math.inf)
    for each in volumes:
        upper = each.volume.altitude_upper
        lower = each.volume.altitude_lower
        if upper is None:
            return "a volume has no altitude_upper; give one"
        base_m = -geoid_m if upper.reference == "W84" else home_m
        if base_m is None:
            return f"the ground elevation is unknown, so altitudes above {upper.reference} cannot be compared"
        if lower is not None and lower.reference == upper.reference and lower.value >= upper.value:
            return "altitude_lower must be below altitude_upper"
        if upper.value + base_m > highest_m:
            return (
                f"{upper.value:g} m ({upper.reference}) is {upper.value + base_m:.0f} m above mean sea level, but the template"
                f" permits only {highest_m:.0f} m"
            )
    return ""


# -- clear area --


def reserves_in(plan: Body, extent: Volume4D) -> bool:
    """Return True if a FlightPlan reserves airspace in an extent. The altitudes of the extent are ignored.

    Raises:
        InvalidObject: The extent or a volume of the plan is invalid.
    """
    status = FlightPlan.from_body(plan).status
    if status is None or status.state in {"Rejected", "Ended"}:
        return False
    cleared = ReservedAirspace.of_area(
        _area(extent),
        lower_m=-math.inf,
        upper_m=math.inf,
        begin_s=extent.time_start.value.timestamp() if extent.time_start is not None else 0.0,
        end_s=extent.time_end.value.timestamp() if extent.time_end is not None else 1e11,
    )
    reserved = [volume_of(each) for each in (*status.volumes, *status.off_nominal_volumes)]
    return first_overlap([cleared], reserved) is not None


# -- responses --


def status_of(plan: Body | None) -> PlanStatus:
    """Return the status of a FlightPlan; None: it does not exist."""
    state = (plan or {}).get("status", {}).get("state") or "Draft"
    return _STATUSES[state]


def response_of(plan: Body | None, result: PlanningResult, notes: str = "") -> PlanningResponse:
    """Return the response to a request about a FlightPlan."""
    advisories = (plan or {}).get("status", {}).get("advisories") or ()
    messages = [notes, *(each["message"] for each in advisories)]
    return PlanningResponse(
        planning_result=result,
        flight_plan_status=status_of(plan),
        notes="; ".join(filter(None, messages)) or None,
        includes_advisories="AtLeastOneAdvisoryOrCondition" if advisories else "NoAdvisoriesOrConditions",
    )


def refusal_of(plan: Body) -> Unplannable | None:
    """Return why the latest version of a FlightPlan is not in force, or None if it is."""
    status = plan.get("status") or {}
    conditions = {each["type"]: each for each in status.get("conditions") or ()}
    for name, value in (
        ("ActionNeeded", "True"),
        ("ChangeRefused", "True"),
        ("Startable", "False"),
        ("Accepted", "False"),
    ):
        condition = conditions.get(name)
        if condition is not None and condition["status"] == value:
            result: PlanningResult = "NotSupported" if condition["reason"] == "ChangeNotPermitted" else "Rejected"
            return Unplannable(result, str(condition.get("message") or condition["reason"]))
    return None


def notifications_of(plan: Body, after: datetime, before: datetime | None) -> Iterator[Body]:
    """Yield the notification of a conflict that arose with a FlightPlan, if the operator reported it in a time."""
    status = plan.get("status") or {}
    overlaps = [each for each in status.get("advisories") or () if each.get("plan")]
    for condition in status.get("conditions") or ():
        if condition["type"] != "ConflictArose" or condition["status"] != "True":
            continue
        at = datetime.fromisoformat(condition["lastTransitionTime"])
        # Kubernetes omits the fraction of a second. A difference does not overflow for the first and last times of datetime.
        if after - at < timedelta(seconds=1) and (before is None or at <= before):
            yield {
                "observed_at": {"value": condition["lastTransitionTime"], "format": "RFC3339"},
                "message": condition.get("message", ""),
                "conflicts": "Multiple" if len(overlaps) > 1 else "Single",
            }

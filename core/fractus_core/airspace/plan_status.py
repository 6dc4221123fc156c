"""Conversion between the status of FlightPlans and operational intents. A new operator leader reads its airspace from them."""

from __future__ import annotations

import math
from datetime import UTC, datetime

from fractus_core.airspace.conflicts import OperationalIntent
from fractus_core.airspace.decide import Finding
from fractus_core.airspace.volumes import Volume4D
from fractus_core.api.flight_plans import FlightPlan, PlanFinding, PriorityClass, ReservedVolume
from fractus_core.exhaustive import exhaustive

PRIORITIES: dict[PriorityClass, int] = exhaustive(PriorityClass, {"normal": 0, "elevated": 1, "emergency": 2})
"""Priority of each priority class."""


def intent_of(plan: FlightPlan) -> OperationalIntent:
    """Return the operational intent that the status of a plan describes: its volumes in force, not those of a newer spec.

    Raises:
        InvalidObject: A volume of the status is invalid.
    """
    name = f"{plan.metadata.namespace or 'default'}/{plan.name}"
    status = plan.status
    if status is None:
        return OperationalIntent(name, "Draft", PRIORITIES[plan.spec.priority_class])
    return OperationalIntent(
        name,
        status.state or "Draft",
        PRIORITIES[status.priority_class or plan.spec.priority_class],
        tuple(volume_of(volume) for volume in status.volumes),
        tuple(volume_of(volume) for volume in status.off_nominal_volumes),
    )


def volume_of(reserved: ReservedVolume) -> Volume4D:
    """Return a volume of a status.

    Raises:
        InvalidObject: The volume is invalid.
    """
    return Volume4D.of_corners(
        reserved.areas,
        lower_m=-math.inf if reserved.lower is None else reserved.lower,
        upper_m=math.inf if reserved.upper is None else reserved.upper,
        begin_s=reserved.begin.timestamp(),
        end_s=reserved.end.timestamp(),
    )


def reserved_volume(volume: Volume4D) -> ReservedVolume:
    """Return a volume as it is stored in a status."""
    return ReservedVolume(
        areas=volume.areas(),
        lower=None if volume.lower_m == -math.inf else volume.lower_m,
        upper=None if volume.upper_m == math.inf else volume.upper_m,
        begin=datetime.fromtimestamp(volume.begin_s, UTC),
        end=datetime.fromtimestamp(volume.end_s, UTC),
    )


def plan_finding(finding: Finding) -> PlanFinding:
    """Return a reason of a decision as it is stored in a status."""
    return PlanFinding(reason=finding.reason, message=finding.message, plan=finding.other or None)

"""Which instances of an Application continue to run after its mission, and for how long. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta

from fractus_core.api import Application
from fractus_core.api.applications import ApplicationSpec
from fractus_core.api.components import default_lifetime
from fractus_core.api.plans import DeploymentPlanSpec, MissionRecord, PlannedInstance

from fractus_operator.kinds import Body
from fractus_operator.labels import COMPONENT_LABEL, INSTANCE_LABEL

_DEFAULT_AFTER_FLIGHT_S: int = ApplicationSpec.model_fields["after_flight"].default
_MAX_CLOCK_DIFFERENCE = timedelta(minutes=2)
"""A landing later than this in the future was recorded with a wrong clock. It keeps no instance running."""


@dataclass(frozen=True, slots=True)
class AfterFlight:
    """The instances that continue to run after a mission.

    Attributes:
        running: These instances.
        flight_ended: True if none of them ends with the flight.
        next_s: Seconds until the instances that end with the flight stop. Infinite before the landing, and if there are none.
    """

    running: tuple[PlannedInstance, ...] = ()
    flight_ended: bool = True
    next_s: float = float("inf")

    @property
    def instances(self) -> frozenset[str]:
        """Names of the running instances."""
        return frozenset(placed.instance for placed in self.running)

    def keeps(self, body: Body) -> bool:
        """Return True if a child object is still needed, because its instance or an instance of its component runs.

        An object of the whole Application, such as the disruption budget, is needed for the instances on the drone.
        """
        labels = body["metadata"]["labels"]
        if INSTANCE_LABEL in labels:
            return labels[INSTANCE_LABEL] in self.instances
        component = labels.get(COMPONENT_LABEL)
        if component is None:
            return not self.flight_ended
        return any(placed.component == component for placed in self.running)


def after_flight(application: Application | None, plan: DeploymentPlanSpec, now: datetime) -> AfterFlight:
    """Return the instances that continue to run after the mission of a plan.

    Args:
        application: The Application, or None if its manifest is invalid. Its components then have the default lifetime.
        plan: The plan, with the record of the mission.
        now: The current time.
    """
    assert plan.flown is not None
    after_s = application.spec.after_flight if application is not None else _DEFAULT_AFTER_FLIGHT_S
    remaining_s = _remaining_s(plan.flown, after_s, now)
    if remaining_s > 0:
        return AfterFlight(plan.placements, flight_ended=False, next_s=remaining_s)
    return until_deleted(application, plan)


def until_deleted(application: Application | None, plan: DeploymentPlanSpec) -> AfterFlight:
    """Return the instances of a plan that run until the Application is deleted. Instances on the drone are never included."""
    drone = plan.drone.node if plan.drone is not None else None

    def lasts(placed: PlannedInstance) -> bool:
        component = application.spec.find(placed.component) if application is not None else None
        lifetime = component.lifetime if component is not None else default_lifetime(placed.placement)
        return lifetime == "application" and (placed.node is None or placed.node != drone)

    return AfterFlight(tuple(placed for placed in plan.placements if lasts(placed)))


def _remaining_s(record: MissionRecord, after_s: int, now: datetime) -> float:
    """Return the seconds for which instances that end with the flight continue to run. Infinite before the landing."""
    if not record.landed:
        return float("inf")
    # Plans of an earlier release do not contain the time of the landing.
    if record.landed_at is None or record.landed_at > now + _MAX_CLOCK_DIFFERENCE:
        return 0.0
    return (record.landed_at + timedelta(seconds=after_s) - now).total_seconds()

"""The flight of a plan: its application, and the time in which its records are searched. Pure."""

from __future__ import annotations

from dataclasses import dataclass

from fractus_core.api.flight_plans import FlightPlan, application_name
from fractus_core.api.names import ComponentIdentity

BEFORE_S = 600.0
"""Seconds before the window of a plan from which records are searched. The clock of the node may differ."""

AFTER_S = 3600.0
"""Seconds after the window of a plan until which records are searched. A drone may come home late."""


class NoFlight(Exception):
    """A plan has no flight on this node. The message is one sentence."""


@dataclass(frozen=True, slots=True)
class PlannedFlight:
    """The flight of a plan on this node.

    The name of the Application contains the uid of the plan, so it identifies the flight among all others.

    Attributes:
        namespace: Namespace of the plan.
        application: Name of the Application that flies.
        begin_s: Begin of the time in which records are searched, in seconds since 1970 UTC.
        end_s: End of this time.
    """

    namespace: str
    application: str
    begin_s: float
    end_s: float

    def owns(self, identity: object) -> bool:
        """Return True if a text is the SPIFFE ID of a component instance of the flight."""
        parsed = ComponentIdentity.parse(identity) if isinstance(identity, str) else None
        return parsed is not None and (parsed.namespace, parsed.application) == (self.namespace, self.application)

    def covers(self, time_s: float) -> bool:
        """Return True if records of a time are searched."""
        return self.begin_s <= time_s <= self.end_s

    def may_cover(self, begin_s: float, next_s: float) -> bool:
        """Return True if a file of records may contain records that are searched.

        Args:
            begin_s: Time of the first record of the file.
            next_s: Time of the first record of the next file. If the clock of the node was set back between these times, the
                end of the file is unknown.
        """
        return next_s < begin_s or (next_s >= self.begin_s and begin_s <= self.end_s)


def planned_flight(plan: FlightPlan, node: str) -> PlannedFlight:
    """Return the flight of a plan on a node.

    Raises:
        NoFlight: The plan has not started, or flies with another drone.
    """
    status = plan.status
    if status is None or status.application is None:
        raise NoFlight(f"the flight of {plan.name} has not started; read its records after the takeoff")
    if status.drone != node or status.application != application_name(plan.metadata.uid or ""):
        raise NoFlight(f"{node} does not fly {plan.name}; read the records at {status.drone}")
    window = plan.spec.window
    ends = [volume.end.timestamp() for volume in status.volumes]
    namespace = plan.metadata.namespace or "default"
    end_s = max((window.end_s, *ends)) + AFTER_S
    return PlannedFlight(namespace, status.application, window.begin_s - BEFORE_S, end_s)

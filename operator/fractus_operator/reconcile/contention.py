"""What other applications leave of the drones: the input of planning, and whether a plan lost its drone."""

from __future__ import annotations

from collections.abc import Mapping

from fractus_core.planning.inventory import Flight, Inventory

from fractus_operator.inventory.live import LiveInventory
from fractus_operator.inventory.observed import Observed
from fractus_operator.reconcile.shared_flights import may_share, offered_flights, shared_flight_lost


def planning_input(live: LiveInventory, seen: Observed, radius_m: float) -> tuple[Inventory, tuple[str, str] | None]:
    """The input of planning for an application; and why its plan lost its drone, if it did.

    Args:
        live: The cluster.
        seen: The application, as it is at the same moment.
        radius_m: How far from its path a drone may be.

    Returns:
        The inventory; and the reason (CamelCase) and a sentence, if another application has the drone, or if the flight that
        it shared is over or leads elsewhere.
    """
    application, plan = seen.submitted.application, seen.plan
    flights: Mapping[str, Flight] = {}
    if may_share(application):
        others = (f for f in live.fleet.flown() if f.application.key != seen.key)
        flights = offered_flights(others, live.depots_by_name(), radius_m, plan)
    inventory = live.snapshot(seen.key, seen.uid, flights)
    if plan is None or plan.drone is None:
        return inventory, None
    node = plan.drone.node
    if plan.drone.shared_with is None:
        claim = live.fleet.claims().get(node)
        lost = claim is not None and claim.uid != seen.uid
        return inventory, ("DroneBusy", f"another application has {node}") if lost else None
    if application is None:
        return inventory, None
    why = shared_flight_lost(application, plan, seen.host[1], flights.get(node), radius_m)
    return inventory, ("SharedFlightLost", why) if why is not None else None

"""`python -m fractus_operator.uninstall_check`: tells whether Fractus can be uninstalled without leaving a drone in the air."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Sequence

from fractus_core.api.nodes import DRONE_REPORT_S, GROUNDED_ANNOTATION, ON_MISSION, is_airborne

from fractus_operator.kinds import APPLICATION, DRONE, Body, Kind, key_of
from fractus_operator.labels import FINALIZER
from fractus_operator.store import KubeError, NotFound, Store, Unconfigured

NOT_REPORTED = "its last report"
_REPORTS_S = 3 * DRONE_REPORT_S
"""How long two reports may take; the chart's Job has 150 s in all."""
_PERIOD_S = 2.0


def objection(applications: Sequence[Body], drones: Sequence[Body]) -> str:
    """Return why Fractus is still needed and what to do, in a sentence; empty when it is not.

    Args:
        applications: All Application objects.
        drones: All Drone objects. One that never reported is taken to be on the ground.
    """
    kept = ["/".join(key_of(body)) for body in applications if FINALIZER in body["metadata"].get("finalizers", ())]
    if kept:
        return (
            f"Fractus still has to take down {_listed(kept)}: delete all Applications first "
            "(kubectl delete applications.fractus.dev --all -A), then uninstall"
        )
    watched = [body for body in drones if not _grounded_by_hand(body)]
    flying = [f"{body['metadata']['name']} ({body['status']['flightState']})" for body in watched if _flies(body)]
    if flying:
        return (
            f"Fractus still flies {_listed(flying)}: wait until kubectl get drones.fractus.dev says inactive or charging, "
            "then uninstall"
        )
    unsure = [body["metadata"]["name"] for body in watched if _may_take_off(body)]
    if unsure:
        return (
            f"{_listed(unsure)} may have taken off since {NOT_REPORTED}: wait for its next report, or, if you see it on the "
            "ground, annotate it fractus.dev/grounded (docs/upgrades.md), then uninstall"
        )
    return ""


def _flies(drone: Body) -> bool:
    status = drone.get("status") or {}
    return is_airborne(status.get("flightState"), status.get("lastFlightState"))


def _may_take_off(drone: Body) -> bool:
    conditions = (drone.get("status") or {}).get("conditions") or ()
    return any(c.get("type") == ON_MISSION and c.get("status") != "False" for c in conditions)


def _grounded_by_hand(drone: Body) -> bool:
    seen = (drone.get("status") or {}).get("lastSeen")
    return seen is not None and (drone["metadata"].get("annotations") or {}).get(GROUNDED_ANNOTATION) == seen


def _listed(names: Sequence[str], most: int = 5) -> str:
    named = ", ".join(sorted(names)[:most])
    return named if len(names) <= most else f"{named} and {len(names) - most} more"


async def check() -> str:
    """Return the objection that the cluster's present state gives rise to; drones that have landed get the time for two reports.

    Raises:
        Unconfigured: there are no credentials.
        KubeError: the API server refused, or could not be reached.
    """
    store = await Store.connect()
    found = "whether drones fly could not be found out: the API server did not answer in time"
    try:
        async with asyncio.timeout(_REPORTS_S) as waited:
            while True:
                found = objection(await _all(store, APPLICATION), await _all(store, DRONE))
                if NOT_REPORTED not in found:
                    return found
                await asyncio.sleep(_PERIOD_S)
    except TimeoutError:
        if not waited.expired():
            raise
        return found
    finally:
        await store.aclose()


async def _all(store: Store, kind: Kind) -> list[Body]:
    """All objects of a kind; none where the kind itself is gone, so that Fractus can be removed after it."""
    try:
        return await store.list(kind)
    except NotFound:
        return []


def main() -> int:
    """Run the check as a program; returns its exit code."""
    try:
        found = asyncio.run(check())
    except (Unconfigured, KubeError) as error:
        found = f"whether drones fly could not be found out: {error}"
    if found:
        print(found, file=sys.stderr)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())

"""`python -m fractus_operator.uninstall_check [--drone NAME]`: checks that no drone is in the air before an uninstall.

With --drone, only this drone is checked, for the chart that contains it. Without it, no Application may exist either.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
from collections.abc import Sequence

from fractus_core.api.nodes import DRONE_REPORT_S, GROUNDED_ANNOTATION, ON_MISSION, is_airborne

from fractus_operator.kinds import APPLICATION, DRONE, Body, Kind, key_of
from fractus_operator.labels import FINALIZER
from fractus_operator.store import KubeError, NotFound, Store, Unconfigured

NOT_REPORTED = "its last report"
_REPORTS_S = 3 * DRONE_REPORT_S
"""Maximum time for two reports to arrive, in seconds. The deadline of the chart's Job is 150 s."""
_PERIOD_S = 2.0


def objection(applications: Sequence[Body], drones: Sequence[Body]) -> str:
    """Return why Fractus must not be uninstalled yet and what to do, as a sentence, or an empty string.

    Args:
        applications: All Application objects.
        drones: All Drone objects. A drone that never reported counts as on the ground.
    """
    kept = ["/".join(key_of(body)) for body in applications if FINALIZER in body["metadata"].get("finalizers", ())]
    if kept:
        return (
            f"Fractus still runs {_listed(kept)}: delete all Applications first "
            "(kubectl delete applications.fractus.dev --all -A), then uninstall"
        )
    watched = [body for body in drones if not _grounded_by_hand(body)]
    flying = [f"{body['metadata']['name']} ({body['status']['flightState']})" for body in watched if _flies(body)]
    if flying:
        return (
            f"Fractus still flies {_listed(flying)}: wait until kubectl get drones.fractus.dev shows inactive or charging, "
            "then uninstall"
        )
    unsure = [body["metadata"]["name"] for body in watched if _may_take_off(body)]
    if unsure:
        return (
            f"{_listed(unsure)} may have taken off since {NOT_REPORTED}: delete its Application and wait for its next report, or, "
            "if you see it on the ground, set its annotation fractus.dev/grounded (docs/upgrades.md), then uninstall"
        )
    return ""


def _flies(drone: Body) -> bool:
    status = drone.get("status") or {}
    return is_airborne(status.get("flightState"), status.get("lastFlightState"))


def _may_take_off(drone: Body) -> bool:
    conditions = (drone.get("status") or {}).get("conditions") or ()
    return any(c.get("type") == ON_MISSION and c.get("status") != "False" for c in conditions)


def _grounded_by_hand(drone: Body) -> bool:
    seen = (drone.get("status") or {}).get("lastSeen", "never")
    return bool((drone["metadata"].get("annotations") or {}).get(GROUNDED_ANNOTATION) == seen)


def _listed(names: Sequence[str], most: int = 5) -> str:
    named = ", ".join(sorted(names)[:most])
    return named if len(names) <= most else f"{named} and {len(names) - most} more"


async def check(drone: str | None = None) -> str:
    """Return the objection for the current state of the cluster. Waits for up to two reports of drones that have landed.

    Args:
        drone: Name of the only drone to check. Default: all drones, and all Applications.

    Raises:
        Unconfigured: There are no credentials.
        KubeError: The API server refused a request, or could not be reached.
    """
    store = await Store.connect()
    problem = "cannot check for drones in flight: the API server did not respond in time"
    try:
        async with asyncio.timeout(_REPORTS_S) as waited:
            while True:
                applications = await _all(store, APPLICATION) if drone is None else []
                drones = await _all(store, DRONE)
                if drone is not None:
                    drones = [body for body in drones if body["metadata"]["name"] == drone]
                problem = objection(applications, drones)
                if NOT_REPORTED not in problem:
                    return problem
                await asyncio.sleep(_PERIOD_S)
    except TimeoutError:
        if not waited.expired():
            raise
        return problem
    finally:
        await store.aclose()


async def _all(store: Store, kind: Kind) -> list[Body]:
    """Return all objects of a kind. The result is empty if the kind was deleted, so that Fractus can be removed after its kinds."""
    try:
        return await store.list(kind)
    except NotFound:
        return []


def main() -> int:
    """Run the check as a program. Return its exit code."""
    parser = argparse.ArgumentParser(description="Check that no drone is in the air before an uninstall.")
    parser.add_argument("--drone", help="Name of the only drone to check. Default: all drones and Applications.")
    arguments = parser.parse_args()
    try:
        problem = asyncio.run(check(arguments.drone))
    except (Unconfigured, KubeError) as error:
        problem = f"cannot check for drones in flight: {error}"
    if problem:
        print(problem, file=sys.stderr)
    return 1 if problem else 0


if __name__ == "__main__":
    sys.exit(main())

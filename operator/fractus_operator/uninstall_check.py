"""`python -m fractus_operator.uninstall_check`: tells whether Fractus can be uninstalled without leaving a drone in the air."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Sequence

from fractus_core.api.nodes import is_airborne

from fractus_operator.cluster.kinds import APPLICATION, DRONE, Body, key_of
from fractus_operator.cluster.labels import FINALIZER
from fractus_operator.cluster.store import KubeError, Store, Unconfigured


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
    states = {body["metadata"]["name"]: body.get("status") or {} for body in drones}
    flying = [
        f"{name} ({status['flightState']})"
        for name, status in states.items()
        if is_airborne(status.get("flightState"), status.get("lastFlightState"))
    ]
    if flying:
        return (
            f"Fractus still flies {_listed(flying)}: wait until kubectl get drones.fractus.dev says inactive or charging, "
            "then uninstall"
        )
    return ""


def _listed(names: Sequence[str], most: int = 5) -> str:
    named = ", ".join(sorted(names)[:most])
    return named if len(names) <= most else f"{named} and {len(names) - most} more"


async def check() -> str:
    """Return the objection that the cluster's present state gives rise to.

    Raises:
        Unconfigured: there are no credentials.
        KubeError: the API server refused, or could not be reached.
    """
    store = await Store.connect()
    try:
        return objection(await store.list(APPLICATION), await store.list(DRONE))
    finally:
        await store.aclose()


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

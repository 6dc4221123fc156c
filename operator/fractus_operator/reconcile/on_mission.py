"""Says of each drone whether it may take off unseen: what admission judges by where its last report is old."""

from __future__ import annotations

import logging
from collections.abc import Callable
from datetime import datetime

from fractus_core.api import Drone
from fractus_core.api.nodes import ON_MISSION

from fractus_operator.cluster.kinds import DRONE, GRANT, Key
from fractus_operator.cluster.store import Store
from fractus_operator.inventory.live import LiveInventory
from fractus_operator.reconcile.conditions import ConditionUpdate
from fractus_operator.reconcile.node_reports import NodeReports
from fractus_operator.reconcile.reporting import record_events

logger = logging.getLogger(__name__)

_REPORTS = 2
"""How many reports, after its Grants went, show what the drone does."""


class OnMission:
    """Writes the condition OnMission of Drones.

    True while there is a Grant for the drone; then Unknown until it has reported twice, for it may have taken off out of
    reach: the first report that is heard may have been written before the Grant went. Reports are told apart by their time,
    which is the drone's own and compared with no other clock.

    And records where someone overrides the protection of a drone by the annotation fractus.dev/grounded.
    """

    def __init__(self, store: Store, live: LiveInventory, reports: NodeReports, clock: Callable[[], datetime]) -> None:
        self._store = store
        self._live = live
        self._reports = reports
        self._clock = clock
        self._nodes: dict[Key, str] = {}
        self._holders: dict[str, dict[Key, str]] = {}
        self._reports_of: dict[str, set[datetime | None]] = {}
        """Of drones whose grants are gone: the times of their reports, from the one that was known by then."""
        self._recorded: dict[str, datetime | None] = {}

    def grant_changed(self, key: Key) -> Key | None:
        """Follow a Grant that appeared, changed or went; returns the drone to reconcile, if it is known."""
        body = self._live.children[GRANT].get(key)
        node = self._nodes.pop(key, None)
        if node is not None:
            self._holders[node].pop(key)
        if body is not None:
            spec = body["spec"]
            node = self._nodes[key] = str(spec["node"])
            owner = spec["application"]
            self._holders.setdefault(node, {})[key] = f"{owner['namespace']}/{owner['name']}"
        return ("", node) if node is not None else None

    def holders(self, drone: str) -> list[str]:
        """The Applications that may fly a drone, as NAMESPACE/NAME."""
        return sorted(set(self._holders.get(drone, {}).values()))

    async def reconcile(self, key: Key) -> None:
        """Say it of one drone.

        Raises:
            KubeError: the API server refused it, or cannot be reached.
        """
        drone = self._live.drone(key[1])
        if drone is None:
            return
        update = self._observed(drone)
        if update is not None:
            await self._reports.say(drone.name, update)
        await self._record_override(drone)

    def _observed(self, drone: Drone) -> ConditionUpdate | None:
        holders = self.holders(drone.name)
        if holders:
            self._reports_of.pop(drone.name, None)
            return ConditionUpdate(ON_MISSION, "True", "Granted", f"{', '.join(holders)} may fly it")
        known = self._reports.condition(drone.name, ON_MISSION)
        if known is None or known.status == "False":
            self._reports_of.pop(drone.name, None)
            return None
        seen = drone.status.last_seen if drone.status is not None else None
        heard = self._reports_of.setdefault(drone.name, {seen})
        if drone.status is not None and drone.status.flight_state != "unknown":
            heard.add(seen)
        if len(heard) > _REPORTS:
            return ConditionUpdate(ON_MISSION, "False", "NoGrant", "no application may fly it", progress=True)
        why = "no application may fly it any more, but it has not reported twice since"
        return ConditionUpdate(ON_MISSION, "Unknown", "NotHeardOf", why, progress=True)

    async def _record_override(self, drone: Drone) -> None:
        seen = drone.status.last_seen if drone.status is not None else None
        if not drone.grounded_by_hand or self._recorded.get(drone.name) == seen:
            return
        logger.warning("on mission: declared to be on the ground by hand (drone=%s)", drone.name)
        said = (
            f"someone declared {drone.name} to be on the ground (annotation fractus.dev/grounded): until it reports again,"
            " neither admission nor the operator protects its services"
        )
        regarding = DRONE.header(drone.name, uid=drone.metadata.uid)
        update = ConditionUpdate("Grounded", "False", "GroundedByHand", said)
        await record_events(self._store, regarding, [update], self._clock())
        self._recorded[drone.name] = seen

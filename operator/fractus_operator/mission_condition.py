"""Controller of the condition OnMission of Drones, which is True while an Application may fly the drone.

While the last report of a drone is old, admission policies use the condition to decide if the drone may be in the air.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from datetime import datetime

from fractus_core.api import Drone
from fractus_core.api.conditions import ConditionUpdate
from fractus_core.api.nodes import ON_MISSION

from fractus_operator.cache import ClusterCache
from fractus_operator.kinds import DRONE, GRANT, Key
from fractus_operator.node_conditions import NodeConditionWriter
from fractus_operator.status_reporter import create_events
from fractus_operator.store import Store

log = logging.getLogger(__name__)

_REPORTS = 2
"""Number of reports that must arrive after the deletion of the last Grant before the drone's state counts as known."""


class MissionConditionController:
    """Writes the condition OnMission of Drones.

    The condition is True while there is a Grant for the drone. After the deletion of the Grant it is Unknown until the drone
    has reported twice. The drone may have taken off while it was out of reach, and the first report that arrives may be older
    than the deletion. Reports are distinguished by their times. These times are not compared with another clock.

    The controller also records when a user overrides the protection of a drone with the annotation fractus.dev/grounded.
    """

    def __init__(
        self, store: Store, cache: ClusterCache, conditions: NodeConditionWriter, clock: Callable[[], datetime]
    ) -> None:
        self._store = store
        self._cache = cache
        self._conditions = conditions
        self._clock = clock
        self._nodes: dict[Key, str] = {}
        self._owners: dict[str, dict[Key, str]] = {}
        self._report_times: dict[str, set[datetime | None]] = {}
        """Times of the reports of drones without Grants, beginning with the last one before the deletion."""
        self._recorded: dict[str, datetime | None] = {}

    def grant_changed(self, key: Key) -> Key | None:
        """Handle a change of a Grant. Return the drone to reconcile, if it is known."""
        body = self._cache.children[GRANT].get(key)
        node = self._nodes.pop(key, None)
        if node is not None:
            self._owners[node].pop(key)
        if body is not None:
            spec = body["spec"]
            owner = spec["application"]
            node = str(spec["node"])
            self._nodes[key] = node
            self._owners.setdefault(node, {})[key] = f"{owner['namespace']}/{owner['name']}"
        return ("", node) if node is not None else None

    def granted_applications(self, drone: str) -> list[str]:
        """Return the Applications with a Grant for a drone, as NAMESPACE/NAME."""
        return sorted(set(self._owners.get(drone, {}).values()))

    async def reconcile(self, key: Key) -> None:
        """Write the condition of one drone.

        Raises:
            KubeError: The API server refused the write, or could not be reached.
        """
        drone = self._cache.drone(key[1])
        if drone is None:
            return
        update = self._observed(drone)
        if update is not None:
            await self._conditions.write(drone.name, update)
        await self._record_override(drone)

    def _observed(self, drone: Drone) -> ConditionUpdate | None:
        applications = self.granted_applications(drone.name)
        if applications:
            self._report_times.pop(drone.name, None)
            return ConditionUpdate(ON_MISSION, "True", "Granted", f"{', '.join(applications)} may fly the drone")
        known = self._conditions.condition(drone.name, ON_MISSION)
        if known is None or known.status == "False":
            self._report_times.pop(drone.name, None)
            return None
        last_seen = drone.status.last_seen if drone.status is not None else None
        times = self._report_times.setdefault(drone.name, {last_seen})
        if drone.status is not None and drone.status.flight_state != "unknown":
            times.add(last_seen)
        if len(times) > _REPORTS:
            return ConditionUpdate(ON_MISSION, "False", "NoGrant", "no Application may fly the drone", progress=True)
        message = "no Application may fly the drone, but it has not reported twice since its last Grant was deleted"
        return ConditionUpdate(ON_MISSION, "Unknown", "AwaitingReports", message, progress=True)

    async def _record_override(self, drone: Drone) -> None:
        last_seen = drone.status.last_seen if drone.status is not None else None
        if not drone.grounded_by_hand or self._recorded.get(drone.name) == last_seen:
            return
        log.warning("mission condition: user declared a drone to be on the ground (drone=%s)", drone.name)
        message = (
            f"a user declared {drone.name} to be on the ground (annotation fractus.dev/grounded): until its next report,"
            " neither admission nor the operator protects its services"
        )
        regarding = DRONE.header(drone.name, uid=drone.metadata.uid)
        update = ConditionUpdate("Grounded", "False", "GroundedByHand", message)
        await create_events(self._store, regarding, [update], self._clock())
        self._recorded[drone.name] = last_seen

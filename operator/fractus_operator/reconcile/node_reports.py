"""What the operator writes into the status of drones and edge nodes, beside what their agents report."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime

from fractus_core.api import Condition, Drone, EdgeNode

from fractus_operator.cluster.kinds import DRONE, EDGE_NODE, Body, Kind
from fractus_operator.cluster.store import Conflict, NotFound, Store
from fractus_operator.inventory.live import LiveInventory
from fractus_operator.reconcile.conditions import ConditionUpdate, merge
from fractus_operator.reconcile.reporting import record_events


class NodeReports:
    """Conditions of drones and edge nodes."""

    def __init__(self, store: Store, live: LiveInventory, clock: Callable[[], datetime]) -> None:
        self._store = store
        self._live = live
        self._clock = clock

    def condition(self, name: str, type_: str) -> Condition | None:
        """A condition of a drone or edge node; None where it has none, or does not exist."""
        _, node = self._node(name)
        conditions = node.status.conditions if node is not None and node.status is not None else ()
        return next((c for c in conditions if c.type == type_), None)

    async def say(self, name: str, update: ConditionUpdate, change: Callable[[Body], bool] = lambda _: True) -> None:
        """Write a condition where it is not so already; a warning gets an Event.

        Args:
            name: Of the drone or edge node.
            update: The condition.
            change: Changes more of the status as it is now; whether the condition is true of that.

        Raises:
            KubeError: the API server refused it, or cannot be reached.
        """
        kind, node = self._node(name)
        known = self.condition(name, update.type)
        if node is None or _says(known, update):
            return
        now = self._clock()
        try:
            body = await self._store.get(kind, name)
            status = body.setdefault("status", {})
            if not change(status):
                return
            before = [Condition.model_validate(c) for c in status.get("conditions") or () if c["type"] == update.type]
            others = [c for c in status.get("conditions") or () if c["type"] != update.type]
            conditions, transitions = merge(before, [update], body["metadata"].get("generation"), now)
            status["conditions"] = [*others, *(c.to_dict() for c in conditions)]
            await self._store.replace(kind, body, subresource="status")
        except (Conflict, NotFound):
            # Its agent was quicker: what is to be said then, the next step tells.
            return
        regarding = kind.header(name, uid=node.metadata.uid)
        await record_events(self._store, regarding, (update for update in transitions if update.warning), now)

    def _node(self, name: str) -> tuple[Kind, Drone | EdgeNode | None]:
        drone = self._live.drone(name)
        return (DRONE, drone) if drone is not None else (EDGE_NODE, self._live.edge_nodes.get(("", name)))


def _says(known: Condition | None, update: ConditionUpdate) -> bool:
    return known is not None and (known.status, known.reason, known.message) == (
        update.status,
        update.reason,
        update.message,
    )

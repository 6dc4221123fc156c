"""What the operator writes into the status of drones and edge nodes, beside what their agents report."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from datetime import datetime
from http import HTTPStatus
from typing import Any

from fractus_core.api import Condition, Drone, EdgeNode

from fractus_operator.cluster.kinds import DRONE, EDGE_NODE, Body, Kind, key_of
from fractus_operator.cluster.store import Conflict, KubeError, NotFound, Reflector, Store
from fractus_operator.inventory.live import LiveInventory
from fractus_operator.reconcile.conditions import ConditionUpdate, merge
from fractus_operator.reconcile.reporting import record_events

logger = logging.getLogger(__name__)


class NodeReports:
    """Conditions of drones and edge nodes."""

    def __init__(self, store: Store, live: LiveInventory, clock: Callable[[], datetime]) -> None:
        self._store = store
        self._live = live
        self._clock = clock
        self._warned = False

    def condition(self, name: str, type_: str) -> Condition | None:
        """A condition of a drone or edge node; None where it has none, or does not exist."""
        _, node = self._node(name)
        conditions = node.status.conditions if node is not None and node.status is not None else ()
        return next((c for c in conditions if c.type == type_), None)

    async def say(self, name: str, update: ConditionUpdate, change: Callable[[Body], bool] | None = None) -> None:
        """Write a condition where it is not so already; a warning gets an Event.

        Args:
            name: Of the drone or edge node.
            update: The condition.
            change: Changes more of the status as it is now; whether the condition is true of that. None: the condition
                does not depend on the rest, and is written alone, which takes one request.

        Raises:
            KubeError: the API server refused it, or cannot be reached.
        """
        kind, node = self._node(name)
        known = self.condition(name, update.type)
        if node is None or _says(known, update):
            return
        now = self._clock()
        try:
            if change is None:
                transitions = await self._say_alone(kind, node, known, update, now)
            else:
                transitions = await self._say_with(kind, name, update, change, now)
        except (Conflict, NotFound):
            # Its agent was quicker, or it is gone: what is to be said then, the next step tells.
            return
        regarding = kind.header(name, uid=node.metadata.uid)
        await record_events(self._store, regarding, (update for update in transitions if update.warning), now)

    async def _say_alone(
        self, kind: Kind, node: Drone | EdgeNode, known: Condition | None, update: ConditionUpdate, now: datetime
    ) -> Sequence[ConditionUpdate]:
        """Write a condition that only the operator writes; returns the transitions."""
        before = [known] if known is not None else []
        conditions, transitions = merge(before, [update], node.metadata.generation, now)
        # With the uid: nothing is written to a later one of its name. A manager for each type: an apply that does not
        # mention a condition of its manager removes it.
        body = kind.header(node.name, uid=node.metadata.uid)
        body["status"] = {"conditions": [condition.to_dict() for condition in conditions]}
        manager = f"{self._store.field_manager}-{update.type.lower()}"
        try:
            self._note(kind, await self._store.apply(kind, body, subresource="status", field_manager=manager))
        except KubeError as error:
            # The ClusterRole of a release that was rolled back to allows updates only.
            if error.status != HTTPStatus.FORBIDDEN:
                raise
            if not self._warned:
                remedy = "its ClusterRole is of another release, upgrade the chart fractus"
                logger.warning("node reports: status is updated, as it may not be patched; %s: %s", remedy, error)
            self._warned = True
            return await self._say_with(kind, node.name, update, lambda _: True, now)
        return transitions

    async def _say_with(
        self, kind: Kind, name: str, update: ConditionUpdate, change: Callable[[Body], bool], now: datetime
    ) -> Sequence[ConditionUpdate]:
        """Write a condition with what else it is true of; returns the transitions."""
        body = await self._store.get(kind, name)
        status = body.setdefault("status", {})
        if not change(status):
            return ()
        before = [Condition.model_validate(c) for c in status.get("conditions") or () if c["type"] == update.type]
        others = [c for c in status.get("conditions") or () if c["type"] != update.type]
        conditions, transitions = merge(before, [update], body["metadata"].get("generation"), now)
        status["conditions"] = [*others, *(c.to_dict() for c in conditions)]
        self._note(kind, await self._store.replace(kind, body, subresource="status"))
        return transitions

    def _note(self, kind: Kind, written: Body) -> None:
        """Take what a write returned, ahead of the watch, so that what comes meanwhile does not have it written again."""
        copies: Reflector[Any] = self._live.drones if kind is DRONE else self._live.edge_nodes
        copies.note(key_of(written), written)

    def _node(self, name: str) -> tuple[Kind, Drone | EdgeNode | None]:
        drone = self._live.drone(name)
        return (DRONE, drone) if drone is not None else (EDGE_NODE, self._live.edge_nodes.get(("", name)))


def _says(known: Condition | None, update: ConditionUpdate) -> bool:
    return known is not None and (known.status, known.reason, known.message) == (
        update.status,
        update.reason,
        update.message,
    )

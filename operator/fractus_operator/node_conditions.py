"""Writes conditions into the status of drones and edge nodes, in addition to the reports of their agents."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from datetime import datetime
from http import HTTPStatus
from typing import Any

from fractus_core.api import Condition, Drone, EdgeNode
from fractus_core.api.conditions import ConditionUpdate, merge_conditions

from fractus_operator.cache import ClusterCache
from fractus_operator.kinds import DRONE, EDGE_NODE, Body, Kind, key_of
from fractus_operator.status_reporter import create_events
from fractus_operator.store import Conflict, Informer, KubeError, NotFound, Store

log = logging.getLogger(__name__)


class NodeConditionWriter:
    """Writes conditions of drones and edge nodes."""

    def __init__(self, store: Store, cache: ClusterCache, clock: Callable[[], datetime]) -> None:
        self._store = store
        self._cache = cache
        self._clock = clock
        self._warned = False

    def condition(self, name: str, type_: str) -> Condition | None:
        """Return a condition of a drone or edge node, or None if the condition or the node does not exist."""
        _, node = self._node(name)
        conditions = node.status.conditions if node is not None and node.status is not None else ()
        return next((c for c in conditions if c.type == type_), None)

    async def write(self, name: str, update: ConditionUpdate, change: Callable[[Body], bool] | None = None) -> None:
        """Write a condition if it changed. A warning also gets an Event.

        Args:
            name: Name of the drone or edge node.
            update: The condition.
            change: Changes other fields of the current status. Returns False if the condition no longer applies to that
                status. Without `change`, the condition does not depend on other fields and is written alone.

        Raises:
            KubeError: The API server refused the write, or could not be reached.
        """
        kind, node = self._node(name)
        known = self.condition(name, update.type)
        if node is None or _is_unchanged(known, update):
            return
        now = self._clock()
        try:
            if change is None:
                transitions = await self._write_condition(kind, node, known, update, now)
            else:
                transitions = await self._write_status(kind, name, update, change, now)
        except (Conflict, NotFound):
            # The agent of the node wrote first, or the node was deleted. The next step uses the new state.
            return
        regarding = kind.header(name, uid=node.metadata.uid)
        await create_events(self._store, regarding, (update for update in transitions if update.warning), now)

    async def _write_condition(
        self, kind: Kind, node: Drone | EdgeNode, known: Condition | None, update: ConditionUpdate, now: datetime
    ) -> Sequence[ConditionUpdate]:
        """Write a condition that only the operator writes. Return the transitions."""
        before = [known] if known is not None else []
        conditions, transitions = merge_conditions(before, [update], node.metadata.generation, now)
        # The uid prevents a write to a later object of this name. Each type has its own field manager, because an apply removes
        # the conditions of its manager that it does not contain.
        body = kind.header(node.name, uid=node.metadata.uid)
        body["status"] = {"conditions": [condition.to_dict() for condition in conditions]}
        manager = f"{self._store.field_manager}-{update.type.lower()}"
        try:
            self._record(kind, await self._store.apply(kind, body, subresource="status", field_manager=manager))
        except KubeError as error:
            # The ClusterRole of an earlier release, to which the chart was rolled back, allows only updates.
            if error.status != HTTPStatus.FORBIDDEN:
                raise
            if not self._warned:
                log.warning(
                    "node conditions: may not patch the status, using update; upgrade the chart fractus, because its"
                    " ClusterRole belongs to another release (error=%s)",
                    error,
                )
            self._warned = True
            return await self._write_status(kind, node.name, update, lambda _: True, now)
        return transitions

    async def _write_status(
        self, kind: Kind, name: str, update: ConditionUpdate, change: Callable[[Body], bool], now: datetime
    ) -> Sequence[ConditionUpdate]:
        """Write a condition together with the changed status. Return the transitions."""
        body = await self._store.get(kind, name)
        status = body.setdefault("status", {})
        if not change(status):
            return ()
        before = [Condition.model_validate(c) for c in status.get("conditions") or () if c["type"] == update.type]
        others = [c for c in status.get("conditions") or () if c["type"] != update.type]
        conditions, transitions = merge_conditions(before, [update], body["metadata"].get("generation"), now)
        status["conditions"] = [*others, *(c.to_dict() for c in conditions)]
        self._record(kind, await self._store.replace(kind, body, subresource="status"))
        return transitions

    def _record(self, kind: Kind, written: Body) -> None:
        """Add the result of a write to the cache before the watch reports it, so that it is not written again."""
        informer: Informer[Any] = self._cache.drones if kind is DRONE else self._cache.edge_nodes
        informer.record_write(key_of(written), written)

    def _node(self, name: str) -> tuple[Kind, Drone | EdgeNode | None]:
        drone = self._cache.drone(name)
        return (DRONE, drone) if drone is not None else (EDGE_NODE, self._cache.edge_nodes.get(("", name)))


def _is_unchanged(known: Condition | None, update: ConditionUpdate) -> bool:
    return known is not None and (known.status, known.reason, known.message) == (
        update.status,
        update.reason,
        update.message,
    )

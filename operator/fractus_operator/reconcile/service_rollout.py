"""Replaces the services of nodes where a newer release asks for others: node by node, and of a drone only on the ground."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from http import HTTPStatus

from fractus_operator.cluster import kinds
from fractus_operator.cluster.pods import PodView
from fractus_operator.cluster.store import KubeError, Store
from fractus_operator.inventory.live import LiveInventory
from fractus_operator.reconcile.conditions import ConditionUpdate
from fractus_operator.reconcile.node_reports import NodeReports
from fractus_operator.reconcile.worklist import one_of_many

logger = logging.getLogger(__name__)

CURRENT = "ServicesCurrent"
PERIOD_S = 2.0
_SHARE = 20
"""One node of this many is replaced at a time: a release that does not start stops at the first."""


@dataclass(frozen=True, slots=True)
class ServicesOfNode:
    """What runs on a node.

    Attributes:
        outdated: pods that run another release than asked for.
        starting: names of the others that are not ready yet, and DaemonSets that owe a pod.
        obstacle: why nothing may be replaced now: a reason and a sentence.
    """

    node: str
    outdated: Sequence[PodView]
    starting: Sequence[str]
    obstacle: tuple[str, str] | None


def next_step(nodes: Iterable[ServicesOfNode]) -> tuple[list[ServicesOfNode], dict[str, ConditionUpdate]]:
    """The nodes whose services are replaced now, and what is to be said of each node."""
    nodes = tuple(nodes)
    # A node out of reach tells nothing about the release.
    busy = [node.node for node in nodes if node.starting and (node.obstacle or ("",))[0] != "NodeUnreachable"]
    free = max(1, len(nodes) // _SHARE) - len(busy)
    chosen: list[ServicesOfNode] = []
    said: dict[str, ConditionUpdate] = {}
    for node in nodes:
        names = ", ".join(sorted(pod.name for pod in node.outdated))
        if not node.outdated:
            waits = f"waiting for {', '.join(sorted(node.starting))}" if node.starting else ""
            said[node.node] = ConditionUpdate(
                CURRENT, "False" if waits else "True", "Starting" if waits else "Current", waits, progress=True
            )
        elif node.obstacle is not None:
            reason, why = node.obstacle
            said[node.node] = ConditionUpdate(CURRENT, "False", reason, f"{names}: {why}", progress=True)
        elif len(chosen) < free:
            chosen.append(node)
            said[node.node] = ConditionUpdate(CURRENT, "False", "Replacing", f"{names}: being replaced", progress=True)
        else:
            before = (busy or [chosen[0].node])[0]
            why = f"replaced once the services of {before} are ready"
            said[node.node] = ConditionUpdate(CURRENT, "False", "Queued", f"{names}: {why}", progress=True)
    return chosen, said


class ServiceRollout:
    """Carries the steps out, and reports them in the condition ServicesCurrent of drones and edge nodes."""

    def __init__(self, store: Store, live: LiveInventory, reports: NodeReports) -> None:
        self._store = store
        self._live = live
        self._reports = reports
        self._owed: dict[str, set[str]] = {}
        """By node, the DaemonSets whose pods were deleted and have no ready successor yet, if they ever get one."""

    async def step(self) -> None:
        """Replace what may be replaced now.

        Raises:
            KubeError: the API server cannot be reached.
        """
        await self._live.synced()
        chosen, said = next_step(self._observe())
        for node in chosen:
            try:
                await self._replace(node)
            except KubeError as error:
                if not error.status:
                    raise
                logger.warning("services: not replaced (node=%s): %s", node.node, error)
                # What is forbidden has taken off since.
                reason = "InTheAir" if error.status == HTTPStatus.FORBIDDEN else "Refused"
                said[node.node] = ConditionUpdate(CURRENT, "False", reason, str(error), progress=True)
        await self._report(said)

    def _observe(self) -> Iterable[ServicesOfNode]:
        held, services = self._live.claims(), self._live.services
        found = dict(services.nodes())
        for node in sorted({*found, *self._owed}):
            pods = found.get(node, ())
            outdated = tuple(p for p in pods if not p.terminating and not services.is_current(p))
            present = [p for p in pods if not p.terminating and p not in outdated]
            self._settle(node, {p.daemon_set for p in present if p.ready})
            if not pods and node not in self._owed:
                continue
            shown = {p.daemon_set for p in (*present, *outdated)}
            starting = tuple(p.name for p in pods if p.terminating or (p not in outdated and not p.ready))
            starting += tuple(sorted(self._owed.get(node, set()) - shown))
            holder = held.get(node)
            yield ServicesOfNode(node, outdated, starting, self._obstacle(node, holder.key if holder else None))

    def _settle(self, node: str, ready: set[str | None]) -> None:
        """Forget the pods that a node is not owed any more: they are there, or their DaemonSet or the node is gone."""
        owed = {d for d in self._owed.pop(node, ()) if d not in ready and self._live.services.is_asked_for(d)}
        if owed and self._live.hosts.get(("", node)) is not None:
            self._owed[node] = owed

    def _obstacle(self, node: str, holder: kinds.Key | None) -> tuple[str, str] | None:
        host = self._live.hosts.get(("", node))
        if host is None or not host.ready:
            # It would carry out what it missed as soon as it is back, whatever it does by then.
            return "NodeUnreachable", f"{node} is out of reach"
        if self._live.fleet.is_in_flight(node):
            return "InTheAir", f"{node} is in the air"
        if holder is not None and self._live.drone(node) is not None:
            return "OnMission", f"{'/'.join(holder)} has {node} and may take off"
        return None

    async def _replace(self, node: ServicesOfNode) -> None:
        for pod in node.outdated:
            logger.info("services: replacing (node=%s pod=%s)", node.node, pod.name)
            # Before it is deleted: a request without an answer may have been carried out.
            self._owed.setdefault(node.node, set()).add(str(pod.daemon_set))
            await self._store.delete(kinds.POD, (pod.namespace, pod.name))

    async def _report(self, said: Mapping[str, ConditionUpdate]) -> None:
        for name, update in said.items():
            # Where nothing was ever outdated there is nothing to say.
            if update.reason not in {"Current", "Starting"} or self._reports.condition(name, CURRENT) is not None:
                with one_of_many("services", name):
                    await self._reports.say(name, update)

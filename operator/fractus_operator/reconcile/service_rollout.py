"""Replaces the services of nodes where a newer release asks for others: node by node, and of a drone only on the ground."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
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
"""One node of this many is replaced at a time."""
STUCK_S = 600.0
"""How long services may take to be ready, images pulled over slow links included, before others go on without their node."""


@dataclass(frozen=True, slots=True)
class ServicesOfNode:
    """What runs on a node.

    Attributes:
        outdated: pods that run another release than asked for.
        starting: what is not ready of the release that is asked for: by DaemonSet, the pod's name, or its own where it owes one.
        obstacle: why nothing may be replaced now: a reason and a sentence.
        starting_s: for how long that has been so, in seconds.
    """

    node: str
    outdated: Sequence[PodView]
    starting: Mapping[str, str]
    obstacle: tuple[str, str] | None
    starting_s: float = 0.0


def next_step(
    nodes: Collection[ServicesOfNode], fleet: int, ready: Callable[[str], int]
) -> tuple[list[ServicesOfNode], dict[str, ConditionUpdate]]:
    """The nodes whose services are replaced now, and what is to be said of each node.

    A release that does not start stops at the second node at the latest. A node that does not start it is left behind where
    others run it.

    Args:
        nodes: All that are not as they should be; others may be among them.
        fleet: How many nodes have services.
        ready: How many nodes run what a DaemonSet asks for by now, and are ready.
    """
    # A node out of reach tells nothing about the release.
    starting = [node for node in nodes if node.starting and (node.obstacle or ("",))[0] != "NodeUnreachable"]
    stuck = [node for node in starting if node.starting_s > STUCK_S]
    failed = Counter(daemon_set for node in stuck for daemon_set in node.starting)
    skipped = {n.node for n in stuck if all(failed[d] <= max(1, ready(d)) for d in n.starting)}
    busy = [node.node for node in starting if node.node not in skipped]
    # What does not run well on a node already would say less of the release.
    due = [node for node in nodes if node.outdated and node.obstacle is None]
    due.sort(key=lambda node: not all(pod.ready for pod in node.outdated))
    chosen = due[: max(0, max(1, fleet // _SHARE) - len(busy))]
    replaced = {node.node for node in chosen}
    said: dict[str, ConditionUpdate] = {}
    for node in nodes:
        names = ", ".join(sorted(pod.name for pod in node.outdated))
        if not node.outdated:
            said[node.node] = _not_outdated(node, node.node in skipped)
        elif node.obstacle is not None:
            reason, why = node.obstacle
            said[node.node] = ConditionUpdate(CURRENT, "False", reason, f"{names}: {why}", progress=True)
        elif node.node in replaced:
            said[node.node] = ConditionUpdate(CURRENT, "False", "Replacing", f"{names}: being replaced", progress=True)
        else:
            before = (busy or [chosen[0].node])[0]
            why = f"replaced once the services of {before} are ready"
            said[node.node] = ConditionUpdate(CURRENT, "False", "Queued", f"{names}: {why}", progress=True)
    return chosen, said


def _not_outdated(node: ServicesOfNode, skipped: bool) -> ConditionUpdate:
    if not node.starting:
        return ConditionUpdate(CURRENT, "True", "Current")
    names = ", ".join(sorted(node.starting.values()))
    if node.starting_s <= STUCK_S:
        return ConditionUpdate(CURRENT, "False", "Starting", f"waiting for {names}", progress=True)
    others = "other nodes go on without it" if skipped else "other nodes wait, as too few run this release"
    why = f"{names}: not ready for {STUCK_S / 60:.0f} minutes; {others}: see kubectl -n fractus-system describe pods"
    return ConditionUpdate(CURRENT, "False", "NotReady", why)


class ServiceRollout:
    """Carries the steps out, and reports them in the condition ServicesCurrent of drones and edge nodes."""

    def __init__(self, store: Store, live: LiveInventory, reports: NodeReports, monotonic: Callable[[], float]) -> None:
        self._store = store
        self._live = live
        self._reports = reports
        self._monotonic = monotonic
        self._unsettled: set[str] = set()
        """Nodes to look at; of the others everything is as it should be, and said."""
        self._owed: dict[str, set[str]] = {}
        """By node, the DaemonSets whose pods were deleted and have no ready successor yet, if they ever get one."""
        self._starting: dict[str, tuple[Mapping[str, str], float]] = {}
        """By node, what is starting, and since when."""

    async def step(self) -> None:
        """Replace what may be replaced now.

        Raises:
            KubeError: the API server cannot be reached.
        """
        await self._live.synced()
        services = self._live.services
        self._unsettled |= services.take_changed()
        if not self._unsettled:
            return
        chosen, said = next_step(list(self._observe()), len(services), services.ready)
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
        held, services = self._live.fleet.claims(), self._live.services
        for node in sorted(self._unsettled):
            pods = services.on(node)
            outdated = tuple(p for p in pods if not p.terminating and not services.is_current(p))
            present = [p for p in pods if not p.terminating and p not in outdated]
            self._settle(node, {p.daemon_set for p in present if p.ready})
            if not pods and node not in self._owed:
                self._unsettled.discard(node)
                continue
            shown = {p.daemon_set for p in (*present, *outdated)}
            starting = {name: name for name in self._owed.get(node, set()) - shown}
            starting |= {
                str(p.daemon_set): p.name for p in pods if p.terminating or (p not in outdated and not p.ready)
            }
            holder = held.get(node)
            obstacle = self._obstacle(node, holder.key if holder else None)
            yield ServicesOfNode(node, outdated, starting, obstacle, self._starting_s(node, starting))

    def _starting_s(self, node: str, starting: Mapping[str, str]) -> float:
        """For how long these have been starting."""
        now_s = self._monotonic()
        known, since_s = self._starting.pop(node, (starting, now_s))
        if starting:
            self._starting[node] = (starting, since_s if known == starting else now_s)
        return now_s - since_s if known == starting else 0.0

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
        drone = self._live.drone(node)
        if drone is not None and holder is not None and not drone.grounded_by_hand:
            return "OnMission", f"{'/'.join(holder)} has {node} and may take off"
        if drone is not None and drone.may_take_off:
            return "OnMission", f"{node} may have taken off since its last report"
        return None

    async def _replace(self, node: ServicesOfNode) -> None:
        for pod in node.outdated:
            logger.info("services: replacing (node=%s pod=%s)", node.node, pod.name)
            # Before it is deleted: a request without an answer may have been carried out.
            self._owed.setdefault(node.node, set()).add(str(pod.daemon_set))
            await self._store.delete(kinds.POD, (pod.namespace, pod.name))

    async def _report(self, said: Mapping[str, ConditionUpdate]) -> None:
        for name, update in said.items():
            known = self._reports.condition(name, CURRENT)
            # Where nothing was ever outdated there is nothing to say.
            if update.reason not in {"Current", "Starting"} or known is not None:
                with one_of_many("services", name):
                    await self._reports.say(name, update)
            if update.status == "True" and (known is None or known.status == "True"):
                self._unsettled.discard(name)

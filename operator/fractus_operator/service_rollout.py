"""Rollout of a new release of the node services: node by node, and for a drone only while it is on the ground."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from http import HTTPStatus

from fractus_core.api.conditions import ConditionUpdate

from fractus_operator import kinds
from fractus_operator.cache import ClusterCache
from fractus_operator.node_conditions import NodeConditionWriter
from fractus_operator.pods import PodView
from fractus_operator.store import KubeError, Store
from fractus_operator.work_queue import skip_failed_node

log = logging.getLogger(__name__)

SERVICES_CURRENT = "ServicesCurrent"
ROLLOUT_PERIOD_S = 2.0
_SHARE = 20
"""Services are replaced on at most 1/`_SHARE` of all nodes at the same time, or on one node if the fleet is small."""
STUCK_S = 600.0
"""Maximum time until services are ready, in seconds, including image pulls over slow links.

After this time, the rollout may continue without the node.
"""


@dataclass(frozen=True, slots=True)
class ServicesOfNode:
    """The service pods of a node.

    Attributes:
        outdated: Pods of another revision than their DaemonSet requires.
        starting: Pods of the required revision that are not ready. Keys: DaemonSets. Values: names of their pods, or of the
            DaemonSet while it has not created the pod.
        obstacle: Reason and message why nothing may be replaced at present, if so.
        starting_s: Seconds for which `starting` has been unchanged.
    """

    node: str
    outdated: Sequence[PodView]
    starting: Mapping[str, str]
    obstacle: tuple[str, str] | None
    starting_s: float = 0.0


def next_step(
    nodes: Collection[ServicesOfNode], fleet: int, ready: Callable[[str], int]
) -> tuple[list[ServicesOfNode], dict[str, ConditionUpdate]]:
    """Return the nodes whose services are replaced now, and the condition of each node.

    If a release does not start, its rollout stops at the second node at the latest. If other nodes run the release, a
    node on which it does not start is skipped.

    Args:
        nodes: All nodes that are not in the desired state. May include others.
        fleet: Number of nodes that have services.
        ready: Returns the number of nodes with a ready pod of the required revision of a DaemonSet.
    """
    # If services do not start on an unreachable node, this does not show that the release is faulty.
    starting = [node for node in nodes if node.starting and (node.obstacle or ("",))[0] != "NodeUnreachable"]
    stuck = [node for node in starting if node.starting_s > STUCK_S]
    failed = Counter(daemon_set for node in stuck for daemon_set in node.starting)
    skipped = {n.node for n in stuck if all(failed[d] <= max(1, ready(d)) for d in n.starting)}
    busy = [node.node for node in starting if node.node not in skipped]
    # Nodes whose services are ready come first. If the services fail there, the release is the cause.
    due = [node for node in nodes if node.outdated and node.obstacle is None]
    due.sort(key=lambda node: not all(pod.ready for pod in node.outdated))
    chosen = due[: max(0, max(1, fleet // _SHARE) - len(busy))]
    replaced = {node.node for node in chosen}
    updates: dict[str, ConditionUpdate] = {}
    for node in nodes:
        names = ", ".join(sorted(pod.name for pod in node.outdated))
        if not node.outdated:
            updates[node.node] = _condition_without_outdated(node, node.node in skipped)
        elif node.obstacle is not None:
            reason, message = node.obstacle
            updates[node.node] = ConditionUpdate(
                SERVICES_CURRENT, "False", reason, f"{names}: {message}", progress=True
            )
        elif node.node in replaced:
            message = f"{names}: being replaced"
            updates[node.node] = ConditionUpdate(SERVICES_CURRENT, "False", "Replacing", message, progress=True)
        else:
            before = (busy or [chosen[0].node])[0]
            message = f"{names}: replaced when the services of {before} are ready"
            updates[node.node] = ConditionUpdate(SERVICES_CURRENT, "False", "Queued", message, progress=True)
    return chosen, updates


def _condition_without_outdated(node: ServicesOfNode, skipped: bool) -> ConditionUpdate:
    if not node.starting:
        return ConditionUpdate(SERVICES_CURRENT, "True", "Current")
    names = ", ".join(sorted(node.starting.values()))
    if node.starting_s <= STUCK_S:
        return ConditionUpdate(SERVICES_CURRENT, "False", "Starting", f"waiting for {names}", progress=True)
    others = "the rollout continues without it" if skipped else "other nodes wait, because too few run this release"
    message = (
        f"{names}: not ready for {STUCK_S / 60:.0f} minutes; {others}; see kubectl -n fractus-system describe pods"
    )
    return ConditionUpdate(SERVICES_CURRENT, "False", "NotReady", message)


class ServiceRollout:
    """Executes the steps of the rollout, and reports them in the condition ServicesCurrent of drones and edge nodes."""

    def __init__(
        self, store: Store, cache: ClusterCache, conditions: NodeConditionWriter, monotonic: Callable[[], float]
    ) -> None:
        self._store = store
        self._cache = cache
        self._conditions = conditions
        self._monotonic = monotonic
        self._unsettled: set[str] = set()
        """Nodes that are not in the desired state, or whose condition is not written yet."""
        self._awaited: dict[str, set[str]] = {}
        """By node, the DaemonSets whose deleted pods have no ready successor yet."""
        self._starting: dict[str, tuple[Mapping[str, str], float]] = {}
        """By node, the starting pods, and the time since which they have been starting, in seconds."""

    async def step(self) -> None:
        """Replace the services that may be replaced now.

        Raises:
            KubeError: The API server cannot be reached.
        """
        await self._cache.synced()
        services = self._cache.services
        self._unsettled |= services.take_changed()
        if not self._unsettled:
            return
        chosen, updates = next_step(list(self._observe()), len(services), services.ready)
        for node in chosen:
            try:
                await self._replace(node)
            except KubeError as error:
                if not error.status:
                    raise
                log.warning("service rollout: services not replaced (node=%s error=%s)", node.node, error)
                # The admission policy forbids the deletion if the drone has taken off meanwhile.
                reason = "InTheAir" if error.status == HTTPStatus.FORBIDDEN else "Refused"
                updates[node.node] = ConditionUpdate(SERVICES_CURRENT, "False", reason, str(error), progress=True)
        await self._report(updates)

    def _observe(self) -> Iterable[ServicesOfNode]:
        claims = self._cache.fleet.claims()
        services = self._cache.services
        for node in sorted(self._unsettled):
            pods = services.on(node)
            outdated = tuple(p for p in pods if not p.terminating and not services.is_current(p))
            present = [p for p in pods if not p.terminating and p not in outdated]
            self._settle(node, {p.daemon_set for p in present if p.ready})
            if not pods and node not in self._awaited:
                self._unsettled.discard(node)
                continue
            existing = {p.daemon_set for p in (*present, *outdated)}
            starting = {name: name for name in self._awaited.get(node, set()) - existing}
            starting |= {
                str(p.daemon_set): p.name for p in pods if p.terminating or (p not in outdated and not p.ready)
            }
            claim = claims.get(node)
            obstacle = self._obstacle(node, claim.key if claim else None)
            yield ServicesOfNode(node, outdated, starting, obstacle, self._starting_s(node, starting))

    def _starting_s(self, node: str, starting: Mapping[str, str]) -> float:
        """Return the seconds for which these pods have been starting."""
        now_s = self._monotonic()
        known, since_s = self._starting.pop(node, (starting, now_s))
        if starting:
            self._starting[node] = (starting, since_s if known == starting else now_s)
        return now_s - since_s if known == starting else 0.0

    def _settle(self, node: str, ready: set[str | None]) -> None:
        """Stop waiting for successors that are ready, or whose DaemonSet or node was deleted."""
        awaited = {d for d in self._awaited.pop(node, ()) if d not in ready and self._cache.services.has_revision(d)}
        if awaited and self._cache.hosts.get(("", node)) is not None:
            self._awaited[node] = awaited

    def _obstacle(self, node: str, holder: kinds.Key | None) -> tuple[str, str] | None:
        host = self._cache.hosts.get(("", node))
        if host is None or not host.ready:
            # The kubelet would replace the pods when the node is reachable again, even in flight.
            return "NodeUnreachable", f"{node} is unreachable"
        if self._cache.fleet.is_in_flight(node):
            return "InTheAir", f"{node} is in the air"
        drone = self._cache.drone(node)
        if drone is not None and holder is not None and not drone.grounded_by_hand:
            return "OnMission", f"{'/'.join(holder)} holds {node} and may take off"
        if drone is not None and drone.may_take_off:
            return "OnMission", f"{node} may have taken off since its last report"
        return None

    async def _replace(self, node: ServicesOfNode) -> None:
        for pod in node.outdated:
            log.info("service rollout: replacing pod (node=%s pod=%s)", node.node, pod.name)
            # Recorded before the deletion, because a request without a response may take effect.
            self._awaited.setdefault(node.node, set()).add(str(pod.daemon_set))
            await self._store.delete(kinds.POD, (pod.namespace, pod.name))

    async def _report(self, updates: Mapping[str, ConditionUpdate]) -> None:
        for name, update in updates.items():
            known = self._conditions.condition(name, SERVICES_CURRENT)
            # A node without an outdated pod gets no condition.
            if update.reason not in {"Current", "Starting"} or known is not None:
                with skip_failed_node("service rollout", name):
                    await self._conditions.write(name, update)
            if update.status == "True" and (known is None or known.status == "True"):
                self._unsettled.discard(name)

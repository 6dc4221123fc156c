"""Status of DirectLinks: the fields that each end of the link writes, and the intervals between writes."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from fractus_core.api.conditions import ConditionUpdate, merge_conditions
from fractus_core.api.direct_links import LINKED, PEER_READY, TRAFFIC_DIRECT, DirectLink
from fractus_core.api.model import Condition, timestamp
from fractus_core.linking import LearnedRange, LinkPhase, LinkState, PathMetrics, Peer

from fractus_agent.links.decisions import LinkActions
from fractus_agent.links.direct_link_store import virtual_endpoints
from fractus_agent.links.traffic_rates import ServiceRate
from fractus_agent.redirector.nft_maps import Endpoint
from fractus_agent.store import LinkEnd, Object, Store
from fractus_agent.supervisor import repeat

URGENT_INTERVAL_S = 1.0
VALUES_INTERVAL_S = 15.0
"""Minimum seconds between writes of one status: after a decision (URGENT), or if only measured values have changed (VALUES)."""

_PHASES = {LinkPhase.NONE: "Idle", LinkPhase.CONNECTING: "Connecting", LinkPhase.UP: "Up"}


@dataclass(frozen=True, slots=True)
class DroneLinkReport:
    """State of all links of a drone after a decision.

    Attributes:
        links: DirectLinks of the drone.
        link: Current state of the link.
        actions: Last decision.
        direct: Services on the link.
        measured: Measured performance of the link that is up, None before the first measurement.
        ranges: Learned ranges by peer.
        unknown: Reason by application whose heuristic is unknown to this agent.
        cloud: Performance of the cloud path, None while it does not respond.
        expected: Expected performance of the links from the position of the drone, None out of range.
        rates: Recent traffic of services over the link.
    """

    links: tuple[DirectLink, ...]
    link: LinkState
    actions: LinkActions
    direct: frozenset[Endpoint]
    measured: PathMetrics | None
    ranges: Mapping[str, LearnedRange]
    unknown: Mapping[str, str]
    cloud: PathMetrics | None
    expected: Mapping[Peer, PathMetrics | None]
    rates: Mapping[Endpoint, ServiceRate] = field(default_factory=dict)


def drone_status(report: DroneLinkReport, direct_link: DirectLink) -> tuple[dict[str, Any], list[ConditionUpdate]]:
    """Return the drone's part of the status of a DirectLink, without switch counts, and its conditions."""
    spec = direct_link.spec
    phase = report.link.phase if report.link.peer == spec.node else LinkPhase.NONE
    direct = phase is LinkPhase.UP and not report.direct.isdisjoint(virtual_endpoints([direct_link]))
    reason, message = _reason(report, direct_link, phase)
    status: dict[str, Any] = {
        "phase": _PHASES[phase],
        "traffic": "direct" if direct else "cloud",
        "reason": reason,
        "message": message,
    }
    if phase is LinkPhase.UP and report.measured is not None:
        status["bandwidth"] = round(report.measured.ingress_mbps, 1)
        status["latency"] = round(report.measured.ingress_latency_ms, 1)
    linked = ConditionUpdate(LINKED, "False", reason, message)
    if phase is LinkPhase.UP:
        linked = ConditionUpdate(LINKED, "True", "Up")
    return status, [
        linked,
        ConditionUpdate(TRAFFIC_DIRECT, "True" if direct else "False", reason, message),
    ]


def _reason(report: DroneLinkReport, direct_link: DirectLink, phase: LinkPhase) -> tuple[str, str]:
    """Return reason and message of the state of a link."""
    spec = direct_link.spec
    application = f"{spec.application.namespace}/{spec.application.name}"
    if application in report.unknown:
        return "UnknownHeuristic", report.unknown[application]
    decision = report.actions.link
    target = report.actions.targets.get(application)
    if phase is LinkPhase.UP and target is not None:
        return target.code, target.reason
    if phase is LinkPhase.CONNECTING or report.link.phase is LinkPhase.NONE:
        learned = report.ranges.get(spec.node)
        if phase is LinkPhase.NONE and learned is not None and learned.failures:
            return "PairingFailed", f"pairing with {spec.node} failed {learned.failures} times, retrying later"
        return decision.code, decision.reason
    return "NotChosen", f"the drone has one link at a time, which goes to {report.link.peer}"


def edge_condition(direct_link: DirectLink, problem: tuple[str, str] | None, linked: Iterable[str]) -> ConditionUpdate:
    """Return the condition PeerReady, which the edge node sets on a DirectLink.

    Args:
        direct_link: The DirectLink.
        problem: Reason and message if the interface is not usable, otherwise None.
        linked: Drones that are linked to the node.
    """
    spec = direct_link.spec
    if problem is not None:
        return ConditionUpdate(PEER_READY, "False", *problem)
    others = sorted(set(linked) - {spec.drone})
    if others:
        return ConditionUpdate(PEER_READY, "False", "Busy", f"{spec.node} is linked to {', '.join(others)}")
    if not any(service.target is not None for service in spec.services):
        return ConditionUpdate(PEER_READY, "False", "NotServed", f"{spec.node} has no ready instance")
    return ConditionUpdate(
        PEER_READY, "True", "Listening", f"{spec.node} accepts the drone's calls over its direct interface"
    )


@dataclass(slots=True)
class _TrackedStatus:
    """Desired and written status of one DirectLink."""

    desired: Object
    uid: str | None
    written: Object | None = None
    written_s: float = 0.0
    traffic: str = "cloud"
    switches: int = 0
    last_switch: str = ""
    conditions: tuple[Condition, ...] = ()


class LinkStatusReporter:
    """Writes the status of the node's DirectLinks: soon after decisions, and less often if only values have changed.

    Args:
        store: The node's objects at the API server.
        end: This node's end of its links, `drone` or `node`.
        wall: Returns the wall clock time.
    """

    def __init__(self, store: Store, end: LinkEnd, wall: Callable[[], datetime]) -> None:
        self._store = store
        self._end: LinkEnd = end
        self._wall = wall
        self._statuses: dict[str, _TrackedStatus] = {}
        self._changed = asyncio.Event()

    def set_drone_report(self, report: DroneLinkReport) -> None:
        """Set the status of all links from the report of the drone's link controller."""
        for link in report.links:
            status, conditions = drone_status(report, link)
            self._set_drone_status(link, status, conditions)
        self._forget(report.links)

    def set_unusable(self, links: tuple[DirectLink, ...], reason: str, message: str) -> None:
        """Set the status of all links of a drone whose interface is not usable."""
        for link in links:
            status = {"phase": "Idle", "traffic": "cloud", "reason": reason, "message": message}
            self._set_drone_status(
                link, status, [ConditionUpdate(kind, "False", reason, message) for kind in (LINKED, TRAFFIC_DIRECT)]
            )
        self._forget(links)

    def set_conditions(self, links: Iterable[DirectLink], of: Callable[[DirectLink], ConditionUpdate]) -> None:
        """Set one condition of each link."""
        links = tuple(links)
        for link in links:
            self._set(link, {}, [of(link)])
        self._forget(links)

    async def run(self) -> None:
        """Write until cancelled. Failed writes are repeated."""
        await repeat("links", self.step, self._changed)

    async def step(self) -> float:
        """Write each status that is due. Return the seconds until the next one is due."""
        wait_s = VALUES_INTERVAL_S
        for name, tracked in tuple(self._statuses.items()):
            due_s = self._due_s(tracked)
            if due_s <= 0:
                tracked.written = tracked.desired
                tracked.written_s = time.monotonic()
                try:
                    await self._store.apply_status("DirectLink", name, tracked.desired, self._end)
                except BaseException:
                    tracked.written = None
                    raise
            else:
                wait_s = min(wait_s, due_s)
        return wait_s

    def _set_drone_status(self, link: DirectLink, status: Object, conditions: list[ConditionUpdate]) -> None:
        """Set the drone's part of a status, and count switches."""
        tracked = self._tracked(link)
        if status["traffic"] != tracked.traffic:
            tracked.traffic = status["traffic"]
            tracked.switches += 1
            tracked.last_switch = timestamp(self._wall())
        kept = {k: tracked.desired[k] for k in ("bandwidth", "latency") if k in tracked.desired}
        counted = {"switches": tracked.switches} | ({"lastSwitch": tracked.last_switch} if tracked.last_switch else {})
        self._set(link, kept | status | counted, conditions)

    def _tracked(self, link: DirectLink) -> _TrackedStatus:
        tracked = self._statuses.get(link.name)
        if tracked is None or tracked.uid != link.metadata.uid:
            tracked = self._statuses[link.name] = _TrackedStatus({}, link.metadata.uid)
        return tracked

    def _set(self, link: DirectLink, status: Object, conditions: list[ConditionUpdate]) -> None:
        tracked = self._tracked(link)
        generation = link.metadata.generation
        tracked.conditions, _ = merge_conditions(tracked.conditions, conditions, generation, self._wall())
        if self._end == "drone" and generation is not None:
            status = {**status, "observedGeneration": generation}
        desired = {**status, "conditions": [condition.to_dict() for condition in tracked.conditions]}
        if desired != tracked.desired:
            tracked.desired = desired
            self._changed.set()

    def _forget(self, links: Iterable[DirectLink]) -> None:
        for removed in self._statuses.keys() - {link.name for link in links}:
            del self._statuses[removed]

    @staticmethod
    def _due_s(tracked: _TrackedStatus) -> float:
        if tracked.written is None:
            return 0.0
        if tracked.written == tracked.desired:
            return VALUES_INTERVAL_S
        interval_s = VALUES_INTERVAL_S
        if _urgent(tracked.written) != _urgent(tracked.desired):
            interval_s = URGENT_INTERVAL_S
        return interval_s - (time.monotonic() - tracked.written_s)


def _urgent(status: Object) -> tuple[object, ...]:
    conditions = tuple((c["type"], c["status"], c["reason"]) for c in status.get("conditions", ()))
    return (status.get("phase"), status.get("traffic"), status.get("reason"), status.get("switches"), conditions)

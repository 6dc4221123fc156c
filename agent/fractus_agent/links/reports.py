"""What the agents of both ends say of a DirectLink in its status, and when it is worth a write."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from fractus_core.api.direct_links import LINKED, PEER_READY, TRAFFIC_DIRECT, DirectLink
from fractus_core.linking import Link, PathMetrics, Peer, Phase, Reach

from fractus_agent.cluster.store import End, Object, Store
from fractus_agent.conditions import Condition, timestamp, to_kubernetes
from fractus_agent.links.decisions import Actions
from fractus_agent.links.flows import Flow
from fractus_agent.links.plans import virtuals
from fractus_agent.redirector.nft import Endpoint
from fractus_agent.supervisor import repeat

URGENT_S, FIGURES_S = 1.0, 15.0
"""Seconds between writes of one status: after a decision, and when only figures have moved."""

_PHASES = {Phase.NONE: "Idle", Phase.CONNECTING: "Connecting", Phase.UP: "Up"}


@dataclass(frozen=True, slots=True)
class DroneReport:
    """What a drone's end has done about its links.

    Attributes:
        links: the DirectLinks of the drone.
        link: the link as it is.
        actions: the last decision.
        direct: services whose calls take the link.
        measured: of the link that is up; None before that.
        reaches: what was learned of peers.
        unknown: applications whose heuristic is not known here, and why.
        cloud: what the cloud path offers; None while it does not answer.
        offers: what the links to peers are expected to offer where the drone is; None out of reach.
        flows: what services moved over the link lately.
    """

    links: tuple[DirectLink, ...]
    link: Link
    actions: Actions
    direct: frozenset[Endpoint]
    measured: PathMetrics | None
    reaches: Mapping[str, Reach]
    unknown: Mapping[str, str]
    cloud: PathMetrics | None
    offers: Mapping[Peer, PathMetrics | None]
    flows: Mapping[Endpoint, Flow] = field(default_factory=dict)


def drone_status(report: DroneReport, about: DirectLink) -> tuple[dict[str, Any], list[Condition]]:
    """The drone's part of the status of one DirectLink, without what depends on the one before, and its conditions."""
    spec = about.spec
    phase = report.link.phase if report.link.peer == spec.node else Phase.NONE
    direct = phase is Phase.UP and not report.direct.isdisjoint(virtuals([about]))
    reason, message = _reason(report, about, phase)
    status: dict[str, Any] = {
        "phase": _PHASES[phase],
        "traffic": "direct" if direct else "cloud",
        "reason": reason,
        "message": message,
    }
    if phase is Phase.UP and report.measured is not None:
        status["bandwidth"] = round(report.measured.ingress_mbps, 1)
        status["latency"] = round(report.measured.ingress_latency_ms, 1)
    up = phase is Phase.UP
    return status, [
        Condition(LINKED, "True" if up else "False", "Up" if up else reason, "" if up else message),
        Condition(TRAFFIC_DIRECT, "True" if direct else "False", reason, message),
    ]


def _reason(report: DroneReport, about: DirectLink, phase: Phase) -> tuple[str, str]:
    """Why the link is as it is: CamelCase, and a sentence."""
    application = f"{about.spec.application.namespace}/{about.spec.application.name}"
    if application in report.unknown:
        return "UnknownHeuristic", report.unknown[application]
    decided = report.actions.link
    if phase is Phase.UP and (target := report.actions.targets.get(application)) is not None:
        return target.code, target.reason
    if phase is Phase.CONNECTING or report.link.phase is Phase.NONE:
        reach = report.reaches.get(about.spec.node)
        if phase is Phase.NONE and reach is not None and reach.failures:
            return (
                "PairingFailed",
                f"{about.spec.node} did not pair {reach.failures} times; it is asked again after a while",
            )
        return decided.code, decided.reason
    return "NotChosen", f"the drone has one link at a time, and that goes to {report.link.peer}"


def peer_condition(about: DirectLink, problem: tuple[str, str] | None, linked: Iterable[str]) -> Condition:
    """What the node that is asked says of one DirectLink.

    Args:
        about: the DirectLink.
        problem: why its interface cannot be used, CamelCase and a sentence; None while it can.
        linked: drones that are linked to the node.
    """
    if problem is not None:
        return Condition(PEER_READY, "False", *problem)
    others = sorted(set(linked) - {about.spec.drone})
    if others:
        return Condition(PEER_READY, "False", "Busy", f"{about.spec.node} is linked to {', '.join(others)}")
    if not any(service.target is not None for service in about.spec.services):
        return Condition(PEER_READY, "False", "NotServed", f"{about.spec.node} has no ready instance")
    return Condition(
        PEER_READY, "True", "Listening", f"{about.spec.node} takes the drone's calls over its direct interface"
    )


@dataclass(slots=True)
class _Known:
    """What is known of one status: as it is to be, as it was written, and when."""

    wanted: Object
    uid: str | None
    written: Object | None = None
    written_s: float = 0.0
    traffic: str = "cloud"
    switches: int = 0
    last_switch: str = ""
    conditions: tuple[Object, ...] = ()


class LinkReports:
    """Writes the statuses of the node's DirectLinks: soon after decisions, now and then when figures move.

    Args:
        store: the API server.
        end: which end this node is.
        wall: the wall clock.
    """

    def __init__(self, store: Store, end: End, wall: Callable[[], datetime]) -> None:
        self._store = store
        self._end: End = end
        self._wall = wall
        self._known: dict[str, _Known] = {}
        self._changed = asyncio.Event()

    def drone(self, report: DroneReport) -> None:
        """Take what the drone's end has done."""
        for link in report.links:
            status, conditions = drone_status(report, link)
            self._say(link, status, conditions)
        self._forget(report.links)

    def unusable(self, links: tuple[DirectLink, ...], reason: str, message: str) -> None:
        """Take that a drone cannot use its interface, and why."""
        for link in links:
            status = {"phase": "Idle", "traffic": "cloud", "reason": reason, "message": message}
            self._say(link, status, [Condition(kind, "False", reason, message) for kind in (LINKED, TRAFFIC_DIRECT)])
        self._forget(links)

    def conditions(self, links: Iterable[DirectLink], of: Callable[[DirectLink], Condition]) -> None:
        """Take one condition of each link."""
        links = tuple(links)
        for link in links:
            self._set(link, {}, [of(link)])
        self._forget(links)

    async def run(self) -> None:
        """Write until cancelled; what cannot be written now is written later."""
        await repeat("links", self.step, self._changed)

    async def step(self) -> float:
        """Write what is due; seconds until something will be."""
        wait_s = FIGURES_S
        for name, known in tuple(self._known.items()):
            due_s = self._due_s(known)
            if due_s <= 0:
                known.written, known.written_s = known.wanted, time.monotonic()
                try:
                    await self._store.apply_status("DirectLink", name, known.wanted, self._end)
                except BaseException:
                    known.written = None
                    raise
            else:
                wait_s = min(wait_s, due_s)
        return wait_s

    def _say(self, link: DirectLink, status: Object, conditions: list[Condition]) -> None:
        """Take the drone's part of a status, and count switches."""
        known = self._of(link)
        if status["traffic"] != known.traffic:
            known.traffic, known.switches = status["traffic"], known.switches + 1
            known.last_switch = timestamp(self._wall())
        kept = {k: known.wanted[k] for k in ("bandwidth", "latency") if k in known.wanted}
        counted = {"switches": known.switches} | ({"lastSwitch": known.last_switch} if known.last_switch else {})
        self._set(link, kept | status | counted, conditions)

    def _of(self, link: DirectLink) -> _Known:
        known = self._known.get(link.name)
        if known is None or known.uid != link.metadata.uid:
            known = self._known[link.name] = _Known({}, link.metadata.uid)
        return known

    def _set(self, link: DirectLink, status: Object, conditions: list[Condition]) -> None:
        known = self._of(link)
        made = to_kubernetes(conditions, known.conditions, link.metadata.generation, self._wall())
        known.conditions = tuple(made)
        if self._end == "drone" and link.metadata.generation is not None:
            status = {**status, "observedGeneration": link.metadata.generation}
        wanted = {**status, "conditions": made}
        if wanted != known.wanted:
            known.wanted = wanted
            self._changed.set()

    def _forget(self, links: Iterable[DirectLink]) -> None:
        for gone in self._known.keys() - {link.name for link in links}:
            del self._known[gone]

    @staticmethod
    def _due_s(known: _Known) -> float:
        if known.written is None:
            return 0.0
        if known.written == known.wanted:
            return FIGURES_S
        pace_s = URGENT_S if _urgent(known.written) != _urgent(known.wanted) else FIGURES_S
        return pace_s - (time.monotonic() - known.written_s)


def _urgent(status: Object) -> tuple[object, ...]:
    conditions = tuple((c["type"], c["status"], c["reason"]) for c in status.get("conditions", ()))
    return (status.get("phase"), status.get("traffic"), status.get("reason"), status.get("switches"), conditions)

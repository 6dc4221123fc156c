"""The drone's end of direct links: knows the flight, decides, connects, and moves the traffic."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any

from fractus_core.api.direct_links import DirectLink
from fractus_core.linking import (
    NO_LINK,
    Course,
    Link,
    PathMetrics,
    Peer,
    Phase,
    Seen,
    Settings,
    TargetHeuristic,
    Track,
    UnknownHeuristic,
)

from fractus_agent.links.addressing import link_address
from fractus_agent.links.connector import Connector
from fractus_agent.links.decisions import Actions, Situation, Traffic, decide
from fractus_agent.links.drains import Drains
from fractus_agent.links.evidence import Record, records
from fractus_agent.links.flows import FULL, MAX_CONFIRMED, WINDOW_S, Flows
from fractus_agent.links.heuristics import Heuristics
from fractus_agent.links.lessons import Lessons
from fractus_agent.links.pairing import LinkLost, Session
from fractus_agent.links.plans import callers, route_key, virtuals
from fractus_agent.links.reports import DroneReport
from fractus_agent.redirector.netlink import NetlinkError
from fractus_agent.redirector.nft import Endpoint, RedirectFailed
from fractus_agent.redirector.redirector import Redirector

log = logging.getLogger(__name__)

DECIDE_S = 0.5
PROBE_S = 3.0
"""Seconds between two measurements of a link that is up."""
PROBES = 3
"""The best of the last N counts: a probe that meets the components' own traffic shows what is left beside it."""
LEAVE_S = 2.0
"""So long before the drone leaves a link's reach its traffic is led back: clients that call all the time are drained within 1.5 s,
and reaches have soft edges."""
PART_S = 1.5
"""Connections have so long to become idle when the agent ends, or no link is planned any more."""
DIRECT_LATENCY_MS = 5.0
"""What a link is expected to need before it was measured."""


class DroneEnd:
    """Keeps the drone's direct link and the traffic where they are best.

    Args:
        node: this node.
        tls: its certificate, key and authority.
        redirector: of this node.
        cloud: what the cloud path offers; None while it does not answer.
        seen: what telemetry says of the drone now; None while it says nothing.
        report: takes what becomes of the links.
        record: writes an entry of the audit log: its kind and content.
    """

    def __init__(
        self,
        node: str,
        tls: Path,
        redirector: Redirector,
        *,
        cloud: Callable[[], PathMetrics | None],
        seen: Callable[[], Seen | None],
        report: Callable[[DroneReport], None],
        record: Record,
    ) -> None:
        self._redirector = redirector
        self._cloud = cloud
        self._seen = seen
        self._report = report
        self._record = record
        self._settings = Settings(drain_s=LEAVE_S)
        self._connector = Connector(node, tls, self._use, self._link_changed)
        self._lessons = Lessons(self._settings)
        self._links: tuple[DirectLink, ...] = ()
        self._courses: dict[tuple[object, ...], Course] = {}
        self._unknown: dict[str, str] = {}
        self._heuristics = Heuristics()
        self._said: tuple[str, Mapping[str, Any]] | None = None
        self._direct: PathMetrics | None = None
        self._flows = Flows()
        self._parting = False
        self._wake = asyncio.Event()
        self._drains = Drains(redirector, self._wake.set)
        self._before = NO_LINK

    def plan(self, links: tuple[DirectLink, ...]) -> None:
        """Take the DirectLinks of this drone as they are now."""
        self._links = links
        self._lessons.keep(self._nodes())
        self._wake.set()

    def heard(self, node: str) -> None:
        """A beacon came; anyone can send one, with any name."""
        if node in self._nodes():
            self._lessons.beacon(node, time.monotonic())

    def _nodes(self) -> set[str]:
        return {link.spec.node for link in self._links}

    async def run(self) -> None:
        """Decide until cancelled; then lead all traffic back and end the link."""
        try:
            while True:
                self._wake.clear()
                try:
                    await self._step()
                except (NetlinkError, RedirectFailed) as error:
                    log.warning("links: traffic is not moved, trying again (error=%s)", error)
                try:
                    async with asyncio.timeout(DECIDE_S):
                        await self._wake.wait()
                except TimeoutError:
                    continue
        finally:
            await asyncio.shield(self._part())

    async def _part(self) -> None:
        try:
            async with asyncio.timeout(PART_S):
                back = dict.fromkeys(self._redirector.redirects)
                await self._redirector.switch(back, planned=self._connector.link.phase is Phase.UP)
        except TimeoutError:
            log.info("links: connections were closed that were not idle in time")
        except (NetlinkError, RedirectFailed) as error:
            log.warning("links: traffic is not led back, its redirects end by themselves (error=%s)", error)
        for on_link in (True, False):
            await self._drains.cut(on_link=on_link)
        await self._want("")

    async def _step(self) -> None:
        """One decision, and what it asks for."""
        # Those that are not planned any more as well, for as long as their traffic takes the link.
        self._redirector.serve({*virtuals(self._links), *self._redirector.redirects}, callers(self._links))
        situation = self._situation()
        # What drains on a path that is gone would never end.
        if situation.link.phase is not Phase.UP:
            await self._drains.cut(on_link=True)
        if situation.cloud is None:
            await self._drains.cut(on_link=False)
        actions = decide(situation, self._settings)
        if actions.abrupt:
            await self._redirector.switch(actions.abrupt, planned=False)
        if actions.planned:
            await self._drains.begin(actions.planned)
        if self._drains.on_link:  # the link is left, or given to another peer, once nothing needs it any more
            actions = replace(actions, link=replace(actions.link, changes=False))
        self._explain(actions, situation)
        if actions.link.changes:
            await self._want(actions.peer)
        self._tell(actions, situation)

    async def _want(self, peer: str) -> None:
        self._parting = True
        try:
            await self._connector.want(peer)
        finally:
            self._parting = False

    def _situation(self) -> Situation:
        now_s = time.monotonic()
        track, peers = self._flight()
        self._lessons.here = track.position if track is not None else None
        self._lessons.peers = peers
        return Situation(
            now_s, track, tuple(self._traffic(peers)), self._connector.link, dict(self._lessons.reaches),
            self._cloud(), self._direct, self._routes(), self._redirector.redirects,
        )  # fmt: skip

    def _routes(self) -> dict[Endpoint, Endpoint]:
        """Where the peer takes calls, by the DirectLinks of now: it may tell of one before this end knows it."""
        if self._said is None:
            return {}
        peer, message = self._said
        return _routes(message, link_address(peer), [link for link in self._links if link.spec.node == peer])

    def _flight(self) -> tuple[Track | None, dict[str, Peer]]:
        """Where the drone flies, and where its peers are, in one frame; by the path of the first application by name."""
        seen = self._seen()
        if seen is None or not self._links:
            return None, {}
        path = min(self._links, key=_application).spec.path
        if path not in self._courses:
            self._courses = {path: Course(path)}
        frame, track = self._courses[path].track(seen)
        peers = {}
        for link in self._links:
            spec = link.spec
            offers = PathMetrics(spec.bandwidth, spec.bandwidth, DIRECT_LATENCY_MS, DIRECT_LATENCY_MS, direct=True)
            peers[spec.node] = Peer(spec.node, frame.place(spec.position, seen), spec.range, offers)
        return track, peers

    def _traffic(self, peers: Mapping[str, Peer]) -> list[Traffic]:
        found = []
        self._unknown = {}
        for application in sorted({_application(link) for link in self._links}):
            links = [link for link in self._links if _application(link) == application]
            score = self._heuristic(application, links[0])
            if score is None:
                continue
            served = tuple(peers[link.spec.node] for link in links if link.spec.node in peers)
            found.append(Traffic(application, score, served, frozenset(virtuals(links))))
        return found

    def _heuristic(self, application: str, link: DirectLink) -> TargetHeuristic | None:
        """The heuristic of an application; None, and so the cloud path, where it is not known here."""
        chosen = link.spec.heuristic
        try:
            return self._heuristics.find(chosen.kind, chosen.metric)
        except UnknownHeuristic as error:
            self._unknown[application] = str(error)
        return None

    async def _use(self, session: Session) -> None:
        """While a session lasts: hear the peer's routes, and measure.

        Raises:
            LinkLost: the peer keeps the session, and serves nothing.
        """

        def told(message: Mapping[str, Any]) -> None:
            self._said = (session.peer, message)
            self._wake.set()

        session.told = told
        rates: deque[float] = deque(maxlen=PROBES)
        probed, confirmed = 0.0, MAX_CONFIRMED
        try:
            while True:
                while session.latency_ms is None:  # noqa: ASYNC110 (the session has no event for it)
                    await asyncio.sleep(0.01)
                peak = self._flows.peak_mbps
                confirmed = confirmed + 1 if peak >= FULL * probed else MAX_CONFIRMED + 1
                if confirmed > MAX_CONFIRMED:
                    probed, confirmed = await session.probe(), 0
                rates.append(max(peak, probed))
                rate, latency_ms = max(rates), session.latency_ms
                self._direct = PathMetrics(rate, rate, latency_ms, latency_ms, direct=True)
                self._lessons.delivered(session.peer, self._direct)
                _log_measured(session.peer, self._direct, first=len(rates) == 1)
                self._wake.set()
                await self._watch(PROBE_S)
                if self._said is None:
                    raise LinkLost(f"{session.peer} has not said where it takes calls")
        finally:
            self._flows = Flows()
            self._said = self._direct = None
            self._wake.set()

    async def _watch(self, seconds: float) -> None:
        """Look at what flows, for so long."""
        for _ in range(round(seconds / WINDOW_S)):
            await asyncio.sleep(WINDOW_S)
            try:
                self._flows.take(time.monotonic(), self._redirector.counted())
            except NetlinkError as error:
                log.debug("links: counters not read (error=%s)", error)

    def _link_changed(self, link: Link, reason: str) -> None:
        now_s, before, self._before = time.monotonic(), self._before, link
        self._record("link", {"phase": link.phase.value, "peer": link.peer or before.peer, "reason": reason})
        if link.phase is Phase.UP:
            self._lessons.came_up(link.peer, now_s)
        elif link.phase is Phase.NONE and not self._parting:
            learn = self._lessons.broke if before.phase is Phase.UP else self._lessons.not_paired
            learn(before.peer, now_s)
        self._wake.set()

    def _explain(self, actions: Actions, situation: Situation) -> None:
        """One line of the log, and one entry of the audit log, for each decision that changes something."""
        said = {"link": f"{actions.link.code}: {actions.link.reason}"} if actions.link.changes else {}
        said |= {name: f"{found.code}: {found.reason}" for name, found in actions.targets.items() if found.changes}
        for what, why in said.items():
            log.info("links: decided (on=%s peer=%s): %s", what, actions.peer or "-", why)
        for kind, content in records(actions, situation):
            self._record(kind, content)

    def _tell(self, actions: Actions, situation: Situation) -> None:
        self._report(
            DroneReport(
                links=self._links,
                link=self._connector.link,
                actions=actions,
                direct=frozenset(self._redirector.redirects),
                measured=situation.direct,
                reaches=self._lessons.reaches,
                unknown=dict(self._unknown),
                cloud=situation.cloud,
                offers=self._lessons.offers(),
                flows=self._flows.by_service,
            )
        )


def _log_measured(peer: str, path: PathMetrics, *, first: bool) -> None:
    level = logging.INFO if first else logging.DEBUG
    mbps, latency_ms = path.ingress_mbps, path.ingress_latency_ms
    log.log(level, "links: measured (peer=%s mbps=%.1f latency_ms=%.1f)", peer, mbps, latency_ms)


def _application(link: DirectLink) -> str:
    return f"{link.spec.application.namespace}/{link.spec.application.name}"


def _routes(message: Mapping[str, Any], address: IPv4Address, links: list[DirectLink]) -> dict[Endpoint, Endpoint]:
    """What a peer says of where it takes calls, as far as its DirectLinks name the services."""
    said = message.get("routes")
    if not isinstance(said, dict):
        return {}
    found = {}
    for service in virtuals(links):
        port = said.get(route_key(service))
        if isinstance(port, int) and not isinstance(port, bool) and 0 < port < 65536:
            found[service] = Endpoint(address, port, service.protocol)
    return found

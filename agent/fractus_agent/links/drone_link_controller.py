"""Drone end of direct links: estimates the flight, decides, pairs with peers, and moves the traffic."""

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
    HeuristicRegistry,
    LinkPhase,
    LinkSettings,
    LinkState,
    PathHeuristic,
    PathMetrics,
    Peer,
    RangeModel,
    TelemetrySample,
    Track,
    TrajectoryEstimator,
    UnknownHeuristic,
    local_position,
)

from fractus_agent.links.audit_records import AuditRecorder, decision_records
from fractus_agent.links.connection_drain import ConnectionDrain
from fractus_agent.links.connector import Connector
from fractus_agent.links.decisions import ApplicationTraffic, LinkActions, LinkSituation, decide
from fractus_agent.links.device_addresses import link_address
from fractus_agent.links.direct_link_store import allowed_callers, route_key, virtual_endpoints
from fractus_agent.links.link_status import DroneLinkReport
from fractus_agent.links.pairing import ACKNOWLEDGEMENT_TIMEOUT_S, LinkLost, Session
from fractus_agent.links.traffic_rates import CONFIRMING_SHARE, MAX_CONFIRMATIONS, WINDOW_S, TrafficRates
from fractus_agent.redirector.netlink import NetlinkError
from fractus_agent.redirector.nft_maps import Endpoint, RedirectFailed
from fractus_agent.redirector.redirector import QUIET_TIMEOUT_S, Redirector
from fractus_agent.settings import DEFAULT_DRAIN_S

log = logging.getLogger(__name__)

DECISION_INTERVAL_S = 0.5
PROBE_INTERVAL_S = 3.0
"""Seconds between two bandwidth measurements of a link that is up."""
PROBE_SAMPLES = 3
"""Number of recent measurements, of which the highest is used as the bandwidth.

A probe that competes with traffic measures only the unused bandwidth.
"""
MIN_LEAVE_S = 2.0
"""Shortest time before the predicted end of a link's range at which traffic moves back to the cloud path, in seconds."""
SHUTDOWN_DRAIN_S = 2.0
"""Seconds for which connections may finish on the link after the agent is stopped, or after no link is planned."""
DEFAULT_LATENCY_MS = 5.0
"""Expected latency of a link before its first measurement, in milliseconds."""


class DroneLinkController:
    """Keeps the drone's direct link and the traffic on the best peer and path.

    Args:
        node: Name of this node.
        tls: Directory of its certificate, key and authority.
        redirector: Redirector of this node.
        cloud: Returns the performance of the cloud path, None while it is unreachable.
        telemetry: Returns the latest telemetry of the drone, None if unavailable.
        report: Called with the state of the links after each decision.
        record: Writes an audit record.
        drain_s: Time for which connections stay on a path that their service has left, in seconds.
    """

    def __init__(
        self,
        node: str,
        tls: Path,
        redirector: Redirector,
        *,
        cloud: Callable[[], PathMetrics | None],
        telemetry: Callable[[], TelemetrySample | None],
        report: Callable[[DroneLinkReport], None],
        record: AuditRecorder,
        drain_s: float = DEFAULT_DRAIN_S,
    ) -> None:
        self._redirector = redirector
        self._cloud = cloud
        self._telemetry = telemetry
        self._report = report
        self._record = record
        # Old connections must have ended before the link breaks.
        self._settings = LinkSettings(drain_s=max(MIN_LEAVE_S, drain_s + QUIET_TIMEOUT_S))
        self._connector = Connector(node, tls, self._run_session, self._on_link_change)
        self._range_model = RangeModel(self._settings)
        self._links: tuple[DirectLink, ...] = ()
        self._estimators: dict[tuple[object, ...], TrajectoryEstimator] = {}
        self._unknown: dict[str, str] = {}
        self._heuristics = HeuristicRegistry()
        self._peer_message: tuple[str, Mapping[str, Any]] | None = None
        self._direct: PathMetrics | None = None
        self._rates = TrafficRates()
        self._closing = False
        self._wake = asyncio.Event()
        self._drain = ConnectionDrain(redirector, self._wake.set)
        self._previous_link = NO_LINK

    def set_links(self, links: tuple[DirectLink, ...]) -> None:
        """Set the current DirectLinks of this drone."""
        self._links = links
        self._range_model.retain(self._peer_names())
        self._wake.set()

    def on_beacon(self, node: str) -> None:
        """Handle a beacon. Anyone can send a beacon with any name."""
        if node in self._peer_names():
            self._range_model.on_beacon(node, time.monotonic())

    def _peer_names(self) -> set[str]:
        return {link.spec.node for link in self._links}

    async def run(self) -> None:
        """Decide until cancelled. Then move all traffic back and end the link."""
        try:
            while True:
                self._wake.clear()
                try:
                    await self._step()
                except (NetlinkError, RedirectFailed) as error:
                    log.warning("links: traffic not moved, retrying (error=%s)", error)
                try:
                    async with asyncio.timeout(DECISION_INTERVAL_S):
                        await self._wake.wait()
                except TimeoutError:
                    continue
        finally:
            await asyncio.shield(self._shut_down())

    async def _shut_down(self) -> None:
        try:
            async with asyncio.timeout(SHUTDOWN_DRAIN_S):
                to_cloud = dict.fromkeys(self._redirector.redirects)
                await self._redirector.switch(to_cloud, planned=self._connector.link.phase is LinkPhase.UP)
        except TimeoutError:
            log.info("links: remaining connections cut at shutdown")
        except (NetlinkError, RedirectFailed) as error:
            log.warning("links: traffic not moved back, redirects will time out (error=%s)", error)
        for on_link in (True, False):
            await self._drain.cut(on_link=on_link)
        await self._set_peer("")

    async def _step(self) -> None:
        """Make one decision and execute it."""
        # A service that is no longer planned is included until its traffic has left the link.
        services = {*virtual_endpoints(self._links), *self._redirector.redirects}
        self._redirector.set_services(services, allowed_callers(self._links))
        situation = self._situation()
        # Connections on a lost path would never finish.
        if situation.link.phase is not LinkPhase.UP:
            await self._drain.cut(on_link=True)
        if situation.cloud is None:
            await self._drain.cut(on_link=False)
        actions = decide(situation, self._settings)
        if actions.abrupt:
            await self._redirector.switch(actions.abrupt, planned=False)
        if actions.planned:
            await self._drain.begin(actions.planned)
        if self._drain.on_link:  # the link changes only after its last connection has ended
            actions = replace(actions, link=replace(actions.link, changes=False))
        self._log_decision(actions, situation)
        if actions.link.changes:
            await self._set_peer(actions.peer)
        self._send_report(actions, situation)

    async def _set_peer(self, peer: str) -> None:
        self._closing = True
        try:
            await self._connector.set_peer(peer)
        finally:
            self._closing = False

    def _situation(self) -> LinkSituation:
        now_s = time.monotonic()
        track, peers = self._track_and_peers()
        self._range_model.position = track.position if track is not None else None
        self._range_model.peers = peers
        return LinkSituation(
            now_s=now_s,
            track=track,
            traffic=tuple(self._traffic(peers)),
            link=self._connector.link,
            ranges=dict(self._range_model.ranges),
            cloud=self._cloud(),
            direct=self._direct,
            routes=self._routes(),
            redirects=self._redirector.redirects,
        )

    def _routes(self) -> dict[Endpoint, Endpoint]:
        """Return the peer's endpoint by service, for the services that current DirectLinks to the peer contain."""
        if self._peer_message is None:
            return {}
        peer, message = self._peer_message
        return _parse_routes(message, link_address(peer), [link for link in self._links if link.spec.node == peer])

    def _track_and_peers(self) -> tuple[Track | None, dict[str, Peer]]:
        """Return the track of the drone and its peers in one frame. The track follows the path of the first application by name."""
        sample = self._telemetry()
        if sample is None or not self._links:
            return None, {}
        path = min(self._links, key=_application).spec.path
        if path not in self._estimators:
            self._estimators = {path: TrajectoryEstimator(path)}
        frame, track = self._estimators[path].estimate(sample)
        peers = {}
        for link in self._links:
            spec = link.spec
            offers = PathMetrics(spec.bandwidth, spec.bandwidth, DEFAULT_LATENCY_MS, DEFAULT_LATENCY_MS, direct=True)
            peers[spec.node] = Peer(spec.node, local_position(frame, spec.position, sample), spec.range, offers)
        return track, peers

    def _traffic(self, peers: Mapping[str, Peer]) -> list[ApplicationTraffic]:
        traffic = []
        self._unknown = {}
        for application in sorted({_application(link) for link in self._links}):
            links = [link for link in self._links if _application(link) == application]
            heuristic = self._heuristic(application, links[0])
            if heuristic is None:
                continue
            serving = tuple(peers[link.spec.node] for link in links if link.spec.node in peers)
            services = frozenset(virtual_endpoints(links))
            traffic.append(ApplicationTraffic(application, heuristic, serving, services))
        return traffic

    def _heuristic(self, application: str, link: DirectLink) -> PathHeuristic | None:
        """Return the heuristic of an application.

        Return None if the heuristic is unknown: the cloud path is then used.
        """
        selected = link.spec.heuristic
        try:
            return self._heuristics.find(selected.kind, selected.metric)
        except UnknownHeuristic as error:
            self._unknown[application] = str(error)
        return None

    async def _run_session(self, session: Session) -> None:
        """Receive the peer's routes and measure the link while a session lasts.

        Raises:
            LinkLost: The peer keeps the session, but returns no heartbeats or sends no routes.
        """

        def on_message(message: Mapping[str, Any]) -> None:
            self._peer_message = (session.peer, message)
            self._wake.set()

        session.on_message = on_message
        samples_mbps: deque[float] = deque(maxlen=PROBE_SAMPLES)
        probed_mbps = 0.0
        confirmations = MAX_CONFIRMATIONS
        try:
            while True:
                try:
                    async with asyncio.timeout(ACKNOWLEDGEMENT_TIMEOUT_S):
                        while session.latency_ms is None:  # noqa: ASYNC110 (the session has no event for it)
                            await asyncio.sleep(0.01)
                except TimeoutError:
                    raise LinkLost(f"{session.peer} returns no heartbeats") from None
                peak_mbps = self._rates.peak_mbps
                confirmed = peak_mbps >= CONFIRMING_SHARE * probed_mbps
                confirmations = confirmations + 1 if confirmed else MAX_CONFIRMATIONS + 1
                if confirmations > MAX_CONFIRMATIONS:
                    probed_mbps = await session.probe()
                    confirmations = 0
                samples_mbps.append(max(peak_mbps, probed_mbps))
                rate_mbps = max(samples_mbps)
                self._direct = PathMetrics(rate_mbps, rate_mbps, session.latency_ms, session.latency_ms, direct=True)
                self._range_model.on_measurement(session.peer, self._direct)
                _log_measurement(session.peer, self._direct, first=len(samples_mbps) == 1)
                self._wake.set()
                await self._update_rates(PROBE_INTERVAL_S)
                if self._peer_message is None:
                    raise LinkLost(f"{session.peer} has sent no routes")
        finally:
            self._rates = TrafficRates()
            self._peer_message = None
            self._direct = None
            self._wake.set()

    async def _update_rates(self, duration_s: float) -> None:
        for _ in range(round(duration_s / WINDOW_S)):
            await asyncio.sleep(WINDOW_S)
            try:
                self._rates.update(time.monotonic(), self._redirector.byte_counts())
            except NetlinkError as error:
                log.debug("links: counters not read (error=%s)", error)

    def _on_link_change(self, link: LinkState, reason: str) -> None:
        now_s = time.monotonic()
        previous = self._previous_link
        self._previous_link = link
        self._record("link", {"phase": link.phase.value, "peer": link.peer or previous.peer, "reason": reason})
        if link.phase is LinkPhase.UP:
            self._range_model.on_link_up(link.peer, now_s)
        elif link.phase is LinkPhase.NONE and not self._closing:
            if previous.phase is LinkPhase.UP:
                self._range_model.on_link_lost(previous.peer, now_s)
            else:
                self._range_model.on_pairing_failed(previous.peer, now_s)
        self._wake.set()

    def _log_decision(self, actions: LinkActions, situation: LinkSituation) -> None:
        """Write one log line and one audit record for each decision that changes something."""
        changes = {"link": f"{actions.link.code}: {actions.link.reason}"} if actions.link.changes else {}
        for application, decision in actions.targets.items():
            if decision.changes:
                changes[application] = f"{decision.code}: {decision.reason}"
        for subject, reason in changes.items():
            log.info("links: decided (on=%s peer=%s): %s", subject, actions.peer or "-", reason)
        for kind, content in decision_records(actions, situation):
            self._record(kind, content)

    def _send_report(self, actions: LinkActions, situation: LinkSituation) -> None:
        self._report(
            DroneLinkReport(
                links=self._links,
                link=self._connector.link,
                actions=actions,
                direct=frozenset(self._redirector.redirects),
                measured=situation.direct,
                ranges=self._range_model.ranges,
                unknown=dict(self._unknown),
                cloud=situation.cloud,
                expected=self._range_model.expected_metrics(),
                rates=self._rates.by_service,
            )
        )


def _log_measurement(peer: str, path: PathMetrics, *, first: bool) -> None:
    level = logging.INFO if first else logging.DEBUG
    mbps = path.ingress_mbps
    latency_ms = path.ingress_latency_ms
    log.log(level, "links: measured (peer=%s mbps=%.1f latency_ms=%.1f)", peer, mbps, latency_ms)


def _application(link: DirectLink) -> str:
    return f"{link.spec.application.namespace}/{link.spec.application.name}"


def _parse_routes(
    message: Mapping[str, Any], address: IPv4Address, links: list[DirectLink]
) -> dict[Endpoint, Endpoint]:
    """Parse a peer's routes. Ignore services that its DirectLinks do not name, and invalid ports."""
    ports = message.get("routes")
    if not isinstance(ports, dict):
        return {}
    routes = {}
    for service in virtual_endpoints(links):
        port = ports.get(route_key(service))
        if isinstance(port, int) and not isinstance(port, bool) and 0 < port < 65536:
            routes[service] = Endpoint(address, port, service.protocol)
    return routes

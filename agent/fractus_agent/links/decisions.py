"""Decisions of the drone's direct links: next peer, and path of each application's traffic. Pure functions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from fractus_core.linking import (
    LearnedRange,
    LinkDecision,
    LinkPhase,
    LinkSettings,
    LinkState,
    PathDecision,
    PathHeuristic,
    PathMetrics,
    Peer,
    Track,
    choose_path,
    leaves_range,
    plan_link,
)
from fractus_core.linking.range_model import expected_range

from fractus_agent.redirector.nft_maps import Endpoint

BEACON_TIMEOUT_S = 2.0
"""Seconds without a beacon after which a peer counts as absent although it should be in range."""


@dataclass(frozen=True, slots=True)
class ApplicationTraffic:
    """Traffic of one application that may take a direct link.

    Attributes:
        application: Namespace and name of the application.
        heuristic: Scores a path for the application.
        peers: Nodes that serve the application over a link.
        services: Virtual endpoints that its components call.
    """

    application: str
    heuristic: PathHeuristic
    peers: tuple[Peer, ...]
    services: frozenset[Endpoint]


@dataclass(frozen=True, slots=True)
class LinkSituation:
    """All inputs of a decision.

    Attributes:
        now_s: Current time on a monotonic clock, in seconds.
        track: Position and expected motion of the drone, None if its position is unknown.
        traffic: Traffic by application.
        link: Current state of the direct link.
        ranges: Learned ranges by peer.
        cloud: Performance of the cloud path, None while it does not respond.
        direct: Measured performance of the link that is up, None before the first measurement.
        routes: Endpoint on the link at which the peer accepts calls, by service. Empty until the peer has sent its
            routes, and after the loss of the link.
        redirects: Current target by service.
    """

    now_s: float
    track: Track | None
    traffic: tuple[ApplicationTraffic, ...]
    link: LinkState
    ranges: Mapping[str, LearnedRange]
    cloud: PathMetrics | None
    direct: PathMetrics | None = None
    routes: Mapping[Endpoint, Endpoint] = field(default_factory=dict)
    redirects: Mapping[Endpoint, Endpoint] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class LinkActions:
    """Actions that follow from a decision. They are carried out in the order `abrupt`, `planned`, `peer`.

    Attributes:
        abrupt: New target by service, for services whose old path is lost. None is the cloud path.
        planned: New target by service, for services whose old path still works. None is the cloud path.
        peer: Peer of the link after all services have their new targets, empty for no link.
        link: Decision on the peer, with its reason.
        targets: Decision on the path of each application, with its reason.
    """

    abrupt: Mapping[Endpoint, Endpoint | None]
    planned: Mapping[Endpoint, Endpoint | None]
    peer: str
    link: LinkDecision
    targets: Mapping[str, PathDecision]


def decide(situation: LinkSituation, settings: LinkSettings) -> LinkActions:
    """Decide on the peer of the link and on the paths of all traffic. The result depends on the arguments only.

    The drone has one link, so the traffic of the first application by name decides on its peer. Other applications
    take the link if it is better for them. A link that carries traffic is left only after its traffic has been moved
    back (make before break).
    """
    link = _decide_peer(situation, settings)
    leaving = link.changes or _leaves_range(situation, settings)
    abrupt: dict[Endpoint, Endpoint | None] = {}
    planned: dict[Endpoint, Endpoint | None] = {}
    targets: dict[str, PathDecision] = {}

    def move(service: Endpoint, target: Endpoint | None) -> None:
        moves = planned if _current_path_works(service, situation) else abrupt
        moves[service] = target

    for traffic in situation.traffic:
        decision = _decide_path(traffic, situation, leaving, settings)
        targets[traffic.application] = decision
        for service in sorted(traffic.services):
            target = situation.routes.get(service) if decision.direct else None
            if situation.redirects.get(service) != target:
                move(service, target)
    planned_services = {service for traffic in situation.traffic for service in traffic.services}
    for service in situation.redirects.keys() - planned_services:
        move(service, None)
    return LinkActions(abrupt, planned, link.peer, link, targets)


def _decide_peer(situation: LinkSituation, settings: LinkSettings) -> LinkDecision:
    link = situation.link
    present = link.peer if link.phase is not LinkPhase.NONE else ""
    deciding = next((traffic for traffic in situation.traffic if traffic.peers), None)
    if deciding is None:
        return LinkDecision("", bool(present), "NotPlanned", "no application may use a direct link")
    track = situation.track
    if track is None:
        return LinkDecision(present, False, "PositionUnknown", "the position of the drone is unknown, nothing changes")
    decision = plan_link(
        track,
        [peer for peer in deciding.peers if _is_candidate(peer, track, situation)],
        situation.cloud,
        link,
        situation.now_s,
        heuristic=deciding.heuristic,
        settings=settings,
        ranges=situation.ranges,
    )
    if situation.cloud is None and link.phase is LinkPhase.UP and not decision.peer:
        return LinkDecision(present, False, "CloudSilent", "the cloud path does not respond, the link is kept")
    return decision


def _is_candidate(peer: Peer, track: Track, situation: LinkSituation) -> bool:
    """Return True if a peer is linked, has sent a recent beacon, or is too far away for beacons."""
    if peer.name == situation.link.peer and situation.link.phase is not LinkPhase.NONE:
        return True
    learned = expected_range(situation.ranges, peer.name)
    silent = situation.now_s - learned.last_beacon_s > BEACON_TIMEOUT_S
    return not silent or math.dist(track.position, peer.position) > peer.range_m * learned.range_factor


def _current_path_works(service: Endpoint, situation: LinkSituation) -> bool:
    target = situation.redirects.get(service)
    if target is None:
        return situation.cloud is not None
    return target in situation.routes.values()


def _leaves_range(situation: LinkSituation, settings: LinkSettings) -> bool:
    peers = {peer.name: peer for traffic in situation.traffic for peer in traffic.peers}
    peer = peers.get(situation.link.peer)
    if situation.track is None or peer is None:
        return False
    learned = expected_range(situation.ranges, peer.name)
    return leaves_range(situation.track, peer, learned, situation.link, settings)


def _decide_path(
    traffic: ApplicationTraffic, situation: LinkSituation, leaving: bool, settings: LinkSettings
) -> PathDecision:
    is_direct = any(service in situation.redirects for service in traffic.services)
    served = not traffic.services.isdisjoint(situation.routes)
    if situation.direct is not None and not served:
        reason = f"{situation.link.peer} has no ready instance"
        return PathDecision(False, is_direct, False, "NotServed", reason)
    return choose_path(
        traffic.heuristic,
        situation.cloud,
        situation.direct if served else None,
        is_direct=is_direct,
        leaving=leaving,
        settings=settings,
    )

"""What the drone's end does next, from all that it knows: pure, so that it is tried without radios."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from fractus_core.linking import (
    Link,
    LinkDecision,
    PathMetrics,
    Peer,
    Phase,
    Reach,
    Settings,
    TargetDecision,
    TargetHeuristic,
    Track,
    choose_target,
    leaves_reach,
    plan_link,
)
from fractus_core.linking.learning import expected

from fractus_agent.redirector.nft import Endpoint

HEARD_S = 2.0
"""A peer that should be in reach, and of which no beacon came for so long, is not there, or does not reach as far as it says."""


@dataclass(frozen=True, slots=True)
class Traffic:
    """The traffic of one application that may take a direct link.

    Attributes:
        application: namespace and name.
        heuristic: what makes a path good for it.
        peers: nodes that serve it over a link.
        services: where its components call.
    """

    application: str
    heuristic: TargetHeuristic
    peers: tuple[Peer, ...]
    services: frozenset[Endpoint]


@dataclass(frozen=True, slots=True)
class Situation:
    """All that a decision depends on.

    Attributes:
        now_s: monotonic.
        track: of the drone; None while its position is not known.
        traffic: by application.
        link: the direct link as it is.
        reaches: what was learned of peers' links, by name.
        cloud: what the cloud path offers; None while it does not answer.
        direct: what was measured of the link that is up; None before that.
        routes: where on the link its peer takes the calls to services; empty until it says so, and once the link is lost.
        redirects: where calls to services are led now.
    """

    now_s: float
    track: Track | None
    traffic: tuple[Traffic, ...]
    link: Link
    reaches: Mapping[str, Reach]
    cloud: PathMetrics | None
    direct: PathMetrics | None = None
    routes: Mapping[Endpoint, Endpoint] = field(default_factory=dict)
    redirects: Mapping[Endpoint, Endpoint] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Actions:
    """What is to be done, in this order.

    Attributes:
        abrupt: services whose path is gone, and where their calls go from now on; None for the cloud path.
        planned: services whose old path still lives, and where their calls go from now on.
        peer: which node the link should go to afterwards; empty for none.
        link: why.
        targets: why each application's traffic takes its path.
    """

    abrupt: Mapping[Endpoint, Endpoint | None]
    planned: Mapping[Endpoint, Endpoint | None]
    peer: str
    link: LinkDecision
    targets: Mapping[str, TargetDecision]


def decide(now: Situation, settings: Settings) -> Actions:
    """Decide on the link and on the paths of all traffic; the same situation gives the same actions.

    The drone has one link, so the traffic of one application decides which: that of the first by name. All others take it
    where it is better for them. A link that carries traffic is left only after that was led back (make before break).
    """
    link = _wanted(now, settings)
    leaving = link.changes or _leaves(now, settings)
    abrupt: dict[Endpoint, Endpoint | None] = {}
    planned: dict[Endpoint, Endpoint | None] = {}
    targets: dict[str, TargetDecision] = {}
    for traffic in now.traffic:
        found = targets[traffic.application] = _target(traffic, now, leaving, settings)
        for service in sorted(traffic.services):
            to = now.routes.get(service) if found.direct else None
            if now.redirects.get(service) != to:
                (planned if _lives(service, now) else abrupt)[service] = to
    for service in now.redirects.keys() - {s for traffic in now.traffic for s in traffic.services}:
        (planned if _lives(service, now) else abrupt)[service] = None
    return Actions(abrupt, planned, link.peer, link, targets)


def _wanted(now: Situation, settings: Settings) -> LinkDecision:
    """Which peer the link should go to."""
    present = now.link.peer if now.link.phase is not Phase.NONE else ""
    deciding = next((traffic for traffic in now.traffic if traffic.peers), None)
    if deciding is None:
        return LinkDecision("", bool(present), "NotPlanned", "no application's traffic may take a direct link")
    if now.track is None:
        return LinkDecision(present, False, "PositionUnknown", "where the drone is is not known, so nothing is changed")
    found = plan_link(
        now.track, [peer for peer in deciding.peers if _expected(peer, now.track, now)], now.cloud, now.link, now.now_s,
        heuristic=deciding.heuristic, settings=settings, reaches=now.reaches,
    )  # fmt: skip
    if now.cloud is None and now.link.phase is Phase.UP and not found.peer:
        return LinkDecision(present, False, "CloudSilent", "the cloud path does not answer, so the link is kept")
    return found


def _expected(peer: Peer, track: Track, now: Situation) -> bool:
    """Whether a link to a peer can be hoped for: it is there, or it is heard, or nothing of it can be heard from here yet."""
    if peer.name == now.link.peer and now.link.phase is not Phase.NONE:
        return True
    reach = expected(now.reaches, peer.name)
    silent = now.now_s - reach.heard_s > HEARD_S
    return not silent or math.dist(track.position, peer.position) > peer.range_m * reach.range_factor


def _lives(service: Endpoint, now: Situation) -> bool:
    """Whether the path that a service takes now works."""
    before = now.redirects.get(service)
    return now.cloud is not None if before is None else before in now.routes.values()


def _leaves(now: Situation, settings: Settings) -> bool:
    if now.track is None:
        return False
    peers = {peer.name: peer for traffic in now.traffic for peer in traffic.peers}
    peer = peers.get(now.link.peer)
    return peer is not None and leaves_reach(now.track, peer, expected(now.reaches, peer.name), now.link, settings)


def _target(traffic: Traffic, now: Situation, leaving: bool, settings: Settings) -> TargetDecision:
    """Which path the traffic of one application takes."""
    is_direct = any(service in now.redirects for service in traffic.services)
    served = not traffic.services.isdisjoint(now.routes)
    if now.direct is not None and not served:
        reason = f"{now.link.peer} has no ready instance"
        return TargetDecision(False, is_direct, False, "NotServed", reason)
    return choose_target(
        traffic.heuristic, now.cloud, now.direct if served else None,
        is_direct=is_direct, leaving=leaving, settings=settings,
    )  # fmt: skip

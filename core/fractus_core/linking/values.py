"""Values of direct link decisions: paths, peers, the drone's track, the link state, settings and decisions."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

LocalPosition = tuple[float, float, float]
"""East, north and up in metres in one local frame."""


@dataclass(frozen=True, slots=True)
class PathMetrics:
    """Performance of a network path for the drone's services, measured if possible, otherwise expected.

    Attributes:
        ingress_mbps: Bandwidth towards the component that provides the service, in Mbit/s.
        egress_mbps: Bandwidth from that component, in Mbit/s.
        ingress_latency_ms: One-way latency towards that component, in milliseconds.
        egress_latency_ms: One-way latency from that component, in milliseconds.
        direct: True if the path is a direct link.
    """

    ingress_mbps: float
    egress_mbps: float
    ingress_latency_ms: float
    egress_latency_ms: float
    direct: bool = False


@dataclass(frozen=True, slots=True)
class Peer:
    """A node that the drone may link to.

    Attributes:
        name: Name of the node.
        position: Position of the node in the local frame.
        range_m: Declared range of the direct link, in metres: the smaller range of the two interfaces.
        offers: Performance of the link well inside its range.
    """

    name: str
    position: LocalPosition
    range_m: float
    offers: PathMetrics


@dataclass(frozen=True, slots=True)
class Track:
    """Position of the drone and its expected motion.

    Attributes:
        position: Current position.
        speed_mps: Speed along the waypoints, in m/s (path navigation).
        waypoints: Next waypoints in the order flown (path navigation).
        velocity_mps: East, north and up velocity in m/s (region navigation, where no waypoints are known).
    """

    position: LocalPosition
    speed_mps: float = 0.0
    waypoints: tuple[LocalPosition, ...] = ()
    velocity_mps: LocalPosition = (0.0, 0.0, 0.0)


class LinkPhase(Enum):
    """Phase of the drone's direct link."""

    NONE = "none"
    CONNECTING = "connecting"
    UP = "up"


@dataclass(frozen=True, slots=True)
class LinkState:
    """State of the drone's direct link.

    Attributes:
        phase: Current phase.
        peer: Node at the other end, empty without a link.
        since_s: Start of this phase, on the clock of `now_s`.
    """

    phase: LinkPhase = LinkPhase.NONE
    peer: str = ""
    since_s: float = 0.0


NO_LINK = LinkState()


@dataclass(frozen=True, slots=True)
class LearnedRange:
    """Experience with the link to one peer, relative to its declaration.

    Attributes:
        range_factor: Real range divided by the declared range.
        rate_factor: Measured divided by declared bandwidth, well inside the range.
        last_beacon_s: Time of the last beacon on the clock of `now_s`, negative infinity before the first.
        failures: Failed attempts to connect since the link last worked.
        last_failure_s: Time of the last failed attempt, on the same clock.
    """

    range_factor: float = 1.0
    rate_factor: float = 1.0
    last_beacon_s: float = float("-inf")
    failures: int = 0
    last_failure_s: float = float("-inf")


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """Times and costs of link and path switches.

    Attributes:
        horizon_s: Planning horizon, in seconds.
        step_s: Resolution of the plan, in seconds.
        link_up_s: Time from the command to connect until the link carries traffic (thesis 8.9.1: 0.62 s).
        probe_s: Time for which a new link is measured before traffic moves to it.
        drain_s: Time before the end of the range at which traffic leaves the link, so that connections can finish.
        dwell_s: Minimum time for which a working link is kept, unless it is about to be lost.
        switch_cost_s: Cost of one change of link. The unit is one second with the best direct link instead of the
            cloud path.
        hysteresis: Share by which another path must be better than the current one.
        region_trust_s: Time for which a velocity is extrapolated in region navigation.
        edge: Share of the range inside which a link offers its full bandwidth. The bandwidth fades from there to
            the range.
    """

    horizon_s: float = 45.0
    step_s: float = 0.5
    link_up_s: float = 0.62
    probe_s: float = 0.3
    drain_s: float = 1.0
    dwell_s: float = 3.0
    switch_cost_s: float = 0.5
    hysteresis: float = 0.05
    region_trust_s: float = 8.0
    edge: float = 0.95


@dataclass(frozen=True, slots=True)
class PlanSegment:
    """Segment of a link plan: start in seconds from now, and the linked peer (empty for the cloud path alone)."""

    begin_s: float
    peer: str


@dataclass(frozen=True, slots=True)
class LinkDecision:
    """Decision on the peer of the drone's direct link.

    Attributes:
        peer: Name of the peer, empty for no link.
        changes: True if the peer differs from the peer of the current link.
        code: Reason in CamelCase, for programs.
        reason: Reason in one sentence, for people.
        plan: Expected links over the horizon.
    """

    peer: str
    changes: bool
    code: str
    reason: str
    plan: tuple[PlanSegment, ...] = field(default=())


@dataclass(frozen=True, slots=True)
class PathDecision:
    """Decision on the path of a hybrid component's traffic.

    Attributes:
        direct: True for the direct link, False for the cloud path.
        changes: True if the path differs from the current path.
        planned: True if the old path still works, so that connections may finish on it.
        code: Reason in CamelCase, for programs.
        reason: Reason in one sentence, for people.
    """

    direct: bool
    changes: bool
    planned: bool
    code: str
    reason: str

"""What decisions on direct links are made of: paths, peers, the drone's track, the state of the link, settings."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

Position = tuple[float, float, float]
"""East, north and up in metres in one local frame."""


@dataclass(frozen=True, slots=True)
class PathMetrics:
    """What a network path offers the drone's services; measured where known, else expected.

    Attributes:
        ingress_mbps: towards the component that provides the service.
        egress_mbps: from it.
        ingress_latency_ms: one way, towards the component that provides the service.
        egress_latency_ms: one way, from it.
        direct: whether the path is a direct link.
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
        name: of the node.
        position: where it stands.
        range_m: declared reach of the direct link, the lesser of both ends.
        offers: what the link offers well inside its reach.
    """

    name: str
    position: Position
    range_m: float
    offers: PathMetrics


@dataclass(frozen=True, slots=True)
class Track:
    """Where the drone is, and what is known of where it will be.

    Attributes:
        position: now.
        speed_mps: along the waypoints; for path navigation.
        waypoints: coming waypoints in the order flown; for path navigation.
        velocity_mps: east, north and up; for region navigation, where nothing else is known.
    """

    position: Position
    speed_mps: float = 0.0
    waypoints: tuple[Position, ...] = ()
    velocity_mps: Position = (0.0, 0.0, 0.0)


class Phase(Enum):
    """How far the one direct link of a drone is."""

    NONE = "none"
    CONNECTING = "connecting"
    UP = "up"


@dataclass(frozen=True, slots=True)
class Link:
    """The direct link of the drone.

    Attributes:
        phase: how far it is.
        peer: the other end; empty when there is none.
        since_s: when this phase began, on the clock of `now_s`.
    """

    phase: Phase = Phase.NONE
    peer: str = ""
    since_s: float = 0.0


NO_LINK = Link()


@dataclass(frozen=True, slots=True)
class Reach:
    """What was learned of a peer's link beside its declaration.

    Attributes:
        range_factor: real reach by declared reach.
        rate_factor: measured by offered bandwidth, well inside the reach.
        heard_s: when the peer was last heard, on the clock of `now_s`; negative infinity before.
        failures: attempts to connect that failed since the link last worked.
        failed_s: when the last of them did, on the same clock.
    """

    range_factor: float = 1.0
    rate_factor: float = 1.0
    heard_s: float = float("-inf")
    failures: int = 0
    failed_s: float = float("-inf")


@dataclass(frozen=True, slots=True)
class Settings:
    """Times and costs of switching.

    Attributes:
        horizon_s: how far ahead is planned.
        step_s: resolution of the plan.
        link_up_s: from the command to connect until the link carries traffic (thesis 8.9.1: 0.62 s).
        probe_s: for how long a new link is measured before traffic moves to it.
        drain_s: for how long connections on the old path may finish in a planned switch.
        dwell_s: a working link is kept at least for so long, unless it is about to be lost.
        switch_cost_s: what one change of link costs, in seconds of the advantage of the best direct link.
        hysteresis: by which share another target must be better than the present one.
        region_trust_s: for how long a velocity is believed in region navigation.
        edge: share of the reach inside which a link offers all; from there to the reach it fades.
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
class Segment:
    """A piece of the plan: from when on which peer is linked to; empty for the cloud path alone."""

    begin_s: float
    peer: str


@dataclass(frozen=True, slots=True)
class LinkDecision:
    """Which peer the drone's direct link should go to now, and why.

    Attributes:
        peer: empty for none.
        changes: whether that differs from the link as it is.
        code: CamelCase, for programs.
        reason: one sentence for people.
        plan: what is expected over the horizon, from now on, in seconds from now.
    """

    peer: str
    changes: bool
    code: str
    reason: str
    plan: tuple[Segment, ...] = field(default=())


@dataclass(frozen=True, slots=True)
class TargetDecision:
    """Which path the traffic of a hybrid component should take now, and why.

    Attributes:
        direct: the direct link, or else the cloud path.
        changes: whether that differs from the path as it is.
        planned: whether the old path still lives, so that connections may finish on it.
        code: CamelCase, for programs.
        reason: one sentence for people.
    """

    direct: bool
    changes: bool
    planned: bool
    code: str
    reason: str

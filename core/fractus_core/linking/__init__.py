"""Which direct link when, and which path traffic takes: pure decisions over predicted positions (thesis 8.6)."""

from fractus_core.linking.heuristics import TargetHeuristic, UnknownHeuristic, heuristic
from fractus_core.linking.horizon import plan_link
from fractus_core.linking.targets import choose_target, leaves_reach
from fractus_core.linking.values import (
    NO_LINK,
    Link,
    LinkDecision,
    PathMetrics,
    Peer,
    Phase,
    Reach,
    Segment,
    Settings,
    TargetDecision,
    Track,
)

__all__ = [
    "NO_LINK",
    "Link",
    "LinkDecision",
    "PathMetrics",
    "Peer",
    "Phase",
    "Reach",
    "Segment",
    "Settings",
    "TargetDecision",
    "TargetHeuristic",
    "Track",
    "UnknownHeuristic",
    "choose_target",
    "heuristic",
    "leaves_reach",
    "plan_link",
]

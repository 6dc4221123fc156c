"""Which direct link when, and which path traffic takes: pure decisions over predicted positions (thesis 8.6)."""

from fractus_core.linking.course import Course as Course
from fractus_core.linking.course import Seen as Seen
from fractus_core.linking.heuristics import TargetHeuristic as TargetHeuristic
from fractus_core.linking.heuristics import UnknownHeuristic as UnknownHeuristic
from fractus_core.linking.heuristics import heuristic as heuristic
from fractus_core.linking.horizon import plan_link as plan_link
from fractus_core.linking.targets import choose_target as choose_target
from fractus_core.linking.targets import leaves_reach as leaves_reach
from fractus_core.linking.values import NO_LINK as NO_LINK
from fractus_core.linking.values import Link as Link
from fractus_core.linking.values import LinkDecision as LinkDecision
from fractus_core.linking.values import PathMetrics as PathMetrics
from fractus_core.linking.values import Peer as Peer
from fractus_core.linking.values import Phase as Phase
from fractus_core.linking.values import Position as Position
from fractus_core.linking.values import Reach as Reach
from fractus_core.linking.values import Segment as Segment
from fractus_core.linking.values import Settings as Settings
from fractus_core.linking.values import TargetDecision as TargetDecision
from fractus_core.linking.values import Track as Track

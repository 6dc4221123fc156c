"""Direct link decisions: which peer to link to, and which path traffic takes (thesis 8.6).

All functions are pure. They work on predicted positions of the drone.
"""

from fractus_core.linking.heuristics import HeuristicRegistry as HeuristicRegistry
from fractus_core.linking.heuristics import PathHeuristic as PathHeuristic
from fractus_core.linking.heuristics import UnknownHeuristic as UnknownHeuristic
from fractus_core.linking.heuristics import find_heuristic as find_heuristic
from fractus_core.linking.link_planner import plan_link as plan_link
from fractus_core.linking.path_choice import choose_path as choose_path
from fractus_core.linking.path_choice import leaves_range as leaves_range
from fractus_core.linking.range_model import RangeModel as RangeModel
from fractus_core.linking.trajectory_estimator import TelemetrySample as TelemetrySample
from fractus_core.linking.trajectory_estimator import TrajectoryEstimator as TrajectoryEstimator
from fractus_core.linking.trajectory_estimator import local_position as local_position
from fractus_core.linking.values import NO_LINK as NO_LINK
from fractus_core.linking.values import LearnedRange as LearnedRange
from fractus_core.linking.values import LinkDecision as LinkDecision
from fractus_core.linking.values import LinkPhase as LinkPhase
from fractus_core.linking.values import LinkSettings as LinkSettings
from fractus_core.linking.values import LinkState as LinkState
from fractus_core.linking.values import LocalPosition as LocalPosition
from fractus_core.linking.values import PathDecision as PathDecision
from fractus_core.linking.values import PathMetrics as PathMetrics
from fractus_core.linking.values import Peer as Peer
from fractus_core.linking.values import PlanSegment as PlanSegment
from fractus_core.linking.values import Track as Track

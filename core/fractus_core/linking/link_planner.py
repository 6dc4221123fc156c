"""Receding-horizon planner for the peer of the drone's direct link.

The plan maximises the sum over time of the score of the best usable path. It uses dynamic programming over the steps
of the horizon, with one state for "no link" and one state for each peer. Leaving a link is free. A new
link takes time until it is up and measured, and until then traffic stays on the cloud path (make before break, thesis
Fig. 8.13). Each connection also has a fixed cost, so that small gains cause no switch. Complexity: O(steps x peers).

Only the first move of the plan is executed. The plan is made again whenever something changes (level-triggered).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fractus_core.linking.heuristics import PathHeuristic
from fractus_core.linking.prediction import expected_metrics, predict
from fractus_core.linking.range_model import expected_range, next_attempt_s
from fractus_core.linking.values import (
    LearnedRange,
    LinkDecision,
    LinkPhase,
    LinkSettings,
    LinkState,
    PathMetrics,
    Peer,
    PlanSegment,
    Track,
)

OUT_OF_RANGE = -math.inf


@dataclass(frozen=True, slots=True)
class Horizon:
    """Scores over the steps of the horizon. State 0 is "no link", the other states are links to the peers in order.

    Attributes:
        cloud: Score of the cloud path.
        direct: Score of each peer's link at each step, negative infinity out of range.
        connect_steps: Number of steps during which a new link carries no traffic.
        switch_cost: Cost of one change of link, in units of score times steps.
        step_s: Length of a step, in seconds.
    """

    cloud: float
    direct: tuple[tuple[float, ...], ...]
    connect_steps: int
    switch_cost: float
    step_s: float

    @property
    def steps(self) -> int:
        """Number of steps that have a score."""
        return len(self.direct[0]) if self.direct else 0

    def in_range(self, state: int, step: int) -> bool:
        """Return True if a state's link is in range at a step. Beyond the horizon every link counts as in range."""
        return not state or step >= self.steps or self.direct[state - 1][step] != OUT_OF_RANGE

    def score(self, state: int, step: int) -> float:
        """Return the score of a state at a step: the better score of its link and of the cloud path."""
        return max(self.cloud, self.direct[state - 1][step]) if state else self.cloud


@dataclass(frozen=True, slots=True)
class Solution:
    """For each step and each state: the best sum of scores from this step to the end, and the best next state."""

    values: tuple[tuple[float, ...], ...]
    moves: tuple[tuple[int, ...], ...]


def solve(horizon: Horizon) -> Solution:
    """Maximise the sum of scores, from the last step backwards."""
    states = range(len(horizon.direct) + 1)
    # Values and moves of `step` and all later steps, in reverse order of time.
    values = [tuple(0.0 for _ in states)]
    moves = [tuple(states)]
    for step in range(horizon.steps - 1, -1, -1):
        after = values[-1]
        up = min(step + horizon.connect_steps, horizon.steps)
        # All links cost the same to connect to. So every state has the same best target, except for the target itself, whose
        # best target is the second best.
        gains = {
            state: values[-(up - step)][state] + horizon.cloud * (up - step) - horizon.switch_cost
            for state in states[1:]
            if horizon.in_range(state, step) and horizon.in_range(state, up)
        }
        best = sorted(gains, key=gains.__getitem__, reverse=True)[:2]
        leave = horizon.cloud + after[0]
        row = []
        for state in states:
            stay = horizon.score(state, step) + after[state] if horizon.in_range(state, step) else OUT_OF_RANGE
            others = ((gains[target], target) for target in best if target != state)
            row.append(max((stay, state), (leave, 0), *others, key=lambda option: option[0]))
        values.append(tuple(value for value, _ in row))
        moves.append(tuple(move for _, move in row))
    return Solution(tuple(reversed(values)), tuple(reversed(moves)))


def plan_link(
    track: Track,
    peers: Sequence[Peer],
    cloud: PathMetrics | None,
    link: LinkState,
    now_s: float,
    *,
    heuristic: PathHeuristic,
    settings: LinkSettings,
    ranges: Mapping[str, LearnedRange],
) -> LinkDecision:
    """Decide which peer to link to.

    Args:
        track: Position and expected motion of the drone.
        peers: Nodes that the drone may link to.
        cloud: Performance of the cloud path, None while it does not respond.
        link: Current link state.
        now_s: Current time on a monotonic clock, in seconds.
        heuristic: Scores a path.
        settings: Times and costs of switches.
        ranges: Learned ranges by peer.

    Returns:
        The decision. The same inputs give the same decision.
    """
    present = link.peer if link.phase is not LinkPhase.NONE else ""
    usable = [
        peer
        for peer in peers
        if peer.name == present or next_attempt_s(expected_range(ranges, peer.name), linked=bool(present)) <= now_s
    ]
    names = ["", *(peer.name for peer in usable)]
    positions = predict(track, settings)
    rows = [
        [expected_metrics(peer, expected_range(ranges, peer.name), position, settings) for position in positions]
        for peer in usable
    ]
    direct = tuple(tuple(OUT_OF_RANGE if path is None else heuristic(path) for path in row) for row in rows)
    scores = [score for row in direct for score in row if score != OUT_OF_RANGE]
    base = heuristic(cloud) if cloud is not None else _score_without_path(scores)
    advantage = max(scores, default=base) - base
    # At least one step, because `solve` would otherwise compute the value of a step from that value itself.
    connect_steps = max(math.ceil((settings.link_up_s + settings.probe_s) / settings.step_s), 1)
    cost = max(advantage, 0.0) * settings.switch_cost_s / settings.step_s
    horizon = Horizon(base, direct, connect_steps, cost, settings.step_s)
    solution = solve(horizon)

    current = names.index(present) if present in names else 0
    if not current:
        best = solution.moves[0][0]
        code = "Connect" if best else "CloudOnly"
    elif link.phase is LinkPhase.CONNECTING:
        best, code = _while_connecting(current, now_s - link.since_s, horizon, solution)
    else:
        best, code = _while_up(current, now_s - link.since_s, horizon, solution, settings)
    distance_m = math.dist(positions[0], usable[best - 1].position) if best else 0.0
    reason = _REASONS[code].format(peer=names[best], present=present, distance_m=distance_m)
    return LinkDecision(
        names[best], names[best] != present, code, reason, _unroll(best, current, names, horizon, solution)
    )


def _score_without_path(scores: Sequence[float]) -> float:
    """Return the score of a step without any path. It is so low that a switch to the worst link is an improvement."""
    return min(scores, default=0.0) - max(map(abs, scores), default=0.0)


def _while_connecting(current: int, elapsed_s: float, horizon: Horizon, solution: Solution) -> tuple[int, str]:
    """Return the next state and its reason while a link comes up.

    The link is abandoned only if this gains more than a switch costs.
    """
    steps_left = min(max(horizon.connect_steps - math.floor(elapsed_s / horizon.step_s), 0), horizon.steps)
    continued = horizon.cloud * steps_left + solution.values[steps_left][current]
    if solution.values[0][0] > continued + horizon.switch_cost:
        return solution.moves[0][0], "Abandon"
    return current, "Connecting"


def _while_up(
    current: int, elapsed_s: float, horizon: Horizon, solution: Solution, settings: LinkSettings
) -> tuple[int, str]:
    """Return the next state and its reason while a link is up."""
    move = solution.moves[0][current]
    if not horizon.in_range(current, 0):
        return move, "OutOfReach"
    if elapsed_s < settings.dwell_s and move != current:
        return current, "Dwell"
    kept = horizon.score(current, 0) + solution.values[1][current]
    if solution.values[0][current] - kept <= horizon.switch_cost * settings.hysteresis:
        # An idle link costs nothing, so the drone leaves a link only for another link.
        return current, "Keep" if move == current else "Hysteresis"
    return (move, "BetterPeer") if move else (current, "Keep")


def _unroll(
    state: int, current: int, names: Sequence[str], horizon: Horizon, solution: Solution
) -> tuple[PlanSegment, ...]:
    """Return the planned links in order of time, as segments to display."""
    segments = [PlanSegment(0.0, names[state])]
    step = horizon.connect_steps if state != current else 0
    while step < horizon.steps:
        move = solution.moves[step][state]
        if move != state:
            segments.append(PlanSegment(step * horizon.step_s, names[move]))
        step += horizon.connect_steps if move not in (state, 0) else 1
        state = move
    return tuple(segments)


_REASONS = {
    "CloudOnly": "no direct link offers more than the cloud path within the horizon",
    "Connect": "{peer}, {distance_m:.0f} m away, offers more than the cloud path",
    "Connecting": "the link to {peer} is coming up",
    "Abandon": "the link to {present} is coming up, but is no longer useful",
    "OutOfReach": "the drone is out of range of {present}",
    "Keep": "the link to {peer} is the best within the horizon",
    "Dwell": "the link to {peer} has only just come up",
    "Hysteresis": "no other peer is better than {peer} by more than the switch cost",
    "BetterPeer": "{peer}, {distance_m:.0f} m away, is better than {present} from here on",
}

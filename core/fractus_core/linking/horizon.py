"""Which peer the drone's one direct link should go to now: a receding-horizon plan over predicted positions.

The plan maximises the sum over time of the score of the best path that is usable, by dynamic programming over the steps
of the horizon with one state for "no link" and one for each peer. Leaving a link costs nothing at once; connecting takes
the time to come up and to be measured, during which traffic is on the cloud path (make before break, Fig. 8.13), and a
fixed cost, so that small gains change nothing. Complexity: O(steps x peers).

Only the first move of the plan is acted on; the plan is made again whenever something changes (level-triggered).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fractus_core.linking.heuristics import TargetHeuristic
from fractus_core.linking.learning import expected, retry_s
from fractus_core.linking.prediction import offered, predict
from fractus_core.linking.values import (
    Link,
    LinkDecision,
    PathMetrics,
    Peer,
    Phase,
    Reach,
    Segment,
    Settings,
    Track,
)

UNREACHABLE = -math.inf


@dataclass(frozen=True, slots=True)
class Horizon:
    """Scores over the steps of the horizon; state 0 is "no link", the others are links to the peers in order.

    Attributes:
        cloud: score of the cloud path.
        direct: score of each peer's link at each step, minus infinity out of its reach.
        connect_steps: for how long a new link carries no traffic.
        switch_cost: what one change of link costs, in units of score times steps.
        step_s: length of a step.
    """

    cloud: float
    direct: tuple[tuple[float, ...], ...]
    connect_steps: int
    switch_cost: float
    step_s: float

    @property
    def steps(self) -> int:
        """How many steps have a score."""
        return len(self.direct[0]) if self.direct else 0

    def reaches(self, state: int, step: int) -> bool:
        """Whether a state's link is in reach at a step; beyond the horizon nothing is known against it."""
        return not state or step >= self.steps or self.direct[state - 1][step] != UNREACHABLE

    def score(self, state: int, step: int) -> float:
        """The score of a state at a step: over a link that offers less than the cloud path no traffic goes."""
        return max(self.cloud, self.direct[state - 1][step]) if state else self.cloud


@dataclass(frozen=True, slots=True)
class Solution:
    """The best that can be had from each step on in each state, and the state to go to there."""

    values: tuple[tuple[float, ...], ...]
    moves: tuple[tuple[int, ...], ...]


def solve(horizon: Horizon) -> Solution:
    """Maximise the sum of scores from the last step backwards."""
    states = range(len(horizon.direct) + 1)
    values, moves = [tuple(0.0 for _ in states)], [tuple(states)]  # of the steps from `step` on, nearest last
    for step in range(horizon.steps - 1, -1, -1):
        after = values[-1]
        up = min(step + horizon.connect_steps, horizon.steps)
        # All links cost the same to connect to, so the best one is the same from every state but its own: there it is the
        # second best.
        gains = {
            state: values[-(up - step)][state] + horizon.cloud * (up - step) - horizon.switch_cost
            for state in states[1:]
            if horizon.reaches(state, step) and horizon.reaches(state, up)
        }
        best = sorted(gains, key=gains.__getitem__, reverse=True)[:2]
        left = horizon.cloud + after[0]
        row = []
        for state in states:
            stays = horizon.score(state, step) + after[state] if horizon.reaches(state, step) else UNREACHABLE
            others = ((gains[target], target) for target in best if target != state)
            row.append(max((stays, state), (left, 0), *others, key=lambda option: option[0]))
        values.append(tuple(value for value, _ in row))
        moves.append(tuple(move for _, move in row))
    return Solution(tuple(reversed(values)), tuple(reversed(moves)))


def plan_link(
    track: Track,
    peers: Sequence[Peer],
    cloud: PathMetrics | None,
    link: Link,
    now_s: float,
    *,
    heuristic: TargetHeuristic,
    settings: Settings,
    reaches: Mapping[str, Reach],
) -> LinkDecision:
    """Decide which peer to link to.

    Args:
        track: where the drone is and will be.
        peers: nodes that it may link to.
        cloud: what the cloud path offers now; None while it does not answer.
        link: the direct link as it is.
        now_s: a monotonic clock.
        heuristic: what makes a path good.
        settings: times and costs.
        reaches: what was learned of the peers' links, by name.

    Returns:
        The decision; the same inputs give the same one.
    """
    present = link.peer if link.phase is not Phase.NONE else ""
    usable = [
        p for p in peers if p.name == present or retry_s(expected(reaches, p.name), linked=bool(present)) <= now_s
    ]
    names = ["", *(peer.name for peer in usable)]
    positions = predict(track, settings)
    rows = [[offered(peer, expected(reaches, peer.name), at, settings) for at in positions] for peer in usable]
    direct = tuple(tuple(UNREACHABLE if path is None else heuristic(path) for path in row) for row in rows)
    scores = [score for row in direct for score in row if score != UNREACHABLE]
    base = heuristic(cloud) if cloud is not None else _nothing(scores)
    advantage = max(scores, default=base) - base
    # A link that is up at once would be one of its own successors.
    connect_steps = max(math.ceil((settings.link_up_s + settings.probe_s) / settings.step_s), 1)
    cost = max(advantage, 0.0) * settings.switch_cost_s / settings.step_s
    horizon = Horizon(base, direct, connect_steps, cost, settings.step_s)
    solution = solve(horizon)

    current = names.index(present) if present in names else 0
    if not current:
        best = solution.moves[0][0]
        code = "Connect" if best else "CloudOnly"
    elif link.phase is Phase.CONNECTING:
        best, code = _while_connecting(current, now_s - link.since_s, horizon, solution)
    else:
        best, code = _while_up(current, now_s - link.since_s, horizon, solution, settings)
    away = math.dist(positions[0], usable[best - 1].position) if best else 0.0
    reason = _REASONS[code].format(peer=names[best], present=present, away=away)
    return LinkDecision(
        names[best], names[best] != present, code, reason, _unroll(best, current, names, horizon, solution)
    )


def _nothing(scores: Sequence[float]) -> float:
    """The score of no path at all: so much worse than the worst link that each of them is worth a switch."""
    return min(scores, default=0.0) - max(map(abs, scores), default=0.0)


def _while_connecting(current: int, elapsed_s: float, horizon: Horizon, solution: Solution) -> tuple[int, str]:
    """The state to go to while a link comes up, and why: abandoning it must be worth a switch."""
    left = min(max(horizon.connect_steps - math.floor(elapsed_s / horizon.step_s), 0), horizon.steps)
    continued = horizon.cloud * left + solution.values[left][current]
    if solution.values[0][0] > continued + horizon.switch_cost:
        return solution.moves[0][0], "Abandon"
    return current, "Connecting"


def _while_up(
    current: int, elapsed_s: float, horizon: Horizon, solution: Solution, settings: Settings
) -> tuple[int, str]:
    """The state to go to while a link is up, and why."""
    move = solution.moves[0][current]
    if not horizon.reaches(current, 0):
        return move, "OutOfReach"
    if elapsed_s < settings.dwell_s and move != current:
        return current, "Dwell"
    kept = horizon.score(current, 0) + solution.values[1][current]
    if solution.values[0][current] - kept <= horizon.switch_cost * settings.hysteresis:
        # An idle link costs nothing, so that a drone leaves one only for another.
        return current, "Keep" if move == current else "Hysteresis"
    return (move, "BetterPeer") if move else (current, "Keep")


def _unroll(
    state: int, current: int, names: Sequence[str], horizon: Horizon, solution: Solution
) -> tuple[Segment, ...]:
    """What the plan expects over the horizon, for people."""
    segments, step = [Segment(0.0, names[state])], horizon.connect_steps if state != current else 0
    while step < horizon.steps:
        move = solution.moves[step][state]
        if move != state:
            segments.append(Segment(step * horizon.step_s, names[move]))
        step += horizon.connect_steps if move not in (state, 0) else 1
        state = move
    return tuple(segments)


_REASONS = {
    "CloudOnly": "no direct link offers more than the cloud path within the horizon",
    "Connect": "{peer}, {away:.0f} m away, offers more than the cloud path",
    "Connecting": "the link to {peer} is coming up",
    "Abandon": "the link to {present} that is coming up would be of no use any more",
    "OutOfReach": "the drone is out of reach of {present}",
    "Keep": "the link to {peer} is the best within the horizon",
    "Dwell": "the link to {peer} has only just come up",
    "Hysteresis": "no other peer is better than {peer} by what a switch costs",
    "BetterPeer": "{peer}, {away:.0f} m away, is better than {present} from here on",
}

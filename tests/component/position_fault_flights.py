"""Faults of the position during permitted legs, in the oracle of the policy engine.

The service does not judge such a fault but stops the drone. The oracle simulates the time until the stop, and checks the true path.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from policy_flights import SLOWEST_STOP_S, STANDING_MPS, STEP_S, Flags, Fleet, Floats, Tally, excused

DISAGREEMENT_S = 1.2
"""Longest time until two fixes of a wrong GPS have disagreed with the estimate (2 Hz)."""

SAMPLE_S = 0.1
"""Longest time until the position after a jump is received and judged (20 Hz)."""

JUMP_M = (8.0, 80.0)

REACTION_S = 0.25
"""Share of the latency that is not the round trip of the link."""

SWERVE_M = 5.0
SWERVE_MPS = 20.0
"""Documented distance by which a drone may leave its course after a jump: without delay, and in addition per second of round trip."""


def swerve_m(round_trip_s: Floats) -> Floats:
    """Return how far a drone may leave its course between a jump of its estimate and the end of its stop, in metres."""
    return SWERVE_M + SWERVE_MPS * np.maximum(round_trip_s, 0.0)


@dataclass(frozen=True)
class PositionFaultFlights:
    """Simulator of position faults.

    Attributes:
        seed: Seed of the faults, which the texts of violations contain.
        every: The position of one in `every` drones fails.
    """

    seed: int
    every: int

    def fly(self, fleet: Fleet, exempt: Flags, tally: Tally) -> None:
        """Let the position of some drones on a leg fail, and report violations. The fleet is not changed.

        While a GPS (also a second one) is wrong, the estimate stays correct until the drone has stopped. A drone whose estimate
        jumps turns towards a wrong point until it stops. It may leave its course by the distance that the documentation states.
        """
        rows = np.arange(self.seed % self.every, len(fleet.scenes), self.every)
        expected = {i for _, i, _ in fleet.mail}
        moves = np.linalg.norm(fleet.speed[:, :2], axis=1) > STANDING_MPS
        rows = np.array(
            [i for i in rows if fleet.legs[i] is not None and moves[i] and i not in expected], dtype=np.int64
        )
        if not len(rows):
            return
        rng = np.random.default_rng(self.seed)
        angle = rng.uniform(0, 2 * math.pi, len(rows))
        size = rng.uniform(*JUMP_M, len(rows))
        jump = np.column_stack((np.cos(angle), np.sin(angle))) * size[:, None]
        straight = fleet.part(rows)
        allowed = exempt[rows] | excused(straight)
        glitch_s = straight.latency + rng.uniform(0, DISAGREEMENT_S, len(rows))
        _fly(straight, glitch_s, allowed, rows, tally, f"seed {self.seed}, GPS wrong")
        jump_s = straight.latency + rng.uniform(0, SAMPLE_S, len(rows))
        course = fleet.part(rows)
        jumped = fleet.part(rows)
        jumped.goal[:, :2] -= jump
        paths = [_fly(each, jump_s, allowed, rows, tally, "") for each in (course, jumped)]
        away = np.linalg.norm(paths[0] - paths[1], axis=2).max(axis=0)
        bound = swerve_m(straight.latency - REACTION_S)
        for i in np.flatnonzero(away > bound):
            tally.wrong.append(
                f"seed {self.seed}, drone {rows[i]} left its course by {away[i]:.1f} m after a jump, more than {bound[i]:.1f} m"
            )
        tally.position_faults += 2 * len(rows)


def _fly(
    fleet: Fleet,
    stop_s: Floats,
    allowed: Flags,
    rows: np.ndarray[tuple[int], np.dtype[np.int64]],
    tally: Tally,
    fault: str,
) -> Floats:
    """Fly until all drones have stopped. Return their true horizontal positions, shape (steps, drones, 2).

    Args:
        fleet: Drones with a fault.
        stop_s: Time after which each of them stops.
        allowed: Fences that each drone may violate.
        rows: Number of each drone.
        tally: Receives violations.
        fault: Text for violations; empty if the path may leave the course.
    """
    began_s = fleet.time_s
    stopped = np.zeros(len(rows), dtype=bool)
    reported = np.zeros(len(rows), dtype=bool)
    path = []
    for _ in range(int((SLOWEST_STOP_S + stop_s.max()) / STEP_S)):
        due = ~stopped & (fleet.time_s - began_s >= stop_s)
        if due.any():
            fleet.stop(np.flatnonzero(due))
            stopped |= due
        fleet.step()
        path.append(fleet.true[:, :2].copy())
        broken = (fleet.trespassing() & ~allowed).any(axis=1) & ~reported
        if fault:
            tally.wrong += [
                f"{fault}, drone {rows[i]}: breach at {fleet.true[i].round(1)}" for i in np.flatnonzero(broken)
            ]
            reported |= broken
    return np.array(path)

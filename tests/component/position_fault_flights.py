"""Faults of the position during permitted legs, in the oracle of the policy engine.

The service stops the drone after a fault with a sign. The oracle simulates the time until the stop, and checks the true path.
A drift has no sign. The drone follows it, and may enter a zone by as much as the position is wrong.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from policy_flights import (
    INCLUSION,
    LIMIT,
    LIMIT_SLACK_M,
    SLOWEST_STOP_S,
    STANDING_MPS,
    STEP_S,
    Flags,
    Fleet,
    Floats,
    Tally,
    distances,
    excused,
)

DISAGREEMENT_S = 1.2
"""Longest time until two fixes of a wrong GPS have disagreed with the estimate (2 Hz)."""

VARIANCE_S = 1.0
"""Longest time until EKF_STATUS_REPORT reports the variance of a wrong barometer."""

DRIFT_MPS = 0.5
"""Speed at which a position drifts: no sign shows it."""

DRIFT_S = 40.0
"""Duration of a drift. Most legs end before, and the drone then hovers at a position that drifts."""

SAMPLE_S = 0.1
"""Longest time until the position after a jump is received and judged (20 Hz)."""

JUMP_M = (8.0, 80.0)

REACTION_S = 0.25
"""Share of the latency that is not the round trip of the link."""

SWERVE_M = 5.0
SWERVE_MPS = 20.0
"""Documented distance by which a drone may leave its course after a jump: without delay, and in addition per second of round trip."""

FAST_SWERVE_S = 0.8
FAST_SWERVE_SHARE = 2.0
"""The same for a fast drone, as multiples of its speed: these replace the two above if they are larger.

A drone that brakes before the end of its leg may accelerate instead for the time T until its stop begins. It is then faster by
up to 2 * acceleration * T, which makes its way to stop longer by 2 * speed * T. Without delay, T is the reaction and the time
until the next position: 0.35 s. The rest covers the turn itself.
"""

SLOW_TURN_S = 0.5
SLOW_TURN_MPS = 25.0
"""Documented increase of this distance for a drone that needs longer than `SLOW_TURN_S` to undo its acceleration.

For this time, the drone still accelerates in the direction of the jump, although it already brakes. ArduCopter needs
WPNAV_ACCEL / PSC_JERK_XY: 0.5 s with its default parameters.
"""


def swerve_m(round_trip_s: Floats, turn_s: Floats, speed_mps: Floats) -> Floats:
    """Return how far a drone may leave its course between a jump of its estimate and the end of its stop, in metres.

    Args:
        round_trip_s: Delay of the link.
        turn_s: Time in which the drone undoes its acceleration.
        speed_mps: Horizontal speed at the jump.
    """
    base_m = np.maximum(SWERVE_M, FAST_SWERVE_S * speed_mps)
    late_mps = np.maximum(SWERVE_MPS, FAST_SWERVE_SHARE * speed_mps)
    slow_m = SLOW_TURN_MPS * np.maximum(turn_s - SLOW_TURN_S, 0.0)
    return base_m + late_mps * np.maximum(round_trip_s, 0.0) + slow_m


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

        While a GPS (also a second one) or the barometer is wrong, the estimate stays correct until the drone has stopped. A drone
        whose estimate jumps turns towards a wrong point until it stops. It may leave its course by the distance that the
        documentation states. A drone whose GPS or barometer drifts continues.
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
        speed = np.linalg.norm(fleet.speed[rows, :2], axis=1)
        bound = swerve_m(straight.latency - REACTION_S, straight.accels / straight.jerks, speed)
        for i in np.flatnonzero(away > bound):
            tally.wrong.append(
                f"seed {self.seed}, drone {rows[i]} left its course by {away[i]:.1f} m after a jump, more than {bound[i]:.1f} m"
            )
        barometer_s = straight.latency + rng.uniform(0, VARIANCE_S, len(rows))
        _fly(fleet.part(rows), barometer_s, allowed, rows, tally, f"seed {self.seed}, barometer wrong")
        sideways = jump / size[:, None] * rng.uniform(0, DRIFT_MPS, (len(rows), 1))
        upwards = rng.uniform(-DRIFT_MPS, DRIFT_MPS, len(rows))
        still = np.zeros(len(rows))
        for fault, rate in (
            ("GPS drifts", np.column_stack((sideways, still))),
            ("barometer drifts", np.column_stack((still, still, upwards))),
        ):
            _drift(fleet.part(rows), rate, allowed, rows, tally, f"seed {self.seed}, {fault}")
        tally.position_faults += 5 * len(rows)


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


def _drift(
    fleet: Fleet,
    rate_mps: Floats,
    allowed: Flags,
    rows: np.ndarray[tuple[int], np.dtype[np.int64]],
    tally: Tally,
    fault: str,
) -> None:
    """Fly on with an estimate that drifts. Report each drone that is deeper in a forbidden place than its estimate is wrong.

    Args:
        fleet: Drones with the fault.
        rate_mps: Speed of the drift of each drone, either horizontal or vertical, shape (drones, 3).
        allowed, rows, tally, fault: See `_fly`.
    """
    correct = fleet.error.copy()
    inside_m = heights_inside if rate_mps[:, 2].any() else depths
    reported = np.zeros(len(rows), dtype=bool)
    for _ in range(int(DRIFT_S / STEP_S)):
        fleet.step()
        fleet.error = fleet.error + rate_mps * STEP_S
        broken = fleet.trespassing() & ~allowed
        if broken.any():
            wrong_m = np.linalg.norm(fleet.error - correct, axis=1)
            deep = (broken & (inside_m(fleet) > wrong_m[:, None])).any(axis=1) & ~reported
            tally.wrong += [
                f"{fault}, drone {rows[i]}: breach at {fleet.true[i].round(1)}, the position is wrong by {wrong_m[i]:.1f} m"
                for i in np.flatnonzero(deep)
            ]
            reported |= deep


def depths(fleet: Fleet) -> Floats:
    """Return the horizontal distance that leads each drone out of each zone; in the last column, into an inclusion zone."""
    rings = np.stack([place.rings for place in fleet.scenes])
    edges = np.array([distances(point[None, :2], ring)[0] for point, ring in zip(fleet.true, rings, strict=True)])
    up = fleet.true[:, 2:]
    permits = (fleet.kinds == INCLUSION) & (fleet.bands[..., 0] <= up) & (up <= fleet.bands[..., 1])
    return np.column_stack((edges, np.where(permits, edges, np.inf).min(axis=1)))


def heights_inside(fleet: Fleet) -> Floats:
    """Return the climb or descent that leads each drone out of each violated zone; in the last column, into an inclusion zone."""
    up = fleet.true[:, 2:]
    floors = fleet.bands[..., 0]
    ceilings = fleet.bands[..., 1]
    leave = np.minimum(up - floors, ceilings - up)
    comply = np.maximum(fleet.limits[..., 0] - LIMIT_SLACK_M - up, up - fleet.limits[..., 1] - LIMIT_SLACK_M)
    leave = np.where(fleet.kinds == LIMIT, np.minimum(leave, comply), leave)
    permits = (fleet.kinds == INCLUSION) & fleet.walls.around(fleet.true[:, :2])
    enter = np.where(permits, np.maximum(np.maximum(floors - up, up - ceilings), 0.0), np.inf)
    return np.column_stack((leave, enter.min(axis=1)))

"""Setpoints in quick succession: the engine considers all possible arrival times of pending setpoints."""

from __future__ import annotations

import math
import random

import pytest
import shapely
from fractus_core.policy.decision_types import Call, Situation, VelocityArgs
from fractus_core.policy.engine import judge
from fractus_core.policy.kinematics import motion_before_reaction, stop_point, velocity_leg
from policy_world import at, box, compiled, exclusion, goto

Velocity = tuple[float, float]
STEP_S = 0.02
BRAKES = -2.5


def flown(rng: random.Random, now: Situation, pending: list[Velocity], requested: VelocityArgs) -> list[Velocity]:
    """Return positions of a drone that receives the setpoints at random times within the latency, and then stops."""
    moments = sorted(rng.choice([0.0, rng.uniform(0, now.latency_s), now.latency_s]) for _ in (*pending, requested))
    velocities = [
        (0.0, 0.0) if now.forward_mps2 == BRAKES else (now.east_mps, now.north_mps),
        *((e, n) for n, e in pending),
        (requested.east_mps, requested.north_mps),
        (0.0, 0.0),
    ]
    moments.append(rng.choice([requested.hold_s, requested.hold_s + now.latency_s]))
    x = 0.0
    y = 0.0
    vx = now.east_mps
    vy = now.north_mps
    time_s = 0.0
    places = []
    while time_s < moments[-1] or math.hypot(vx, vy) > 0.05:
        tx, ty = velocities[sum(moment <= time_s for moment in moments)]
        change = math.hypot(tx - vx, ty - vy)
        share = min(now.airframe.accel_mps2 * STEP_S / change, 1.0) if change else 0.0
        vx = vx + (tx - vx) * share
        vy = vy + (ty - vy) * share
        x = x + vx * STEP_S
        y = y + vy * STEP_S
        time_s = time_s + STEP_S
        places.append((x, y))
    return places


def direction(rng: random.Random, fast: float) -> Velocity:
    angle = rng.uniform(0, 2 * math.pi)
    speed = rng.choice([0.0, fast, rng.uniform(0, fast)])
    return speed * math.cos(angle), speed * math.sin(angle)


@pytest.mark.parametrize("seed", range(4))
def test_velocity_leg_contains_the_flown_path_with_pending_setpoints(seed: int) -> None:
    rng = random.Random(seed)
    furthest_m = 0.0
    missed_m = 0.0
    for _ in range(150):
        north, east = direction(rng, 9.0)
        pending = [direction(rng, 12.0) for _ in range(rng.choice([1, 1, 2, 3, 7]))]
        now = at(
            0, 0, north_mps=north, east_mps=east, latency_s=rng.choice([0.3, 0.8, 1.5]), speed_setpoint_mps=12.0,
            forward_mps2=rng.choice([None, 0.0, BRAKES]), pending=tuple((n, e, 0.0) for n, e in pending),
        )  # fmt: skip
        n, e = direction(rng, 12.0)
        requested = VelocityArgs(n, e, hold_s=rng.choice([0.3, 0.5, 1.0]))
        places = shapely.points(flown(rng, now, pending, requested))
        holds = velocity_leg(now, (0.0, 0.0), requested).ground
        furthest_m = max(furthest_m, float(shapely.distance(holds, places).max()))
        blind = Situation(**{f: getattr(now, f) for f in Situation.__slots__ if f != "pending"})
        missed_m = max(
            missed_m, float(shapely.distance(velocity_leg(blind, (0.0, 0.0), requested).ground, places).max())
        )
    assert furthest_m < now.airframe.tracking_m, "legs keep a larger margin than this deviation"
    assert missed_m > 2.0, "a leg that ignores the pending setpoints does not contain the path"


def test_pending_setpoint_may_end_braking() -> None:
    braking = at(0, 0, east_mps=8, forward_mps2=-2.5, latency_s=0.5)
    pending_turn = at(0, 0, east_mps=8, forward_mps2=-2.5, latency_s=0.5, pending=((0.0, 8.0, 0.0),))
    stopped = at(0, 0, east_mps=8, forward_mps2=-2.5, latency_s=0.5, pending=((0.0, 0.0, 0.0),))
    assert motion_before_reaction(pending_turn).speed_mps == 8.0
    assert motion_before_reaction(stopped).speed_mps == motion_before_reaction(braking).speed_mps < 7.0
    assert stop_point(pending_turn, (0.0, 0.0))[0] > stop_point(braking, (0.0, 0.0))[0] + 3.0


def test_drone_with_pending_setpoint_counts_as_moving() -> None:
    assert not at(0, 0).is_moving
    assert at(0, 0, pending=((5.0, 0.0, 0.0),)).is_moving
    assert not at(0, 0, pending=((0.0, 0.0, 0.0),)).is_moving


def test_goto_is_judged_with_pending_setpoints() -> None:
    grant = compiled(exclusion(box(-30, 3.5, 30, 30)))
    aside = goto(30, 0, speed_mps=5.0)
    assert judge(aside, at(0, 0), grant).permits
    verdict = judge(aside, at(0, 0, latency_s=0.8, pending=((9.0, 0.0, 0.0),)), grant)
    assert not verdict.permits or verdict.brake_first


def test_denied_setpoint_stays_denied_after_the_next_setpoint() -> None:
    grant = compiled(exclusion(box(-30, 30, 30, 60)))
    call = Call("SetVelocity", VelocityArgs(9.0, 0.0, hold_s=1.0))
    hot = at(0, 4, north_mps=8.9, forward_mps2=-2.0, latency_s=0.5, speed_setpoint_mps=9.0, pending=((9.0, 0.0, 0.0),))
    assert not judge(call, hot, grant).permits

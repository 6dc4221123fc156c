"""Thin zones: a leg may cross a zone only if the drone certainly cannot stop before the zone.

It is not sufficient that the drone would come to rest behind the zone.
"""

from __future__ import annotations

import math

import pytest
from depth import examples
from fractus_core.policy.decision_types import Airframe, Call, Situation, VelocityArgs
from fractus_core.policy.engine import judge
from hypothesis import given, settings
from hypothesis import strategies as st
from policy_world import at, box, compiled, exclusion, goto, policy, zone

RETRACES = Airframe(retraces=True)


@settings(max_examples=examples(400), deadline=None)
@given(
    thick=st.floats(0.2, 8.0),
    speed=st.floats(0.5, 14.0),
    away=st.floats(0.05, 60.0),
    latency=st.sampled_from([0.05, 0.3, 1.0, 1.8]),
    forward=st.sampled_from([None, -2.5, -1.0, 0.0, 2.5]),
    beyond=st.floats(0.0, 30.0),
    velocity=st.booleans(),
)
def test_leg_through_thin_zone_is_allowed_only_when_the_drone_cannot_stop_before_it(
    thick: float, speed: float, away: float, latency: float, forward: float | None, beyond: float, velocity: bool
) -> None:
    grant = compiled(exclusion(box(-60, away, 60, away + thick)), operationArea=[])
    now: Situation = at(
        0, 0, north_mps=speed, latency_s=latency, forward_mps2=forward, airframe=RETRACES, speed_setpoint_mps=max(speed, 5.0)
    )  # fmt: skip
    call = (
        Call("SetVelocity", VelocityArgs(speed, 0.0, hold_s=2.0)) if velocity else goto(0, away + thick + 5.0 + beyond)
    )
    verdict = judge(call, now, grant)
    if verdict.permits and not verdict.brake_first:
        flown = verdict.args
        if isinstance(flown, VelocityArgs) and math.hypot(flown.north_mps, flown.east_mps) < speed - 0.1:
            return  # the velocity was scaled so that the drone stays before the zone
        reach = speed * speed / (2 * now.airframe.accel_mps2)
        assert reach >= away or (velocity and away > reach + 2.0 * speed), "the drone could stop before the zone"


@pytest.mark.parametrize("thick", [0.5, 2.0, 4.0])
def test_drone_that_certainly_enters_thin_zone_may_leave_on_the_far_side(thick: float) -> None:
    grant = compiled(exclusion(box(-60, 5, 60, 5 + thick)), operationArea=[])
    now = at(0, 0, north_mps=9.0, forward_mps2=0.0, airframe=RETRACES)
    assert judge(goto(0, 60), now, grant).permits


def test_drone_inside_thin_zone_may_leave_it() -> None:
    grant = compiled(exclusion(box(-60, -1, 60, 1)), operationArea=[])
    for end in (30, -30):
        assert judge(goto(0, end), at(0, math.copysign(0.2, end), airframe=RETRACES), grant).permits


@settings(max_examples=examples(200), deadline=None)
@given(
    gap=st.floats(0.2, 6.0),
    speed=st.floats(0.5, 14.0),
    away=st.floats(0.05, 60.0),
    latency=st.sampled_from([0.05, 0.3, 1.0, 1.8]),
    forward=st.sampled_from([None, -2.5, 0.0, 2.5]),
)
def test_leg_across_gap_is_allowed_only_when_the_drone_cannot_stop_before_it(
    gap: float, speed: float, away: float, latency: float, forward: float | None
) -> None:
    start = box(-60, -60, 60, away)
    end = box(-60, away + gap, 60, 200)
    now: Situation = at(
        0, 0, north_mps=speed, latency_s=latency, forward_mps2=forward, airframe=RETRACES, speed_setpoint_mps=max(speed, 5.0)
    )  # fmt: skip
    grants = (
        compiled(policy("in", "GeofenceControl", "inclusion", [zone("a", start), zone("b", end)]), operationArea=[]),
        compiled(operationArea=[start, end]),
    )
    for grant in grants:
        verdict = judge(goto(0, away + gap + 40.0), now, grant)
        if verdict.permits and not verdict.brake_first:
            assert speed * speed / (2 * now.airframe.accel_mps2) >= away, "the drone could stop before the zone"

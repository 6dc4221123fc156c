"""Legs that a moving drone cannot begin legally.

If the stop and a leg from standstill are both legal, the drone stops before the leg.
"""

from __future__ import annotations

import math
from typing import Any

import pytest
from fractus_core.geo import areas_of_shape, corridor
from fractus_core.policy.compiled_grant import CompiledGrant
from fractus_core.policy.decision_types import Airframe, GotoArgs, Situation
from fractus_core.policy.engine import judge
from fractus_core.policy.kinematics import stop_point
from policy_world import FRAME, altitude, ask, at, box, compiled, exclusion, goto, inclusion, ring, zone


def lane(radius_m: float, *points: tuple[float, float], **changes: Any) -> CompiledGrant:
    from fractus_core.api.geometry import Point

    line = [Point(lat=lat, lon=lon) for lat, lon in (FRAME.latlon(*p) for p in points)]
    areas = [a.to_dict() for a in areas_of_shape(FRAME, corridor(FRAME, line, radius_m))]
    return compiled(operationArea=areas, **changes)


def test_goto_turning_back_in_narrow_corridor_brakes_first() -> None:
    grant = lane(7.0, (0, 0), (0, 80), (60, 80))
    assert judge(goto(50, 80), at(0.5, 79), grant).brake_first is False
    hot = judge(goto(50, 80), at(0.5, 74, north_mps=5), grant)
    assert (hot.action, hot.brake_first) == ("allow", True), "a turn onto the leg would cut the corner"
    beyond = judge(goto(50, 80), at(0.5, 78, north_mps=5), grant)
    assert (beyond.action, beyond.brake_first) == ("deny", False), "the drone cannot even stop inside"
    earlier = at(0.5, 64, north_mps=5)
    straight_back = judge(goto(0, 10), earlier, grant)
    assert (straight_back.action, straight_back.brake_first) == ("allow", False), (
        "the drone reverses on its own path, so it makes no turn"
    )
    turning = judge(goto(40, 80), at(0, 68, north_mps=5, east_mps=0.3), grant)
    assert turning.permits
    assert turning.brake_first
    assert isinstance(turning.args, GotoArgs)


def test_goto_after_stop_gets_the_verdict_of_a_goto_from_standstill() -> None:
    grant = compiled(exclusion(box(10, 15, 30, 30)), altitude(upperLimit=15))
    moving = at(0, 0, east_mps=5)
    verdict = ask(grant, goto(0, 60, 40), moving)
    assert (verdict.action, verdict.code, verdict.brake_first) == ("correct", "AltitudeAboveLimit", True)
    x, y = stop_point(moving, (0.0, 0.0))
    again = ask(grant, goto(0, 60, 40), at(x, y))
    assert (again.action, again.args, again.brake_first) == (verdict.action, verdict.args, False)


def test_goto_with_wide_turn_causes_no_takeover() -> None:
    grant = compiled(exclusion(box(10, 15, 30, 30), "land"))
    assert ask(grant, goto(0, 60), at(0, 0, east_mps=5)).brake_first
    through = ask(grant, goto(20, 60), at(0, 0, east_mps=5))
    assert (through.action, through.takeover, through.brake_first) == ("takeover", "land", True)
    assert ask(grant, goto(20, 20), at(0, 0)).brake_first is False


def test_goto_is_denied_when_the_stop_violates_a_fence() -> None:
    ahead = compiled(exclusion(box(12, -20, 30, 20)))
    verdict = ask(ahead, goto(60, 60), at(0, 0, east_mps=9))
    assert not verdict.permits
    assert not verdict.brake_first


def test_goto_prefers_whole_leg_after_stop_to_shortened_leg() -> None:
    grant = compiled(exclusion(box(10, 15, 30, 30), "adjust"))
    verdict = ask(grant, goto(0, 60), at(0, 0, east_mps=5))
    assert verdict.brake_first
    assert verdict.action == "allow"
    through = ask(grant, goto(20, 22), at(-10, 0))
    assert (through.code, through.brake_first) == ("LegShortened", False)


@pytest.mark.parametrize("speed", [0.6, 2.0, 5.0, 8.0])
def test_stops_before_a_leg_end_at_legal_positions(speed: float) -> None:
    grant = compiled(exclusion(box(10, 15, 30, 30)), inclusion(box(-40, -40, 60, 80)), operationArea=[])
    offered = 0
    for degrees in range(0, 360, 15):
        heading = math.radians(degrees)
        now: Situation = at(3, 3, east_mps=speed * math.cos(heading), north_mps=speed * math.sin(heading))
        verdict = ask(grant, goto(0, 60), now)
        if verdict.brake_first:
            offered += 1
            x, y = stop_point(now, (3.0, 3.0))
            assert ask(grant, goto(0, 60), at(x, y)).action == "allow"
    assert offered or speed != 5


RETRACES = Airframe(retraces=True)
"""Airframe that returns along its outbound path. No request is then denied because of a blocked return."""


@pytest.mark.parametrize(
    ("corners", "start", "velocity", "end", "cruise"),
    [
        ([(2.1, 25.2), (-5.0, 24.5), (-6.5, 19.4), (-0.9, 18.3)], (0, 0), (-0.77, 7.12), (-15.2, 52), 9.9),
        ([(-6.1, 69.1), (-35.6, 79.5), (-48.8, 50.1), (-20.3, 45.2)], (-7.2, 79.3), (-0.3, -3.7), (-29.4, -12), 5.6),
    ],
)
def test_goto_through_zone_is_denied_when_the_drone_may_stop_before_it(
    corners: list[tuple[float, float]],
    start: tuple[float, float],
    velocity: tuple[float, float],
    end: tuple[float, float],
    cruise: float,
) -> None:
    grant = compiled(exclusion(ring(corners)), operationArea=[])
    east, north = velocity
    hot = at(*start, east_mps=east, north_mps=north, airframe=RETRACES)
    refused = ask(grant, goto(*end, speed_mps=cruise), hot)
    assert (refused.action, refused.policies) == ("deny", ("no-fly",))
    away = goto(start[0] - 3 * east, start[1] - 3 * north)
    assert ask(grant, away, at(*start, airframe=RETRACES)).action == "allow", (
        "the drone at rest may fly away from the zone"
    )


def test_goto_outside_area_is_denied_when_the_drone_may_stop_inside() -> None:
    area = box(-50, -50, 20, 50)
    for grant in (compiled(operationArea=[area]), compiled(inclusion(area), operationArea=[])):
        leg = goto(10, 40, speed_mps=9.0)
        assert not ask(grant, leg, at(6, 0, east_mps=5)).permits, (
            "the drone may already accelerate outside, or may stop inside the area"
        )
        assert ask(grant, leg, at(14, 0, east_mps=5)).permits, (
            "the drone enters the margin even if it stops, and the leg leads back"
        )


def test_goto_at_higher_speed_needs_wider_turn() -> None:
    grant = compiled(exclusion(box(6, 10, 30, 30)))
    slow = ask(grant, goto(0, 60), at(0, -2, east_mps=1.5, speed_setpoint_mps=1.0))
    assert (slow.action, slow.brake_first) == ("allow", False)
    fast = ask(grant, goto(0, 60, speed_mps=15.0), at(0, -2, east_mps=1.5, speed_setpoint_mps=1.0))
    assert fast.brake_first or not fast.permits


def test_goto_of_accelerating_drone_needs_more_room() -> None:
    steady = stop_point(at(east_mps=4, speed_setpoint_mps=4), (0.0, 0.0))[0]
    known = stop_point(at(east_mps=4, speed_setpoint_mps=9, forward_mps2=0.0), (0.0, 0.0))[0]
    unknown = stop_point(at(east_mps=4, speed_setpoint_mps=9), (0.0, 0.0))[0]
    measured = stop_point(at(east_mps=4, speed_setpoint_mps=9, forward_mps2=2.5), (0.0, 0.0))[0]
    slowing = stop_point(at(east_mps=4, speed_setpoint_mps=9, forward_mps2=-2.5), (0.0, 0.0))[0]
    assert steady == known
    assert slowing < known - 2
    assert unknown == measured > steady + 3
    # Numerical integration: latency, jerk-limited end of the acceleration, then ArduPilot's stopping distance.
    x = 0.0
    v = 4.0
    a = 2.5
    t = 0.0
    while t < 0.3 or a > 0:
        a = a if t < 0.3 else max(a - 5.0 * 1e-4, 0.0)
        x = x + v * 1e-4
        v = v + a * 1e-4
        t = t + 1e-4
    x += v * 0.25 + 1.25 + v * v / 5
    assert unknown == pytest.approx(x, abs=0.05)


def test_goto_leaves_room_for_a_stop_during_the_turn() -> None:
    grant = compiled(exclusion(box(14, 7.5, 40, 30)))
    now = at(0, 0, east_mps=6, speed_setpoint_mps=6)
    leg = ask(grant, goto(-6, 60), now)
    assert leg.brake_first or not leg.permits, "a stop in the middle of the turn would end in the zone's margin"


@pytest.mark.parametrize("target", [(0, -50), (40, 0)])
def test_stop_before_leg_enters_no_zone_at_forbidden_altitude(target: tuple[float, float]) -> None:
    low = compiled(altitude("low", [zone("ahead", box(-20, 12, 20, 60))], upperLimit=10))
    flying = at(alt=20, north_mps=8, speed_setpoint_mps=8)
    assert ask(low, goto(*target, 20), flying).code == "AltitudeAboveLimit"
    assert not ask(low, goto(*target, 20), flying).permits, "the drone would stop in the zone"
    assert ask(low, goto(*target, 20), at(alt=20)).action == "allow"
    assert ask(low, goto(*target, 8), at(alt=8, north_mps=8, speed_setpoint_mps=8)).permits
    terrain = altitude("terrain", [zone("ahead", box(-20, 12, 20, 60))], upperLimit=10, altitudeReference="terrain")
    assert not ask(compiled(terrain), goto(*target, 20), flying).permits

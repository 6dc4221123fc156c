"""Motion monitor: prevented violations and permitted motion."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
from fractus_core.policy.decision_types import GotoArgs, SetSpeedArgs, Verdict
from fractus_core.policy.engine import judge
from fractus_core.policy.monitoring import monitor
from policy_world import NOW, altitude, at, box, compiled, exclusion, goto, inclusion, speed

WALL = box(-50, 50, 50, 90)


def test_monitor_permits_motion_without_violation() -> None:
    grant = compiled(exclusion(WALL), altitude(upperLimit=30), speed(upperLimit=10))
    assert monitor(at(), grant) is None
    assert monitor(at(0, 20, north_mps=5), grant) is None
    assert monitor(at(0, 60, in_air=False), grant) is None, "the monitor ignores a drone on the ground"


def test_monitor_stops_drone_while_it_can_still_brake() -> None:
    grant = compiled(exclusion(WALL))
    for y in range(10, 60):
        verdict = monitor(at(0, float(y), north_mps=8), grant)
        if verdict is not None:
            assert (verdict.action, verdict.takeover, verdict.code) == ("deny", "hover", "ExclusionZoneAhead")
            stop = 8 * (0.3 + 0.25) + 1.25 + 64 / 5
            assert 50 - stop - 3 < y < 50 - stop + 1, "the drone stops neither too early nor too late"
            return
    raise AssertionError("it never braked")


@pytest.mark.parametrize("action", ["hover", "land", "returnToLaunch", "abort", "revoke"])
def test_monitor_takes_over_by_action_of_policy(action: str) -> None:
    grant = compiled(exclusion(WALL, action))
    for state in (at(0, 70), at(0, 40, north_mps=8)):
        verdict = monitor(state, grant)
        assert verdict is not None
        assert (verdict.action, verdict.takeover, verdict.policies) == ("takeover", action, ("no-fly",))


def test_monitor_takes_over_by_most_restrictive_policy() -> None:
    grant = compiled(exclusion(WALL, "hover", "a"), exclusion(WALL, "revoke", "b"), exclusion(WALL, "ignore", "c"))
    verdict = monitor(at(0, 70), grant)
    assert verdict is not None
    assert verdict.policies == ("b",)


def test_monitor_lets_drone_inside_zone_hover_or_leave_but_not_go_deeper() -> None:
    grant = compiled(exclusion(WALL))
    assert monitor(at(0, 55), grant) is None
    assert monitor(at(0, 55, north_mps=-4), grant) is None
    deeper = monitor(at(0, 55, north_mps=4), grant)
    assert deeper is not None
    assert deeper.code == "InsideExclusionZone"


def test_monitor_respects_altitude_bands_and_validity_windows() -> None:
    assert monitor(at(0, 70, 40), compiled(exclusion(WALL, "land", upper=20))) is None
    falling = at(0, 70, 26, down_mps=4)
    verdict = monitor(falling, compiled(exclusion(WALL, "land", upper=20)))
    assert verdict is not None, "the drone sinks into the zone"
    future = compiled(exclusion(WALL, "land", validFrom="2026-06-01T12:00:10Z"))
    assert monitor(at(0, 70), future) is None
    assert monitor(replace(at(0, 70), time_s=NOW + 11), future) is not None


def test_monitor_stops_drone_leaving_operation_area_or_inclusion_zone() -> None:
    leaving = monitor(at(0, 190, north_mps=6), compiled())
    assert leaving is not None
    assert (leaving.action, leaving.code) == ("deny", "OperationAreaBorderAhead")
    assert monitor(at(0, 190, north_mps=-6), compiled()) is None
    inclusion_grant = compiled(inclusion(box(-50, -50, 50, 50), "returnToLaunch"))
    verdict = monitor(at(0, 45, north_mps=6), inclusion_grant)
    assert verdict is not None
    assert (verdict.code, verdict.takeover) == ("InclusionBorderAhead", "returnToLaunch")


def test_monitor_stops_system_flight_only_if_it_increases_a_violation() -> None:
    inclusion_grant = compiled(inclusion(box(-50, -50, 50, 50), "land"))
    out = compiled(exclusion(WALL, "revoke"))
    for state, grant, code in (
        (at(0, 45, north_mps=6), inclusion_grant, "InclusionBorderAhead"),
        (at(0, 60, north_mps=6), inclusion_grant, "OutsideInclusionZone"),
        (at(0, 40, north_mps=6), out, "ExclusionZoneAhead"),
        (at(0, 55, north_mps=6), out, "InsideExclusionZone"),
        (replace(at(), lat=None), out, "PositionUnknown"),
    ):
        verdict = monitor(state, grant, system_flies=True)
        assert verdict is not None
        assert (verdict.action, verdict.code) == ("takeover", code)
    for state, grant in (
        (at(0, 60), inclusion_grant),
        (at(0, 60, north_mps=-6), inclusion_grant),
        (at(0, 55, north_mps=-6), out),
    ):
        assert monitor(state, grant, system_flies=True) is None, "the motion leads back"
        assert monitor(state, grant) is not None


def test_monitor_detects_zone_ahead_while_leaving_another() -> None:
    around = exclusion(box(-50, -50, 50, 10), "revoke", "around")
    ahead = exclusion(WALL, "ignore", "ahead")
    verdict = monitor(at(0, 8, north_mps=12), compiled(around, ahead), system_flies=True)
    assert verdict is None
    verdict = monitor(at(0, 9.5, north_mps=16), compiled(around, ahead), system_flies=True)
    assert verdict is not None
    assert verdict.policies == ("ahead",)


@pytest.mark.parametrize("forward_mps2", [None, 0.0, -2.5])
def test_drone_flying_into_zone_brakes_before_a_new_command(forward_mps2: float | None) -> None:
    grant = compiled(exclusion(WALL))
    toward_home = goto(0, 0)
    heading = replace(at(0, 29, north_mps=7.5), forward_mps2=forward_mps2)
    verdict = judge(toward_home, heading, grant)
    assert (verdict.permits, verdict.brake_first) == (True, True)
    assert judge(toward_home, at(0, 29), grant).brake_first is False
    assert judge(toward_home, at(0, 29, north_mps=-7.5), grant).brake_first is False
    assert judge(toward_home, at(0, 10, north_mps=7.5), grant).brake_first is False


def test_monitor_corrects_altitude_and_speed() -> None:
    grant = compiled(altitude(upperLimit=15), speed(upperLimit=5))
    high = monitor(at(alt=18), grant)
    assert high is not None
    assert isinstance(high.args, GotoArgs)
    assert (high.action, high.args.alt, high.policies) == ("correct", 14.8, ("altitudes",))
    assert monitor(at(alt=15.5), grant) is None, "the excess is within the tolerance"
    fast = monitor(at(north_mps=9), grant)
    assert fast is not None
    assert fast.args == SetSpeedArgs(4.5)
    assert monitor(at(north_mps=5.5), grant) is None


@pytest.mark.parametrize(
    ("height_m", "down_mps", "reason"),
    [
        (18.0, 0.1, "the drone is at 18.0 m, above the limit of 15.0 m"),
        (18.0, -1.0, "the drone climbs to"),
        (2.0, 0.0, "the drone is at 2.0 m, below the limit of 8.0 m"),
        (4.0, 1.0, "the drone sinks to"),
    ],
)
def test_monitor_reports_climb_or_descent_only_of_drone_that_climbs_or_sinks(
    height_m: float, down_mps: float, reason: str
) -> None:
    verdict = monitor(at(alt=height_m, down_mps=down_mps), compiled(altitude(lowerLimit=8, upperLimit=15)))
    assert verdict is not None
    assert verdict.reason.startswith(reason)


def test_known_altitude_limit_applies_despite_limit_of_unknown_datum() -> None:
    grant = compiled(altitude(upperLimit=15), altitude("terrain", lowerLimit=5, altitudeReference="terrain"))
    high = monitor(at(alt=18), grant)
    assert high is not None
    assert (high.action, high.code, high.policies) == ("correct", "AltitudeAboveLimit", ("altitudes",))
    assert monitor(at(alt=10), grant) is None
    climbing = monitor(at(alt=10, down_mps=-2), grant)
    assert climbing is not None
    assert (climbing.action, climbing.code, climbing.takeover) == ("deny", "TerrainUnknown", "hover")


def test_monitor_takes_over_when_position_is_unknown() -> None:
    for state in (replace(at(), lat=None), at(north_mps=math.nan)):
        verdict = monitor(state, compiled())
        assert verdict is not None
        assert (verdict.action, verdict.takeover) == ("takeover", "hover")


def test_monitor_takeover_of_fast_drone_brakes_first() -> None:
    grant = compiled(exclusion(WALL, "returnToLaunch"))
    fast = monitor(at(0, 40, north_mps=8), grant)
    slow = monitor(at(0, 70), grant)
    assert fast is not None
    assert slow is not None
    assert (fast.brake_first, slow.brake_first) == (True, False)


def test_monitor_stops_drone_creeping_over_border() -> None:
    creeping = monitor(at(0, 49.9, north_mps=0.3), compiled(exclusion(WALL)))
    assert creeping is not None
    assert (creeping.action, creeping.takeover) == ("deny", "hover")
    out = monitor(at(0, 49.9, north_mps=0.3), compiled(inclusion(box(-50, -50, 50, 50)), operationArea=[]))
    assert out is not None


def test_monitor_ignores_lower_limits_while_landing() -> None:
    grant = compiled(altitude(lowerLimit=8, upperLimit=30))
    low = monitor(at(alt=4), grant)
    assert low is not None
    assert isinstance(low.args, GotoArgs)
    assert (low.action, low.code, low.args.alt) == ("correct", "AltitudeBelowLimit", 8.2)
    assert monitor(at(alt=4, vertical=True), grant) is None
    assert monitor(at(alt=7), grant) is None, "the deviation is within the tolerance of the autopilot"


def test_monitor_correction_never_leads_into_zone() -> None:
    under = exclusion(box(-50, -50, 50, 50), upper=20, name="under")
    stuck = monitor(at(alt=30), compiled(under, altitude(upperLimit=15)))
    assert stuck is not None
    assert (stuck.action, stuck.takeover, stuck.args) == ("deny", "hover", None)


def test_monitor_handles_zone_appearing_around_drone() -> None:
    for action, want in (("ignore", None), ("hover", "hover"), ("land", "land"), ("revoke", "revoke")):
        verdict = monitor(at(0, 70, north_mps=-4), compiled(exclusion(WALL, action)))
        assert (verdict.takeover if verdict else None) == want, (
            "a drone on its way out is stopped only if the policy has a takeover action"
        )
    deeper = monitor(at(0, 60, north_mps=6), compiled(exclusion(WALL, "adjust")))
    assert deeper is not None
    assert (deeper.action, deeper.takeover) == ("deny", "hover")


def test_monitor_permits_climb_to_allowed_altitude_despite_link_latency() -> None:
    grant = compiled(altitude(upperLimit=16))
    leg = goto(100, 0, 16.0).args
    assert isinstance(leg, GotoArgs)
    climbing = at(0, 0, 12.0, down_mps=-2.6, latency_s=0.77)
    assert monitor(climbing, grant, current_leg=leg) is None
    assert correction(monitor(climbing, grant)) == "AltitudeAboveLimit"
    past = at(0, 0, 17.5, down_mps=-2.6, latency_s=0.77)
    assert correction(monitor(past, grant, current_leg=leg)) == "AltitudeAboveLimit", (
        "the drone is already above the end of the leg, so it may not stop climbing"
    )
    higher = goto(100, 0, 12.0).args
    assert isinstance(higher, GotoArgs)
    fast = at(0, 0, 14.5, down_mps=-2.6, latency_s=0.77)
    assert correction(monitor(fast, grant, current_leg=higher)) == "AltitudeAboveLimit"


def test_monitor_stops_leg_crossing_new_zone_at_once() -> None:
    """The monitor stops the leg early, because the link may fail before the last possible moment."""
    leg = goto(180, 0, 12.0).args
    climbing = goto(180, 0, 30.0).args
    short = goto(60, 0, 12.0).args
    assert isinstance(leg, GotoArgs)
    assert isinstance(climbing, GotoArgs)
    assert isinstance(short, GotoArgs)
    flying = at(0, 0, 12.0, east_mps=5.0)
    for action, expected in (("ignore", ("deny", "hover")), ("returnToLaunch", ("takeover", "returnToLaunch"))):
        ahead = compiled(exclusion(box(100, -20, 140, 20), action))
        verdict = monitor(flying, ahead, current_leg=leg, fences_changed=True)
        assert verdict is not None
        assert (verdict.action, verdict.takeover) == expected
    assert monitor(flying, ahead, current_leg=short, fences_changed=True) is None, "the leg ends before the zone"
    above = compiled(exclusion(box(100, -20, 140, 20), lower=20))
    assert monitor(flying, above, current_leg=leg, fences_changed=True) is None, "the leg passes below the zone"
    assert monitor(flying, above, current_leg=climbing, fences_changed=True) is not None
    around = compiled(exclusion(box(-20, -20, 20, 20)))
    assert monitor(flying, around, current_leg=leg, fences_changed=True, system_flies=True) is None, "the leg leads out"


def test_monitor_permits_climb_ended_by_velocity_despite_link_latency() -> None:
    grant = compiled(altitude(upperLimit=16))
    up = (0.0, 0.0, -2.6)
    level = (1.0, 0.0, 0.0)
    climbing = at(0, 0, 12.5, down_mps=-2.6, latency_s=0.77)
    assert monitor(replace(climbing, pending=(up, level)), grant) is None
    assert correction(monitor(replace(climbing, pending=(level, up)), grant)) == "AltitudeAboveLimit"
    assert correction(monitor(replace(climbing, altitude_m=15.5, pending=(level,)), grant)) == "AltitudeAboveLimit"
    below = compiled(exclusion(AROUND, lower=18))
    assert monitor(replace(climbing, altitude_m=14.0, pending=(level,)), below) is not None


AROUND = box(-50, -50, 50, 50)


@pytest.mark.parametrize("action", ["ignore", "hover"])
@pytest.mark.parametrize(
    ("above", "climb_mps", "grant"),
    [
        (True, 2.0, lambda action: compiled(exclusion(AROUND, action, lower=15))),
        (False, -2.0, lambda action: compiled(exclusion(AROUND, action, upper=15))),
        (True, 2.0, lambda action: compiled(inclusion(AROUND, action, upper=15))),
        (False, -2.0, lambda action: compiled(inclusion(AROUND, action, lower=15))),
    ],
)
def test_monitor_stops_drone_below_and_above_altitude_band(
    action: str, above: bool, climb_mps: float, grant: Any
) -> None:
    grant = grant(action)
    up = 1 if above else -1
    stopped = []
    for step in range(200):
        height = 15 - up * (10 - step * 0.1)
        verdict = monitor(at(0, 0, height, down_mps=-climb_mps), grant)
        if verdict is not None:
            assert (verdict.action, verdict.takeover) == ("takeover" if action == "hover" else "deny", "hover")
            stopped.append(height)
    stop_m = 2 * (0.3 + 0.1) + 0.5 + 2.0
    assert stop_m < (15 - stopped[0]) * up < stop_m + 1.5, "the drone stops neither too early nor too late"
    assert len(stopped) > 100, "the monitor also stops a drone that has entered the zone"
    away = at(0, 0, 15 + up, down_mps=climb_mps)
    assert (monitor(away, grant) is None) is (action == "ignore"), (
        "a drone that flies away from the altitude band is stopped only with a takeover action"
    )
    assert monitor(at(0, 0, 15 - 3 * up), grant) is None
    assert monitor(at(60 * up, 0, 12, down_mps=-climb_mps), compiled(exclusion(AROUND, lower=15))) is None


def test_monitor_stops_drone_creeping_up_into_zone() -> None:
    verdict = monitor(at(0, 0, 14.9, down_mps=-0.2), compiled(exclusion(AROUND, lower=15)))
    assert verdict is not None
    assert verdict.takeover == "hover"


def test_monitor_permits_landing_and_climb_that_ends_below_zone() -> None:
    grant = compiled(exclusion(AROUND, "returnToLaunch", lower=18))
    leg = goto(0, 0, 16.0).args
    assert isinstance(leg, GotoArgs)
    for tenths in range(50, 160):
        climb = min(2.5, math.sqrt(2 * max(16.0 - tenths / 10, 0.05)))
        climbing = at(0, 0, tenths / 10, down_mps=-climb, latency_s=0.77)
        for changed in (False, True):
            assert monitor(climbing, grant, current_leg=leg, fences_changed=changed) is None
    assert monitor(at(0, 0, 13.0, down_mps=-2.0), compiled(exclusion(AROUND, lower=15)), current_leg=leg) is not None
    below = compiled(exclusion(AROUND, upper=10))
    landing = at(0, 0, 12.0, down_mps=1.5)
    assert monitor(landing, below) is not None
    assert monitor(replace(landing, vertical=True), below, system_flies=True) is None


def correction(verdict: Verdict | None) -> str:
    """Return the code of a verdict that corrects, or an empty text for any other verdict."""
    return verdict.code if verdict is not None and verdict.action == "correct" else ""


def test_monitor_ends_unjudged_climb_at_half_the_tolerance() -> None:
    grant = compiled(altitude(upperLimit=10))
    climbing = at(0, 0, 10.8, down_mps=-0.7)
    assert correction(monitor(climbing, grant, system_flies=True)) == "AltitudeAboveLimit"
    assert monitor(climbing, grant) is None, "the engine has judged the climb of the driver"
    leg = goto(0, 50, 10.0).args
    assert isinstance(leg, GotoArgs)
    assert monitor(climbing, grant, system_flies=True, current_leg=leg) is None, (
        "the climb belongs to the current leg of the system"
    )
    assert monitor(at(0, 0, 11.4, down_mps=-0.1), grant, system_flies=True) is None, (
        "the drone does not climb noticeably"
    )

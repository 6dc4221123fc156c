"""Geofences of the policy engine: operation areas, exclusion zones and inclusion zones."""

from __future__ import annotations

import pytest
from fractus_core.api.geometry import Point
from fractus_core.geo import distance_m
from fractus_core.policy.decision_types import (
    Airframe,
    Call,
    GotoArgs,
    Home,
    TakeoffArgs,
)
from fractus_core.policy.kinematics import stopping_distance_m
from policy_world import (
    FRAME,
    HOME,
    ask,
    at,
    box,
    compiled,
    exclusion,
    goto,
    inclusion,
    policy,
    ring,
    target,
    zone,
)

# Fences


def test_goto_outside_operation_area_is_denied() -> None:
    verdict = ask(compiled(), goto(0, 230))
    assert (verdict.action, verdict.code, verdict.takeover) == ("deny", "OutsideOperationArea", None)
    assert "30.0 m outside" in verdict.reason
    assert ask(compiled(), goto(0, 198)).code == "OutsideOperationArea", "the target is inside the margin of the border"
    assert ask(compiled(), goto(0, 197)).action == "allow"
    assert ask(compiled(operationArea=[]), goto(0, 230)).action == "allow"


def test_goto_cutting_corner_of_operation_area_is_denied() -> None:
    corner = [ring([(-20, -20), (100, -20), (100, 20), (20, 20), (20, 100), (-20, 100)])]
    grant = compiled(operationArea=corner)
    assert ask(grant, goto(0, 90), at(0, 0)).action == "allow"
    assert ask(grant, goto(90, 0), at(0, 90)).code == "OutsideOperationArea"


def test_goto_along_corridor_and_home_is_allowed() -> None:
    grant = compiled(operationArea=[box(50, -20, 150, 20)], corridor=[box(-30, -30, 150, 30)])
    assert ask(grant, goto(100, 0), at(0, 0)).action == "allow"
    assert ask(grant, goto(20, 0), at(0, 0)).code == "OutsideOperationArea", (
        "the corridor is not part of the operation area"
    )
    assert ask(grant, goto(0, 0), at(100, 0)).action == "allow", "the leg leads home"
    assert ask(grant, Call("Takeoff", TakeoffArgs(10)), at(0, 0, 0)).action == "allow"
    partial = compiled(operationArea=[box(50, -20, 150, 20)], corridor=[box(-30, -30, 150, 30)], control="partial")
    assert ask(partial, goto(100, 0), at(0, 0)).action == "allow", "the leg leads into the operation area"
    assert ask(partial, Call("Arm"), at(0, 0, 0)).code == "OutsideOperationArea"


def test_goto_from_home_may_leave_operation_area_into_corridor() -> None:
    bend = ring([(-10, -5), (60, -5), (60, 60), (50, 60), (50, 5), (-10, 5)])
    grant = compiled(operationArea=[bend], corridor=[box(-30, -30, 100, 100)])
    assert ask(grant, goto(55, 50), at(0, 0)).action == "allow"
    assert ask(grant, goto(55, 50), at(20, 0)).code == "OutsideOperationArea", (
        "a driver inside the operation area must stay inside"
    )
    partial = compiled(operationArea=[bend], corridor=[box(-30, -30, 100, 100)], control="partial")
    assert ask(partial, goto(55, 50), at(0, 0)).code == "OutsideOperationArea", (
        "only the system may fly the leg to the control point"
    )


def test_partial_control_driver_may_fly_where_system_can_return_around_zone() -> None:
    fields = {"operationArea": [box(50, -20, 150, 20)], "corridor": [box(-30, -60, 150, 60)], "control": "partial"}
    retracing = at(60, 0, airframe=Airframe(retraces=True))
    beside = exclusion(box(20, -10, 40, 10))
    across = exclusion(box(20, -70, 40, 70))
    assert ask(compiled(beside, **fields), goto(100, 0), retracing).action == "allow"
    assert ask(compiled(across, **fields), goto(100, 0), retracing).code == "WayHomeBlocked"
    assert ask(compiled(beside, **fields), goto(100, 0), at(60, 0)).code == "WayHomeBlocked", (
        "the drone returns straight through the zone"
    )


def test_goto_into_through_or_near_exclusion_zone_is_denied() -> None:
    grant = compiled(exclusion(box(50, -20, 80, 20)))
    inside = ask(grant, goto(60, 0))
    through = ask(grant, goto(150, 0))
    near = ask(grant, goto(48, 0))
    assert (inside.action, inside.code) == ("deny", "InsideExclusionZone")
    assert "10.0 m inside" in inside.reason
    assert through.code == "LegThroughExclusionZone"
    assert "30.0 m" in through.reason
    assert near.code == "TooCloseToExclusionZone"
    assert ask(grant, goto(47, 0)).action == "allow"
    assert ask(grant, goto(47, 0), at(position_error_m=3)).code == "TooCloseToExclusionZone"


def test_reason_shows_distances_below_a_tenth_of_a_metre() -> None:
    zone_at = exclusion(box(50, -20, 80, 20))
    verdicts = [
        ask(compiled(exclusion(ring([(50, 0.01), (40, -20), (60, -20)]))), goto(100, 0)),
        ask(compiled(zone_at), goto(50.01, 0)),
        ask(compiled(zone_at), goto(49.99, 0)),
        ask(compiled(inclusion(box(-50, -50, 50, 50))), goto(50.01, 0)),
        ask(compiled(inclusion(box(-50, -50, 50, 50))), goto(49.99, 0)),
        ask(compiled(), goto(0, 199.99)),
        ask(compiled(), goto(0, 200.01)),
        ask(compiled(), Call("CaptureImage"), at(0, 200.01)),
    ]
    for verdict in verdicts:
        assert not verdict.permits
        assert " 0.0 m" not in verdict.reason, verdict
    assert "touches zone no-fly-zone" in verdicts[0].reason
    assert "less than 0.1 m inside zone no-fly-zone" in verdicts[1].reason
    assert "comes within 0.1 m of zone no-fly-zone" in verdicts[2].reason


def test_reason_distinguishes_turn_from_leg_through_zone() -> None:
    verdict = ask(compiled(exclusion(box(1, 5, 3, 9))), goto(0, 60), at(east_mps=5.0, north_mps=0.0))
    assert verdict.code == "LegThroughExclusionZone"
    assert "turn onto the leg touches zone no-fly-zone" in verdict.reason


def test_zone_with_altitude_band_may_be_overflown() -> None:
    grant = compiled(exclusion(box(50, -20, 80, 20), upper=20))
    assert ask(grant, goto(150, 0, 30), at(alt=30)).action == "allow"
    assert ask(grant, goto(150, 0, 30), at(alt=10)).code == "LegThroughExclusionZone", (
        "the drone may still climb when it reaches the zone"
    )
    assert ask(grant, goto(150, 0, 21), at(alt=21)).code == "LegThroughExclusionZone", (
        "the leg is inside the altitude margin"
    )
    high = compiled(exclusion(box(50, -20, 80, 20), lower=140, reference="amsl"))
    assert ask(high, goto(60, 0, 20)).action == "allow"
    assert ask(high, goto(60, 0, 39)).code == "InsideExclusionZone"
    unknown = compiled(exclusion(box(50, -20, 80, 20), upper=20, reference="terrain"))
    assert ask(unknown, goto(60, 0, 90), at(alt=90)).code == "InsideExclusionZone", (
        "a zone above unknown terrain has no upper limit"
    )


@pytest.mark.parametrize("action", ["hover", "land", "returnToLaunch", "abort", "revoke"])
def test_geofence_action_determines_takeover(action: str) -> None:
    grant = compiled(exclusion(box(50, -20, 80, 20), action))
    verdict = ask(grant, goto(60, 0))
    assert (verdict.action, verdict.takeover, verdict.policies) == ("takeover", action, ("no-fly",))
    assert ask(grant, goto(150, 0)).takeover == action, "a leg through the zone also breaks the policy"
    assert ask(grant, goto(48, 0)).action == "deny", "a leg that only enters the margin causes no takeover"


def test_most_restrictive_fence_decides() -> None:
    actions = ("adjust", "hover", "ignore", "land", "returnToLaunch")
    zones = [exclusion(box(50, -20, 80, 20), a, f"p-{a.lower()}") for a in actions]
    verdict = ask(compiled(*zones), goto(60, 0))
    assert (verdict.action, verdict.takeover) == ("takeover", "land")
    assert verdict.policies == ("p-land", "p-returntolaunch", "p-hover", "p-ignore", "p-adjust")
    zones.append(exclusion(box(50, -20, 80, 20), "abort", "p-abort"))
    assert ask(compiled(*zones), goto(60, 0)).takeover == "abort"
    zones.append(exclusion(box(50, -20, 80, 20), "revoke", "p-revoke"))
    assert ask(compiled(*zones), goto(60, 0)).takeover == "revoke"


def test_adjust_action_shortens_leg_before_exclusion_zone() -> None:
    grant = compiled(exclusion(box(50, -20, 80, 20), "adjust"))
    verdict = ask(grant, goto(150, 0))
    assert (verdict.action, verdict.code) == ("correct", "LegShortened")
    x, y = target(verdict)
    assert y == pytest.approx(0, abs=1e-3)
    assert 46.5 < x < 47.5
    assert ask(grant, Call("Goto", verdict.args)).action == "allow", "the corrected target is legal"
    assert ask(grant, goto(150, 0), at(47, 0)).action == "deny", "no legal part of the leg remains"
    both = compiled(exclusion(box(50, -20, 80, 20), "adjust"), exclusion(box(20, -20, 30, 20), "ignore", "other"))
    assert ask(both, goto(150, 0)).action == "deny"


def test_adjust_action_shortens_leg_inside_inclusion_zone() -> None:
    grant = compiled(inclusion(box(-30, -30, 60, 60), "adjust"))
    verdict = ask(grant, goto(0, 100))
    assert verdict.action == "correct"
    assert 56 < target(verdict)[1] < 57.5
    assert ask(compiled(inclusion(box(-30, -30, 60, 60))), goto(0, 100)).code == "OutsideInclusionZone"
    assert ask(compiled(inclusion(box(-30, -30, 60, 60), "land")), goto(0, 100)).takeover == "land"
    assert ask(compiled(inclusion(box(-30, -30, 60, 60))), goto(0, 59)).code == "TooCloseToInclusionBorder"


@pytest.mark.parametrize("radius_m", [20_000.0, 100_000.0])
def test_inclusion_circle_of_large_radius_is_not_left(radius_m: float) -> None:
    """The border of the circle is 100 m north of home. Its center is far to the south."""
    lat, lon = FRAME.latlon(0.0, -(radius_m - 100.0))
    # The local frame distorts large distances, so the radius is a geodesic distance.
    south_m = distance_m(Point(lat=lat, lon=lon), Point(lat=HOME.lat, lon=HOME.lon))
    circle = {"circle": {"center": {"lat": lat, "lon": lon}, "radius": south_m + 100.0}}
    grant = compiled(inclusion(circle))
    assert ask(grant, goto(0, 102), at(0, -170)).code == "OutsideInclusionZone"
    area = compiled(operationArea=[circle], corridor=[circle])
    assert ask(area, goto(0, 102), at(0, -170)).code == "OutsideOperationArea"
    assert ask(area, goto(0, -180), at(0, -170)).action == "allow"
    assert ask(grant, goto(0, -180), at(0, -170)).action == "allow"


def test_inclusion_area_is_union_of_the_zones_of_a_policy() -> None:
    two = policy(
        "keep-in", "GeofenceControl", "inclusion",
        [zone("a", box(-30, -30, 50, 30)), zone("b", box(49, -30, 120, 30))],
    )  # fmt: skip
    assert ask(compiled(two), goto(100, 0)).action == "allow"
    apart = (inclusion(box(-30, -30, 50, 30), name="a"), inclusion(box(49, -30, 120, 30), name="b"))
    assert ask(compiled(*apart), goto(100, 0)).action == "deny", "both policies apply"


def test_goto_of_moving_drone_needs_room_to_turn() -> None:
    grant = compiled(exclusion(box(10, 15, 30, 30)))
    assert ask(grant, goto(0, 60), at(0, 0)).action == "allow"
    assert ask(grant, goto(0, 60), at(0, 0, east_mps=9)).code == "LegThroughExclusionZone"
    ahead = compiled(exclusion(box(15, -20, 30, 20)))
    assert ask(ahead, goto(0, 60), at(0, 0, east_mps=9)).action == "allow", (
        "the leg leads away from a zone that the drone cannot avoid"
    )
    assert ask(ahead, goto(60, 60), at(0, 0, east_mps=9)).action == "deny"
    assert stopping_distance_m(9, 2.5, 1.0) == pytest.approx(2.5 / 2 + 81 / 5)
    assert stopping_distance_m(2, 2.5, 1.0) == pytest.approx(2.0)


def test_goto_from_inside_zone_may_only_lead_out() -> None:
    grant = compiled(exclusion(box(50, -50, 90, 50), "land"))
    inside = at(60, 0)
    assert ask(grant, goto(40, 0), inside).action == "allow"
    assert ask(grant, goto(80, 0), inside).action != "allow"
    assert ask(grant, goto(100, 0), inside).action != "allow", (
        "on the longer leg, the drone flies deeper into the zone before it leaves"
    )
    assert ask(grant, goto(49, 0), inside).action != "allow", "the target is outside, but inside the margin"
    assert ask(grant, goto(80, 0), inside).action == "deny", (
        "the monitor already handles the violation, so there is no second takeover"
    )


def test_drone_outside_inclusion_zone_may_only_fly_in() -> None:
    grant = compiled(operationArea=[box(50, -50, 150, 50)])
    outside = at(20, 0)
    assert ask(grant, goto(100, 0), outside).action == "allow"
    assert ask(grant, goto(10, 0), outside).action == "deny"
    keep = compiled(inclusion(box(-5, -50, 150, 50)), operationArea=[])
    assert ask(keep, goto(50, 0), at(-20, 0)).action == "allow"
    assert ask(keep, goto(-10, 0), at(-20, 0)).action == "deny"


def test_goto_is_denied_when_straight_return_is_blocked() -> None:
    wall = exclusion(box(-100, 40, 60, 50), name="wall")
    grant = compiled(wall)
    behind = at(100, 60)
    assert ask(grant, goto(0, 80), behind).code == "WayHomeBlocked"
    assert ask(grant, goto(150, 60), behind).action == "allow"
    low = compiled(exclusion(box(-100, 40, 60, 50), name="wall", upper=12))
    assert ask(low, goto(0, 80, 10), behind).action == "allow", "the drone returns at 15 m, above the wall"
    assert ask(compiled(inclusion(box(20, -50, 150, 150))), goto(100, 50), at(80, 50)).code == "WayHomeBlocked"


def test_straight_return_near_home_is_checked_at_lower_altitude() -> None:
    """Near home, the autopilot climbs only to three times its distance from home instead of its return altitude."""
    grant = compiled(exclusion(box(-20, 15, 20, 17), name="mast", upper=70))
    high = at(60, 60, airframe=Airframe(return_altitude_m=100.0))
    assert ask(grant, goto(0, 60), high).action == "allow", "from the target the drone returns at 100 m"
    near = ask(grant, goto(0, 23), high)
    assert near.code == "WayHomeBlocked"
    assert "69.0 to 100.0 m" in near.reason


def test_takeoff_and_landing_respect_fences() -> None:
    grant = compiled(exclusion(box(-10, -10, 10, 10), "land", lower=20))
    assert ask(grant, Call("Takeoff", TakeoffArgs(10)), at(alt=0)).action == "allow"
    assert ask(grant, Call("Takeoff", TakeoffArgs(30)), at(alt=0)).action == "deny"
    ground = compiled(exclusion(box(40, -10, 60, 10), upper=30))
    assert ask(ground, Call("Land"), at(50, 0, alt=50)).code == "InsideExclusionZone"
    assert ask(ground, Call("Land"), at(30, 0, east_mps=8)).action == "deny", "the drone would land in the zone"
    assert ask(ground, Call("Land"), at(0, 0)).action == "allow"
    assert ask(ground, Call("Arm"), at(50, 0, alt=0)).action == "deny"


@pytest.mark.parametrize(("lower", "upper", "away", "closer"), [(12.0, 60.0, 9.0, 10.5), (-5.0, 8.0, 11.0, 9.5)])
def test_drone_too_close_below_or_above_zone_may_sink_or_climb_away(
    lower: float, upper: float, away: float, closer: float
) -> None:
    grant = compiled(exclusion(box(-40, -40, 40, 40), lower=lower, upper=upper))
    for x in (0.0, 39.9, 40.5):
        beside = at(x, 0, 10.0)
        assert ask(grant, goto(x, 0, away), beside).action == "allow"
        assert ask(grant, goto(x, 0, closer), beside).action == "deny"
        assert ask(grant, goto(x, 0, 10.0), beside).action == "deny", "the drone stays too close"
        assert ask(grant, goto(x - 20, 0, away), beside).action == "deny", (
            "the drone may fly above or below the zone before it has changed its altitude"
        )
    moving = at(x=40.5, alt=10.0, east_mps=-8.0)
    assert ask(grant, goto(40.5, 0, away), moving).action == "deny"


def test_disarm_is_denied_in_the_air() -> None:
    assert ask(compiled(), Call("Disarm"), at()).code == "InAir"
    assert ask(compiled(), Call("Disarm"), at(in_air=False)).action == "allow"


# Distant geometry


def test_zones_on_the_far_side_of_the_globe_are_ignored() -> None:
    far = [{"lat": lat, "lon": lon} for lat, lon in ((-39.3, -157.1), (-39.4, -157.1), (-39.4, -157.0))]
    grant = compiled(exclusion({"polygon": {"exterior": far}}))
    assert ask(grant, goto(50, 0)).action == "allow"


def test_fences_work_across_the_antimeridian() -> None:
    from fractus_core.geo import LocalFrame
    from fractus_core.policy.decision_types import Situation
    from fractus_core.policy.engine import judge

    frame = LocalFrame(-17.0, 179.9999)
    corners = [
        dict(zip(("lat", "lon"), frame.latlon(x, y), strict=True))
        for x, y in ((50, -20), (80, -20), (80, 20), (50, 20))
    ]
    grant = compiled(
        exclusion({"polygon": {"exterior": corners}}), operationArea=[],
        home={"lat": -17.0, "lon": 179.9999, "alt": 0, "altitudeReference": "amsl"},
    )  # fmt: skip
    now = Situation(time_s=0, lat=-17.0, lon=179.9999, altitude_m=10, home=Home(-17.0, 179.9999, 0), in_air=True)
    for x, code in ((60, "InsideExclusionZone"), (150, "LegThroughExclusionZone"), (40, "")):
        assert judge(Call("Goto", GotoArgs(*frame.latlon(x, 0), 10)), now, grant).code == code

"""Verdicts on random requests near random fences, compared with an oracle that simulates flights in small steps.

The oracle shares no code with the engine. It projects positions on a sphere, and uses ray casting to distinguish inside
from outside. It integrates the motion of a drone with bounded acceleration, wind drift, latency and position error.
"""

from __future__ import annotations

import math
import random
from typing import Any

import numpy as np
import policy_flights
import pytest
from depth import cells, examples
from fractus_core.policy import free_space, goto_rules
from fractus_core.policy.decision_types import Call, GotoArgs, Situation, TakeoffArgs, Verdict
from fractus_core.policy.engine import MIN_TAKEOFF_ALTITUDE_M
from fractus_core.policy.limits import MIN_LEG_ALTITUDE_M
from fractus_core.policy.monitoring import monitor
from fractus_services.mobility.mavlink import failsafes
from hypothesis import example, given, settings
from hypothesis import strategies as st
from parameter_faults import parameter_faults
from policy_flights import (
    CORNERS,
    EAST_M,
    EXCLUSION,
    INCLUSION,
    LIMIT,
    NORTH_M,
    OVERSHOOT_M,
    ZONES,
    Fleet,
    Floats,
    Scene,
    excused,
    flights,
    strays,
)
from policy_world import HOME, Corners, altitude, ask, at, compiled, exclusion, goto, inclusion, ring, target
from position_fault_flights import PositionFaultFlights, depths, heights_inside
from return_flights import ReturnFlights

STEP_S = 0.05
ACCEL_MPS2 = 2.5
TOLERANCE_M = 0.02  # position error of the sphere compared with the ellipsoid, within a few hundred metres
_cases = settings(max_examples=examples(600), deadline=None, derandomize=True)


def flat(lat: float, lon: float) -> tuple[float, float]:
    north_scale = 110_998.0
    east_scale = math.cos(math.radians(HOME.lat)) * 111_458.0
    return (lon - HOME.lon) * east_scale, (lat - HOME.lat) * north_scale


def inside(point: tuple[float, float], corners: Corners) -> bool:
    x, y = point
    result = False
    for (x0, y0), (x1, y1) in zip(corners, corners[1:] + corners[:1], strict=True):
        if (y0 > y) != (y1 > y) and x < (x1 - x0) * (y - y0) / (y1 - y0) + x0:
            result = not result
    return result


def fly(
    start: tuple[float, float], velocity: tuple[float, float], to: tuple[float, float], cruise: float, latency: float
) -> list[tuple[float, float]]:
    """Return the positions of a drone on a flight to a target.

    The drone receives the target after a latency. It then turns toward the target, and brakes in time.
    """
    x, y = start
    vx, vy = velocity
    track = [start]
    t = 0.0
    while t < 120:
        t += STEP_S
        ax = ay = 0.0
        if t > latency:
            dx = to[0] - x
            dy = to[1] - y
            away = math.hypot(dx, dy)
            linear = ACCEL_MPS2
            expected = away if away < linear else math.sqrt(2 * ACCEL_MPS2 * (away - linear / 2))
            expected = min(expected, cruise)
            wx, wy = (dx / away * expected, dy / away * expected) if away > 1e-6 else (0.0, 0.0)
            ex = (wx - vx) / STEP_S
            ey = (wy - vy) / STEP_S
            size = math.hypot(ex, ey)
            scale = min(1.0, ACCEL_MPS2 / size) if size > 0 else 0.0
            ax = ex * scale
            ay = ey * scale
            if away < 0.05 and math.hypot(vx, vy) < 0.05:
                break
        vx = vx + ax * STEP_S
        vy = vy + ay * STEP_S
        x = x + vx * STEP_S
        y = y + vy * STEP_S
        track.append((x, y))
    return track


def brake(start: tuple[float, float], velocity: tuple[float, float], latency: float) -> list[tuple[float, float]]:
    """Return the positions of a drone after a stop command.

    The stopping distance is that of ArduPilot's formula, with its tolerance of 1.25 m.
    """
    speed = math.hypot(*velocity)
    run = speed * latency + 1.25 + speed * speed / (2 * ACCEL_MPS2) if speed > 0 else 0.0
    return [
        (start[0] + velocity[0] / speed * run * i / 40, start[1] + velocity[1] / speed * run * i / 40)
        for i in range(41)
        if speed > 0
    ] or [start]


@st.composite
def polygons(draw: st.DrawFn) -> Corners:
    """Draw a star-shaped polygon, convex or not."""
    cx = draw(st.floats(-120, 120))
    cy = draw(st.floats(-120, 120))
    count = draw(st.integers(3, 8))
    radii = draw(st.lists(st.floats(5, 45), min_size=count, max_size=count))
    turn = draw(st.floats(0, 6))
    return [
        (cx + r * math.cos(turn + 2 * math.pi * i / count), cy + r * math.sin(turn + 2 * math.pi * i / count))
        for i, r in enumerate(radii)
    ]


spots = st.tuples(st.floats(-150, 150), st.floats(-150, 150))
speeds = st.tuples(st.floats(-8, 8), st.floats(-8, 8)).filter(lambda v: math.hypot(*v) < 10)


@_cases
@given(
    zones=st.lists(polygons(), min_size=1, max_size=4),
    start=spots,
    to=spots,
    velocity=speeds,
    action=st.sampled_from(["ignore", "adjust"]),
    seed=st.integers(0, 10**6),
)
@example([[(-79.2, -30.7), (-96.7, 22.6), (-138.3, -5.8)]], (-149.8, -40.1), (0.0, 0.0), (-0.3, -7.1), "ignore", 331)
def test_oracle_finds_no_permitted_goto_that_enters_a_zone(
    zones: list[Corners],
    start: tuple[float, float],
    to: tuple[float, float],
    velocity: tuple[float, float],
    action: str,
    seed: int,
) -> None:
    fences = [exclusion(ring(zone), action, f"z{i}") for i, zone in enumerate(zones)]
    grant = compiled(*fences, operationArea=[])
    now = at(*start, east_mps=velocity[0], north_mps=velocity[1], speed_setpoint_mps=10.0)
    verdict = ask(grant, goto(*to), now)
    if not verdict.permits:
        return
    begun_outside = not any(inside(start, zone) for zone in zones)
    draw = random.Random(seed)
    error = (draw.uniform(-1, 1), draw.uniform(-1, 1))
    scale = now.position_error_m / max(math.hypot(*error), 1.0)
    off = (error[0] * scale, error[1] * scale)
    # The check ignores zones that the drone enters even if it is commanded to stop.
    braking = [(x + off[0] * k, y + off[1] * k) for x, y in brake(start, velocity, now.latency_s) for k in (-1, 0, 1)]
    unavoidable = any(inside(point, zone) for zone in zones for point in braking)
    begin = start
    track: list[tuple[float, float]] = []
    if verdict.brake_first:
        stop = brake(start, velocity, now.latency_s)
        track = [(x + off[0], y + off[1]) for x, y in stop]
        begin = stop[-1]
        velocity = (0.0, 0.0)
        # The drone stops up to 1.25 m from where the engine expects it, so the service judges the leg again.
        verdict = ask(grant, goto(*to), at(*begin, speed_setpoint_mps=10.0))
        if not verdict.permits:
            return
    assert isinstance(verdict.args, GotoArgs)
    end = flat(verdict.args.lat, verdict.args.lon)
    track += fly(
        (begin[0] + off[0], begin[1] + off[1]), velocity, (end[0] + off[0], end[1] + off[1]), 10.0, now.latency_s
    )
    if begun_outside and not unavoidable:
        for point in track:
            for zone in zones:
                assert not inside(point, zone), f"inside at {point}, verdict {verdict}"
    for zone in zones:
        assert not inside(track[-1], zone)


@_cases
@given(area=polygons(), start=spots, to=spots, action=st.sampled_from(["ignore", "adjust"]))
def test_oracle_finds_no_permitted_goto_that_leaves_an_inclusion_zone(
    area: Corners, start: tuple[float, float], to: tuple[float, float], action: str
) -> None:
    big = [(x * 3, y * 3) for x, y in area]
    fence = inclusion(ring(big), action)
    verdict = ask(compiled(fence, operationArea=[]), goto(*to), at(*start))
    if not verdict.permits:
        return
    end = target(verdict)
    track = fly(start, (0.0, 0.0), end, 10.0, 0.3)
    outside = [not inside(p, big) for p in track]
    if not outside[0]:
        assert not any(outside)
    assert outside == sorted(outside, reverse=True), "the drone stays inside the zone after it has entered it"
    assert not outside[-1]
    # A circle around a corrected target, with the size of the margin, is inside the zone.
    ring_of = [(end[0] + 2.4 * math.cos(a / 5), end[1] + 2.4 * math.sin(a / 5)) for a in range(32)]
    assert all(inside(p, big) for p in ring_of)


@_cases
@given(
    requested=st.floats(0.5, 200),
    lower=st.one_of(st.none(), st.floats(0, 60)),
    upper=st.one_of(st.none(), st.floats(0, 60)),
    refuse=st.booleans(),
)
def test_altitude_verdicts_match_the_rules_of_the_oracle(
    requested: float, lower: float | None, upper: float | None, refuse: bool
) -> None:
    if lower is None and upper is None:
        return
    if lower is not None and upper is not None and lower > upper:
        lower, upper = upper, lower
    limits = {k: v for k, v in (("lowerLimit", lower), ("upperLimit", upper)) if v is not None}
    grant = compiled(altitude(action="refuse" if refuse else "enforce", **limits))
    breaks = (upper is not None and requested > upper + 1e-6) or (lower is not None and requested < lower - 1e-6)
    top = 120.0 if upper is None else upper
    bottom = -math.inf if lower is None else lower
    # The drone overshoots a commanded altitude.
    want = max(min(requested, top - OVERSHOOT_M), bottom + OVERSHOOT_M)
    if bottom + OVERSHOOT_M > top - OVERSHOOT_M:
        want = (bottom + top) / 2
    corrected = breaks or requested > 120.0 + 1e-6
    for call in (goto(10, 10, requested), Call("Takeoff", TakeoffArgs(requested))):
        verdict = ask(grant, call, at(alt=0.0) if call.method == "Takeoff" else at())
        edges = [edge for edge in (lower, top - OVERSHOOT_M) if edge is not None]
        low = want < MIN_LEG_ALTITUDE_M - 1e-6 and not any(edge < MIN_LEG_ALTITUDE_M for edge in edges)
        if breaks and refuse:
            assert verdict.action == "deny"
        elif low and call.method == "Goto":
            assert verdict.code == "AltitudeTooLow"
        elif call.method == "Takeoff" and corrected and want < MIN_TAKEOFF_ALTITUDE_M:
            assert verdict.code == "ConflictingLimits", "the altitude is below the minimum of a takeoff"
        else:
            assert verdict.permits
            flown = verdict.args.alt if isinstance(verdict.args, GotoArgs) else verdict.args.altitude_m  # type: ignore[union-attr]
            assert math.isclose(flown or 0.0, want, abs_tol=1e-5)
            assert (verdict.action == "correct") == corrected, "a value inside a limit breaks no limit"


@_cases
@given(lat=st.floats(), lon=st.floats(), alt=st.floats(), vn=st.floats(-100, 100), ve=st.floats(-100, 100))
def test_every_random_goto_gets_a_verdict(lat: float, lon: float, alt: float, vn: float, ve: float) -> None:
    zone = [(20.0, 20.0), (40.0, 20.0), (40.0, 40.0)]
    grant = compiled(exclusion(ring(zone), "adjust"), altitude(upperLimit=30))
    verdict = ask(grant, Call("Goto", GotoArgs(lat, lon, alt)), at(north_mps=vn, east_mps=ve))
    if verdict.permits:
        assert isinstance(verdict.args, GotoArgs)
        assert all(math.isfinite(v) for v in (verdict.args.lat, verdict.args.lon, verdict.args.alt or 0.0))
    else:
        assert verdict.reason
        assert verdict.code


def test_oracle_finds_no_permitted_request_that_violates_a_policy() -> None:
    """Short version of `bench/oracle.py`: velocities, interrupted legs, altitude bands, schedules, limits and wind."""
    tally = flights(seed=7, count=500)
    assert tally.wrong == []
    assert tally.permitted > tally.requests / 3
    assert tally.corrected > 100
    assert tally.taken > 20
    assert tally.braked > 0


def test_oracle_detects_too_small_margins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Situation, "margin_m", property(lambda _now: 0.5))
    assert flights(seed=3, count=200).wrong


def test_oracle_finds_no_return_flight_that_violates_a_policy() -> None:
    tally = flights(seed=11, count=160, requests=2, returns=ReturnFlights(11, 4))
    assert tally.wrong == []
    assert tally.system_returns > 30
    assert tally.autopilot_returns > 5
    assert tally.changed > 0


def test_oracle_detects_return_flights_through_zones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(free_space, "check_straight_return", lambda *_, **__: None)
    monkeypatch.setattr(goto_rules, "check_return", lambda *_: None)
    monkeypatch.setattr(free_space.FreeSpace, "blockers", lambda *_: [])
    wrong = flights(seed=11, count=160, requests=2, returns=ReturnFlights(11, 2)).wrong
    assert any("return flight of drone" in line for line in wrong)
    assert any("returning by its autopilot" in line for line in wrong)


def test_oracle_finds_no_armed_vehicle_with_unknown_parameters() -> None:
    assert parameter_faults(seed=1, count=300) == []


def test_oracle_detects_assumed_parameters(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(failsafes.Reader, "read", lambda self, names, otherwise, *, needed=True: otherwise)
    assert parameter_faults(seed=1, count=50)


def test_oracle_accepts_drones_that_start_beyond_an_altitude_limit() -> None:
    rings = np.full((ZONES, CORNERS, 2), 1e6)
    rings[0] = [(-20, -20)] * 5 + [(20, -20), (20, 20), (-20, 20)]
    bands = np.tile([-np.inf, np.inf], (ZONES, 1))
    limits = bands.copy()
    limits[0] = 21, 40
    scene = Scene(compiled(), rings, np.array([LIMIT] + [0] * (ZONES - 1)), bands, limits, (-np.inf, 120.0), 15.0)
    fleet = Fleet(np.random.default_rng(1), [scene] * 4)
    fleet.place[:] = (0, 0, 19)
    fleet.speed[:] = 0
    fleet.gust[:] = 0
    fleet.place[1:, 2] = 21.5, 39.5, 42
    assert excused(fleet)[:, 0].tolist() == [True, False, False, True]


def two_zones(kind: int, bands: Floats, limits: Floats) -> Scene:
    """Return a scene with one square around home and another 36 m east of it."""
    rings = np.full((ZONES, CORNERS, 2), 1e6)
    for slot, west in ((0, -20.0), (1, 56.0)):
        corners = [(west, -20.0), (west + 40, -20.0), (west + 40, 20.0), (west, 20.0)]
        rings[slot] = corners + corners[-1:] * (CORNERS - 4)
    kinds = np.array([kind] * 2 + [0] * (ZONES - 2))
    return Scene(compiled(), rings, kinds, bands, limits, (-np.inf, 120.0), 15.0)


def test_oracle_detects_leg_through_uncovered_air_to_another_inclusion_zone() -> None:
    bands = np.tile([-np.inf, np.inf], (ZONES, 1))
    bands[0, 1] = 20.0
    scene = two_zones(INCLUSION, bands, bands.copy())

    def wrong(start: Situation, call: Call) -> bool:
        return strays(Verdict("allow", call.args), start, scene)

    assert wrong(at(20.05, 0, alt=10), goto(70, 0, 30))
    assert wrong(at(0, 0, alt=20.5), goto(70, 0, 30))
    assert not wrong(at(20.05, 0, alt=10), goto(0, 0, 10)), "the drone returns into the zone"
    assert not wrong(at(50, 0, alt=10), goto(70, 0, 30)), "the other zone is nearer"
    assert not wrong(at(50, 0, alt=40), goto(70, 0, 30))


def test_oracle_detects_altitude_limit_only_within_the_altitudes_of_its_zone() -> None:
    bands = np.tile([-np.inf, np.inf], (ZONES, 1))
    bands[0, 1] = 25.0
    limits = np.tile([-np.inf, np.inf], (ZONES, 1))
    limits[0, 1] = 15.0
    fleet = Fleet(np.random.default_rng(1), [two_zones(LIMIT, bands, limits)] * 3)
    fleet.place[:] = (0, 0, 10)
    fleet.place[1:, 2] = 24.0, 26.0
    fleet.gust[:] = fleet.error[:] = fleet.settled[:] = 0.0
    fleet._estimated = None
    fleet.speed[:] = 1.0
    assert fleet.trespassing()[:, 0].tolist() == [False, True, False]


@pytest.fixture
def shortening(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use only Goto requests, and policies that shorten their legs. The legs then end at the margins of fences."""
    made = policy_flights.policy

    def shortens(name: str, *args: Any, **more: Any) -> dict[str, Any]:
        return made(name, *args, **more | ({"action": "adjust"} if args[0] == "GeofenceControl" else {}))

    def far(rng: np.random.Generator, _place: Scene) -> Call:
        x, y = rng.uniform(-85, 85, 2)
        away = GotoArgs(
            float(HOME.lat + y / NORTH_M), float(HOME.lon + x / EAST_M), speed_mps=float(rng.uniform(2, 14))
        )
        return Call("Goto", away)

    monkeypatch.setattr(policy_flights, "policy", shortens)
    monkeypatch.setattr(policy_flights, "_request", far)


@pytest.mark.usefixtures("shortening")
@pytest.mark.parametrize("seed", cells([3, 4], quick=[3]))
def test_oracle_finds_no_permitted_flight_stopped_by_monitor(seed: int) -> None:
    tally = flights(seed=seed, count=examples(400, 100), requests=2, watch_every=3)
    assert tally.wrong == []
    assert tally.stopped == []
    assert tally.shortened > 5
    assert tally.permitted > tally.requests / 3


@pytest.mark.usefixtures("shortening")
def test_oracle_detects_monitor_that_stops_permitted_flights(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policy_flights, "monitor", lambda now, grant, **_: monitor(now, grant))
    assert flights(seed=7, count=64, requests=2, watch_every=3).stopped


def test_position_fault_on_permitted_leg_breaches_no_fence() -> None:
    tally = flights(3, 64, requests=2, faults=PositionFaultFlights(3, 1))
    assert tally.position_faults > 10
    assert tally.wrong == []


def test_oracle_detects_drone_that_enters_zone_deeper_than_its_position_drifted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Fleet, "true", property(lambda fleet: fleet.estimated + 4 * fleet.error))
    wrong = flights(12, 128, requests=2, faults=PositionFaultFlights(12, 1)).wrong
    assert any("GPS drifts" in text for text in wrong)
    assert any("barometer drifts" in text for text in wrong)


def test_oracle_finds_distance_that_leads_out_of_forbidden_place() -> None:
    bands = np.tile([-np.inf, np.inf], (ZONES, 1))
    bands[0] = 10.0, 30.0
    scene = two_zones(EXCLUSION, bands, bands.copy())
    fleet = Fleet(np.random.default_rng(1), [scene, two_zones(INCLUSION, bands, bands.copy())])
    fleet.place[:] = (15, 0, 27), (25, 0, 27)
    fleet.gust[:] = fleet.error[:] = fleet.settled[:] = 0.0
    fleet._estimated = None
    assert depths(fleet)[0, 0] == pytest.approx(5.0)
    assert heights_inside(fleet)[0, 0] == pytest.approx(3.0)
    assert depths(fleet)[1, -1] == pytest.approx(5.0)
    assert heights_inside(fleet)[1, -1] == np.inf


def test_oracle_detects_drone_that_does_not_stop_after_jump_of_position(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Fleet, "stop", lambda _fleet, _rows: None)
    assert any(
        "left its course" in text for text in flights(3, 64, requests=2, faults=PositionFaultFlights(3, 1)).wrong
    )

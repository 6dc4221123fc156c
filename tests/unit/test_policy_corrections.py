"""Corrected calls: the engine allows them unchanged, and an independent implementation finds no violated policy."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest
from depth import examples
from fractus_core.policy import engine
from fractus_core.policy.compiled_grant import CompiledGrant
from fractus_core.policy.decision_types import (
    Args,
    Call,
    GotoArgs,
    SetSpeedArgs,
    Situation,
    TakeoffArgs,
    VelocityArgs,
    Verdict,
)
from policy_world import (
    CAMERA,
    FRAME,
    HOME,
    METHODS,
    Corners,
    altitude,
    ask,
    at,
    box,
    compiled,
    exclusion,
    goto,
    policy,
    ring,
    speed,
    zone,
)

EVERYWHERE = box(-190, -190, 190, 190)
SERVICES = [{"service": "mobility", "methods": [*METHODS, "SetVelocity"]}, {"service": "camera", "methods": CAMERA}]


def holds(grant: CompiledGrant, call: Call, verdict: Verdict, now: Situation) -> bool:
    """Return True if the engine allows a corrected call without another correction."""
    again = ask(grant, Call(call.method, verdict.args), now)
    return again.action == "allow" and again.args == verdict.args


# Corrected calls are judged again


def test_altitude_correction_into_slower_zone_also_corrects_speed() -> None:
    low = zone("low", EVERYWHERE, lower=20, upper=60)
    grant = compiled(altitude(lowerLimit=30), speed("slow", [low], upperLimit=3))
    verdict = ask(grant, goto(50, 0, 5, speed_mps=8), at(alt=10))
    assert (verdict.action, verdict.code) == ("correct", "AltitudeBelowLimit")
    assert isinstance(verdict.args, GotoArgs)
    assert (verdict.args.alt, verdict.args.speed_mps) == (30.2, pytest.approx(2.55))
    assert verdict.policies == ("altitudes", "slow")
    assert "altitude 5.0 m" in verdict.reason
    assert "speed 8.0 m/s" in verdict.reason


def test_takeoff_correction_complies_with_limits_of_entered_zone() -> None:
    high = zone("high", EVERYWHERE, lower=20, upper=60)
    climb = Call("Takeoff", TakeoffArgs(5))
    ground = at(alt=0.0, in_air=False)
    taller = ask(compiled(altitude(lowerLimit=30), altitude("tall", [high], lowerLimit=40)), climb, ground)
    assert (taller.action, taller.args) == ("correct", TakeoffArgs(40.2))
    assert taller.policies == ("altitudes", "tall")
    lower = ask(compiled(altitude(lowerLimit=30), altitude("flat", [high], upperLimit=25)), climb, ground)
    assert (lower.action, lower.code, lower.policies) == ("deny", "ConflictingLimits", ("altitudes", "flat"))
    assert "altitudes" in lower.reason
    assert "flat" in lower.reason


def test_corrections_through_stacked_zones_settle_or_are_denied() -> None:
    floors = [altitude(f"f{n}", [zone(f"z{n}", EVERYWHERE, lower=n * 10, upper=n * 10 + 5)], lowerLimit=n * 10 + 10) for n in range(1, 11)]  # fmt: skip
    climb = Call("Takeoff", TakeoffArgs(5))
    ground = at(alt=0.0, in_air=False)
    short = ask(compiled(altitude(lowerLimit=10), *floors[:4]), climb, ground)
    assert (short.action, short.args) == ("correct", TakeoffArgs(50.2))
    endless = ask(compiled(altitude(lowerLimit=10), *floors), climb, ground)
    assert (endless.action, endless.code) == ("deny", "ConflictingLimits")


def test_correction_never_causes_takeover() -> None:
    below = exclusion(box(40, -50, 90, 50), "revoke", upper=60)
    grant = compiled(altitude(upperLimit=50), below)
    over = ask(grant, goto(150, 0, 90), at(alt=90))
    assert (over.action, over.code, over.policies) == ("deny", "ConflictingLimits", ("altitudes", "no-fly"))
    assert ask(grant, goto(150, 0, 45), at(alt=45)).takeover == "revoke", "the requested leg enters the zone"
    assert ask(grant, goto(150, 0, 55), at(alt=55)).takeover == "revoke", (
        "the leg enters the zone, whether it is corrected or not"
    )
    climb = ask(
        compiled(altitude(lowerLimit=30), exclusion(EVERYWHERE, lower=20)), Call("Takeoff", TakeoffArgs(5)), at(alt=0.0)
    )
    assert (climb.code, climb.policies) == ("ConflictingLimits", ("altitudes", "no-fly"))


def test_velocity_corrected_into_fence_is_denied() -> None:
    below = exclusion(box(40, -50, 90, 50), "land", upper=55)
    grant = compiled(altitude(upperLimit=50), below, services=SERVICES)
    return_velocity = ask(grant, Call("SetVelocity", VelocityArgs(0, 0, 0, hold_s=2.0)), at(65, alt=59.0))
    assert (return_velocity.action, return_velocity.code, return_velocity.policies) == (
        "deny",
        "ConflictingLimits",
        ("altitudes", "no-fly"),
    )


@pytest.mark.parametrize("limit", [0.05, 0.0, -5.0, math.nan, -math.inf])
def test_speed_is_not_corrected_to_unachievable_speed(limit: float) -> None:
    grant = compiled(speed(upperLimit=5), services=SERVICES)
    for rule in grant.speed_limits.everywhere:
        # The schema accepts this value, but the engine must not rely on the schema.
        rule.spec.__dict__["upper_limit"] = limit
    for call in (Call("SetSpeed", SetSpeedArgs(3)), goto(50, 0), goto(50, 0, speed_mps=4)):
        verdict = ask(grant, call)
        assert (verdict.action, verdict.policies) == ("deny", ("speeds",)), verdict
    velocity = ask(grant, Call("SetVelocity", VelocityArgs(3, 0)))
    assert velocity.action == ("correct" if limit == 0.05 else "deny")


@pytest.mark.parametrize("limit", [math.inf, math.nan])
def test_speed_is_not_corrected_to_infinity(limit: float) -> None:
    grant = compiled(speed(lowerLimit=5))
    for rule in grant.speed_limits.everywhere:
        rule.spec.__dict__["lower_limit"] = limit
    assert ask(grant, Call("SetSpeed", SetSpeedArgs(3))).action == "deny"


# Random policies and their plain implementation


@dataclass
class Plain:
    """Rule in the representation of the oracle. A rule without corners applies everywhere."""

    kind: str
    corners: Corners
    band: tuple[float, float]
    lower: float = -math.inf
    upper: float = math.inf

    def meets(self, low: float, high: float) -> bool:
        return low <= self.band[1] and high >= self.band[0]

    def around(self, x: float, y: float) -> bool:
        if not self.corners:
            return True
        odd = False
        for (x0, y0), (x1, y1) in zip(self.corners, self.corners[1:] + self.corners[:1], strict=True):
            if (y0 > y) != (y1 > y) and x < (x1 - x0) * (y - y0) / (y1 - y0) + x0:
                odd = not odd
        return odd


@dataclass
class World:
    """Random policies, compiled for the engine and as plain rules for the oracle."""

    seed: int
    rules: list[Plain] = field(default_factory=list)
    bodies: list[dict[str, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Draw the policies."""
        self.draw = random.Random(self.seed)
        for n in range(self.draw.randint(1, 5)):
            self.draw.choice((self._altitude, self._altitude, self._speed, self._exclusion, self._inclusion))(f"p{n}")
        if self.draw.random() < 0.1:
            area = self._zone("deny", 30)[0]
            method = self.draw.choice(["Goto", "SetSpeed", "Takeoff", "SetVelocity"])
            self.bodies.append(policy("deny", "AccessControl", "denial", [area], methods=[method]))
        if self.draw.random() < 0.1:
            self.bodies.append(policy("faces", "PrivacyControl", "camera", action="blurFaces"))
        self.grant = compiled(*self.bodies, operationArea=[], services=SERVICES)

    def _zone(self, name: str, size: float) -> tuple[dict[str, Any], Corners, tuple[float, float]]:
        draw = self.draw
        x = draw.uniform(-60, 60)
        y = draw.uniform(-60, 60)
        count = draw.randint(3, 7)
        turn = draw.uniform(0, 6)
        angles = [turn + 2 * math.pi * n / count for n in range(count)]
        radii = [size * draw.uniform(0.5, 1) for _ in angles]
        corners = [(x + r * math.cos(a), y + r * math.sin(a)) for a, r in zip(angles, radii, strict=True)]
        if draw.random() < 0.3:
            return zone(name, ring(corners)), corners, (-math.inf, math.inf)
        low = draw.uniform(0, 60)
        high = low + draw.uniform(1, 30)
        shift = draw.choice((0.0, HOME.amsl_m))
        band = {"lower": low + shift, "upper": high + shift, "reference": "amsl" if shift else "home"}
        return zone(name, ring(corners), **band), corners, (low, high)

    def _limits(self, low: float, high: float) -> dict[str, float]:
        edges = sorted((self.draw.uniform(low, high), self.draw.uniform(low, high)))
        named = dict(zip(("lowerLimit", "upperLimit"), edges, strict=True))
        return {k: v for k, v in named.items() if len(named) < 2 or self.draw.random() < 0.7} or {
            "upperLimit": edges[1]
        }

    def _limit(self, name: str, kind: str, low: float, high: float) -> None:
        zones = []
        corners = []
        band = (-math.inf, math.inf)
        if self.draw.random() < 0.7:
            area, corners, band = self._zone(f"{name}-z", 100)
            zones = [area]
        limits = self._limits(low, high)
        action = self.draw.choice(("enforce", "enforce", "enforce", "refuse"))
        self.bodies.append(policy(name, "LimitControl", kind, zones, action=action, **limits))
        edges = (limits.get("lowerLimit", -math.inf), limits.get("upperLimit", math.inf))
        self.rules.append(Plain(kind, corners, band, *edges))

    def _altitude(self, name: str) -> None:
        self._limit(name, "altitude", 3, 70)

    def _speed(self, name: str) -> None:
        self._limit(name, "speed", 0.5, 9)

    def _exclusion(self, name: str) -> None:
        area, corners, band = self._zone(f"{name}-z", 30)
        action = self.draw.choice(("adjust", "adjust", "ignore", "hover", "revoke"))
        self.bodies.append(policy(name, "GeofenceControl", "exclusion", [area], action=action))
        self.rules.append(Plain("exclusion", corners, band))

    def _inclusion(self, name: str) -> None:
        area, corners, band = self._zone(f"{name}-z", 150)
        action = self.draw.choice(("adjust", "adjust", "ignore"))
        self.bodies.append(policy(name, "GeofenceControl", "inclusion", [area], action=action))
        self.rules.append(Plain("inclusion", corners, band))

    def call(self) -> tuple[Call, Situation]:
        """Return a random request and situation."""
        draw = self.draw
        method = draw.choice(("Goto", "Goto", "Goto", "Takeoff", "SetSpeed", "SetVelocity"))
        x = draw.uniform(-80, 80)
        y = draw.uniform(-80, 80)
        alt = draw.uniform(3, 90)
        motion: dict[str, float] = {}
        if draw.random() < 0.4:
            motion = {
                "north_mps": draw.uniform(-6, 6),
                "east_mps": draw.uniform(-6, 6),
                "down_mps": draw.uniform(-1, 1),
            }
        match method:
            case "Goto":
                fast = draw.uniform(0.5, 14) if draw.random() < 0.5 else None
                altitude_m = draw.uniform(1, 90) if draw.random() < 0.8 else None
                return goto(draw.uniform(-80, 80), draw.uniform(-80, 80), altitude_m, speed_mps=fast), at(
                    x, y, alt, **motion
                )
            case "Takeoff":
                return Call("Takeoff", TakeoffArgs(draw.uniform(0.5, 90))), at(x, y, 0.0, in_air=False)
            case "SetSpeed":
                return Call("SetSpeed", SetSpeedArgs(draw.uniform(0.1, 14))), at(x, y, alt, **motion)
            case _:
                velocity = VelocityArgs(draw.uniform(-9, 9), draw.uniform(-9, 9), draw.uniform(-2, 2))
                return Call("SetVelocity", velocity), at(x, y, alt, **motion)


@dataclass(frozen=True)
class Motion:
    """Motion that the arguments of a call cause: points on the ground, altitude range, and speed."""

    points: list[tuple[float, float]]
    heights: tuple[float, float]
    fast: float | None
    method: str


def motion(args: Args, now: Situation) -> Motion:
    assert now.lat is not None
    assert now.lon is not None
    x, y = FRAME.xy(now.lat, now.lon)
    altitude_now_m = now.altitude_m
    match args:
        case GotoArgs(lat, lon, alt, _, _, speed_mps):
            to = FRAME.xy(lat, lon)
            points = [(x + (to[0] - x) * n / 60, y + (to[1] - y) * n / 60) for n in range(61)]
            fast = now.speed_setpoint_mps if speed_mps is None else speed_mps
            return Motion(points, (altitude_now_m, altitude_now_m if alt is None else alt), fast, "Goto")
        case TakeoffArgs(altitude_m):
            return Motion([(x, y)], (altitude_now_m, altitude_m), None, "Takeoff")
        case SetSpeedArgs(speed_mps):
            return Motion([(x, y)], (altitude_now_m, altitude_now_m), speed_mps, "SetSpeed")
        case VelocityArgs(north, east, _, _, hold_s):
            # A moving drone deviates from the straight line. tests/component/policy_flights.py covers this case.
            resting = math.hypot(now.north_mps, now.east_mps) == 0
            points = [(x + east * hold_s * n / 10, y + north * hold_s * n / 10) for n in range(11 if resting else 1)]
            return Motion(points, (altitude_now_m, altitude_now_m), math.hypot(north, east), "SetVelocity")
    raise AssertionError(args)


def broken(rules: list[Plain], args: Args, now: Situation) -> Iterator[str]:
    """Yield the rules of the oracle that the arguments of a call violate."""
    done = motion(args, now)
    if done.fast is not None and not (0 <= done.fast < math.inf and (done.fast > 0 or done.method == "SetVelocity")):
        yield f"flies at {done.fast}"
    for rule in rules:
        along = [rule.around(*point) for point in done.points]
        if _breaks(rule, done, along):
            yield f"{done} breaks {rule}"


def _breaks(rule: Plain, done: Motion, along: list[bool]) -> bool:
    end = done.heights[1]
    fast = done.fast
    met = any(along) and rule.meets(min(done.heights), max(done.heights))
    match rule.kind:
        case "speed" if fast is not None:
            # Hovering is always permitted, so lower speed limits do not apply to velocities.
            slow = fast < rule.lower - 1e-3 and done.method != "SetVelocity"
            return met and (slow or fast > rule.upper + 1e-3)
        case "altitude" if done.method in {"Goto", "Takeoff"}:
            return met and not rule.lower - 1e-3 <= end <= rule.upper + 1e-3
        case "exclusion" if done.method != "SetSpeed":
            # A drone inside a zone may leave it.
            return (met and not along[0]) or (along[-1] and rule.meets(end, end) and done.method == "Goto")
        case "inclusion" if done.method in {"Goto", "Takeoff"}:
            return not along[-1] or not rule.band[0] <= end <= rule.band[1]
    return False


def corrections(seeds: range) -> Iterator[tuple[World, Call, Situation, Verdict]]:
    """Yield random calls that the engine corrects, or denies because no correction complies with all limits."""
    for seed in seeds:
        world = World(seed)
        for _ in range(4):
            call, now = world.call()
            verdict = ask(world.grant, call, now)
            if verdict.action == "correct" or verdict.code == "ConflictingLimits":
                yield world, call, now, verdict


def test_corrected_calls_are_allowed_unchanged_and_break_no_policy() -> None:
    corrected = dict.fromkeys(("Goto", "Takeoff", "SetSpeed", "SetVelocity"), 0)
    again = conflicts = 0
    for world, call, now, verdict in corrections(range(examples(20_000, 400))):
        context = f"seed {world.seed}: {call} in {now} -> {verdict}"
        if verdict.action == "deny":
            conflicts += 1
            assert verdict.policies, context
            assert all(name in verdict.reason for name in verdict.policies), context
            continue
        corrected[call.method] += 1
        again += verdict.reason.count("corrected") > 1
        assert holds(world.grant, call, verdict, now), context
        # The oracle skips calls that begin with a stop, because the engine judges them again after the stop.
        assert verdict.brake_first or not list(broken(world.rules, verdict.args, now)), context
    assert min(corrected.values()) > 10, corrected
    assert again > 5
    assert conflicts > 5


def test_correction_oracle_detects_unsettled_corrections(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "settle_correction", lambda _call, first, _judge: first)
    assert any(
        verdict.permits and not verdict.brake_first and any(broken(world.rules, verdict.args, now))
        for world, _, now, verdict in corrections(range(400))
    )

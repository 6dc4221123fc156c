"""Oracle for the policy engine: thousands of drones flown in small steps through random policies.

The oracle and the engine share only the types of calls and verdicts. The oracle projects positions on a flat Earth. It
uses ray casting to distinguish inside from outside. It integrates ArduPilot's jerk-limited position controller with
wind, latency and position errors. These errors stay within the bounds that the engine gets. The computation is
vectorised over drones, except for the calls of the engine.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any, Protocol

import numpy as np
from fractus_core.api.methods import Method
from fractus_core.policy.compiled_grant import CompiledGrant
from fractus_core.policy.decision_types import (
    Airframe,
    Call,
    GotoArgs,
    SetSpeedArgs,
    Situation,
    UncertainTime,
    VelocityArgs,
    Verdict,
)
from fractus_core.policy.engine import judge
from fractus_core.policy.monitoring import monitor
from fractus_core.policy.return_route import return_bounds
from fractus_services.mobility.mavlink.mavlink_autopilot import is_turning
from numpy.typing import NDArray
from policy_world import HOME, METHODS, NOW, commanded_mps, compiled, policy, ring

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

STEP_S = 0.05
STANDING_MPS = 0.02
ZONES = 7
CORNERS = 8
ACCELS = (1.0, 2.5, 2.5, 3.5)
CLIMB_ACCELS = (1.0, 1.0, 2.0)
JERKS = (3.0, 5.0, 5.0, 8.0)
GAIN = 1.0
"""Values of WPNAV_ACCEL, WPNAV_ACCEL_Z and PSC_JERK_XY, in m/s2 and m/s3, and of the position gain PSC_POSXY_P."""
NEAR_BORDER = 0.25
"""Fraction of drones that start at the border of an inclusion zone, if their scene has one."""
NEAR_LIMIT = 0.4
"""Fraction of drones that start near the floor or ceiling of a zone, and of requests to fly there."""
NEAR_LIMIT_M = 2.5
"""Greatest distance of these altitudes from the floor or ceiling."""
CHANGED = 0.04
"""Fraction of vehicles whose parameters change between two requests."""
RETURNS_M = (3.0, 15.0, 15.0, 40.0)
"""Values of RTL_ALT in metres."""
UP_MPS = 2.5
DOWN_MPS = 1.5
RATIO = 4.0
"""ArduPilot's CONTROL_TIME_CONSTANT_RATIO. With this value it plans to brake with 3/4 of its acceleration."""
POSITION_ERROR_M = 1.5
HEIGHT_ERROR_M = 1.0
TRACKING_M = 1.0
OVERSHOOT_M = 0.2
"""Height by which the vehicle may climb or sink past a commanded altitude."""
LATENCY_S = (0.05, 0.8)
"""Range of the time until a command takes effect: round-trip delay of the link, plus reaction time of the autopilot."""
COURSE_S = 0.3
"""Age of a reported acceleration. Setpoints that were sent within this time are reported as pending."""
RESEND_S = 0.2
"""Interval at which the service sends a velocity setpoint until its hold time ends. A zero velocity follows."""
STILL = (0.0, 0.0, 0.0)
MINUTE_S = 60
DAY_MIN = 1440
DOUBT_MIN = 2 * DAY_MIN
"""Maximum error of an uncertain clock in minutes: difference between its readings and NOW, the time of the flights."""
DAYS = ("Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun")
NOW_DAY = 0
"""Index of the weekday of NOW."""
NORTH_M = 110_998.6
EAST_M = math.cos(math.radians(HOME.lat)) * 111_457.6
"""Metres per degree of latitude and longitude at home (WGS 84). The error within a scene is a few centimetres."""
EXCLUSION = 1
INCLUSION = 2
LIMIT = 3
SERVICES = [{"service": "mobility", "methods": [*METHODS, "SetVelocity"]}]
METHOD_OF: dict[type, Method] = {GotoArgs: "Goto", VelocityArgs: "SetVelocity", SetSpeedArgs: "SetSpeed"}
_CIRCLE = np.array([(math.cos(a), math.sin(a)) for a in np.arange(16) * math.pi / 8])


@dataclass
class Scene:
    """Policies in the representation of the oracle: kind, position and altitude range of each zone.

    Attributes:
        rings: Corners of the zones in metres, shape (ZONES, CORNERS, 2). Rings with fewer corners repeat the last one.
        kinds: EXCLUSION, INCLUSION, LIMIT, or 0 for an empty or inactive slot, shape (ZONES,).
        bands: Altitude range of the zone in metres above home, shape (ZONES, 2).
        limits: Permitted altitudes inside a zone of kind LIMIT, in metres above home, shape (ZONES, 2).
        heights: Lower and upper altitude limit that apply everywhere, in metres above home.
        time_s: Time of the flights, in doubt for some scenes.
    """

    grant: CompiledGrant
    rings: Floats
    kinds: NDArray[np.int64]
    bands: Floats
    limits: Floats
    heights: tuple[float, float]
    top_mps: float
    time_s: float = NOW

    def airframe(self, rng: np.random.Generator) -> Airframe:
        """Return a random vehicle. Its return altitude respects the limits, as the service ensures before arming."""
        at_home = Situation(time_s=self.time_s, lat=HOME.lat, lon=HOME.lon, altitude_m=0.0, home=HOME)
        ceiling_m = math.floor(return_bounds(at_home, self.grant).height_m * 100) / 100
        return Airframe(
            accel_mps2=float(rng.choice(ACCELS)), climb_accel_mps2=float(rng.choice(CLIMB_ACCELS)),
            jerk_mps3=float(rng.choice(JERKS)), return_altitude_m=min(float(rng.choice(RETURNS_M)), ceiling_m),
            retraces=bool(rng.random() < 0.5),
        )  # fmt: skip

    def altitude_near_edge(self, rng: np.random.Generator) -> float | None:
        """Return an altitude near the floor or ceiling of a random zone, or None if no zone has one."""
        edges = self.bands[self.kinds > 0].ravel()
        edges = edges[np.isfinite(edges)]
        if not len(edges):
            return None
        return max(float(rng.choice(edges) + rng.uniform(-NEAR_LIMIT_M, NEAR_LIMIT_M)), 1.0)


def scene(rng: np.random.Generator) -> Scene:
    """Return a random set of policies."""
    rings = np.full((ZONES, CORNERS, 2), 1e6)
    kinds = np.zeros(ZONES, dtype=np.int64)
    bands = np.tile(np.array([-np.inf, np.inf]), (ZONES, 1))
    limits = bands.copy()
    time_s, minutes = _moments(rng)
    policies: list[dict[str, Any]] = []
    slot = 0
    for _ in range(int(rng.integers(1, 5))):
        zone, active = _zone(rng, slot, rings, bands, rng.uniform(4, 28), rng.uniform(-70, 70, 2), minutes)
        action = rng.choice(["ignore", "adjust", "adjust", "hover", "land", "returnToLaunch", "abort", "revoke"])
        window, valid = _validity(rng, minutes)
        policies.append(policy(f"out-{slot}", "GeofenceControl", "exclusion", [zone], action=str(action), **window))
        kinds[slot] = EXCLUSION if (active & valid).any() else 0
        slot += 1
    if rng.random() < 0.3:
        zones = []
        window, valid = _validity(rng, minutes)
        for _ in range(int(rng.integers(1, 3))):
            size = rng.uniform(60, 110) if rng.random() < 0.7 else rng.uniform(20, 60)
            zone, active = _zone(rng, slot, rings, bands, size, rng.uniform(-20, 20, 2), minutes)
            zones.append(zone)
            kinds[slot] = INCLUSION if valid.any() else 0
            # A zone that is inactive at some time permits nothing: its band contains no altitude.
            if not active.all():
                bands[slot] = (np.inf, -np.inf)
            slot += 1
        action = str(rng.choice(["ignore", "adjust"]))
        policies.append(policy("in", "GeofenceControl", "inclusion", zones, action=action, **window))
    if rng.random() < 0.4:
        zone, active = _zone(rng, slot, rings, bands, rng.uniform(8, 40), rng.uniform(-60, 60, 2), minutes)
        low, high = sorted(rng.uniform(3, 50, 2))
        window, valid = _validity(rng, minutes)
        policies.append(policy("zoned", "LimitControl", "altitude", [zone], lowerLimit=low, upperLimit=high, **window))
        kinds[slot] = LIMIT if (active & valid).any() else 0
        limits[slot] = (low, high)
    heights = (-np.inf, 120.0)
    top = 15.0
    if rng.random() < 0.5:
        heights = (float(rng.uniform(2, 10)), float(rng.uniform(12, 60)))
        action = str(rng.choice(["enforce", "enforce", "refuse"]))
        limit = {"lowerLimit": heights[0], "upperLimit": heights[1], "action": action}
        policies.append(policy("heights", "LimitControl", "altitude", **limit))
    if rng.random() < 0.3:
        top = float(rng.uniform(2, 10))
        policies.append(policy("speeds", "LimitControl", "speed", upperLimit=top))
    grant = compiled(*policies, operationArea=[], services=SERVICES)
    return Scene(grant, rings, kinds, bands, limits, heights, top, time_s)


def _moments(rng: np.random.Generator) -> tuple[float, NDArray[np.int64]]:
    """Return the time of a scene, and all its minutes since NOW: NOW, or any minute between readings of a clock in doubt."""
    if rng.random() < 0.6:
        return NOW, np.zeros(1, dtype=np.int64)
    reach = int(rng.choice([5, 240, DOUBT_MIN]))
    first, last = -int(rng.integers(0, reach)), int(rng.integers(1, reach))
    return UncertainTime(NOW + last * MINUTE_S, NOW + first * MINUTE_S), np.arange(first, last + 1)


def _validity(rng: np.random.Generator, minutes: NDArray[np.int64]) -> tuple[dict[str, Any], Flags]:
    """Return a random validity of a policy as fields of its spec, and whether it includes each minute."""
    if rng.random() < 0.8:
        return {}, np.ones(len(minutes), dtype=bool)
    begin, end = sorted(int(m) for m in rng.choice(DOUBT_MIN, 2, replace=False) - DOUBT_MIN // 2)
    fields = {"validFrom": begin, "validUntil": end}
    if rng.random() < 0.3:
        del fields["validUntil"]
        end = DOUBT_MIN
    texts = {k: datetime.fromtimestamp(NOW + m * MINUTE_S, UTC).isoformat() for k, m in fields.items()}
    return texts, (begin <= minutes) & (minutes < end)


def _schedule(rng: np.random.Generator, minutes: NDArray[np.int64]) -> tuple[list[dict[str, Any]], Flags]:
    """Return a random schedule of a zone, and whether it includes each minute."""
    times = []
    active = np.zeros(len(minutes), dtype=bool)
    noon = NOW % (DAY_MIN * MINUTE_S) / MINUTE_S
    for _ in range(int(rng.integers(1, 3))):
        begin, end = (int(m) for m in rng.choice(DAY_MIN, 2, replace=False))
        time: dict[str, Any] = {"start": f"{begin // 60:02}:{begin % 60:02}", "end": f"{end // 60:02}:{end % 60:02}"}
        days = sorted(int(d) for d in rng.choice(7, 3, replace=False)) if rng.random() < 0.4 else list(range(7))
        if len(days) < 7:
            time["days"] = [DAYS[d] for d in days]
        times.append(time)
        # Minutes since the midnight before NOW.
        since = minutes + int(noon)
        for day in range(-4, 4):
            if (NOW_DAY + day) % 7 in days:
                lasts = (end - begin) % DAY_MIN
                active |= (since >= day * DAY_MIN + begin) & (since < day * DAY_MIN + begin + lasts)
    return times, active


def _zone(
    rng: np.random.Generator,
    slot: int,
    rings: Floats,
    bands: Floats,
    size: float,
    middle: Floats,
    minutes: NDArray[np.int64],
) -> tuple[dict[str, Any], Flags]:
    """Add a random star-shaped zone to a slot of the scene. Return the zone, and whether it is active at each minute."""
    count = int(rng.integers(3, CORNERS + 1))
    turn = rng.uniform(0, 2 * math.pi) + 2 * math.pi * np.arange(count) / count
    radii = size * rng.uniform(0.45, 1.0, count)
    corners = middle + np.column_stack((np.cos(turn), np.sin(turn))) * radii[:, None]
    rings[slot, :count] = corners
    rings[slot, count:] = corners[-1]
    zone: dict[str, Any] = {"name": f"z{slot}", "area": ring([tuple(c) for c in corners.tolist()])}
    if rng.random() < 0.35:
        low, high = sorted(rng.uniform(0, 70, 2))
        amsl = rng.random() < 0.4
        shift = HOME.amsl_m if amsl else 0.0
        zone["altitude"] = {"lower": low + shift, "upper": high + shift + 1.0, "reference": "amsl" if amsl else "home"}
        bands[slot] = (low, high + 1.0)
    active = np.ones(len(minutes), dtype=bool)
    if rng.random() < 0.3:
        zone["schedule"], active = _schedule(rng, minutes)
    return zone, active


@dataclass(frozen=True)
class Walls:
    """Edges of rings for ray casting.

    Attributes:
        y0: Coordinate north of the first end.
        y1: Coordinate north of the second end.
        x0: Coordinate east at which the line through the edge crosses north 0.
        slope: Change of the coordinate east per metre north.
    """

    y0: Floats
    y1: Floats
    x0: Floats
    slope: Floats

    @classmethod
    def of(cls, rings: Floats) -> Walls:
        """Return the edges of rings, an array of shape (drones, zones, corners, 2)."""
        x = rings[..., 0]
        y = rings[..., 1]
        rise = np.roll(y, -1, axis=2) - y
        slope = (np.roll(x, -1, axis=2) - x) / np.where(rise == 0, 1.0, rise)
        return cls(y, np.roll(y, -1, axis=2), x - slope * y, slope)

    def of_some(self, rows: NDArray[np.int64]) -> Walls:
        """Return the edges for the drones in `rows`."""
        return Walls(self.y0[rows], self.y1[rows], self.x0[rows], self.slope[rows])

    def around(self, points: Floats) -> Flags:
        """Return which rings contain the points, by ray casting to the east.

        Shapes: points (drones, 2), result (drones, zones).
        """
        x = points[:, None, None, 0]
        y = points[:, None, None, 1]
        hits = ((self.y0 > y) != (self.y1 > y)) & (x < self.x0 + self.slope * y)
        odd: Flags = np.logical_xor.reduce(hits, axis=2)
        return odd


_ROWS = (
    "place", "speed", "accel", "error", "gust", "settled", "beat", "phase", "latency", "goal", "cruise", "setpoint", "velocity_setpoint",
    "held", "until",
)  # fmt: skip


@dataclass
class Fleet:
    """State of drones in flight, one row per drone: motion in its position controller, and disturbances."""

    rng: np.random.Generator
    scenes: list[Scene]
    place: Floats = field(init=False)
    """Position in the vehicle's position controller: metres east, north and up."""
    speed: Floats = field(init=False)
    accel: Floats = field(init=False)
    airframes: list[Airframe] = field(init=False)

    def __post_init__(self) -> None:
        """Give each drone a random position, velocity, wind and position error."""
        rng = self.rng
        count = len(self.scenes)
        (generator,) = rng.spawn(1)
        self.airframes = [s.airframe(generator) for s in self.scenes]
        self.place = np.column_stack((rng.uniform(-80, 80, (count, 2)), rng.uniform(3, 45, count)))
        angle = rng.uniform(0, 2 * math.pi, count)
        fast = rng.uniform(0, 8, count) * (rng.random(count) < 0.7)
        climb = rng.uniform(-1.5, 2.0, count) * (rng.random(count) < 0.4)
        self.speed = np.column_stack((fast * np.cos(angle), fast * np.sin(angle), climb))
        self.accel = np.zeros((count, 3))
        for i in np.flatnonzero(generator.random(count) < NEAR_LIMIT).tolist():
            self.place[i, 2] = self.scenes[i].altitude_near_edge(generator) or self.place[i, 2]
        for i in np.flatnonzero(generator.random(count) < NEAR_BORDER).tolist():
            self._start_at_border(i, generator)
        self.walls = Walls.of(np.stack([s.rings for s in self.scenes]))
        self.kinds = np.stack([s.kinds for s in self.scenes])
        self.bands = np.stack([s.bands for s in self.scenes])
        self.limits = np.stack([s.limits for s in self.scenes])
        self.heights = np.array([s.heights for s in self.scenes])
        self.error = np.column_stack(
            (_disc(rng, count, POSITION_ERROR_M), rng.uniform(-HEIGHT_ERROR_M, HEIGHT_ERROR_M, count))
        )
        self.gust = np.column_stack((_disc(rng, count, TRACKING_M), rng.uniform(-TRACKING_M, TRACKING_M, count)))
        self.settled = np.zeros((count, 3))
        """Displacement of each drone by wind, at the time when its current course began."""
        self.beat = rng.uniform(0.05, 0.4, count)
        self.phase = rng.uniform(0, 2 * math.pi, count)
        self.latency = rng.uniform(*LATENCY_S, count)
        self.sent: list[list[tuple[float, float, tuple[float, float, float]]]] = [[] for _ in range(count)]
        """Velocity setpoints of each drone in the order of arrival, with the times of first and last transmission."""
        self.mail: list[tuple[float, int, Verdict]] = []
        self.last_calls: list[Call | None] = [None] * count
        self.legs: list[GotoArgs | None] = [None] * count
        """Current Goto target of each drone, or None if its last command was not a Goto."""
        self.time_s = 0.0
        self._estimated: Floats | None = None
        # The current command of each drone: fly to `goal` with `cruise`, or hold `velocity_setpoint` until `until`.
        self.goal = self.place.copy()
        self.cruise = np.full(count, 5.0)
        self.setpoint = np.full(count, 5.0)
        self.velocity_setpoint = np.zeros((count, 3))
        self.held = np.zeros(count, dtype=bool)
        self.arrives, self.surely_returns = (np.zeros(count, dtype=bool) for _ in range(2))
        """`surely_returns`: drones on a leg from whose end a legal return flight exists."""
        self.until = np.zeros(count)
        self.learn()
        # A drone without a command stops.
        self.stop(np.arange(count))

    def _start_at_border(self, i: int, rng: np.random.Generator) -> None:
        """Let a drone hover beside the border of an inclusion zone, if its scene has one."""
        place = self.scenes[i]
        slots = np.flatnonzero((place.kinds == INCLUSION) & (place.bands[:, 0] < place.bands[:, 1]))
        if not len(slots):
            return
        slot = rng.choice(slots)
        low, high = np.clip(place.bands[slot], 3.0, 45.0)
        edge = rng.integers(0, CORNERS)
        first, second = place.rings[slot, edge], place.rings[slot, (edge + 1) % CORNERS]
        border = first + (second - first) * rng.random()
        self.place[i] = (*(border + rng.uniform(-JUST_M, JUST_M, 2)), rng.uniform(low - JUST_M, high + JUST_M))
        self.speed[i] = 0.0

    def learn(self) -> None:
        """Copy the controller limits from `airframes` to arrays."""
        self.accels, self.climbs, self.jerks = (
            np.array([getattr(a, name) for a in self.airframes])
            for name in ("accel_mps2", "climb_accel_mps2", "jerk_mps3")
        )

    def part(self, rows: NDArray[np.int64]) -> Fleet:
        """Return a copy of the drones in `rows`. The copies fly independently of this fleet."""
        selected = Fleet(np.random.default_rng(0), [self.scenes[i] for i in rows])
        selected.rng = self.rng
        selected.time_s = self.time_s
        selected.airframes = [self.airframes[i] for i in rows]
        for name in _ROWS:
            setattr(selected, name, getattr(self, name)[rows].copy())
        selected.learn()
        return selected

    def sway(self) -> Floats:
        """Return the displacement of each drone by wind.

        The displacement is relative to the observed position at which the current course began, and is bounded.
        """
        return (self._wind() - self.settled) / 2

    def _wind(self) -> Floats:
        return self.gust * np.sin(self.beat * self.time_s + self.phase)[:, None]

    @property
    def estimated(self) -> Floats:
        """Return the position that each drone estimates."""
        if self._estimated is None:
            self._estimated = self.place + self.sway()
        return self._estimated

    @property
    def true(self) -> Floats:
        """Return the true position of each drone."""
        return self.estimated + self.error

    def stop(self, rows: NDArray[np.int64]) -> None:
        """Make drones fly to the nearest positions at which their controllers can stop."""
        for axes, accels in ((slice(0, 2), self.accels), (slice(2, 3), self.climbs)):
            accel = accels[rows]
            moving = self.speed[rows, axes]
            fast = np.linalg.norm(moving, axis=1)
            run = np.where(fast < accel / GAIN, fast / GAIN, accel / (2 * GAIN**2) + fast**2 / (2 * accel))
            ahead = moving / np.maximum(fast, 1e-9)[:, None] * run[:, None]
            self.goal[rows, axes] = self.place[rows, axes] + ahead
        self.held[rows] = False
        self.cruise[rows] = 20.0
        self.velocity_setpoint[rows] = 0.0

    def step(self) -> None:
        """Advance by one step and receive the messages that have arrived."""
        for due_s, i, verdict in [letter for letter in self.mail if letter[0] <= self.time_s]:
            self.mail.remove((due_s, i, verdict))
            self.obey(i, verdict)
        late = self.held & (self.time_s >= self.until)
        if late.any():
            self.stop(np.flatnonzero(late))
        self._axes(slice(0, 2), self.accels, self.cruise, self.cruise)
        self._axes(slice(2, 3), self.climbs, np.full(len(self.place), UP_MPS), np.full(len(self.place), DOWN_MPS))
        self._estimated = None
        self.place = self.place + self.speed * STEP_S
        self.time_s += STEP_S

    def _axes(self, axes: slice, accel: Floats, most: Floats, least: Floats) -> None:
        """Integrate ArduPilot's shape_pos_vel_accel (AP_Math/control.cpp) jointly for the given axes."""
        off = self.goal[:, axes] - self.place[:, axes]
        away = np.linalg.norm(off, axis=1)
        most = np.where(off[:, -1] < 0, least, most) if off.shape[1] == 1 else most
        velocity = (
            off
            / np.maximum(away, 1e-9)[:, None]
            * np.minimum(_root(away, self.jerks / (RATIO * accel), (1 - 1 / RATIO) * accel), most)[:, None]
        )
        velocity = np.where(self.held[:, None], self.velocity_setpoint[:, axes], velocity)
        change = velocity - self.speed[:, axes]
        size = np.linalg.norm(change, axis=1)
        push = np.minimum(_root(size, self.jerks / accel, self.jerks), accel)
        # The controller plans to reach its target within one step. Otherwise it would oscillate around it.
        target = change / np.maximum(size, 1e-9)[:, None] * np.minimum(push, size / STEP_S)[:, None]
        step = target - self.accel[:, axes]
        jerk = np.linalg.norm(step, axis=1)
        self.accel[:, axes] += step * np.minimum(1.0, self.jerks * STEP_S / np.maximum(jerk, 1e-9))[:, None]
        self.speed[:, axes] += self.accel[:, axes] * STEP_S

    def situation(self, i: int, *, measured: bool) -> Situation:
        """Return the Situation of a drone, as the service passes it to the engine.

        The situation contains the acceleration only if `measured` is set.
        """
        x, y, z = self.estimated[i]
        # Derivative of `sway`.
        drift = self.gust[i] * self.beat[i] * math.cos(self.beat[i] * self.time_s + self.phase[i]) / 2
        east, north, up = (float(v) for v in self.speed[i] + drift)
        ground = math.hypot(east, north)
        tends = float(np.linalg.norm(self.velocity_setpoint[i, :2]))
        forward = float(self.accel[i, 0] * east + self.accel[i, 1] * north) / max(ground, 0.05) if measured else None
        return Situation(
            time_s=self.scenes[i].time_s, lat=float(HOME.lat + y / NORTH_M), lon=float(HOME.lon + x / EAST_M), altitude_m=float(z), north_mps=north, east_mps=east,
            down_mps=-up, home=HOME, armed=True, in_air=True, position_error_m=POSITION_ERROR_M,
            altitude_error_m=HEIGHT_ERROR_M, latency_s=float(self.latency[i]), pending=self._pending(i), speed_setpoint_mps=max(float(self.setpoint[i]), tends), forward_mps2=forward,
            airframe=self.airframes[i],
        )  # fmt: skip

    def _pending(self, i: int) -> tuple[tuple[float, float, float], ...]:
        """Return the setpoints that may not yet have affected the reported state of a drone."""
        now = self.time_s
        since = self.time_s - float(self.latency[i]) - COURSE_S
        late = [item for item in self.sent[i] if item[1] >= since]
        before = [item for item in self.sent[i] if item[1] < since][-1:]
        east, north, up = (float(v) for v in self.speed[i])
        self.sent[i] = [item for item in before if is_turning((north, east, -up), item[2])] + late
        return tuple(dict.fromkeys(velocity for at, _, velocity in reversed(self.sent[i]) if at <= now))[::-1]

    def send(self, i: int, verdict: Verdict, *, returns: bool = False) -> None:
        """Send the command of a verdict to a drone. It arrives within the latency, and after all earlier commands.

        Args:
            returns: True if the engine has verified that the drone can return from the end of the leg.
        """
        self.surely_returns[i] = returns or (self.surely_returns[i] and isinstance(verdict.args, SetSpeedArgs))
        args = verdict.args
        velocity = STILL
        hold_s = 0.0
        if isinstance(args, SetSpeedArgs):
            self.mail.append((self.time_s + self.rng.uniform(0, float(self.latency[i])), i, verdict))
            return
        if isinstance(args, VelocityArgs) and not verdict.brake_first:
            velocity = (args.north_mps, args.east_mps, args.down_mps)
            hold_s = args.hold_s
        elif isinstance(args, GotoArgs) and not verdict.brake_first:
            x, y, z = self.estimated[i]
            east = (args.lon - HOME.lon) * EAST_M - x
            north = (args.lat - HOME.lat) * NORTH_M - y
            cruise = (args.speed_mps or float(self.setpoint[i])) / max(math.hypot(east, north), 1e-6)
            rise = (args.alt or z) - z
            velocity = (float(north * cruise), float(east * cruise), math.copysign(UP_MPS, -rise))
        self.legs[i] = args if isinstance(args, GotoArgs) and not verdict.brake_first else None
        now = self.time_s
        self.sent[i] = [(at, min(last, now), was) for at, last, was in self.sent[i] if at < now]
        self.sent[i].append((now, now + max(hold_s - RESEND_S, 0.0), velocity))
        if hold_s:
            self.sent[i].append((now + hold_s, now + hold_s, STILL))
        before = max((due_s for due_s, rows, _ in self.mail if rows == i), default=self.time_s)
        self.mail.append((max(before, self.time_s + self.rng.uniform(0, float(self.latency[i]))), i, verdict))

    def obey(self, i: int, verdict: Verdict) -> None:
        """Execute the command of a verdict, after it has arrived at the drone."""
        args = verdict.args
        if isinstance(args, SetSpeedArgs):
            self.setpoint[i] = args.speed_mps
            self.cruise[i] = self.cruise[i] if self.held[i] else args.speed_mps
            return
        self.place[i] = self.estimated[i]
        self.settled[i] = self._wind()[i]
        self._estimated = None
        self.arrives[i] = isinstance(args, GotoArgs) and not verdict.brake_first and self.surely_returns[i]
        if verdict.brake_first:
            self.stop(np.array([i]))
        elif isinstance(args, GotoArgs):
            self.held[i] = False
            self.goal[i] = ((args.lon - HOME.lon) * EAST_M, (args.lat - HOME.lat) * NORTH_M, args.alt)
            self.setpoint[i] = self.cruise[i] = args.speed_mps or self.setpoint[i]
            self.velocity_setpoint[i] = 0.0
        elif isinstance(args, VelocityArgs):
            self.held[i] = True
            self.velocity_setpoint[i] = (args.east_mps, args.north_mps, -args.down_mps)
            self.until[i] = self.time_s + args.hold_s + self.rng.uniform(0, float(self.latency[i]))

    def trespassing(self) -> Flags:
        """Return the zones that each drone violates, shape (drones, ZONES + 1).

        Each exclusion zone and limit has its own column. The last column is True outside all inclusion zones.
        """
        true = self.true
        fast = np.abs(self.speed).max(axis=1) > STANDING_MPS
        if fast.mean() > 0.5:
            return trespasses(true[:, :2], true[:, 2], self.walls, self.kinds, self.bands, self.limits)
        # A hovering drone moves slowly, so its position is checked only every tenth step.
        fast |= round(self.time_s / STEP_S) % 10 == 0
        broken = np.zeros((len(true), ZONES + 1), dtype=bool)
        rows = np.flatnonzero(fast)
        broken[rows] = trespasses(
            true[rows, :2],
            true[rows, 2],
            self.walls.of_some(rows),
            self.kinds[rows],
            self.bands[rows],
            self.limits[rows],
        )
        return broken


def trespasses(
    points: Floats, heights: Floats, walls: Walls, kinds: NDArray[np.int64], bands: Floats, limits: Floats
) -> Flags:
    """Return the zones violated at the given points. The last column is True outside all inclusion zones."""
    inside = walls.around(points)
    up = heights[:, None]
    within = (bands[..., 0] <= up) & (up <= bands[..., 1])
    allowed = (limits[..., 0] - LIMIT_SLACK_M <= up) & (up <= limits[..., 1] + LIMIT_SLACK_M)
    broken = inside & within & ((kinds == EXCLUSION) | (~allowed & (kinds == LIMIT)))
    inclusion = kinds == INCLUSION
    outside = inclusion.any(axis=1) & ~(inside & within & inclusion).any(axis=1)
    return np.column_stack((broken, outside))


JUST_M = 0.3
"""Permitted violation of an altitude limit in addition to the declared errors, for overshoot of the controller."""

LIMIT_SLACK_M = HEIGHT_ERROR_M + TRACKING_M + JUST_M
"""Permitted violation of an altitude limit."""


def _root(error: Floats, gain: Floats, limit: Floats) -> Floats:
    """ArduPilot's square-root controller."""
    linear = limit / gain**2
    root = np.sqrt(np.maximum(2 * limit * (error - linear / 2), 0.0))
    return np.where(error > linear, root, error * gain)


def _disc(rng: np.random.Generator, count: int, radius: float) -> Floats:
    """Return random points of a disc. Half of them are on its rim."""
    angle = rng.uniform(0, 2 * math.pi, count)
    far = np.sqrt(np.minimum(rng.uniform(0, 2, count), 1.0)) * radius
    return np.column_stack((far * np.cos(angle), far * np.sin(angle)))


@dataclass
class Tally:
    """Numbers of requests by verdict, and all violations.

    Attributes:
        changed: Number of vehicles whose parameters another station changed in flight.
        system_returns: Number of return flights by the system.
        autopilot_returns: Number of return flights by the autopilot.
        position_faults: Number of simulated faults of the position.
    """

    requests: int = 0
    permitted: int = 0
    corrected: int = 0
    braked: int = 0
    taken: int = 0
    shortened: int = 0
    changed: int = 0
    system_returns: int = 0
    autopilot_returns: int = 0
    position_faults: int = 0
    wrong: list[str] = field(default_factory=list)
    stopped: list[str] = field(default_factory=list)
    """Permitted flights that the monitor stopped."""

    def add(self, other: Tally) -> None:
        """Add another tally."""
        for name in vars(self):
            setattr(self, name, getattr(self, name) + getattr(other, name))


def flights(
    seed: int,
    count: int,
    shared: int = 8,
    requests: int = 3,
    watch_every: int = 0,
    watched: int = 1,
    returns: Returns | None = None,
    faults: Faults | None = None,
    source: Source | None = None,
) -> Tally:
    """Fly a fleet through random scenes, each drone with several requests, and report violations.

    Args:
        seed: Seed of all random numbers.
        count: Number of drones.
        shared: Number of drones that share a scene. Compiling policies takes longer than judging requests.
        requests: Number of requests per drone. Each request interrupts the flight of the previous request.
        watch_every: Number of steps between two checks by the motion monitor. 0 disables the monitor.
        watched: The monitor checks every `watched`-th drone.
        returns: Return flights, or None.
        faults: Faults of the position, or None.
        source: Source of the requests. None for random requests of the SDK.
    """
    rng = np.random.default_rng(seed)
    scenes = [s for s in (scene(rng) for _ in range(math.ceil(count / shared))) for _ in range(shared)][:count]
    fleet = Fleet(rng, scenes)
    tally = Tally()
    exempt = excused(fleet)
    permitted: list[str] = [""] * count
    (generator,) = rng.spawn(1)
    for turn in range(requests):
        if turn:
            _change(fleet, tally, permitted, exempt, generator)
        flown = _request_all(fleet, tally, permitted, rng, watched if watch_every else 0, source)
        called_s = (
            fleet.time_s + generator.uniform(1.5, 8.0) if returns is not None and turn == requests - 1 else math.inf
        )
        # About one in three requests follows so soon that the previous request may not have taken effect yet.
        span_s = 30.0 if turn == requests - 1 else rng.choice([rng.uniform(0.05, 0.6), *rng.uniform(0.4, 7.0, 2)])
        for n in range(int(span_s / STEP_S)):
            fleet.step()
            if returns is not None and fleet.time_s >= called_s:
                called_s = math.inf
                returns.fly_by_system(fleet, exempt, tally)
            if faults is not None and turn and n == FAULT_STEP:
                faults.fly(fleet, exempt, tally)
            if (
                turn == requests - 1
                and math.isinf(called_s)
                and not fleet.mail
                and np.abs(fleet.speed).max() < STANDING_MPS
            ):
                break
            if watch_every and n % watch_every == 0:
                measured(fleet, tally, flown, exempt)
            broken = fleet.trespassing() & ~exempt
            for i in np.flatnonzero(broken.any(axis=1)):
                # Drift in the wind is not a violation if no command was permitted.
                if not permitted[i]:
                    continue
                tally.wrong.append(f"seed {seed}, drone {i}, turn {turn}, {fleet.time_s:.2f} s: {permitted[i]}")
                exempt[i] = True
    if returns is not None:
        returns.fly_by_autopilot(fleet, exempt, tally)
    return tally


FAULT_STEP = 30
"""Step after a request at which positions fail. Most requests have taken effect, and most drones still fly."""


class Faults(Protocol):
    """Simulator of faults of the position. The given fleet is not changed."""

    def fly(self, fleet: Fleet, exempt: Flags, tally: Tally) -> None:
        """Let the position of some flying drones fail."""


class Source(Protocol):
    """Source of random requests."""

    def request(self, rng: np.random.Generator, place: Scene, now: Situation) -> Call | None:
        """Return a request of a drone, or None for no request."""


class Returns(Protocol):
    """Simulator of return flights that begin after the requests. The given fleet is not changed."""

    def fly_by_system(self, fleet: Fleet, exempt: Flags, tally: Tally) -> None:
        """Simulate return flights of some flying drones by the system."""

    def fly_by_autopilot(self, fleet: Fleet, exempt: Flags, tally: Tally) -> None:
        """Simulate return flights of some hovering drones by their autopilots."""


def _change(fleet: Fleet, tally: Tally, permitted: list[str], exempt: Flags, rng: np.random.Generator) -> None:
    """Change parameters of some vehicles as another station does, and inform their services.

    Afterwards, the check ignores requests that were permitted before, and motion that no command can prevent.
    """
    expected = {i for _, i, _ in fleet.mail}
    rows = np.array(
        [i for i in np.flatnonzero(rng.random(len(permitted)) < CHANGED) if i not in expected], dtype=np.int64
    )
    for i in rows:
        other = fleet.scenes[i].airframe(rng)
        fleet.airframes[i] = replace(other, retraces=fleet.airframes[i].retraces)
        permitted[i] = ""
        fleet.arrives[i] = False
    fleet.learn()
    # No request in force has caused the motion of these drones: before a new request, they may already be unable to stop.
    idle = np.array([i for i, text in enumerate(permitted) if not text], dtype=np.int64)
    if len(idle):
        exempt[idle] |= excused(fleet.part(idle))
    tally.changed += len(rows)


Flown = dict[int, tuple[str, GotoArgs | None, bool]]
"""Permitted request of each drone, its leg, and True if the drone reports its acceleration."""


def measured(fleet: Fleet, tally: Tally, flown: Flown, exempt: Flags) -> None:
    """Report each drone that the motion monitor would stop, once per drone."""
    for i, (request, end, measured) in list(flown.items()):
        if np.abs(fleet.speed[i]).max() < STANDING_MPS:
            continue
        now = fleet.situation(i, measured=measured)
        verdict = monitor(now, fleet.scenes[i].grant, current_leg=None if fleet.held[i] else end)
        if verdict is None:
            continue
        del flown[i]
        slots = [ZONES if name == "in" else int(name[4:]) for name in verdict.policies if name[:2] in {"in", "ou"}]
        if not slots or not exempt[i, slots].all():
            tally.stopped.append(f"{fleet.time_s:.2f} s, drone {i}: {verdict} at {now} after {request}")


def _request_all(
    fleet: Fleet, tally: Tally, permitted: list[str], rng: np.random.Generator, watched: int, source: Source | None
) -> Flown:
    """Make one request per drone. Return the drones to monitor, except those that the monitor would stop already."""
    flown: Flown = {}
    legs: list[tuple[int, GotoArgs]] = []
    near = vicinity(fleet).any(axis=1)
    for i, place in enumerate(fleet.scenes):
        call: Call | None = None
        if source is None:
            call = _repeated(rng, fleet.last_calls[i]) or _request(rng, place)
        measured = bool(rng.random() < 0.5)
        now = fleet.situation(i, measured=measured)
        if source is not None:
            call = source.request(rng, place, now)
        if call is None:
            continue
        fleet.last_calls[i] = call
        verdict = judge(call, now, place.grant)
        tally.requests += 1
        tally.permitted += verdict.permits
        tally.corrected += verdict.action == "correct"
        tally.braked += verdict.permits and verdict.brake_first
        tally.taken += verdict.action == "takeover"
        if verdict.permits and not _flies_faster(fleet, i, verdict, now):
            text = f"{call} in {now} -> {verdict}"
            tally.wrong += [f"{defect}: {text}" for defect in _defects(verdict, now, place)]
            if strays(verdict, now, place):
                tally.wrong.append(f"leads from one inclusion zone through uncovered air to another: {text}")
            # SetSpeed does not start a motion.
            moves = not isinstance(verdict.args, SetSpeedArgs)
            permitted[i] = text if moves else permitted[i] and f"{permitted[i]}, then {text}"
            tally.shortened += "the last legal point" in verdict.reason
            if isinstance(verdict.args, GotoArgs):
                legs.append((i, verdict.args))
            fleet.send(i, verdict, returns=not near[i])
            # A drone that starts beyond an altitude limit flies back to the limit, so it is not monitored.
            low, high = place.heights
            level = low - HEIGHT_ERROR_M <= now.altitude_m <= high + HEIGHT_ERROR_M
            if moves and level and watched and i % watched == 0 and monitor(now, place.grant) is None:
                leg = verdict.args if isinstance(verdict.args, GotoArgs) and not verdict.brake_first else None
                flown[i] = permitted[i], leg, measured
    tally.wrong += [f"target inside the margin of a fence: {permitted[i]}" for i in _too_near(fleet, legs)]
    return flown


def _flies_faster(fleet: Fleet, i: int, verdict: Verdict, now: Situation) -> bool:
    """Return True if a higher speed would make the current leg of a drone illegal.

    In this case, the service does not change the speed of the leg.
    """
    leg = fleet.legs[i]
    args = verdict.args
    if leg is None or not isinstance(args, SetSpeedArgs) or args.speed_mps <= float(fleet.setpoint[i]):
        return False
    faster = replace(leg, speed_mps=args.speed_mps)
    rest = judge(Call("Goto", faster), now, fleet.scenes[i].grant)
    return not rest.permits or rest.brake_first or rest.args != faster


def _too_near(fleet: Fleet, legs: list[tuple[int, GotoArgs]]) -> Iterator[int]:
    """Yield the drones whose legs end inside the margin of a fence."""
    rows = np.array([i for i, _ in legs for _ in _CIRCLE], dtype=np.int64)
    heights = np.array([leg.alt for _, leg in legs for _ in _CIRCLE])
    ends = [[(leg.lon - HOME.lon) * EAST_M, (leg.lat - HOME.lat) * NORTH_M] for _, leg in legs]
    around = (np.array(ends).reshape(-1, 1, 2) + _CIRCLE * (POSITION_ERROR_M + TRACKING_M - 0.05)).reshape(-1, 2)
    broken = trespasses(
        around, heights, fleet.walls.of_some(rows), fleet.kinds[rows], fleet.bands[rows], fleet.limits[rows]
    )
    yield from sorted(set(rows[broken.any(axis=1)].tolist()))


def _repeated(rng: np.random.Generator, last: Call | None) -> Call | None:
    """Return the last velocity request with the same or a slightly higher speed.

    Return None with a probability of 50 %, or if the last request was not a velocity.
    """
    if last is None or not isinstance(last.args, VelocityArgs) or rng.random() < 0.5:
        return None
    args = last.args
    faster = float(rng.choice([1.0, 1.3]))
    return Call("SetVelocity", replace(args, north_mps=args.north_mps * faster, east_mps=args.east_mps * faster))


def _request(rng: np.random.Generator, place: Scene) -> Call:
    if rng.random() < 0.05:
        return Call("SetSpeed", SetSpeedArgs(float(rng.uniform(0.5, 14))))
    if rng.random() < 0.65:
        x, y = rng.uniform(-85, 85, 2)
        alt = None if rng.random() < 0.3 else float(rng.uniform(1, 60))
        if rng.random() < NEAR_LIMIT:
            alt = place.altitude_near_edge(rng) or alt
        speed = float(rng.uniform(1, 12)) if rng.random() < 0.4 else None
        return Call("Goto", GotoArgs(float(HOME.lat + y / NORTH_M), float(HOME.lon + x / EAST_M), alt, speed_mps=speed))
    north, east = rng.uniform(-9, 9, 2)
    down = float(rng.uniform(-2.5, 2.0)) if rng.random() < 0.5 else 0.0
    return Call("SetVelocity", VelocityArgs(float(north), float(east), down, hold_s=float(rng.uniform(0.1, 2.0))))


def strays(verdict: Verdict, now: Situation, place: Scene) -> bool:
    """Return True if the leg of a hovering drone outside all inclusion zones leads away from the zones at its altitude.

    The distance to these zones may not grow before the drone is inside a zone that permits all altitudes of the leg.
    """
    args = verdict.args
    included = place.kinds == INCLUSION
    if not included.any() or not isinstance(args, GotoArgs) or now.is_moving or now.lat is None or now.lon is None:
        return False
    shares = np.linspace(0, 1, 60)[:, None]
    start = np.array([(now.lon - HOME.lon) * EAST_M, (now.lat - HOME.lat) * NORTH_M])
    end = np.array([(args.lon - HOME.lon) * EAST_M, (args.lat - HOME.lat) * NORTH_M])
    points = start + (end - start) * shares
    low, high = sorted((now.altitude_m, now.altitude_m if args.alt is None else args.alt))
    floors, ceilings = place.bands.T
    inside = Walls.of(np.tile(place.rings, (len(points), 1, 1, 1))).around(points) & included
    if (inside[0] & (floors <= now.altitude_m) & (now.altitude_m <= ceilings)).any():
        return False
    beside = included & (floors <= now.altitude_m + HEIGHT_ERROR_M) & (now.altitude_m - HEIGHT_ERROR_M <= ceilings)
    if not beside.any():
        return False
    arrived: Flags = np.logical_or.reduce(inside & (floors <= low) & (high <= ceilings), axis=1)
    away = np.where(inside, 0.0, distances(points, place.rings))[:, beside].min(axis=1)
    until = int(np.argmax(arrived)) if arrived.any() else len(points)
    return bool((away[1:until] > np.minimum.accumulate(away)[: until - 1] + 0.05).any()) if until > 1 else False


def distances(points: Floats, rings: Floats) -> Floats:
    """Return the distance of each point to the edges of each ring, shape (points, rings)."""
    edges = np.roll(rings, -1, axis=1) - rings
    off = points[:, None, None] - rings
    along = (off * edges).sum(axis=-1) / np.maximum((edges * edges).sum(axis=-1), 1e-12)
    nearest = off - np.clip(along, 0.0, 1.0)[..., None] * edges
    distances: Floats = np.linalg.norm(nearest, axis=-1).min(axis=-1)
    return distances


def _defects(verdict: Verdict, now: Situation, place: Scene) -> Iterator[str]:
    """Yield the defects of the arguments in a verdict."""
    args = verdict.args
    if verdict.action == "correct":
        verdict_again = judge(Call(METHOD_OF[type(args)], args), now, place.grant)
        if (verdict_again.action, verdict_again.args) != ("allow", args):
            yield "corrected to arguments that are not allowed unchanged"
    if (
        isinstance(args, VelocityArgs)
        and math.hypot(args.north_mps, args.east_mps) > commanded_mps(place.top_mps) + 1e-6
    ):
        yield "too fast"
    if isinstance(args, SetSpeedArgs) and args.speed_mps > commanded_mps(place.top_mps) + 1e-6:
        yield "too fast"
    if not isinstance(args, GotoArgs):
        return
    if (args.speed_mps or now.speed_setpoint_mps) > commanded_mps(place.top_mps) + 1e-6:
        yield "too fast"
    low, high = place.heights
    if args.alt is None or not (
        low + OVERSHOOT_M - 1e-6 <= args.alt <= high - OVERSHOOT_M + 1e-6 or _is_only_height(args.alt, place)
    ):
        yield "at the wrong height"


def _is_only_height(height: float, place: Scene) -> bool:
    """Return True for the middle between limits whose distance leaves no room for the overshoot on both sides."""
    for zone_low, zone_high in place.limits[place.kinds == LIMIT]:
        low = max(place.heights[0], zone_low)
        high = min(place.heights[1], zone_high)
        if low <= high < low + 2 * OVERSHOOT_M and abs(height - (low + high) / 2) < 1e-6:
            return True
    return False


SLOWEST_STOP_S = 20.0
"""Duration of a stop from 15 m/s with 1 m/s2, including the latency and the slow end of the stop."""


def excused(fleet: Fleet) -> Flags:
    """Return the fences that a drone violates or approaches even if it stops now, shape (drones, ZONES + 1).

    A request causes neither this motion nor the ways back that the engine permits afterwards. The fleet is not changed.
    """
    trial = fleet.part(np.arange(len(fleet.scenes)))
    trial.held[:] = True
    trial.velocity_setpoint = trial.speed.copy()
    trial.until = fleet.time_s + fleet.latency
    broken = np.zeros((len(fleet.scenes), ZONES + 1), dtype=bool)
    for n in range(int(SLOWEST_STOP_S / STEP_S)):
        if n % 4 == 0:
            broken |= vicinity(trial)
            if trial.time_s > trial.until.max() and np.abs(trial.speed).max() < STANDING_MPS:
                break
        trial.step()
    return broken


def vicinity(fleet: Fleet) -> Flags:
    """Return the fences that each drone violates, or whose margin it violates, shape (drones, ZONES + 1)."""
    tall = HEIGHT_ERROR_M + TRACKING_M + 0.1
    around = np.where((fleet.kinds == INCLUSION)[..., None], [tall, -tall], [-tall, tall])
    broken = np.zeros((len(fleet.scenes), ZONES + 1), dtype=bool)
    for dx in (*_CIRCLE * (POSITION_ERROR_M + TRACKING_M + 0.1), np.zeros(2)):
        broken |= trespasses(
            fleet.estimated[:, :2] + dx, fleet.estimated[:, 2], fleet.walls, fleet.kinds, fleet.bands + around,
            fleet.limits + np.array([tall, -tall]),
        )  # fmt: skip
    return broken

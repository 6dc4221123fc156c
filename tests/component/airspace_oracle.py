"""Independent oracle for 4D volumes and for decisions on flight plans.

The oracle shares no code with `fractus_core.airspace`:

- Two ground areas are projected around a point between them (azimuthal equidistant, with PROJ's geodesics). Their edges are
  geodesics. Circles are exact. The distance of two areas follows from a comparison of all edges.
- The rules for plans are stated again for plans whose volumes are boxes on a grid of whole numbers.
"""

from __future__ import annotations

import random
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from fractus_core.airspace import Airspace, OperationalIntent, Volume4D, decide
from fractus_core.api.geometry import Area, Circle, Point, Polygon
from fractus_core.geo import LocalFrame
from numpy.typing import NDArray
from pyproj import Geod

Floats = NDArray[np.float64]

GEOD = Geod(ellps="WGS84")
NOW_S = 1_800_000_000.0
EXTRA_M = 1.0
"""Largest distance of two areas that may still count as overlapping."""

_ERROR_M = 0.02
"""Error of the projection in a distance."""

_EDGE_M = 500.0
"""Maximum length of a straight piece that replaces a part of a geodesic edge."""

# -- pairs of volumes --

_PLACES = [
    (39.36, 22.93), (0.0, 180.0), (12.0, -180.0), (-60.0, 179.99), (90.0, 0.0), (-90.0, 0.0), (89.95, 77.0), (0.0, 0.0),
]  # fmt: skip


@dataclass(frozen=True)
class Ground:
    """A circle (with a radius) or a polygon, with coordinates in degrees."""

    lats: Floats
    lons: Floats
    radius_m: float | None = None


@dataclass(frozen=True)
class Case:
    """Two areas, each with altitudes and times."""

    grounds: tuple[Ground, Ground]
    altitudes: tuple[tuple[float, float], tuple[float, float]]
    times: tuple[tuple[float, float], tuple[float, float]]


def pair_deviation(seed: int) -> str | None:
    """Return the difference between the oracle and both the exact test and the index, or None if they agree."""
    case = _case(random.Random(seed))
    one, other = (_volume(case, i) for i in (0, 1))
    found = one.overlap(other) is not None
    index = Airspace([OperationalIntent("other", "Accepted", volumes=(other,))])
    if (other.overlap(one) is not None) != found or bool(index.overlapping([one], without="")) != found:
        return "the index, or the exchanged pair, has another result"
    apart_m = _distance_m(*case.grounds)
    level = _touches(*case.altitudes)
    present = _touches(*case.times)
    if level and present and apart_m == 0 and not found:
        return "an overlap was missed"
    if found and not (present and apart_m <= EXTRA_M + _ERROR_M):
        return f"volumes overlap that are {apart_m:.2f} m apart, or at different times"
    if found and _gap(*case.altitudes) > EXTRA_M:
        return f"volumes overlap that are {_gap(*case.altitudes):.2f} m above each other"
    return None


def overlaps(seed: int) -> bool:
    """Return True if the oracle finds an overlap for a seed."""
    case = _case(random.Random(seed))
    return _touches(*case.altitudes) and _touches(*case.times) and _distance_m(*case.grounds) == 0


def _case(rng: random.Random) -> Case:
    place = rng.choice([*_PLACES, (rng.uniform(-90, 90), rng.uniform(-180, 180))])
    sizes = [10 ** rng.uniform(0.5, rng.choice([2.0, 3.2, 4.0])) for _ in range(2)]
    away_m = sum(sizes) * rng.choice([0.0, rng.uniform(0, 1), rng.uniform(0.5, 1.3), 1.0])
    lon, lat, _ = GEOD.fwd(place[1], place[0], rng.uniform(0, 360), away_m)
    grounds = (_ground(rng, place, sizes[0]), _ground(rng, (lat, lon), sizes[1]))
    return Case(grounds, _spans(rng, -50.0, 50.0), _spans(rng, NOW_S, 600.0))


def _spans(rng: random.Random, start: float, length: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return two spans that overlap, touch, are apart, or have no length. All numbers have exact binary fractions."""
    a = start + 64.0 * rng.randint(0, 4)
    b = a + rng.choice([0.0, 64.0, length])
    begin = rng.choice([a, a, b, b, a + (b - a) / 2, b + 2.0, a - 64.0])
    end = rng.choice([begin, begin + 128.0, max(begin, a), max(begin, b)])
    return (a, b), (begin, end)


def _ground(rng: random.Random, place: tuple[float, float], size_m: float) -> Ground:
    lat, lon = place
    if rng.random() < 0.4:
        # Circles are circumscribed with up to 0.03 % more than their radius.
        return Ground(np.array([lat]), np.array([lon]), min(size_m, 2000.0))
    count = rng.randint(3, 9)
    # Corners in the order of their bearings. A gap below 180 degrees keeps the middle inside.
    bearings = [360 / count * (i + rng.uniform(-0.35, 0.35)) for i in range(count)]
    reaches = [size_m * rng.uniform(0.2, 1.0) for _ in range(count)]
    lons, lats, _ = GEOD.fwd([lon] * count, [lat] * count, bearings, reaches)
    return Ground(np.array(lats), np.array(lons))


def _volume(case: Case, index: int) -> Volume4D:
    ground = case.grounds[index]
    points = [Point(lat=lat, lon=lon) for lat, lon in zip(ground.lats.tolist(), ground.lons.tolist(), strict=True)]
    area = (
        Area(polygon=Polygon(exterior=tuple(points)))
        if ground.radius_m is None
        else Area(circle=Circle(center=points[0], radius=ground.radius_m))
    )
    (lower_m, upper_m), (begin_s, end_s) = case.altitudes[index], case.times[index]
    return Volume4D.of_area(area, lower_m=lower_m, upper_m=upper_m, begin_s=begin_s, end_s=end_s)


def _touches(a: tuple[float, float], b: tuple[float, float]) -> bool:
    return _gap(a, b) <= 0


def _gap(a: tuple[float, float], b: tuple[float, float]) -> float:
    return max(a[0] - b[1], b[0] - a[1])


def _distance_m(a: Ground, b: Ground) -> float:
    """Return the distance of two areas in metres, 0 if they share a point."""
    lat, lon = _between(a, b)
    first, second = _ring(a, lat, lon), _ring(b, lat, lon)
    if a.radius_m is not None and b.radius_m is not None:
        _, _, away = GEOD.inv(a.lons[0], a.lats[0], b.lons[0], b.lats[0])
        return max(away - a.radius_m - b.radius_m, 0.0)
    if a.radius_m is not None:
        return max(_to_ring(first, second) - a.radius_m, 0.0)
    if b.radius_m is not None:
        return max(_to_ring(second, first) - b.radius_m, 0.0)
    if _cross(first, second):
        return 0.0
    return float(min(_to_ring(first, second), _to_ring(second, first)))


def _between(a: Ground, b: Ground) -> tuple[float, float]:
    azimuth, _, away = GEOD.inv(a.lons[0], a.lats[0], b.lons[0], b.lats[0])
    lon, lat, _ = GEOD.fwd(a.lons[0], a.lats[0], azimuth, away / 2)
    return lat, lon


def _ring(ground: Ground, lat: float, lon: float) -> Floats:
    """Return the corners of an area in metres around a point, shape (n, 2), with more corners on long edges."""
    lats = ground.lats
    lons = ground.lons
    if ground.radius_m is None:
        ends = np.roll(lons, -1), np.roll(lats, -1)
        azimuths, _, lengths = GEOD.inv(lons, lats, *ends)
        pieces = np.maximum(np.ceil(lengths / _EDGE_M).astype(int), 1)
        repeated = [np.repeat(values, pieces) for values in (lons, lats, azimuths, lengths / pieces)]
        step = np.concatenate([np.arange(n) for n in pieces])
        lons, lats, _ = GEOD.fwd(repeated[0], repeated[1], repeated[2], repeated[3] * step)
    azimuths, _, lengths = GEOD.inv(np.full(len(lats), lon), np.full(len(lats), lat), lons, lats)
    return np.column_stack((lengths * np.sin(np.radians(azimuths)), lengths * np.cos(np.radians(azimuths))))


def _to_ring(points: Floats, ring: Floats) -> float:
    """Return the smallest distance of points to the area in a ring, 0 if one is inside."""
    start = ring
    end = np.roll(ring, -1, axis=0)
    x, y = points[:, None, 0], points[:, None, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = start[:, 0] + (y - start[:, 1]) * (end[:, 0] - start[:, 0]) / (end[:, 1] - start[:, 1])
    right = ((start[:, 1] > y) != (end[:, 1] > y)) & (x < crossing)
    if (right.sum(axis=1) % 2 == 1).any():
        return 0.0
    along = end - start
    offset = points[:, None, :] - start
    share = np.clip((offset * along).sum(axis=2) / np.maximum((along**2).sum(axis=1), 1e-12), 0, 1)
    return float(np.linalg.norm(offset - share[:, :, None] * along, axis=2).min())


def _cross(a: Floats, b: Floats) -> bool:
    """Return True if an edge of a ring crosses an edge of another ring."""
    a0, a1 = a[:, None], np.roll(a, -1, axis=0)[:, None]
    b0, b1 = b[None], np.roll(b, -1, axis=0)[None]

    def side(p: Floats, q: Floats, r: Floats) -> Floats:
        u = q - p
        v = r - p
        return np.sign(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])

    return bool(((side(a0, a1, b0) * side(a0, a1, b1) < 0) & (side(b0, b1, a0) * side(b0, b1, a1) < 0)).any())


# -- histories of plans --

_FRAME = LocalFrame(-33.9, 151.2)
_CELL_M = 50.0
_STEP_S = 300.0
_NAMES = ("a", "b", "c", "d")
_USES_AIRSPACE = ("Accepted", "Activated", "Nonconforming", "Contingent")

Box = tuple[int, int, int, int, int, int, int, int]
"""West, east, south, north, lower and upper in cells, begin and end in steps. All bounds belong to the box."""


@dataclass
class Plan:
    """A plan of the oracle."""

    state: str = "Draft"
    priority: int = 0
    boxes: tuple[Box, ...] = ()
    strayed: tuple[Box, ...] = ()


@dataclass
class Verdict:
    """Result of the oracle: accepted or not, the plans in conflict, and the plans of permitted overlaps."""

    accepted: bool
    conflicts: set[str] = field(default_factory=set)
    advised: set[str] = field(default_factory=set)


def history_deviation(seed: int) -> str | None:
    """Return the first difference in a random history of plans, or None if all decisions agree."""
    rng = random.Random(seed)
    plans = {name: Plan(priority=rng.choice([0, 0, 1, 2])) for name in _NAMES}
    airspace = Airspace()
    step = 0
    for number in range(rng.randint(5, 25)):
        step += rng.choice([0, 0, 0, 1])
        name = rng.choice(_NAMES)
        wanted = _request(rng, plans[name], step)
        expected = _verdict(name, wanted, plans, step)
        decision = decide(_intent(name, wanted), _intent(name, plans[name]), airspace, NOW_S + step * _STEP_S)
        conflicts = {finding.other for finding in decision.refusals if finding.other}
        advised = {finding.other for finding in decision.advisories}
        if (decision.accepted, conflicts, advised) != (expected.accepted, expected.conflicts, expected.advised):
            return f"request {number} of plan {name} ({wanted}): expected {expected}, got {decision}"
        if expected.accepted:
            plans[name] = wanted
            airspace.put(_intent(name, wanted))
    return None


def _request(rng: random.Random, plan: Plan, step: int) -> Plan:
    """Return a random next version of a plan: usually a possible state, often with other boxes."""
    usual = {
        "Draft": ["Accepted", "Accepted", "Rejected"],
        "Rejected": ["Draft"],
        "Accepted": [*["Activated"] * 6, "Accepted", "Ended"],
        "Activated": [*["Activated"] * 6, "Nonconforming", "Contingent", "Ended"],
        "Nonconforming": [*["Activated"] * 4, "Nonconforming", "Contingent", "Ended"],
        "Contingent": ["Ended", "Contingent"],
        "Ended": ["Accepted"],
    }
    state = rng.choice(usual[plan.state])
    if rng.random() < 0.1:
        state = rng.choice(["Draft", "Rejected", *_USES_AIRSPACE, "Ended"])
    boxes = plan.boxes
    if not boxes or rng.random() < 0.2:
        boxes = tuple(_box(rng, step) for _ in range(rng.randint(1, 2)))
    elif rng.random() < 0.5:
        boxes = tuple(_grown(rng, box) for box in boxes)
    strayed: tuple[Box, ...] = ()
    if state in {"Nonconforming", "Contingent"} or rng.random() < 0.03:
        strayed = tuple(_box(rng, step) for _ in range(rng.randint(0, 2)))
    if rng.random() < 0.03:
        boxes = ()
    priority = rng.choice([0, 1, 2]) if rng.random() < 0.1 else plan.priority
    return replace(plan, state=state, priority=priority, boxes=boxes, strayed=strayed)


def _grown(rng: random.Random, box: Box) -> Box:
    """Return a box with one bound moved outward."""
    bounds = list(box)
    moved = rng.randrange(8)
    bounds[moved] = bounds[moved] + 1 if moved % 2 else max(bounds[moved] - 1, 0)
    west, east, south, north, lower, upper, begin, end = bounds
    return west, east, south, north, lower, upper, begin, end


def _box(rng: random.Random, step: int) -> Box:
    west, south, lower = rng.randint(0, 5), rng.randint(0, 5), rng.randint(0, 2)
    begin = max(step + rng.randint(-3, 1), 0)
    return (
        west, west + rng.randint(1, 4), south, south + rng.randint(1, 4), lower, lower + 1,
        begin, begin + rng.randint(0, 10),
    )  # fmt: skip


def _verdict(name: str, wanted: Plan, plans: dict[str, Plan], step: int) -> Verdict:
    """State the rules: permitted states, limits, and overlaps with other plans."""
    if not _may_become(plans[name].state, wanted.state):
        return Verdict(accepted=False)
    if wanted.state not in _USES_AIRSPACE:
        return Verdict(accepted=True)
    flying_badly = wanted.state in {"Nonconforming", "Contingent"}
    if flying_badly:
        if not wanted.boxes and not wanted.strayed:
            return Verdict(accepted=False)
    elif (
        not wanted.boxes
        or wanted.strayed
        or step > max(box[7] for box in wanted.boxes)
        or (wanted.state == "Activated" and not any(box[6] <= step <= box[7] for box in wanted.boxes))
    ):
        return Verdict(accepted=False)
    conflicts: set[str] = set()
    advised: set[str] = set()
    for other_name, other in plans.items():
        if other_name == name or other.state not in _USES_AIRSPACE:
            continue
        theirs = other.boxes + other.strayed
        if not _share(wanted.boxes + wanted.strayed, theirs):
            continue
        now = plans[name]
        existed = now.state == "Activated" and other.state == "Activated" and _share(now.boxes, theirs)
        if flying_badly or wanted.priority > other.priority or existed:
            advised.add(other_name)
        else:
            conflicts.add(other_name)
    if conflicts:
        return Verdict(accepted=False, conflicts=conflicts)
    return Verdict(accepted=True, advised=advised)


def _may_become(before: str, after: str) -> bool:
    return before == after or f"{before} {after}" in {
        "Draft Accepted", "Draft Rejected", "Rejected Draft",
        "Accepted Activated", "Accepted Ended", "Accepted Rejected",
        "Activated Nonconforming", "Activated Contingent", "Activated Ended",
        "Nonconforming Activated", "Nonconforming Contingent", "Nonconforming Ended", "Contingent Ended",
    }  # fmt: skip


def _share(mine: tuple[Box, ...], theirs: tuple[Box, ...]) -> bool:
    return any(
        all(a[axis] <= b[axis + 1] and b[axis] <= a[axis + 1] for axis in (0, 2, 4, 6)) for a in mine for b in theirs
    )


def _intent(name: str, plan: Plan) -> OperationalIntent:
    volumes, strayed = (tuple(_of_box(box) for box in boxes) for boxes in (plan.boxes, plan.strayed))
    return OperationalIntent(name, plan.state, plan.priority, volumes, strayed)


@lru_cache(maxsize=100_000)
def _of_box(box: Box) -> Volume4D:
    west, east, south, north = (_CELL_M * cells for cells in box[:4])
    corners = [(west, south), (east, south), (east, north), (west, north)]
    points = [Point(lat=lat, lon=lon) for lat, lon in (_FRAME.latlon(x, y) for x, y in corners)]
    return Volume4D.of_area(
        Area(polygon=Polygon(exterior=tuple(points))),
        lower_m=20.0 * box[4], upper_m=20.0 * box[5], begin_s=NOW_S + _STEP_S * box[6], end_s=NOW_S + _STEP_S * box[7],
    )  # fmt: skip


def histories_reach(seeds: range) -> dict[str, int]:
    """Return how many decisions of histories were accepted, refused for a conflict, advised, or kept an overlap."""
    counts = {"accepted": 0, "conflicts": 0, "advised": 0, "kept": 0}
    for seed in seeds:
        rng = random.Random(seed)
        plans = {name: Plan(priority=rng.choice([0, 0, 1, 2])) for name in _NAMES}
        step = 0
        for _ in range(rng.randint(5, 25)):
            step += rng.choice([0, 0, 0, 1])
            name = rng.choice(_NAMES)
            wanted = _request(rng, plans[name], step)
            verdict = _verdict(name, wanted, plans, step)
            nominal = wanted.state in {"Accepted", "Activated"}
            equal = any(plans[other].priority >= wanted.priority for other in verdict.advised)
            counts["accepted"] += verdict.accepted
            counts["conflicts"] += bool(verdict.conflicts)
            counts["advised"] += bool(verdict.advised)
            counts["kept"] += verdict.accepted and nominal and equal
            if verdict.accepted:
                plans[name] = wanted
    return counts

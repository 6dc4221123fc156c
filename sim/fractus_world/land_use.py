"""Layout of blocks by land use: fields, woods, meadows, houses with gardens, industry, parks."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import shapely
from shapely import affinity

from fractus_world.block import Block, Colour, Kind, Parking, Patch, Points, Roof

CROPS: tuple[Colour, ...] = (
    (112, 172, 196),
    (62, 118, 98),
    (52, 98, 76),
    (86, 112, 140),
    (126, 166, 186),
    (66, 176, 190),
    (84, 142, 126),
    (74, 128, 104),
    (98, 124, 150),
)
_ROOFS: tuple[Colour, ...] = (
    (74, 92, 150),
    (66, 82, 132),
    (84, 82, 82),
    (78, 90, 118),
    (96, 100, 106),
    (62, 70, 122),
    (88, 108, 152),
)
_HALLS: tuple[Colour, ...] = ((176, 178, 178), (150, 152, 150), (136, 124, 112), (190, 192, 190))
_STREET: Colour = (110, 110, 112)
_PAVEMENT: Colour = (142, 146, 148)
_LAWN: Colour = (70, 116, 92)


@dataclass(slots=True)
class Site:
    """A block during its layout.

    Attributes:
        block: Block to which content is added.
        inside: Ground area without roads and verges.
        roll: Random source.
        crop: Crop of the first field.
        trees: Trees: x, y, crown radius, and a number that selects the appearance.
        built: Ground areas of houses.
    """

    block: Block
    inside: shapely.Polygon
    roll: random.Random
    crop: Colour
    trees: list[tuple[float, float, float, float]] = field(default_factory=list)
    built: list[shapely.Polygon] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class _Frontage:
    """A point at a road, with two directions: along the road, and from the road into the block."""

    origin: tuple[float, float]
    along: tuple[float, float]
    away: tuple[float, float]

    def box(self, a0: float, n0: float, a1: float, n1: float) -> shapely.Polygon:
        """Return the rectangle between two distances along the road and two distances from the road."""
        x, y = self.origin
        ax, ay = self.along
        nx, ny = self.away
        corners = ((a0, n0), (a1, n0), (a1, n1), (a0, n1))
        return shapely.Polygon([(x + a * ax + n * nx, y + a * ay + n * ny) for a, n in corners])


def _fields(site: Site) -> None:
    """Add strips of crops side by side, with hedges between some of them."""
    block = site.block
    inside = site.inside
    roll = site.roll
    sides = inside.minimum_rotated_rectangle.exterior.coords
    heading = math.degrees(math.atan2(sides[1][0] - sides[0][0], sides[1][1] - sides[0][1]))
    heading += 90.0 * (roll.random() < 0.5)
    middle = inside.centroid
    level = affinity.rotate(inside, heading, origin=middle)
    west, south, east, north = level.bounds
    count = roll.choice((1, 2, 2, 3, 3, 4))
    cuts = sorted(
        [west, east, *(west + (east - west) * (k + roll.uniform(-0.2, 0.2)) / count for k in range(1, count))]
    )
    for left, right in itertools.pairwise(cuts):
        piece = level.intersection(shapely.box(left + 0.6, south, right - 0.6, north))
        for part in shapely.get_parts(affinity.rotate(piece, -heading, origin=middle)):
            if isinstance(part, shapely.Polygon) and part.area > 200.0:
                crop = roll.choice(CROPS) if block.patches else site.crop
                block.patches.append(Patch(_corners(part), _tinted(crop, roll, 8), 80, heading))
        if right < east and roll.random() < 0.3:
            hedge = affinity.rotate(shapely.LineString([(right, south), (right, north)]), -heading, origin=middle)
            _hedge(site, hedge.intersection(inside), (1.0, 2.8), (2.0, 9.0))


def _hedge(site: Site, line: shapely.Geometry, radius_m: tuple[float, float], gap_m: tuple[float, float]) -> None:
    """Add bushes along a line."""
    roll = site.roll
    at = 0.0
    while at < line.length:
        point = line.interpolate(at)
        shift = (roll.uniform(-0.2, 0.2) * radius_m[1], roll.uniform(-0.2, 0.2) * radius_m[1])
        site.trees.append((point.x + shift[0], point.y + shift[1], roll.uniform(*radius_m), roll.random()))
        at += roll.uniform(*gap_m)


def _meadow(site: Site) -> None:
    block = site.block
    inside = site.inside
    roll = site.roll
    block.patches.append(Patch(_corners(inside), _tinted((78, 130, 112), roll, 8), 130))
    _scatter(site, inside, roll.randint(8, 40), (1.5, 5.0))


def _wood(site: Site) -> None:
    block = site.block
    inside = site.inside
    roll = site.roll
    block.patches.append(Patch(_corners(inside), (40, 64, 50), 160))
    west, south, east, north = inside.bounds
    step = 5.2
    xs, ys = np.meshgrid(np.arange(west, east, step), np.arange(south, north, step))
    shift = np.array([[roll.uniform(-2.2, 2.2) for _ in range(4)] for _ in range(xs.size)])
    points = np.column_stack((xs.ravel(), ys.ravel())) + shift[:, :2]
    keep = shapely.contains_xy(inside.buffer(-2.0), points)
    for (x, y), (a, b) in zip(points[keep], shift[keep, 2:], strict=True):
        site.trees.append((float(x), float(y), 3.1 + 0.45 * float(a), float(b) / 4.4 + 0.5))


def _park(site: Site) -> None:
    """Add lawn, a pitch, a pond, paths and trees."""
    block = site.block
    inside = site.inside
    roll = site.roll
    block.patches.append(Patch(_corners(inside), _LAWN, 90))
    middle = inside.centroid
    pond = shapely.Point(middle.x + roll.uniform(40, 60), middle.y + roll.uniform(-50, 50)).buffer(roll.uniform(14, 24))
    pond = affinity.scale(pond, 1.5, 0.8).intersection(inside)
    heading = roll.uniform(0.0, 180.0)
    pitch = affinity.rotate(
        shapely.box(middle.x - 85, middle.y - 45, middle.x + 5, middle.y + 15), heading, origin=middle
    )
    for x0, y0, x1, y1 in ((-120, -2, 120, 0), (0, -120, 2, 120)):
        path = affinity.rotate(
            shapely.box(middle.x + x0, middle.y + y0, middle.x + x1, middle.y + y1), heading + 20, origin=middle
        )
        part = path.intersection(inside)
        if isinstance(part, shapely.Polygon):
            block.patches.append(Patch(_corners(part), (150, 176, 188), 60))
    if inside.contains(pitch):
        block.patches.append(Patch(_corners(pitch), (76, 138, 100), 50, -heading))
    if isinstance(pond, shapely.Polygon) and not pond.is_empty:
        block.patches.append(Patch(_corners(pond), (110, 116, 100), 40))
        block.patches.append(Patch(_corners(pond.buffer(-1.2)), (92, 78, 58), 14))
    free = inside.difference(pond.buffer(6)).difference(pitch.buffer(5))
    _scatter(site, free, 130, (2.0, 5.5))


def _works(site: Site) -> None:
    """Add industrial halls on a paved yard with a car park."""
    block = site.block
    inside = site.inside
    roll = site.roll
    block.patches.append(Patch(_corners(inside), _tinted(_PAVEMENT, roll, 6), 50))
    sides = inside.minimum_rotated_rectangle.exterior.coords
    angle = math.degrees(math.atan2(sides[1][1] - sides[0][1], sides[1][0] - sides[0][0])) % 90.0
    level = affinity.rotate(inside, -angle, origin=inside.centroid)
    west, south, east, north = level.bounds
    taken = shapely.Polygon()
    for _ in range(12):
        w = roll.uniform(28, 80)
        d = roll.uniform(24, 50)
        x = roll.uniform(west, east - w)
        y = roll.uniform(south + 50, north - d)
        hall = shapely.box(x, y, x + w, y + d)
        if level.contains(hall.buffer(4)) and not hall.buffer(9).intersects(taken):
            taken = taken.union(hall)
            corners = _corners(affinity.rotate(hall, angle, origin=inside.centroid))
            block.roofs.append(
                Roof(corners, roll.uniform(6, 11), _tinted(roll.choice(_HALLS), roll, 8), roll.random() < 0.3)
            )
    _car_park(site, level, taken, angle)
    rim = inside.difference(inside.buffer(-5.0))
    _scatter(site, rim, 60, (1.2, 3.2))


def _car_park(site: Site, level: shapely.Polygon, taken: shapely.Geometry, angle: float) -> None:
    block = site.block
    roll = site.roll
    origin = site.inside.centroid
    west, south, east, _ = level.bounds
    for row in range(4):
        y = south + 16.0 + 8.5 * row
        for bay in range(int((east - west) / 2.6)):
            x = west + 2.6 * bay
            place = shapely.box(x, y, x + 2.5, y + 5.0)
            if not level.contains(place) or taken.intersects(place):
                continue
            shape = affinity.rotate(place, angle, origin=origin)
            block.patches.append(Patch(_corners(shape), (108, 110, 112), 40))
            if roll.random() < 0.42:
                middle = shape.centroid
                block.parked.append(Parking(middle.x, middle.y, -angle + 180.0 * (roll.random() < 0.4)))


def _houses(site: Site) -> None:
    """Add rows of houses along the surrounding roads and along inner streets. Each house has a drive and a garden."""
    block = site.block
    inside = site.inside
    roll = site.roll
    block.patches.append(Patch(_corners(inside), _tinted(_LAWN, roll, 6), 110))
    whole = shapely.Polygon(block.outline)
    sides = inside.minimum_rotated_rectangle.exterior.coords
    angle = math.degrees(math.atan2(sides[1][1] - sides[0][1], sides[1][0] - sides[0][0]))
    west, south, east, north = affinity.rotate(inside, -angle, origin=inside.centroid).bounds
    rows: shapely.Geometry = inside
    count = max(round((north - south) / 88.0), 1)
    for k in range(1, count):
        y = south + (north - south) * k / count
        for half, colour in ((4.6, (150, 154, 157)), (2.8, _STREET)):
            street = affinity.rotate(
                shapely.box(west - 40, y - half, east + 40, y + half), angle, origin=inside.centroid
            )
            part = street.intersection(whole)
            if isinstance(part, shapely.Polygon):
                block.patches.append(Patch(_corners(part), colour, 36))
            rows = rows.difference(street.buffer(0.4) if half > 4 else street)
    hedges: list[shapely.Geometry] = []
    for row in shapely.get_parts(rows):
        if isinstance(row, shapely.Polygon) and row.area > 600.0:
            hedges += _row(site, row)
    standing = shapely.union_all(site.built).buffer(1.2)
    for line in shapely.get_parts(shapely.difference(np.array(hedges, object), standing)):
        _hedge(site, line, (0.5, 0.9), (0.8, 1.2))
    solid = [*site.built, *(shapely.Polygon(patch.outline) for patch in block.patches[1:])]
    _scatter(site, inside.buffer(-1.0).difference(shapely.union_all(solid).buffer(1.6)), 330, (0.6, 3.4))


def _row(site: Site, ground: shapely.Polygon) -> list[shapely.Geometry]:
    """Add houses along the edge of an area. Return possible positions of hedges."""
    hedges: list[shapely.Geometry] = []
    ring = ground.exterior
    roll = site.roll
    at = roll.uniform(4.0, 12.0)
    while at < ring.length - 10.0:
        lot = roll.uniform(17.0, 25.0)
        _house(site, ground, _frontage(ring, at + lot / 2), lot)
        if roll.random() < 0.4:
            front = _frontage(ring, at)
            x, y = front.origin
            nx, ny = front.away
            hedge = shapely.LineString([(x + nx * 3, y + ny * 3), (x + nx * 26, y + ny * 26)])
            hedges.append(hedge.intersection(ground))
        at += lot
    return hedges


def _frontage(line: shapely.LinearRing, at_m: float) -> _Frontage:
    """Return the frontage at a point of a closed line.

    Args:
        line: Outline of a block.
        at_m: Distance of the point along the outline, in metres.

    Returns:
        The frontage. Its direction `away` points into the block.
    """
    behind = line.interpolate(at_m - 1.0)
    ahead = line.interpolate(at_m + 1.0)
    length = max(math.hypot(ahead.x - behind.x, ahead.y - behind.y), 1e-6)
    ax = (ahead.x - behind.x) / length
    ay = (ahead.y - behind.y) / length
    side = 1.0 if line.is_ccw else -1.0
    return _Frontage((behind.x, behind.y), (ax, ay), (-ay * side, ax * side))


def _house(site: Site, ground: shapely.Polygon, front: _Frontage, lot: float) -> None:
    block = site.block
    roll = site.roll
    wide = roll.uniform(9.0, min(lot - 6.0, 14.0))
    deep = roll.uniform(8.0, 11.0)
    back = roll.uniform(5.0, 9.0)
    house = front.box(-wide / 2, back, wide / 2, back + deep)
    room = house.buffer(3.0, quad_segs=1)
    if not ground.contains(house) or any(room.intersects(other) for other in site.built):
        return
    site.built.append(house)
    gabled = roll.random() < 0.94
    colour = _tinted(roll.choice(_ROOFS) if gabled else (132, 134, 134), roll, 9)
    block.roofs.append(Roof(_corners(house), roll.uniform(4.5, 7.0), colour, gabled))
    side = roll.choice((-1.0, 1.0))
    near, far = sorted((side * (wide / 2 - 3.4), side * (wide / 2 - 0.4)))
    block.patches.append(Patch(_corners(front.box(near, -3.0, far, back)), _tinted((150, 152, 156), roll, 12), 40))
    if roll.random() < 0.5:
        middle = front.box(near, back - 5.0, far, back - 1.2).centroid
        heading = math.degrees(math.atan2(front.away[0], front.away[1]))
        block.parked.append(Parking(middle.x, middle.y, heading + 180.0 * (roll.random() < 0.5)))
    _garden(site, front, wide, back + deep)


def _garden(site: Site, front: _Frontage, wide: float, behind: float) -> None:
    block = site.block
    roll = site.roll
    inside = site.inside
    terrace = front.box(-wide / 4, behind, wide / 4, behind + 3.2)
    if inside.contains(terrace):
        block.patches.append(Patch(_corners(terrace), _tinted((150, 160, 172), roll, 10), 40))
    pool = front.box(-2.0, behind + 5.5, 5.5, behind + 9.2)
    bed = front.box(wide / 2 - 2.0, behind + 8.0, wide / 2 + 3.0, behind + 14.0)
    draw = roll.random()
    if draw < 0.16 and inside.contains(pool):
        block.patches.append(Patch(_corners(pool.buffer(0.9, join_style="mitre")), (186, 192, 196), 20))
        block.patches.append(Patch(_corners(pool), (196, 168, 92), 10))
    elif draw < 0.5 and inside.contains(bed):
        block.patches.append(Patch(_corners(bed), (72, 98, 116), 140))


def _scatter(site: Site, area: shapely.Geometry, count: int, radius_m: tuple[float, float]) -> None:
    roll = site.roll
    if area.is_empty:
        return
    west, south, east, north = area.bounds
    shapely.prepare(area)
    for _ in range(count):
        x = roll.uniform(west, east)
        y = roll.uniform(south, north)
        radius = radius_m[0] + (radius_m[1] - radius_m[0]) * roll.random() ** 2
        looks = roll.random()
        if shapely.contains_xy(area, x, y):
            site.trees.append((x, y, radius, looks))


def _corners(shape: shapely.Polygon) -> Points:
    return np.array(shape.exterior.coords[:-1])


def _tinted(colour: Colour, roll: random.Random, by: int) -> Colour:
    shift = roll.randint(-by, by)
    blue, green, red = (min(max(part + shift + roll.randint(-by // 3, by // 3), 0), 255) for part in colour)
    return blue, green, red


LAYOUTS: dict[Kind, Callable[[Site], None]] = {
    "fields": _fields,
    "meadow": _meadow,
    "wood": _wood,
    "houses": _houses,
    "works": _works,
    "park": _park,
}

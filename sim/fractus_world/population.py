"""Objects on the ground at a time: traffic, parked cars and people. A pure function of seed and time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from fractus_world.block import Block
from fractus_world.blocks import Blocks
from fractus_world.optics import Matrix
from fractus_world.randomness import mixed, unit
from fractus_world.roads import SPACING_M, Road, Roads, cell, centre

Kind = Literal["car", "van", "truck", "bus", "person"]

WALK_MPS = 1.35
_SIZES: dict[Kind, tuple[float, float, float]] = {
    "car": (4.5, 1.85, 1.48),
    "van": (5.6, 2.05, 2.3),
    "truck": (10.5, 2.5, 3.6),
    "bus": (12.0, 2.55, 3.1),
    "person": (0.5, 0.5, 1.75),
}
_GAP_M = {True: 85.0, False: 330.0}
_SPEED_MPS = {True: 13.0, False: 7.0}
_LANE_M = {True: 1.9, False: 1.35}
_STROLLERS = {"park": 14, "meadow": 2, "fields": 1}
_PARKED_WITHIN_M = 700.0


@dataclass(frozen=True, slots=True)
class Thing:
    """An object on the ground.

    Attributes:
        id: Identical at all times.
        kind: Object class.
        x: Metres east of the world's origin.
        y: Metres north.
        heading_deg: Heading, clockwise from the frame's north.
        speed_mps: Ground speed.
        looks: Number that selects colours.
    """

    id: str
    kind: Kind
    x: float
    y: float
    heading_deg: float
    speed_mps: float
    looks: int

    @property
    def size_m(self) -> tuple[float, float, float]:
        """Length, width and height."""
        return _SIZES[self.kind]


class Population(Protocol):
    """Provides the objects on the ground."""

    def within(self, box: Matrix, time_s: float) -> list[Thing]:
        """Return the objects within a box ((x0, y0), (x1, y1)), metres, at a time."""


class Unpopulated:
    """An empty world."""

    def within(self, box: Matrix, time_s: float) -> list[Thing]:
        """Return no objects."""
        del box, time_s
        return []


class TownPopulation:
    """The population of a procedural landscape."""

    def __init__(self, roads: Roads, blocks: Blocks) -> None:
        self._roads = roads
        self._blocks = blocks
        self._seed = roads.seed

    def within(self, box: Matrix, time_s: float) -> list[Thing]:
        """Return the objects within a box."""
        things = self._traffic(box, time_s)
        (x0, y0), (x1, y1) = box
        middle = (box[0] + box[1]) / 2.0
        for i, j in self._blocks.near(x0, y0, x1, y1):
            if math.dist(centre(i, j), middle) > _PARKED_WITHIN_M + SPACING_M:
                continue
            things += self._walkers(i, j, time_s)
            things += self._in_block(self._blocks.block(i, j), i, j, time_s)
        return [thing for thing in things if x0 <= thing.x <= x1 and y0 <= thing.y <= y1]

    def _traffic(self, box: Matrix, time_s: float) -> list[Thing]:
        things: list[Thing] = []
        low = np.array(cell(*box[0])) + 0.5
        high = np.array(cell(*box[1])) + 0.5
        for family, across, along in (("east", 1, 0), ("north", 0, 1)):
            for index in range(math.floor(low[across] - 0.5), math.ceil(high[across] + 0.5) + 1):
                road = Road("east" if family == "east" else "north", index)
                for direction in (1, -1):
                    things += self._lane(road, direction, (low[along] - 0.6, high[along] + 0.6), time_s)
        return things

    def _lane(self, road: Road, direction: int, span: tuple[float, float], time_s: float) -> list[Thing]:
        """Return the vehicles of one lane. All have the same speed, so that they do not collide."""
        family = 1 if road.family == "east" else 2
        key = (self._seed, 31, family, road.index, direction)
        gap = _GAP_M[road.main] / SPACING_M
        rate = direction * _SPEED_MPS[road.main] * (0.85 + 0.3 * unit(*key)) / SPACING_M
        first = math.floor((span[0] - rate * time_s) / gap) - 1
        last = math.ceil((span[1] - rate * time_s) / gap)
        things = []
        for slot in range(first, last + 1):
            along = (slot + 0.65 * unit(*key, slot)) * gap + rate * time_s
            if not span[0] <= along <= span[1]:
                continue
            x, y, dx, dy = self._roads.along(road, along)
            length = math.hypot(dx, dy)
            ux = direction * dx / length
            uy = direction * dy / length
            offset = _LANE_M[road.main]
            looks = mixed(*key, slot, 5)
            things.append(
                Thing(
                    f"vehicle-{road.family[0]}{road.index}{'+' if direction > 0 else '-'}{slot}",
                    _vehicle_kind(looks, road.main),
                    x + uy * offset,
                    y - ux * offset,
                    math.degrees(math.atan2(ux, uy)),
                    abs(rate) * length,
                    looks,
                )
            )
        return things

    def _walkers(self, i: int, j: int, time_s: float) -> list[Thing]:
        """Return the people who walk to and fro on the pavements of the two roads that begin at a vertex."""
        things = []
        for road, step in ((Road("east", j), i), (Road("north", i), j)):
            if not self._roads.built_up(road, step):
                continue
            family = 1 if road.family == "east" else 2
            for n in range(int(7 * unit(self._seed, 41, family, i, j))):
                key = (self._seed, 42, family, i, j, n)
                pace = WALK_MPS * (0.8 + 0.4 * unit(*key))
                phase = (unit(*key, 1) + time_s * pace / (2 * SPACING_M)) % 1.0
                direction = 1 if phase < 0.5 else -1
                share = 0.04 + 0.92 * (2 * phase if direction > 0 else 2 - 2 * phase)
                x, y, dx, dy = self._roads.along(road, step + share)
                length = math.hypot(dx, dy)
                side = (self._roads.width_m(road, step) / 2 + 1.2) * (1 if unit(*key, 2) < 0.5 else -1)
                heading = math.degrees(math.atan2(direction * dx, direction * dy))
                speed = 0.92 * pace * length / SPACING_M
                place = (x - dy / length * side, y + dx / length * side)
                things.append(
                    Thing(f"person-{road.family[0]}{i}_{j}_{n}", "person", *place, heading, speed, mixed(*key, 3))
                )
        return things

    def _in_block(self, block: Block, i: int, j: int, time_s: float) -> list[Thing]:
        things = []
        for n, place in enumerate(block.parked):
            looks = mixed(self._seed, 51, i, j, n)
            kind: Kind = "van" if looks % 11 == 0 else "car"
            things.append(Thing(f"parked-{i}_{j}_{n}", kind, place.x, place.y, place.heading_deg, 0.0, looks))
        return things + [self._stroller(i, j, n, time_s) for n in range(_STROLLERS.get(block.kind, 0))]

    def _stroller(self, i: int, j: int, n: int, time_s: float) -> Thing:
        """Return a person who walks on a closed curve inside a block."""
        draws = [unit(self._seed, 61, i, j, n, k) for k in range(7)]
        x, y = centre(i + 0.5 * (draws[0] - 0.5), j + 0.5 * (draws[1] - 0.5))
        reach = 6.0 + 22.0 * draws[2]
        rate = WALK_MPS * (0.6 + 0.4 * draws[3]) / reach / 1.3
        east = rate * time_s + 2 * math.pi * draws[4]
        north = 0.61 * rate * time_s + 2 * math.pi * draws[5]
        vx = reach * rate * math.cos(east)
        vy = 0.61 * reach * rate * math.cos(north)
        place = (x + reach * math.sin(east), y + reach * math.sin(north))
        heading = math.degrees(math.atan2(vx, vy))
        return Thing(
            f"person-{i}_{j}_{n}", "person", *place, heading, math.hypot(vx, vy), mixed(self._seed, 62, i, j, n)
        )


def _vehicle_kind(looks: int, main: bool) -> Kind:
    draw = looks % 100
    if draw < 12:
        return "van"
    if main and draw < 20:
        return "truck"
    if main and draw < 23:
        return "bus"
    return "car"


def nearest(things: list[Thing], place: Matrix, count: int) -> list[Thing]:
    """Return the `count` things nearest to a place, in order of decreasing distance."""
    if not things:
        return []
    distances = np.hypot([t.x - place[0] for t in things], [t.y - place[1] for t in things])
    return [things[k] for k in np.argsort(distances, kind="stable")[:count]][::-1]

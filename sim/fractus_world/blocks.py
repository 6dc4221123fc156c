"""Blocks between the roads of a seed. Each block is generated when it is first requested."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import shapely

from fractus_world.block import Block, Colour, Kind
from fractus_world.land_use import CROPS, LAYOUTS, Site
from fractus_world.randomness import dice, unit
from fractus_world.roads import Road, Roads, cell

_REACH = 0.5 + 0.2 + 0.1
"""Maximum distance of a block's outline from its centre, in cells: half a cell, vertex jitter, and road curvature."""


class Blocks:
    """Blocks of a seed. Each block is generated when it is first requested."""

    def __init__(self, roads: Roads) -> None:
        self.roads = roads
        self.block = lru_cache(maxsize=256)(self._block)

    def kind(self, i: int, j: int) -> Kind:
        """Return the land use of a block."""
        draw = unit(self.roads.seed, 11, i, j)
        if self.roads.town(i, j):
            if draw < 0.74 or (i, j) == (0, 0):
                return "houses"
            return "works" if draw < 0.88 else "park"
        if draw < 0.66:
            return "fields"
        return "wood" if draw < 0.82 else "meadow"

    def crop(self, i: int, j: int) -> Colour:
        """Return the crop of a block's first field."""
        return CROPS[int(len(CROPS) * unit(self.roads.seed, 13, i, j))]

    def _block(self, i: int, j: int) -> Block:
        roll = dice(self.roads.seed, 12, i, j)
        block = Block(self.kind(i, j), self.roads.outline(i, j))
        inside = shapely.Polygon(block.outline).buffer(-self._verge_m(i, j))
        if inside.is_empty or not isinstance(inside, shapely.Polygon):
            return block
        site = Site(block, inside, roll, self.crop(i, j))
        LAYOUTS[block.kind](site)
        block.trees = np.array(site.trees).reshape(-1, 4)
        return block

    def _verge_m(self, i: int, j: int) -> float:
        """Return the distance between the centre line of a road and the usable ground of a block."""
        around = ((Road("east", j), i), (Road("east", j + 1), i), (Road("north", i), j), (Road("north", i + 1), j))
        return max(self.roads.width_m(road, step) for road, step in around) / 2 + 3.0

    def near(self, x0: float, y0: float, x1: float, y1: float) -> list[tuple[int, int]]:
        """Return the blocks that may overlap a box."""
        west, south = cell(x0, y0)
        east, north = cell(x1, y1)
        columns = range(math.ceil(west - _REACH), math.floor(east + _REACH) + 1)
        return [(i, j) for j in range(math.ceil(south - _REACH), math.floor(north + _REACH) + 1) for i in columns]

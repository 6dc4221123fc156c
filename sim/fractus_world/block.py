"""A block: the area between four roads, with ground, buildings, trees and parked cars."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]
Kind = Literal["fields", "meadow", "wood", "houses", "works", "park"]
Colour = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class Patch:
    """An area of one ground type.

    Attributes:
        outline: Corners, metres, shape (n, 2).
        colour: Blue, green, red.
        rough: Strength of the texture, from 0 to 255.
        rows_deg: Direction of crop rows, clockwise from north. None without crop.
    """

    outline: Points
    colour: Colour
    rough: int
    rows_deg: float | None = None


@dataclass(frozen=True, slots=True)
class Roof:
    """Top view of a building.

    Attributes:
        corners: Four corners. The ridge is parallel to the side between the first two corners.
        height_m: Height above the ground. It determines the length of the shadow.
        colour: Blue, green, red.
        gabled: True if the roof has a ridge.
    """

    corners: Points
    height_m: float
    colour: Colour
    gabled: bool


@dataclass(frozen=True, slots=True)
class Parking:
    """A parking position of a car."""

    x: float
    y: float
    heading_deg: float


@dataclass
class Block:
    """The area between four roads.

    Attributes:
        kind: Land use.
        outline: Centre lines of the surrounding roads.
        patches: Ground areas in drawing order.
        roofs: Buildings.
        trees: x, y and crown radius in metres, and a number that selects the appearance, shape (n, 4).
        parked: Parked cars.
    """

    kind: Kind
    outline: Points
    patches: list[Patch] = field(default_factory=list)
    roofs: list[Roof] = field(default_factory=list)
    trees: Points = field(default_factory=lambda: np.empty((0, 4)))
    parked: list[Parking] = field(default_factory=list)

    @cached_property
    def patch_boxes(self) -> Points:
        """West, south, east and north edge of each patch, shape (n, 4)."""
        return _boxes([patch.outline for patch in self.patches])

    @cached_property
    def roof_boxes(self) -> Points:
        """West, south, east and north edge of each roof, shape (n, 4)."""
        return _boxes([roof.corners for roof in self.roofs])


def _boxes(outlines: list[Points]) -> Points:
    boxes = [(*outline.min(axis=0), *outline.max(axis=0)) for outline in outlines]
    return np.array(boxes).reshape(-1, 4)

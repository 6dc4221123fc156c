"""Billboards with photographed faces, upright beside roads or lying on the ground, for face detection.

The photograph, astronaut.png, is NASA's portrait of Eileen Collins (public domain).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from fractus_world.blocks import Blocks
from fractus_world.optics import Matrix
from fractus_world.randomness import unit
from fractus_world.roads import Road, Roads, centre

Picture = NDArray[np.uint8]

VARIATIONS = 8
_PHOTOGRAPH = Path(__file__).with_name("astronaut.png")
_CROP = (92, 0, 362, 300)
"""Left, top, right, bottom of the head and shoulders in the photograph."""
_FACE = (180, 72, 272, 186)
"""Left, top, right, bottom of the face in the photograph, from hairline to chin."""
_ASPECT = (_CROP[2] - _CROP[0]) / (_CROP[3] - _CROP[1])
_FEET_M = 1.2
"""Height of an upright billboard's lower edge above the ground."""


@dataclass(frozen=True, slots=True)
class Billboard:
    """A billboard with a photographed face.

    Attributes:
        id: Identical in every picture.
        x: Metres east of the world's origin, of the middle of the lower edge.
        y: Metres north of the world's origin, of the middle of the lower edge.
        heading_deg: Direction of the front side. For a billboard on the ground: direction of its top edge.
        standing: True if the billboard is upright.
        height_m: Height of the picture.
        variation: Index of the variation of the photograph.
    """

    id: str
    x: float
    y: float
    heading_deg: float
    standing: bool
    height_m: float
    variation: int

    def corners(self) -> Matrix:
        """Return the corners of the picture in the world's frame, shape (4, 3): upper left, clockwise."""
        return self._points(((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)))

    def face_corners(self) -> Matrix:
        """Return the corners of the face, in the order of `corners`."""
        left, top, right, bottom = face_box(self.variation)
        return self._points(((left, top), (right, top), (right, bottom), (left, bottom)))

    def _points(self, shares: tuple[tuple[float, float], ...]) -> Matrix:
        angle = math.radians(self.heading_deg)
        ahead = np.array([math.sin(angle), math.cos(angle), 0.0])
        right = np.array([math.cos(angle), -math.sin(angle), 0.0])
        up = ahead
        base = np.array([self.x, self.y, 0.02])
        if self.standing:
            # A viewer in front of the billboard sees its right side on the left.
            right = -right
            up = np.array([0.0, 0.0, 1.0])
            base = np.array([self.x, self.y, _FEET_M])
        width = self.height_m * _ASPECT
        return np.array([base + (u - 0.5) * width * right + (1.0 - v) * self.height_m * up for u, v in shares])

    def faces(self, viewer: Matrix) -> bool:
        """Return True if a viewer sees the front. `viewer` is a point in the world's frame, shape (3,)."""
        corners = self.corners()
        front = np.cross(corners[3] - corners[0], corners[1] - corners[0])
        return bool(front @ (viewer - corners[0]) > 0.0)


class Billboards(Protocol):
    """Provides the positions of billboards."""

    def within(self, box: Matrix) -> list[Billboard]:
        """Return the billboards in a box ((x0, y0), (x1, y1))."""


class BillboardsAroundOrigin:
    """Six billboards within 100 m of the origin, for worlds whose ground is a picture of the user."""

    def __init__(self, seed: int) -> None:
        self._boards = []
        for n in range(6):
            bearing = 2 * math.pi * (n / 6 + 0.1 * unit(seed, 71, n))
            distance_m = 14.0 + 14.0 * n
            x = distance_m * math.sin(bearing)
            y = distance_m * math.cos(bearing)
            heading = math.degrees(bearing) + 180.0 if n % 2 else 360.0 * unit(seed, 72, n)
            size = (4.8, 3.2, 6.4)[n % 3]
            self._boards.append(Billboard(f"face-{n}", x, y, heading, n % 2 == 1, size, n % VARIATIONS))

    def within(self, box: Matrix) -> list[Billboard]:
        """Return the billboards in a box."""
        return [board for board in self._boards if _is_in(board, box)]


class LandscapeBillboards:
    """Billboards of a procedural landscape, beside main roads and in parks and meadows."""

    def __init__(self, roads: Roads, blocks: Blocks) -> None:
        self._roads = roads
        self._blocks = blocks
        self._near_origin = BillboardsAroundOrigin(roads.seed)

    def within(self, box: Matrix) -> list[Billboard]:
        """Return the billboards in a box."""
        boards = self._near_origin.within(box)
        (x0, y0), (x1, y1) = box
        for i, j in self._blocks.near(x0, y0, x1, y1):
            boards += self._on_lawn(i, j)
            boards += [
                self._beside(road, step) for road, step in ((Road("east", j), i), (Road("north", i), j)) if road.main
            ]
        return [board for board in boards if _is_in(board, box)]

    def _on_lawn(self, i: int, j: int) -> list[Billboard]:
        if self._blocks.kind(i, j) not in ("park", "meadow"):
            return []
        draws = [unit(self._roads.seed, 73, i, j, k) for k in range(4)]
        x, y = centre(i + 0.4 * (draws[0] - 0.5), j + 0.4 * (draws[1] - 0.5))
        size = 3.2 + 3.2 * draws[2]
        return [Billboard(f"face-lawn-{i}_{j}", x, y, 360.0 * draws[3], False, size, int(97 * draws[2]) % VARIATIONS)]

    def _beside(self, road: Road, step: int) -> Billboard:
        """Return a billboard beside a road that faces the traffic, which drives on the right."""
        family = 1 if road.family == "east" else 2
        draw = unit(self._roads.seed, 74, family, road.index, step)
        x, y, dx, dy = self._roads.at(road, step + 0.3 + 0.4 * draw)
        length = math.hypot(dx, dy)
        place = (x + dy / length * 7.5, y - dx / length * 7.5)
        heading = math.degrees(math.atan2(-dx, -dy))
        return Billboard(
            f"face-{road.family[0]}{road.index}_{step}", *place, heading, True, 3.6, int(89 * draw) % VARIATIONS
        )


def _is_in(board: Billboard, box: Matrix) -> bool:
    return bool(box[0][0] <= board.x <= box[1][0] and box[0][1] <= board.y <= box[1][1])


def face_box(variation: int) -> tuple[float, float, float, float]:
    """Return left, top, right and bottom of the face in the picture of a variation, as shares of its size."""
    wide = _CROP[2] - _CROP[0]
    high = _CROP[3] - _CROP[1]
    left = (_FACE[0] - _CROP[0]) / wide
    right = (_FACE[2] - _CROP[0]) / wide
    if variation % 2:
        mirrored_left = 1.0 - right
        right = 1.0 - left
        left = mirrored_left
    return left, (_FACE[1] - _CROP[1]) / high, right, (_FACE[3] - _CROP[1]) / high


@cache
def photograph() -> Picture:
    """Return the whole photograph: 512 x 512 pixels, BGR.

    Raises:
        FileNotFoundError: The installation lacks the file.
    """
    data = np.frombuffer(_PHOTOGRAPH.read_bytes(), np.uint8)
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


@lru_cache(maxsize=VARIATIONS)
def _portrait(variation: int) -> Picture:
    """Return a variation of the photograph: mirrored, in another light."""
    left, top, right, bottom = _CROP
    picture = photograph()[top:bottom, left:right] / 255.0
    if variation % 2:
        picture = picture[:, ::-1]
    gain = np.array([1.0 - 0.05 * (variation // 2 % 3), 1.0, 1.0 + 0.03 * (variation // 2 % 3 - 1)])
    bent = np.clip(picture ** (0.82 + 0.12 * (variation // 2)) * gain, 0.0, 1.0)
    return np.ascontiguousarray(np.round(bent * 255.0).astype(np.uint8))


@lru_cache(maxsize=8 * VARIATIONS)
def portrait(variation: int, halvings: int) -> Picture:
    """Return a variation of the photograph, reduced by powers of two for large distances."""
    whole = _portrait(variation)
    height = max(whole.shape[0] >> halvings, 2)
    width = max(whole.shape[1] >> halvings, 2)
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.uint8)

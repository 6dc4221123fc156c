"""Drawing on a tile: shapes in metres, seamless noise, shadows and tree crowns."""

from __future__ import annotations

import math
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from fractus_world.randomness import mixed

Points = NDArray[np.float64]
Colour = tuple[int, int, int]

SUN_SHADOW = (-0.62, 0.55)
"""Shadow offset per metre of height of an object, metres east and north."""

_SHIFT = 4
_LATTICE = 256
_FINEST_OCTAVE_M = 0.0625
_OCTAVES = 13
_ENLARGED = 8
_CROWN_PX = 160
_CROWNS = 7


class Noise:
    """Seamless noise on an unbounded plane, as a sum of octaves. Each octave is a random lattice that repeats."""

    def __init__(self, seed: int) -> None:
        random = np.random.default_rng(mixed(seed, 77))
        self._lattices = [random.standard_normal((_LATTICE, _LATTICE)).astype(np.float32) for _ in range(_OCTAVES)]

    def octave(self, octave: int, drawing: TileDrawing) -> NDArray[np.float32]:
        """Return one octave of the noise for a square tile. Its standard deviation is below 1."""
        cell = _FINEST_OCTAVE_M * 2**octave
        # An octave much coarser than a pixel is computed for every eighth pixel only, with a margin, and enlarged.
        step = _ENLARGED if cell >= 2 * _ENLARGED * drawing.pixel_m else 1
        rim, size = (1, drawing.size // step + 2) if step > 1 else (0, drawing.size)
        scale = step * drawing.pixel_m / cell
        x = (drawing.left_m / cell) % _LATTICE
        y = (-drawing.top_m / cell) % _LATTICE
        matrix = np.array([[scale, 0.0, x + (0.5 - rim) * scale], [0.0, scale, y + (0.5 - rim) * scale]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        lattice = self._lattices[octave]
        drawn = cv2.warpAffine(lattice, matrix, (size, size), flags=flags, borderMode=cv2.BORDER_WRAP)
        if step > 1:
            drawn = cv2.resize(drawn, (size * step, size * step), interpolation=cv2.INTER_LINEAR)
            drawn = drawn[step:-step, step:-step]
        return np.asarray(drawn, np.float32)

    def between(self, finest_m: float, coarsest_m: float, drawing: TileDrawing) -> NDArray[np.float32]:
        """Return the sum of the octaves with cells between two sizes, for a tile.

        Octaves finer than a pixel are omitted.
        """
        total = np.zeros((drawing.size, drawing.size), np.float32)
        for octave in range(_OCTAVES):
            cell = _FINEST_OCTAVE_M * 2**octave
            if max(finest_m, drawing.pixel_m * 0.9) <= cell <= coarsest_m:
                total += self.octave(octave, drawing)
        return total


class TileDrawing:
    """A square tile.

    Args:
        left_m: East coordinate of the western edge.
        top_m: North coordinate of the northern edge.
        pixel_m: Size of a pixel.
        size: Pixels along an edge.
        ground: Colour of the empty tile.
    """

    def __init__(self, left_m: float, top_m: float, pixel_m: float, size: int, ground: Colour) -> None:
        self.left_m = left_m
        self.top_m = top_m
        self.pixel_m = pixel_m
        self.size = size
        self.colour = np.empty((size, size, 3), np.uint8)
        self.colour[:] = ground
        self.rough = np.full((size, size), 110, np.uint8)
        self.shade = np.zeros((size, size), np.uint8)

    @property
    def box(self) -> tuple[float, float, float, float]:
        """West, south, east, north edge."""
        extent = self.size * self.pixel_m
        return self.left_m, self.top_m - extent, self.left_m + extent, self.top_m

    def sees(self, points: Points, margin_m: float = 0.0) -> bool:
        """Return True if the bounding box of points touches the tile."""
        west, south, east, north = self.box
        (x0, y0) = points.min(axis=0)[:2]
        (x1, y1) = points.max(axis=0)[:2]
        return bool(x0 < east + margin_m and x1 > west - margin_m and y0 < north + margin_m and y1 > south - margin_m)

    def within(self, boxes: Points, margin_m: float = 0.0) -> NDArray[np.int64]:
        """Return the indexes of the boxes (west, south, east, north), shape (n, 4), that touch the tile."""
        west, south, east, north = self.box
        touch = (boxes[:, 0] < east + margin_m) & (boxes[:, 2] > west - margin_m)
        touch &= (boxes[:, 1] < north + margin_m) & (boxes[:, 3] > south - margin_m)
        return np.flatnonzero(touch)

    def pixels(self, points: Points) -> NDArray[np.int32]:
        """Convert points in metres to fixed-point pixel coordinates of OpenCV."""
        scaled = (points[:, :2] - [self.left_m, self.top_m]) * [1 / self.pixel_m, -1 / self.pixel_m] - 0.5
        return np.round(np.clip(scaled, -20_000, 20_000) * (1 << _SHIFT)).astype(np.int32)

    def fill(self, outline: Points, colour: Colour, rough: int | None = None) -> None:
        """Fill a polygon."""
        corners = self.pixels(outline)
        cv2.fillPoly(self.colour, [corners], colour, cv2.LINE_AA, _SHIFT)
        if rough is not None:
            cv2.fillPoly(self.rough, [corners], (rough,), cv2.LINE_8, _SHIFT)

    def mask(self, outline: Points) -> NDArray[np.uint8]:
        """Return a mask that is 255 inside a polygon."""
        mask = np.zeros((self.size, self.size), np.uint8)
        cv2.fillPoly(mask, [self.pixels(outline)], (255,), cv2.LINE_AA, _SHIFT)
        return mask

    def line(self, points: Points, colour: Colour, width_m: float) -> None:
        """Draw a line unless it is much thinner than a pixel."""
        thickness = width_m / self.pixel_m
        if thickness < 0.35:
            return
        cv2.polylines(self.colour, [self.pixels(points)], False, colour, max(round(thickness), 1), cv2.LINE_AA, _SHIFT)

    def shadow(self, outline: Points, height_m: float) -> None:
        """Add the shadow of a prism."""
        base = outline[:, :2]
        both = np.vstack((base, base + np.array(SUN_SHADOW) * height_m))
        hull = cv2.convexHull(both.astype(np.float32)).reshape(-1, 2).astype(np.float64)
        cv2.fillConvexPoly(self.shade, self.pixels(hull), (255,), cv2.LINE_AA, _SHIFT)

    def disc(self, x: float, y: float, radius_m: float, colour: Colour, rough: int) -> None:
        """Fill a disc."""
        centre = self.pixels(np.array([[x, y]]))[0]
        radius = int(radius_m / self.pixel_m * (1 << _SHIFT))
        cv2.circle(self.colour, centre, radius, colour, -1, cv2.LINE_AA, _SHIFT)
        cv2.circle(self.rough, centre, radius, (rough,), -1, cv2.LINE_8, _SHIFT)

    def round_shadow(self, x: float, y: float, radius_m: float, height_m: float) -> None:
        """Add the shadow of a tree crown."""
        middle = np.array([[x + SUN_SHADOW[0] * height_m, y + SUN_SHADOW[1] * height_m]])
        centre = self.pixels(middle)[0]
        radius = int(radius_m / self.pixel_m * (1 << _SHIFT))
        cv2.circle(self.shade, centre, max(radius, 8), (230,), -1, cv2.LINE_AA, _SHIFT)

    def darken_shadows(self, depth: float) -> None:
        """Darken the ground in the added shadows. Half of the remaining light is bluish light from the sky."""
        if not self.shade.any():
            return
        soft = max(int(0.25 / self.pixel_m), 0)
        shade = cv2.blur(self.shade, (2 * soft + 1, 2 * soft + 1)) if soft else self.shade
        layers = [255 - (shade * (depth * tint)).astype(np.uint8) for tint in (0.86, 0.98, 1.04)]
        cv2.multiply(self.colour, cv2.merge(layers), dst=self.colour, scale=1 / 255)
        self.shade[:] = 0

    def crown(self, x: float, y: float, radius_m: float, looks: float) -> None:
        """Draw a tree from above."""
        diameter = max(round(2.2 * radius_m / self.pixel_m), 2)
        if diameter > 64:
            diameter = diameter // 4 * 4
        colour, cover = _crown(int(looks * 997) % _CROWNS, diameter, int(looks * 7919) % 5)
        column = round((x - self.left_m) / self.pixel_m - diameter / 2)
        row = round((self.top_m - y) / self.pixel_m - diameter / 2)
        x0 = max(column, 0)
        y0 = max(row, 0)
        x1 = min(column + diameter, self.size)
        y1 = min(row + diameter, self.size)
        if x0 >= x1 or y0 >= y1:
            return
        part = self.colour[y0:y1, x0:x1]
        inside = np.s_[y0 - row : y1 - row, x0 - column : x1 - column]
        part[:] = (part * cover[inside] + colour[inside]).astype(np.uint8)


@lru_cache(maxsize=2048)
def _crown(kind: int, diameter: int, shade: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return a tree crown of `diameter` pixels: its colours multiplied by its opacity, and its transparency."""
    colour, alpha = _drawn_crown(kind)
    colour = colour * (0.84 + 0.08 * shade)
    size = (diameter, diameter)
    small = cv2.resize(colour * alpha[..., None], size, interpolation=cv2.INTER_AREA)
    cover = cv2.resize(alpha, size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32), np.asarray(1.0 - cover, np.float32)[..., None]


_CROWN_COLOURS: tuple[Colour, ...] = (
    (44, 84, 60),
    (50, 92, 74),
    (40, 72, 54),
    (58, 100, 84),
    (46, 88, 78),
    (38, 70, 46),
    (62, 110, 92),
)


@lru_cache(maxsize=_CROWNS)
def _drawn_crown(kind: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the colours and coverage of a large crown: a dome of leaf clusters, lit from the south-east."""
    random = np.random.default_rng(1000 + kind)
    half = _CROWN_PX / 2
    base = np.array(_CROWN_COLOURS[kind], np.float64)
    colour = np.empty((_CROWN_PX, _CROWN_PX, 3), np.uint8)
    colour[:] = np.clip(base * 0.45, 0, 255)
    alpha = np.zeros((_CROWN_PX, _CROWN_PX), np.uint8)
    clusters = []
    for _ in range(420):
        bearing = random.uniform(0, 2 * math.pi)
        radius_share = math.sqrt(random.uniform(0, 1)) * 0.86
        bulge = 1 + 0.12 * math.sin(3 * bearing + kind) + 0.07 * math.sin(5 * bearing + 2 * kind)
        clusters.append(
            (
                radius_share * bulge * math.cos(bearing),
                radius_share * bulge * math.sin(bearing),
                random.uniform(0.05, 0.14),
            )
        )
    clusters.sort(key=lambda cluster: math.hypot(cluster[0], cluster[1]), reverse=True)
    for x, y, radius in clusters:
        lit = 0.82 + 0.34 * (x * 0.7 + y * 0.7) + 0.16 * (1 - math.hypot(x, y)) + random.normal(0, 0.09)
        tone = tuple(float(v) for v in np.clip(base * lit, 0, 255))
        centre = (int(half + x * half * 0.88), int(half + y * half * 0.88))
        size = max(int(radius * half), 2)
        cv2.circle(alpha, centre, size, (255,), -1, cv2.LINE_AA)
        cv2.circle(colour, centre, size, tone, -1, cv2.LINE_AA)
        glint = tuple(float(v) for v in np.clip(base * (lit + 0.2), 0, 255))
        cv2.circle(colour, (centre[0] + size // 3, centre[1] + size // 3), max(size // 2, 1), glint, -1, cv2.LINE_AA)
    return cv2.GaussianBlur(colour, (3, 3), 0).astype(np.float32), alpha.astype(np.float32) / 255.0

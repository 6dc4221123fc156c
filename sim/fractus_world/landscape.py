"""Procedural ground: draws tiles of any level from the layout of roads and blocks."""

from __future__ import annotations

import math

import cv2
import numpy as np
from fractus_core.geo import LocalFrame
from numpy.typing import NDArray

from fractus_world.block import Block, Kind, Patch, Roof
from fractus_world.blocks import Blocks
from fractus_world.roads import Road, Roads, lengthened, strip
from fractus_world.tile_drawing import SUN_SHADOW, Colour, Noise, TileDrawing
from fractus_world.tiles import TILE_PX, Picture

Points = NDArray[np.float64]

FINEST_M = 0.03125
LEVELS = 12
_GRASS: Colour = (82, 126, 110)
_ASPHALT: Colour = (106, 106, 108)
_KERB: Colour = (156, 160, 162)
_TRACK: Colour = (128, 152, 166)
_PAINT: Colour = (214, 218, 220)
_TREES_DOWN_TO_M = 0.7
_DETAIL_DOWN_TO_M = 2.1
_COARSE_COLOURS: dict[Kind, Colour] = {
    "wood": (44, 72, 54),
    "houses": (92, 112, 112),
    "works": (140, 144, 146),
    "park": (72, 116, 92),
    "meadow": (78, 130, 112),
}
_SHADOW_DEPTH = 0.56
_EARTHY = np.array([0.86, 1.0, 0.98], np.float32)
_LEAFY = np.array([0.8, 1.0, 1.0], np.float32)
_LIGHT = np.clip(np.outer(np.arange(256), [0.97, 1.0, 1.03]), 0, 255).astype(np.uint8).reshape(256, 1, 3)
"""Colour correction for the light of an afternoon."""
_DASH_M = 3.0
_DASH_EVERY_M = 9.0
_JUNCTION_M = 11.0


class Landscape:
    """Ground that is generated from a seed. See `tiles.Ground`."""

    def __init__(self, frame: LocalFrame, seed: int) -> None:
        self.frame = frame
        self.finest_m = FINEST_M
        self.levels = LEVELS
        self.roads = Roads(seed)
        self.blocks = Blocks(self.roads)
        self._noise = Noise(seed)

    def tile(self, level: int, column: int, row: int) -> Picture:
        """Draw one tile."""
        pixel_m = FINEST_M * 2**level
        extent = TILE_PX * pixel_m
        drawing = TileDrawing(column * extent, -row * extent, pixel_m, TILE_PX, _GRASS)
        west, south, east, north = drawing.box
        near = self.blocks.near(west, south, east, north)
        if pixel_m > _DETAIL_DOWN_TO_M:
            self._draw_coarse(drawing, near)
            self._grain(drawing)
        else:
            blocks = [self.blocks.block(i, j) for i, j in near]
            blocks = [block for block in blocks if drawing.sees(block.outline, 12.0)]
            for block in blocks:
                _patches(drawing, block)
            self._roads(drawing, near)
            self._grain(drawing)
            _draw_raised(drawing, blocks)
        return np.asarray(cv2.LUT(drawing.colour, _LIGHT), np.uint8)

    def _draw_coarse(self, drawing: TileDrawing, near: list[tuple[int, int]]) -> None:
        """Draw the land use of each block with straight borders, and main roads. This is enough from kilometres away."""
        vertex = self.roads.vertex
        for i, j in near:
            kind = self.blocks.kind(i, j)
            colour = self.blocks.crop(i, j) if kind == "fields" else _COARSE_COLOURS[kind]
            outline = np.array([vertex(i, j), vertex(i + 1, j), vertex(i + 1, j + 1), vertex(i, j + 1)])
            drawing.fill(outline, colour, 90)
        for i, j in near if drawing.pixel_m < 10.0 else ():
            for road, corner in ((Road("east", j), (i + 1, j)), (Road("north", i), (i, j + 1))):
                if road.main:
                    drawing.line(np.array([vertex(i, j), vertex(*corner)]), _ASPHALT, 9.0)

    def _roads(self, drawing: TileDrawing, near: list[tuple[int, int]]) -> None:
        pieces = [(road, step) for i, j in near for road, step in ((Road("east", j), i), (Road("north", i), j))]
        pieces = [piece for piece in pieces if drawing.sees(self.roads.edge(*piece), 8.0)]
        pieces = sorted(pieces, key=lambda piece: piece[0].main)
        for paved in (False, True):
            for road, step in pieces:
                self._carriageway(drawing, road, step, paved=paved)
        for road, step in pieces:
            if road.main or self.roads.built_up(road, step):
                x, y = self.roads.vertex(*road.vertex(step))
                drawing.disc(x, y, self.roads.width_m(road, step) / 2 + 2.0, _ASPHALT, 36)
        for road, step in pieces:
            if road.main or self.roads.built_up(road, step):
                _marks(drawing, self.roads.edge(road, step), self.roads.width_m(road, step), road.main)

    def _carriageway(self, drawing: TileDrawing, road: Road, step: int, *, paved: bool) -> None:
        """Draw one road segment: first its verges, then its surface over the verges of its neighbours."""
        edge = lengthened(self.roads.edge(road, step), 2.5)
        half = self.roads.width_m(road, step) / 2
        built_up = self.roads.built_up(road, step)
        if not paved:
            if built_up:
                drawing.fill(strip(edge, half + 2.2, -half - 2.2), _KERB, 40)
                drawing.fill(strip(edge, half + 0.15, -half - 0.15), (122, 126, 128), 30)
            elif road.main:
                drawing.fill(strip(edge, half + 1.6, -half - 1.6), (92, 136, 124), 130)
                drawing.fill(strip(edge, half + 0.4, -half - 0.4), (112, 128, 134), 70)
            else:
                drawing.fill(strip(edge, half + 1.0, -half - 1.0), (84, 132, 116), 130)
                drawing.fill(strip(edge, half, -half), _TRACK, 90)
                drawing.fill(strip(edge, 0.45, -0.45), (96, 134, 128), 140)
        elif built_up or road.main:
            drawing.fill(strip(edge, half, -half), _ASPHALT, 36)
            if drawing.pixel_m < 0.3:
                for wheel in (-0.72, -0.3, 0.3, 0.72):
                    drawing.line(edge[:, :2] + wheel * half * edge[:, 2:], (98, 98, 100), 0.5)

    def _grain(self, drawing: TileDrawing) -> None:
        """Add noise for clods, tufts and stains, with the roughness of each material."""
        fine = self._noise.between(0.0, 0.6, drawing) * 6.5 + self._noise.between(1.0, 4.5, drawing) * 5.5
        shift = fine * (drawing.rough.astype(np.float32) / 128.0)
        shift += self._noise.between(8.0, 70.0, drawing) * 3.6 + self._noise.between(120.0, 300.0, drawing) * 2.0
        shifts = cv2.merge([shift * part for part in _EARTHY])
        drawing.colour = np.asarray(cv2.add(drawing.colour, shifts, dtype=cv2.CV_8U), np.uint8)


def _patches(drawing: TileDrawing, block: Block) -> None:
    for index in drawing.within(block.patch_boxes):
        patch = block.patches[index]
        drawing.fill(patch.outline, patch.colour, patch.rough)
        if patch.rows_deg is not None and drawing.pixel_m < 1.2:
            _rows(drawing, patch, patch.rows_deg)


def _rows(drawing: TileDrawing, patch: Patch, heading_deg: float) -> None:
    """Draw crop rows, swaths, and a tractor's tramlines every 18 m."""
    mask = drawing.mask(patch.outline)
    rows = np.flatnonzero(mask.any(axis=1))
    columns = np.flatnonzero(mask.any(axis=0))
    if len(rows) == 0:
        return
    y0 = int(rows[0])
    y1 = int(rows[-1]) + 1
    x0 = int(columns[0])
    x1 = int(columns[-1]) + 1
    across = math.radians(heading_deg + 90.0)
    east = (drawing.left_m + (np.arange(x0, x1) + 0.5) * drawing.pixel_m) * math.sin(across)
    north = (drawing.top_m - (np.arange(y0, y1) + 0.5) * drawing.pixel_m) * math.cos(across)
    first = float(east.min() + north.min())
    fine = max(drawing.pixel_m / 2, 0.02)
    count = int((float(east.max() + north.max()) - first) / fine) + 2
    profile = _profile(first + fine * np.arange(count), drawing.pixel_m)
    index = ((east[None, :] + north[:, None] - first) / fine).astype(np.int32)
    shift = profile[index] * (mask[y0:y1, x0:x1].astype(np.float32) / 255.0)
    part = drawing.colour[y0:y1, x0:x1]
    part[:] = np.clip(part + shift[..., None] * _LEAFY, 0, 255).astype(np.uint8)


def _profile(across_m: NDArray[np.floating], pixel_m: float) -> NDArray[np.float32]:
    """Return the brightness across the rows of a field."""
    seen = np.clip(0.8 - pixel_m / 0.75, 0.0, 1.0)
    rows = 7.0 * seen * np.sin(across_m * (2 * math.pi / 0.75))
    swath = np.where((across_m // 6.0) % 2 < 1.0, 2.2, -2.2)
    tram = across_m % 18.0
    lines = np.where((np.abs(tram - 8.1) < 0.28) | (np.abs(tram - 9.9) < 0.28), -17.0, 0.0)
    if pixel_m > 0.28:
        lines = lines * 0.28 / pixel_m * (np.abs(tram - 9.0) < 1.2)
    return np.asarray(rows + swath + lines, np.float32)


def _marks(drawing: TileDrawing, edge: Points, width_m: float, main: bool) -> None:
    """Draw lines along both sides of a main road, and a dashed centre line."""
    if drawing.pixel_m > 0.5:
        return
    distance = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(edge[:, :2], axis=0), axis=1))))

    def between(start_m: float, end_m: float, offset_m: float, count: int) -> Points:
        at = np.linspace(start_m, end_m, count)
        line = np.column_stack([np.interp(at, distance, edge[:, k]) for k in range(4)])
        points: Points = line[:, :2] + offset_m * line[:, 2:]
        return points

    length = float(distance[-1])
    if main:
        for side in (-1.0, 1.0):
            points = between(_JUNCTION_M, length - _JUNCTION_M, side * (width_m / 2 - 0.35), 48)
            drawing.line(points, _PAINT, 0.14)
    at = _JUNCTION_M
    while at + _DASH_M < length - _JUNCTION_M:
        dash = between(at, at + _DASH_M, 0.0, 3)
        if drawing.sees(dash, 1.0):
            drawing.line(dash, _PAINT, 0.14)
        at += _DASH_EVERY_M


def _draw_raised(drawing: TileDrawing, blocks: list[Block]) -> None:
    """Draw roofs and trees after their shadows."""
    roofs = [block.roofs[index] for block in blocks for index in drawing.within(block.roof_boxes, 10.0)]
    trees = _trees(drawing, blocks) if drawing.pixel_m <= _TREES_DOWN_TO_M else np.empty((0, 4))
    for roof in roofs:
        drawing.shadow(roof.corners, roof.height_m)
    for x, y, radius, _ in trees:
        drawing.round_shadow(x, y, radius, 1.5 * radius)
    drawing.darken_shadows(_SHADOW_DEPTH)
    for roof in roofs:
        _roof(drawing, roof)
    for x, y, radius, looks in trees:
        drawing.crown(x, y, radius, looks)


def _trees(drawing: TileDrawing, blocks: list[Block]) -> Points:
    west, south, east, north = drawing.box
    margin = 9.0
    groups = [block.trees for block in blocks if len(block.trees)]
    if not groups:
        return np.empty((0, 4))
    trees = np.vstack(groups)
    x = trees[:, 0]
    y = trees[:, 1]
    keep = (x > west - margin) & (x < east + margin) & (y > south - margin) & (y < north + margin)
    keep &= trees[:, 2] > 1.1 * drawing.pixel_m
    return np.asarray(trees[keep])


def _roof(drawing: TileDrawing, roof: Roof) -> None:
    a, b, c, d = roof.corners
    if not roof.gabled:
        drawing.fill(roof.corners, _lit(roof.colour, 1.12), 20)
        middle = roof.corners.mean(axis=0)
        drawing.fill(middle + (roof.corners - middle) * 0.95, roof.colour, 30)
        for u, v in ((0.3, 0.35), (0.62, 0.6), (0.75, 0.3)):
            at = a + u * (b - a) + v * (d - a)
            box = at + np.array([(-0.9, -0.9), (0.9, -0.9), (0.9, 0.9), (-0.9, 0.9)])
            drawing.fill(box + np.array(SUN_SHADOW) * 0.8, _lit(roof.colour, 0.62))
            drawing.fill(box, (178, 178, 176))
        return
    start = (a + d) / 2
    end = (b + c) / 2
    for near, far in ((a, b), (d, c)):
        outward = (near + far) / 2 - (start + end) / 2
        facing = float(outward @ np.array(SUN_SHADOW)) / float(np.linalg.norm(outward))
        half = np.array([near, far, end, start])
        drawing.fill(half, _lit(roof.colour, 1.0 - 0.26 * facing))
        if drawing.pixel_m < 0.07:
            _courses(drawing, half, _lit(roof.colour, 0.9 - 0.26 * facing))
    drawing.line(np.array([start, end]), _lit(roof.colour, 0.78), 0.16)
    chimney = start + 0.3 * (end - start) + 0.18 * (d - a)
    box = chimney + np.array([(-0.4, -0.4), (0.4, -0.4), (0.4, 0.4), (-0.4, 0.4)])
    drawing.fill(np.vstack((box[:2] + np.array(SUN_SHADOW) * 1.2, box[2:])), _lit(roof.colour, 0.6))
    drawing.fill(box, (92, 96, 112))


def _courses(drawing: TileDrawing, half: Points, colour: Colour) -> None:
    """Draw rows of tiles on one side of a roof, parallel to the ridge."""
    near, far, end, start = half
    count = int(np.linalg.norm(start - near) / 0.36)
    for k in range(1, count):
        share = k / count
        drawing.line(np.array([near + share * (start - near), far + share * (end - far)]), colour, 0.05)


def _lit(colour: Colour, factor: float) -> Colour:
    blue, green, red = (min(max(int(part * factor), 0), 255) for part in colour)
    return blue, green, red

"""Shapes of vehicles and people: convex parts that are drawn on top of each other."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fractus_world.population import Kind, Thing

Points = NDArray[np.float64]
Colour = tuple[int, int, int]

PAINTS: tuple[Colour, ...] = (
    (232, 234, 234),
    (232, 234, 234),
    (60, 58, 56),
    (44, 40, 38),
    (172, 172, 170),
    (150, 148, 146),
    (128, 84, 46),
    (44, 40, 168),
    (108, 70, 40),
    (70, 92, 60),
    (60, 120, 190),
    (120, 130, 140),
)
CLOTHES: tuple[Colour, ...] = (
    (60, 50, 190),
    (200, 190, 180),
    (150, 90, 40),
    (60, 60, 60),
    (90, 150, 210),
    (110, 160, 80),
    (230, 230, 228),
    (160, 80, 140),
)
_HAIR: tuple[Colour, ...] = ((34, 40, 52), (24, 26, 30), (70, 110, 150), (120, 124, 130), (40, 60, 92))
_TROUSERS: tuple[Colour, ...] = ((92, 66, 48), (50, 50, 52), (110, 130, 148), (70, 62, 60))
_GLASS: Colour = (58, 50, 44)


@dataclass(frozen=True, slots=True)
class Part:
    """A convex part of a body.

    Attributes:
        points: Corners in metres ahead, to the right and up, shape (n, 3).
        colour: Blue, green, red.
        warmth: Grey value for a thermal camera.
        detail: True if the part is omitted when the body is only a few pixels long.
    """

    points: Points
    colour: Colour
    warmth: int
    detail: bool = False


def parts_of(thing: Thing) -> tuple[Part, ...]:
    """Return the parts of a thing in drawing order."""
    moving = thing.speed_mps > 0.1
    if thing.kind == "person":
        stride = 2 * math.pi * ((thing.x + thing.y) % 1.4) / 1.4 if moving else 0.0
        return _person(thing.looks % 997, round(4 * math.sin(stride)))
    return _VEHICLES[thing.kind](PAINTS[thing.looks // 128 % len(PAINTS)], moving)


def _outline(length: float, width: float, *, nose: float = 0.0, round_m: float = 0.3) -> Points:
    """Return a rectangle with cut corners around the origin, shifted ahead by `nose` metres."""
    a = length / 2
    b = width / 2
    c = round_m
    corners = [(a - c, b), (a, b - c), (a, c - b), (a - c, -b), (c - a, -b), (-a, c - b), (-a, b - c), (c - a, b)]
    return _moved(np.array(corners), nose, 0.0)


def _moved(outline: Points, ahead: float, right: float) -> Points:
    return np.asarray(outline + np.array([ahead, right]))


def _at(outline: Points, height: float) -> Points:
    return np.column_stack((outline, np.full(len(outline), height)))


def _prism(low: Points, low_m: float, high: Points, high_m: float) -> Points:
    return np.vstack((_at(low, low_m), _at(high, high_m)))


def _shaded(colour: Colour, factor: float) -> Colour:
    blue, green, red = (min(max(int(part * factor), 0), 255) for part in colour)
    return blue, green, red


def _lights(ahead: float, width: float, height: float) -> tuple[Part, ...]:
    parts = []
    for side in (-1, 1):
        centre = side * (width / 2 - 0.33)
        box = _outline(0.22, 0.36, round_m=0.08)
        parts.append(Part(_at(_moved(box, ahead - 0.2, centre), height), (236, 240, 240), 150, detail=True))
        parts.append(Part(_at(_moved(box, -ahead + 0.14, centre), height), (40, 36, 170), 120, detail=True))
    return tuple(parts)


@lru_cache(maxsize=64)
def _car(paint: Colour, moving: bool) -> tuple[Part, ...]:
    base = _outline(4.4, 1.78, round_m=0.38)
    belt = _outline(4.5, 1.85, round_m=0.42)
    cabin = _outline(2.75, 1.62, nose=-0.3, round_m=0.25)
    roof = _outline(1.65, 1.36, nose=-0.42, round_m=0.2)
    pillars = _outline(2.0, 1.46, nose=-0.4, round_m=0.1)
    bonnet = _outline(1.0, 1.3, nose=1.55, round_m=0.2)
    return (
        Part(_prism(base, 0.18, belt, 0.82), _shaded(paint, 0.55), 128),
        Part(_at(belt, 0.86), paint, 150),
        Part(_at(bonnet, 0.9), _shaded(paint, 1.06), 226 if moving else 150, detail=True),
        *_lights(2.25, 1.85, 0.86),
        Part(_prism(cabin, 0.88, roof, 1.42), _GLASS, 120),
        Part(_prism(pillars, 1.3, roof, 1.42), _shaded(paint, 0.75), 140, detail=True),
        Part(_at(roof, 1.46), _shaded(paint, 1.05), 150),
    )


@lru_cache(maxsize=64)
def _van(paint: Colour, moving: bool) -> tuple[Part, ...]:
    base = _outline(5.6, 2.05, round_m=0.3)
    roof = _outline(4.3, 1.86, nose=-0.55, round_m=0.2)
    screen = _outline(0.75, 1.7, nose=1.75, round_m=0.12)
    bonnet = _outline(0.8, 1.5, nose=2.3, round_m=0.2)
    return (
        Part(_prism(base, 0.2, base, 1.05), _shaded(paint, 0.55), 128),
        Part(_at(base, 1.08), _shaded(paint, 0.95), 150),
        Part(_at(bonnet, 1.12), paint, 220 if moving else 150, detail=True),
        *_lights(2.8, 2.05, 1.08),
        Part(_prism(_outline(4.9, 1.95, nose=-0.35), 1.08, roof, 2.26), _shaded(paint, 0.7), 140),
        Part(
            np.vstack((_at(_moved(screen, 0.2, 0.0), 1.3), _at(_moved(screen, -0.15, 0.0), 2.1))),
            _GLASS,
            120,
            detail=True,
        ),
        Part(_at(roof, 2.3), _shaded(paint, 1.04), 150),
    )


@lru_cache(maxsize=64)
def _truck(paint: Colour, moving: bool) -> tuple[Part, ...]:
    cab = _outline(2.2, 2.45, nose=4.1, round_m=0.25)
    box = _outline(7.8, 2.5, nose=-1.3, round_m=0.05)
    load: Colour = (206, 208, 206)
    return (
        Part(_prism(_outline(10.4, 2.2), 0.4, _outline(10.4, 2.2), 1.0), (54, 54, 56), 140),
        Part(_prism(cab, 0.5, cab, 2.7), _shaded(paint, 0.55), 160),
        Part(_at(cab, 2.75), paint, 215 if moving else 150),
        Part(np.vstack((_at(_moved(cab, 0.05, 0.0), 1.6), _at(cab, 2.4))), _GLASS, 130, detail=True),
        Part(_at(cab, 2.75), paint, 215 if moving else 150, detail=True),
        Part(_prism(box, 1.0, box, 3.55), _shaded(load, 0.6), 120),
        Part(_at(box, 3.6), load, 132),
        Part(_at(_outline(0.5, 2.3, nose=2.2, round_m=0.05), 3.62), _shaded(load, 0.86), 132, detail=True),
    )


@lru_cache(maxsize=64)
def _bus(paint: Colour, moving: bool) -> tuple[Part, ...]:
    base = _outline(12.0, 2.55, round_m=0.35)
    roof = _outline(11.7, 2.35, round_m=0.35)
    return (
        Part(_prism(base, 0.3, base, 1.2), _shaded(paint, 0.55), 140),
        Part(_prism(base, 1.2, roof, 2.6), _GLASS, 130),
        Part(_prism(roof, 2.6, roof, 3.0), _shaded(paint, 0.8), 150),
        Part(_at(roof, 3.05), paint, 160),
        Part(_at(_outline(2.6, 1.7, nose=2.6), 3.1), _shaded(paint, 0.82), 190 if moving else 160, detail=True),
        Part(_at(_outline(1.8, 1.5, nose=-3.4), 3.1), _shaded(paint, 0.82), 220 if moving else 160, detail=True),
    )


@lru_cache(maxsize=4096)
def _person(looks: int, stride: int) -> tuple[Part, ...]:
    shirt = CLOTHES[looks % len(CLOTHES)]
    hair = _HAIR[looks // 8 % len(_HAIR)]
    trousers = _TROUSERS[looks // 40 % len(_TROUSERS)]
    step = 0.07 * stride
    foot = _outline(0.28, 0.11, round_m=0.05)
    hips = _outline(0.24, 0.36, round_m=0.1)
    chest = _outline(0.27, 0.5, round_m=0.11)
    head = _outline(0.22, 0.18, round_m=0.07)
    left = _moved(foot, step, -0.1)
    right = _moved(foot, -step, 0.1)
    return (
        Part(np.vstack((_at(left, 0.0), _at(_moved(hips, 0.0, -0.02), 0.9))), _shaded(trousers, 0.8), 214),
        Part(np.vstack((_at(right, 0.0), _at(hips, 0.9))), trousers, 220),
        Part(_prism(hips, 0.85, chest, 1.4), _shaded(shirt, 0.72), 230),
        Part(_at(chest, 1.45), shirt, 236),
        Part(
            _at(_moved(_outline(0.14, 0.12, round_m=0.04), 0.16 - step, 0.28), 1.0), (130, 150, 190), 248, detail=True
        ),
        Part(
            _at(_moved(_outline(0.14, 0.12, round_m=0.04), 0.16 + step, -0.28), 1.0), (130, 150, 190), 248, detail=True
        ),
        Part(_prism(head * 0.8, 1.48, head, 1.68), (120, 144, 186), 252),
        Part(_prism(head, 1.62, head * 0.8, 1.75), hair, 250),
    )


_VEHICLES: dict[Kind, Callable[[Colour, bool], tuple[Part, ...]]] = {
    "car": _car,
    "van": _van,
    "truck": _truck,
    "bus": _bus,
}


def silhouette(thing: Thing) -> tuple[Part, ...]:
    """Return simplified parts of a thing that is only a few pixels long, in its main colour."""
    if thing.kind == "person":
        return _far_person(CLOTHES[thing.looks % 997 % len(CLOTHES)])
    colour = (206, 208, 206) if thing.kind == "truck" else PAINTS[thing.looks // 128 % len(PAINTS)]
    return _far_vehicle(thing.size_m, colour)


@lru_cache(maxsize=128)
def _far_vehicle(size_m: tuple[float, float, float], paint: Colour) -> tuple[Part, ...]:
    length, width, height = size_m
    base = _outline(length, width, round_m=0.4)
    roof = _outline(0.6 * length, 0.8 * width, round_m=0.2)
    low = 0.6 * height
    return (
        Part(_prism(base, 0.2, base, low), _shaded(paint, 0.62), 140),
        Part(_prism(base, low, roof, height), _shaded(paint, 0.95), 160),
    )


@lru_cache(maxsize=64)
def _far_person(shirt: Colour) -> tuple[Part, ...]:
    return (Part(_prism(_outline(0.24, 0.36, round_m=0.1), 0.0, _outline(0.27, 0.5, round_m=0.11), 1.75), shirt, 236),)

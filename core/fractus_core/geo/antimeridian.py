"""Cuts paths at the antimeridian (RFC 7946, 3.1.9). Programs would draw an uncut path around the world."""

from __future__ import annotations

from collections.abc import Sequence

Position = tuple[float, ...]
"""Longitude and latitude in degrees, and any further values, such as altitude and time."""


def cut_path(points: Sequence[Position]) -> list[list[Position]]:
    """Return the parts of a path between its crossings of the antimeridian.

    At a crossing, one part ends at a longitude of 180 or -180 degrees, and the next part begins at the longitude with
    the opposite sign. The other values at the crossing are interpolated. The leg between two points is the shorter
    connection.

    Args:
        points: Points in order.
    """
    parts: list[list[Position]] = []
    for point in points:
        if not parts:
            parts.append([point])
            continue
        last = parts[-1][-1]
        turn = _turn(last[0], point[0])
        if turn:
            span = point[0] + turn - last[0]
            edge = 180.0 if turn > 0 else -180.0
            share = (edge - last[0]) / span if span else 0.0
            others = [a + (b - a) * share for a, b in zip(last[1:], point[1:], strict=True)]
            if last[0] != edge:
                parts[-1].append((edge, *others))
            parts.append([] if point[0] == -edge else [(-edge, *others)])
        parts[-1].append(point)
    return parts


def _turn(start: float, end: float) -> float:
    """Return the degrees to add to the end so that the end is at most 180 degrees from the start."""
    if end - start > 180.0:
        return -360.0
    return 360.0 if end - start < -180.0 else 0.0

"""Map of flights: paths, zones, nodes with their WiFi range, and marks of events."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import shapely
from fractus_core.geo import LocalFrame
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, PathPatch
from matplotlib.path import Path as Outline

from fractus_sim.report.figure_style import (
    BLUE,
    GREEN,
    GREY,
    INK,
    MARKS,
    PURPLE,
    SKY,
    TRACK_COLOURS,
    VERMILION,
    add_legend,
    draw_number,
    new_figure,
)
from fractus_sim.report.track import Track

XY = tuple[float, float]
ZoneKind = Literal["exclusion", "denial", "camera", "inclusion", "limit", "other"]


@dataclass(frozen=True, slots=True)
class DrawnZone:
    """A zone on a map. `shape` is a shapely geometry in metres, in the frame of the map."""

    name: str
    kind: ZoneKind
    shape: Any


@dataclass(frozen=True, slots=True)
class DrawnNode:
    """An edge node with its WiFi range."""

    name: str
    position: XY
    wifi_range_m: float | None
    used: bool


@dataclass(frozen=True, slots=True)
class Mark:
    """A numbered event mark.

    Attributes:
        kind: Drawing style.
        number: Number or letter of the event on the report page.
        position: Position of the event in the frame of the map.
        origin: Position of the drone, if `position` is a denied target.
        label: Legend text. Default: the kind.
    """

    kind: Literal["refused", "corrected", "fault"]
    number: str
    position: XY
    origin: XY | None = None
    label: str = ""


@dataclass(frozen=True)
class FlightMap:
    """Content of a map, in metres east and north of the frame's origin.

    Attributes:
        area: Shape of the operation area.
        depots: Names and positions.
        landings: Names and positions of landing places.
        links: For each direct link, the positions of the drone when it began to use the link, and of the node.
    """

    title: str
    frame: LocalFrame
    tracks: tuple[Track, ...]
    zones: tuple[DrawnZone, ...] = ()
    area: Any = None
    nodes: tuple[DrawnNode, ...] = ()
    depots: tuple[tuple[str, XY], ...] = ()
    landings: tuple[tuple[str, XY], ...] = ()
    marks: tuple[Mark, ...] = ()
    links: tuple[tuple[XY, XY], ...] = ()


_MARGIN_M = 45.0
_MARGIN_SHARE = 0.12
_NAMED_TRACKS = 10
_ASPECT = 1.25
_NEAR_M = 150.0
_ZONE_STYLES: Mapping[str, tuple[str, str, str]] = {
    "exclusion": (VERMILION, "///", "no-fly zone"),
    "denial": (PURPLE, "...", "calls denied"),
    "camera": (PURPLE, "\\\\\\", "privacy filter"),
    "inclusion": (GREEN, "", "stay inside"),
    "limit": (GREY, "", "limits apply"),
    "other": (GREY, "", "zone"),
}
Bounds = tuple[float, float, float, float]


def draw_map(content: FlightMap) -> Figure:
    """Draw the map, in metres east and north of home."""
    figure, axes = new_figure(9.0, 6.6)
    bounds = _bounds(content)
    _draw_zones(axes, content, bounds)
    _draw_operation_area(axes, content)
    _draw_nodes(axes, content, bounds)
    if len(content.tracks) == 1:
        _draw_track(axes, content, figure)
    else:
        _draw_tracks(axes, content)
    for drone, node in content.links:
        axes.plot(
            *zip(drone, node, strict=True), color=GREEN, linewidth=2.0, label="traffic moves to a direct link", zorder=5
        )
    _draw_marks(axes, content)
    axes.set_xlim(bounds[0], bounds[2])
    axes.set_ylim(bounds[1], bounds[3])
    axes.set_aspect("equal")
    axes.set_xlabel("metres east of home", fontsize=9)
    axes.set_ylabel("metres north of home", fontsize=9)
    axes.grid(color="#EEEEEE", linewidth=0.6, zorder=0)
    axes.set_axisbelow(True)
    axes.set_title(content.title, fontsize=11, loc="left")
    add_legend(figure, axes)
    return figure


def _bounds(content: FlightMap) -> Bounds:
    """Return the visible extent: paths, operation area, marks and restrictive zones. Other objects are clipped."""
    points: list[XY] = [content.frame.xy(s.place.lat, s.place.lon) for track in content.tracks for s in track.samples]
    points += [mark.position for mark in content.marks]
    if content.area is not None and not content.area.is_empty:
        points += _corners(content.area)
    near = shapely.box(*_grown(_corners(shapely.MultiPoint(points or [(0.0, 0.0)])), _NEAR_M))
    for zone in content.zones:
        if zone.kind != "limit" and zone.shape.intersects(near):
            points += _corners(zone.shape)
    low_x, low_y, high_x, high_y = shapely.MultiPoint(points or [(0.0, 0.0)]).bounds
    margin_m = min(_MARGIN_M, max(_MARGIN_SHARE * max(high_x - low_x, high_y - low_y), 5.0))
    half_x = (high_x - low_x) / 2 + margin_m
    half_y = (high_y - low_y) / 2 + margin_m
    half_width = max(half_x, half_y * _ASPECT)
    half_height = max(half_y, half_x / _ASPECT)
    x = (low_x + high_x) / 2
    y = (low_y + high_y) / 2
    return x - half_width, y - half_height, x + half_width, y + half_height


def _grown(corners: list[XY], by_m: float) -> Bounds:
    (low_x, low_y), (high_x, high_y) = corners
    return low_x - by_m, low_y - by_m, high_x + by_m, high_y + by_m


def _corners(shape: Any) -> list[XY]:
    return [(shape.bounds[0], shape.bounds[1]), (shape.bounds[2], shape.bounds[3])]


def _draw_operation_area(axes: Any, content: FlightMap) -> None:
    if content.area is None or content.area.is_empty:
        return
    for part in getattr(content.area, "geoms", [content.area]):
        _draw_shape(
            axes, part, facecolor=SKY, alpha=0.25, edgecolor=BLUE, linewidth=0.8, label="operation area", zorder=2
        )


def _draw_zones(axes: Any, content: FlightMap, bounds: Bounds) -> None:
    window = shapely.box(*bounds)
    for zone in content.zones:
        colour, hatch, label = _ZONE_STYLES[zone.kind]
        shape = zone.shape.intersection(window)
        if shape.is_empty:
            continue
        if zone.kind == "limit":
            axes.annotate(
                f"zone {zone.name}: limits apply", (bounds[0], bounds[3]), xytext=(6, -12), textcoords="offset points",
                fontsize=8, color=GREY, style="italic",
            )  # fmt: skip
            continue
        for part in getattr(shape, "geoms", [shape]):
            _draw_shape(axes, part, facecolor=colour, alpha=0.13, edgecolor="none", zorder=1)
            _draw_shape(
                axes, part, facecolor="none", edgecolor=colour, hatch=hatch, linewidth=1.2, label=label, zorder=1.5
            )
        beside = content.area is not None and content.area.intersects(shape)
        _draw_zone_name(axes, zone.name, shape, colour, beside=beside)


def _draw_zone_name(axes: Any, name: str, shape: Any, colour: str, *, beside: bool) -> None:
    """Draw the name of a zone at its upper border, or next to the zone if the path crosses that position."""
    low_x, low_y, high_x, high_y = shape.bounds
    position = (high_x, (low_y + high_y) / 2) if beside else ((low_x + high_x) / 2, high_y)
    axes.annotate(
        name, position, xytext=(5 if beside else 0, 0), textcoords="offset points", ha="left" if beside else "center",
        va="center", fontsize=8.5, color=INK, zorder=5.8,
        bbox={"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": colour, "alpha": 0.9},
    )  # fmt: skip


def _draw_shape(axes: Any, shape: Any, **style: Any) -> None:
    rings = [shape.exterior, *shape.interiors]
    vertices = np.concatenate([np.asarray(ring.coords) for ring in rings])
    codes = np.concatenate(
        [[Outline.MOVETO, *[Outline.LINETO] * (len(r.coords) - 2), Outline.CLOSEPOLY] for r in rings]
    )
    axes.add_patch(PathPatch(Outline(vertices, codes), **style))


def _draw_nodes(axes: Any, content: FlightMap, bounds: Bounds) -> None:
    for node in content.nodes:
        at = node.position
        if not (bounds[0] < at[0] < bounds[2] and bounds[1] < at[1] < bounds[3]):
            _draw_far_node(axes, node.name, at, bounds)
            continue
        if node.wifi_range_m is not None:
            axes.add_patch(
                Circle(
                    at, node.wifi_range_m, fill=False, edgecolor=GREEN, linestyle=(0, (4, 3)), linewidth=1.0, zorder=3
                )
            )
            axes.plot([], [], color=GREEN, linestyle=(0, (4, 3)), linewidth=1.0, label="WiFi range")
        axes.plot(
            *at, marker="s", markersize=9, color=GREEN if node.used else "white", markeredgecolor=INK, linestyle="none",
            label="edge node in use" if node.used else "edge node not used", zorder=6,
        )  # fmt: skip
        axes.annotate(
            node.name, at, xytext=(0, -15), textcoords="offset points", ha="center", fontsize=8.5, color=INK, zorder=6
        )
    for letter, name, at in (
        *(("H", name, at) for name, at in content.depots),
        *(("L", name, at) for name, at in content.landings),
    ):
        axes.plot(*at, marker="o", markersize=11, color="white", markeredgecolor=INK, markeredgewidth=1.5, zorder=6)
        axes.annotate(letter, at, ha="center", va="center", fontsize=7.5, fontweight="bold", color=INK, zorder=7)
        axes.annotate(
            name, at, xytext=(0, -16), textcoords="offset points", ha="center", fontsize=8.5, color=INK, zorder=6
        )


def _draw_far_node(axes: Any, name: str, at: XY, bounds: tuple[float, float, float, float]) -> None:
    """Draw a pointer to a node outside of the map."""
    middle = ((bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2)
    dx = at[0] - middle[0]
    dy = at[1] - middle[1]
    half = ((bounds[2] - bounds[0]) / 2, (bounds[3] - bounds[1]) / 2)
    share = min(half[0] / abs(dx) if dx else math.inf, half[1] / abs(dy) if dy else math.inf)
    tip = (middle[0] + dx * share * 0.99, middle[1] + dy * share * 0.99)
    tail = (middle[0] + dx * share * 0.86, middle[1] + dy * share * 0.86)
    axes.annotate("", tip, xytext=tail, arrowprops={"arrowstyle": "-|>", "color": GREY, "linewidth": 1.4}, zorder=6)
    axes.annotate(
        f"{name}\n{math.hypot(*at):.0f} m from home", tail, xytext=(-9 if dx > 0 else 9, -2), textcoords="offset points",
        ha="right" if dx > 0 else "left", va="top", fontsize=8, color=GREY, zorder=6,
    )  # fmt: skip


def _points(content: FlightMap, track: Track) -> np.ndarray:
    return np.array([content.frame.xy(s.place.lat, s.place.lon) for s in track.samples])


def _draw_track(axes: Any, content: FlightMap, figure: Figure) -> None:
    """Draw a single track, coloured by altitude."""
    (track,) = content.tracks
    if len(track.samples) < 2:
        return
    points = _points(content, track)
    heights = np.array([s.place.alt_m for s in track.samples])
    segments = np.stack([points[:-1], points[1:]], axis=1)
    axes.plot(points[:, 0], points[:, 1], color="white", linewidth=5.0, zorder=4, solid_capstyle="round")
    line = LineCollection(list(segments), cmap="viridis", linewidth=3.0, zorder=5, capstyle="round")
    line.set_array((heights[:-1] + heights[1:]) / 2)
    axes.add_collection(line)
    bar = figure.colorbar(line, ax=axes, shrink=0.6, pad=0.01, aspect=30)
    bar.set_label("metres above home", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    _draw_arrows(axes, points)


def _draw_tracks(axes: Any, content: FlightMap) -> None:
    """Draw several tracks, each with its own colour and start mark."""
    for index, track in enumerate(content.tracks):
        if len(track.samples) < 2:
            continue
        colour = TRACK_COLOURS[index % len(TRACK_COLOURS)]
        points = _points(content, track)
        label = track.name if len(content.tracks) <= _NAMED_TRACKS else None
        axes.plot(points[:, 0], points[:, 1], color="white", linewidth=3.6, zorder=4, solid_capstyle="round")
        axes.plot(points[:, 0], points[:, 1], color=colour, linewidth=2.0, zorder=5, label=label)
        axes.plot(
            *points[0], marker="o", markersize=6, color="white", markeredgecolor=colour, markeredgewidth=2.0, zorder=6
        )
        _draw_arrows(axes, points, colour)


def _draw_arrows(axes: Any, points: np.ndarray, colour: str = INK) -> None:
    """Draw arrowheads in flight direction at equal distances along the path."""
    steps = np.hypot(*np.diff(points, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    if along[-1] < 5.0:
        return
    for share in (0.1, 0.26, 0.42, 0.58, 0.74, 0.9):
        i = int(np.searchsorted(along, share * along[-1]))
        ahead = int(np.searchsorted(along, along[i] + max(along[-1] * 0.01, 1.0)))
        if i < ahead < len(points):
            axes.annotate(
                "", points[ahead], xytext=points[i],
                arrowprops={"arrowstyle": "-|>", "color": colour, "linewidth": 0, "mutation_scale": 13}, zorder=5.5,
            )  # fmt: skip


def _draw_marks(axes: Any, content: FlightMap) -> None:
    for mark in content.marks:
        if mark.kind == "refused" and mark.origin is not None:
            axes.plot(
                [mark.origin[0], mark.position[0]], [mark.origin[1], mark.position[1]], color=VERMILION, linewidth=1.2,
                linestyle=":", zorder=6,
            )  # fmt: skip
        axes.plot(*mark.position, **MARKS[mark.kind], label=mark.label or mark.kind, zorder=8)
        draw_number(axes, mark.number, *mark.position)

"""The flight seen from above: path, zones, nodes and their reach, and the requests that policies changed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import shapely
import shapely.geometry
from fractus_core.api import EdgeNode, Policy, Zone
from fractus_core.geo import polygon
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, PathPatch
from matplotlib.path import Path as Outline

from fractus_sim.report.drawing import (
    BLUE,
    CORRECTED,
    GREEN,
    GREY,
    INK,
    PURPLE,
    REFUSED,
    SKY,
    VERMILION,
    canvas,
    number,
)
from fractus_sim.report.record import Record

_MARGIN_M = 45.0
_ZONE_STYLES: Mapping[str, tuple[str, str, str]] = {
    "exclusion": (VERMILION, "///", "no-fly zone"),
    "denial": (PURPLE, "...", "calls denied"),
    "camera": (PURPLE, "\\\\\\", "privacy filter"),
    "inclusion": (GREEN, "", "stay inside"),
    "limit": (GREY, "", "limits hold"),
}
XY = tuple[float, float]


def draw_map(record: Record) -> Figure:
    """Draw the map, in metres east and north of home."""
    figure, axes = canvas(9.0, 6.6)
    bounds = _bounds(record)
    _zones(axes, record, bounds)
    _operation_area(axes, record)
    _nodes(axes, record, bounds)
    _path(axes, record, figure)
    _requests(axes, record)
    axes.set_xlim(bounds[0], bounds[2])
    axes.set_ylim(bounds[1], bounds[3])
    axes.set_aspect("equal")
    axes.set_xlabel("metres east of home", fontsize=9)
    axes.set_ylabel("metres north of home", fontsize=9)
    axes.grid(color="#EEEEEE", linewidth=0.6, zorder=0)
    axes.set_axisbelow(True)
    drone = record.drone.name if record.drone else "no drone"
    axes.set_title(f"{record.application.name}: {drone}, {record.distance_m:.0f} m", fontsize=11, loc="left")
    handles, labels = axes.get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    figure.legend(unique.values(), unique.keys(), loc="outside lower center", ncols=5, fontsize=8, frameon=False)
    return figure


def _bounds(record: Record) -> tuple[float, float, float, float]:
    """What is shown: path, operation area, requests, and the zones that close or deny; the rest is cut off."""
    frame = record.frame
    shown: list[XY] = [frame.xy(s.place.lat, s.place.lon) for s in record.samples]
    shown += [frame.xy(j.asked.lat, j.asked.lon) for j in record.judgements if j.asked is not None]
    area = _area_shape(record)
    if area is not None and not area.is_empty:
        shown += [(area.bounds[0], area.bounds[1]), (area.bounds[2], area.bounds[3])]
    core = shapely.box(*shapely.MultiPoint(shown or [(0.0, 0.0)]).buffer(150.0).bounds)
    for zone, kind in _classified(record):
        shape = polygon(frame, zone.spec.area)
        if kind != "limit" and shape.intersects(core):
            shown += [(shape.bounds[0], shape.bounds[1]), (shape.bounds[2], shape.bounds[3])]
    low_x, low_y, high_x, high_y = shapely.MultiPoint(shown or [(0.0, 0.0)]).bounds
    return low_x - _MARGIN_M, low_y - _MARGIN_M, high_x + _MARGIN_M, high_y + _MARGIN_M


def _area_shape(record: Record) -> Any:
    if record.plan is None or record.plan.spec.operation_area is None:
        return None
    shape = shapely.geometry.shape(record.plan.spec.operation_area)
    frame = record.frame

    def metres(lonlat: np.ndarray) -> np.ndarray:
        return np.array([frame.xy(lat, lon) for lon, lat in lonlat])

    return shapely.transform(shape, metres)


def _operation_area(axes: Any, record: Record) -> None:
    shape = _area_shape(record)
    if shape is None or shape.is_empty:
        return
    for part in getattr(shape, "geoms", [shape]):
        _patch(axes, part, facecolor=SKY, alpha=0.25, edgecolor=BLUE, linewidth=0.8, label="operation area", zorder=2)


def _classified(record: Record) -> Iterable[tuple[Zone, str]]:
    """Each zone with the strictest kind of policy that holds there for this drone."""
    for zone in record.zones:
        kinds = [_kind(p) for p in record.policies_in_force if zone.name in p.spec.selector.zones]
        order = [kind for kind in _ZONE_STYLES if kind in kinds]
        if order:
            yield zone, order[0]


def _kind(policy: Policy) -> str:
    return "limit" if policy.spec.type == "LimitControl" else policy.spec.kind


def _zones(axes: Any, record: Record, bounds: tuple[float, float, float, float]) -> None:
    window, area = shapely.box(*bounds), _area_shape(record)
    for zone, kind in _classified(record):
        colour, hatch, label = _ZONE_STYLES[kind]
        shape = polygon(record.frame, zone.spec.area).intersection(window)
        if shape.is_empty:
            continue
        if kind == "limit":
            x, y = bounds[0], bounds[3]
            axes.annotate(
                f"zone {zone.name}: limits hold", (x, y), xytext=(6, -12), textcoords="offset points", fontsize=8,
                color=GREY, style="italic",
            )  # fmt: skip
            continue
        for part in getattr(shape, "geoms", [shape]):
            _patch(axes, part, facecolor=colour, alpha=0.13, edgecolor="none", zorder=1)
            _patch(axes, part, facecolor="none", edgecolor=colour, hatch=hatch, linewidth=1.2, label=label, zorder=1.5)
        _zone_name(axes, zone.name, shape, colour, beside=area is not None and area.intersects(shape))


def _zone_name(axes: Any, name: str, shape: Any, colour: str, *, beside: bool) -> None:
    """Write a zone's name on its upper border, or beside it where the path crosses it."""
    low_x, low_y, high_x, high_y = shape.bounds
    at = (high_x, (low_y + high_y) / 2) if beside else ((low_x + high_x) / 2, high_y)
    axes.annotate(
        name, at, xytext=(5 if beside else 0, 0), textcoords="offset points", ha="left" if beside else "center",
        va="center", fontsize=8.5, color=INK, zorder=5.8,
        bbox={"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": colour, "alpha": 0.9},
    )  # fmt: skip


def _patch(axes: Any, shape: Any, **style: Any) -> None:
    rings = [shape.exterior, *shape.interiors]
    vertices = np.concatenate([np.asarray(ring.coords) for ring in rings])
    codes = np.concatenate(
        [[Outline.MOVETO, *[Outline.LINETO] * (len(r.coords) - 2), Outline.CLOSEPOLY] for r in rings]
    )
    axes.add_patch(PathPatch(Outline(vertices, codes), **style))


def _nodes(axes: Any, record: Record, bounds: tuple[float, float, float, float]) -> None:
    used = {p.node for p in record.plan.spec.placements} if record.plan else set()
    for node in record.edge_nodes:
        at = record.frame.xy(node.spec.location.lat, node.spec.location.lon)
        chosen = node.name in used
        if not (bounds[0] < at[0] < bounds[2] and bounds[1] < at[1] < bounds[3]):
            _far_node(axes, node.name, at, bounds)
            continue
        reach = _reach_m(node)
        if reach is not None:
            axes.add_patch(
                Circle(at, reach, fill=False, edgecolor=GREEN, linestyle=(0, (4, 3)), linewidth=1.0, zorder=3)
            )
            axes.plot([], [], color=GREEN, linestyle=(0, (4, 3)), linewidth=1.0, label="WiFi reach")
        label = "edge node in use" if chosen else "edge node not used"
        axes.plot(
            *at, marker="s", markersize=9, color=GREEN if chosen else "white", markeredgecolor=INK, linestyle="none",
            label=label, zorder=6,
        )  # fmt: skip
        axes.annotate(
            node.name, at, xytext=(0, -15), textcoords="offset points", ha="center", fontsize=8.5, color=INK, zorder=6
        )
    for depot in record.depots:
        at = record.frame.xy(depot.spec.location.lat, depot.spec.location.lon)
        axes.plot(*at, marker="o", markersize=11, color="white", markeredgecolor=INK, markeredgewidth=1.5, zorder=6)
        axes.annotate("H", at, ha="center", va="center", fontsize=7.5, fontweight="bold", color=INK, zorder=7)
        axes.annotate(
            depot.name, at, xytext=(0, -16), textcoords="offset points", ha="center", fontsize=8.5, color=INK, zorder=6
        )


def _far_node(axes: Any, name: str, at: XY, bounds: tuple[float, float, float, float]) -> None:
    """Point at a node beyond the border."""
    middle = ((bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2)
    dx, dy = at[0] - middle[0], at[1] - middle[1]
    half = ((bounds[2] - bounds[0]) / 2, (bounds[3] - bounds[1]) / 2)
    share = min(half[0] / abs(dx) if dx else math.inf, half[1] / abs(dy) if dy else math.inf)
    tip = (middle[0] + dx * share * 0.99, middle[1] + dy * share * 0.99)
    tail = (middle[0] + dx * share * 0.86, middle[1] + dy * share * 0.86)
    axes.annotate("", tip, xytext=tail, arrowprops={"arrowstyle": "-|>", "color": GREY, "linewidth": 1.4}, zorder=6)
    axes.annotate(
        f"{name}\n{math.hypot(*at):.0f} m from home", tail, xytext=(-9 if dx > 0 else 9, -2), textcoords="offset points",
        ha="right" if dx > 0 else "left", va="top", fontsize=8, color=GREY, zorder=6,
    )  # fmt: skip


def _reach_m(node: EdgeNode) -> float | None:
    return max((i.range for i in node.spec.interfaces if i.range is not None and i.pairing is not None), default=None)


def _path(axes: Any, record: Record, figure: Figure) -> None:
    if len(record.samples) < 2:
        return
    points = np.array([record.frame.xy(s.place.lat, s.place.lon) for s in record.samples])
    heights = np.array([s.place.alt_m for s in record.samples])
    segments = np.stack([points[:-1], points[1:]], axis=1)
    axes.plot(points[:, 0], points[:, 1], color="white", linewidth=5.0, zorder=4, solid_capstyle="round")
    line = LineCollection(list(segments), cmap="viridis", linewidth=3.0, zorder=5, capstyle="round")
    line.set_array((heights[:-1] + heights[1:]) / 2)
    axes.add_collection(line)
    bar = figure.colorbar(line, ax=axes, shrink=0.6, pad=0.01, aspect=30)
    bar.set_label("metres above home", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    step = max(len(points) // 6, 1)
    for i in range(step // 2, len(points) - 1, step):
        ahead = points[min(i + 2, len(points) - 1)] - points[i]
        if math.hypot(*ahead) > 1.0:
            axes.annotate(
                "", points[i] + ahead, xytext=points[i],
                arrowprops={"arrowstyle": "-|>", "color": INK, "linewidth": 0, "mutation_scale": 13}, zorder=5.5,
            )  # fmt: skip


def _requests(axes: Any, record: Record) -> None:
    for index, judged in enumerate(record.judgements, 1):
        place = judged.asked or judged.at
        if place is None:
            continue
        x, y = record.frame.xy(place.lat, place.lon)
        if judged.refused and judged.asked is not None and judged.at is not None:
            start = record.frame.xy(judged.at.lat, judged.at.lon)
            axes.plot([start[0], x], [start[1], y], color=VERMILION, linewidth=1.2, linestyle=":", zorder=6)
        style = REFUSED if judged.refused else CORRECTED
        axes.plot(x, y, **style, label="refused" if judged.refused else "corrected", zorder=8)
        number(axes, str(index), x, y)

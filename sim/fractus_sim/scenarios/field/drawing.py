"""The two figures of the experiment: map with three flights (Fig. 8.10) and their altitudes (Fig. 8.11)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

from fractus_sim.report.drawing import BLUE, GREEN, GREY, INK, ORANGE, SKY, VERMILION, canvas, legend
from fractus_sim.scenarios.field.evidence import Evidence
from fractus_sim.scenarios.field.expectations import HIGHEST_M, LOWEST_M
from fractus_sim.scenarios.field.place import NAVIGATOR, Field

# Drawing order: the widest line first, so that overlapping flights remain visible.
_STYLES: Mapping[str, Mapping[str, Any]] = {
    "normal": {"color": BLUE, "linewidth": 5.5, "alpha": 0.45},
    "unguarded": {"color": VERMILION, "linewidth": 1.5, "linestyle": (0, (5, 2))},
    "guarded": {"color": GREEN, "linewidth": 2.2},
}
_PICTURE = {"linestyle": "none", "markersize": 11, "markeredgecolor": "white", "markeredgewidth": 0.6}
_ARROW_M = 35.0
_MARGIN_M = 14.0
_YELLOW = "#F0E442"


def draw_ground(field: Field, area: Sequence[Any], runs: Sequence[Evidence]) -> Figure:
    """Draw the map, in metres east and north of home."""
    figure, axes = canvas(10.0, 6.9)
    region = max(area, key=lambda shape: shape.area, default=None)
    for shape in area:
        words = "operation area at CTRL2 (REGION2)" if shape is region else "operation area at CTRL1"
        _fill(axes, shape, GREY if shape is region else SKY, 0.22, words)
    _fill(axes, field.zone("no-photo"), _YELLOW, 0.55, "no-photo zone")
    _fill(axes, field.zone("no-fly"), VERMILION, 0.25, "no-fly zone")
    for run in sorted(runs, key=lambda r: list(_STYLES).index(r.name)):
        points = np.array([field.frame.xy(s.place.lat, s.place.lon) for s in run.track.samples if s.in_air])
        if len(points):
            axes.plot(
                points[:, 0], points[:, 1], label=run.title, zorder=4, solid_capstyle="round", **_STYLES[run.name]
            )
            _direction(axes, points, _STYLES[run.name]["color"])
        _pictures(axes, field, run)
    _names(axes, field)
    axes.set_aspect("equal")
    low_x, low_y, high_x, high_y = axes.dataLim.extents
    axes.set_xlim(low_x - _MARGIN_M, high_x + _MARGIN_M)
    axes.set_ylim(low_y - _MARGIN_M, high_y + _MARGIN_M)
    axes.set_xlabel("metres east of HOME", fontsize=9)
    axes.set_ylabel("metres north of HOME", fontsize=9)
    axes.grid(color="#EEEEEE", linewidth=0.6, zorder=0)
    axes.set_axisbelow(True)
    axes.set_title("The field experiment from above", fontsize=11, loc="left")
    legend(figure, axes, columns=3)
    return figure


def _fill(axes: Any, shape: Any, colour: str, alpha: float, label: str) -> None:
    corners = np.asarray(shape.exterior.coords)
    codes = [Outline.MOVETO, *[Outline.LINETO] * (len(corners) - 2), Outline.CLOSEPOLY]
    axes.add_patch(PathPatch(Outline(corners, codes), facecolor=colour, alpha=alpha, edgecolor="none", zorder=1))
    axes.add_patch(
        PathPatch(Outline(corners, codes), facecolor="none", edgecolor=colour, linewidth=1.0, label=label, zorder=1.5)
    )
    axes.update_datalim(corners)


def _pictures(axes: Any, field: Field, run: Evidence) -> None:
    """Draw the positions of captured and denied pictures in the colour of the run."""
    for taken, marker, words in ((True, "*", "picture taken"), (False, "X", "picture refused")):
        at = [field.frame.xy(c.at.lat, c.at.lon) for c in run.pictures(taken=taken) if c.at is not None]
        if at:
            colour = _STYLES[run.name]["color"]
            label = f"{words}, {run.title}"
            axes.plot(*np.array(at).T, color=colour, marker=marker, label=label, zorder=7, **_PICTURE)


def _direction(axes: Any, points: Any, colour: str) -> None:
    """Draw arrowheads along a path, one every `_ARROW_M`."""
    flown_m = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))
    for at in np.searchsorted(flown_m, np.arange(_ARROW_M / 2, flown_m[-1], _ARROW_M)):
        axes.annotate(
            "", points[at], xytext=points[at - 1], zorder=6,
            arrowprops={"arrowstyle": "-|>", "color": colour, "mutation_scale": 13, "shrinkA": 0, "shrinkB": 0},
        )  # fmt: skip


def _names(axes: Any, field: Field) -> None:
    axes.plot(0.0, 0.0, marker="s", markersize=9, color="white", markeredgecolor=INK, markeredgewidth=1.6, zorder=8)
    named = {"HOME": (0.0, 0.0)} | {n: field.frame.xy(p[0], p[1]) for n, p in field.places.items()}
    for name, (east, north) in named.items():
        if name != "HOME":
            outside = name.startswith("WP-E")
            axes.plot(
                east, north, marker="X" if outside else "o", markersize=8 if outside else 5,
                color=VERMILION if outside else INK, markeredgecolor="white", zorder=8,
            )  # fmt: skip
        axes.annotate(
            name, (east, north), xytext=_offset(name), textcoords="offset points", fontsize=8.5, color=INK, zorder=9,
            ha="center", va="center",
            bbox={"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.75},
        )  # fmt: skip


def _offset(name: str) -> tuple[float, float]:
    return {
        "HOME": (0.0, -14.0),
        "CTRL1": (-27.0, 0.0),
        "WP1": (-22.0, 6.0),
        "WP3": (22.0, 4.0),
        "WP4": (0.0, -14.0),
        "CTRL2": (0.0, -14.0),
        "WP6": (0.0, -14.0),
        "WP8": (0.0, -14.0),
        "WP-E1": (30.0, 0.0),
        "WP-E2": (30.0, 0.0),
        "WP-S": (24.0, 0.0),
    }.get(name, (0.0, 13.0))


def draw_altitudes(runs: Sequence[Evidence]) -> Figure:
    """Draw altitudes above home since takeoff, with limits and the requests beyond them."""
    figure, axes = canvas(10.0, 4.6)
    for limit in (LOWEST_M, HIGHEST_M):
        axes.axhline(limit, color=INK, linestyle=(0, (5, 3)), linewidth=1.0, zorder=2)
        axes.annotate(
            f"limit {limit:.0f} m", (1.0, limit), xycoords=("axes fraction", "data"), xytext=(-4, 4),
            textcoords="offset points", fontsize=8, color=INK, ha="right",
        )  # fmt: skip
    for run in sorted(runs, key=lambda r: list(_STYLES).index(r.name)):
        start_s = run.track.takeoff_s or 0.0
        shown = [s for s in run.track.samples if s.time_s >= start_s - 2.0]
        times = [s.time_s - start_s for s in shown]
        heights = [s.place.alt_m for s in shown]
        axes.plot(times, heights, label=run.title, zorder=4, **_STYLES[run.name])
    for run in runs:
        if run.name == "guarded":
            _requests(axes, run)
    axes.set_ylim(-0.5, 23.5)
    axes.set_xlim(left=-2.0)
    axes.set_xlabel("seconds since takeoff", fontsize=9)
    axes.set_ylabel("metres above HOME", fontsize=9)
    axes.grid(color="#EEEEEE", linewidth=0.6, zorder=0)
    axes.set_title("Altitude: requested and flown", fontsize=11, loc="left")
    legend(figure, axes)
    return figure


def _requests(axes: Any, run: Evidence) -> None:
    """Draw arrows from requested to flown altitudes."""
    start_s = run.track.takeoff_s or 0.0
    seen: set[float] = set()
    for call in run.gotos():
        if call.who != NAVIGATOR or call.asked is None or call.flown is None:
            continue
        asked = call.asked.alt_m
        flown = call.flown.alt_m
        if abs(asked - flown) < 0.1 or round(call.time_s) in seen:
            continue
        seen.add(round(call.time_s))
        at = call.time_s - start_s
        axes.annotate(
            "", (at, flown), xytext=(at, asked), zorder=6,
            arrowprops={"arrowstyle": "-|>", "color": ORANGE, "linewidth": 1.8, "shrinkA": 4, "shrinkB": 0},
        )  # fmt: skip
        axes.plot(
            at, asked, marker="o", markersize=8, color=ORANGE, markeredgecolor=INK, linestyle="none",
            label="requested, and corrected", zorder=7,
        )  # fmt: skip
        axes.annotate(
            f"{asked:.0f} m", (at, asked), xytext=(0, 11 if asked > flown else -11), textcoords="offset points",
            fontsize=8.5, color=INK, va="center", ha="center",
        )  # fmt: skip

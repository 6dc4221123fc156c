"""Common parts of the figures: colours that colour-blind readers can distinguish (Okabe and Ito), marks and legends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

BLUE = "#0072B2"
ORANGE = "#E69F00"
GREEN = "#009E73"
VERMILION = "#D55E00"
PURPLE = "#CC79A7"
SKY = "#56B4E9"
INK = "#222222"
GREY = "#6B6B6B"

CORRECTED = {"marker": "^", "markersize": 10, "color": ORANGE, "markeredgecolor": INK, "linestyle": "none"}
REFUSED = {"marker": "X", "markersize": 10, "color": VERMILION, "markeredgecolor": INK, "linestyle": "none"}
FAULT = {"marker": "D", "markersize": 8, "color": PURPLE, "markeredgecolor": INK, "linestyle": "none"}
MARKS: Mapping[str, Mapping[str, Any]] = {"refused": REFUSED, "corrected": CORRECTED, "fault": FAULT}
"""Styles of event marks by kind."""

TRACK_COLOURS = (BLUE, ORANGE, GREEN, VERMILION, PURPLE, SKY, "#8C6D1F", "#444444", "#7A4FA3", "#00685A")


def add_legend(figure: Figure, *all_axes: Any, columns: int = 5) -> None:
    """Add one legend for all axes below the figure. Each label appears once."""
    entries = [entry for axes in all_axes for entry in zip(*axes.get_legend_handles_labels(), strict=True)]
    unique = {label: handle for handle, label in entries}
    figure.legend(unique.values(), unique.keys(), loc="outside lower center", ncols=columns, fontsize=8, frameon=False)


def new_figure(width_in: float, height_in: float) -> tuple[Figure, Any]:
    """Return a figure with one axes, without pyplot's global state."""
    figure, (axes,) = new_panels(width_in, (height_in,))
    return figure, axes


def new_panels(width_in: float, heights_in: Sequence[float], *, sharex: bool = False) -> tuple[Figure, list[Any]]:
    """Return a figure with vertically stacked axes."""
    figure = Figure(figsize=(width_in, sum(heights_in)), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    all_axes = figure.subplots(len(heights_in), 1, sharex=sharex, squeeze=False, height_ratios=list(heights_in))[:, 0]
    for axes in all_axes:
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
        axes.tick_params(labelsize=8, colors=INK)
    return figure, list(all_axes)


def draw_number(axes: Any, text: str, x: float, y: float) -> None:
    """Draw the number of an event next to its mark."""
    axes.annotate(
        text, (x, y), xytext=(7, 5), textcoords="offset points", fontsize=8, fontweight="bold", color=INK, zorder=9,
        bbox={"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
    )  # fmt: skip

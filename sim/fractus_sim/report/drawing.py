"""What the pictures share: colours that colour-blind people tell apart (Okabe and Ito), marks, deterministic files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

BLUE, ORANGE, GREEN, VERMILION = "#0072B2", "#E69F00", "#009E73", "#D55E00"
PURPLE, SKY, INK, GREY = "#CC79A7", "#56B4E9", "#222222", "#6B6B6B"

CORRECTED = {"marker": "^", "markersize": 10, "color": ORANGE, "markeredgecolor": INK, "linestyle": "none"}
REFUSED = {"marker": "X", "markersize": 10, "color": VERMILION, "markeredgecolor": INK, "linestyle": "none"}


def canvas(width_in: float, height_in: float) -> tuple[Figure, Any]:
    """A figure with one axes, outside pyplot's global state."""
    figure = Figure(figsize=(width_in, height_in), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.tick_params(labelsize=8, colors=INK)
    return figure, axes


def number(axes: Any, text: str, x: float, y: float) -> None:
    """Write a request's number beside its mark."""
    axes.annotate(
        text, (x, y), xytext=(7, 5), textcoords="offset points", fontsize=8, fontweight="bold", color=INK, zorder=9,
        bbox={"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
    )  # fmt: skip


def save(figure: Figure, path: Path) -> None:
    """Write a PNG without dates or versions, so that the same flight gives the same bytes."""
    figure.savefig(path, metadata={"Software": None})

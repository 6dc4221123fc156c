"""The flight seen from the side: altitude over time, the limits, and the requests that policies changed."""

from __future__ import annotations

from typing import Any

from matplotlib.figure import Figure

from fractus_sim.report.drawing import BLUE, CORRECTED, GREY, INK, ORANGE, REFUSED, canvas, number
from fractus_sim.report.record import Judgement, Record

_PHASES = {"GUIDED": "driver flies", "RTL": "flies home", "LAND": "lands"}


def draw_altitude(record: Record) -> Figure:
    """Draw the profile; time runs from the takeoff."""
    figure, axes = canvas(9.0, 4.2)
    start = record.takeoff_s if record.takeoff_s is not None else record.times.get("applied", 0.0)
    times = [s.time_s - start for s in record.samples]
    heights = [s.place.alt_m for s in record.samples]
    axes.fill_between(times, heights, color=BLUE, alpha=0.10, zorder=1)
    axes.plot(times, heights, color=BLUE, linewidth=2.0, label="altitude", zorder=4)
    end = times[-1] if times else 1.0
    shown = [*heights, *_limits(axes, record)]
    shown += _requests(axes, record, start)
    _home_leg(axes, record, start)
    axes.set_xlim(min(times[0] if times else 0.0, 0.0), end)
    axes.set_ylim(0, max(shown, default=10.0) * 1.18 + 1.0)
    axes.set_xlabel("seconds since takeoff", fontsize=9)
    axes.set_ylabel("metres above home", fontsize=9)
    axes.set_title(f"{record.application.name}: altitude", fontsize=11, loc="left")
    axes.grid(color="#EEEEEE", linewidth=0.6, zorder=0)
    handles, labels = axes.get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    figure.legend(unique.values(), unique.keys(), loc="outside lower center", ncols=5, fontsize=8, frameon=False)
    return figure


def _limits(axes: Any, record: Record) -> list[float]:
    """Dashed lines for altitude limits; which of them held where is in the summary."""
    drawn: list[float] = []
    for policy in record.policies_in_force:
        spec = policy.spec
        if spec.type != "LimitControl" or spec.kind != "altitude" or spec.altitude_reference != "home":
            continue
        for limit, word in ((spec.upper_limit, "at most"), (spec.lower_limit, "at least")):
            if limit is None:
                continue
            drawn.append(limit)
            axes.axhline(limit, color=INK, linestyle=(0, (5, 3)), linewidth=1.1, label="altitude limit", zorder=3)
            axes.annotate(
                f"{policy.name}: {word} {limit:g} m", (0.62, limit), xycoords=("axes fraction", "data"),
                xytext=(0, 4), textcoords="offset points", ha="center", fontsize=8, color=INK,
            )  # fmt: skip
    return drawn


def _requests(axes: Any, record: Record, start: float) -> list[float]:
    heights = []
    for index, judged in enumerate(record.judgements, 1):
        place = judged.asked or judged.at
        if place is None:
            continue
        at = judged.time_s - start
        if not judged.refused and _climbs(judged):
            flown = judged.flown.alt_m if judged.flown is not None else place.alt_m
            axes.annotate(
                "", (at, flown), xytext=(at, place.alt_m),
                arrowprops={"arrowstyle": "-|>", "color": ORANGE, "linewidth": 1.6, "shrinkA": 5, "shrinkB": 0},
                zorder=5,
            )  # fmt: skip
        style = REFUSED if judged.refused else CORRECTED
        axes.plot(at, place.alt_m, **style, label="refused" if judged.refused else "asked, and corrected", zorder=8)
        number(axes, str(index), at, place.alt_m)
        heights.append(place.alt_m)
    return heights


def _climbs(judged: Judgement) -> bool:
    return judged.asked is not None and judged.flown is not None and abs(judged.asked.alt_m - judged.flown.alt_m) > 0.05


def _home_leg(axes: Any, record: Record, start: float) -> None:
    """Shade what the system flew."""
    spans: list[tuple[float, float, str]] = []
    for sample in record.samples:
        if sample.mode not in {"RTL", "SMART_RTL", "LAND"} or not sample.in_air:
            continue
        at = sample.time_s - start
        if spans and at - spans[-1][1] < 3.0:
            spans[-1] = (spans[-1][0], at, spans[-1][2])
        else:
            spans.append((at, at, _PHASES.get(sample.mode, "flies home")))
    for begin, end, words in spans:
        axes.axvspan(begin, end, color=GREY, alpha=0.13, linewidth=0, zorder=0.5)
        axes.annotate(
            f"the system {words}", ((begin + end) / 2, 1.0), xycoords=("data", "axes fraction"), xytext=(0, -12),
            textcoords="offset points", ha="center", fontsize=8, color=INK,
        )  # fmt: skip

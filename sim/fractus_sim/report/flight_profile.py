"""Profile of flights: altitude, speed and battery over time, with limits, requests and events."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from matplotlib.figure import Figure

from fractus_sim.report.figure_style import (
    BLUE,
    GREY,
    INK,
    MARKS,
    ORANGE,
    PURPLE,
    TRACK_COLOURS,
    add_legend,
    draw_number,
    new_panels,
)
from fractus_sim.report.track import Sample, Track

Panel = Literal["altitude", "speed", "battery", "voltage"]
_NAMED_TRACKS = 10
_HEADROOM = 1.18
_ROW_POINTS = 12
_CHARACTER_SHARE = 0.0085
"""Width of a letter in the label of a fault, as a share of the axis."""


@dataclass(frozen=True, slots=True)
class Limit:
    """A dashed limit line in a panel."""

    panel: Panel
    value: float
    label: str


@dataclass(frozen=True, slots=True)
class Span:
    """A shaded time span. The span of a fault has the colour of fault marks, and its label is above the figure."""

    begin_s: float
    end_s: float
    label: str
    fault: bool = False


@dataclass(frozen=True, slots=True)
class Request:
    """A request that policies changed.

    Attributes:
        number: Number of the call on the report page.
        altitude_m: Requested altitude.
        label: Legend text.
        flown_m: Altitude that was flown instead. None if it equals `altitude_m`, or if the request was refused.
    """

    kind: Literal["refused", "corrected"]
    number: str
    time_s: float
    altitude_m: float
    label: str
    flown_m: float | None = None


@dataclass(frozen=True)
class Profile:
    """Content of a profile. Times use the clock of the tracks and are shown relative to `start_s`."""

    title: str
    tracks: tuple[Track, ...]
    start_s: float
    panels: tuple[Panel, ...] = ("altitude", "speed", "battery")
    limits: tuple[Limit, ...] = ()
    spans: tuple[Span, ...] = ()
    requests: tuple[Request, ...] = ()
    time_label: str = "seconds"


_VALUES: Mapping[Panel, tuple[str, Callable[[Sample], float]]] = {
    "altitude": ("metres above home", lambda s: s.place.alt_m),
    "speed": ("metres per second", lambda s: s.speed_mps),
    "battery": ("battery, %", lambda s: s.battery * 100.0),
    "voltage": ("battery, volts", lambda s: s.voltage_v or 0.0),
}


def draw_profile(profile: Profile) -> Figure:
    """Draw the panels vertically stacked with a common time axis."""
    figure, all_axes = new_panels(9.0, _heights(profile), sharex=True)
    for axes, panel in zip(all_axes, profile.panels, strict=True):
        values = _draw_curves(axes, profile, panel) + _draw_limits(axes, profile, panel)
        if panel == "altitude":
            values += _draw_requests(axes, profile)
        _draw_spans(axes, profile, top=axes is all_axes[0])
        _set_scale(axes, panel, values)
    first, last = _time_span(profile)
    all_axes[-1].set_xlim(first, max(last, first + 1.0))
    all_axes[-1].set_xlabel(profile.time_label, fontsize=9)
    rows = max((row + 1 for span, row in _label_rows(profile) if span.fault), default=0)
    all_axes[0].set_title(profile.title, fontsize=11, loc="left", pad=6 + _ROW_POINTS * rows)
    add_legend(figure, *all_axes)
    return figure


def _heights(profile: Profile) -> tuple[float, ...]:
    return (4.2,) if len(profile.panels) == 1 else (2.8, *[1.7] * (len(profile.panels) - 1))


def _time_span(profile: Profile) -> tuple[float, float]:
    times = [s.time_s - profile.start_s for track in profile.tracks for s in (track.samples[:1] + track.samples[-1:])]
    return min([*times, 0.0]), max([*times, 1.0])


def _draw_curves(axes: Any, profile: Profile, panel: Panel) -> list[float]:
    """Draw the curve of each track. Return the drawn values."""
    value = _VALUES[panel][1]
    drawn: list[float] = []
    for index, track in enumerate(profile.tracks):
        times = [s.time_s - profile.start_s for s in track.samples]
        values = [value(s) for s in track.samples]
        drawn += values
        if len(profile.tracks) == 1:
            axes.fill_between(times, values, color=BLUE, alpha=0.10, zorder=1)
            axes.plot(
                times, values, color=BLUE, linewidth=2.0, label=panel if len(profile.panels) == 1 else None, zorder=4
            )
        else:
            colour = TRACK_COLOURS[index % len(TRACK_COLOURS)]
            label = track.name if len(profile.tracks) <= _NAMED_TRACKS else None
            axes.plot(times, values, color=colour, linewidth=1.5, label=label, zorder=4)
    return drawn


def _draw_limits(axes: Any, profile: Profile, panel: Panel) -> list[float]:
    """Draw the limits of a panel. Return their values."""
    drawn = [limit for limit in profile.limits if limit.panel == panel]
    for limit in drawn:
        axes.axhline(limit.value, color=INK, linestyle=(0, (5, 3)), linewidth=1.1, label=f"{panel} limit", zorder=3)
        axes.annotate(
            limit.label, (0.62, limit.value), xycoords=("axes fraction", "data"), xytext=(0, 4),
            textcoords="offset points", ha="center", fontsize=8, color=INK,
        )  # fmt: skip
    return [limit.value for limit in drawn]


def _draw_requests(axes: Any, profile: Profile) -> list[float]:
    """Draw the requests. Return their altitudes."""
    for request in profile.requests:
        time_s = request.time_s - profile.start_s
        if request.flown_m is not None:
            axes.annotate(
                "", (time_s, request.flown_m), xytext=(time_s, request.altitude_m),
                arrowprops={"arrowstyle": "-|>", "color": ORANGE, "linewidth": 1.6, "shrinkA": 5, "shrinkB": 0},
                zorder=5,
            )  # fmt: skip
        axes.plot(time_s, request.altitude_m, **MARKS[request.kind], label=request.label, zorder=8)
        draw_number(axes, request.number, time_s, request.altitude_m)
    return [request.altitude_m for request in profile.requests]


def _label_rows(profile: Profile) -> list[tuple[Span, int]]:
    """Return each span with the row of its label. Labels that would overlap are in different rows."""
    first, last = _time_span(profile)
    ends: list[float] = []
    placed = []
    for span in sorted(profile.spans, key=lambda span: span.begin_s):
        if not span.fault:
            placed.append((span, 0))
            continue
        row = next((at for at, end in enumerate(ends) if end <= span.begin_s), len(ends))
        width_s = (last - first) * len(span.label) * _CHARACTER_SHARE
        ends[row : row + 1] = [span.begin_s + width_s]
        placed.append((span, row))
    return placed


def _draw_spans(axes: Any, profile: Profile, *, top: bool) -> None:
    for span, row in _label_rows(profile):
        begin = span.begin_s - profile.start_s
        end = span.end_s - profile.start_s
        if span.fault:
            axes.axvspan(begin, end, color=PURPLE, alpha=0.11, linewidth=0, zorder=0.6)
            axes.axvline(begin, color=PURPLE, linewidth=1.2, zorder=2)
            place = {"xytext": (0, 3 + _ROW_POINTS * row), "va": "bottom", "ha": "left"}
        else:
            axes.axvspan(begin, end, color=GREY, alpha=0.13, linewidth=0, zorder=0.5)
            place = {"xytext": (0, -12), "ha": "center"}
            begin = (begin + end) / 2
        if top and span.label:
            axes.annotate(
                span.label, (begin, 1.0), xycoords=("data", "axes fraction"), textcoords="offset points", fontsize=8,
                color=INK, **place,
            )  # fmt: skip


def _set_scale(axes: Any, panel: Panel, values: list[float]) -> None:
    axes.set_ylabel(_VALUES[panel][0], fontsize=9)
    axes.grid(color="#EEEEEE", linewidth=0.6, zorder=0)
    if panel == "battery":
        axes.set_ylim(0, 105)
    else:
        axes.set_ylim(0, max(values, default=10.0) * _HEADROOM + 1.0)

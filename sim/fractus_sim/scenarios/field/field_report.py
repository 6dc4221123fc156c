"""Summary page and results of the field experiment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

from fractus_sim.report.figure_style import BLUE, GREEN, GREY, INK, ORANGE, SKY, VERMILION, canvas, legend
from fractus_sim.report.report_files import clock, rounded, table
from fractus_sim.scenarios.field.field_evidence import Call, Evidence
from fractus_sim.scenarios.field.field_expectations import HIGHEST_M, LOWEST_M, Check
from fractus_sim.scenarios.field.field_site import NAVIGATOR, Field


def summary(field: Field, runs: Sequence[Evidence], checks: Sequence[Check], autopilot: str) -> str:
    """Return the page in Markdown."""
    failed = [check for check in checks if not check.holds]
    held = (
        f"All {len(checks)} expectations hold." if not failed else f"{len(failed)} of {len(checks)} expectations FAIL."
    )
    parts = [
        f"# The field experiment\n\n{held} Flown by {autopilot}, home at {field.home[0]:.6f}, {field.home[1]:.6f}.",
        "The scene has the structure of the thesis' Fig. 8.10 (two control points, a zigzag in a region, a no-fly zone, a"
        " no-photo stripe, 5 to 15 m), not its coordinates, which the thesis does not give. Without policies means: the"
        " same program with Grants that hold no policies and whose operation area covers the whole surroundings.",
        "![the ground](map.png)\n\n![altitudes](altitude.png)",
        "## The three runs\n\n" + _runs(runs),
        "## Requests beyond the limits\n\n" + _violations(field, runs),
        "## Expectations\n\n" + _checks(checks),
        "Each run's directory has its manifests, Grants, audit logs, the tlog of the autopilot's link, and pictures."
        " For programs: [report.json](report.json).",
    ]
    return "\n\n".join(parts) + "\n"


def figures(field: Field, runs: Sequence[Evidence], checks: Sequence[Check], autopilot: str) -> dict[str, Any]:
    """Return the results as JSON-compatible values."""
    return {
        "holds": all(check.holds for check in checks),
        "autopilot": autopilot,
        "home": {"lat": field.home[0], "lon": field.home[1]},
        "runs": [_figures(run) for run in runs],
        "checks": [{"run": c.run, "text": c.text, "holds": c.holds, "seen": c.seen} for c in checks],
    }


def _figures(run: Evidence) -> dict[str, Any]:
    takeover = run.takeover()
    return {
        "name": run.name,
        "title": run.title,
        "policies": run.policies,
        "flight_s": rounded(_flight_s(run)),
        "distance_m": rounded(run.track.distance_m),
        "max_altitude_m": rounded(run.track.max_altitude_m),
        "max_speed_mps": rounded(run.track.max_speed_mps),
        "landed_from_takeoff_m": rounded(run.track.miss_m),
        "pictures_taken": len(run.pictures(taken=True)),
        "pictures_refused": len(run.pictures(taken=False)),
        "corrected": sum(c.action == "correct" and _altered(c) for c in _mine(run)),
        "denied": sum(c.refused for c in _mine(run)),
        "takeover": None if takeover is None else takeover.reason,
        "texts": list(run.texts),
    }


def _runs(runs: Sequence[Evidence]) -> str:
    rows = []
    for run in runs:
        f = _figures(run)
        rows.append(
            (
                run.title, clock(f["flight_s"]), f"{f['distance_m']:.0f} m", f"{f['max_altitude_m']:.1f} m",
                str(f["pictures_taken"]), str(f["pictures_refused"]), str(f["corrected"]), str(f["denied"]),
                f["takeover"] or "-",
            )
        )  # fmt: skip
    head = (
        "Run",
        "In the air",
        "Way",
        "Highest",
        "Pictures",
        "Pictures refused",
        "Corrected",
        "Denied",
        "Taken over for",
    )
    return table(head, rows)


def _violations(field: Field, runs: Sequence[Evidence]) -> str:
    rows = []
    for run in runs:
        for call in _mine(run):
            if call.asked is None or not (call.refused or _altered(call)):
                continue
            flown = "refused" if call.refused or call.flown is None else f"{call.flown.alt_m:.1f} m"
            rows.append((run.title, _name(field, call), f"{call.asked.alt_m:.0f} m", flown, call.reason))
    return table(("Run", "Goto", "Asked", "Flown", "Why"), rows) if rows else "Nothing."


def _checks(checks: Sequence[Check]) -> str:
    rows = [(check.run, check.text, "yes" if check.holds else "**NO**", check.seen) for check in checks]
    return table(("Run", "Expected", "Holds", "Seen"), rows)


def _mine(run: Evidence) -> list[Call]:
    """Return the Gotos of the program while it had control, without those of the system."""
    return [c for c in run.gotos() if c.who == NAVIGATOR]


def _altered(call: Call) -> bool:
    return call.asked is not None and call.flown is not None and abs(call.asked.alt_m - call.flown.alt_m) > 0.05


def _name(field: Field, call: Call) -> str:
    if call.asked is None:
        return "-"
    east, north = field.frame.xy(call.asked.lat, call.asked.lon)
    near = {n: field.frame.xy(p[0], p[1]) for n, p in field.places.items()}
    name, at = min(near.items(), key=lambda item: (item[1][0] - east) ** 2 + (item[1][1] - north) ** 2)
    return name if abs(at[0] - east) + abs(at[1] - north) < 1.0 else f"{east:.0f} m east, {north:.0f} m north"


def _flight_s(run: Evidence) -> float | None:
    begin = run.track.takeoff_s
    end = run.track.landing_s
    return None if begin is None or end is None else end - begin


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

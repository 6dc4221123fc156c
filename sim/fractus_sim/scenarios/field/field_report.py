"""Report of the field experiment: summary page, results, map (Fig. 8.10) and altitudes (Fig. 8.11)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

from fractus_sim.report.figure_style import BLUE, GREEN, GREY, INK, ORANGE, SKY, VERMILION, add_legend, new_figure
from fractus_sim.report.flight_record import JudgedCall
from fractus_sim.report.report_files import (
    Expectation,
    expectations_headline,
    expectations_table,
    format_duration,
    rounded,
    table,
    write_report,
)
from fractus_sim.scenarios.field.field_expectations import MAX_ALTITUDE_M, MIN_ALTITUDE_M
from fractus_sim.scenarios.field.field_site import NAVIGATOR, FieldSite
from fractus_sim.scenarios.scenario_evidence import Evidence


def write_field_report(
    site: FieldSite, runs: Sequence[Evidence], expectations: Sequence[Expectation], vehicle: str, out: Path
) -> None:
    """Write summary.md, report.json, map.png and altitude.png into a folder.

    Args:
        site: Site of the experiment.
        runs: Evidence of the runs.
        expectations: Evaluated expectations of all runs.
        vehicle: Description of the vehicle.
        out: Output folder.
    """
    area = site.operation_area(site.grants(site.write(out), policies=True))
    write_report(
        out,
        field_page(site, runs, expectations, vehicle),
        field_results(site, runs, expectations, vehicle),
        {"map.png": lambda: draw_map(site, area, runs), "altitude.png": lambda: draw_altitudes(runs)},
    )


def field_page(site: FieldSite, runs: Sequence[Evidence], expectations: Sequence[Expectation], vehicle: str) -> str:
    """Return the page in Markdown."""
    parts = [
        f"# The field experiment\n\n{expectations_headline(expectations)} Flown by {vehicle}, home at {site.home[0]:.6f}, {site.home[1]:.6f}.",
        "The site has the structure of the thesis' Fig. 8.10: two control points, a zigzag in a region, a no-fly zone, a"
        " no-photo stripe, and altitude limits of 5 and 15 m. The thesis does not give coordinates. In the run without"
        " policies, the Grants contain no policies, and their operation area is not restricted.",
        "![map](map.png)\n\n![altitudes](altitude.png)",
        "## The three runs\n\n" + _runs_table(runs),
        "## Requests beyond the limits\n\n" + _violations_table(site, runs),
        "## Expectations\n\n" + expectations_table(expectations),
        "The directory of each run contains its manifests, Grants, audit logs, the tlog of the autopilot link, and pictures."
        " Data: [report.json](report.json).",
    ]
    return "\n\n".join(parts) + "\n"


def field_results(
    site: FieldSite, runs: Sequence[Evidence], expectations: Sequence[Expectation], vehicle: str
) -> dict[str, Any]:
    """Return the results as JSON-compatible values."""
    return {
        "holds": all(expectation.holds for expectation in expectations),
        "autopilot": vehicle,
        "home": {"lat": site.home[0], "lon": site.home[1]},
        "runs": [_run_results(run) for run in runs],
        "checks": [expectation.to_dict() for expectation in expectations],
    }


def _run_results(run: Evidence) -> dict[str, Any]:
    takeover = run.takeover()
    return {
        "name": run.name,
        "title": run.title,
        "policies": run.policies,
        "flight_s": rounded(_flight_s(run)),
        "distance_m": rounded(run.track.distance_m),
        "max_altitude_m": rounded(run.track.max_altitude_m),
        "max_speed_mps": rounded(run.track.max_speed_mps),
        "landed_from_takeoff_m": rounded(run.track.landing_error_m),
        "pictures_taken": len(run.pictures(taken=True)),
        "pictures_refused": len(run.pictures(taken=False)),
        "corrected": sum(c.action == "correct" and _altitude_changed(c) for c in _navigator_gotos(run)),
        "denied": sum(c.refused for c in _navigator_gotos(run)),
        "takeover": None if takeover is None else takeover.reason,
        "texts": list(run.texts),
    }


def _runs_table(runs: Sequence[Evidence]) -> str:
    rows = []
    for run in runs:
        results = _run_results(run)
        rows.append(
            (
                run.title, format_duration(results["flight_s"]), f"{results['distance_m']:.0f} m", f"{results['max_altitude_m']:.1f} m",
                str(results["pictures_taken"]), str(results["pictures_refused"]), str(results["corrected"]),
                str(results["denied"]),
                results["takeover"] or "-",
            )
        )  # fmt: skip
    head = (
        "Run",
        "In the air",
        "Distance",
        "Max altitude",
        "Pictures",
        "Pictures refused",
        "Corrected",
        "Denied",
        "Takeover reason",
    )
    return table(head, rows)


def _violations_table(site: FieldSite, runs: Sequence[Evidence]) -> str:
    rows = []
    for run in runs:
        for call in _navigator_gotos(run):
            if call.requested is None or not (call.refused or _altitude_changed(call)):
                continue
            flown = "refused" if call.refused or call.flown is None else f"{call.flown.alt_m:.1f} m"
            rows.append((run.title, _target_name(site, call), f"{call.requested.alt_m:.0f} m", flown, call.reason))
    return table(("Run", "Goto", "Requested", "Flown", "Reason"), rows) if rows else "There were no such requests."


def _navigator_gotos(run: Evidence) -> list[JudgedCall]:
    """Return the Goto calls of the Navigator."""
    return [c for c in run.gotos() if c.caller == NAVIGATOR]


def _altitude_changed(call: JudgedCall) -> bool:
    return call.requested is not None and call.flown is not None and abs(call.requested.alt_m - call.flown.alt_m) > 0.05


def _target_name(site: FieldSite, call: JudgedCall) -> str:
    if call.requested is None:
        return "-"
    east, north = site.frame.xy(call.requested.lat, call.requested.lon)
    positions = {n: site.frame.xy(p[0], p[1]) for n, p in site.places.items()}
    name, nearest = min(positions.items(), key=lambda item: (item[1][0] - east) ** 2 + (item[1][1] - north) ** 2)
    return name if abs(nearest[0] - east) + abs(nearest[1] - north) < 1.0 else f"{east:.0f} m east, {north:.0f} m north"


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
_ARROW_INTERVAL_M = 35.0
_MARGIN_M = 14.0
_YELLOW = "#F0E442"


def draw_map(site: FieldSite, area: Sequence[Any], runs: Sequence[Evidence]) -> Figure:
    """Draw the map, in metres east and north of home."""
    figure, axes = new_figure(10.0, 6.9)
    region = max(area, key=lambda shape: shape.area, default=None)
    for shape in area:
        if shape is region:
            _draw_area(axes, shape, GREY, 0.22, "operation area at CTRL2 (REGION2)")
        else:
            _draw_area(axes, shape, SKY, 0.22, "operation area at CTRL1")
    _draw_area(axes, site.zone("no-photo"), _YELLOW, 0.55, "no-photo zone")
    _draw_area(axes, site.zone("no-fly"), VERMILION, 0.25, "no-fly zone")
    for run in sorted(runs, key=lambda r: list(_STYLES).index(r.name)):
        points = np.array([site.frame.xy(s.place.lat, s.place.lon) for s in run.track.samples if s.in_air])
        if len(points):
            axes.plot(
                points[:, 0], points[:, 1], label=run.title, zorder=4, solid_capstyle="round", **_STYLES[run.name]
            )
            _draw_direction(axes, points, _STYLES[run.name]["color"])
        _draw_pictures(axes, site, run)
    _draw_positions(axes, site)
    axes.set_aspect("equal")
    low_x, low_y, high_x, high_y = axes.dataLim.extents
    axes.set_xlim(low_x - _MARGIN_M, high_x + _MARGIN_M)
    axes.set_ylim(low_y - _MARGIN_M, high_y + _MARGIN_M)
    axes.set_xlabel("metres east of HOME", fontsize=9)
    axes.set_ylabel("metres north of HOME", fontsize=9)
    axes.grid(color="#EEEEEE", linewidth=0.6, zorder=0)
    axes.set_axisbelow(True)
    axes.set_title("Map of the field experiment", fontsize=11, loc="left")
    add_legend(figure, axes, columns=3)
    return figure


def _draw_area(axes: Any, shape: Any, colour: str, alpha: float, label: str) -> None:
    corners = np.asarray(shape.exterior.coords)
    codes = [Outline.MOVETO, *[Outline.LINETO] * (len(corners) - 2), Outline.CLOSEPOLY]
    axes.add_patch(PathPatch(Outline(corners, codes), facecolor=colour, alpha=alpha, edgecolor="none", zorder=1))
    axes.add_patch(
        PathPatch(Outline(corners, codes), facecolor="none", edgecolor=colour, linewidth=1.0, label=label, zorder=1.5)
    )
    axes.update_datalim(corners)


def _draw_pictures(axes: Any, site: FieldSite, run: Evidence) -> None:
    """Draw the positions of captured and denied pictures in the colour of the run."""
    for taken, marker, outcome in ((True, "*", "picture taken"), (False, "X", "picture refused")):
        positions = [
            site.frame.xy(c.position.lat, c.position.lon) for c in run.pictures(taken=taken) if c.position is not None
        ]
        if positions:
            colour = _STYLES[run.name]["color"]
            label = f"{outcome}, {run.title}"
            axes.plot(*np.array(positions).T, color=colour, marker=marker, label=label, zorder=7, **_PICTURE)


def _draw_direction(axes: Any, points: Any, colour: str) -> None:
    """Draw arrowheads along a path at intervals of `_ARROW_INTERVAL_M`."""
    flown_m = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))
    for index in np.searchsorted(flown_m, np.arange(_ARROW_INTERVAL_M / 2, flown_m[-1], _ARROW_INTERVAL_M)):
        axes.annotate(
            "", points[index], xytext=points[index - 1], zorder=6,
            arrowprops={"arrowstyle": "-|>", "color": colour, "mutation_scale": 13, "shrinkA": 0, "shrinkB": 0},
        )  # fmt: skip


def _draw_positions(axes: Any, site: FieldSite) -> None:
    axes.plot(0.0, 0.0, marker="s", markersize=9, color="white", markeredgecolor=INK, markeredgewidth=1.6, zorder=8)
    positions = {"HOME": (0.0, 0.0)} | {n: site.frame.xy(p[0], p[1]) for n, p in site.places.items()}
    for name, (east, north) in positions.items():
        if name != "HOME":
            outside = name.startswith("WP-E")
            axes.plot(
                east, north, marker="X" if outside else "o", markersize=8 if outside else 5,
                color=VERMILION if outside else INK, markeredgecolor="white", zorder=8,
            )  # fmt: skip
        axes.annotate(
            name, (east, north), xytext=_label_offset(name), textcoords="offset points", fontsize=8.5, color=INK, zorder=9,
            ha="center", va="center",
            bbox={"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.75},
        )  # fmt: skip


def _label_offset(name: str) -> tuple[float, float]:
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
    figure, axes = new_figure(10.0, 4.6)
    for limit in (MIN_ALTITUDE_M, MAX_ALTITUDE_M):
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
            _draw_corrections(axes, run)
    axes.set_ylim(-0.5, 23.5)
    axes.set_xlim(left=-2.0)
    axes.set_xlabel("seconds since takeoff", fontsize=9)
    axes.set_ylabel("metres above HOME", fontsize=9)
    axes.grid(color="#EEEEEE", linewidth=0.6, zorder=0)
    axes.set_title("Altitude: requested and flown", fontsize=11, loc="left")
    add_legend(figure, axes)
    return figure


def _draw_corrections(axes: Any, run: Evidence) -> None:
    """Draw arrows from requested to flown altitudes."""
    start_s = run.track.takeoff_s or 0.0
    drawn: set[float] = set()
    for call in run.gotos():
        if call.caller != NAVIGATOR or call.requested is None or call.flown is None:
            continue
        requested_m = call.requested.alt_m
        flown_m = call.flown.alt_m
        if abs(requested_m - flown_m) < 0.1 or round(call.time_s) in drawn:
            continue
        drawn.add(round(call.time_s))
        time_s = call.time_s - start_s
        axes.annotate(
            "", (time_s, flown_m), xytext=(time_s, requested_m), zorder=6,
            arrowprops={"arrowstyle": "-|>", "color": ORANGE, "linewidth": 1.8, "shrinkA": 4, "shrinkB": 0},
        )  # fmt: skip
        axes.plot(
            time_s, requested_m, marker="o", markersize=8, color=ORANGE, markeredgecolor=INK, linestyle="none",
            label="requested, and corrected", zorder=7,
        )  # fmt: skip
        axes.annotate(
            f"{requested_m:.0f} m", (time_s, requested_m), xytext=(0, 11 if requested_m > flown_m else -11), textcoords="offset points",
            fontsize=8.5, color=INK, va="center", ha="center",
        )  # fmt: skip

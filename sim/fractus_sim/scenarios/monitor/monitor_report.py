"""Report of the monitor scenario: summary page, results, map (Fig. 7.8) and sequence of pictures (Fig. 7.9)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from matplotlib.figure import Figure
from PIL import Image, UnidentifiedImageError
from PIL.ExifTags import GPS, IFD

from fractus_sim.report.figure_style import (
    BLUE,
    CORRECTED,
    GREEN,
    INK,
    ORANGE,
    PURPLE,
    REFUSED,
    VERMILION,
    add_legend,
    new_figure,
)
from fractus_sim.report.flight_record import JudgedCall
from fractus_sim.report.report_files import (
    Expectation,
    expectations_headline,
    expectations_table,
    rounded,
    table,
    write_report,
)
from fractus_sim.report.track import Place
from fractus_sim.scenarios.monitor.monitor_flight import pictures_folder
from fractus_sim.scenarios.monitor.monitor_site import DRIVER, OUTSIDE_POSITIONS_M, MonitorSite
from fractus_sim.scenarios.scenario_evidence import Evidence

_STYLES: Mapping[str, Mapping[str, Any]] = {
    "monitored": {"color": BLUE, "linewidth": 2.4},
    "unmonitored": {"color": VERMILION, "linewidth": 1.5, "linestyle": (0, (5, 2))},
}
_COLUMNS = 6
_ROW_HEIGHT = 0.6
"""Height of a row of pictures, in widths of a column."""

_MAX_PICTURES = 24


def write_monitor_report(
    site: MonitorSite, runs: Sequence[Evidence], expectations: Sequence[Expectation], vehicle: str, out: Path
) -> None:
    """Write summary.md, report.json, map.png and pictures.png into a folder.

    Args:
        site: Site of the scenario.
        runs: Evidence of the runs.
        expectations: Evaluated expectations of all runs.
        vehicle: Description of the vehicle.
        out: Output folder, which contains the folders of the runs.
    """
    site.write(out)
    results = {
        "holds": all(expectation.holds for expectation in expectations),
        "autopilot": vehicle,
        "home": {"lat": site.home[0], "lon": site.home[1]},
        "runs": [_run_results(site, run) for run in runs],
        "checks": [expectation.to_dict() for expectation in expectations],
    }
    figures = {
        "map.png": lambda: draw_map(site, runs),
        "pictures.png": lambda: draw_pictures(site, pictures_folder(out / "pictures")),
    }
    write_report(out, monitor_page(site, runs, expectations, vehicle), results, figures)


def monitor_page(site: MonitorSite, runs: Sequence[Evidence], expectations: Sequence[Expectation], vehicle: str) -> str:
    """Return the page in Markdown."""
    parts = [
        f"# The monitor scenario\n\n{expectations_headline(expectations)} Flown by {vehicle}, home at {site.home[0]:.6f}, {site.home[1]:.6f}.",
        "A DroneKit program flies through the MAVLink gateway. The site has the structure of the thesis' Fig. 7.8: four waypoints with"
        " a permitted area around the legs, a no-fly zone, a no-photo zone, and the landing place WP4. In the runs without policies, the"
        " Grants contain no policies, and their operation area is not restricted.",
        "![map](map.png)",
        "## Verdicts\n\n" + _verdicts_table(site, runs),
        "## Pictures\n\nPictures of the declared course without policies. Crossed pictures were taken above the no-photo zone; with"
        " policies, they are suppressed.\n\n![pictures](pictures.png)\n\n" + _pictures_table(site, runs),
        "## Expectations\n\n" + expectations_table(expectations),
        "The directory of each run contains its manifests, Grants, audit logs, the tlog of the autopilot link, and pictures."
        " Data: [report.json](report.json).",
    ]
    return "\n\n".join(parts) + "\n"


def _run_results(site: MonitorSite, run: Evidence) -> dict[str, Any]:
    takeover = run.takeover()
    return {
        "name": run.name,
        "title": run.title,
        "policies": run.policies,
        "distance_m": rounded(run.track.distance_m),
        "pictures_taken": len(run.pictures(taken=True)),
        "pictures_refused": len(run.pictures(taken=False)),
        "targets": [
            {
                "position": target_name(site, call.requested),
                "action": _verdict(run, call),
                "reason": call.reason,
                "flown": None if flown is None else {"lat": flown.lat, "lon": flown.lon},
            }
            for call in _targets(run)
            for flown in (_flown(run, call),)
            if call.requested is not None
        ],
        "takeover": None if takeover is None else takeover.reason,
    }


def _targets(run: Evidence) -> list[JudgedCall]:
    return [call for call in run.gotos() if call.caller == DRIVER]


def _verdict(run: Evidence, call: JudgedCall) -> str:
    """Return the verdict on a target. After an abort, policies still judge a target, but the program has no control."""
    taken = run.takeover()
    return "no control" if taken is not None and call.time_s > taken.time_s else call.action


def _flown(run: Evidence, call: JudgedCall) -> Place | None:
    """Return the position to which the drone flew for a target, or None if the target was refused."""
    return call.flown if _verdict(run, call) in {"allow", "correct"} else None


def _verdicts_table(site: MonitorSite, runs: Sequence[Evidence]) -> str:
    rows = []
    for run in runs:
        for call in _targets(run):
            if call.requested is None:
                continue
            flown = _flown(run, call)
            to = "-" if flown is None else f"{flown.lat:.6f}, {flown.lon:.6f}"
            rows.append((run.title, target_name(site, call.requested), _verdict(run, call), to, call.reason or "-"))
    return table(("Run", "Target", "Verdict", "Flown to", "Reason"), dict.fromkeys(rows))


def _pictures_table(site: MonitorSite, runs: Sequence[Evidence]) -> str:
    zone = site.zone("no-photo")
    rows = []
    for run in runs:
        counts = []
        for taken in (True, False):
            calls = run.pictures(taken=taken)
            above = [c for c in calls if c.position is not None and zone.contains(_point(site, c.position))]
            counts += [str(len(calls)), str(len(above))]
        rows.append((run.title, *counts))
    return table(("Run", "Taken", "of these above the zone", "Suppressed", "of these above the zone"), rows)


def target_name(site: MonitorSite, place: Place) -> str:
    """Return the name of the nearest position of the scenario."""
    point = _point(site, place)
    return min(site.places, key=lambda name: point.distance(_point(site, Place(*site.places[name]))))


def _point(site: MonitorSite, place: Place) -> shapely.Point:
    return shapely.Point(site.frame.xy(place.lat, place.lon))


# -- Figures -------------------------------------------------------------------------------------------------------


def draw_map(site: MonitorSite, runs: Sequence[Evidence]) -> Figure:
    """Draw zones, positions, and the paths of the deviating program."""
    figure, axes = new_figure(10.0, 7.6)
    for name, colour, label in (
        ("course", GREEN, "permitted area"),
        ("city-hall", PURPLE, "no-fly zone"),
        ("no-photo", ORANGE, "no-photo zone"),
    ):
        axes.fill(*np.asarray(site.zone(name).exterior.coords).T, color=colour, alpha=0.25, label=label, zorder=1)
    for run in runs:
        if run.name not in _STYLES:
            continue
        path = np.array([site.frame.xy(s.place.lat, s.place.lon) for s in run.track.samples if s.in_air])
        axes.plot(*path.T, label=run.title, zorder=4, **_STYLES[run.name])
        if run.policies:
            _draw_verdicts(axes, site, run)
    for name, (lat, lon, _) in site.places.items():
        x, y = site.frame.xy(lat, lon)
        colour = VERMILION if name in OUTSIDE_POSITIONS_M else GREEN
        axes.plot(x, y, marker="o", markersize=7, color=colour, markeredgecolor=INK, zorder=6)
        axes.annotate(name, (x, y), xytext=(8, 6), textcoords="offset points", fontsize=9, color=INK, zorder=9)
    axes.plot(0.0, 0.0, marker="s", markersize=9, color="white", markeredgecolor=INK, zorder=6, label="home")
    axes.set_aspect("equal")
    axes.set_xlabel("metres east of home", fontsize=9)
    axes.set_ylabel("metres north of home", fontsize=9)
    axes.grid(color="#EEEEEE", linewidth=0.6, zorder=0)
    axes.set_axisbelow(True)
    axes.set_title("Deviating program, with and without policies", fontsize=11, loc="left")
    add_legend(figure, axes, columns=4)
    return figure


def _draw_verdicts(axes: Any, site: MonitorSite, run: Evidence) -> None:
    """Mark corrected targets, and the positions of the drone at refused requests."""
    for call in _targets(run):
        place = call.flown if call.action == "correct" else call.position
        if place is None or _verdict(run, call) not in {"correct", "deny", "takeover"}:
            continue
        style = CORRECTED if call.action == "correct" else REFUSED
        label = "corrected target" if call.action == "correct" else "refused request"
        axes.plot(*site.frame.xy(place.lat, place.lon), label=label, zorder=7, **style)


def draw_pictures(site: MonitorSite, folder: Path) -> Figure:
    """Draw the pictures of a folder in the order in which they were taken. Those above the no-photo zone are crossed."""
    files = sorted(folder.glob("*.jp*g"), key=lambda file: file.stat().st_mtime)[-_MAX_PICTURES:]
    rows = max(1, -(-len(files) // _COLUMNS))
    figure, axes = new_figure(10.0, 10.0 / _COLUMNS * _ROW_HEIGHT * rows + 0.3)
    axes.set_axis_off()
    zone = site.zone("no-photo")
    for number, file in enumerate(files):
        left = float(number % _COLUMNS)
        top = -_ROW_HEIGHT * float(number // _COLUMNS)
        extent = (left, left + 0.96, top - 0.54, top)
        with Image.open(file) as picture:
            place = picture_place(picture)
            axes.imshow(np.asarray(picture.resize((320, 180))), extent=extent, zorder=1)
        if place is not None and zone.contains(_point(site, place)):
            for ends in ((top - 0.54, top), (top, top - 0.54)):
                axes.plot((left, left + 0.96), ends, color=VERMILION, linewidth=2.5, zorder=2)
        axes.annotate(str(number + 1), (left + 0.02, top - 0.02), color="white", fontsize=8, va="top", zorder=3)
    axes.set_xlim(0.0, float(_COLUMNS))
    axes.set_ylim(-_ROW_HEIGHT * float(rows), 0.05)
    return figure


def picture_place(picture: Image.Image) -> Place | None:
    """Return the GPS position in the EXIF metadata of a picture, or None if there is no position."""
    try:
        gps = picture.getexif().get_ifd(IFD.GPSInfo)
        lat, lon = (
            (1.0 if gps[ref] in "NE" else -1.0) * sum(float(part) / 60**power for power, part in enumerate(gps[angle]))
            for ref, angle in ((GPS.GPSLatitudeRef, GPS.GPSLatitude), (GPS.GPSLongitudeRef, GPS.GPSLongitude))
        )
    except (KeyError, UnidentifiedImageError):
        return None
    return Place(lat, lon, 0.0)

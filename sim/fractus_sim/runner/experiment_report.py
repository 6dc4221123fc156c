"""Report of an experiment: summary page, figures, tracks and machine-readable results."""

from __future__ import annotations

import itertools
import json
import string
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from fractus_core.geo import LocalFrame, area_polygon, multipolygon_geojson

from fractus_sim.experiment.checks import AltitudeBand, SpeedLimit
from fractus_sim.report.figure_style import save
from fractus_sim.report.flight_map import DrawnZone, Mark, Scene, draw_map
from fractus_sim.report.flight_profile import Limit, Profile, Span, draw_profile
from fractus_sim.report.geojson import feature, lonlat, path, point
from fractus_sim.report.mission_report import judged, marks_of, requests_of
from fractus_sim.report.report_files import PAGE, clock, rounded, table, write_page
from fractus_sim.report.track import Sample, Track
from fractus_sim.runner.experiment_runner import Outcome
from fractus_sim.runner.fault_injection import Occurrence

_CLOCK_MODES = ("vehicles",)
_PAGE_EVENTS = 40
_PAGE_TEXTS = 25
_QUIET_SEVERITY = 6


def write_outcome(outcome: Outcome) -> None:
    """Write report.json, tracks.geojson, map.png, profile.png and summary.md into the folder of the experiment.

    Results are written first so that a failure to draw a figure does not lose them. The page is written last because it
    links all other files.
    """
    folder = outcome.folder
    (folder / "report.json").write_text(json.dumps(figures(outcome), indent=2) + "\n")
    (folder / "tracks.geojson").write_text(json.dumps(features(outcome)) + "\n")
    if _tracks(outcome):
        save(draw_map(scene_of(outcome)), folder / "map.png")
        save(draw_profile(profile_of(outcome)), folder / "profile.png")
    write_page(folder, summary(outcome))


def remove_report(folder: Path) -> None:
    """Remove the report of an earlier run, so that an aborted run does not show an outdated report."""
    for name in (PAGE, "report.json", "tracks.geojson", "map.png", "profile.png"):
        (folder / name).unlink(missing_ok=True)


def scene_of(outcome: Outcome) -> Scene:
    """Return the map of the experiment, in metres east and north of the start of the first vehicle."""
    tracks = _tracks(outcome)
    first = tracks[0].samples[0].place
    frame = LocalFrame(first.lat, first.lon)
    zones = tuple(DrawnZone(z.name, z.kind, area_polygon(frame, z.area)) for z in outcome.experiment.zones)
    marks: list[Mark] = []
    for letter, occurrence in _lettered(outcome):
        for track in tracks:
            at = _sample_at(track, occurrence.begin_s)
            if at is not None and (track.name in _victims(outcome, occurrence) or not occurrence.vehicle):
                label = f"{letter} {occurrence.title}"
                marks.append(Mark("fault", letter, frame.xy(at.place.lat, at.place.lon), label=label))
    return Scene(
        title=f"{outcome.experiment.name}: {_whom(tracks)}",
        frame=frame,
        tracks=tracks,
        zones=zones,
        depots=(("home", (0.0, 0.0)),) if len(tracks) == 1 else (),
        marks=(*marks, *marks_of(outcome.judgements, frame)),
    )


def profile_of(outcome: Outcome) -> Profile:
    """Return the profile of altitude, speed and battery over time, with faults."""
    tracks = _tracks(outcome)
    end_s = max(track.samples[-1].time_s for track in tracks)
    spans = [
        Span(o.begin_s, o.end_s if o.end_s is not None else end_s, f"{letter} {o.title}", fault=True)
        for letter, o in _lettered(outcome)
    ]
    sagging = any(o.kind == "batteryDrop" for o in outcome.occurrences)
    limits: list[Limit] = []
    for check in outcome.experiment.checks:
        if isinstance(check, AltitudeBand):
            for value, word in ((check.max, "at most"), (check.min, "at least")):
                if value is not None:
                    limits.append(Limit("altitude", value, f"{word} {value:g} m"))
        elif isinstance(check, SpeedLimit):
            limits.append(Limit("speed", check.max, f"at most {check.max:g} m/s"))
    return Profile(
        title=f"{outcome.experiment.name}: altitude, speed, battery",
        tracks=tracks,
        start_s=0.0,
        panels=("altitude", "speed", "voltage" if sagging else "battery"),
        limits=tuple(limits),
        spans=tuple(spans),
        requests=tuple(requests_of(outcome.judgements)),
        axis="seconds since the vehicles were ready",
    )


def summary(outcome: Outcome) -> str:
    """Return the summary page in Markdown."""
    pictures = ""
    if _tracks(outcome):
        pictures = "![map](map.png)\n\n![altitude, speed and battery](profile.png)"
    parts = [
        f"# Experiment {outcome.experiment.name}\n\n{outcome.experiment.description}".rstrip(),
        _headline(outcome),
        _checks(outcome),
        pictures,
        _flights(outcome),
        judged(outcome.judgements, lambda time_s: f"{time_s:.1f} s") if outcome.findings.calls else "",
        _events(outcome),
        _texts(outcome),
        _files(outcome),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def figures(outcome: Outcome) -> dict[str, Any]:
    """Return the results as JSON-compatible values."""
    return {
        "experiment": outcome.experiment.name,
        "mode": outcome.experiment.mode,
        "seed": outcome.experiment.seed,
        "holds": outcome.holds,
        "problem": outcome.problem,
        "duration_s": round(outcome.duration_s, 2),
        "wall_s": round(outcome.wall_s, 2),
        "checks": [
            {"check": v.check, "vehicle": v.vehicle or None, "holds": v.holds, "found": v.found}
            for v in outcome.verdicts
        ],
        "vehicles": {name: _vehicle(track, outcome) for name, track in _by_name(outcome).items()},
        "faults": [
            {
                "fault": o.kind, "title": o.title, "vehicle": o.vehicle or None, "begin_s": round(o.begin_s, 2),
                "end_s": None if o.end_s is None else round(o.end_s, 2),
            }
            for o in outcome.occurrences
        ],
        "events": [{"time_s": round(at, 2), "vehicle": who or None, "text": text} for at, who, text in outcome.events],
        "programs": outcome.findings.programs,
        "phases": outcome.findings.phases,
        "audit": outcome.findings.audit_problems,
    }  # fmt: skip


def features(outcome: Outcome) -> dict[str, Any]:
    """Return tracks, zones and faults as a GeoJSON FeatureCollection."""
    found: list[dict[str, Any]] = [path(track) for track in _tracks(outcome)]
    for zone in outcome.experiment.zones:
        frame = LocalFrame(*_middle(outcome))
        found.append(
            feature(
                multipolygon_geojson(frame, area_polygon(frame, zone.area)), what="zone", name=zone.name, kind=zone.kind
            )
        )
    for occurrence in outcome.occurrences:
        track = _by_name(outcome).get(occurrence.vehicle)
        at = _sample_at(track, occurrence.begin_s) if track is not None else None
        if at is not None:
            fields = {"fault": occurrence.kind, "title": occurrence.title, "drone": occurrence.vehicle}
            found.append(feature(point(lonlat(at.place)), what="fault", time=round(occurrence.begin_s, 3), **fields))
    return {"type": "FeatureCollection", "features": found}


def _middle(outcome: Outcome) -> tuple[float, float]:
    tracks = _tracks(outcome)
    if tracks:
        return tracks[0].samples[0].place.lat, tracks[0].samples[0].place.lon
    home = next(setup.home for setup in outcome.experiment.setups())
    return (home.lat, home.lon) if home is not None else (0.0, 0.0)


def _by_name(outcome: Outcome) -> dict[str, Track]:
    return {name: flight.track for name, flight in outcome.flights.items()}


def _tracks(outcome: Outcome) -> tuple[Track, ...]:
    return tuple(track for track in _by_name(outcome).values() if len(track.samples) > 1)


def _whom(tracks: Sequence[Track]) -> str:
    if len(tracks) == 1:
        return f"{tracks[0].name}, {tracks[0].distance_m:.0f} m flown"
    return f"{len(tracks)} vehicles, {sum(track.distance_m for track in tracks):.0f} m flown"


def _lettered(outcome: Outcome) -> list[tuple[str, Occurrence]]:
    """Assign letters to faults. A fault that affects several vehicles at the same time gets one letter."""
    seen: dict[tuple[str, float], Occurrence] = {}
    for occurrence in sorted(outcome.occurrences, key=lambda o: o.begin_s):
        seen.setdefault((occurrence.title, round(occurrence.begin_s)), occurrence)
    letters = (f"{letter}{turn or ''}" for turn in itertools.count() for letter in string.ascii_uppercase)
    return list(zip(letters, seen.values(), strict=False))


def _victims(outcome: Outcome, lettered: Occurrence) -> set[str]:
    key = (lettered.title, round(lettered.begin_s))
    return {o.vehicle for o in outcome.occurrences if (o.title, round(o.begin_s)) == key}


def _sample_at(track: Track, time_s: float) -> Sample | None:
    return min(track.samples, key=lambda s: abs(s.time_s - time_s), default=None)


def _headline(outcome: Outcome) -> str:
    failed = [verdict for verdict in outcome.verdicts if not verdict.holds]
    if outcome.problem:
        word = f"**Aborted: {outcome.problem}.**"
    elif not outcome.verdicts:
        word = "**Completed.** There are no checks."
    elif len(outcome.verdicts) == 1:
        word = "**The check failed.**" if failed else "**The check holds.**"
    elif failed:
        word = f"**{len(failed)} of {len(outcome.verdicts)} checks failed.**"
    else:
        word = f"**All {len(outcome.verdicts)} checks hold.**"
    experiment = outcome.experiment
    pace = "in lockstep" if not experiment.pace else f"at {experiment.pace:g} times real time"
    if experiment.mode not in _CLOCK_MODES and experiment.pace == 1:
        pace = "in real time"
    return (
        f"{word} Mode {experiment.mode}, {pace}, seed {experiment.seed}; {len(outcome.flights)} vehicles,"
        f" {clock(outcome.duration_s)} of flight time in {clock(outcome.wall_s)}."
    ).replace("; 1 vehicles", "; 1 vehicle")


def _checks(outcome: Outcome) -> str:
    if not outcome.verdicts:
        return ""
    rows = [("holds" if v.holds else "**failed**", v.check, v.vehicle or "-", v.found) for v in outcome.verdicts]
    return "## Checks\n\n" + table(("", "Check", "Vehicle", "Result"), rows)


def _vehicle(track: Track, outcome: Outcome) -> dict[str, Any]:
    return {
        "takeoff_s": rounded(track.takeoff_s),
        "landing_s": rounded(track.landing_s),
        "distance_m": rounded(track.distance_m),
        "max_altitude_m": rounded(track.max_altitude_m),
        "max_speed_mps": rounded(track.max_speed_mps),
        "landed_from_takeoff_m": rounded(track.miss_m),
        "battery": rounded(track.samples[-1].battery) if track.samples else None,
        "modes": [[round(at, 2), mode] for at, mode in outcome.flights[track.name].modes],
        "task": outcome.flights[track.name].task or None,
    }


def _flights(outcome: Outcome) -> str:
    rows = []
    for track in _by_name(outcome).values():
        battery = f"{100 * track.samples[-1].battery:.0f} %" if track.samples else "-"
        rows.append(
            (
                track.name, clock(track.takeoff_s), clock(track.landing_s), f"{track.distance_m:.0f} m",
                f"{track.max_altitude_m:.1f} m", f"{track.max_speed_mps:.1f} m/s",
                "-" if track.miss_m is None else f"{track.miss_m:.1f} m", battery,
            )
        )  # fmt: skip
    head = ("Vehicle", "Takeoff", "Landed", "Flown", "Highest", "Fastest", "From takeoff", "Battery")
    return "## Flights\n\n" + table(head, rows)


def _events(outcome: Outcome) -> str:
    letters = {(o.title, round(o.begin_s)): letter for letter, o in _lettered(outcome)}
    modes = [
        (at, flight.name, f"mode {mode}")
        for flight in outcome.flights.values()
        for at, mode in flight.modes
        if len(outcome.flights) <= 3
    ]
    merged = sorted([*outcome.events, *modes], key=lambda event: event[0])
    rows = [(letters.get((text, round(at)), ""), f"{at:.1f} s", who or "-", text) for at, who, text in merged]
    if not rows:
        return ""
    left = f"\n\n{len(rows) - _PAGE_EVENTS} more events are in report.json." if len(rows) > _PAGE_EVENTS else ""
    return "## Events\n\n" + table(("", "Time", "Vehicle", "Event"), rows[:_PAGE_EVENTS]) + left


def _texts(outcome: Outcome) -> str:
    """Return a table of STATUSTEXT messages more severe than INFO."""
    loud = [
        (f"{text.time_s:.1f} s", flight.name, text.text)
        for flight in outcome.flights.values()
        for text in flight.texts
        if text.severity < _QUIET_SEVERITY
    ]
    return "## Autopilot warnings\n\n" + table(("At", "Vehicle", "Text"), loud[:_PAGE_TEXTS]) if loud else ""


def _files(outcome: Outcome) -> str:
    names: Mapping[str, str] = {
        "report.json": "the figures",
        "tracks.geojson": "tracks, zones and faults for maps",
        f"logs/{outcome.experiment.name}.mcap": "telemetry and events for Foxglove",
    }
    logs: Iterable[Path] = sorted((outcome.folder / "logs").glob("*.tlog"))
    listed = [f"[{name}]({name}): {what}" for name, what in names.items()]
    if logs:
        listed.append(f"logs/*.tlog ({len(list(logs))} files): MAVLink of each link, for MAVProxy and Mission Planner")
    return "\n".join(["## Files", "", *(f"- {line}" for line in listed)])

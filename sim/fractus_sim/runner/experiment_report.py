"""Report of an experiment: summary page, figures, tracks and machine-readable results."""

from __future__ import annotations

import itertools
import string
from collections.abc import Callable, Sequence
from typing import Any

from fractus_core.geo import LocalFrame, area_polygon, multipolygon_geojson
from matplotlib.figure import Figure
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_sim.experiment.checks import AltitudeBand, SpeedLimit
from fractus_sim.report.flight_geojson import feature, feature_collection, lonlat, path_feature, point
from fractus_sim.report.flight_map import DrawnZone, FlightMap, Mark, draw_map
from fractus_sim.report.flight_profile import Limit, Profile, Span, draw_profile
from fractus_sim.report.mission_report import decision_marks, decision_requests, decisions_section
from fractus_sim.report.report_files import RESULTS, format_duration, rounded, table, write_report
from fractus_sim.report.track import Track
from fractus_sim.runner.fault_injection import Occurrence
from fractus_sim.runner.outcome import Event, Outcome

_MAX_EVENTS = 40
_MAX_TEXTS = 25
_MAX_VEHICLES_WITH_MODES = 3
"""With more vehicles, the page does not list mode changes."""


def write_outcome(outcome: Outcome) -> None:
    """Write report.json, tracks.geojson, map.png, profile.png and summary.md into the folder of the experiment."""
    figures: dict[str, Callable[[], Figure]] = {}
    if _tracks(outcome):
        figures = {
            "map.png": lambda: draw_map(experiment_map(outcome)),
            "profile.png": lambda: draw_profile(experiment_profile(outcome)),
        }
    write_report(
        outcome.folder,
        experiment_page(outcome),
        experiment_results(outcome),
        figures,
        geojson={"tracks.geojson": experiment_geojson(outcome)},
    )


def experiment_map(outcome: Outcome) -> FlightMap:
    """Return the content of the map, in metres east and north of the start of the first vehicle."""
    tracks = _tracks(outcome)
    first = tracks[0].samples[0].place
    frame = LocalFrame(first.lat, first.lon)
    zones = tuple(DrawnZone(z.name, z.kind, area_polygon(frame, z.area)) for z in outcome.experiment.zones)
    marks: list[Mark] = []
    for letter, occurrence in _faults_with_letters(outcome):
        for track in tracks:
            sample = track.sample_at(occurrence.begin_s)
            affected = not occurrence.vehicle or track.name in _affected_vehicles(outcome, occurrence)
            if sample is not None and affected:
                position = frame.xy(sample.place.lat, sample.place.lon)
                marks.append(Mark("fault", letter, position, label=f"{letter} {occurrence.title}"))
    return FlightMap(
        title=f"{outcome.experiment.name}: {_distance_words(tracks)}",
        frame=frame,
        tracks=tracks,
        zones=zones,
        depots=(("home", (0.0, 0.0)),) if len(tracks) == 1 else (),
        marks=(*marks, *decision_marks(outcome.decisions, frame)),
    )


def experiment_profile(outcome: Outcome) -> Profile:
    """Return the content of the profile: altitude, speed and battery over time, with faults."""
    tracks = _tracks(outcome)
    end_s = max(track.samples[-1].time_s for track in tracks)
    spans = [
        Span(o.begin_s, o.end_s if o.end_s is not None else end_s, f"{letter} {o.title}", fault=True)
        for letter, o in _faults_with_letters(outcome)
    ]
    has_battery_fault = any(o.kind == "batteryDrop" for o in outcome.occurrences)
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
        panels=("altitude", "speed", "voltage" if has_battery_fault else "battery"),
        limits=tuple(limits),
        spans=tuple(spans),
        requests=tuple(decision_requests(outcome.decisions)),
        time_label="seconds since the vehicles were ready",
    )


def experiment_page(outcome: Outcome) -> str:
    """Return the summary page in Markdown."""
    figures = ""
    if _tracks(outcome):
        figures = "![map](map.png)\n\n![altitude, speed and battery](profile.png)"
    decisions = ""
    if outcome.findings.calls:
        decisions = decisions_section(outcome.decisions, lambda time_s: f"{time_s:.1f} s")
    parts = [
        f"# Experiment {outcome.experiment.name}\n\n{outcome.experiment.description}".rstrip(),
        _headline(outcome),
        _checks_section(outcome),
        figures,
        _flights_section(outcome),
        decisions,
        _events_section(outcome),
        _texts_section(outcome),
        _files_section(outcome),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def experiment_results(outcome: Outcome) -> dict[str, Any]:
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
            {"check": v.check, "vehicle": v.vehicle or None, "holds": v.holds, "found": v.observed}
            for v in outcome.verdicts
        ],
        "vehicles": {name: _vehicle_results(track, outcome) for name, track in _tracks_by_name(outcome).items()},
        "faults": [
            {
                "fault": o.kind, "title": o.title, "vehicle": o.vehicle or None, "begin_s": round(o.begin_s, 2),
                "end_s": None if o.end_s is None else round(o.end_s, 2),
            }
            for o in outcome.occurrences
        ],
        "events": [
            {"time_s": round(event.time_s, 2), "vehicle": event.vehicle or None, "text": event.text}
            for event in outcome.events
        ],
        "programs": outcome.findings.programs,
        "resources": {
            name: {
                "vehicle": usage.vehicle or None, "cpu_s": round(usage.cpu_s, 2), "wall_s": round(usage.wall_s, 2),
                "mean_memory_mib": round(usage.mean_memory_mib, 1), "peak_memory_mib": round(usage.peak_memory_mib, 1),
            }
            for name, usage in outcome.findings.usages.items()
        },
        "data_sent": outcome.findings.data_sent,
        "phases": outcome.findings.phases,
        "audit": outcome.findings.audit_problems,
    }  # fmt: skip


def experiment_geojson(outcome: Outcome) -> dict[str, Any]:
    """Return tracks, zones and faults as a GeoJSON FeatureCollection."""
    features: list[dict[str, Any]] = [path_feature(track) for track in _tracks(outcome)]
    frame = LocalFrame(*_first_position(outcome))
    for zone in outcome.experiment.zones:
        shape = multipolygon_geojson(frame, area_polygon(frame, zone.area))
        features.append(feature(shape, what="zone", name=zone.name, kind=zone.kind))
    for occurrence in outcome.occurrences:
        track = _tracks_by_name(outcome).get(occurrence.vehicle)
        sample = track.sample_at(occurrence.begin_s) if track is not None else None
        if sample is not None:
            fields = {"fault": occurrence.kind, "title": occurrence.title, "drone": occurrence.vehicle}
            time_s = round(occurrence.begin_s, 3)
            features.append(feature(point(lonlat(sample.place)), what="fault", time=time_s, **fields))
    return feature_collection(features)


def _first_position(outcome: Outcome) -> tuple[float, float]:
    """Return latitude and longitude of the start of the first vehicle."""
    tracks = _tracks(outcome)
    if tracks:
        return tracks[0].samples[0].place.lat, tracks[0].samples[0].place.lon
    home = next(setup.home for setup in outcome.experiment.setups())
    return (home.lat, home.lon) if home is not None else (0.0, 0.0)


def _tracks_by_name(outcome: Outcome) -> dict[str, Track]:
    return {name: flight.track for name, flight in outcome.flights.items()}


def _tracks(outcome: Outcome) -> tuple[Track, ...]:
    return tuple(track for track in _tracks_by_name(outcome).values() if len(track.samples) > 1)


def _distance_words(tracks: Sequence[Track]) -> str:
    if len(tracks) == 1:
        return f"{tracks[0].name}, {tracks[0].distance_m:.0f} m flown"
    return f"{len(tracks)} vehicles, {sum(track.distance_m for track in tracks):.0f} m flown"


def _faults_with_letters(outcome: Outcome) -> list[tuple[str, Occurrence]]:
    """Assign letters to faults. A fault that affects several vehicles at the same time gets one letter."""
    first: dict[tuple[str, float], Occurrence] = {}
    for occurrence in sorted(outcome.occurrences, key=lambda o: o.begin_s):
        first.setdefault((occurrence.title, round(occurrence.begin_s)), occurrence)
    letters = (f"{letter}{repetition or ''}" for repetition in itertools.count() for letter in string.ascii_uppercase)
    return list(zip(letters, first.values(), strict=False))


def _affected_vehicles(outcome: Outcome, occurrence: Occurrence) -> set[str]:
    """Return the vehicles on which a fault was injected at the same time."""
    key = (occurrence.title, round(occurrence.begin_s))
    return {o.vehicle for o in outcome.occurrences if (o.title, round(o.begin_s)) == key}


def _headline(outcome: Outcome) -> str:
    failed = [verdict for verdict in outcome.verdicts if not verdict.holds]
    if outcome.problem:
        result = f"**Aborted: {outcome.problem}.**"
    elif not outcome.verdicts:
        result = "**Completed.** There are no checks."
    elif len(outcome.verdicts) == 1:
        result = "**The check failed.**" if failed else "**The check holds.**"
    elif failed:
        result = f"**{len(failed)} of {len(outcome.verdicts)} checks failed.**"
    else:
        result = f"**All {len(outcome.verdicts)} checks hold.**"
    experiment = outcome.experiment
    if not experiment.pace:
        pace = "in lockstep"
    elif experiment.pace == 1 and experiment.mode != "vehicles":
        pace = "in real time"
    else:
        pace = f"at {experiment.pace:g} times real time"
    vehicles = "1 vehicle" if len(outcome.flights) == 1 else f"{len(outcome.flights)} vehicles"
    return (
        f"{result} Mode {experiment.mode}, {pace}, seed {experiment.seed}; {vehicles},"
        f" {format_duration(outcome.duration_s)} of flight time in {format_duration(outcome.wall_s)}."
    )


def _checks_section(outcome: Outcome) -> str:
    if not outcome.verdicts:
        return ""
    rows = [("holds" if v.holds else "**failed**", v.check, v.vehicle or "-", v.observed) for v in outcome.verdicts]
    return "## Checks\n\n" + table(("", "Check", "Vehicle", "Result"), rows)


def _vehicle_results(track: Track, outcome: Outcome) -> dict[str, Any]:
    return {
        "takeoff_s": rounded(track.takeoff_s),
        "landing_s": rounded(track.landing_s),
        "distance_m": rounded(track.distance_m),
        "max_altitude_m": rounded(track.max_altitude_m),
        "max_speed_mps": rounded(track.max_speed_mps),
        "landed_from_takeoff_m": rounded(track.landing_error_m),
        "battery": rounded(track.samples[-1].battery) if track.samples else None,
        "modes": [[round(at, 2), mode] for at, mode in outcome.flights[track.name].modes],
        "task": outcome.flights[track.name].task or None,
    }


def _flights_section(outcome: Outcome) -> str:
    rows = []
    for track in _tracks_by_name(outcome).values():
        battery = f"{100 * track.samples[-1].battery:.0f} %" if track.samples else "-"
        rows.append(
            (
                track.name, format_duration(track.takeoff_s), format_duration(track.landing_s), f"{track.distance_m:.0f} m",
                f"{track.max_altitude_m:.1f} m", f"{track.max_speed_mps:.1f} m/s",
                "-" if track.landing_error_m is None else f"{track.landing_error_m:.1f} m", battery,
            )
        )  # fmt: skip
    head = ("Vehicle", "Takeoff", "Landing", "Distance", "Max altitude", "Max speed", "Landed from takeoff", "Battery")
    return "## Flights\n\n" + table(head, rows)


def _events_section(outcome: Outcome) -> str:
    letters = {(o.title, round(o.begin_s)): letter for letter, o in _faults_with_letters(outcome)}
    events = list(outcome.events)
    if len(outcome.flights) <= _MAX_VEHICLES_WITH_MODES:
        for flight in outcome.flights.values():
            events += [Event(time_s, flight.name, f"mode {mode}") for time_s, mode in flight.modes]
    rows = [
        (letters.get((e.text, round(e.time_s)), ""), f"{e.time_s:.1f} s", e.vehicle or "-", e.text)
        for e in sorted(events, key=lambda event: event.time_s)
    ]
    if not rows:
        return ""
    section = "## Events\n\n" + table(("", "Time", "Vehicle", "Event"), rows[:_MAX_EVENTS])
    if len(rows) > _MAX_EVENTS:
        section += f"\n\n{len(rows) - _MAX_EVENTS} more events are in report.json."
    return section


def _texts_section(outcome: Outcome) -> str:
    """Return a table of STATUSTEXT messages more severe than INFO."""
    rows = [
        (f"{text.time_s:.1f} s", flight.name, text.text)
        for flight in outcome.flights.values()
        for text in flight.texts
        if text.severity < mavlink.MAV_SEVERITY_INFO
    ]
    return "## Autopilot warnings\n\n" + table(("Time", "Vehicle", "Text"), rows[:_MAX_TEXTS]) if rows else ""


def _files_section(outcome: Outcome) -> str:
    contents = {
        RESULTS: "results for programs",
        "tracks.geojson": "tracks, zones and faults for maps",
        f"logs/{outcome.experiment.name}.mcap": "telemetry and events for Foxglove",
    }
    lines = [f"- [{name}]({name}): {content}" for name, content in contents.items()]
    logs = len(list((outcome.folder / "logs").glob("*.tlog")))
    if logs:
        lines.append(f"- logs/*.tlog ({logs} files): MAVLink of each link, for MAVProxy and Mission Planner")
    return "\n".join(["## Files", "", *lines])

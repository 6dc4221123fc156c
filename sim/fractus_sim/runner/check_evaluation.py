"""Evaluation of checks on recorded evidence. All functions are pure, and each verdict states its reason."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely
from fractus_core.geo import LocalFrame, area_polygon
from fractus_vehicle.earth import Place

from fractus_sim.experiment import checks
from fractus_sim.experiment.definition import NamedZone
from fractus_sim.report.track import Sample
from fractus_sim.runner.fault_injection import Occurrence
from fractus_sim.runner.telemetry_recording import Flight
from fractus_sim.testbeds.detections import score_detections
from fractus_sim.testbeds.testbed import Findings

MATCH_S = 0.2
"""Maximum difference of the times of two samples that count as simultaneous."""


@dataclass(frozen=True)
class Evidence:
    """Recorded evidence. Times are seconds of the experiment.

    Attributes:
        flights: Flights by vehicle.
        occurrences: Injected faults.
        zones: Zones by name.
        findings: Other results, such as exit codes of programs.
    """

    flights: Mapping[str, Flight]
    occurrences: Sequence[Occurrence] = ()
    zones: Mapping[str, NamedZone] = field(default_factory=dict)
    findings: Findings = field(default_factory=Findings)


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of a check for one vehicle, or for the whole experiment if `vehicle` is empty.

    Attributes:
        check: Description of the check.
        observed: Observed value or reason.
    """

    check: str
    vehicle: str
    holds: bool
    observed: str


_SHOWN_IF_ZERO = ("north", "east", "alt", "exitCode")


def evaluate_check(check: checks.Check, evidence: Evidence) -> tuple[Verdict, ...]:
    """Evaluate one check. Return one verdict per vehicle, or a single verdict for a check of the whole experiment."""
    if isinstance(check, checks.VehicleCheck) and not isinstance(check, checks.Separation):
        names = check.vehicles or tuple(evidence.flights)
        return tuple(
            Verdict(check_title(check), name, *_VEHICLE_CHECKS[type(check)](check, evidence.flights[name], evidence))
            for name in names
        )
    holds, observed = _EXPERIMENT_CHECKS[type(check)](check, evidence)
    return (Verdict(check_title(check), "", holds, observed),)


def check_title(check: checks.Check) -> str:
    """Describe a check in a few words."""
    fields = check.to_dict()
    kind = fields.pop("check")
    fields.pop("vehicles", None)
    words = ", ".join(_format_field(name, value) for name, value in fields.items() if value or name in _SHOWN_IF_ZERO)
    return f"{kind}: {words}" if words else kind


def _format_field(name: str, value: object) -> str:
    if value is True:
        return name
    return f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}"


def _landed(check: checks.Landed, flight: Flight, evidence: Evidence) -> tuple[bool, str]:
    track = flight.track
    if track.takeoff_s is None:
        return False, "never took off"
    if track.landing_s is None:
        return False, "still in the air"
    if flight.armed_at_end:
        return False, "landed, but still armed"
    distance_m = track.landing_error_m or 0.0
    observed = f"landed after {track.landing_s:.1f} s, {distance_m:.1f} m from the takeoff position"
    late = check.within is not None and track.landing_s > check.within
    near = check.near_home is None or distance_m <= check.near_home
    return near and not late, observed


def _never_flew(_check: checks.NeverFlew, flight: Flight, _evidence: Evidence) -> tuple[bool, str]:
    takeoff_s = flight.track.takeoff_s
    if takeoff_s is None:
        return True, "stayed on the ground"
    return False, f"took off at {takeoff_s:.1f} s"


def _reached(check: checks.Reached, flight: Flight, _evidence: Evidence) -> tuple[bool, str]:
    home = flight.track.home
    if home is None:
        return False, "position never received"
    if check.lat is not None and check.lon is not None:
        target = Place.from_degrees(check.lat, check.lon, 0.0)
    else:
        target = Place.from_degrees(home.lat, home.lon, 0.0).offset(check.north or 0.0, check.east or 0.0)
    closest_m = math.inf
    closest_s = 0.0
    for sample in flight.samples:
        if check.within is not None and sample.time_s > check.within:
            break
        north, east, _ = Place.from_degrees(sample.place.lat, sample.place.lon, 0.0).vector_to(target)
        up = 0.0 if check.alt is None else sample.place.alt_m - check.alt
        distance_m = math.hypot(north, east, up)
        if distance_m < closest_m:
            closest_m = distance_m
            closest_s = sample.time_s
    return closest_m <= check.tolerance, f"closest {closest_m:.1f} m, at {closest_s:.1f} s"


def _mode(check: checks.ModeReached, flight: Flight, evidence: Evidence) -> tuple[bool, str]:
    begin_s = 0.0
    if check.after is not None:
        begins = [o.begin_s for o in evidence.occurrences if o.kind == check.after and o.vehicle in {flight.name, ""}]
        if not begins:
            return False, f"{check.after} was not injected"
        begin_s = min(begins)
    changes = [(time_s, mode) for time_s, mode in flight.modes if time_s >= begin_s]
    reached_s = next((time_s for time_s, mode in changes if mode == check.mode), None)
    if reached_s is None:
        modes = ", ".join(dict.fromkeys(mode for _, mode in changes)) or "no change"
        return False, f"never; modes: {modes}"
    delay_s = reached_s - begin_s
    when = f"{delay_s:.1f} s after {check.after}" if check.after else f"at {reached_s:.1f} s"
    return check.within is None or delay_s <= check.within, f"{check.mode} {when}"


def _statustext(check: checks.StatusText, flight: Flight, _evidence: Evidence) -> tuple[bool, str]:
    match = next((text for text in flight.texts if re.search(check.matches, text.text)), None)
    if match is None:
        return check.absent, "no matching text"
    return not check.absent, f"{match.text!r} at {match.time_s:.1f} s"


def _altitude(check: checks.AltitudeBand, flight: Flight, _evidence: Evidence) -> tuple[bool, str]:
    heights = [s.place.alt_m for s in flight.samples if s.in_air]
    if not heights:
        return False, "never took off"
    holds = True
    observed = []
    if check.max is not None:
        observed.append(f"maximum {max(heights):.1f} m")
        holds = max(heights) <= check.max
    if check.min is not None:
        above = [i for i, height in enumerate(heights) if height >= check.min]
        low_m = min(heights[above[0] : above[-1] + 1]) if above else max(heights)
        observed.append(f"minimum {low_m:.1f} m")
        holds = holds and low_m >= check.min
    return holds, ", ".join(observed)


def _speed(check: checks.SpeedLimit, flight: Flight, _evidence: Evidence) -> tuple[bool, str]:
    fastest = flight.track.max_speed_mps
    return fastest <= check.max, f"maximum {fastest:.1f} m/s"


def _outside(check: checks.OutsideZone, flight: Flight, evidence: Evidence) -> tuple[bool, str]:
    distances = _distances_m(evidence.zones[check.zone], [s for s in flight.samples if s.in_air])
    if distances.size == 0:
        return True, "never took off"
    nearest = float(distances.min())
    if nearest <= 0:
        return False, f"up to {-nearest:.1f} m inside"
    return nearest >= check.margin, f"closest {nearest:.1f} m from the border"


def _inside(check: checks.InsideZone, flight: Flight, evidence: Evidence) -> tuple[bool, str]:
    distances = _distances_m(evidence.zones[check.zone], [s for s in flight.samples if s.in_air])
    if distances.size == 0:
        return False, "never took off"
    farthest = float(distances.max())
    if farthest > 0:
        return False, f"up to {farthest:.1f} m outside"
    return True, f"always at least {-farthest:.1f} m inside"


def _distances_m(zone: NamedZone, samples: Sequence[Sample]) -> np.ndarray:
    """Return the distance to the border of a zone for each sample, in metres: positive outside, negative inside.

    A sample above or below the altitude band counts as outside. Its distance is the larger of the horizontal and the
    vertical distance.
    """
    if not samples:
        return np.empty(0)
    frame = LocalFrame(samples[0].place.lat, samples[0].place.lon)
    shape = area_polygon(frame, zone.area)
    points = shapely.points([frame.xy(s.place.lat, s.place.lon) for s in samples])
    horizontal = np.where(shapely.contains(shape, points), -1.0, 1.0) * shapely.distance(shape.boundary, points)
    band = zone.altitude
    if band is None:
        return np.asarray(horizontal)
    heights = np.array([s.place.alt_m for s in samples])
    lower = -math.inf if band.lower is None else band.lower
    upper = math.inf if band.upper is None else band.upper
    return np.asarray(np.maximum(horizontal, np.maximum(lower - heights, heights - upper)))


def _battery(check: checks.Battery, flight: Flight, _evidence: Evidence) -> tuple[bool, str]:
    if not flight.samples:
        return False, "no battery status received"
    remaining = flight.samples[-1].battery * 100
    return remaining >= check.min, f"{remaining:.0f} % left"


def _task(_check: checks.TaskDone, flight: Flight, _evidence: Evidence) -> tuple[bool, str]:
    return flight.task == "done", flight.task or "not completed"


def _separation(check: checks.Separation, evidence: Evidence) -> tuple[bool, str]:
    names = check.vehicles or tuple(evidence.flights)
    nearest_m = math.inf
    vehicles = ""
    nearest_s = 0.0
    for one, other in itertools.combinations(names, 2):
        for a, b in _simultaneous_samples(evidence.flights[one].samples, evidence.flights[other].samples):
            start = Place.from_degrees(a.place.lat, a.place.lon, a.place.alt_m)
            distance_m = math.hypot(*start.vector_to(Place.from_degrees(b.place.lat, b.place.lon, b.place.alt_m)))
            if distance_m < nearest_m:
                nearest_m = distance_m
                vehicles = f"{one} and {other}"
                nearest_s = a.time_s
    if not vehicles:
        return True, "no two vehicles were in the air at the same time"
    return nearest_m >= check.min, f"closest {nearest_m:.1f} m, {vehicles} at {nearest_s:.1f} s"


def _simultaneous_samples(ones: Sequence[Sample], others: Sequence[Sample]) -> Iterable[tuple[Sample, Sample]]:
    """Yield pairs of simultaneous samples of two vehicles that are both in the air."""
    index = 0
    for one in ones:
        while index < len(others) - 1 and others[index].time_s < one.time_s - MATCH_S / 2:
            index += 1
        if others and abs(others[index].time_s - one.time_s) <= MATCH_S and one.in_air and others[index].in_air:
            yield one, others[index]


def _data_sent(check: checks.DataSent, flight: Flight, evidence: Evidence) -> tuple[bool, str]:
    sent = evidence.findings.data_sent.get(flight.name, {}).get(check.level)
    if sent is None:
        return False, "not measured"
    return check.min <= sent and (check.max is None or sent <= check.max), f"{sent} bytes"


def _program(check: checks.ProgramEnded, evidence: Evidence) -> tuple[bool, str]:
    if check.program not in evidence.findings.programs:
        return False, "was not started"
    code = evidence.findings.programs[check.program]
    observed = "had to be stopped" if code is None else f"exit code {code}"
    return code == check.exit_code, observed


def _call(check: checks.CallJudged, evidence: Evidence) -> tuple[bool, str]:
    def matches(entry: Mapping[str, Any]) -> bool:
        caller = f"/component/{check.component}/"
        action = "takeover" if entry.get("kind") == "takeover" else entry.get("action")
        return (
            action == check.action
            and (check.component is None or caller in str(entry.get("caller", "")))
            and (check.method is None or entry.get("method") == check.method)
            and (check.code is None or entry.get("code") == check.code)
        )

    calls = [entry for entry in evidence.findings.calls if matches(entry)]
    if check.absent and not evidence.findings.audit_problems and not calls:
        return False, "no audit log"
    if not calls:
        return check.absent, f"no match in {len(evidence.findings.calls)} entries"
    return not check.absent, f"{len(calls)}, for example: {calls[0].get('reason') or calls[0].get('method', '')}"


def _audit(_check: checks.AuditSound, evidence: Evidence) -> tuple[bool, str]:
    problems = evidence.findings.audit_problems
    if not problems:
        return False, "no audit log"
    invalid = [f"{log}: {problem}" for log, problem in problems.items() if problem]
    if invalid:
        return False, "; ".join(invalid)
    return True, "the log is valid" if len(problems) == 1 else f"{len(problems)} logs are valid"


def _phase(check: checks.ApplicationPhase, evidence: Evidence) -> tuple[bool, str]:
    phases = evidence.findings.phases.get(check.application, ())
    return check.phase in phases, f"phases: {', '.join(phases)}" if phases else "no phase observed"


def _detections(check: checks.Detections, evidence: Evidence) -> tuple[bool, str]:
    score = score_detections(evidence.findings.detections, evidence.findings.truths, check.kind, check.radius)
    if not score.objects and not score.detections:
        return False, f"no {check.kind} was in view, and none was detected"
    observed = (
        f"precision {score.precision:.2f} ({score.correct_detections} of {score.detections}),"
        f" recall {score.recall:.2f} ({score.detected_objects} of {score.objects})"
    )
    return score.precision >= check.precision and score.recall >= check.recall, observed


_VEHICLE_CHECKS: Mapping[type, Callable[[Any, Flight, Evidence], tuple[bool, str]]] = {
    checks.Landed: _landed,
    checks.NeverFlew: _never_flew,
    checks.Reached: _reached,
    checks.ModeReached: _mode,
    checks.StatusText: _statustext,
    checks.AltitudeBand: _altitude,
    checks.SpeedLimit: _speed,
    checks.OutsideZone: _outside,
    checks.InsideZone: _inside,
    checks.Battery: _battery,
    checks.TaskDone: _task,
    checks.DataSent: _data_sent,
}
_EXPERIMENT_CHECKS: Mapping[type, Callable[[Any, Evidence], tuple[bool, str]]] = {
    checks.Separation: _separation,
    checks.ProgramEnded: _program,
    checks.CallJudged: _call,
    checks.AuditSound: _audit,
    checks.ApplicationPhase: _phase,
    checks.Detections: _detections,
}

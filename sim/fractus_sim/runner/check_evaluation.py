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

from fractus_sim.experiment import checks as kinds
from fractus_sim.experiment.definition import NamedZone
from fractus_sim.report.track import Sample
from fractus_sim.runner.fault_injection import Occurrence
from fractus_sim.runner.telemetry_recording import Flight
from fractus_sim.testbeds.detections import score
from fractus_sim.testbeds.testbed import Findings

MATCH_S = 0.2


@dataclass(frozen=True)
class Evidence:
    """Recorded evidence. Times are seconds of the experiment.

    Attributes:
        flights: Flights by vehicle.
        zones: Zones by name.
    """

    flights: Mapping[str, Flight]
    occurrences: Sequence[Occurrence] = ()
    zones: Mapping[str, NamedZone] = field(default_factory=dict)
    findings: Findings = field(default_factory=Findings)


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of a check for one vehicle, or for the whole experiment if `vehicle` is empty."""

    check: str
    vehicle: str
    holds: bool
    found: str


_SHOWN_IF_ZERO = ("north", "east", "alt", "exitCode")


def judge(check: kinds.Check, evidence: Evidence) -> tuple[Verdict, ...]:
    """Evaluate one check. Return one verdict per vehicle, or a single verdict."""
    if isinstance(check, kinds.VehicleCheck) and not isinstance(check, kinds.Separation):
        names = check.vehicles or tuple(evidence.flights)
        return tuple(
            Verdict(title(check), name, *_FOR_VEHICLES[type(check)](check, evidence.flights[name], evidence))
            for name in names
        )
    holds, found = _FOR_ALL[type(check)](check, evidence)
    return (Verdict(title(check), "", holds, found),)


def title(check: kinds.Check) -> str:
    """Describe a check in a few words."""
    fields = check.to_dict()
    kind = fields.pop("check")
    fields.pop("vehicles", None)
    words = ", ".join(_word(name, value) for name, value in fields.items() if value or name in _SHOWN_IF_ZERO)
    return f"{kind}: {words}" if words else kind


def _word(name: str, value: object) -> str:
    if value is True:
        return name
    return f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}"


def _landed(check: kinds.Landed, flight: Flight, evidence: Evidence) -> tuple[bool, str]:
    track = flight.track
    if track.takeoff_s is None:
        return False, "never took off"
    if track.landing_s is None or flight.armed_at_end:
        return False, "still in the air" if track.landing_s is None else "landed, but still armed"
    miss_m = track.miss_m or 0.0
    found = f"landed after {track.landing_s:.1f} s, {miss_m:.1f} m from the takeoff position"
    late = check.within is not None and track.landing_s > check.within
    return not late and (check.near_home is None or miss_m <= check.near_home), found


def _never_flew(_check: kinds.NeverFlew, flight: Flight, _evidence: Evidence) -> tuple[bool, str]:
    takeoff_s = flight.track.takeoff_s
    return takeoff_s is None, "stayed on the ground" if takeoff_s is None else f"took off at {takeoff_s:.1f} s"


def _reached(check: kinds.Reached, flight: Flight, _evidence: Evidence) -> tuple[bool, str]:
    home = flight.track.home
    if home is None:
        return False, "position never received"
    if check.lat is not None and check.lon is not None:
        target = Place.from_degrees(check.lat, check.lon, 0.0)
    else:
        target = Place.from_degrees(home.lat, home.lon, 0.0).offset(check.north or 0.0, check.east or 0.0)
    best_m = math.inf
    best_s = 0.0
    for sample in flight.samples:
        if check.within is not None and sample.time_s > check.within:
            break
        north, east, _ = Place.from_degrees(sample.place.lat, sample.place.lon, 0.0).vector_to(target)
        off_m = math.hypot(north, east, 0.0 if check.alt is None else sample.place.alt_m - check.alt)
        if off_m < best_m:
            best_m = off_m
            best_s = sample.time_s
    return best_m <= check.tolerance, f"closest {best_m:.1f} m, at {best_s:.1f} s"


def _mode(check: kinds.ModeReached, flight: Flight, evidence: Evidence) -> tuple[bool, str]:
    begin_s = 0.0
    if check.after is not None:
        begun = [o.begin_s for o in evidence.occurrences if o.kind == check.after and o.vehicle in {flight.name, ""}]
        if not begun:
            return False, f"{check.after} was not injected"
        begin_s = min(begun)
    after = [(at, mode) for at, mode in flight.modes if at >= begin_s]
    hit = next((at for at, mode in after if mode == check.mode), None)
    if hit is None:
        seen = ", ".join(dict.fromkeys(mode for _, mode in after)) or "no change"
        return False, f"never; modes: {seen}"
    waited_s = hit - begin_s
    since = f"{waited_s:.1f} s after {check.after}" if check.after else f"at {hit:.1f} s"
    return check.within is None or waited_s <= check.within, f"{check.mode} {since}"


def _statustext(check: kinds.StatusText, flight: Flight, _evidence: Evidence) -> tuple[bool, str]:
    hit = next((text for text in flight.texts if re.search(check.matches, text.text)), None)
    found = f"{hit.text!r} at {hit.time_s:.1f} s" if hit is not None else "no matching text"
    return (hit is None) == check.absent, found


def _altitude(check: kinds.AltitudeBand, flight: Flight, _evidence: Evidence) -> tuple[bool, str]:
    heights = [s.place.alt_m for s in flight.samples if s.in_air]
    if not heights:
        return False, "never took off"
    holds = True
    found = []
    if check.max is not None:
        found.append(f"maximum {max(heights):.1f} m")
        holds = max(heights) <= check.max
    if check.min is not None:
        above = [i for i, height in enumerate(heights) if height >= check.min]
        low_m = min(heights[above[0] : above[-1] + 1]) if above else max(heights)
        found.append(f"minimum {low_m:.1f} m")
        holds = holds and low_m >= check.min
    return holds, ", ".join(found)


def _speed(check: kinds.SpeedLimit, flight: Flight, _evidence: Evidence) -> tuple[bool, str]:
    fastest = flight.track.max_speed_mps
    return fastest <= check.max, f"maximum {fastest:.1f} m/s"


def _outside(check: kinds.OutsideZone, flight: Flight, evidence: Evidence) -> tuple[bool, str]:
    distances = _distances_m(evidence.zones[check.zone], [s for s in flight.samples if s.in_air])
    if distances.size == 0:
        return True, "never took off"
    nearest = float(distances.min())
    found = f"closest {nearest:.1f} m from the border" if nearest > 0 else f"up to {-nearest:.1f} m inside"
    return nearest > 0 and nearest >= check.margin, found


def _inside(check: kinds.InsideZone, flight: Flight, evidence: Evidence) -> tuple[bool, str]:
    distances = _distances_m(evidence.zones[check.zone], [s for s in flight.samples if s.in_air])
    if distances.size == 0:
        return False, "never took off"
    worst = float(distances.max())
    return worst <= 0, f"always at least {-worst:.1f} m inside" if worst <= 0 else f"up to {worst:.1f} m outside"


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
    flat = np.where(shapely.contains(shape, points), -1.0, 1.0) * shapely.distance(shape.boundary, points)
    band = zone.altitude
    if band is None:
        return np.asarray(flat)
    heights = np.array([s.place.alt_m for s in samples])
    lower = -math.inf if band.lower is None else band.lower
    upper = math.inf if band.upper is None else band.upper
    return np.asarray(np.maximum(flat, np.maximum(lower - heights, heights - upper)))


def _battery(check: kinds.Battery, flight: Flight, _evidence: Evidence) -> tuple[bool, str]:
    if not flight.samples:
        return False, "no battery status received"
    left = flight.samples[-1].battery * 100
    return left >= check.min, f"{left:.0f} % left"


def _task(_check: kinds.TaskDone, flight: Flight, _evidence: Evidence) -> tuple[bool, str]:
    return flight.task == "done", flight.task or "not completed"


def _separation(check: kinds.Separation, evidence: Evidence) -> tuple[bool, str]:
    names = check.vehicles or tuple(evidence.flights)
    nearest_m = math.inf
    who = ""
    when_s = 0.0
    for one, other in itertools.combinations(names, 2):
        for a, b in _pairs(evidence.flights[one].samples, evidence.flights[other].samples):
            start = Place.from_degrees(a.place.lat, a.place.lon, a.place.alt_m)
            off_m = math.hypot(*start.vector_to(Place.from_degrees(b.place.lat, b.place.lon, b.place.alt_m)))
            if off_m < nearest_m:
                nearest_m = off_m
                who = f"{one} and {other}"
                when_s = a.time_s
    if not who:
        return True, "no two vehicles were in the air at the same time"
    return nearest_m >= check.min, f"closest {nearest_m:.1f} m, {who} at {when_s:.1f} s"


def _pairs(ones: Sequence[Sample], others: Sequence[Sample]) -> Iterable[tuple[Sample, Sample]]:
    """Yield simultaneous samples of two vehicles while both are in the air."""
    at = 0
    for one in ones:
        while at < len(others) - 1 and others[at].time_s < one.time_s - MATCH_S / 2:
            at += 1
        if others and abs(others[at].time_s - one.time_s) <= MATCH_S and one.in_air and others[at].in_air:
            yield one, others[at]


def _program(check: kinds.ProgramEnded, evidence: Evidence) -> tuple[bool, str]:
    code = evidence.findings.programs.get(check.program)
    return code == check.exit_code, "had to be stopped" if code is None else f"exit code {code}"


def _call(check: kinds.CallJudged, evidence: Evidence) -> tuple[bool, str]:
    def fits(entry: Mapping[str, Any]) -> bool:
        caller = f"/component/{check.component}/"
        action = "takeover" if entry.get("kind") == "takeover" else entry.get("action")
        return (
            action == check.action
            and (check.component is None or caller in str(entry.get("caller", "")))
            and (check.method is None or entry.get("method") == check.method)
            and (check.code is None or entry.get("code") == check.code)
        )

    hits = [entry for entry in evidence.findings.calls if fits(entry)]
    if not hits:
        return check.absent, f"no match in {len(evidence.findings.calls)} entries"
    return not check.absent, f"{len(hits)}, for example: {hits[0].get('reason') or hits[0].get('method', '')}"


def _audit(_check: kinds.AuditSound, evidence: Evidence) -> tuple[bool, str]:
    broken = [f"{log}: {problem}" for log, problem in evidence.findings.audit_problems.items() if problem]
    if not evidence.findings.audit_problems:
        return False, "no audit log"
    count = len(evidence.findings.audit_problems)
    return not broken, "; ".join(broken) or ("the log is valid" if count == 1 else f"{count} logs are valid")


def _phase(check: kinds.ApplicationPhase, evidence: Evidence) -> tuple[bool, str]:
    seen = evidence.findings.phases.get(check.application, ())
    return check.phase in seen, f"phases: {', '.join(seen)}" if seen else "no phase observed"


def _detections(check: kinds.Detections, evidence: Evidence) -> tuple[bool, str]:
    found = score(evidence.findings.detections, evidence.findings.truths, check.kind, check.radius)
    result = (
        f"precision {found.precision:.2f} ({found.right} of {found.detections}),"
        f" recall {found.recall:.2f} ({found.found} of {found.objects})"
    )
    if not found.objects and not found.detections:
        return False, f"no {check.kind} was in view, and none was detected"
    return found.precision >= check.precision and found.recall >= check.recall, result


_FOR_VEHICLES: Mapping[type, Callable[[Any, Flight, Evidence], tuple[bool, str]]] = {
    kinds.Landed: _landed,
    kinds.NeverFlew: _never_flew,
    kinds.Reached: _reached,
    kinds.ModeReached: _mode,
    kinds.StatusText: _statustext,
    kinds.AltitudeBand: _altitude,
    kinds.SpeedLimit: _speed,
    kinds.OutsideZone: _outside,
    kinds.InsideZone: _inside,
    kinds.Battery: _battery,
    kinds.TaskDone: _task,
}
_FOR_ALL: Mapping[type, Callable[[Any, Evidence], tuple[bool, str]]] = {
    kinds.Separation: _separation,
    kinds.ProgramEnded: _program,
    kinds.CallJudged: _call,
    kinds.AuditSound: _audit,
    kinds.ApplicationPhase: _phase,
    kinds.Detections: _detections,
}

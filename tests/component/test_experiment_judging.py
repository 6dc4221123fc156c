"""Checks of experiments: each check passes or fails according to the evidence."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from fractus_sim.experiment import parse
from fractus_sim.report.track import Place, Sample
from fractus_sim.runner.check_evaluation import Evidence, evaluate_check
from fractus_sim.runner.fault_injection import Occurrence
from fractus_sim.runner.telemetry_recording import Flight, Text
from fractus_sim.testbeds.detections import ObservedObject, Score, read_detections, score_detections
from fractus_sim.testbeds.testbed import Findings
from fractus_vehicle import earth

HOME = earth.Place.from_degrees(50.0, 4.0, 0.0)


def sample(time_s: float, north: float, east: float, alt: float, **changes: Any) -> Sample:
    place = HOME.offset(north, east)
    made = Sample(time_s, Place(place.lat_e7 / 1e7, place.lon_e7 / 1e7, alt), 5.0, "GUIDED", alt > 0.3, 0.8)
    return replace(made, **changes)


def flight(name: str = "d", east: float = 0.0, **changes: Any) -> Flight:
    """Return a flight that climbs to 20 m, flies 100 m north and back, and lands. It has one sample per second."""
    legs = [
        *[sample(t, 0, east, 0) for t in range(3)],
        *[sample(3 + t, 0, east, 2.0 * t + 1) for t in range(10)],
        *[sample(13 + t, 5.0 * t, east, 20) for t in range(21)],
        *[sample(34 + t, 100 - 5.0 * t, east, 20) for t in range(21)],
        *[sample(55 + t, 0, east, 20 - 2.0 * t) for t in range(10)],
        *[sample(65 + t, 0.5, east, 0) for t in range(3)],
    ]
    made = Flight(name, legs, [Text(30.0, 4, "GPS Glitch")], [(0.0, "GUIDED"), (50.0, "RTL")], task="done")
    for field, value in changes.items():
        setattr(made, field, value)
    return made


CIRCLE = {"circle": {"center": {"lat": 50.0 + 50 / 111_319.5, "lon": 4.0 + 40 / 71_696.0}, "radius": 20}}
FAULT = Occurrence("gpsLoss", "GPS lost", "d", 45.0)


def verdict(
    check: dict[str, Any], *flights: Flight, zone: dict[str, Any] | None = None, **more: Any
) -> tuple[bool, str]:
    """Evaluate a check on flights. Return whether it holds for all vehicles, and the observed values."""
    experiment = parse(
        {
            "name": "x",
            "vehicles": [{"name": f.name, "home": {"lat": 50, "lon": 4}, "task": [{"do": "land"}]} for f in flights],
            "zones": [{"name": "z", "area": CIRCLE, **(zone or {})}],
            "faults": [{"fault": "gpsLoss", "at": 1}],
            "checks": [check],
        }
    )
    evidence = Evidence(
        {f.name: f for f in flights}, (FAULT,), {zone.name: zone for zone in experiment.zones}, Findings(**more)
    )
    verdicts = evaluate_check(experiment.checks[0], evidence)
    return all(one.holds for one in verdicts), "; ".join(one.observed for one in verdicts)


def in_the_air() -> Flight:
    return flight(samples=flight().samples[:40])


@pytest.mark.parametrize(
    ("holding", "failing"),
    [
        ({"check": "landed", "within": 66}, {"check": "landed", "within": 64}),
        ({"check": "landed", "nearHome": 1}, {"check": "landed", "nearHome": 0.2}),
        ({"check": "reached", "north": 100, "east": 0, "alt": 20}, {"check": "reached", "north": 100, "east": 9}),
        ({"check": "reached", "north": 100, "east": 0}, {"check": "reached", "north": 100, "east": 0, "within": 30}),
        ({"check": "mode", "mode": "RTL", "within": 51}, {"check": "mode", "mode": "LAND"}),
        (
            {"check": "mode", "mode": "RTL", "after": "gpsLoss", "within": 6},
            {"check": "mode", "mode": "RTL", "after": "gpsLoss", "within": 4},
        ),
        ({"check": "statustext", "matches": "^GPS"}, {"check": "statustext", "matches": "EKF"}),
        (
            {"check": "statustext", "matches": "EKF", "absent": True},
            {"check": "statustext", "matches": "GPS", "absent": True},
        ),
        ({"check": "altitude", "max": 20, "min": 20}, {"check": "altitude", "max": 19.9}),
        ({"check": "speed", "max": 5}, {"check": "speed", "max": 4.9}),
        ({"check": "outsideZone", "zone": "z", "margin": 19}, {"check": "outsideZone", "zone": "z", "margin": 21}),
        ({"check": "battery", "min": 80}, {"check": "battery", "min": 81}),
    ],
)
def test_check_holds_or_fails_as_expected(holding: dict[str, Any], failing: dict[str, Any]) -> None:
    holds, observed = verdict(holding, flight())
    assert holds, observed
    holds, observed = verdict(failing, flight())
    assert not holds, observed


def test_landed_check_fails_while_airborne_or_armed() -> None:
    assert not verdict({"check": "landed"}, in_the_air())[0]
    assert not verdict({"check": "landed"}, flight(armed_at_end=True))[0]
    assert not verdict({"check": "landed"}, flight(samples=[sample(0, 0, 0, 0)]))[0]


def test_check_fails_if_one_selected_vehicle_fails() -> None:
    assert not verdict({"check": "landed"}, flight(), flight("e", samples=flight().samples[:40]))[0]
    assert verdict({"check": "landed", "vehicles": ["d"]}, flight(), flight("e", samples=flight().samples[:40]))[0]


def test_altitude_check_fails_after_a_dip_below_the_minimum() -> None:
    dipped = flight()
    dipped.samples[30] = sample(30, 85, 0, 12)
    holds, observed = verdict({"check": "altitude", "min": 15}, dipped)
    assert not holds
    assert "12.0 m" in observed


def test_zone_checks_consider_area_and_altitude_band() -> None:
    through = flight(east=40.0)
    assert not verdict({"check": "outsideZone", "zone": "z"}, through)[0]
    above = {"altitude": {"upper": 15}}
    assert verdict({"check": "outsideZone", "zone": "z"}, through, zone=above)[0], "the flight passes above the zone"
    assert not verdict({"check": "outsideZone", "zone": "z", "margin": 6}, through, zone=above)[0]
    wide = {"area": {"circle": {"center": {"lat": 50.0, "lon": 4.0}, "radius": 120}}}
    assert verdict({"check": "insideZone", "zone": "z"}, flight(), zone=wide)[0]
    narrow = {"area": {"circle": {"center": {"lat": 50.0, "lon": 4.0}, "radius": 90}}}
    holds, observed = verdict({"check": "insideZone", "zone": "z"}, flight(), zone=narrow)
    assert not holds
    assert "m outside" in observed


def test_separation_check_compares_simultaneous_airborne_samples() -> None:
    assert verdict({"check": "separation", "min": 7.9}, flight(), flight("e", east=8.0))[0]
    holds, observed = verdict({"check": "separation", "min": 8.1}, flight(), flight("e", east=8.0))
    assert not holds
    assert "d and e" in observed
    later = [replace(s, time_s=s.time_s + 500) for s in flight().samples]
    assert verdict({"check": "separation", "min": 50}, flight(), flight("e", samples=later))[0]


def test_task_check_fails_for_an_aborted_task() -> None:
    assert verdict({"check": "task"}, flight())[0]
    holds, observed = verdict({"check": "task"}, flight(task="the autopilot changed to RTL"))
    assert not holds
    assert observed == "the autopilot changed to RTL"


CALL = {"kind": "call", "caller": "spiffe://x/component/Navigator/instance/n", "method": "Goto", "action": "deny"}


def service(check: dict[str, Any], **more: Any) -> bool:
    mode = {"mode": "cluster", "cluster": {"file": "c", "apply": ["a"]}}
    experiment = parse({"name": "x", "vehicles": [{"name": "d"}], "checks": [check], **mode})
    return evaluate_check(experiment.checks[0], Evidence({}, findings=Findings(**more)))[0].holds


def test_call_check_finds_matching_audit_entries() -> None:
    entry = {**CALL, "code": "InsideExclusionZone"}
    check = {"check": "call", "component": "Navigator", "method": "Goto", "action": "deny"}
    assert service({**check, "code": "InsideExclusionZone"}, calls=[entry])
    assert not service({**check, "code": "AltitudeAboveLimit"}, calls=[entry])
    assert not service({**check, "component": "Viewer"}, calls=[entry])
    assert not service({**check, "absent": True}, calls=[entry])
    assert service({**check, "absent": True}, audit_problems={"d/mobility.jsonl": ""})
    assert not service({**check, "absent": True}), "without any log, the calls are unknown"


def test_audit_phase_and_program_checks_fail_on_problems() -> None:
    assert service({"check": "audit"}, audit_problems={"d/mobility.jsonl": ""})
    assert not service({"check": "audit"}, audit_problems={"d/mobility.jsonl": "line 3 was changed"})
    assert not service({"check": "audit"}), "the check fails without any log"
    phase = {"check": "phase", "application": "a", "phase": "Completed"}
    assert service(phase, phases={"a": ["Running", "Completed"]})
    assert not service(phase, phases={"a": ["Running", "Failed"]})


def car(name: str, north: float, kind: str = "car") -> ObservedObject:
    at = HOME.offset(north, 0.0)
    return ObservedObject(kind, at.lat_e7 / 1e7, at.lon_e7 / 1e7, name)


def test_detections_check_compares_with_objects_in_view() -> None:
    truths = [car("a", 0), car("a", 6), car("b", 30), car("c", 60, "person")]
    detections = [car("", 1), car("", 7), car("", 50), car("", 60, "person")]
    assert score_detections(detections, truths, "car", 3.0) == Score(
        detections=3, correct_detections=2, objects=2, detected_objects=1
    )
    assert score_detections(detections, truths, "person", 3.0) == Score(1, 1, 1, 1)
    assert score_detections([], truths, "car", 3.0).precision == 1.0
    assert score_detections([], truths, "car", 3.0).recall == 0.0
    assert read_detections(['{"class": "car", "lat": 1, "lon": 2}', "no JSON", '{"class": "car"}']) == [
        ObservedObject("car", 1.0, 2.0)
    ]

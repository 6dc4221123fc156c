"""The field experiment: site, evidence from logs, and evaluation of the expectations."""

from __future__ import annotations

import functools
import json
import math
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from fractus_core.api.geometry import Point
from fractus_core.geo import geodesic_m
from fractus_sim.errors import ExperimentError
from fractus_sim.report.flight_record import JudgedCall
from fractus_sim.report.report_files import Expectation
from fractus_sim.report.track import Place, Sample, Track
from fractus_sim.scenarios.field.field_expectations import RunEvaluation
from fractus_sim.scenarios.field.field_report import field_results, write_field_report
from fractus_sim.scenarios.field.field_site import FieldSite
from fractus_sim.scenarios.scenario_evidence import Evidence, read_evidence
from fractus_sim.scenarios.scenario_site import format_position
from fractus_sim.testbeds.vehicle_settings import parse_link
from vehicle_world import alone

EXAMPLE = Path(__file__).parents[2] / "examples" / "field"
CANBERRA = (-35.3632621, 149.1652374, 584.0)
SITE = FieldSite.read(EXAMPLE)


def test_site_keeps_its_shape_at_another_home():
    moved = FieldSite.read(EXAMPLE, CANBERRA)
    assert moved.home == CANBERRA
    for name, (lat, lon, alt) in SITE.places.items():
        new_lat, new_lon, new_alt = moved.places[name]
        assert new_alt == alt
        distance_m = geodesic_m(Point(lat=SITE.home[0], lon=SITE.home[1]), Point(lat=lat, lon=lon))
        new_distance_m = geodesic_m(Point(lat=CANBERRA[0], lon=CANBERRA[1]), Point(lat=new_lat, lon=new_lon))
        assert new_distance_m == pytest.approx(distance_m, rel=0.01), name
    assert moved.zone("no-fly").area == pytest.approx(SITE.zone("no-fly").area, rel=0.01)
    assert "39.37" not in json.dumps(moved.documents), "a position was not moved"


def test_grants_contain_all_policies_or_no_policy(tmp_path: Path):
    manifests = SITE.write(tmp_path)
    restricted = SITE.grants(manifests, policies=True)
    unrestricted = SITE.grants(manifests, policies=False)
    assert {g["spec"]["component"] for g in restricted} == {"Navigator", "AerialViewer"}
    for grant in restricted:
        assert [p["name"] for p in grant["spec"]["policies"]] == [
            "keep-away",
            "low-flight",
            "no-pictures-of-the-stripe",
        ]
    for grant in unrestricted:
        assert not grant["spec"].get("policies")
        assert grant["spec"]["operationArea"][0]["circle"]["radius"] == 1000.0
    assert len(SITE.operation_area(restricted)) == 2


@pytest.mark.parametrize("text", ["udp:1.2.3.4:14550", "tcp:host", "tcp::5760", "tcp:host:99999", "5760"])
def test_autopilot_link_must_be_tcp_host_port(text: str):
    with pytest.raises(ExperimentError, match="expected tcp:HOST:PORT"):
        parse_link(text)
    assert parse_link("tcp:127.0.0.1:5760") == ("127.0.0.1", 5760)


def test_evidence_times_use_the_clock_of_the_autopilot(tmp_path: Path):
    vehicle, pilot = alone()
    path = tmp_path / "drone.tlog"
    with path.open("wb") as file:
        pilot.craft.record(file)
        pilot.craft.vehicle.state.channels[-1].set_interval("EXTENDED_SYS_STATE", 0.5)
        pilot.take_off(8.0)
        pilot.go_to(10.0, 0.0, 8.0)
        pilot.fly_on(8.0)
    moment = datetime.fromtimestamp((vehicle.config.epoch_us / 1e6) + 12.5, UTC)
    entry = {
        "kind": "call", "time": moment.isoformat(), "caller": "spiffe://fractus.dev/ns/d/app/f/component/Navigator/instance/n",
        "method": "Goto", "action": "correct", "code": "AltitudeAboveLimit", "policies": ["low-flight"], "reason": "r",
        "args": {"lat": 48.2, "lon": 16.37, "alt": 20.0}, "result": {"lat": 48.2, "lon": 16.37, "alt": 15.0},
        "lat": 48.2, "lon": 16.37, "alt": 8.0,
    }  # fmt: skip
    audit = tmp_path / "mobility.jsonl"
    audit.write_text(json.dumps(entry) + "\n" + json.dumps({"kind": "state"}) + '\n{"kind": "ca')
    evidence = read_evidence("normal", "normal", policies=True, tlog=path, audits=(audit,))
    (call,) = evidence.calls
    assert call.time_s == pytest.approx(12.5, abs=0.05)
    assert (call.caller, call.method) == ("Navigator", "Goto")
    assert call.requested == Place(48.2, 16.37, 20.0)
    assert call.flown == Place(48.2, 16.37, 15.0)
    assert evidence.track.max_altitude_m == pytest.approx(8.0, abs=0.5)
    assert evidence.track.takeoff_s is not None
    assert any("Arming motors" in text for text in evidence.texts)


# -- Expectations on synthetic flights -------------------------------------------------------------------------


def _samples(stops: list[tuple[float, float, float, str]]) -> tuple[Sample, ...]:
    """Return a flight at 5 m/s from home through (east, north, altitude, mode) positions, and back."""
    samples = []
    time_s = 0.0
    at = (0.0, 0.0, 0.0)
    for east, north, alt, mode in [*stops, (0.0, 0.0, 15.0, "RTL"), (0.0, 0.0, 0.0, "RTL")]:
        steps = max(1, round(math.dist(at, (east, north, alt)) / 1.0))
        for step in range(1, steps + 1):
            now = tuple(a + (b - a) * step / steps for a, b in zip(at, (east, north, alt), strict=True))
            time_s += 0.2
            lat, lon = SITE.frame.latlon(now[0], now[1])
            samples.append(Sample(time_s, Place(lat, lon, now[2]), 5.0, mode, now[2] > 0.3, 0.9))
        at = (east, north, alt)
    ground = replace(samples[-1], time_s=time_s + 1.0, in_air=False)
    return (replace(samples[0], time_s=0.0, in_air=False), *samples, ground)


def _at(name: str, alt: float | None = None) -> tuple[float, float, float, str]:
    lat, lon, usual = SITE.places[name]
    return (*SITE.frame.xy(lat, lon), usual if alt is None else alt, "GUIDED")


def _when(samples: tuple[Sample, ...], name: str) -> float:
    lat, lon, _ = SITE.places[name]
    return min(samples, key=lambda s: (s.place.lat - lat) ** 2 + (s.place.lon - lon) ** 2).time_s


def _goto(
    time_s: float, name: str, action: str, requested: float = 10.0, flown: float | None = None, policy: str = ""
) -> JudgedCall:
    lat, lon, _ = SITE.places[name]
    result = Place(lat, lon, requested if flown is None else flown) if action != "deny" else None
    return JudgedCall(
        time_s, "Navigator", "Goto", action, policy, policy, (policy,), Place(lat, lon, requested), result, None
    )


def _picture(samples: tuple[Sample, ...], time_s: float, action: str) -> JudgedCall:
    at = min(samples, key=lambda s: abs(s.time_s - time_s)).place
    policies = ("no-pictures-of-the-stripe",) if action == "deny" else ()
    return JudgedCall(time_s, "AerialViewer", "CaptureImage", action, "Privacy", "", policies, None, None, at)


def _system(time_s: float, action: str, code: str = "") -> JudgedCall:
    return JudgedCall(time_s, "system", action, "", code, "because", (), None, None, None)


def _pictures(samples: tuple[Sample, ...]) -> list[JudgedCall]:
    """Return a picture at each of five waypoints, and a refused picture above the stripe."""
    taken = [_picture(samples, _when(samples, name), "allow") for name in ("WP1", "WP2", "WP3", "WP4", "WP5")]
    stripe = SITE.zone("no-photo")
    frame = SITE.frame
    middle = stripe.centroid
    above = min(samples, key=lambda s: math.dist(frame.xy(s.place.lat, s.place.lon), (middle.x, middle.y)))
    return [*taken, _picture(samples, above.time_s, "deny")]


def _run(name: str, samples: tuple[Sample, ...], calls: list[JudgedCall], *, policies: bool = True) -> Evidence:
    ordered = tuple(sorted(calls, key=lambda c: c.time_s))
    return Evidence(name, name, policies, Track(name, samples), ordered, ())


UP = (0.0, 0.0, 10.0, "GUIDED")


@functools.cache
def _normal() -> Evidence:
    samples = _samples(
        [UP, _at("CTRL1"), *[_at(f"WP{n}") for n in range(1, 5)], _at("CTRL2"), *[_at(f"WP{n}") for n in range(5, 10)]]
    )
    calls = [_system(_when(samples, "CTRL1"), "granted"), _system(_when(samples, "WP9"), "over", "x")]
    return _run("normal", samples, [*calls, *_pictures(samples)])


@functools.cache
def _guarded() -> Evidence:
    stops = [
        UP,
        _at("CTRL1"),
        _at("WP1", 15.0),
        _at("WP2"),
        _at("WP3", 15.0),
        _at("WP4"),
        _at("CTRL2"),
        _at("WP5"),
        _at("WP6", 5.0),
        _at("WP7"),
    ]
    samples = _samples(stops)
    end = _when(samples, "WP7")
    calls = [
        _system(_when(samples, "CTRL1") + 0.1, "granted"),
        _goto(_when(samples, "CTRL1") + 0.2, "WP1", "correct", 20.0, 15.0, "low-flight"),
        _goto(_when(samples, "WP2"), "WP-E1", "deny", policy="operation-area"),
        _goto(_when(samples, "WP2") + 0.2, "WP3", "correct", 20.0, 15.0, "low-flight"),
        _goto(_when(samples, "WP5"), "WP6", "correct", 4.0, 5.0, "low-flight"),
        _goto(end, "WP-E2", "deny", policy="keep-away"),
        _system(end + 0.1, "revoke", "InsideExclusionZone"),
    ]
    return _run("guarded", samples, [*calls, *_pictures(samples)])


@functools.cache
def _unguarded() -> Evidence:
    stops = [
        UP,
        _at("CTRL1"),
        _at("WP1", 20.0),
        _at("WP2"),
        _at("WP-E1"),
        _at("WP3", 20.0),
        _at("WP4"),
        _at("CTRL2"),
        _at("WP5"),
        _at("WP6", 4.0),
        _at("WP7"),
        _at("WP-E2"),
        _at("WP8"),
        _at("WP9"),
    ]
    samples = _samples(stops)
    pictures = [_picture(samples, call.time_s, "allow") for call in _pictures(samples)]
    return _run("unguarded", samples, pictures, policies=False)


def _failed(expectations: list[Expectation]) -> list[str]:
    return [expectation.text for expectation in expectations if not expectation.holds]


def test_expectations_hold_for_correct_flights():
    assert _failed(RunEvaluation(SITE, _normal()).normal()) == []
    assert _failed(RunEvaluation(SITE, _guarded()).guarded()) == []
    assert _failed(RunEvaluation(SITE, _unguarded()).unguarded()) == []


def _later(run: Evidence, method: str, action: str) -> Evidence:
    call = _goto(run.calls[-1].time_s + 2.0, "WP8", action)
    return replace(run, calls=(*run.calls, replace(call, method=method)))


def test_program_may_request_control_but_not_fly_after_a_takeover():
    assert _failed(RunEvaluation(SITE, _later(_guarded(), "GetControl", "allow")).guarded()) == []
    for action in ("allow", "correct"):
        failed = _failed(RunEvaluation(SITE, _later(_guarded(), "Goto", action)).guarded())
        assert failed == ["no call of the program is executed after the takeover"]


def test_flight_without_policies_fails_the_expectations_with_policies():
    failed = _failed(RunEvaluation(SITE, _unguarded()).guarded())
    for part in (
        "WP1, requested",
        "WP6, requested",
        "above 15",
        "WP-E1 is",
        "WP-E2",
        "no-fly",
        "no picture is taken above",
    ):
        assert any(part in text for text in failed), part


def _without(run: Evidence, *methods: str) -> Evidence:
    return replace(run, calls=tuple(c for c in run.calls if c.method not in methods))


def _changed(run: Evidence, place: str, **changes: object) -> Evidence:
    lat, lon, _ = SITE.places[place]
    calls = [
        replace(c, **changes) if c.requested is not None and (c.requested.lat, c.requested.lon) == (lat, lon) else c  # type: ignore[arg-type]
        for c in run.calls
    ]
    return replace(run, calls=tuple(calls))


@pytest.mark.parametrize(
    ("incorrect", "text"),
    [
        (_without(_guarded(), "revoke"), "revokes the control"),
        (_without(_guarded(), "CaptureImage"), "pictures are taken"),
        (_changed(_guarded(), "WP-E1", action="allow"), "discarded"),
        (_changed(_guarded(), "WP3", action="deny"), "continues"),
        (_changed(_guarded(), "WP1", flown=Place(0.0, 0.0, 17.0)), "WP1, requested"),
        (_changed(_guarded(), "WP6", flown=Place(0.0, 0.0, 4.2)), "WP6, requested"),
        (replace(_guarded(), track=Track("x", _guarded().track.samples[:-40])), "lands at home"),
    ],
)
def test_expectation_fails_for_an_incorrect_flight(incorrect: Evidence, text: str):
    assert any(text in failed for failed in _failed(RunEvaluation(SITE, incorrect).guarded()))


def test_field_report_is_written_with_page_results_and_figures(tmp_path: Path):
    runs = [_normal(), _guarded(), _unguarded()]
    expectations = RunEvaluation(SITE, runs[1]).guarded()
    write_field_report(SITE, runs, expectations, "synthetic vehicles", tmp_path)
    page = (tmp_path / "summary.md").read_text()
    assert f"All {len(expectations)} expectations hold" in page
    assert "| guarded | WP6 | 4 m | 5.0 m |" in page
    results = json.loads((tmp_path / "report.json").read_text())
    assert results == json.loads(json.dumps(field_results(SITE, runs, expectations, "synthetic vehicles")))
    assert results["runs"][1]["corrected"] == 3
    for name in ("map.png", "altitude.png"):
        assert (tmp_path / name).stat().st_size > 20_000


def test_position_is_formatted_as_lat_lon_alt():
    assert format_position((39.37, 22.93, 10.0)) == "39.3700000,22.9300000,10"

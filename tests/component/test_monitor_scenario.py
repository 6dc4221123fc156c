"""The monitor scenario: its independent intersection, its expectations on synthetic flights, and its report."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import shapely
from fractus_sim.report.flight_record import JudgedCall
from fractus_sim.report.track import Place, Sample, Track
from fractus_sim.scenarios.monitor.monitor_expectations import border_intersection, evaluate_run
from fractus_sim.scenarios.monitor.monitor_report import write_monitor_report
from fractus_sim.scenarios.monitor.monitor_site import DRIVER, EXAMPLE, PHOTOGRAPHER, MonitorSite
from fractus_sim.scenarios.scenario_evidence import Evidence
from PIL import Image

SITE = MonitorSite.read(EXAMPLE)
CLEARANCE_M = 1.5
PLACES = {name: Place(*position) for name, position in SITE.places.items()}
C1 = border_intersection(SITE, PLACES["WP2"], PLACES["WP-E1"], CLEARANCE_M)
C2 = border_intersection(SITE, PLACES["WP3"], PLACES["WP-E2"], CLEARANCE_M)
HOME = Place(SITE.home[0], SITE.home[1], 0.0)


def flown(*stops: Place) -> tuple[Sample, ...]:
    """Return the samples of a flight from home over some positions at 5 m/s, and of the landing at the last one."""
    points = [(0.0, 0.0), *[SITE.frame.xy(stop.lat, stop.lon) for stop in stops]]
    samples = [Sample(0.0, HOME, 0.0, "GUIDED", False, 1.0)]
    for start, end in itertools.pairwise(points):
        steps = max(1, round(math.dist(start, end)))
        for step in range(1, steps + 1):
            east, north = (a + (b - a) * step / steps for a, b in zip(start, end, strict=True))
            place = Place(*SITE.frame.latlon(east, north), 15.0)
            samples.append(Sample(samples[-1].time_s + 0.2, place, 5.0, "GUIDED", True, 1.0))
    samples.append(replace(samples[-1], time_s=samples[-1].time_s + 10.0, in_air=False))
    return tuple(samples)


def when(samples: tuple[Sample, ...], place: Place) -> float:
    """Return the time at which a flight is closest to a position."""
    return min(samples, key=lambda s: math.hypot(s.place.lat - place.lat, s.place.lon - place.lon)).time_s


def goto(time_s: float, name: str, action: str = "allow", *, at: Place = HOME, to: Place | None = None) -> JudgedCall:
    """Return a request of the program for a named position."""
    result = None if action == "takeover" else to or PLACES[name]
    return JudgedCall(time_s, DRIVER, "Goto", action, "", "", (), PLACES[name], result, at)


def pictures(samples: tuple[Sample, ...], *, policies: bool) -> list[JudgedCall]:
    """Return a picture every 4 s. With policies, those within 15 m of the no-photo zone are refused."""
    calls = []
    for sample in samples[1:-1:20]:
        near = SITE.zone("no-photo").buffer(15.0).contains(_point(sample.place))
        action = "deny" if policies and near else "allow"
        calls.append(
            JudgedCall(sample.time_s, PHOTOGRAPHER, "CaptureImage", action, "", "", (), None, None, sample.place)
        )
    return calls


def _point(place: Place) -> shapely.Point:
    return shapely.Point(SITE.frame.xy(place.lat, place.lon))


def monitored() -> Evidence:
    """Return the flight that the policies permit the deviating program."""
    samples = flown(PLACES["WP1"], PLACES["WP2"], C1, PLACES["WP3"], C2, PLACES["WP4"])
    abort_s = when(samples, C2) + 0.1
    calls = (
        goto(when(samples, PLACES["WP2"]), "WP-E1", "correct", at=PLACES["WP2"], to=C1),
        goto(when(samples, PLACES["WP3"]), "WP-E2", "correct", at=PLACES["WP3"], to=C2),
        goto(abort_s, "WP-E3", "takeover", at=C2),
        JudgedCall(abort_s, "system", "landAt", "", "", "", (), None, None, C2),
    )
    return Evidence("monitored", "with policies", True, Track("", samples), calls, (), ((0.0, 0.3),))


def declared(name: str, *, policies: bool) -> Evidence:
    """Return the flight of the program that stays on its course."""
    samples = flown(*[PLACES[f"WP{number}"] for number in range(1, 5)])
    start = goto(when(samples, PLACES["WP2"]), "WP3", at=PLACES["WP2"])
    return Evidence(
        name, name, policies, Track("", samples), (start, *pictures(samples, policies=policies)), (), ((0.0, 0.3),)
    )


def unmonitored() -> Evidence:
    """Return the flight of the deviating program without policies."""
    names = ("WP1", "WP2", "WP-E1", "WP3", "WP-E2", "WP-E3", "WP4")
    return Evidence("unmonitored", "", False, Track("", flown(*[PLACES[name] for name in names])), (), ())


def failed(run: Evidence) -> list[str]:
    return [expectation.text for expectation in evaluate_run(SITE, run) if not expectation.holds]


def test_intersection_keeps_the_clearance_from_the_border():
    for corrected in (C1, C2):
        assert SITE.zone("course").exterior.distance(_point(corrected)) == pytest.approx(CLEARANCE_M, abs=0.02)
        assert SITE.zone("course").contains(_point(corrected))


def test_expectations_hold_for_correct_flights():
    runs = (
        monitored(),
        unmonitored(),
        declared("declared", policies=True),
        declared("pictures", policies=False),
    )
    assert [failed(run) for run in runs] == [[], [], [], []]


def moved(place: Place, metres: float) -> Place:
    return replace(place, lat=place.lat + metres / 111_320.0)


@pytest.mark.parametrize(
    ("run", "text"),
    [
        (replace(unmonitored(), name="monitored"), "C1"),
        (replace(unmonitored(), name="monitored"), "never enters the no-fly zone"),
        (replace(unmonitored(), name="monitored"), "never leaves the course"),
        (replace(monitored(), calls=monitored().calls[:3]), "aborts the program"),
        (
            replace(monitored(), calls=(replace(monitored().calls[0], flown=moved(C1, 0.6)), *monitored().calls[1:])),
            "C1, flown",
        ),
        (replace(monitored(), track=Track("", monitored().track.samples[:-40])), "lands at WP4"),
        (replace(monitored(), name="unmonitored"), "WP-E1"),
        (replace(declared("declared", policies=False)), "no picture is taken above"),
        (replace(declared("pictures", policies=True)), "no picture is suppressed"),
    ],
)
def test_expectation_fails_for_an_incorrect_flight(run: Evidence, text: str):
    assert any(text in name for name in failed(run))


def test_expectation_fails_if_a_picture_far_from_the_zone_is_suppressed():
    run = declared("declared", policies=True)
    calls = tuple(replace(c, action="deny") if c.method == "CaptureImage" else c for c in run.calls)
    assert failed(replace(run, calls=calls)) == ["all other pictures are kept"]


def test_monitor_report_contains_verdicts_and_pictures(tmp_path: Path):
    folder = tmp_path / "pictures" / "photographer"
    folder.mkdir(parents=True)
    Image.new("RGB", (64, 36), (10, 200, 30)).save(folder / "0001.jpg")
    runs = [monitored(), declared("pictures", policies=False)]
    expectations = [expectation for run in runs for expectation in evaluate_run(SITE, run)]
    write_monitor_report(SITE, runs, expectations, "synthetic vehicles", tmp_path)
    page = (tmp_path / "summary.md").read_text()
    assert f"All {len(expectations)} expectations hold" in page
    assert "| with policies | WP-E1 | correct |" in page
    assert "| with policies | WP-E3 | takeover | - |" in page
    results = json.loads((tmp_path / "report.json").read_text())
    assert results["holds"]
    assert [target["position"] for target in results["runs"][0]["targets"]] == ["WP-E1", "WP-E2", "WP-E3"]
    for name in ("map.png", "pictures.png"):
        assert (tmp_path / name).stat().st_size > 1_000

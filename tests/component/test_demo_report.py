"""The report of a mission, from a synthetic record."""

from __future__ import annotations

import base64
import copy
import json
import re
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import demo_flight
import pytest
import yaml
from fractus_core.api import DeploymentPlan
from fractus_sim.report.flight_record import FlightRecord
from fractus_sim.report.html_page import html_page
from fractus_sim.report.mission_report import (
    mission_geojson,
    mission_map,
    mission_page,
    mission_results,
    write_mission_report,
)

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="module")
def record() -> FlightRecord:
    return FlightRecord.of(demo_flight.content(), demo_flight.audit())


@pytest.fixture(scope="module")
def written(record: FlightRecord, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    write_mission_report(record, folder)
    return folder


def test_flight_metrics_are_computed_from_the_record(record: FlightRecord) -> None:
    assert record.track.max_altitude_m == pytest.approx(50.0, abs=0.2)
    assert record.track.distance_m == pytest.approx(796, abs=5), "distance is the sum of the geodesic leg lengths"
    assert record.track.takeoff_s == pytest.approx(demo_flight.TAKEOFF_S)
    assert record.track.landing_s is not None
    assert 100 < record.track.landing_s - record.track.takeoff_s < 110


def test_repeated_policy_decisions_are_merged(record: FlightRecord) -> None:
    decisions = [(call.caller, call.method, call.action, call.policies[0], call.count) for call in record.decisions]
    assert decisions == [
        ("Navigator", "SetSpeed", "correct", "town-speed", 1),
        ("Navigator", "Goto", "deny", "no-fly-hospital", 1),
        ("Navigator", "Goto", "correct", "town-altitude", 1),
        ("AerialViewer", "CaptureImage", "deny", "no-pictures-of-the-schoolyard", 2),
    ]
    corrected = record.decisions[2]
    assert corrected.requested is not None
    assert corrected.flown is not None
    assert (corrected.requested.alt_m, corrected.flown.alt_m) == (70.0, 50.0)


def test_repeated_denial_is_listed_again_after_a_minute() -> None:
    refused = [e for e in demo_flight.calls() if e.get("method") == "CaptureImage"]
    later = {**refused[0], "time": demo_flight.stamp(demo_flight.TAKEOFF_S + 300)}
    record = FlightRecord.of(demo_flight.content(), [*refused, later])
    assert [call.count for call in record.decisions] == [2, 1]


def test_takeover_is_listed_among_the_requests() -> None:
    takeover = {
        "kind": "takeover",
        "time": demo_flight.stamp(demo_flight.TAKEOFF_S + 40),
        "action": "returnToLaunch",
        "code": "ZoneEntered",
        "reason": "zone hospital appeared around the drone",
        "policies": ["no-fly-hospital"],
        "lat": 50.8653,
        "lon": 4.6797,
        "alt": 20.0,
    }
    record = FlightRecord.of(demo_flight.content(), [*demo_flight.states(), takeover])
    (takeover_call,) = record.decisions
    assert (takeover_call.caller, takeover_call.method, takeover_call.action) == (
        "the system",
        "returnToLaunch",
        "takeover",
    )
    assert "| the system | returnToLaunch | taken over | no-fly-hospital |" in mission_page(record)


def test_page_shows_corrections_refusals_placements_and_the_audit_log(record: FlightRecord) -> None:
    page = mission_page(record)
    assert page.startswith("# Flight of traffic-monitoring\n\n**Completed.** drone-1 flew 79")
    assert "policies corrected 2 and refused 3." in page
    for row in (
        "| Goto 50.865633, 4.680631, 70 m | corrected | town-altitude | AltitudeAboveLimit: ",
        "| Goto 50.865992, 4.679565, 20 m | refused | no-fly-hospital, operation-area | InsideExclusionZone: ",
        "| CaptureImage (x2) | refused | no-pictures-of-the-schoolyard |",
        "| ImageChecker | edge-3 | NoCoverage: ",
        "| DataStore | any cloud node x3 | base in the cloud |",
        "| all pods Running | 11.0 s |",
    ):
        assert row in page
    assert "40 entries on the drone, 9 of this mission. The hash chain is valid." in page
    assert max(map(len, page.splitlines())) < 400


def test_broken_audit_chain_is_reported_prominently(record: FlightRecord) -> None:
    broken = replace(record, audit={"entries": 3, "kept": 3, "problem": "line 2 was changed after it was written"})
    assert "**The hash chain is broken: line 2 was changed after it was written.**" in mission_page(broken)


def test_direct_links_are_listed_and_drawn(record: FlightRecord) -> None:
    assert "## Direct links" not in mission_page(record)
    at_s = demo_flight.TAKEOFF_S + 20.0
    changes = [
        {"time": at_s, "node": "edge-1", "traffic": "direct", "why": "the direct link scores 12, the present path 8"},
        {"time": at_s + 9.0, "node": "edge-1", "traffic": "cloud", "why": "the direct link is about to be left"},
    ]
    linked = FlightRecord.of({**demo_flight.content(), "links": changes}, demo_flight.audit())
    page = mission_page(linked)
    assert "| edge-1 | WiFi | the direct link scores 12, the present path 8 |" in page
    assert "| edge-1 | back to the cloud | the direct link is about to be left |" in page
    ((_, node_position),) = mission_map(linked).links
    assert node_position == next(node.position for node in mission_map(linked).nodes if node.name == "edge-1")
    assert [link["direct"] for link in mission_results(linked)["links"]] == [True, False]


def test_json_results_match_the_page(record: FlightRecord) -> None:
    results = mission_results(record)
    assert (results["corrected"], results["refused"], results["calls"]) == (2, 3, 7)
    assert results["landed"] is True
    assert results["landed_from_home_m"] < 1.0
    assert results["times"]["planned"] == 0.8
    assert results["judgements"][1]["code"] == "InsideExclusionZone"
    assert json.loads(json.dumps(results)) == results


def test_geojson_contains_all_objects_as_longitude_latitude(record: FlightRecord) -> None:
    collection = mission_geojson(record)
    by_kind: dict[str, list[Any]] = {}
    for feature in collection["features"]:
        by_kind.setdefault(feature["properties"]["what"], []).append(feature)
    path = by_kind["path"][0]
    assert path["geometry"]["coordinates"][0][:2] == [4.6785, 50.8637]
    assert len(path["geometry"]["coordinates"]) == len(path["properties"]["times"])
    assert {f["properties"]["name"] for f in by_kind["zone"]} == {"town", "hospital", "schoolyard", "riverside"}
    assert {f["properties"]["name"] for f in by_kind["edgeNode"]} == {"edge-1", "edge-2", "edge-3"}
    assert [f["properties"]["number"] for f in by_kind["refused"]] == [2, 4]
    assert [f["properties"]["number"] for f in by_kind["corrected"]] == [1, 3]
    assert by_kind["operationArea"]
    assert by_kind["depot"]


def test_all_report_files_are_written(written: Path) -> None:
    names = {path.name for path in written.iterdir()}
    assert names == {
        "summary.md",
        "report.json",
        "flight.geojson",
        "plan.yaml",
        "map.png",
        "altitude.png",
        "report.html",
    }
    for figure in ("map.png", "altitude.png"):
        content = (written / figure).read_bytes()
        assert content.startswith(PNG)
        assert len(content) > 20_000
    assert DeploymentPlan.from_body(yaml.safe_load((written / "plan.yaml").read_text())).spec.placements


def test_html_page_contains_figures_and_no_reference_to_other_files(written: Path) -> None:
    page = (written / "report.html").read_text()
    figures = [base64.b64encode((written / name).read_bytes()).decode() for name in ("map.png", "altitude.png")]
    assert re.findall(r' src="([^"]*)"', page) == [f"data:image/png;base64,{figure}" for figure in figures]
    assert "href=" not in page
    assert "<table>" in page
    assert "no-fly-hospital" in page


def test_html_page_escapes_texts_of_components_and_embeds_no_files_that_they_name(tmp_path: Path) -> None:
    (tmp_path / "secret.jpg").write_bytes(b"secret")
    text = "![x](secret.jpg) ![y](https://example.com/y.png) <script>alert(1)</script>"
    page = html_page("<b>", summary=text, figures=(), sections=text, pictures={}, folder=tmp_path)
    assert "<script>" not in page
    assert "<title>&lt;b&gt;</title>" in page
    assert base64.b64encode(b"secret").decode() not in page
    assert "default-src 'none'; img-src data:" in page


def test_html_page_embeds_each_image_only_where_the_report_places_it(tmp_path: Path) -> None:
    for name in ("map.png", "a.jpg"):
        (tmp_path / name).write_bytes(name.encode())
    text = "![x](map.png) ![y](a.jpg) ![z](a.jpg)"
    page = html_page("t", summary=text, figures=["map.png"], sections=text, pictures={"a.jpg": "12 m"}, folder=tmp_path)
    images = [("image/png", b"map.png"), ("image/jpeg", b"a.jpg")]
    assert re.findall(r'src="([^"]*)"', page) == [
        f"data:{kind};base64,{base64.b64encode(d).decode()}" for kind, d in images
    ]
    assert "<p>12 m</p>" in page
    assert "href=" not in page


def test_report_is_deterministic(record: FlightRecord, written: Path, tmp_path: Path) -> None:
    write_mission_report(record, tmp_path)
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == {p.name: p.read_bytes() for p in written.iterdir()}


def test_policies_for_other_drones_are_not_drawn(record: FlightRecord) -> None:
    assert "no-heavy-drones-at-the-riverside" not in {p.name for p in record.policies_in_force}
    assert "no-fly-hospital" in {p.name for p in record.policies_in_force}


@pytest.mark.parametrize(
    ("selection", "drawn"),
    [
        ({"action": "abort"}, (10.0, 20.0)),
        ({"action": "abort", "landAt": {"north": 30.0, "east": 40.0}}, (30.0, 40.0)),
        ({"action": "returnToLaunch"}, None),
        (None, None),
    ],
)
def test_landing_place_of_a_selected_policy_is_drawn(
    selection: dict[str, Any] | None, drawn: tuple[float, float] | None, record: FlightRecord
) -> None:
    def place(north_m: float, east_m: float) -> dict[str, float]:
        lat, lon = record.frame.latlon(east_m, north_m)
        return {"lat": lat, "lon": lon}

    content = copy.deepcopy(demo_flight.content())
    for body in content["objects"]:
        if body["kind"] == "Application" and selection is not None:
            own = (
                {"landAt": place(**{f"{k}_m": v for k, v in selection["landAt"].items()})}
                if "landAt" in selection
                else {}
            )
            body["spec"]["policyActions"] = [{"policy": "no-fly-hospital", "action": selection["action"], **own}]
        if body["metadata"]["name"] == "no-fly-hospital":
            body["spec"] |= {"choices": ["abort", "returnToLaunch"], "landAt": place(10.0, 20.0)}
    landings = dict(mission_map(FlightRecord.of(content, demo_flight.audit())).landings)
    if drawn is None:
        assert landings == {}
    else:
        assert landings["landing (no-fly-hospital)"] == pytest.approx((drawn[1], drawn[0]), abs=0.01)


def test_report_of_a_mission_without_flight_is_written(tmp_path: Path) -> None:
    content = demo_flight.content()
    application = {**content["objects"][0], "status": {"phase": "Failed", "message": "no drone can fly it"}}
    content["objects"] = [application, *(o for o in content["objects"][1:] if o["kind"] != "DeploymentPlan")]
    record = FlightRecord.of({**content, "pods": [], "audit": {}}, [])
    write_mission_report(record, tmp_path)
    page = (tmp_path / "summary.md").read_text()
    assert "**Failed.** No drone did not fly" not in page
    assert "did not fly" in page
    assert "no drone can fly it" in page
    assert "No audit log was collected" in page
    assert not (tmp_path / "plan.yaml").exists()


def test_landing_time_is_none_while_in_the_air(record: FlightRecord) -> None:
    flying = replace(record, samples=record.samples[:100])
    assert flying.track.landing_s is None
    assert "is still in the air" in mission_page(flying)


def test_record_is_read_from_the_files_of_the_demo(tmp_path: Path, record: FlightRecord) -> None:
    (tmp_path / "objects.json").write_text(json.dumps(demo_flight.content()))
    lines = "".join(json.dumps(entry) + "\n" for entry in demo_flight.audit())
    earlier = json.dumps({**demo_flight.calls()[0], "time": demo_flight.stamp(demo_flight.APPLIED_S - 60)}) + "\n"
    (tmp_path / "audit").mkdir()
    (tmp_path / "audit" / "mobility.000000000001.jsonl").write_text(earlier)
    (tmp_path / "audit" / "mobility.jsonl").write_text(lines + '{"time": "2027-')
    choice = {
        "kind": "choice",
        "time": demo_flight.stamp(demo_flight.APPLIED_S + 60),
        "peer": "edge-1",
        "code": "Connect",
    }
    (tmp_path / "audit" / "links.jsonl").write_text(json.dumps(choice) + "\n")
    assert mission_results(FlightRecord.read(tmp_path)) == mission_results(record)
    assert "camera saw" not in mission_page(record)


def test_page_shows_pictures_with_time_and_altitude(tmp_path: Path, record: FlightRecord) -> None:
    highest = max(record.samples, key=lambda sample: sample.place.alt_m)
    name = datetime.fromtimestamp(highest.time_s, UTC).strftime("%Y%m%d%H%M%S%f")[:17] + "-0007.jpg"
    (tmp_path / "objects.json").write_text(json.dumps(demo_flight.content()))
    (tmp_path / "audit").mkdir()
    (tmp_path / "audit" / "mobility.jsonl").write_text("".join(json.dumps(e) + "\n" for e in demo_flight.audit()))
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / name).touch()
    page = mission_page(FlightRecord.read(tmp_path))
    assert f"![from the drone](pictures/{name})" in page
    assert "UTC, 50 m above home |" in page

"""The report of a flight, from a synthetic record of one."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import demo_flight
import pytest
import yaml
from fractus_core.api import DeploymentPlan
from fractus_sim.report import Record, write_report
from fractus_sim.report.mission_report import features, figures, scene_of, summary

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="module")
def record() -> Record:
    return Record.of(demo_flight.content(), demo_flight.audit())


@pytest.fixture(scope="module")
def written(record: Record, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    write_report(record, folder)
    return folder


def test_flight_metrics_are_computed_from_the_record(record: Record) -> None:
    assert record.track.max_altitude_m == pytest.approx(50.0, abs=0.2)
    assert record.track.distance_m == pytest.approx(796, abs=5), "the sum of the legs, geodesic"
    assert record.takeoff_s == pytest.approx(demo_flight.TAKEOFF_S)
    assert record.landing_s is not None
    assert 100 < record.landing_s - record.takeoff_s < 110


def test_repeated_policy_decisions_are_merged(record: Record) -> None:
    told = [(j.component, j.method, j.action, j.policies[0], j.count) for j in record.judgements]
    assert told == [
        ("Navigator", "SetSpeed", "correct", "town-speed", 1),
        ("Navigator", "Goto", "deny", "no-fly-hospital", 1),
        ("Navigator", "Goto", "correct", "town-altitude", 1),
        ("AerialViewer", "CaptureImage", "deny", "no-pictures-of-the-schoolyard", 2),
    ]
    corrected = record.judgements[2]
    assert corrected.asked is not None
    assert corrected.flown is not None
    assert (corrected.asked.alt_m, corrected.flown.alt_m) == (70.0, 50.0)


def test_repeated_denial_is_listed_again_after_a_minute() -> None:
    refused = [e for e in demo_flight.calls() if e.get("method") == "CaptureImage"]
    later = {**refused[0], "time": demo_flight.stamp(demo_flight.TAKEOFF_S + 300)}
    record = Record.of(demo_flight.content(), [*refused, later])
    assert [j.count for j in record.judgements] == [2, 1]


def test_takeover_is_listed_with_the_requests() -> None:
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
    record = Record.of(demo_flight.content(), [*demo_flight.states(), takeover])
    (told,) = record.judgements
    assert (told.component, told.method, told.action) == ("the system", "returnToLaunch", "takeover")
    assert "| the system | returnToLaunch | taken over | no-fly-hospital |" in summary(record)


def test_the_page_shows_corrections_refusals_placements_and_the_chain(record: Record) -> None:
    page = summary(record)
    assert page.startswith("# Flight of traffic-monitoring\n\n**Completed.** drone-1 flew 79")
    assert "policies corrected 2 and refused 3. 0 pictures were checked and kept" in page
    for row in (
        "| Goto 50.865633, 4.680631, 70 m | corrected | town-altitude | AltitudeAboveLimit: ",
        "| Goto 50.865992, 4.679565, 20 m | refused | no-fly-hospital, operation-area | InsideExclusionZone: ",
        "| CaptureImage (x2) | refused | no-pictures-of-the-schoolyard |",
        "| ImageChecker | edge-3 | NoCoverage: ",
        "| DataStore | any cloud node x3 | base in the cloud |",
        "| all pods Running | 11.0 s |",
    ):
        assert row in page
    assert "40 entries on the drone, 9 of this mission; the chain is sound" in page
    assert max(map(len, page.splitlines())) < 400


def test_broken_audit_chain_is_reported_prominently(record: Record) -> None:
    broken = replace(record, audit={"entries": 3, "kept": 3, "problem": "line 2 was changed after it was written"})
    assert "**broken: line 2 was changed after it was written**" in summary(broken)


def test_direct_links_are_listed_and_drawn(record: Record) -> None:
    assert "## Direct links" not in summary(record)
    at_s = demo_flight.TAKEOFF_S + 20.0
    changes = [
        {"time": at_s, "node": "edge-1", "traffic": "direct", "why": "the direct link scores 12, the present path 8"},
        {"time": at_s + 9.0, "node": "edge-1", "traffic": "cloud", "why": "the direct link is about to be left"},
    ]
    linked = Record.of({**demo_flight.content(), "links": changes}, demo_flight.audit())
    page = summary(linked)
    assert "| edge-1 | by WiFi | the direct link scores 12, the present path 8 |" in page
    assert "| edge-1 | by the cloud again | the direct link is about to be left |" in page
    ((_, there),) = scene_of(linked).links
    assert there == next(node.at for node in scene_of(linked).nodes if node.name == "edge-1")
    assert [link["direct"] for link in figures(linked)["links"]] == [True, False]


def test_json_results_match_the_page(record: Record) -> None:
    found = figures(record)
    assert (found["corrected"], found["refused"], found["calls"]) == (2, 3, 7)
    assert found["landed"] is True
    assert found["landed_from_home_m"] < 1.0
    assert found["times"]["planned"] == 0.8
    assert found["judgements"][1]["code"] == "InsideExclusionZone"
    assert json.loads(json.dumps(found)) == found


def test_geojson_is_lon_lat_and_complete(record: Record) -> None:
    collection = features(record)
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
    assert names == {"summary.md", "report.json", "flight.geojson", "plan.yaml", "map.png", "altitude.png"}
    for picture in ("map.png", "altitude.png"):
        content = (written / picture).read_bytes()
        assert content.startswith(PNG)
        assert len(content) > 20_000
    assert DeploymentPlan.from_body(yaml.safe_load((written / "plan.yaml").read_text())).spec.placements


def test_report_is_deterministic(record: Record, written: Path, tmp_path: Path) -> None:
    write_report(record, tmp_path)
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == {p.name: p.read_bytes() for p in written.iterdir()}


def test_policies_for_other_drones_are_not_drawn(record: Record) -> None:
    assert "no-heavy-drones-at-the-riverside" not in {p.name for p in record.policies_in_force}
    assert "no-fly-hospital" in {p.name for p in record.policies_in_force}


def test_report_of_a_mission_without_flight_is_written(tmp_path: Path) -> None:
    content = demo_flight.content()
    application = {**content["objects"][0], "status": {"phase": "Failed", "message": "no drone can fly it"}}
    content["objects"] = [application, *(o for o in content["objects"][1:] if o["kind"] != "DeploymentPlan")]
    record = Record.of({**content, "pods": [], "audit": {}}, [])
    write_report(record, tmp_path)
    page = (tmp_path / "summary.md").read_text()
    assert "**Failed.** No drone did not fly" not in page
    assert "did not fly" in page
    assert "no drone can fly it" in page
    assert "None was collected" in page
    assert not (tmp_path / "plan.yaml").exists()


def test_landing_time_is_none_while_in_the_air(record: Record) -> None:
    flying = replace(record, samples=record.samples[:100])
    assert flying.landing_s is None
    assert "is still in the air" in summary(flying)


def test_a_record_is_read_from_the_files_of_the_demo(tmp_path: Path, record: Record) -> None:
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
    assert figures(Record.read(tmp_path)) == figures(record)
    assert "camera saw" not in summary(record)


def test_the_page_shows_pictures_with_time_and_height(tmp_path: Path, record: Record) -> None:
    high = max(record.samples, key=lambda sample: sample.place.alt_m)
    name = datetime.fromtimestamp(high.time_s, UTC).strftime("%Y%m%d%H%M%S%f")[:17] + "-0007.jpg"
    (tmp_path / "objects.json").write_text(json.dumps(demo_flight.content()))
    (tmp_path / "audit").mkdir()
    (tmp_path / "audit" / "mobility.jsonl").write_text("".join(json.dumps(e) + "\n" for e in demo_flight.audit()))
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / name).touch()
    page = summary(Record.read(tmp_path))
    assert f"![from the drone](pictures/{name})" in page
    assert "UTC, 50 m above home |" in page

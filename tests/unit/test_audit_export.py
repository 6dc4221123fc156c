"""Commands `fractus audit show`, `export` and `verify`. Independent readers check each exported format."""

from __future__ import annotations

import csv
import io
import json
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import demo_flight
import pytest
import shapely.geometry
from click.testing import CliRunner, Result
from fractus_cli.audit import audit
from fractus_core.api.names import component_identity
from fractus_runtime.audit import AuditLog
from mcap.reader import make_reader

TAKEOVER = {
    "kind": "takeover", "time": demo_flight.stamp(demo_flight.TAKEOFF_S + 70), "action": "return", "controller": "system",
    "reason": "the driver left the zone", "code": "LeftZone", "policies": ["town-altitude"], "lat": 50.865, "lon": 4.68, "alt": 30.0,
}  # fmt: skip
MONITOR = {
    "kind": "monitor", "time": demo_flight.stamp(demo_flight.TAKEOFF_S + 20), "action": "correct", "code": "SpeedAboveLimit",
    "reason": "<too> fast & low", "policies": ["town-speed"], "mode": "GUIDED",
}  # fmt: skip
DRIVER = component_identity("default", "patrol", "Navigator", "patrol-navigator")
ZONES = demo_flight.EXAMPLE / "zones.yaml"


@pytest.fixture(scope="module")
def entries() -> list[dict[str, Any]]:
    started = {"kind": "started", "time": demo_flight.stamp(demo_flight.APPLIED_S), "node": "drone-1"}
    states = [state | {"amsl": state["alt"] + 100.0, "controller": DRIVER} for state in demo_flight.states()]
    return sorted([started, *demo_flight.calls(), *states, TAKEOVER, MONITOR], key=lambda entry: str(entry["time"]))


@pytest.fixture
async def log(tmp_path: Path, entries: list[dict[str, Any]]) -> Path:
    """Audit log of a flight, written by AuditLog."""
    return await write_log(tmp_path / "audit" / "mobility.jsonl", entries)


async def write_log(path: Path, entries: list[dict[str, Any]]) -> Path:
    now = 0.0
    writer = AuditLog(path, lambda: now)
    for entry in entries:
        now = datetime.fromisoformat(entry["time"]).timestamp()
        writer.append(entry["kind"], {key: value for key, value in entry.items() if key not in {"kind", "time"}})
    await writer.close()
    return path


def run(*arguments: object) -> Result:
    result = CliRunner().invoke(audit, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output
    return result


def test_geojson_has_path_decisions_takeovers_and_zones(log: Path, entries: list[dict[str, Any]]) -> None:
    result = run("export", log, "--to", "geojson", "--zones", ZONES)
    assert not result.stderr
    collection = json.loads(result.stdout)
    assert (collection["type"], collection["verified"]) == ("FeatureCollection", True)
    features_of = {
        kind: [f for f in collection["features"] if f["properties"]["kind"] == kind]
        for kind in ("path", "call", "takeover", "zone")
    }
    states = [entry for entry in entries if entry["kind"] == "state"]
    (path,) = features_of["path"]
    line = shapely.geometry.shape(path["geometry"])
    assert line.geom_type == "LineString" and len(line.coords) == len(states) == len(path["properties"]["times"])
    assert line.coords[0] == (demo_flight.HOME[1], demo_flight.HOME[0], 100.0), "lon, lat, metres above sea level"
    assert [f["properties"]["code"] for f in features_of["call"]].count("MethodDenied") == 2
    assert not any(f["properties"].get("action") == "allow" for f in collection["features"]), (
        "permitted calls are not exported"
    )
    (takeover,) = features_of["takeover"]
    assert takeover["geometry"]["coordinates"] == [4.68, 50.865, 130.0]
    assert takeover["properties"]["reason"] == "the driver left the zone"
    names = {f["properties"]["name"]: shapely.geometry.shape(f["geometry"]) for f in features_of["zone"]}
    assert names and all(shape.is_valid and shape.area > 0 for shape in names.values())


async def test_path_across_the_antimeridian_is_cut_in_geojson_and_kml(
    tmp_path: Path, entries: list[dict[str, Any]]
) -> None:
    middle = sum(e["lon"] for e in entries if e["kind"] == "state") / sum(e["kind"] == "state" for e in entries)
    moved = [
        entry | {"lon": (entry["lon"] - middle + 360.0) % 360.0 - 180.0} if "lon" in entry else entry
        for entry in entries
    ]
    log = await write_log(tmp_path / "audit" / "mobility.jsonl", moved)
    collection = json.loads(run("export", log, "--to", "geojson").stdout)
    (path,) = (f for f in collection["features"] if f["properties"]["kind"] == "path")
    assert path["geometry"]["type"] == "MultiLineString"
    lines = path["geometry"]["coordinates"]
    assert [len(times) for times in path["properties"]["times"]] == [len(line) for line in lines]
    assert len({time for times in path["properties"]["times"] for time in times}) > 10
    root = ElementTree.fromstring(run("export", log, "--to", "kml").stdout)
    texts = [e.text or "" for e in root.iter("{http://www.opengis.net/kml/2.2}coordinates") if " " in (e.text or "")]
    lines += [[list(map(float, group.split(","))) for group in text.split()] for text in texts]
    assert len(lines) >= 4
    for line in lines:
        assert max(lon for lon, *_ in line) - min(lon for lon, *_ in line) < 1.0, "the line goes around the world"


def test_monitor_decision_has_last_position_of_the_drone(log: Path, entries: list[dict[str, Any]]) -> None:
    collection = json.loads(run("export", log, "--to", "geojson").stdout)
    (monitor,) = (f for f in collection["features"] if f["properties"]["kind"] == "monitor")
    before = [entry for entry in entries if entry["kind"] == "state" and entry["time"] <= MONITOR["time"]][-1]
    assert monitor["geometry"]["coordinates"][:2] == [before["lon"], before["lat"]]


def test_kml_has_path_decisions_and_zones(log: Path, entries: list[dict[str, Any]]) -> None:
    root = ElementTree.fromstring(run("export", log, "--to", "kml", "--zones", ZONES).stdout)
    namespaces = {"k": "http://www.opengis.net/kml/2.2"}
    assert root.tag == "{http://www.opengis.net/kml/2.2}kml"
    (line,) = root.findall(".//k:LineString", namespaces)
    coordinates = (line.findtext("k:coordinates", "", namespaces)).split()
    assert len(coordinates) == sum(entry["kind"] == "state" for entry in entries)
    assert coordinates[0] == f"{demo_flight.HOME[1]},{demo_flight.HOME[0]},100.00"
    assert line.findtext("k:altitudeMode", "", namespaces) == "absolute"
    descriptions = [
        mark.findtext("k:description", "", namespaces) for mark in root.findall(".//k:Placemark[k:Point]", namespaces)
    ]
    assert any("LeftZone, the driver left the zone" in text for text in descriptions)
    assert any("<too> fast & low" in text for text in descriptions)
    assert root.findall(".//k:Polygon", namespaces)


def test_csv_has_every_entry_with_its_hash(log: Path, entries: list[dict[str, Any]]) -> None:
    rows = list(csv.DictReader(io.StringIO(run("export", log, "--to", "csv").stdout)))
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert [(int(row["seq"]), row["hash"]) for row in rows] == [(line["seq"], line["hash"]) for line in lines]
    (row,) = (row for row in rows if row["kind"] == "takeover")
    assert (row["lat"], row["alt_m"], row["policies"], row["log"]) == ("50.865", "30.0", "town-altitude", "mobility")
    denied = next(row for row in rows if row["code"] == "MethodDenied")
    assert (denied["component"], denied["method"]) == ("AerialViewer", "CaptureImage")
    assert sum(row["kind"] == "state" for row in rows) == sum(entry["kind"] == "state" for entry in entries)
    assert {row["controller"] for row in rows} == {"", "Navigator", "system"}


def test_mcap_has_locations_states_decisions_logs_and_zones(
    log: Path, entries: list[dict[str, Any]], tmp_path: Path
) -> None:
    run("export", log, "--to", "mcap", "--zones", ZONES, "--file", tmp_path / "flight.mcap")
    with (tmp_path / "flight.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        messages: dict[str, list[Any]] = {}
        for schema, channel, message in reader.iter_messages():
            assert schema is not None and (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            messages.setdefault(f"{channel.topic} {schema.name}", []).append(
                (message.log_time, json.loads(message.data))
            )
        (metadata,) = reader.iter_metadata()
    states = [entry for entry in entries if entry["kind"] == "state"]
    assert metadata.metadata["verified"] == "yes"
    fixes = messages["/drone-1/location foxglove.LocationFix"]
    assert len(fixes) == len(messages["/drone-1/state fractus.State"]) == len(states)
    stamp = round(datetime.fromisoformat(states[0]["time"]).timestamp() * 1e9)
    assert fixes[0][0] == stamp
    assert fixes[0][1] | {"position_covariance": 9} == {
        "timestamp": {"sec": stamp // 10**9, "nsec": stamp % 10**9}, "frame_id": "drone-1", "latitude": states[0]["lat"],
        "longitude": states[0]["lon"], "altitude": states[0]["amsl"], "position_covariance": 9, "position_covariance_type": 0,
    }  # fmt: skip
    decisions = [content for _, content in messages["/drone-1/decisions fractus.Decision"]]
    assert ("takeover", "LeftZone") in {(content["kind"], content["code"]) for content in decisions}
    levels = {content["message"]: content["level"] for _, content in messages["/drone-1/log foxglove.Log"]}
    assert levels["return: LeftZone, the driver left the zone"] == 4
    ((_, zones),) = messages["/drone-1/zones foxglove.GeoJSON"]
    assert json.loads(zones["geojson"])["features"]


def test_changed_log_is_exported_with_a_warning(log: Path) -> None:
    log.write_bytes(log.read_bytes().replace(b"MethodDenied", b"MethodAllows"))
    result = run("export", log, "--to", "geojson")
    assert "warning: not verified" in result.stderr
    assert "was changed after it was written" in result.stderr
    assert json.loads(result.stdout)["verified"] is False
    assert "was changed after it was written" in run("export", log, "--to", "kml").stdout
    assert "not verified" in run("show", log).stderr


def test_verify_prints_json(fleet: list[Path]) -> None:
    results = json.loads(run("verify", *fleet, "-o", "json").stdout)
    assert [(result["sound"], result["problem"], result["whole"]) for result in results] == [(True, "", True)] * 2
    path = fleet[1] / "mobility.jsonl"
    path.write_bytes(path.read_bytes().replace(b"MethodDenied", b"MethodAllows"))
    failed = CliRunner().invoke(audit, ["verify", *map(str, fleet), "-o", "json"])
    assert failed.exit_code == 1
    by_log = {result["log"]: result for result in json.loads(failed.stdout)}
    assert "was changed after it was written" in by_log[str(path)]["problem"]
    assert sum(result["sound"] for result in by_log.values()) == 1


def test_invalid_lines_are_skipped(log: Path) -> None:
    original = log.read_bytes()
    malformed = [
        b"[]",
        b'{"time": 5}',
        b'{"time": "2026-01-01", "kind": "state"}',
        b"[" * 100_000,
        b'{"lat": NaN, "kind": "state"',
    ]
    lines = (
        *malformed,
        b'{"time": "2026-01-01T00:00:00Z", "kind": "call", "action": "deny", "policies": 7, "lat": "x", "method": []}',
    )
    log.write_bytes(original + b"\n".join(lines) + b"\n")
    assert "is not an audit entry" in run("show", log).stderr
    for target in ("csv", "geojson", "kml", "mcap"):
        assert run("export", log, "--to", target).stdout_bytes


def test_export_reads_zones_and_areas_from_a_grant(log: Path, tmp_path: Path) -> None:
    (tmp_path / "grant.yaml").write_text(demo_flight.GRANT)
    collection = json.loads(run("export", log, "--to", "geojson", "--zones", tmp_path / "grant.yaml").stdout)
    properties = {f["properties"]["kind"]: f["properties"] for f in collection["features"]}
    assert properties["zone"]["name"] == "pool"
    assert properties["operationArea"]["component"] == "Navigator"


PLAN = {
    "apiVersion": "fractus.dev/v1alpha1", "kind": "DeploymentPlan", "metadata": {"name": "traffic", "namespace": "city"},
    "spec": {
        "application": "traffic",
        "operationArea": {
            "type": "MultiPolygon",
            "coordinates": [[
                [[4.67, 50.86], [4.69, 50.86], [4.69, 50.87], [4.67, 50.86]],
                [[4.68, 50.862], [4.685, 50.862], [4.685, 50.864], [4.68, 50.862]],
            ]],
        },
        "flown": {"outcome": "Complete", "landed": True, "landedAt": "2026-06-01T12:00:00Z"},
    },
}  # fmt: skip


def exported_area(result: Result) -> Any:
    features = json.loads(result.stdout)["features"]
    (area,) = [f for f in features if f["properties"]["kind"] == "operationArea"]
    return shapely.geometry.shape(area["geometry"])


def test_export_reads_the_operation_area_from_the_plan_of_a_finished_mission(log: Path, tmp_path: Path) -> None:
    listed = {"apiVersion": "v1", "kind": "List", "items": [PLAN]}
    (tmp_path / "plan.json").write_text(json.dumps(listed))
    area = exported_area(run("export", log, "--to", "geojson", "--zones", tmp_path / "plan.json"))
    assert area.equals(shapely.geometry.shape(PLAN["spec"]["operationArea"]))  # type: ignore[index]
    for target in ("kml", "mcap"):
        assert run("export", log, "--to", target, "--zones", tmp_path / "plan.json").stdout_bytes


def test_show_prints_decisions(log: Path) -> None:
    lines = run("show", log).stdout.splitlines()
    assert len(lines) == 8
    assert lines[0].endswith(
        "mobility  call: Navigator SetSpeed correct: SpeedAboveLimit, speed 12.0 m/s is above the limit of policy town-speed;"
        " corrected to 9.5 m/s (limit 10.0 less 0.5 for overshoot)"
    )
    everything = run("show", log, "--all").stdout
    assert len(everything.splitlines()) == len(log.read_text().splitlines())
    assert "controller=Navigator" in everything
    assert "spiffe:" not in everything
    after = demo_flight.stamp(demo_flight.TAKEOFF_S + 60)
    (*_, last) = (json.loads(line) for line in run("show", log, "-o", "json", "--after", after).stdout.splitlines())
    assert (last["kind"], last["log"]) == ("control", "mobility")
    assert not run("show", log, "--before", demo_flight.stamp(demo_flight.APPLIED_S)).stdout


@pytest.fixture
async def fleet(tmp_path: Path, log: Path, entries: list[dict[str, Any]]) -> list[Path]:
    """Audit logs of two drones in separate directories.

    The drones flew at the same time. The second drone was 0.01 degrees farther north.
    """
    second_log = tmp_path / "other" / "mobility.jsonl"
    now = 0.0
    writer = AuditLog(second_log, lambda: now)
    for entry in entries:
        now = datetime.fromisoformat(entry["time"]).timestamp()
        moved = {"node": "drone-2"} if entry["kind"] == "started" else {}
        moved |= {"lat": entry["lat"] + 0.01} if "lat" in entry else {}
        fields = {key: value for key, value in (entry | moved).items() if key not in {"kind", "time"}}
        writer.append(entry["kind"], fields)
    await writer.close()
    return [log.parent, second_log.parent]


def test_export_has_one_track_for_each_drone(fleet: list[Path], entries: list[dict[str, Any]], tmp_path: Path) -> None:
    states = [entry for entry in entries if entry["kind"] == "state"]
    features = json.loads(run("export", *fleet, "--to", "geojson").stdout)["features"]

    def coordinates_by_node(kind: str) -> dict[str, Any]:
        selected = [f for f in features if f["properties"]["kind"] == kind]
        return {f["properties"]["node"]: f["geometry"]["coordinates"] for f in selected}

    assert [point[1] for point in coordinates_by_node("path")["drone-1"]] == [state["lat"] for state in states]
    assert [point[1] for point in coordinates_by_node("path")["drone-2"]] == [state["lat"] + 0.01 for state in states]
    positions = coordinates_by_node("monitor")
    assert positions["drone-2"][1] == pytest.approx(positions["drone-1"][1] + 0.01), (
        "each decision has the position of its own drone"
    )

    namespaces = {"k": "http://www.opengis.net/kml/2.2"}
    folders = ElementTree.fromstring(run("export", *fleet, "--to", "kml").stdout).findall(".//k:Folder", namespaces)
    assert [folder.findtext("k:name", "", namespaces) for folder in folders] == ["drone-1", "drone-2"]
    assert [len(folder.findall(".//k:LineString", namespaces)) for folder in folders] == [1, 1]

    rows = list(csv.DictReader(io.StringIO(run("export", *fleet, "--to", "csv").stdout)))
    assert {row["node"] for row in rows} == {"drone-1", "drone-2"}
    assert sum(row["node"] == "drone-2" and row["kind"] == "state" for row in rows) == len(states)

    run("export", *fleet, "--to", "mcap", "--file", tmp_path / "both.mcap")
    with (tmp_path / "both.mcap").open("rb") as file:
        locations = list(make_reader(file).iter_messages(topics=["/drone-2/location"]))
    assert [json.loads(message.data)["latitude"] for _, _, message in locations] == [s["lat"] + 0.01 for s in states]


def test_mcap_has_no_topics_of_entries_before_the_window(log: Path, tmp_path: Path) -> None:
    landed = json.loads(log.read_text().splitlines()[-1])["time"]
    run("export", log, "--to", "mcap", "--after", landed, "--file", tmp_path / "late.mcap")
    with (tmp_path / "late.mcap").open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        topics = {channel.topic for _, channel, _ in reader.iter_messages()}
    assert summary is not None and topics
    assert {channel.topic for channel in summary.channels.values()} == topics
    assert {schema.name for schema in summary.schemas.values()} <= {"foxglove.LocationFix", "fractus.State"}
    assert all(topic.startswith("/drone-1/") for topic in topics), (
        "the topics contain the node name, although its entry is before the window"
    )


def test_mcap_is_written_to_a_pipe(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read_end, write_end = os.pipe()
    with ThreadPoolExecutor() as pool, os.fdopen(read_end, "rb") as source:
        content = pool.submit(source.read)
        with os.fdopen(write_end, "w") as stdout, monkeypatch.context() as patched:
            patched.setattr(sys, "stdout", stdout)
            audit.main(["export", str(log), "--to", "mcap"], standalone_mode=False)
        (tmp_path / "piped.mcap").write_bytes(content.result(60))
    run("export", log, "--to", "mcap", "--file", tmp_path / "whole.mcap")
    assert (tmp_path / "piped.mcap").read_bytes() == (tmp_path / "whole.mcap").read_bytes()
    with (tmp_path / "piped.mcap").open("rb") as file:
        assert sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages()) > 10


async def test_path_is_split_at_a_pause(log: Path, tmp_path: Path) -> None:
    now = demo_flight.TAKEOFF_S + 5000.0
    writer = AuditLog(log, lambda: now)
    writer.append("state", {"lat": 50.0, "lon": 4.0, "alt": 0.0, "amsl": 90.0})
    await writer.close()
    collection = json.loads(run("export", log, "--to", "geojson").stdout)
    assert [f["geometry"]["type"] for f in collection["features"] if f["properties"]["kind"] == "path"] == [
        "LineString",
        "Point",
    ]

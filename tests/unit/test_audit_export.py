"""`fractus audit show` and `export`: what an audit log says, read back by the readers of the formats."""

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
ZONES = demo_flight.EXAMPLE / "zones.yaml"


@pytest.fixture(scope="module")
def entries() -> list[dict[str, Any]]:
    started = {"kind": "started", "time": demo_flight.stamp(demo_flight.APPLIED_S), "node": "drone-1"}
    states = [state | {"amsl": state["alt"] + 100.0} for state in demo_flight.states()]
    return sorted([started, *demo_flight.calls(), *states, TAKEOVER, MONITOR], key=lambda entry: str(entry["time"]))


@pytest.fixture
async def log(tmp_path: Path, entries: list[dict[str, Any]]) -> Path:
    """An audit log of a flight, written by the one writer."""
    path = tmp_path / "audit" / "mobility.jsonl"
    now = 0.0
    writer = AuditLog(path, lambda: now)
    for entry in entries:
        now = datetime.fromisoformat(entry["time"]).timestamp()
        writer.append(entry["kind"], {key: value for key, value in entry.items() if key not in {"kind", "time"}})
    await writer.close()
    return path


def run(*arguments: object) -> Result:
    result = CliRunner().invoke(audit, [str(one) for one in arguments])
    assert result.exit_code == 0, result.output
    return result


def test_geojson_has_path_decisions_takeovers_and_zones(log: Path, entries: list[dict[str, Any]]) -> None:
    result = run("export", log, "--to", "geojson", "--zones", ZONES)
    assert not result.stderr
    whole = json.loads(result.stdout)
    assert (whole["type"], whole["verified"]) == ("FeatureCollection", True)
    of = {
        kind: [f for f in whole["features"] if f["properties"]["kind"] == kind]
        for kind in ("path", "call", "takeover", "zone")
    }
    states = [entry for entry in entries if entry["kind"] == "state"]
    (path,) = of["path"]
    line = shapely.geometry.shape(path["geometry"])
    assert line.geom_type == "LineString" and len(line.coords) == len(states) == len(path["properties"]["times"])
    assert line.coords[0] == (demo_flight.HOME[1], demo_flight.HOME[0], 100.0), "lon, lat, metres above sea level"
    assert [f["properties"]["code"] for f in of["call"]].count("MethodDenied") == 2
    assert not any(f["properties"].get("action") == "allow" for f in whole["features"]), (
        "what was permitted is no decision"
    )
    (takeover,) = of["takeover"]
    assert takeover["geometry"]["coordinates"] == [4.68, 50.865, 130.0]
    assert takeover["properties"]["reason"] == "the driver left the zone"
    names = {f["properties"]["name"]: shapely.geometry.shape(f["geometry"]) for f in of["zone"]}
    assert names and all(shape.is_valid and shape.area > 0 for shape in names.values())


def test_the_monitors_decisions_are_where_the_drone_was(log: Path, entries: list[dict[str, Any]]) -> None:
    whole = json.loads(run("export", log, "--to", "geojson").stdout)
    (monitor,) = (f for f in whole["features"] if f["properties"]["kind"] == "monitor")
    before = [entry for entry in entries if entry["kind"] == "state" and entry["time"] <= MONITOR["time"]][-1]
    assert monitor["geometry"]["coordinates"][:2] == [before["lon"], before["lat"]]


def test_kml_is_what_an_xml_reader_expects(log: Path, entries: list[dict[str, Any]]) -> None:
    root = ElementTree.fromstring(run("export", log, "--to", "kml", "--zones", ZONES).stdout)
    space = {"k": "http://www.opengis.net/kml/2.2"}
    assert root.tag == "{http://www.opengis.net/kml/2.2}kml"
    (line,) = root.findall(".//k:LineString", space)
    groups = (line.findtext("k:coordinates", "", space)).split()
    assert len(groups) == sum(entry["kind"] == "state" for entry in entries)
    assert groups[0] == f"{demo_flight.HOME[1]},{demo_flight.HOME[0]},100.00"
    assert line.findtext("k:altitudeMode", "", space) == "absolute"
    told = [mark.findtext("k:description", "", space) for mark in root.findall(".//k:Placemark[k:Point]", space)]
    assert any("LeftZone, the driver left the zone" in text for text in told)
    assert any("<too> fast & low" in text for text in told)
    assert root.findall(".//k:Polygon", space)


def test_csv_has_every_entry_with_its_place_in_the_chain(log: Path, entries: list[dict[str, Any]]) -> None:
    rows = list(csv.DictReader(io.StringIO(run("export", log, "--to", "csv").stdout)))
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert [(int(row["seq"]), row["hash"]) for row in rows] == [(line["seq"], line["hash"]) for line in lines]
    (row,) = (row for row in rows if row["kind"] == "takeover")
    assert (row["lat"], row["alt_m"], row["policies"], row["log"]) == ("50.865", "30.0", "town-altitude", "mobility")
    denied = next(row for row in rows if row["code"] == "MethodDenied")
    assert (denied["component"], denied["method"]) == ("AerialViewer", "CaptureImage")
    assert sum(row["kind"] == "state" for row in rows) == sum(entry["kind"] == "state" for entry in entries)


def test_mcap_is_read_by_its_reader(log: Path, entries: list[dict[str, Any]], tmp_path: Path) -> None:
    run("export", log, "--to", "mcap", "--zones", ZONES, "--file", tmp_path / "flight.mcap")
    with (tmp_path / "flight.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        found: dict[str, list[Any]] = {}
        for schema, channel, message in reader.iter_messages():
            assert schema is not None and (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            found.setdefault(f"{channel.topic} {schema.name}", []).append((message.log_time, json.loads(message.data)))
        (metadata,) = reader.iter_metadata()
    states = [entry for entry in entries if entry["kind"] == "state"]
    assert metadata.metadata["verified"] == "yes"
    fixes = found["/drone-1/location foxglove.LocationFix"]
    assert len(fixes) == len(found["/drone-1/state fractus.State"]) == len(states)
    stamp = round(datetime.fromisoformat(states[0]["time"]).timestamp() * 1e9)
    assert fixes[0][0] == stamp
    assert fixes[0][1] | {"position_covariance": 9} == {
        "timestamp": {"sec": stamp // 10**9, "nsec": stamp % 10**9}, "frame_id": "drone-1", "latitude": states[0]["lat"],
        "longitude": states[0]["lon"], "altitude": states[0]["amsl"], "position_covariance": 9, "position_covariance_type": 0,
    }  # fmt: skip
    decisions = [content for _, content in found["/drone-1/decisions fractus.Decision"]]
    assert ("takeover", "LeftZone") in {(content["kind"], content["code"]) for content in decisions}
    levels = {content["message"]: content["level"] for _, content in found["/drone-1/log foxglove.Log"]}
    assert levels["return: LeftZone, the driver left the zone"] == 4
    ((_, zones),) = found["/drone-1/zones foxglove.GeoJSON"]
    assert json.loads(zones["geojson"])["features"]


def test_what_was_changed_is_written_with_a_warning(log: Path) -> None:
    log.write_bytes(log.read_bytes().replace(b"MethodDenied", b"MethodAllows"))
    result = run("export", log, "--to", "geojson")
    assert "warning: not verified" in result.stderr
    assert "was changed after it was written" in result.stderr
    assert json.loads(result.stdout)["verified"] is False
    assert "was changed after it was written" in run("export", log, "--to", "kml").stdout
    assert "not verified" in run("show", log).stderr


def test_verification_is_for_programs_too(fleet: list[Path]) -> None:
    told = json.loads(run("verify", *fleet, "-o", "json").stdout)
    assert [(one["sound"], one["problem"], one["whole"]) for one in told] == [(True, "", True)] * 2
    path = fleet[1] / "mobility.jsonl"
    path.write_bytes(path.read_bytes().replace(b"MethodDenied", b"MethodAllows"))
    result = CliRunner().invoke(audit, ["verify", *map(str, fleet), "-o", "json"])
    assert result.exit_code == 1
    found = {one["log"]: one for one in json.loads(result.stdout)}
    assert "was changed after it was written" in found[str(path)]["problem"]
    assert sum(one["sound"] for one in found.values()) == 1


def test_lines_that_are_no_entries_are_left_out(log: Path) -> None:
    whole = log.read_bytes()
    odd = [
        b"[]",
        b'{"time": 5}',
        b'{"time": "2026-01-01", "kind": "state"}',
        b"[" * 100_000,
        b'{"lat": NaN, "kind": "state"',
    ]
    lines = (
        *odd,
        b'{"time": "2026-01-01T00:00:00Z", "kind": "call", "action": "deny", "policies": 7, "lat": "x", "method": []}',
    )
    log.write_bytes(whole + b"\n".join(lines) + b"\n")
    assert "is not an audit entry" in run("show", log).stderr
    for target in ("csv", "geojson", "kml", "mcap"):
        assert run("export", log, "--to", target).stdout_bytes


def test_grants_draw_their_zones_and_areas(log: Path, tmp_path: Path) -> None:
    (tmp_path / "grant.yaml").write_text(demo_flight.GRANT)
    whole = json.loads(run("export", log, "--to", "geojson", "--zones", tmp_path / "grant.yaml").stdout)
    told = {f["properties"]["kind"]: f["properties"] for f in whole["features"]}
    assert told["zone"]["name"] == "pool"
    assert told["operationArea"]["component"] == "Navigator"


def test_show_tells_what_was_decided(log: Path) -> None:
    lines = run("show", log).stdout.splitlines()
    assert len(lines) == 8
    assert lines[0].endswith(
        "mobility  call: Navigator SetSpeed correct: SpeedAboveLimit, speed 12.0 m/s is above the limit of policy town-speed;"
        " corrected to 10.0 m/s"
    )
    assert len(run("show", log, "--all").stdout.splitlines()) == len(log.read_text().splitlines())
    after = demo_flight.stamp(demo_flight.TAKEOFF_S + 60)
    (*_, last) = (json.loads(line) for line in run("show", log, "-o", "json", "--after", after).stdout.splitlines())
    assert (last["kind"], last["log"]) == ("control", "mobility")
    assert not run("show", log, "--before", demo_flight.stamp(demo_flight.APPLIED_S)).stdout


@pytest.fixture
async def fleet(tmp_path: Path, log: Path, entries: list[dict[str, Any]]) -> list[Path]:
    """The directories of two drones that flew at the same time, the second one a little to the north."""
    other = tmp_path / "other" / "mobility.jsonl"
    now = 0.0
    writer = AuditLog(other, lambda: now)
    for entry in entries:
        now = datetime.fromisoformat(entry["time"]).timestamp()
        moved = {"node": "drone-2"} if entry["kind"] == "started" else {}
        moved |= {"lat": entry["lat"] + 0.01} if "lat" in entry else {}
        said = {key: value for key, value in (entry | moved).items() if key not in {"kind", "time"}}
        writer.append(entry["kind"], said)
    await writer.close()
    return [log.parent, other.parent]


def test_each_drone_has_a_track_of_its_own(fleet: list[Path], entries: list[dict[str, Any]], tmp_path: Path) -> None:
    states = [entry for entry in entries if entry["kind"] == "state"]
    drawn = json.loads(run("export", *fleet, "--to", "geojson").stdout)["features"]

    def of(kind: str) -> dict[str, Any]:
        found = [f for f in drawn if f["properties"]["kind"] == kind]
        return {f["properties"]["node"]: f["geometry"]["coordinates"] for f in found}

    assert [point[1] for point in of("path")["drone-1"]] == [state["lat"] for state in states]
    assert [point[1] for point in of("path")["drone-2"]] == [state["lat"] + 0.01 for state in states]
    places = of("monitor")
    assert places["drone-2"][1] == pytest.approx(places["drone-1"][1] + 0.01), "where that drone was, not the other"

    space = {"k": "http://www.opengis.net/kml/2.2"}
    folders = ElementTree.fromstring(run("export", *fleet, "--to", "kml").stdout).findall(".//k:Folder", space)
    assert [folder.findtext("k:name", "", space) for folder in folders] == ["drone-1", "drone-2"]
    assert [len(folder.findall(".//k:LineString", space)) for folder in folders] == [1, 1]

    rows = list(csv.DictReader(io.StringIO(run("export", *fleet, "--to", "csv").stdout)))
    assert {row["node"] for row in rows} == {"drone-1", "drone-2"}
    assert sum(row["node"] == "drone-2" and row["kind"] == "state" for row in rows) == len(states)

    run("export", *fleet, "--to", "mcap", "--file", tmp_path / "both.mcap")
    with (tmp_path / "both.mcap").open("rb") as file:
        found = list(make_reader(file).iter_messages(topics=["/drone-2/location"]))
    assert [json.loads(message.data)["latitude"] for _, _, message in found] == [s["lat"] + 0.01 for s in states]


def test_what_was_before_the_window_leaves_no_topic(log: Path, tmp_path: Path) -> None:
    landed = json.loads(log.read_text().splitlines()[-1])["time"]
    run("export", log, "--to", "mcap", "--after", landed, "--file", tmp_path / "late.mcap")
    with (tmp_path / "late.mcap").open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        topics = {channel.topic for _, channel, _ in reader.iter_messages()}
    assert summary is not None and topics
    assert {channel.topic for channel in summary.channels.values()} == topics
    assert {schema.name for schema in summary.schemas.values()} <= {"foxglove.LocationFix", "fractus.State"}
    assert all(topic.startswith("/drone-1/") for topic in topics), "the node that started before the window"


def test_mcap_goes_through_a_pipe(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    into, out = os.pipe()
    with ThreadPoolExecutor() as pool, os.fdopen(into, "rb") as end:
        read = pool.submit(end.read)
        with os.fdopen(out, "w") as stdout, monkeypatch.context() as patched:
            patched.setattr(sys, "stdout", stdout)
            audit.main(["export", str(log), "--to", "mcap"], standalone_mode=False)
        (tmp_path / "piped.mcap").write_bytes(read.result(60))
    run("export", log, "--to", "mcap", "--file", tmp_path / "whole.mcap")
    assert (tmp_path / "piped.mcap").read_bytes() == (tmp_path / "whole.mcap").read_bytes()
    with (tmp_path / "piped.mcap").open("rb") as file:
        assert sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages()) > 10


async def test_a_pause_ends_a_path(log: Path, tmp_path: Path) -> None:
    now = demo_flight.TAKEOFF_S + 5000.0
    writer = AuditLog(log, lambda: now)
    writer.append("state", {"lat": 50.0, "lon": 4.0, "alt": 0.0, "amsl": 90.0})
    await writer.close()
    whole = json.loads(run("export", log, "--to", "geojson").stdout)
    assert [f["geometry"]["type"] for f in whole["features"] if f["properties"]["kind"] == "path"] == [
        "LineString",
        "Point",
    ]

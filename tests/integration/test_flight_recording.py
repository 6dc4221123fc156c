"""Recordings of a real flight, read by third-party tools."""

from __future__ import annotations

import asyncio
import json
import signal
from pathlib import Path
from typing import Any

import chart
import pytest
from fractus_agent.records.audit_records import CAMERA_LOG, MOBILITY_LOG, read_track, read_verdicts
from fractus_agent.records.picture_records import read_picture, read_pictures
from fractus_agent.records.planned_flight import PlannedFlight
from fractus_agent.registration.diagnostics import read_recording_problems
from fractus_core.api.names import component_identity
from fractus_proto.v1 import camera_pb2, camera_pb2_grpc
from fractus_proto.v1 import mobility_pb2 as pb
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC
from mobility_rig import HOME, NODE, PASSENGER, Driver, Rig, altitude_limit, fence, grant, passenger_grant
from pymavlink import mavutil


def messages(directory: Path) -> dict[str, list[Any]]:
    by_topic: dict[str, list[Any]] = {}
    for path in sorted(directory.glob("*.mcap")):
        with path.open("rb") as file:
            for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
                assert schema is not None
                by_topic.setdefault(f"{channel.topic} {schema.name}", []).append(json.loads(message.data))
    return by_topic


def frames(directory: Path) -> set[tuple[str, int]]:
    """Return the types of the recorded messages, each with the system id of its sender."""
    names = set()
    for path in directory.glob("*.tlog"):
        log = mavutil.mavlink_connection(str(path))
        while (message := log.recv_match()) is not None:
            names.add((message.get_type(), message.get_srcSystem()))
        log.close()
    return names


def sizes(directory: Path) -> list[int]:
    return [path.stat().st_size for path in directory.glob("*.mcap")]


async def flushed(directory: Path) -> None:
    """Wait until a large part of the flight is on the disk."""
    async with asyncio.timeout(60):
        while True:
            if any(size > 20_000 for size in sizes(directory)):
                return
            await asyncio.sleep(0.1)


def indexed(directory: Path) -> bool:
    return min(directory.glob("*.mcap")).read_bytes().endswith(MCAP0_MAGIC)


async def completed(directory: Path) -> None:
    """Wait until the service has written the missing indexes of recordings of its earlier runs."""
    async with asyncio.timeout(120):
        while True:
            if indexed(directory):
                return
            await asyncio.sleep(0.1)


async def test_recording_has_flight_and_pictures_and_survives_kill(rig: Rig) -> None:
    mobility = rig.directory / "recordings" / "mobility"
    pictures = rig.directory / "recordings" / "camera"
    camera = [{"service": "camera", "methods": ["CaptureImage"]}]
    rig.write_grant(grant(altitude_limit(5, 15), fence("no-fly", "exclusion", "ignore", -60, -10, -40, 10)))
    rig.write_grant(passenger_grant(services=camera))
    rig.start_service("--recordings", str(mobility))
    rig.start_vehicle()
    address = rig.start_camera("--recordings", str(pictures))
    driver = Driver(rig)
    await driver.up(10.0)
    await driver.goto(20, 0, 20.0)
    stub = camera_pb2_grpc.CameraServiceStub(rig.channel(PASSENGER, address=address))
    await stub.CaptureImage(camera_pb2.CaptureImageRequest(), timeout=60, wait_for_ready=True)
    telemetry = await rig.telemetry()
    assert not telemetry.recording_problem
    await flushed(mobility)
    rig.kill("service")
    rig.start_service("--recordings", str(mobility))
    await rig.until(lambda t: t.autopilot_connected and not t.armed, 120, "landed")
    await completed(mobility)
    rig.kill("service", signal.SIGTERM)
    rig.kill("camera", signal.SIGTERM)

    assert len(sizes(mobility)) >= 2
    recorded = messages(mobility)
    fixes = recorded[f"/{NODE}/location foxglove.LocationFix"]
    assert max(fix["altitude"] for fix in fixes) == pytest.approx(HOME[2] + 15.0, abs=2.0)
    assert {"AltitudeAboveLimit"} <= {message["code"] for message in recorded[f"/{NODE}/decisions fractus.Decision"]}
    zones = [json.loads(message["geojson"]) for message in recorded[f"/{NODE}/zones foxglove.GeoJSON"]]
    names = {f["properties"]["name"] for message in zones for f in message["features"]}
    assert {"no-fly-zone", "operationArea"} <= names
    assert recorded[f"/{NODE}/attitude fractus.Attitude"]
    assert {"GUIDED"} <= {message["mode"] for message in recorded[f"/{NODE}/state fractus.State"]}
    frame_names = frames(mobility)
    assert {("HEARTBEAT", 1), ("HEARTBEAT", 244), ("GLOBAL_POSITION_INT", 1), ("COMMAND_ACK", 1)} <= frame_names
    taken = messages(pictures)
    owners = {picture["owner"] for picture in taken[f"/{NODE}/picture foxglove.CompressedImage"]}
    assert {owner.partition("/")[2] for owner in owners} == {
        component_identity("default", "app", "AerialViewer", "app-aerial-viewer")
    }
    callers = {message["caller"] for message in taken[f"/{NODE}/decisions fractus.Decision"]}
    assert component_identity("default", "app", "AerialViewer", "app-aerial-viewer") in callers


async def test_agent_finds_records_of_a_flight_in_the_files_of_the_services(rig: Rig) -> None:
    pictures = rig.directory / "recordings" / "camera"
    rig.write_grant(grant(altitude_limit(5, 15)))
    rig.write_grant(passenger_grant(services=[{"service": "camera", "methods": ["CaptureImage"]}]))
    rig.start_service()
    rig.start_vehicle()
    address = rig.start_camera("--recordings", str(pictures))
    driver = Driver(rig)
    await driver.up(10.0)
    await driver.goto(5, 0, 20.0)
    stub = camera_pb2_grpc.CameraServiceStub(rig.channel(PASSENGER, address=address))
    await stub.CaptureImage(camera_pb2.CaptureImageRequest(), timeout=60, wait_for_ready=True)
    rig.kill("camera", signal.SIGTERM)
    flight = PlannedFlight("default", "app", 0.0, float("inf"))
    audit = rig.directory / "audit"
    audit.mkdir()
    (audit / MOBILITY_LOG).symlink_to(rig.audit)
    (audit / CAMERA_LOG).symlink_to(rig.directory / "camera.jsonl")
    track = read_track(audit, flight, 10_000, "").items
    assert max(point.alt or 0.0 for point in track) == pytest.approx(15.0, abs=2.0)
    assert "Navigator" in {point.controller for point in track}
    verdicts = read_verdicts(audit, flight, 10_000, "").items
    assert {"AltitudeAboveLimit"} <= {verdict.code for verdict in verdicts}
    assert {"Navigator", "AerialViewer"} <= {verdict.component for verdict in verdicts}
    (picture,) = read_pictures(pictures, flight, 10, "").items
    assert (read_picture(pictures, flight, picture.id) or b"").startswith(b"\xff\xd8")
    other = PlannedFlight("default", "other", 0.0, float("inf"))
    assert read_verdicts(audit, other, 10, "").items == []
    assert read_track(audit, other, 10, "").items == []
    assert read_pictures(pictures, other, 10, "").items == []


async def test_recording_failure_does_not_prevent_flight(rig: Rig) -> None:
    (rig.directory / "file").write_text("in the way")
    rig.write_grant(grant())
    rig.start_service("--recordings", str(rig.directory / "file" / "below"))
    rig.start_vehicle()
    driver = Driver(rig)
    await driver.up(5.0)
    assert "recording stopped" in (await rig.telemetry()).recording_problem
    await driver.goto(10, 0, 5.0)
    assert rig.log("service").count("recording: stopped") == 1
    await driver.stub.ReturnControl(pb.ReturnControlRequest(), timeout=10)


async def test_recording_into_directory_of_another_service_is_reported(rig: Rig) -> None:
    shared = str(rig.directory / "shared")
    rig.write_grant(grant())
    rig.start_service("--recordings", shared)
    rig.start_vehicle()
    driver = Driver(rig)
    await driver.up(5.0)
    rig.start_camera("--recordings", shared)
    problem = f"pictures: recording stopped: another service records into {shared}; give each its own directory with --recordings"
    async with asyncio.timeout(60):
        while True:
            if read_recording_problems(rig.directory) == [problem]:
                break
            await asyncio.sleep(0.1)
    assert not (await rig.telemetry()).recording_problem
    await driver.stub.ReturnControl(pb.ReturnControlRequest(), timeout=10)


def test_chart_value_enables_recordings() -> None:
    def arguments(part: str, *settings: str) -> list[str]:
        (body,) = (
            b
            for b in chart.render(*settings)
            if b["kind"] == "DaemonSet" and b["metadata"]["name"] == f"fractus-{part}"
        )
        (container,) = body["spec"]["template"]["spec"]["containers"]
        args: list[str] = container["args"]
        return args[args.index("--recordings") :] if "--recordings" in args else []

    directory = "/var/lib/fractus/recordings"
    assert arguments("mobility") == ["--recordings", f"{directory}/mobility", "--recordings-mb", "500"]
    assert not arguments("camera"), "the camera service records pictures although its recordings are not enabled"
    assert not arguments("mobility", "--set", "mobility.recordings.enabled=false")
    more = ("--set", "camera.recordings.enabled=true", "--set", "camera.recordings.megabytes=2000000")
    assert arguments("camera", *more) == ["--recordings", f"{directory}/camera", "--recordings-mb", "2000000"]

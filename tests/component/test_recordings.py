"""Flight recordings: content, size limit, recovery after a crash, and failing disks.

Independent readers check the content.
"""

from __future__ import annotations

import asyncio
import base64
import errno
import json
import logging
import os
import stat
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from demo_flight import GRANT
from fractus_agent.registration.diagnostics import read_recording_problems
from fractus_agent.registration.node_status import NodeObservation, node_status
from fractus_agent.telemetry import parse_telemetry
from fractus_core.api import Grant
from fractus_core.api.conditions import ConditionUpdate
from fractus_proto.v1.mobility_pb2 import Telemetry
from fractus_runtime.audit import AuditLog
from fractus_runtime.mavlink_codec import Endpoint, Parser
from fractus_services.recording import recorder
from fractus_services.recording.mavlink_messages import MavlinkDecoder
from fractus_services.recording.recorder import FlightWriter, Recorder
from fractus_services.recording.segment_directory import MIN_SEGMENT_BYTES, SegmentDirectory, segments_in
from fractus_services.recording.segment_writer import rebuild_index
from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import MCAP0_MAGIC
from pymavlink.dialects.v20 import ardupilotmega as mavlink

S = 1_000_000_000
T0 = 1_780_000_000 * S
UNKNOWN = bytes.fromhex("fd 04 00 00 07 01 01 f0 d8 00 01020304 abcd")
"""Frame of message 55536, which the dialect does not define."""


class Vehicle:
    """Fake vehicle that encodes messages of its autopilot."""

    def __init__(self) -> None:
        self.endpoint = Endpoint(1, 1)
        self.boot_ms = 0

    def heartbeat(self, armed: bool) -> bytes:
        mode = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0
        return self.endpoint.encode(
            "HEARTBEAT",
            {"type": 2, "autopilot": mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, "base_mode": mode, "mavlink_version": 3},
        )

    def position(self, lat: float, lon: float, amsl_m: float) -> bytes:
        self.boot_ms += 50
        position = {"lat": round(lat * 1e7), "lon": round(lon * 1e7), "alt": round(amsl_m * 1000)}
        return self.endpoint.encode("GLOBAL_POSITION_INT", {"time_boot_ms": self.boot_ms, **position})

    def attitude(self) -> bytes:
        return self.endpoint.encode("ATTITUDE", {"roll": 0.1, "pitch": -0.2, "yaw": 1.5})

    def text(self, text: str) -> bytes:
        return self.endpoint.encode("STATUSTEXT", {"severity": 4, "text": text.encode()})


class SteadyClock:
    """Steady clock set by the tests."""

    now_s = 0.0


@pytest.fixture(autouse=True)
def steady_clock() -> Iterator[None]:
    SteadyClock.now_s = 0.0
    yield
    while open_writers:
        open_writers.pop().segments.unlock()


open_writers: list[FlightWriter] = []


def writer_in(directory: Path, megabytes: float = 4.0, *, always: bool = False) -> FlightWriter:
    """Return a new writer, as after a restart of the service. The locks of previous writers are released first."""
    while open_writers:
        open_writers.pop().segments.unlock()
    segments = SegmentDirectory(directory, int(megabytes * 1e6), reserve_bytes=0)
    decoder = None if always else MavlinkDecoder("drone-1")
    open_writers.append(FlightWriter(segments, "drone-1", decoder, steady=lambda: SteadyClock.now_s))
    open_writers[-1].begin()
    return open_writers[-1]


def wait_for_index(writer: FlightWriter, path: Path) -> None:
    """Wait until the writer has added the missing index to the file of a crashed process."""
    until(lambda: writer.tick() or path.read_bytes().endswith(MCAP0_MAGIC))


def fly(writer: FlightWriter, begin_s: int, seconds: int, vehicle: Vehicle | None = None) -> None:
    """Record a minute on the ground, a flight of some seconds, and another minute on the ground."""
    vehicle = vehicle or Vehicle()
    companion = Endpoint(244, 191)
    for second in range(begin_s - 60, begin_s + seconds + 60):
        armed = begin_s <= second < begin_s + seconds
        now = T0 + second * S
        SteadyClock.now_s += 1.0
        writer.received(now, vehicle.heartbeat(armed))
        writer.received(now + 1000, vehicle.position(39.0 + second * 1e-5, 22.0, 100.0 + second) + vehicle.attitude())
        writer.sent(now + 2000, companion.encode("TIMESYNC", {"ts1": second}))
        writer.tick()


def files(directory: Path, suffix: str) -> list[Path]:
    return sorted(directory.glob(f"*{suffix}"))


def tlog(path: Path) -> list[Any]:
    from pymavlink import mavutil

    log = mavutil.mavlink_connection(str(path))
    received = []
    while (message := log.recv_match()) is not None:
        if message.get_type() != "BAD_DATA":
            received.append(message)
    log.close()
    return received


def mcap(path: Path) -> dict[str, list[tuple[int, Any]]]:
    by_topic: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert schema is not None and schema.encoding == "jsonschema"
            assert set(json.loads(message.data)) <= set(json.loads(schema.data)["properties"])
            by_topic.setdefault(f"{channel.topic} {schema.name}", []).append(
                (message.log_time, json.loads(message.data))
            )
    return by_topic


def test_flight_is_recorded_with_seconds_before_and_after(tmp_path: Path) -> None:
    writer = writer_in(tmp_path / "r")
    vehicle = Vehicle()
    fly(writer, 100, 30, vehicle)
    (frames,) = files(tmp_path / "r", ".tlog")
    (messages,) = files(tmp_path / "r", ".mcap")
    assert frames.stem == messages.stem == "000001-20260528T202809Z"
    kinds = Counter(message.get_type() for message in tlog(frames))
    assert kinds["HEARTBEAT"] == kinds["GLOBAL_POSITION_INT"] == kinds["ATTITUDE"]
    assert abs(kinds["HEARTBEAT"] - (10 + 30 + 10)) <= 2
    assert kinds["TIMESYNC"] >= 48, "messages of the companion are also recorded"
    assert tlog(frames)[0]._timestamp == pytest.approx(T0 / 1e9 + 90, abs=1.1)
    by_topic = mcap(messages)
    fixes = by_topic["/drone-1/location foxglove.LocationFix"]
    assert len(fixes) == kinds["GLOBAL_POSITION_INT"]
    time_ns, fix = fixes[20]
    second = (time_ns - T0) // S
    assert (fix["latitude"], fix["longitude"], fix["altitude"]) == pytest.approx(
        (39.0 + second * 1e-5, 22.0, 100.0 + second)
    )
    assert fix["timestamp"] == {"sec": time_ns // S, "nsec": time_ns % S}
    assert by_topic["/drone-1/attitude fractus.Attitude"][0][1] == {"roll_rad": 0.1, "pitch_rad": -0.2, "yaw_rad": 1.5}


def test_each_flight_has_separate_files_and_time_on_ground_has_none(tmp_path: Path) -> None:
    writer = writer_in(tmp_path)
    for second in range(600):
        SteadyClock.now_s = float(second)
        writer.received(T0 + second * S, Vehicle().heartbeat(False))
        writer.tick()
    assert not list(tmp_path.iterdir())
    fly(writer, 1000, 5)
    fly(writer, 2000, 5)
    assert [path.name[:6] for path in files(tmp_path, ".mcap")] == ["000001", "000002"]


def test_tlog_is_read_by_mavlogdump(tmp_path: Path) -> None:
    writer = writer_in(tmp_path)
    vehicle = Vehicle()
    fly(writer, 100, 5, vehicle)
    program = Path(sys.executable).with_name("mavlogdump.py")
    (path,) = files(tmp_path, ".tlog")
    argv = [sys.executable, str(program), "--format", "json", "--types", "GLOBAL_POSITION_INT", str(path)]
    done = subprocess.run(argv, capture_output=True, text=True, check=True, timeout=120)
    first = json.loads(done.stdout.splitlines()[0])
    assert first["data"]["lat"] == pytest.approx(39e7 + 90 * 100, abs=300)


def test_tlog_contains_frames_of_unknown_messages(tmp_path: Path) -> None:
    unknown: list[bytes] = []
    parser = Parser(unknown=unknown.append)
    vehicle = Vehicle()
    known = vehicle.heartbeat(True)
    assert [message.frame for message in parser.feed(b"noise" + UNKNOWN[:9])] == []
    assert [message.frame for message in parser.feed(UNKNOWN[9:] + known)] == [known]
    assert unknown == [UNKNOWN]
    writer = writer_in(tmp_path)
    writer.received(T0, known)
    writer.received(T0, UNKNOWN)
    writer.end()
    assert files(tmp_path, ".tlog")[0].read_bytes().endswith(UNKNOWN)


def test_mcap_contains_decisions_statustexts_and_zones(tmp_path: Path) -> None:
    import yaml

    writer = writer_in(tmp_path)
    vehicle = Vehicle()
    spec = Grant.from_body(yaml.safe_load(GRANT)).spec
    writer.grants(T0, [spec])
    writer.received(T0, vehicle.heartbeat(True))
    writer.received(T0 + S, vehicle.text("PreArm: no luck"))
    call = {
        "time": "2026-05-28T20:26:42.000+00:00",
        "kind": "call",
        "caller": spec.identity,
        "method": "Goto",
        "action": "deny",
    }
    writer.entry(
        T0 + S, {**call, "code": "InsideExclusionZone", "reason": "the pool", "policies": ["pool"], "lat": 39.0}
    )
    writer.entry(
        T0 + S, {"time": call["time"], "kind": "state", "alt": 5.0, "amsl": 15.0, "mode": "GUIDED", "in_air": True}
    )
    writer.grants(T0 + 2 * S, [])
    writer.end()
    by_topic = mcap(files(tmp_path, ".mcap")[0])
    ((_, decision),) = by_topic["/drone-1/decisions fractus.Decision"]
    assert (decision["code"], decision["policies"], decision["latitude"]) == ("InsideExclusionZone", ["pool"], 39.0)
    lines = [(content["level"], content["message"]) for _, content in by_topic["/drone-1/log foxglove.Log"]]
    assert lines == [(3, "PreArm: no luck"), (3, "Navigator Goto deny: InsideExclusionZone, the pool")]
    ((_, state),) = by_topic["/drone-1/state fractus.State"]
    assert (state["mode"], state["altitude_m"], state["in_air"]) == ("GUIDED", 5.0, True)
    maps = [json.loads(content["geojson"]) for _, content in by_topic["/drone-1/zones foxglove.GeoJSON"]]
    assert [[f["properties"]["kind"] for f in collection["features"]] for collection in maps] == [
        ["zone", "operationArea"],
        [],
    ]
    assert maps[0]["features"][0]["properties"]["uses"] == ["exclusion"]


def test_oldest_segments_are_removed_and_files_are_private(tmp_path: Path) -> None:
    directory = tmp_path / "deep" / "r"
    limit_mb = 1.5
    writer = writer_in(directory, limit_mb)
    vehicle = Vehicle()
    numbers = set[int]()
    frames = vehicle.heartbeat(True) + vehicle.position(39.0, 22.0, 100.0)
    for second in range(3000):
        now = T0 + second * S
        for _ in range(5):
            writer.received(now, frames + os.urandom(30))
            writer.sent(now, os.urandom(200))
        if second % 5 == 0:
            writer._flush_due_s = 0.0
        writer.tick()
        segments = writer.segments.by_number()
        numbers |= set(segments)
        used = sum(path.stat().st_size for paths in segments.values() for path in paths)
        # Data written since the last check may exceed the limit.
        assert used <= limit_mb * 1e6 + 50_000
    writer.end()
    assert len(numbers) > 8 and min(writer.segments.by_number()) > 1, "the oldest segments were removed"
    assert stat.S_IMODE(directory.stat().st_mode) == 0o700
    assert {stat.S_IMODE(path.stat().st_mode) for path in directory.iterdir()} == {0o600}
    for path in files(directory, ".mcap"):
        assert mcap(path)


def test_files_of_a_crashed_process_are_readable_and_completed(tmp_path: Path) -> None:
    writer = writer_in(tmp_path)
    vehicle = Vehicle()
    for second in range(20):
        writer.received(T0 + second * S, vehicle.heartbeat(True) + vehicle.position(39.0, 22.0, 100.0))
    segment = writer._segment
    assert segment is not None
    segment.flush()
    writer.received(T0 + 20 * S, vehicle.position(39.0, 22.0, 100.0))
    (frames,) = files(tmp_path, ".tlog")
    (messages,) = files(tmp_path, ".mcap")
    original = messages.read_bytes()
    read = []
    with pytest.raises(Exception, match=r".*"), messages.open("rb") as file:
        read.extend(message for _, _, message in NonSeekingReader(file).iter_messages(log_time_order=False))
    assert len(read) == 20
    data = frames.read_bytes()
    for cut in range(len(data) - 60, len(data), 7):
        (tmp_path / "cut.tlog").write_bytes(data[:cut])
        assert len(tlog(tmp_path / "cut.tlog")) in {37, 38, 39, 40}
    (tmp_path / "cut.tlog").unlink()

    for content in (original, original[:-3], original + b"\x06\xff\xff"):
        messages.write_bytes(content)
        restarted = writer_in(tmp_path)
        wait_for_index(restarted, messages)
        assert len(mcap(messages)["/drone-1/location foxglove.LocationFix"]) == 20
        assert stat.S_IMODE(messages.stat().st_mode) == 0o600
        assert restarted.segments.new_segment(T0).name.startswith("000002")
    completed = messages.read_bytes()
    writer_in(tmp_path).tick()
    assert messages.read_bytes() == completed, "a complete file is not changed"


def recording_of_crashed_process(directory: Path, seconds: int = 200) -> Path:
    """Record a flight without its end, as if the process was killed. Return the MCAP file without index."""
    writer = writer_in(directory)
    vehicle = Vehicle()
    for second in range(seconds):
        writer.received(T0 + second * S, vehicle.heartbeat(True) + vehicle.position(39.0, 22.0, 100.0))
    writer.flush()
    (path,) = files(directory, ".mcap")
    return path


def test_index_is_not_rebuilt_in_flight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = recording_of_crashed_process(tmp_path)
    before = broken.read_bytes()
    monkeypatch.setattr(recorder, "INDEX_SLICE_S", 0.0001)
    writer = writer_in(tmp_path)
    vehicle = Vehicle()
    for second in range(100):
        SteadyClock.now_s += 0.25
        writer.received(T0 + (300 + second) * S, vehicle.heartbeat(True))
        writer.tick()
    assert broken.read_bytes() == before and not files(tmp_path, ".part")
    SteadyClock.now_s += 11.0
    steps = 0

    def landed() -> bool:
        nonlocal steps
        steps += 1
        writer.tick()
        return broken.read_bytes().endswith(MCAP0_MAGIC)

    until(landed)
    assert steps > 5, "the index is rebuilt in small steps"
    assert len(mcap(broken)["/drone-1/location foxglove.LocationFix"]) == 200


def test_file_removed_during_index_rebuild_is_not_restored(tmp_path: Path) -> None:
    broken = recording_of_crashed_process(tmp_path)
    steps = rebuild_index(broken)
    next(steps)
    broken.unlink()
    list(steps)
    assert not broken.exists() and not files(tmp_path, ".part")


def test_partial_index_file_of_a_crash_is_removed(tmp_path: Path) -> None:
    orphan = tmp_path / "000007-20260601T120000Z.part"
    foreign = tmp_path / "download.part"
    orphan.write_bytes(b"x")
    foreign.write_bytes(b"x")
    writer_in(tmp_path)
    assert not orphan.exists() and foreign.exists()


def test_failed_index_rebuild_does_not_stop_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    broken = recording_of_crashed_process(tmp_path)

    def full(_file: int) -> None:
        raise OSError(errno.EDQUOT, "Disk quota exceeded")

    monkeypatch.setattr(os, "fsync", full)
    writer = writer_in(tmp_path)
    until(lambda: writer.tick() or "Disk quota exceeded" in caplog.text)
    assert not files(tmp_path, ".part") and str(broken) in caplog.text
    fly(writer, 1000, 5)
    assert len(files(tmp_path, ".mcap")) == 2


def test_recording_directory_has_one_writer(tmp_path: Path) -> None:
    first, second = (SegmentDirectory(tmp_path, 4_000_000, reserve_bytes=0) for _ in range(2))
    first.prepare()
    with pytest.raises(
        OSError, match=r"another service records into .*; give each its own directory with --recordings"
    ):
        second.prepare()
    flight_recorder = Recorder(second, "drone-1", MavlinkDecoder("drone-1"))
    until(lambda: flight_recorder.problem)
    assert f"another service records into {tmp_path}" in flight_recorder.problem
    asyncio.run(flight_recorder.close())
    first.unlock()
    second.prepare()
    second.unlock()


def test_existing_directory_keeps_its_mode(tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o755)
    writer_in(shared)
    assert stat.S_IMODE(shared.stat().st_mode) == 0o755
    writer_in(shared / "own")
    assert stat.S_IMODE((shared / "own").stat().st_mode) == 0o700


@pytest.mark.parametrize("step_s", [-3600, 3600])
def test_step_of_wall_clock_does_not_end_recording(tmp_path: Path, step_s: int) -> None:
    writer = writer_in(tmp_path)
    vehicle = Vehicle()
    for second in range(60):
        SteadyClock.now_s += 1.0
        now = T0 + second * S + (step_s * S if second >= 15 else 0)
        writer.received(now, vehicle.heartbeat(10 <= second < 14))
        writer.tick()
    (path,) = files(tmp_path, ".tlog")
    assert len([m for m in tlog(path) if m.get_type() == "HEARTBEAT"]) == pytest.approx(10 + 4 + 10, abs=2)


def test_pending_data_stays_bounded_after_clock_is_set_back(tmp_path: Path) -> None:
    writer = writer_in(tmp_path)
    vehicle = Vehicle()
    for second in range(3000):
        SteadyClock.now_s = float(second)
        writer.received(T0 - second * S, vehicle.heartbeat(False))
        writer.tick()
    assert len(writer._pending) <= 11
    fly(writer, 0, 5)
    fly(writer, -10_000, 5)
    assert [path.name[:6] for path in files(tmp_path, ".mcap")] == ["000001", "000002"]


def test_pictures_are_recorded_unchanged(tmp_path: Path) -> None:
    writer = writer_in(tmp_path, always=True)
    writer.picture(T0, b"\xff\xd8 a picture", "uid/identity")
    writer.end()
    ((time_ns, picture),) = mcap(files(tmp_path, ".mcap")[0])["/drone-1/picture foxglove.CompressedImage"]
    assert (time_ns, base64.b64decode(picture["data"]), picture["format"]) == (T0, b"\xff\xd8 a picture", "jpeg")
    assert picture["owner"] == "uid/identity"


def until(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder, "POLL_INTERVAL_S", 0.005)
    monkeypatch.setattr(recorder, "RETRY_S", 0.02)
    monkeypatch.setattr(recorder, "FLUSH_INTERVAL_S", 0.0)


def test_recording_is_off_without_directory_or_space(tmp_path: Path) -> None:
    assert segments_in(None, 500) is None
    assert segments_in(tmp_path, 0) is None
    disabled = Recorder(None, "n")
    disabled.take_received(b"x")
    disabled.take_picture("owner", 0.0, b"x")
    asyncio.run(disabled.close())
    assert not disabled.problem


@pytest.mark.usefixtures("quick")
def test_recording_continues_after_a_full_disk_has_space(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    full = threading.Event()

    def sync(_file: int) -> None:
        if full.is_set():
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fdatasync", sync)
    vehicle = Vehicle()
    flight_recorder = Recorder(
        SegmentDirectory(tmp_path, 4_000_000, reserve_bytes=0), "drone-1", MavlinkDecoder("drone-1")
    )

    def record_frames() -> None:
        flight_recorder.take_received(vehicle.heartbeat(True) + vehicle.position(39.0, 22.0, 100.0))

    record_frames()
    until(lambda: files(tmp_path, ".mcap"))
    full.set()

    def failed() -> bool:
        record_frames()
        return bool(flight_recorder.problem)

    until(failed)
    assert "No space left on device" in flight_recorder.problem
    before = len(files(tmp_path, ".mcap"))
    full.clear()

    def continued() -> bool:
        record_frames()
        return not flight_recorder.problem and len(files(tmp_path, ".mcap")) > before

    until(continued)
    asyncio.run(flight_recorder.close())
    assert sum("recording: stopped" in record.message for record in caplog.records) >= 1
    assert mcap(files(tmp_path, ".mcap")[-1])


@pytest.mark.usefixtures("quick")
def test_missing_disk_space_is_logged_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    records_before = len(caplog.records)
    flight_recorder = Recorder(
        SegmentDirectory(tmp_path / "r", 4_000_000, reserve_bytes=2**62), "drone-1", MavlinkDecoder("drone-1")
    )
    until(lambda: flight_recorder.problem)
    vehicle = Vehicle()
    deadline = time.monotonic() + 0.3
    while time.monotonic() < deadline:  # about twelve attempts
        flight_recorder.take_received(vehicle.heartbeat(True))
        time.sleep(0.01)
    asyncio.run(flight_recorder.close())
    assert "are free on its disk" in flight_recorder.problem
    warnings = [record for record in caplog.records[records_before:] if record.levelno >= logging.WARNING]
    assert len(warnings) == 1, [record.message for record in warnings]
    assert not list((tmp_path / "r").iterdir())


def test_hanging_disk_does_not_block_callers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    hangs = threading.Event()
    monotonic = time.monotonic
    monkeypatch.setattr(recorder, "POLL_INTERVAL_S", 0.005)
    monkeypatch.setattr(FlightWriter, "received", lambda _self, _now, _data: hangs.wait(60))
    flight_recorder = Recorder(
        SegmentDirectory(tmp_path, 4_000_000, reserve_bytes=0), "drone-1", MavlinkDecoder("drone-1"), max_waiting=50
    )
    flight_recorder.take_received(b"")
    until(lambda: flight_recorder._busy_since_s is not None and flight_recorder._waiting.empty())
    for _ in range(500):
        flight_recorder.take_received(bytes(100))
    assert flight_recorder._waiting.qsize() == 50
    monkeypatch.setattr(recorder.time, "monotonic", lambda: monotonic() + 100.0)
    assert "the disk has not responded for" in flight_recorder.problem
    monkeypatch.undo()
    hangs.set()
    until(lambda: not flight_recorder.problem)
    asyncio.run(flight_recorder.close())
    assert any("lost=450" in record.message for record in caplog.records)


@pytest.mark.usefixtures("quick")
def test_internal_error_is_reported_and_does_not_crash(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder, "RETRY_S", 60.0)

    def broken(*_: object) -> None:
        raise ZeroDivisionError("oops")

    monkeypatch.setattr(FlightWriter, "sent", broken)
    flight_recorder = Recorder(
        SegmentDirectory(tmp_path, 4_000_000, reserve_bytes=0), "drone-1", MavlinkDecoder("drone-1")
    )
    flight_recorder.take_sent(b"x")
    until(lambda: flight_recorder.problem == "recording stopped: ZeroDivisionError: oops")
    flight_recorder.take_entry({})
    asyncio.run(flight_recorder.close())


@pytest.mark.usefixtures("quick")
def test_agent_reads_recording_problems_of_services(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    state = tmp_path / "camera"
    state.mkdir()
    (state / "recording.problem").write_text("of an earlier process")
    full = threading.Event()
    full.set()

    def check(_self: SegmentDirectory) -> None:
        if full.is_set():
            raise OSError(errno.ENOSPC, "no room")

    monkeypatch.setattr(SegmentDirectory, "check_space", check)
    Recorder(None, "drone-1", problem_file=state / "recording.problem")
    assert read_recording_problems(tmp_path) == []
    flight_recorder = Recorder(
        SegmentDirectory(tmp_path / "r", 4_000_000),
        "drone-1",
        MavlinkDecoder("drone-1"),
        problem_file=state / "recording.problem",
    )
    until(lambda: read_recording_problems(tmp_path) == ["camera: recording stopped: no room"])
    full.clear()
    until(lambda: read_recording_problems(tmp_path) == [])
    asyncio.run(flight_recorder.close())


async def test_audit_entries_are_passed_to_the_recorder(tmp_path: Path) -> None:
    copied: list[dict[str, Any]] = []
    log = AuditLog(tmp_path / "audit.jsonl", lambda: 1_780_000_000.0, listeners=(copied.append,))
    log.append("control", {"action": "takenOver"})
    await log.close()
    assert copied == [{"time": "2026-05-28T20:26:40.000+00:00", "kind": "control", "action": "takenOver"}]


def test_node_status_reports_recording_problems() -> None:
    from datetime import UTC, datetime

    certified = ConditionUpdate("Certified", "True", "Issued", "")
    cases = (("", (), ""), ("flights stopped", (), "flights stopped"), ("", ("camera: full",), "camera: full"))
    for flights, node_problems, problem in cases:
        telemetry = parse_telemetry(Telemetry(recording_problem=flights))
        observed = NodeObservation(
            "Drone",
            has_mobility=True,
            needs_certificate=True,
            certified=certified,
            snapshot=telemetry,
            recording_problems=node_problems,
        )
        status = node_status(observed, {}, 1, datetime(2026, 6, 1, tzinfo=UTC))
        messages = [c["message"] for c in status["conditions"] if c["type"] == "Recording" and c["status"] == "False"]
        assert messages == ([problem] if problem else [])


def test_segment_size_has_a_minimum_and_a_maximum(tmp_path: Path) -> None:
    assert SegmentDirectory(tmp_path, 1).segment_bytes == MIN_SEGMENT_BYTES
    assert SegmentDirectory(tmp_path, 10**12).segment_bytes == 32_000_000

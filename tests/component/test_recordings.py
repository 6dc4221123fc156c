"""Recordings of flights, opened by the readers of others: what is in them, their bound, and what a failing disk does."""

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
from fractus_agent.conditions import Condition
from fractus_agent.registration.diagnostics import read_recording_problems
from fractus_agent.registration.node_status import NodeObservation, node_status
from fractus_agent.telemetry import parse_telemetry
from fractus_core.api import Grant
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
"""A sound-looking frame of a message that our dialect does not have (55536)."""


class Vehicle:
    """What an autopilot says."""

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
        place = {"lat": round(lat * 1e7), "lon": round(lon * 1e7), "alt": round(amsl_m * 1000)}
        return self.endpoint.encode("GLOBAL_POSITION_INT", {"time_boot_ms": self.boot_ms, **place})

    def attitude(self) -> bytes:
        return self.endpoint.encode("ATTITUDE", {"roll": 0.1, "pitch": -0.2, "yaw": 1.5})

    def text(self, words: str) -> bytes:
        return self.endpoint.encode("STATUSTEXT", {"severity": 4, "text": words.encode()})


class Steady:
    """A clock that does not jump."""

    now_s = 0.0


@pytest.fixture(autouse=True)
def steady() -> Iterator[None]:
    Steady.now_s = 0.0
    yield
    while opened:
        opened.pop().segments.unlock()


opened: list[FlightWriter] = []


def writer_in(directory: Path, megabytes: float = 4.0, *, always: bool = False) -> FlightWriter:
    """A writer of a process that takes the place of the one before."""
    while opened:
        opened.pop().segments.unlock()
    segments = SegmentDirectory(directory, int(megabytes * 1e6), reserve_bytes=0)
    decoder = None if always else MavlinkDecoder("drone-1")
    opened.append(FlightWriter(segments, "drone-1", decoder, steady=lambda: Steady.now_s))
    opened[-1].begin()
    return opened[-1]


def made_whole(writer: FlightWriter, path: Path) -> None:
    """Wait until what a crash left is complete."""
    until(lambda: writer.tick() or path.read_bytes().endswith(MCAP0_MAGIC))


def fly(writer: FlightWriter, begin_s: int, seconds: int, vehicle: Vehicle | None = None) -> None:
    """A minute on the ground, some seconds with the motors on, a minute on the ground."""
    vehicle = vehicle or Vehicle()
    companion = Endpoint(244, 191)
    for second in range(begin_s - 60, begin_s + seconds + 60):
        armed = begin_s <= second < begin_s + seconds
        now = T0 + second * S
        Steady.now_s += 1.0
        writer.received(now, vehicle.heartbeat(armed))
        writer.received(now + 1000, vehicle.position(39.0 + second * 1e-5, 22.0, 100.0 + second) + vehicle.attitude())
        writer.sent(now + 2000, companion.encode("TIMESYNC", {"ts1": second}))
        writer.tick()


def files(directory: Path, suffix: str) -> list[Path]:
    return sorted(directory.glob(f"*{suffix}"))


def tlog(path: Path) -> list[Any]:
    from pymavlink import mavutil

    log = mavutil.mavlink_connection(str(path))
    found = []
    while (message := log.recv_match()) is not None:
        if message.get_type() != "BAD_DATA":
            found.append(message)
    log.close()
    return found


def mcap(path: Path) -> dict[str, list[tuple[int, Any]]]:
    found: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert schema is not None and schema.encoding == "jsonschema"
            assert set(json.loads(message.data)) <= set(json.loads(schema.data)["properties"])
            found.setdefault(f"{channel.topic} {schema.name}", []).append((message.log_time, json.loads(message.data)))
    return found


def test_a_flight_is_recorded_with_a_little_before_and_after(tmp_path: Path) -> None:
    writer = writer_in(tmp_path / "r")
    vehicle = Vehicle()
    fly(writer, 100, 30, vehicle)
    (frames,) = files(tmp_path / "r", ".tlog")
    (messages,) = files(tmp_path / "r", ".mcap")
    assert frames.stem == messages.stem == "000001-20260528T202809Z"
    kinds = Counter(message.get_type() for message in tlog(frames))
    assert kinds["HEARTBEAT"] == kinds["GLOBAL_POSITION_INT"] == kinds["ATTITUDE"]
    assert abs(kinds["HEARTBEAT"] - (10 + 30 + 10)) <= 2
    assert kinds["TIMESYNC"] >= 48, "what the companion sent, too"
    assert tlog(frames)[0]._timestamp == pytest.approx(T0 / 1e9 + 90, abs=1.1)
    found = mcap(messages)
    fixes = found["/drone-1/location foxglove.LocationFix"]
    assert len(fixes) == kinds["GLOBAL_POSITION_INT"]
    time_ns, fix = fixes[20]
    second = (time_ns - T0) // S
    assert (fix["latitude"], fix["longitude"], fix["altitude"]) == pytest.approx(
        (39.0 + second * 1e-5, 22.0, 100.0 + second)
    )
    assert fix["timestamp"] == {"sec": time_ns // S, "nsec": time_ns % S}
    assert found["/drone-1/attitude fractus.Attitude"][0][1] == {"roll_rad": 0.1, "pitch_rad": -0.2, "yaw_rad": 1.5}


def test_each_flight_has_files_of_its_own_and_the_ground_has_none(tmp_path: Path) -> None:
    writer = writer_in(tmp_path)
    for second in range(600):
        Steady.now_s = float(second)
        writer.received(T0 + second * S, Vehicle().heartbeat(False))
        writer.tick()
    assert not list(tmp_path.iterdir())
    fly(writer, 1000, 5)
    fly(writer, 2000, 5)
    assert [path.name[:6] for path in files(tmp_path, ".mcap")] == ["000001", "000002"]


def test_ground_stations_tools_read_the_tlog(tmp_path: Path) -> None:
    writer = writer_in(tmp_path)
    vehicle = Vehicle()
    fly(writer, 100, 5, vehicle)
    program = Path(sys.executable).with_name("mavlogdump.py")
    (path,) = files(tmp_path, ".tlog")
    argv = [sys.executable, str(program), "--format", "json", "--types", "GLOBAL_POSITION_INT", str(path)]
    done = subprocess.run(argv, capture_output=True, text=True, check=True, timeout=120)
    first = json.loads(done.stdout.splitlines()[0])
    assert first["data"]["lat"] == pytest.approx(39e7 + 90 * 100, abs=300)


def test_frames_beyond_the_dialect_are_in_the_tlog(tmp_path: Path) -> None:
    heard: list[bytes] = []
    parser = Parser(unknown=heard.append)
    vehicle = Vehicle()
    sound = vehicle.heartbeat(True)
    assert [message.frame for message in parser.feed(b"noise" + UNKNOWN[:9])] == []
    assert [message.frame for message in parser.feed(UNKNOWN[9:] + sound)] == [sound]
    assert heard == [UNKNOWN]
    writer = writer_in(tmp_path)
    writer.received(T0, sound)
    writer.received(T0, UNKNOWN)
    writer.end()
    assert files(tmp_path, ".tlog")[0].read_bytes().endswith(UNKNOWN)


def test_decisions_texts_and_zones_are_in_the_mcap(tmp_path: Path) -> None:
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
    found = mcap(files(tmp_path, ".mcap")[0])
    ((_, decision),) = found["/drone-1/decisions fractus.Decision"]
    assert (decision["code"], decision["policies"], decision["latitude"]) == ("InsideExclusionZone", ["pool"], 39.0)
    lines = [(content["level"], content["message"]) for _, content in found["/drone-1/log foxglove.Log"]]
    assert lines == [(3, "PreArm: no luck"), (3, "Navigator Goto deny: InsideExclusionZone, the pool")]
    ((_, state),) = found["/drone-1/state fractus.State"]
    assert (state["mode"], state["altitude_m"], state["in_air"]) == ("GUIDED", 5.0, True)
    maps = [json.loads(content["geojson"]) for _, content in found["/drone-1/zones foxglove.GeoJSON"]]
    assert [[f["properties"]["kind"] for f in one["features"]] for one in maps] == [["zone", "operationArea"], []]


def test_the_oldest_make_room_and_no_other_user_reads_them(tmp_path: Path) -> None:
    directory = tmp_path / "deep" / "r"
    limit_mb = 1.5
    writer = writer_in(directory, limit_mb)
    vehicle = Vehicle()
    seen = set[int]()
    said = vehicle.heartbeat(True) + vehicle.position(39.0, 22.0, 100.0)
    for second in range(3000):
        now = T0 + second * S
        for _ in range(5):
            writer.received(now, said + os.urandom(30))
            writer.sent(now, os.urandom(200))
        if second % 5 == 0:
            writer._flush_due_s = 0.0
        writer.tick()
        found = writer.segments.by_number()
        seen |= set(found)
        used = sum(path.stat().st_size for paths in found.values() for path in paths)
        # What is written between two looks comes on top.
        assert used <= limit_mb * 1e6 + 50_000
    writer.end()
    assert len(seen) > 8 and min(writer.segments.by_number()) > 1, "the oldest are gone"
    assert stat.S_IMODE(directory.stat().st_mode) == 0o700
    assert {stat.S_IMODE(path.stat().st_mode) for path in directory.iterdir()} == {0o600}
    for path in files(directory, ".mcap"):
        assert mcap(path)


def test_what_a_crash_leaves_can_be_read_and_is_completed(tmp_path: Path) -> None:
    writer = writer_in(tmp_path)
    vehicle = Vehicle()
    for second in range(20):
        writer.received(T0 + second * S, vehicle.heartbeat(True) + vehicle.position(39.0, 22.0, 100.0))
    tape = writer._segment
    assert tape is not None
    tape.flush()
    writer.received(T0 + 20 * S, vehicle.position(39.0, 22.0, 100.0))
    (frames,) = files(tmp_path, ".tlog")
    (messages,) = files(tmp_path, ".mcap")
    whole = messages.read_bytes()
    read = []
    with pytest.raises(Exception, match=r".*"), messages.open("rb") as file:
        read.extend(message for _, _, message in NonSeekingReader(file).iter_messages(log_time_order=False))
    assert len(read) == 20
    data = frames.read_bytes()
    for cut in range(len(data) - 60, len(data), 7):
        (tmp_path / "cut.tlog").write_bytes(data[:cut])
        assert len(tlog(tmp_path / "cut.tlog")) in {37, 38, 39, 40}
    (tmp_path / "cut.tlog").unlink()

    for kept in (whole, whole[:-3], whole + b"\x06\xff\xff"):
        messages.write_bytes(kept)
        again = writer_in(tmp_path)
        made_whole(again, messages)
        assert len(mcap(messages)["/drone-1/location foxglove.LocationFix"]) == 20
        assert stat.S_IMODE(messages.stat().st_mode) == 0o600
        assert again.segments.new_segment(T0).name.startswith("000002")
    done = messages.read_bytes()
    writer_in(tmp_path).tick()
    assert messages.read_bytes() == done, "what is complete is left alone"


def crashed(directory: Path, seconds: int = 200) -> Path:
    """A directory in which a process was killed in flight; the file that has no index."""
    writer = writer_in(directory)
    vehicle = Vehicle()
    for second in range(seconds):
        writer.received(T0 + second * S, vehicle.heartbeat(True) + vehicle.position(39.0, 22.0, 100.0))
    writer.flush()
    (path,) = files(directory, ".mcap")
    return path


def test_nothing_is_completed_while_a_drone_flies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = crashed(tmp_path)
    left = broken.read_bytes()
    monkeypatch.setattr(recorder, "INDEX_SLICE_S", 0.0001)
    writer = writer_in(tmp_path)
    vehicle = Vehicle()
    for second in range(100):
        Steady.now_s += 0.25
        writer.received(T0 + (300 + second) * S, vehicle.heartbeat(True))
        writer.tick()
    assert broken.read_bytes() == left and not files(tmp_path, ".part")
    Steady.now_s += 11.0
    steps = 0

    def landed() -> bool:
        nonlocal steps
        steps += 1
        writer.tick()
        return broken.read_bytes().endswith(MCAP0_MAGIC)

    until(landed)
    assert steps > 5, "a little at a time"
    assert len(mcap(broken)["/drone-1/location foxglove.LocationFix"]) == 200


def test_a_file_that_made_room_meanwhile_does_not_come_back(tmp_path: Path) -> None:
    broken = crashed(tmp_path)
    steps = rebuild_index(broken)
    next(steps)
    broken.unlink()
    list(steps)
    assert not broken.exists() and not files(tmp_path, ".part")


def test_what_a_crash_left_half_made_is_removed_and_nothing_else(tmp_path: Path) -> None:
    orphan = tmp_path / "000007-20260601T120000Z.part"
    foreign = tmp_path / "download.part"
    orphan.write_bytes(b"x")
    foreign.write_bytes(b"x")
    writer_in(tmp_path)
    assert not orphan.exists() and foreign.exists()


def test_one_file_that_cannot_be_completed_stops_no_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    broken = crashed(tmp_path)

    def full(_file: int) -> None:
        raise OSError(errno.EDQUOT, "Disk quota exceeded")

    monkeypatch.setattr(os, "fsync", full)
    writer = writer_in(tmp_path)
    until(lambda: writer.tick() or "Disk quota exceeded" in caplog.text)
    assert not files(tmp_path, ".part") and str(broken) in caplog.text
    fly(writer, 1000, 5)
    assert len(files(tmp_path, ".mcap")) == 2


def test_a_directory_has_one_writer(tmp_path: Path) -> None:
    first, second = (SegmentDirectory(tmp_path, 4_000_000, reserve_bytes=0) for _ in range(2))
    first.prepare()
    with pytest.raises(
        OSError, match=r"another service records into .*; give each its own directory with --recordings"
    ):
        second.prepare()
    taken = Recorder(second, "drone-1", MavlinkDecoder("drone-1"))
    until(lambda: taken.problem)
    assert f"another service records into {tmp_path}" in taken.problem
    asyncio.run(taken.close())
    first.unlock()
    second.prepare()
    second.unlock()


def test_only_a_directory_that_it_makes_gets_its_mode(tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o755)
    writer_in(shared)
    assert stat.S_IMODE(shared.stat().st_mode) == 0o755
    writer_in(shared / "own")
    assert stat.S_IMODE((shared / "own").stat().st_mode) == 0o700


@pytest.mark.parametrize("step_s", [-3600, 3600])
def test_the_wall_clock_does_not_say_when_a_flight_ends(tmp_path: Path, step_s: int) -> None:
    writer = writer_in(tmp_path)
    vehicle = Vehicle()
    for second in range(60):
        Steady.now_s += 1.0
        now = T0 + second * S + (step_s * S if second >= 15 else 0)
        writer.received(now, vehicle.heartbeat(10 <= second < 14))
        writer.tick()
    (path,) = files(tmp_path, ".tlog")
    assert len([m for m in tlog(path) if m.get_type() == "HEARTBEAT"]) == pytest.approx(10 + 4 + 10, abs=2)


def test_a_clock_that_is_set_back_lets_nothing_grow(tmp_path: Path) -> None:
    writer = writer_in(tmp_path)
    vehicle = Vehicle()
    for second in range(3000):
        Steady.now_s = float(second)
        writer.received(T0 - second * S, vehicle.heartbeat(False))
        writer.tick()
    assert len(writer._pending) <= 11
    fly(writer, 0, 5)
    fly(writer, -10_000, 5)
    assert [path.name[:6] for path in files(tmp_path, ".mcap")] == ["000001", "000002"]


def test_pictures_are_recorded_as_they_are(tmp_path: Path) -> None:
    writer = writer_in(tmp_path, always=True)
    writer.picture(T0, b"\xff\xd8 a picture")
    writer.end()
    ((time_ns, picture),) = mcap(files(tmp_path, ".mcap")[0])["/drone-1/picture foxglove.CompressedImage"]
    assert (time_ns, base64.b64decode(picture["data"]), picture["format"]) == (T0, b"\xff\xd8 a picture", "jpeg")


# The thread


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


def test_nothing_is_recorded_without_a_directory_or_room(tmp_path: Path) -> None:
    assert segments_in(None, 500) is None
    assert segments_in(tmp_path, 0) is None
    silent = Recorder(None, "n")
    silent.take_received(b"x")
    silent.take_picture(0.0, b"x")
    asyncio.run(silent.close())
    assert not silent.problem


@pytest.mark.usefixtures("quick")
def test_a_full_disk_stops_the_recording_and_it_goes_on_when_there_is_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    full = threading.Event()

    def sync(_file: int) -> None:
        if full.is_set():
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fdatasync", sync)
    vehicle = Vehicle()
    taken = Recorder(SegmentDirectory(tmp_path, 4_000_000, reserve_bytes=0), "drone-1", MavlinkDecoder("drone-1"))

    def flies() -> None:
        taken.take_received(vehicle.heartbeat(True) + vehicle.position(39.0, 22.0, 100.0))

    flies()
    until(lambda: files(tmp_path, ".mcap"))
    full.set()

    def failed() -> bool:
        flies()
        return bool(taken.problem)

    until(failed)
    assert "No space left on device" in taken.problem
    before = len(files(tmp_path, ".mcap"))
    full.clear()

    def goes_on() -> bool:
        flies()
        return not taken.problem and len(files(tmp_path, ".mcap")) > before

    until(goes_on)
    asyncio.run(taken.close())
    assert sum("recording: stopped" in record.message for record in caplog.records) >= 1
    assert mcap(files(tmp_path, ".mcap")[-1])


@pytest.mark.usefixtures("quick")
def test_one_line_tells_that_a_disk_has_no_room(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    tried = len(caplog.records)
    taken = Recorder(
        SegmentDirectory(tmp_path / "r", 4_000_000, reserve_bytes=2**62), "drone-1", MavlinkDecoder("drone-1")
    )
    until(lambda: taken.problem)
    vehicle = Vehicle()
    deadline = time.monotonic() + 0.3
    while time.monotonic() < deadline:  # a dozen of attempts
        taken.take_received(vehicle.heartbeat(True))
        time.sleep(0.01)
    asyncio.run(taken.close())
    assert "are free on its disk" in taken.problem
    told = [record for record in caplog.records[tried:] if record.levelno >= logging.WARNING]
    assert len(told) == 1, [record.message for record in told]
    assert not list((tmp_path / "r").iterdir())


def test_a_disk_that_hangs_delays_no_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    hangs = threading.Event()
    monotonic = time.monotonic
    monkeypatch.setattr(recorder, "POLL_INTERVAL_S", 0.005)
    monkeypatch.setattr(FlightWriter, "received", lambda _self, _now, _data: hangs.wait(60))
    taken = Recorder(
        SegmentDirectory(tmp_path, 4_000_000, reserve_bytes=0), "drone-1", MavlinkDecoder("drone-1"), max_waiting=50
    )
    taken.take_received(b"")
    until(lambda: taken._busy_since_s is not None and taken._waiting.empty())
    for _ in range(500):
        taken.take_received(bytes(100))
    assert taken._waiting.qsize() == 50
    monkeypatch.setattr(recorder.time, "monotonic", lambda: monotonic() + 100.0)
    assert "the disk has not responded for" in taken.problem
    monkeypatch.undo()
    hangs.set()
    until(lambda: not taken.problem)
    asyncio.run(taken.close())
    assert any("lost=450" in record.message for record in caplog.records)


@pytest.mark.usefixtures("quick")
def test_an_error_of_ours_is_a_problem_and_no_crash(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder, "RETRY_S", 60.0)

    def broken(*_: object) -> None:
        raise ZeroDivisionError("oops")

    monkeypatch.setattr(FlightWriter, "sent", broken)
    taken = Recorder(SegmentDirectory(tmp_path, 4_000_000, reserve_bytes=0), "drone-1", MavlinkDecoder("drone-1"))
    taken.take_sent(b"x")
    until(lambda: taken.problem == "recording stopped: ZeroDivisionError: oops")
    taken.take_entry({})
    asyncio.run(taken.close())


@pytest.mark.usefixtures("quick")
def test_the_agent_is_told_what_is_not_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    taken = Recorder(
        SegmentDirectory(tmp_path / "r", 4_000_000),
        "drone-1",
        MavlinkDecoder("drone-1"),
        problem_file=state / "recording.problem",
    )
    until(lambda: read_recording_problems(tmp_path) == ["camera: recording stopped: no room"])
    full.clear()
    until(lambda: read_recording_problems(tmp_path) == [])
    asyncio.run(taken.close())


async def test_entries_of_the_audit_log_are_copied(tmp_path: Path) -> None:
    copied: list[dict[str, Any]] = []
    log = AuditLog(tmp_path / "audit.jsonl", lambda: 1_780_000_000.0, on_entry=copied.append)
    log.append("control", {"action": "takenOver"})
    await log.close()
    assert copied == [{"time": "2026-05-28T20:26:40.000+00:00", "kind": "control", "action": "takenOver"}]


def test_the_status_of_the_node_tells_that_nothing_is_recorded() -> None:
    from datetime import UTC, datetime

    certified = Condition("Certified", "True", "Issued", "")
    cases = (("", (), ""), ("flights stopped", (), "flights stopped"), ("", ("camera: full",), "camera: full"))
    for flights, others, problem in cases:
        seen = parse_telemetry(Telemetry(recording_problem=flights))
        observed = NodeObservation(
            "Drone",
            has_mobility=True,
            needs_certificate=True,
            certified=certified,
            snapshot=seen,
            recording_problems=others,
        )
        status = node_status(observed, {}, 1, datetime(2026, 6, 1, tzinfo=UTC))
        told = [c["message"] for c in status["conditions"] if c["type"] == "Recording" and c["status"] == "False"]
        assert told == ([problem] if problem else [])


def test_a_segment_is_never_smaller_than_what_is_worth_a_file(tmp_path: Path) -> None:
    assert SegmentDirectory(tmp_path, 1).segment_bytes == MIN_SEGMENT_BYTES
    assert SegmentDirectory(tmp_path, 10**12).segment_bytes == 32_000_000

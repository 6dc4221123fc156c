"""The simulated vehicle as a process with TCP, UDP and pseudo-terminal links, and clients that send invalid data."""

from __future__ import annotations

import itertools
import math
import os
import random
import select
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pymavlink.dialects.v20.ardupilotmega as dialect
import pytest
from fractus_cluster.ports import free_port
from pymavlink import mavutil
from vehicle_process import HOME, Client, running_vehicle

# Index in PARAM_VALUE messages outside a parameter list: responses to reads by name, and changed parameters.
UNKNOWN_INDEX = 65535
FAST = ("--speedup", "10", "--ready-after", "3")


@pytest.fixture
def fast() -> Iterator[str]:
    port = free_port()
    with running_vehicle(*FAST, links=(f"tcp:127.0.0.1:{port}",)):
        yield f"tcp:127.0.0.1:{port}"


def _resident_mb(pid: int) -> float:
    text = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    return int(text.split("VmRSS:")[1].split()[0]) / 1024


def test_pymavlink_client_flies_out_and_back(fast: str):
    client = Client(fast)
    heartbeat = client.wait_for("HEARTBEAT")
    assert (heartbeat.type, heartbeat.autopilot) == (2, 3)
    client.take_off(10.0)
    target = HOME[0] + 50.0 / 111_319.0
    client.link.mav.set_position_target_global_int_send(
        0, 1, 1, 6, 0xDF8, int(target * 1e7), int(HOME[1] * 1e7), 10.0, *[0] * 8
    )
    begun = client.wait_for("GLOBAL_POSITION_INT")
    near = client.wait(lambda m: m.get_type() == "GLOBAL_POSITION_INT" and abs(m.lat * 1e-7 - target) * 111_319.0 < 1.0)
    assert 7.4 < (near.time_boot_ms - begun.time_boot_ms) / 1000.0 < 11.2
    assert client.command(20) == 0
    client.wait(lambda m: m.get_type() == "HEARTBEAT" and not m.base_mode & 128, 30.0)
    place = client.wait_for("GLOBAL_POSITION_INT")
    assert abs(place.lat * 1e-7 - HOME[0]) * 111_319.0 < 1.0
    assert abs(place.relative_alt) < 500


def test_vehicle_sends_only_heartbeats_until_streams_are_requested():
    port = free_port()
    with running_vehicle("--ready-after", "0.5", links=(f"tcp:127.0.0.1:{port}",)):
        client = Client(f"tcp:127.0.0.1:{port}")
        client.wait_for("HEARTBEAT")
        names = set()
        end = time.monotonic() + 2.5
        while time.monotonic() < end:
            message = client.link.recv_match(blocking=True, timeout=0.1)
            names |= {message.get_type()} if message is not None else set()
        assert names <= {
            "HEARTBEAT",
            "STATUSTEXT",
            "HOME_POSITION",
            "GPS_GLOBAL_ORIGIN",
            "PARAM_VALUE",
        }  # PARAM_VALUE: ground pressure
        rates = {"ATTITUDE": (30, 50), "LOCAL_POSITION_NED": (32, 10), "GLOBAL_POSITION_INT": (33, 1)}
        for number, rate_hz in rates.values():
            client.interval(number, rate_hz)
        times: dict[str, list[int]] = {name: [] for name in rates}
        while len(times["GLOBAL_POSITION_INT"]) < 4:
            message = client.wait(lambda m: m.get_type() in rates)
            times[message.get_type()].append(message.time_boot_ms)
        for name, (_, rate_hz) in rates.items():
            steps = {later - earlier for earlier, later in itertools.pairwise(times[name])}
            assert len(times[name]) > 2
            assert all(abs(step - 1000 / rate_hz) <= 1 for step in steps), (name, steps)
        assert client.command(511, 30, -1) == 0
        assert client.command(511, 9999, 1000) == 2


def test_acknowledgement_latency_matches_real_vehicle():
    port = free_port()
    with running_vehicle("--ready-after", "0.5", links=(f"tcp:127.0.0.1:{port}",)):
        client = Client(f"tcp:127.0.0.1:{port}")
        client.wait_for("HEARTBEAT")
        rng = random.Random(5)
        waits = []
        for _ in range(60):
            select.select([], [], [], rng.uniform(0.0, 0.012))
            begun = time.perf_counter()
            assert client.command(520, 1) == 0
            waits.append(time.perf_counter() - begun)
        assert 0.001 < sorted(waits)[30] < 0.012


def test_parameters_can_be_listed_read_and_set(fast: str):
    client = Client(fast)
    client.wait_for("HEARTBEAT")
    client.link.mav.param_request_list_send(1, 1)
    first = client.wait(lambda m: m.get_type() == "PARAM_VALUE" and m.param_index != UNKNOWN_INDEX)
    values = {first.param_id: first.param_value}
    indices = {first.param_index}
    while len(indices) < first.param_count:
        value = client.wait(lambda m: m.get_type() == "PARAM_VALUE" and m.param_index != UNKNOWN_INDEX)
        values[value.param_id] = value.param_value
        indices.add(value.param_index)
    assert indices == set(range(first.param_count))
    assert values["WPNAV_SPEED"] == 1000
    for name in ("FS_GCS_ENABLE", "FS_GCS_TIMEOUT", "FENCE_ENABLE", "RTL_ALT", "LAND_SPEED", "SYSID_MYGCS"):
        assert name in values
    client.link.mav.param_set_send(1, 1, b"FS_GCS_TIMEOUT", 7.5, 9)
    assert client.wait(lambda m: m.get_type() == "PARAM_VALUE" and m.param_id == "FS_GCS_TIMEOUT").param_value == 7.5
    client.link.mav.param_request_read_send(1, 1, b"FS_GCS_TIMEOUT", -1)
    assert client.wait(lambda m: m.get_type() == "PARAM_VALUE" and m.param_id == "FS_GCS_TIMEOUT").param_value == 7.5


def test_gcs_failsafe_returns_home_when_heartbeats_stop(fast: str):
    client = Client(fast)
    client.take_off(10.0)
    client.link.mav.param_set_send(1, 1, b"FS_GCS_ENABLE", 1, 2)
    client.wait_for("PARAM_VALUE")
    client.beat = lambda: None  # type: ignore[method-assign]
    client.wait(lambda m: m.get_type() == "HEARTBEAT" and m.custom_mode == 6, 10.0)
    assert "GCS Failsafe" in client.texts
    client.wait(lambda m: m.get_type() == "HEARTBEAT" and not m.base_mode & 128, 30.0)


def test_invalid_data_and_client_that_never_reads_do_not_affect_other_client():
    port = free_port()
    with running_vehicle("--ready-after", "0.5", links=(f"tcp:127.0.0.1:{port}",)) as process:
        good = Client(f"tcp:127.0.0.1:{port}")
        never_reads = socket.create_connection(("127.0.0.1", port))
        never_reads.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        encoder = dialect.MAVLink(None, srcSystem=99, srcComponent=1)
        for group in (0, 1, 2, 3, 6, 10, 11, 12):
            never_reads.sendall(dialect.MAVLink_request_data_stream_message(1, 1, group, 100, 1).pack(encoder))
        for _ in range(40):
            never_reads.sendall(dialect.MAVLink_param_request_list_message(1, 1).pack(encoder))
        noisy = socket.create_connection(("127.0.0.1", port))
        good.wait_for("HEARTBEAT")
        good.interval(30, 50)
        before_mb = _resident_mb(process.pid)
        noise = _noise(10_000)
        gaps = []
        last = time.monotonic()
        while noise:
            noisy.setblocking(False)
            for _ in range(200):
                if not noise:
                    break
                try:
                    noisy.send(noise[-1])
                    noise.pop()
                except BlockingIOError:
                    break
            good.wait_for("ATTITUDE", 2.0)
            gaps.append(time.monotonic() - last)
            last = time.monotonic()
        assert max(gaps) < 1.0
        assert good.command(520, 1) == 0
        assert _resident_mb(process.pid) - before_mb < 10
        assert _resident_mb(process.pid) < 80


def _noise(count: int) -> list[bytes]:
    """Return random bytes, truncated frames, and valid frames with random contents."""
    rng = random.Random(11)
    writer = dialect.MAVLink(None, srcSystem=77, srcComponent=1)
    classes = [dialect.mavlink_map[number] for number in sorted(dialect.mavlink_map) if number >= 0]
    frames = []
    for _ in range(count):
        kind = rng.random()
        if kind < 0.3:
            frames.append(rng.randbytes(rng.randrange(1, 60)))
            continue
        message = rng.choice(classes)
        if message.msgname == "SETUP_SIGNING":
            continue
        payload = rng.randbytes(message.unpacker.size)
        frame = _frame(writer, message, payload)
        frames.append(frame[: rng.randrange(1, len(frame))] if kind < 0.6 else frame)
    return frames


def _frame(writer: dialect.MAVLink, message: Any, payload: bytes) -> bytes:
    head = bytes((0xFD, len(payload), 0, 0, writer.seq, 77, 1)) + message.id.to_bytes(3, "little")
    crc = dialect.x25crc(bytearray(head[1:] + payload + bytes((message.crc_extra,))))
    writer.seq = (writer.seq + 1) % 256
    return head + payload + crc.crc.to_bytes(2, "little")


def test_udp_links_work_in_both_modes():
    inward = free_port()
    outward = free_port()
    server = Client(f"udpin:127.0.0.1:{outward}", sysid=254)
    with running_vehicle(*FAST, links=(f"udpin:127.0.0.1:{inward}", f"udpout:127.0.0.1:{outward}")):
        client = Client(f"udpout:127.0.0.1:{inward}")
        client.beat()
        client.wait_for("HEARTBEAT")
        server.wait_for("HEARTBEAT")
        client.interval(30, 10)
        client.wait_for("ATTITUDE")
        names = {server.wait(lambda _: True).get_type() for _ in range(20)}
        assert "ATTITUDE" not in names, "the vehicle sent a stream on a link that did not request it"
        assert server.command(520, 1) == 0


def test_messages_for_another_system_are_forwarded(fast: str):
    first = Client(fast, sysid=255)
    second = Client(fast, sysid=42)
    first.wait_for("HEARTBEAT")
    second.wait_for("HEARTBEAT")
    second.beat()
    first.wait(lambda m: m.get_type() == "HEARTBEAT" and m.get_srcSystem() == 42)
    second.wait(lambda m: m.get_type() == "HEARTBEAT" and m.get_srcSystem() == 255)
    first.link.mav.command_long_send(42, 190, 511, 0, 30, 1000, 0, 0, 0, 0, 0)
    assert second.wait_for("COMMAND_LONG").command == 511


def test_serial_link_works_over_pseudo_terminal(tmp_path: Path):
    path = tmp_path / "ttyVehicle"
    with running_vehicle(*FAST, links=(f"pty:{path}",)):
        client = Client(str(path))
        client.wait_for("HEARTBEAT")
        client.interval(30, 20)
        client.wait_for("ATTITUDE")
        client.link.mav.param_set_send(1, 1, b"RTL_ALT", 2100, 6)
        assert client.wait(lambda m: m.get_type() == "PARAM_VALUE" and m.param_id == "RTL_ALT").param_value == 2100
        client.take_off(5.0)
        client.close()
    assert not path.exists()


def _send_udp(port: int, frames: list[bytes]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for at, frame in enumerate(frames):
            sender.sendto(frame, ("127.0.0.1", port))
            if at % 100 == 0:
                time.sleep(0.005)  # limits the data that the kernel buffers


def _send_serial(path: Path, frames: list[bytes]) -> None:
    fd = os.open(path, os.O_RDWR | os.O_NOCTTY)
    try:
        for frame in frames:
            select.select([], [fd], [], 5.0)
            os.write(fd, frame)
            while select.select([fd], [], [], 0.0)[0]:
                os.read(fd, 65536)
    finally:
        os.close(fd)


@pytest.mark.parametrize("kind", ["udp", "serial"])
def test_invalid_frames_on_other_links_do_not_affect_client(kind: str, tmp_path: Path):
    port = free_port()
    datagrams = free_port()
    path = tmp_path / "tty"
    links = (f"tcp:127.0.0.1:{port}", f"udpin:127.0.0.1:{datagrams}", f"pty:{path}")
    with running_vehicle("--ready-after", "0.5", links=links) as process:
        good = Client(f"tcp:127.0.0.1:{port}")
        good.wait_for("HEARTBEAT")
        before_mb = _resident_mb(process.pid)
        frames = _noise(10_000)
        if kind == "udp":
            _send_udp(datagrams, frames)
        else:
            _send_serial(path, frames)
        assert good.command(520, 1) == 0
        assert good.command(512, 0) == 0
        assert _resident_mb(process.pid) - before_mb < 10


def test_one_process_runs_several_vehicles():
    port = free_port()
    with running_vehicle(*FAST, "--count", "3", "--spacing", "20", links=(f"tcp:127.0.0.1:{port}",)):
        places = []
        for at in range(3):
            client = Client(f"tcp:127.0.0.1:{port + 10 * at}", target=1 + at)
            assert client.wait_for("HEARTBEAT").get_srcSystem() == 1 + at
            client.interval(24, 5)
            places.append(client.wait(lambda m: m.get_type() == "GPS_RAW_INT" and m.fix_type >= 3))
        metres = 111_319.0 * math.cos(math.radians(HOME[0]))
        assert (places[2].lon - places[0].lon) * 1e-7 * metres == pytest.approx(40.0, abs=2.0)


def _fly_in_lockstep(tmp_path: Path, name: str, seed: int) -> bytes:
    """Arm, take off and fly. Send each message at a fixed simulated time. Return the content of the tlog."""
    port = free_port()
    clock_port = free_port()
    log = tmp_path / name
    options = ("--lockstep", f"127.0.0.1:{clock_port}", "--seed", str(seed), "--wind", "4,200,2", "--tlog", str(log))
    encoder = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
    with running_vehicle("--ready-after", "2", *options, links=(f"tcp:127.0.0.1:{port}",)):
        link = socket.create_connection(("127.0.0.1", port), timeout=10.0)
        clock = socket.create_connection(("127.0.0.1", clock_port), timeout=10.0)
        responses = clock.makefile("r")

        def advance(steps: int) -> int:
            clock.sendall(f"{steps}\n".encode())
            total = int(responses.readline())
            link.setblocking(False)
            try:
                while link.recv(65536):
                    pass
            except BlockingIOError:
                link.setblocking(True)
            return total

        advance(1)
        for message, steps in (
            (dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 3, 3), 300),
            (dialect.MAVLink_command_long_message(1, 1, 176, 0, 1, 4, 0, 0, 0, 0, 0), 10),
            (dialect.MAVLink_command_long_message(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0), 10),
            (dialect.MAVLink_command_long_message(1, 1, 22, 0, 0, 0, 0, 0, 0, 0, 10), 1500),
            (dialect.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, 0xDF8, 9, 9, -9, *[0] * 8), 900),
        ):
            link.sendall(message.pack(encoder))
            total = advance(steps)
        assert total == 1 + 300 + 10 + 10 + 1500 + 900
        link.close()
        clock.close()
    return log.read_bytes()


def test_same_seed_produces_identical_logs_in_lockstep(tmp_path: Path):
    first = _fly_in_lockstep(tmp_path, "first.tlog", 3)
    assert first == _fly_in_lockstep(tmp_path, "second.tlog", 3)
    assert first != _fly_in_lockstep(tmp_path, "third.tlog", 4)
    reader = mavutil.mavlink_connection(str(tmp_path / "first.tlog"))
    highest = 0.0
    while (message := reader.recv_match(type="VFR_HUD")) is not None:
        highest = max(highest, message.alt - HOME[2])
    assert highest == pytest.approx(10.0, abs=1.0)


def test_vehicle_command_rejects_invalid_arguments_with_reason(tmp_path: Path):
    import subprocess
    import sys

    for arguments, text in (
        (["--listen", "tcp:5760"], "expected tcp:HOST:PORT"),
        (["--listen", "carrier-pigeon:1"], "expected tcp:"),
        (["--home", "95,0,0"], "out of range"),
        (["--param", "NO_SUCH=1"], "unknown parameter NO_SUCH"),
        (["--listen", f"serial:{tmp_path / 'none'}"], "No such file"),
    ):
        result = subprocess.run(
            [sys.executable, "-m", "fractus_vehicle", *arguments],
            capture_output=True,
            text=True,
            timeout=20,
            check=False,
        )
        assert result.returncode != 0
        assert text in result.stderr
        assert "Traceback" not in result.stderr

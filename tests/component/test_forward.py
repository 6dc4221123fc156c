"""`fractus forward`: what is read of tlogs, when it is sent, and that nothing comes back."""

from __future__ import annotations

import ast
import itertools
import socket
import struct
import subprocess
from collections.abc import Mapping
from pathlib import Path

import click
import pytest
from click.testing import CliRunner
from fractus_cli import forward, tlog_tail
from fractus_cli.forward import Outlet, Player
from fractus_cli.tlog_tail import Folder, Frame, Node, Tail, first_record, split
from fractus_runtime.mavlink_codec import Endpoint

NAME = "000001-20260601T120000Z.tlog"
START_US = 1_780_000_000_000_000
VEHICLE, SERVICE = Endpoint(1, 1), Endpoint(1, 191)


def record(number: int, of: Endpoint = VEHICLE) -> bytes:
    frame = of.encode("ATTITUDE", {"roll": number / 10, "yaw": 0.5})
    return struct.pack(">Q", START_US + number * 100_000) + frame


class Memory:
    """A directory of tlogs."""

    def __init__(self, **files: bytes) -> None:
        self.files = files

    def sizes(self) -> Mapping[str, int]:
        return {name: len(data) for name, data in self.files.items()}

    def read(self, name: str, offset: int) -> bytes:
        return self.files[name][offset:]


def times(frames: list[Frame]) -> list[int]:
    return [round(frame.time_s * 10 - START_US / 1e5) for frame in frames]


def test_frames_are_read_whole_wherever_the_file_ends() -> None:
    data, memory = b"".join(record(number) for number in range(30)), Memory(a=b"")
    tail = Tail(memory)
    tail.read()
    found: list[Frame] = []
    for end in (*range(0, len(data), 17), len(data)):
        memory.files["a"] = data[:end]
        found += tail.read()
    assert times(found) == list(range(30))


@pytest.mark.parametrize("begin", range(0, 90, 7))
def test_who_comes_in_mid_flight_gets_what_is_recorded_from_then_on(begin: int) -> None:
    data = b"".join(record(number) for number in range(30))
    memory = Memory(a=data[:begin])
    tail = Tail(memory)
    assert tail.read() == []
    memory.files["a"] = data
    found = times(tail.read())
    assert found == list(range(found[0], 30))
    assert found[0] <= begin // (len(data) // 30) + 1


def test_the_next_segment_is_read_from_its_beginning_and_old_flights_are_not() -> None:
    old = b"".join(record(number) for number in range(5))
    memory = Memory(a=old)
    tail = Tail(memory)
    tail.read()
    memory.files["b"] = record(7) + record(8)
    assert times(tail.read()) == [7, 8]
    memory.files.pop("a")
    assert tail.read() == []


def test_what_the_service_said_is_left_out() -> None:
    memory = Memory(a=b"")
    tail = Tail(memory)
    tail.read()
    memory.files["a"] = record(1, SERVICE) + record(2) + record(3, SERVICE)
    assert times(tail.read()) == [2]


def test_damage_is_passed_over() -> None:
    data = b"".join(record(number) for number in range(10))
    third = len(data) // 10 * 3
    frames, rest = split(data[:third] + b"\0" * 11 + data[third:])
    assert set(times(frames)) >= set(range(10)) - {3}
    assert rest == b""
    assert first_record(b"nothing of the kind" * 20) == 380


def test_bursts_are_sent_as_evenly_as_they_were_recorded() -> None:
    now_s, sent = [500.0], list[float]()

    def pause(seconds: float) -> None:
        now_s[0] += seconds

    player = Player(lambda: [], lambda _: sent.append(now_s[0]), lambda: now_s[0], pause)
    for burst in range(3):
        player.take([Frame(1000.0 + burst * 3 + i / 10, b"\xfd") for i in range(30)])
        while now_s[0] < 500.0 + (burst + 1) * 3:
            player.play()
    gaps = [b - a for a, b in itertools.pairwise(sent)]
    assert len(sent) == 90
    assert max(gaps) < 0.15
    assert 8.8 < sent[-1] - sent[0] < 9.1


def test_what_came_too_late_is_sent_at_once_and_a_clock_that_is_set_stops_nothing() -> None:
    now_s, sent = [500.0], list[float]()

    def pause(seconds: float) -> None:
        now_s[0] += seconds

    player = Player(lambda: [], lambda _: sent.append(now_s[0]), lambda: now_s[0], pause)
    player.take([Frame(1000.0 + i / 10, b"\xfd") for i in range(300)])
    for _ in range(600):
        player.play()
    assert len(sent) == 300, "all but the last seconds at once"
    assert sent[150] == 500.0
    player.take([Frame(9000.0, b"\xfd")])
    player.play()
    assert len(sent) == 301


def test_a_lost_link_is_said_once_and_reading_goes_on(capsys: pytest.CaptureFixture[str]) -> None:
    lost = click.ClickException("drone-1: no route")
    answers: list[list[Frame] | Exception] = [lost, lost, [Frame(1.0, b"\xfd")], OSError("gone")]
    sent: list[bytes] = []

    def read() -> list[Frame]:
        found = answers.pop(0)
        if isinstance(found, Exception):
            raise found
        return found

    player = Player(read, sent.append, lambda: 0.0, lambda _: None)
    for _ in range(4):
        player.look()
    player.play()
    assert sent == [b"\xfd"]
    assert capsys.readouterr().err.splitlines() == [
        "forward: drone-1: no route; trying again",
        "forward: gone; trying again",
    ]


def test_nothing_that_a_ground_station_sends_is_read() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ground:
        ground.bind(("127.0.0.1", 0))
        ground.settimeout(5)
        with Outlet("127.0.0.1", ground.getsockname()[1]) as outlet:
            outlet.send(b"telemetry")
            data, sender = ground.recvfrom(100)
            assert data == b"telemetry"
            ground.sendto(b"command", sender)
    for module in (forward, tlog_tail):
        tree = ast.parse(Path(str(module.__file__)).read_text())
        called = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
        assert not called & {
            "recv",
            "recvfrom",
            "recv_into",
            "recvmsg",
            "makefile",
            "write",
            "write_bytes",
            "write_text",
        }
        imported = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
        assert not {
            name for name in imported if name and name.startswith(("fractus_services", "fractus_proto", "grpc"))
        }


def test_a_node_is_read_without_standard_input(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[list[str], object]] = []

    def run(argv: list[str], stdin: object = None, **_: object) -> subprocess.CompletedProcess[bytes]:
        asked.append((argv, stdin))
        if "get" in argv:
            return subprocess.CompletedProcess(argv, 0, b"pod/fractus-mobility-x\n", b"")
        if "ls" in argv:
            listed = f"total 8\n-rw-------    1 root     root          1234 Jun  1 12:00 {NAME}\n-rw------- 1 root root 9 Jun  1 12:00 x.mcap\n"
            return subprocess.CompletedProcess(argv, 0, listed.encode(), b"")
        return subprocess.CompletedProcess(argv, 0, b"tail", b"")

    monkeypatch.setattr(tlog_tail.subprocess, "run", run)
    node = Node(["kubectl", "--context", "k3s"], "drone-1")
    assert node.sizes() == {NAME: 1234}
    assert node.read(NAME, 1000) == b"tail"
    assert all(stdin is subprocess.DEVNULL for _, stdin in asked)
    executed = [argv for argv, _ in asked if "exec" in argv]
    assert [argv[argv.index("--") + 1] for argv in executed] == ["ls", "tail"]
    assert executed[1][-3:] == ["-c", "+1001", f"{tlog_tail.RECORDINGS}/{NAME}"]
    assert not any({"-i", "--stdin", "-it", "-ti"} & set(argv) for argv, _ in asked)


def test_a_drone_without_a_service_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    done = subprocess.CompletedProcess([], 0, b"", b"")
    monkeypatch.setattr(tlog_tail.subprocess, "run", lambda *_, **__: done)
    with pytest.raises(click.ClickException, match="no mobility service runs on drone-9"):
        Node(["kubectl"], "drone-9").sizes()


def test_a_directory_is_read_and_what_is_no_tlog_left_alone(tmp_path: Path) -> None:
    data = record(1)
    (tmp_path / NAME).write_bytes(data)
    (tmp_path / "notes.txt").write_text("x")
    folder = Folder(tmp_path)
    assert folder.sizes() == {NAME: len(data)}
    assert folder.read(NAME, 8) == data[8:]
    assert folder.read("000002-20260601T120000Z.tlog", 0) == b""


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "give the name of a drone, or --recordings"),
        (["drone-1", "--recordings", "."], "give the name of a drone, or --recordings"),
        (["drone-1", "--to", "14550"], "is not HOST:PORT"),
    ],
)
def test_the_command_says_what_is_wrong(arguments: list[str], said: str) -> None:
    done = CliRunner().invoke(forward.forward, arguments)
    assert done.exit_code != 0
    assert said in done.output

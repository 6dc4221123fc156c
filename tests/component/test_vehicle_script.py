"""Responses of the simulated vehicle compared with the recorded ones of real ArduCopters, played from scripts."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import vehicle_script
from fractus_runtime.mavlink_codec import Endpoint
from vehicle_script import (
    MISSION_STEPS,
    STEPS,
    SimulatedConnection,
    Step,
    Summary,
    abort_reason,
    compare,
    main,
    matches,
    steps,
)

SCRIPTS = pytest.mark.parametrize("path", [STEPS, MISSION_STEPS], ids=lambda path: path.stem)


@SCRIPTS
def test_every_script_step_is_played_or_has_a_reason(path: Path):
    script = steps(path)
    assert len({step.name for step in script}) == len(script)
    assert [step.name for step in script if not step.action and not step.note] == []


@SCRIPTS
def test_vehicle_responses_match_real_ardupilot(path: Path):
    differing: list[str] = []

    def report(step: Step, response: str, verdict: str) -> None:
        if verdict == "differs":
            differing.append(f"{step.name}: recorded {step.recorded}, simulated {response}")

    summary = Summary()
    compare(SimulatedConnection(), report, steps(path), summary, simulated=True)
    assert summary.wrong == 0, differing
    assert not summary.lost


@pytest.mark.parametrize(
    ("recorded", "response", "expected"),
    [
        ("ACCEPTED -> 4", "ACCEPTED -> 4", True),
        ("ACCEPTED -> 4", "ACCEPTED -> 6", False),
        ("s=5.0~10% mode=6", "s=4.6 mode=6", True),
        ("s=5.0~10% mode=6", "s=4.4 mode=6", False),
        ("N=0~0.5", "N=-0.4", True),
        ("N=0~0.5", "E=0.1", False),
        ("s=5.0~10%", "nothing", False),
    ],
)
def test_script_tolerances_apply_to_single_numbers(recorded: str, response: str, expected: bool):
    assert matches(recorded, response) is expected


@pytest.mark.parametrize(
    ("action", "aborts"),
    [
        ("upload fence circle_nan", True),
        ("stored fence circle_nan", True),
        ("upload fence circle", False),
        ("upload mission nan_p4", False),
        ("interval 30 1e12", True),
        ("rate 33 nan", True),
        ("rate 33 20000", False),
        ("interval 33 -2", False),
        ("command 511 30 1e12", True),
        ("command 511 30 1e6", False),
        ("int 192 3 20 0 10 -1 1 0 nan", False),
        ("list", False),
    ],
)
def test_script_recognises_steps_that_abort_sitl(action: str, aborts: bool):
    assert bool(abort_reason(action)) is aborts


class Autopilot:
    """Server that sends heartbeats, records what it receives, and closes each connection after a message of a type."""

    def __init__(self, closes_after: str, connections: int) -> None:
        self.received: list[str] = []
        self._closes_after = closes_after
        self._connections = connections
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.link = f"tcp:127.0.0.1:{self._listener.getsockname()[1]}"
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def close(self) -> None:
        self._thread.join(20)
        self._listener.close()

    def _serve(self) -> None:
        for _ in range(self._connections):
            connection, _address = self._listener.accept()
            with connection:
                self._answer(connection)
        self._listener.close()

    def _answer(self, connection: socket.socket) -> None:
        endpoint = Endpoint(1, 1)
        heartbeat = endpoint.encode("HEARTBEAT", {"type": 2, "autopilot": 3, "base_mode": 89, "system_status": 3})
        while data := connection.recv(65536):
            names = [message.name for message in endpoint.decode(data)]
            self.received += names
            if self._closes_after in names:
                return
            connection.sendall(heartbeat)


@pytest.fixture
def script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(vehicle_script, "RECONNECT_TIMEOUT_S", 2.0)
    path = tmp_path / "steps.tsv"
    path.write_text(
        "boot\theartbeat\ttype=2 ap=3 base=89 custom=0 status=3\t\n"
        "nan\tupload fence circle_nan\tno ack after 1 requests\t\n"
        "lost\tread WPNAV_SPEED\tPARAM_VALUE\t\n"
        "after\theartbeat\ttype=2 ap=3 base=89 custom=0 status=3\t\n"
    )
    return path


@pytest.fixture
def autopilots() -> Iterator[list[Autopilot]]:
    started: list[Autopilot] = []
    yield started
    for autopilot in started:
        autopilot.close()


def test_comparison_ends_with_summary_if_the_link_is_lost_for_good(
    script: Path, autopilots: list[Autopilot], capsys: pytest.CaptureFixture[str]
):
    autopilots.append(Autopilot("PARAM_REQUEST_READ", connections=1))
    assert main(["--all", "--autopilot", autopilots[0].link, "--steps", str(script)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(" | ")[0].strip() for line in lines[:-1]] == ["same", "not played", "differs", "not played"]
    assert lines[-1] == (
        "1 of 2 played steps differ unintentionally, 4 steps in total; the link to the autopilot was lost"
    )
    assert "MISSION_COUNT" not in autopilots[0].received, "the autopilot must not receive a radius that is not a number"


def test_comparison_continues_after_a_reconnection(
    script: Path, autopilots: list[Autopilot], capsys: pytest.CaptureFixture[str]
):
    autopilots.append(Autopilot("PARAM_REQUEST_READ", connections=2))
    main(["--all", "--autopilot", autopilots[0].link, "--steps", str(script)])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(" | ")[0].strip() for line in lines[:-1]] == ["same", "not played", "differs", "same"]
    assert lines[-1] == "1 of 3 played steps differ unintentionally, 4 steps in total"


def test_comparison_without_autopilot_is_refused_in_one_sentence(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        main(["--autopilot", "tcp:127.0.0.1:1"])
    assert "cannot connect to tcp:127.0.0.1:1" in capsys.readouterr().err

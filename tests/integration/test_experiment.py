"""Experiments: identical output for the same seed, readable logs, checks, and processes that always end."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from fractus_cluster.ports import free_port
from fractus_sim.experiment import parse
from fractus_sim.experiment_command import experiment as command
from fractus_sim.runner import run
from fractus_sim.testbeds.local_processes import Processes, listening
from mcap.reader import make_reader
from pymavlink import mavutil

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).parents[2] / "examples" / "experiments"
HOME = {"lat": 50.8637, "lon": 4.6785, "alt": 25}
TASK = [{"do": "takeoff", "alt": 8}, {"do": "goto", "north": 15, "east": 0, "alt": 8}, {"do": "returnToLaunch"}]
GUST = {"fault": "windGust", "speed": 7, "at": 6, "duration": 4}
PNG = b"\x89PNG\r\n\x1a\n"


def content(**changes: Any) -> dict[str, Any]:
    vehicle = {"name": "d", "home": HOME, "readyAfter": 2, "task": TASK}
    return {"name": "short", "vehicles": [vehicle], "timeout": 120, "settle": 1, **changes}


def run_command(*arguments: str) -> Result:
    return CliRunner().invoke(command, ["run", *arguments])


def test_experiment_output_is_identical_for_the_same_seed(tmp_path: Path) -> None:
    experiment = parse(content(faults=[GUST], checks=[{"check": "task"}, {"check": "landed", "nearHome": 3}]))
    for name in ("one", "two", "other"):
        seeded = parse({**experiment.to_dict(), "seed": 2}) if name == "other" else experiment
        assert run(seeded, tmp_path / name).holds
    logs = [{p.name: p.read_bytes() for p in (tmp_path / name / "logs").iterdir()} for name in ("one", "two", "other")]
    assert set(logs[0]) == {"d.tlog", "d-observer.tlog", "short.mcap"}
    assert logs[0] == logs[1]
    assert logs[0]["d.tlog"] != logs[2]["d.tlog"]


def test_experiment_output_is_readable_by_standard_tools(tmp_path: Path) -> None:
    slow = {"name": "d", "home": HOME, "readyAfter": 2, "task": [TASK[0], {"do": "speed", "speed": 2.5}, *TASK[1:]]}
    checks = [{"check": "landed"}, {"check": "reached", "north": 15, "east": 0}]
    outcome = run(parse(content(vehicles=[slow], faults=[GUST], checks=checks)), tmp_path)
    leg = [s.speed_mps for s in outcome.flights["d"].track.samples if s.mode == "GUIDED"]
    assert max(leg) < 4.0, "the vehicle flew faster than the speed that the previous step sets"
    log = mavutil.mavlink_connection(str(tmp_path / "logs" / "d.tlog"))
    seen: set[tuple[str, int]] = set()
    while (message := log.recv_match()) is not None:
        seen.add((message.get_type(), message.get_srcSystem()))
    log.close()
    assert ("GLOBAL_POSITION_INT", 1) in seen, "the log has no message of the vehicle"
    assert ("SET_POSITION_TARGET_GLOBAL_INT", 255) in seen, "the log has no message of the ground station"
    with (tmp_path / "logs" / "short.mcap").open("rb") as file:
        messages = [
            (channel.topic, json.loads(message.data)) for _, channel, message in make_reader(file).iter_messages()
        ]
    topics = {topic for topic, _ in messages}
    assert topics == {"/d/location", "/d/state", "/d/attitude", "/d/text", "/events"}
    assert any("gust 7 m/s" in body["text"] for topic, body in messages if topic == "/events")
    tracks = json.loads((tmp_path / "tracks.geojson").read_text())
    assert {feature["properties"]["what"] for feature in tracks["features"]} == {"path", "fault"}
    assert (tmp_path / "map.png").read_bytes().startswith(PNG)
    assert (tmp_path / "profile.png").read_bytes().startswith(PNG)
    page = (tmp_path / "summary.md").read_text()
    assert "All 2 checks hold" in page
    assert "| holds | reached: north 15, east 0, tolerance 3 |" in page
    assert "gust 7 m/s from 270°" in page
    (fault,) = outcome.occurrences
    assert fault.end_s is not None
    assert fault.end_s - fault.begin_s == pytest.approx(4.0, abs=0.1)


def test_experiment_reports_failsafes_and_failed_checks(tmp_path: Path) -> None:
    result = run_command(str(EXAMPLES / "gps-loss.yaml"), "--out", str(tmp_path / "holds"), "--quiet")
    assert result.exit_code == 0, result.output
    deaf = {"name": "d", "home": HOME, "readyAfter": 2, "task": TASK[:2], "parameters": {"FS_GCS_ENABLE": 1}}
    checks = [{"check": "mode", "mode": "RTL", "after": "linkLoss"}, {"check": "task"}, {"check": "altitude", "max": 1}]
    faults = [{"fault": "linkLoss", "at": 4}]
    file = tmp_path / "fails.yaml"
    file.write_text(json.dumps(content(vehicles=[deaf], faults=faults, checks=checks)))
    result = run_command(str(file), "--out", str(tmp_path / "fails"), "--quiet")
    assert result.exit_code == 2
    report = json.loads((tmp_path / "fails" / "report.json").read_text())
    assert [check["holds"] for check in report["checks"]] == [True, False, False]
    assert not report["problem"]


def test_experiment_command_exits_with_1_and_one_message_for_invalid_input(tmp_path: Path) -> None:
    file = tmp_path / "bad.yaml"
    file.write_text(json.dumps(content(faults=[{"fault": "gpsLoss"}])))
    result = run_command(str(file), "--out", str(tmp_path / "out"))
    assert result.exit_code == 1
    assert "faults[0].gpsLoss.at: is missing; specify it" in result.output
    unknown = {"name": "d", "home": HOME, "parameters": {"NO_SUCH": 1}}
    file.write_text(json.dumps(content(vehicles=[unknown])))
    result = run_command(str(file), "--out", str(tmp_path / "out"))
    assert result.exit_code == 1
    assert "d: the autopilot has no parameter NO_SUCH" in result.output


PROGRAM = """
import os
from pymavlink import mavutil
link = mavutil.mavlink_connection(os.environ["FRACTUS_VEHICLE"], source_system=255)
link.wait_heartbeat(timeout=20)
link.set_mode("GUIDED")
for command, *params in ((400, 1), (22, 0, 0, 0, 0, 0, 0, 6)):
    while True:
        link.mav.command_long_send(1, 1, command, 0, *params, *[0] * (7 - len(params)))
        answer = link.recv_match(type="COMMAND_ACK", condition=f"COMMAND_ACK.command=={command}", blocking=True, timeout=2)
        if answer is not None and answer.result == 0:
            break
link.mav.command_long_send(1, 1, 511, 0, 33, 100000, 0, 0, 0, 0, 0)
while link.recv_match(type="GLOBAL_POSITION_INT", blocking=True, timeout=20).relative_alt < 5000:
    pass
link.set_mode("LAND")
link.motors_disarmed_wait()
"""


def test_program_flies_the_vehicle_faster_than_real_time(tmp_path: Path) -> None:
    (tmp_path / "fly.py").write_text(PROGRAM)
    program = {"name": "fly", "command": ["python", "fly.py"], "vehicle": "d"}
    vehicle = {"name": "d", "home": HOME, "readyAfter": 2}
    checks = [{"check": "program", "program": "fly"}, {"check": "landed"}, {"check": "altitude", "max": 8}]
    experiment = parse(content(vehicles=[vehicle], programs=[program], speedup=5, checks=checks))
    outcome = run(experiment, tmp_path / "out", base=tmp_path)
    assert outcome.holds, outcome.verdicts
    log = mavutil.mavlink_connection(str(tmp_path / "out" / "logs" / "d-fly.tlog"))
    command = log.recv_match(type="COMMAND_LONG", condition="COMMAND_LONG.command==22")
    log.close()
    assert command is not None
    assert command.get_srcSystem() == 255


def test_interrupted_experiment_leaves_no_process(tmp_path: Path) -> None:
    (tmp_path / "wait.py").write_text("import time\nopen('began', 'w').close()\ntime.sleep(600)\n")
    program = {"name": "wait", "command": ["python", "wait.py"], "vehicle": "d"}
    file = tmp_path / "long.yaml"
    file.write_text(json.dumps(content(programs=[program], vehicles=[{"name": "d", "home": HOME, "readyAfter": 1}])))
    code = f"from fractus_sim.experiment_command import experiment as e; e(['run', {str(file)!r}, '--out', {str(tmp_path)!r}])"
    runner = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 60
        while not (tmp_path / "began").exists():
            assert runner.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.05)
        runner.send_signal(signal.SIGINT)
        assert runner.wait(20) != 0
    finally:
        runner.kill()
        runner.wait(10)
    remaining = subprocess.run(["pgrep", "-f", str(tmp_path)], capture_output=True, check=False, text=True)
    assert not remaining.stdout


def test_processes_are_killed_if_they_ignore_sigterm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fractus_sim.testbeds.local_processes.STOP_TIMEOUT_S", 1.0)
    stubborn = (
        "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('up', flush=True); time.sleep(60)"
    )
    processes = Processes(tmp_path)
    processes.start("stubborn", [sys.executable, "-c", stubborn], {})
    processes.wait("stubborn", lambda: "up" in processes.log("stubborn").read_text(), 20)
    processes.stop_all()
    assert processes.exit_code("stubborn") == -signal.SIGKILL


def test_processes_get_their_own_time_to_stop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fractus_sim.testbeds.local_processes.STOP_TIMEOUT_S", 0.2)
    slow = "import signal, sys, time; signal.signal(signal.SIGTERM, lambda *_: (time.sleep(1.5), sys.exit(7))); print('up', flush=True); time.sleep(60)"
    processes = Processes(tmp_path)
    processes.start("slow", [sys.executable, "-c", slow], {}, stop_timeout_s=30.0)
    processes.start("killed", [sys.executable, "-c", slow], {})
    for name in ("slow", "killed"):
        processes.wait(name, lambda name=name: "up" in processes.log(name).read_text(), 20)  # type: ignore[misc]
    processes.stop("killed")
    processes.stop_all()
    assert processes.exit_code("slow") == 7
    assert processes.exit_code("killed") == -signal.SIGKILL


def test_child_processes_end_with_their_program(tmp_path: Path) -> None:
    processes = Processes(tmp_path)
    child = f"sleep 600; : {tmp_path}"
    processes.start("leader", ["/bin/sh", "-c", f"/bin/sh -c '{child}' & exit 3"], {"PATH": os.environ["PATH"]})
    assert processes.wait_end("leader", 20) == 3
    assert all_ended(tmp_path)
    processes.stop_all()


RUNNER = """
import sys, time
from pathlib import Path
from fractus_sim.testbeds import local_processes
from fractus_sim.interruption import interrupt_on_signals
local_processes.STOP_TIMEOUT_S = 600.0
interrupt_on_signals()
processes = local_processes.Processes(Path(sys.argv[1]))
try:
    stubborn = f"trap '' TERM; sleep 600 & echo up; while :; do sleep 1; done; : {sys.argv[1]}"
    processes.start("stubborn", ["/bin/sh", "-c", stubborn], {"PATH": "/usr/bin:/bin"})
    processes.wait("stubborn", lambda: "up" in processes.log("stubborn").read_text(), 20)
    print("up", flush=True)
    time.sleep(600)
finally:
    print("stopping", flush=True)
    processes.stop_all()
"""


@pytest.mark.parametrize(
    ("first", "second"),
    [(signal.SIGKILL, None), (signal.SIGINT, signal.SIGINT), (signal.SIGHUP, signal.SIGTERM)],
    ids=["killed", "Ctrl-C twice", "terminal closed"],
)
def test_no_process_outlives_an_interrupted_runner(
    tmp_path: Path, first: signal.Signals, second: signal.Signals | None
) -> None:
    command = [sys.executable, "-c", RUNNER, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as runner:
        try:
            assert runner.stdout is not None
            assert runner.stdout.readline() == b"up\n"
            runner.send_signal(first)
            if second is not None:
                assert runner.stdout.readline() == b"stopping\n"
                runner.send_signal(second)
            assert runner.wait(60) != 0
        finally:
            runner.kill()
    assert all_ended(tmp_path)


def all_ended(mark: Path) -> bool:
    """Return True if all processes with the mark in their command line end within 20 s."""
    deadline = time.monotonic() + 20
    while subprocess.run(["pgrep", "-f", str(mark)], capture_output=True, check=False).stdout:
        if time.monotonic() > deadline:
            return False
        time.sleep(0.05)
    return True


def test_running_autopilot_is_flown_and_faulted_over_tcp(tmp_path: Path) -> None:
    processes = Processes(tmp_path)
    port = free_port()
    link = f"tcp:127.0.0.1:{port}"
    home = "50.8637,4.6785,25"
    arguments = ["--listen", link, "--home", home, "--speedup", "5", "--ready-after", "2"]
    processes.start("sitl", [sys.executable, "-m", "fractus_vehicle", *arguments], dict(os.environ))
    try:
        processes.wait("sitl", lambda: listening(port), 30)
        vehicle = {"name": "d", "connection": link, "task": TASK[:2]}
        checks = [{"check": "mode", "mode": "LAND", "after": "gpsLoss"}, {"check": "statustext", "matches": "EKF"}]
        faults = [{"fault": "gpsLoss", "at": 5}]
        outcome = run(parse(content(vehicles=[vehicle], faults=faults, checks=checks, speedup=5)), tmp_path / "out")
    finally:
        processes.stop_all()
    assert outcome.holds, (outcome.problem, outcome.verdicts)

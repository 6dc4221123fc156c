"""Processes of the embedded cluster: records, kills, supervisor, locks and certificates."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from cryptography import x509
from fractus_cluster.errors import ClusterError
from fractus_cluster.locking import locked
from fractus_cluster.pki import Authority
from fractus_cluster.processes import ProcessRecord, kill, read_record, record_of, spawn, write_record

ENVIRONMENT = {"PATH": os.environ["PATH"]}


def wait_until(condition: Callable[[], bool], description: str, timeout_s: float = 20.0) -> None:
    """Wait for a condition. Fail with its description after the timeout."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, f"waited {timeout_s:.0f} s for {description}"
        threading.Event().wait(0.02)


@pytest.fixture
def sleeper(tmp_path: Path) -> Iterator[ProcessRecord]:
    """Record of a running `sleep` process."""
    record = spawn(["sleep", "300"], log=tmp_path / "log", env=ENVIRONMENT)
    yield record
    kill(record)


def test_process_record_is_stored_and_read_back(sleeper: ProcessRecord, tmp_path: Path) -> None:
    write_record(tmp_path / "record.json", sleeper)
    stored = read_record(tmp_path / "record.json")
    assert stored == sleeper
    assert stored is not None
    assert stored.alive


def test_broken_process_record_is_ignored(tmp_path: Path) -> None:
    for text in ("", "{", '{"pid": 1}', "[]"):
        (tmp_path / "record.json").write_text(text)
        assert read_record(tmp_path / "record.json") is None


def test_process_ends_when_killed(sleeper: ProcessRecord) -> None:
    kill(sleeper)
    assert not sleeper.alive


@pytest.mark.parametrize("change", [{"start_ticks": 1}, {"boot_id": "another"}])
def test_process_with_reused_pid_is_not_killed(sleeper: ProcessRecord, change: dict[str, object]) -> None:
    ended = replace(sleeper, **change)  # type: ignore[arg-type]
    assert not ended.alive
    kill(ended)
    assert sleeper.alive


def test_process_has_separate_session(sleeper: ProcessRecord) -> None:
    assert os.getsid(sleeper.pid) == sleeper.pid
    assert os.getsid(sleeper.pid) != os.getsid(0)


@pytest.fixture
def supervisor(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[bytes]]]:
    """Function that starts a supervisor whose units are shell scripts."""
    started: list[subprocess.Popen[bytes]] = []

    def start(**scripts: str) -> subprocess.Popen[bytes]:
        units = [
            {
                "name": name,
                "argv": ["/bin/sh", "-c", script],
                "log": str(tmp_path / f"{name}.log"),
                "env": ENVIRONMENT,
                "needs": str(tmp_path / "permission") if name == "patient" else "",
            }
            for name, script in scripts.items()
        ]
        (tmp_path / "units.json").write_text(json.dumps({"units": units}))
        with (tmp_path / "supervisor.log").open("wb") as log:
            argv = [sys.executable, "-m", "fractus_cluster.supervisor", str(tmp_path / "units.json")]
            started.append(subprocess.Popen(argv, stdout=log, stderr=log))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.wait(timeout=10)


def test_supervisor_restarts_crashing_unit_with_growing_delay(
    supervisor: Callable[..., subprocess.Popen[bytes]], tmp_path: Path
) -> None:
    supervisor(crashing="date +%s%N", steady="echo up; exec sleep 300")

    def starts() -> list[int]:
        log = tmp_path / "crashing.log"
        return [int(line) for line in log.read_text().split()] if log.exists() else []

    wait_until(lambda: len(starts()) >= 4, "four starts")
    gaps_ns = [after - before for before, after in zip(starts(), starts()[1:4], strict=False)]
    assert all(gap_ns > least_s * 1e9 for gap_ns, least_s in zip(gaps_ns, (0.19, 0.39, 0.79), strict=True)), gaps_ns
    assert (tmp_path / "steady.log").read_text() == "up\n"


def test_supervisor_starts_unit_when_its_required_file_exists(
    supervisor: Callable[..., subprocess.Popen[bytes]], tmp_path: Path
) -> None:
    supervisor(patient="echo up; exec sleep 300", other="echo up; exec sleep 300")
    wait_until(
        lambda: (tmp_path / "other.log").exists() and (tmp_path / "other.log").read_text() == "up\n",
        "the start of the unit without a required file",
    )
    assert not (tmp_path / "patient.log").exists()
    (tmp_path / "permission").touch()
    wait_until(
        lambda: (tmp_path / "patient.log").exists() and (tmp_path / "patient.log").read_text() == "up\n",
        "the start of the unit with a required file",
    )


def test_units_end_when_supervisor_is_killed(
    supervisor: Callable[..., subprocess.Popen[bytes]], tmp_path: Path
) -> None:
    process = supervisor(unit="echo $$; exec sleep 300")
    log = tmp_path / "unit.log"
    wait_until(lambda: log.exists() and log.read_text().strip().isdigit(), "the unit's start")
    record = record_of(int(log.read_text()))
    assert record is not None
    process.kill()
    wait_until(lambda: not record.alive, "the unit's end")


def test_supervisor_exits_with_0_on_sigterm(supervisor: Callable[..., subprocess.Popen[bytes]], tmp_path: Path) -> None:
    process = supervisor(unit="echo up; exec sleep 300")
    wait_until(
        lambda: (tmp_path / "unit.log").exists() and (tmp_path / "unit.log").stat().st_size > 0, "the unit's start"
    )
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=10) == 0


def test_supervisor_starts_other_units_if_a_program_is_missing(
    supervisor: Callable[..., subprocess.Popen[bytes]], tmp_path: Path
) -> None:
    units = [
        {"name": "missing", "argv": ["/nonexistent"], "log": str(tmp_path / "missing.log"), "env": {}},
        {"name": "present", "argv": ["/bin/echo", "up"], "log": str(tmp_path / "present.log"), "env": {}},
    ]
    process = supervisor()
    process.kill()
    process.wait(timeout=10)
    (tmp_path / "units.json").write_text(json.dumps({"units": units}))
    argv = [sys.executable, "-m", "fractus_cluster.supervisor", str(tmp_path / "units.json")]
    with subprocess.Popen(argv, stdout=subprocess.DEVNULL) as second:
        try:
            log = tmp_path / "present.log"
            wait_until(lambda: log.exists() and "up" in log.read_text(), "the start of the unit whose program exists")
        finally:
            second.kill()


def test_lock_is_exclusive_and_released_when_holder_is_killed(tmp_path: Path) -> None:
    script = (
        "import sys, time; from pathlib import Path; from fractus_cluster.locking import locked\n"
        "with locked(Path(sys.argv[1]), timeout_s=5, what='x'):\n    print('held', flush=True); time.sleep(300)"
    )
    path = tmp_path / "lock"
    argv = [sys.executable, "-c", script, str(path)]
    with subprocess.Popen(argv, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        reports: list[str] = []
        with (
            pytest.raises(ClusterError, match="someone builds"),
            locked(path, timeout_s=0.3, what="someone builds", report=reports.append),
        ):
            pytest.fail("two processes hold the lock")
        assert reports == ["waiting: someone builds"]
        holder.kill()
        holder.wait(timeout=10)
    with locked(path, timeout_s=5, what="no one", remove=True):
        assert path.exists()
    assert not path.exists()


def test_certificate_is_reused_for_same_names_and_reissued_for_other_names(tmp_path: Path) -> None:
    authority = Authority(tmp_path)
    first = authority.issue("server", common_name="s", alternative_names=("a.example",)).certificate.read_bytes()
    again = Authority(tmp_path).issue("server", common_name="s", alternative_names=("a.example",))
    assert again.certificate.read_bytes() == first
    other = authority.issue("server", common_name="s", alternative_names=("b.example",))
    assert other.certificate.read_bytes() != first
    issued = x509.load_pem_x509_certificate(other.certificate.read_bytes())
    issued.verify_directly_issued_by(x509.load_pem_x509_certificate(authority.credential.certificate.read_bytes()))
    assert all(path.stat().st_mode & 0o077 == 0 for path in tmp_path.iterdir())

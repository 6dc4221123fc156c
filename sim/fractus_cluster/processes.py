"""Processes that outlive the command that started them, known again by pid, start time and boot."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

from fractus_runtime.files import write_file

from fractus_cluster.errors import ClusterError

_POLL_S = 0.01


@dataclass(frozen=True, slots=True)
class ProcessRecord:
    """A process that can be told apart from a later one with the same pid.

    Attributes:
        pid: Process id in the root pid namespace.
        start_ticks: Field 22 of /proc/PID/stat: clock ticks from boot to its start.
        boot_id: Which boot of the machine that was.
    """

    pid: int
    start_ticks: int
    boot_id: str

    @property
    def alive(self) -> bool:
        """Whether that very process still runs (a zombie does not)."""
        if self.boot_id != boot_id():
            return False
        found = _stat(self.pid)
        return found is not None and found[1] == self.start_ticks and found[0] not in "ZX"


@cache
def boot_id() -> str:
    """Return the id of the machine's present boot."""
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()


def _stat(pid: int) -> tuple[str, int] | None:
    """Return state letter and start time of a process, or None when there is none."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return None
    fields = text.rpartition(")")[2].split()
    return fields[0], int(fields[19])


def record_of(pid: int) -> ProcessRecord | None:
    """Return the record of a running process, or None when there is none with this pid."""
    found = _stat(pid)
    return None if found is None else ProcessRecord(pid, found[1], boot_id())


def spawn(
    argv: Sequence[str | Path],
    *,
    log: Path,
    cgroup_files: Sequence[Path] = (),
    env: Mapping[str, str],
    cwd: Path = Path("/"),
) -> ProcessRecord:
    """Start a process in a session of its own that goes on when we end.

    Args:
        argv: The program and its arguments.
        log: File that its output is appended to.
        cgroup_files: `cgroup.procs` files the process enters before the program starts.
        env: Its whole environment.
        cwd: Its working directory.

    Raises:
        ClusterError: It could not be started.
    """
    words = [str(word) for word in argv]
    enter = 'while [ "$1" != -- ]; do echo $$ > "$1" || exit 126; shift; done; shift; exec "$@"'
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") as output:
        try:
            process = subprocess.Popen(
                ["/bin/sh", "-c", enter, "sh", *map(str, cgroup_files), "--", *words],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=dict(env),
                cwd=cwd,
                start_new_session=True,
            )
        except OSError as error:
            raise ClusterError(f"cannot start {words[0]}: {error}") from error
    # The child is ours alone until it ends, so its pid cannot be another process's.
    record = record_of(process.pid)
    process.returncode = 0  # keep subprocess from waiting for it or warning about it
    if record is None:
        raise ClusterError(f"{words[0]} ended at once; see {log}")
    return record


def kill(record: ProcessRecord, *, timeout_s: float = 10.0) -> None:
    """Kill a recorded process if it still runs, and wait until it is gone.

    Raises:
        ClusterError: It is still there after the time limit.
    """
    if record.alive:
        try:
            handle = os.pidfd_open(record.pid)
        except ProcessLookupError:
            return
        try:
            if record.alive:  # the handle now refers to what the check saw
                signal.pidfd_send_signal(handle, signal.SIGKILL)
        finally:
            os.close(handle)
    deadline = time.monotonic() + timeout_s
    while record.alive:
        if time.monotonic() > deadline:
            raise ClusterError(f"process {record.pid} does not end")
        time.sleep(_POLL_S)
    reap(record.pid)


def reap(pid: int) -> None:
    """Collect a child of ours that has ended; harmless for any other process."""
    try:
        os.waitpid(pid, os.WNOHANG)
    except ChildProcessError:
        return


def write_record(path: Path, record: ProcessRecord) -> None:
    """Store a record so that it is never seen half written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, json.dumps(asdict(record)).encode(), 0o644, durable=False)


def read_record(path: Path) -> ProcessRecord | None:
    """Read a stored record; None when there is none or it is of no use."""
    try:
        return ProcessRecord(**json.loads(path.read_text()))
    except (FileNotFoundError, json.JSONDecodeError, TypeError):
        return None


def running(path: Path) -> ProcessRecord | None:
    """Read the record of a process that still runs; None when it does not."""
    record = read_record(path)
    return record if record is not None and record.alive else None


def kill_recorded(path: Path) -> None:
    """Kill the process of a stored record, if there is one.

    Raises:
        ClusterError: It does not end.
    """
    record = read_record(path)
    if record is not None:
        kill(record)

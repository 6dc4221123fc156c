"""Background processes that are identified by pid, start time and boot."""

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
    """Identity of a process. A later process with the same pid has a different identity.

    Attributes:
        pid: Process id in the root pid namespace.
        start_ticks: Start time of the process, clock ticks since boot (field 22 of /proc/PID/stat).
        boot_id: Id of the boot.
    """

    pid: int
    start_ticks: int
    boot_id: str

    @property
    def alive(self) -> bool:
        """True if this process is running. A zombie is not running."""
        if self.boot_id != boot_id():
            return False
        present = _stat(self.pid)
        return present is not None and present[1] == self.start_ticks and present[0] not in "ZX"


@cache
def boot_id() -> str:
    """Return the id of the current boot."""
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()


def _stat(pid: int) -> tuple[str, int] | None:
    """Return state letter and start time of a process, or None if it does not exist."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return None
    fields = text.rpartition(")")[2].split()
    return fields[0], int(fields[19])


def record_of(pid: int) -> ProcessRecord | None:
    """Return the identity of a running process, or None if no process has this pid."""
    present = _stat(pid)
    return None if present is None else ProcessRecord(pid, present[1], boot_id())


def command_line(record: ProcessRecord) -> list[str]:
    """Return the program and arguments of a process. The list is empty if the process has ended."""
    try:
        return Path(f"/proc/{record.pid}/cmdline").read_bytes().decode(errors="replace").split("\0")[:-1]
    except (FileNotFoundError, ProcessLookupError):
        return []


def spawn(
    argv: Sequence[str | Path],
    *,
    log: Path,
    cgroup_files: Sequence[Path] = (),
    env: Mapping[str, str],
    cwd: Path = Path("/"),
) -> ProcessRecord:
    """Start a process in its own session. It keeps running when the current process ends.

    Args:
        argv: Program and arguments.
        log: File that its output is appended to.
        cgroup_files: `cgroup.procs` files that the process is added to before the program starts.
        env: Complete environment.
        cwd: Working directory.

    Raises:
        ClusterError: The process could not be started.
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
    # The child is not reaped yet, so its pid cannot be reused.
    record = record_of(process.pid)
    process.returncode = 0  # subprocess then neither waits for the process nor emits a ResourceWarning
    if record is None:
        raise ClusterError(f"{words[0]} ended immediately; see {log}")
    return record


def kill(record: ProcessRecord, *, timeout_s: float = 10.0) -> None:
    """Kill a recorded process if it is running, and wait until it has ended.

    Raises:
        ClusterError: The process is still running after the timeout.
    """
    if record.alive:
        try:
            handle = os.pidfd_open(record.pid)
        except ProcessLookupError:
            return
        try:
            if record.alive:  # the process still runs, so the pidfd refers to it
                signal.pidfd_send_signal(handle, signal.SIGKILL)
        finally:
            os.close(handle)
    deadline = time.monotonic() + timeout_s
    while record.alive:
        if time.monotonic() > deadline:
            raise ClusterError(f"process {record.pid} did not end within {timeout_s:.0f} s")
        time.sleep(_POLL_S)
    reap(record.pid)


def reap(pid: int) -> None:
    """Reap a child process if it has ended. Do nothing for other processes."""
    try:
        os.waitpid(pid, os.WNOHANG)
    except ChildProcessError:
        return


def write_record(path: Path, record: ProcessRecord) -> None:
    """Write a record atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, json.dumps(asdict(record)).encode(), 0o644, durable=False)


def read_record(path: Path) -> ProcessRecord | None:
    """Read a record. Return None if it is missing or invalid."""
    try:
        return ProcessRecord(**json.loads(path.read_text()))
    except (FileNotFoundError, json.JSONDecodeError, TypeError):
        return None


def running(path: Path) -> ProcessRecord | None:
    """Read the record of a running process. Return None if the process is not running."""
    record = read_record(path)
    return record if record is not None and record.alive else None


def kill_recorded(path: Path) -> None:
    """Kill the process of a record, if there is one.

    Raises:
        ClusterError: The process did not end.
    """
    record = read_record(path)
    if record is not None:
        kill(record)

"""Local processes with log files. All processes are stopped at the end of the experiment."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from fractus_sim.errors import ExperimentError
from fractus_sim.interruption import uninterrupted
from fractus_sim.testbeds.process_guard import ProcessGuard

POLL_S = 0.05
STOP_POLL_S = 0.01
STOP_TIMEOUT_S = 5.0
_TAIL_BYTES = 600


class Processes:
    """Processes of one experiment, by name.

    Each process runs in its own session, so Ctrl-C does not reach it. Processes are stopped in reverse order of their
    start, with SIGTERM and then SIGKILL. When a process ends, all remaining processes of its group are killed, as in a
    container. If the experiment itself is killed, a guard process kills all groups.
    """

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._stop_timeouts_s: dict[int, float] = {}
        self._guard = ProcessGuard()

    def start(
        self,
        name: str,
        argv: Sequence[str],
        environment: Mapping[str, str],
        folder: Path | None = None,
        stop_timeout_s: float | None = None,
    ) -> None:
        """Start a process. Its output is appended to `NAME.log`.

        Args:
            name: Name of the process.
            argv: Program and arguments.
            environment: Complete environment of the process.
            folder: Working directory.
            stop_timeout_s: Seconds between SIGTERM and SIGKILL when the process is stopped; `STOP_TIMEOUT_S` by default.

        Raises:
            ExperimentError: The process cannot be started, or a process with this name is running.
        """
        if self.running(name):
            raise ExperimentError(f"{name} is already running")
        self._logs.mkdir(parents=True, exist_ok=True)
        with self.log(name).open("ab") as output, uninterrupted():
            try:
                process = subprocess.Popen(
                    list(argv),
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    env=dict(environment),
                    cwd=folder,
                    start_new_session=True,
                )
            except OSError as error:
                raise ExperimentError(f"{name}: cannot start {argv[0]}: {error.strerror}") from None
            self._running.pop(name, None)
            self._running[name] = process
            if stop_timeout_s is not None:
                self._stop_timeouts_s[process.pid] = stop_timeout_s
            self._guard.hold(process.pid)

    def log(self, name: str) -> Path:
        """Return the path of the log file of a process."""
        return self._logs / f"{name}.log"

    def running(self, name: str) -> bool:
        """Return True if a process with this name is running."""
        return name in self._running and self._poll(self._running[name]) is None

    def started(self, name: str) -> bool:
        """Return True if a process with this name was started."""
        return name in self._running

    def pid(self, name: str) -> int:
        """Return the id of the process that was started last with this name.

        Raises:
            ExperimentError: No process with this name was started.
        """
        return self._process(name).pid

    def exit_code(self, name: str) -> int | None:
        """Return the exit code of a process, or None while it is running.

        Raises:
            ExperimentError: No process with this name was started.
        """
        return self._poll(self._process(name))

    def dead(self) -> dict[str, int]:
        """Return the exit codes of the processes that have ended."""
        return {name: code for name, process in self._running.items() if (code := self._poll(process)) is not None}

    def wait(self, name: str, condition: Callable[[], bool], timeout_s: float) -> None:
        """Wait for a condition while a process is running.

        Raises:
            ExperimentError: The process ended, or the timeout expired. The message ends with the tail of its log.
        """
        deadline = time.monotonic() + timeout_s
        while not condition():
            if not self.running(name):
                raise ExperimentError(f"{name} ended with exit code {self.exit_code(name)}: {self.log_tail(name)}")
            if time.monotonic() > deadline:
                raise ExperimentError(f"{name} was not ready within {timeout_s:.0f} s: {self.log_tail(name)}")
            time.sleep(POLL_S)

    def wait_end(self, name: str, timeout_s: float) -> int | None:
        """Wait for a process to end. Return its exit code, or None after the timeout."""
        deadline = time.monotonic() + timeout_s
        while (code := self.exit_code(name)) is None and time.monotonic() < deadline:
            time.sleep(POLL_S)
        return code

    def log_tail(self, name: str) -> str:
        """Return the end of the log of a process as one line."""
        path = self.log(name)
        text = path.read_bytes()[-_TAIL_BYTES:].decode("utf-8", "replace") if path.exists() else ""
        return " | ".join(line.strip() for line in text.splitlines()[-4:] if line.strip()) or "the log is empty"

    def stop(self, *names: str, kill: bool = False) -> None:
        """Stop processes that are still running. After an interrupt, kill them without waiting."""
        chosen = [self._running[name] for name in names if self.running(name)]
        try:
            if not kill:
                for process in chosen:
                    # Popen.terminate is not used: it reaps a process that has ended, before its group is killed.
                    with contextlib.suppress(ProcessLookupError, PermissionError):
                        os.kill(process.pid, signal.SIGTERM)
                self._wait_ended(chosen)
        finally:
            for process in chosen:
                if process.returncode is None:
                    _kill_group(process.pid)
            self._wait_ended(chosen)

    def stop_all(self, *stages: Callable[[str], bool]) -> None:
        """Stop all processes in stages. After an interrupt, kill the remaining processes without waiting.

        Args:
            stages: Predicates of process names. The processes that no predicate selects are stopped last.
        """
        names = list(reversed(self._running))
        try:
            for selects in stages:
                chosen = [name for name in names if selects(name)]
                self.stop(*chosen)
                names = [name for name in names if name not in chosen]
            self.stop(*names)
        finally:
            self.stop(*self._running, kill=True)
            self._guard.close()

    def _process(self, name: str) -> subprocess.Popen[bytes]:
        if name not in self._running:
            raise ExperimentError(f"no process {name}; known: {', '.join(sorted(self._running)) or 'none'}")
        return self._running[name]

    def _wait_ended(self, processes: Sequence[subprocess.Popen[bytes]]) -> None:
        began_s = time.monotonic()
        while processes := [process for process in processes if self._poll(process) is None]:
            waited_s = time.monotonic() - began_s
            if all(waited_s >= self._stop_timeouts_s.get(process.pid, STOP_TIMEOUT_S) for process in processes):
                return
            time.sleep(STOP_POLL_S)

    def _poll(self, process: subprocess.Popen[bytes]) -> int | None:
        """Return the exit code of a process, or None while it is running. Kill its group when it has ended."""
        if process.returncode is None and _is_zombie(process.pid):
            # The process is not reaped yet, so its id cannot belong to another group.
            _kill_group(process.pid)
            self._guard.release(process.pid)
        return process.poll()


def _is_zombie(pid: int) -> bool:
    """Return True if a child process has ended and was not reaped."""
    try:
        return os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None
    except ChildProcessError:
        return False


def _kill_group(group: int) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(group, signal.SIGKILL)


def listening(port: int, host: str = "127.0.0.1") -> bool:
    """Return True if a process accepts connections on a port of this machine."""
    with socket.socket() as probe:
        probe.settimeout(1.0)
        return probe.connect_ex((host, port)) == 0

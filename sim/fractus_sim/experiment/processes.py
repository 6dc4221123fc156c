"""Local processes that end with us: started with a log of their own, watched, stopped in reverse order."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from fractus_sim.experiment.errors import ExperimentError
from fractus_sim.experiment.reaper import Reaper
from fractus_sim.interruption import uninterrupted

POLL_S = 0.05
STOP_POLL_S = 0.01
GRACE_S = 5.0
_TAIL_BYTES = 600


class Processes:
    """The processes of one experiment, by name.

    Each runs in a session of its own, so that Ctrl-C reaches only us, and we end them in good order: the last that was
    started goes first, with SIGTERM, and with SIGKILL if it does not go. What a process has started and left behind in
    its group is killed when it ends, as in a container. If we are killed ourselves, all of them are.
    """

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._reaper = Reaper()

    def start(self, name: str, argv: Sequence[str], environment: Mapping[str, str], folder: Path | None = None) -> None:
        """Start a process; its output is appended to `NAME.log`.

        Raises:
            ExperimentError: it cannot be started, or one of that name runs.
        """
        if self.running(name):
            raise ExperimentError(f"{name} runs already")
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
            self._reaper.hold(process.pid)

    def log(self, name: str) -> Path:
        """The file with what a process writes."""
        return self._logs / f"{name}.log"

    def running(self, name: str) -> bool:
        """Whether a process of that name runs."""
        return name in self._running and self._code(self._running[name]) is None

    def exit_code(self, name: str) -> int | None:
        """How a process ended; None while it runs.

        Raises:
            ExperimentError: there was none of that name.
        """
        if name not in self._running:
            raise ExperimentError(f"no process {name}; there are {', '.join(sorted(self._running)) or 'none'}")
        return self._code(self._running[name])

    def dead(self) -> dict[str, int]:
        """Processes that have ended, with their exit codes."""
        return {name: code for name, process in self._running.items() if (code := self._code(process)) is not None}

    def wait(self, name: str, condition: Callable[[], bool], timeout_s: float) -> None:
        """Wait until a condition holds while a process must run.

        Raises:
            ExperimentError: the process ended, or the time is over; the message ends with the tail of its log.
        """
        deadline = time.monotonic() + timeout_s
        while not condition():
            if not self.running(name):
                raise ExperimentError(f"{name} ended with {self.exit_code(name)}: {self.log_tail(name)}")
            if time.monotonic() > deadline:
                raise ExperimentError(f"{name} was not ready within {timeout_s:.0f} s: {self.log_tail(name)}")
            time.sleep(POLL_S)

    def wait_end(self, name: str, timeout_s: float) -> int | None:
        """Wait for a process to end by itself; its exit code, None when it still runs after the time."""
        deadline = time.monotonic() + timeout_s
        while (code := self.exit_code(name)) is None and time.monotonic() < deadline:
            time.sleep(POLL_S)
        return code

    def log_tail(self, name: str) -> str:
        """The end of a process' log, as one line."""
        path = self.log(name)
        text = path.read_bytes()[-_TAIL_BYTES:].decode("utf-8", "replace") if path.exists() else ""
        return " | ".join(line.strip() for line in text.splitlines()[-4:] if line.strip()) or "it said nothing"

    def stop(self, *names: str, kill: bool = False) -> None:
        """End processes; those that run no more are passed over. Interrupted, it kills them and is done at once."""
        chosen = [self._running[name] for name in names if self.running(name)]
        try:
            if not kill:
                for process in chosen:
                    # Not by Popen, which would wait for one that has just ended, and leave its group alone.
                    with contextlib.suppress(ProcessLookupError, PermissionError):
                        os.kill(process.pid, signal.SIGTERM)
                self._wait_ended(chosen)
        finally:
            for process in chosen:
                if process.returncode is None:
                    _kill_group(process.pid)
            self._wait_ended(chosen)

    def stop_all(self, *stages: Callable[[str], bool]) -> None:
        """End everything: first all processes that the first testbed's predicate names, and so on, then the rest.

        Interrupted, it kills what is left and is done at once.
        """
        names = list(reversed(self._running))
        try:
            for testbed in stages:
                chosen = [name for name in names if testbed(name)]
                self.stop(*chosen)
                names = [name for name in names if name not in chosen]
            self.stop(*names)
        finally:
            self.stop(*self._running, kill=True)
            self._reaper.close()

    def _wait_ended(self, processes: Sequence[subprocess.Popen[bytes]]) -> None:
        deadline = time.monotonic() + GRACE_S
        while any(self._code(process) is None for process in processes) and time.monotonic() < deadline:
            time.sleep(STOP_POLL_S)

    def _code(self, process: subprocess.Popen[bytes]) -> int | None:
        """How a process ended, with the end of its group; None while it runs."""
        if process.returncode is None and _has_ended(process.pid):
            # Not waited for yet, so the number is still its own, as its group's.
            _kill_group(process.pid)
            self._reaper.let_go(process.pid)
        return process.poll()


def _has_ended(pid: int) -> bool:
    try:
        return os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None
    except ChildProcessError:
        return False


def _kill_group(group: int) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(group, signal.SIGKILL)


def listening(port: int) -> bool:
    """Whether a process accepts connections on a port of the loopback device."""
    with socket.socket() as probe:
        probe.settimeout(1.0)
        return probe.connect_ex(("127.0.0.1", port)) == 0

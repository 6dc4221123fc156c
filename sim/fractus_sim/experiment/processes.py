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

POLL_S = 0.05
GRACE_S = 5.0
_LAST_WORDS = 600


class Processes:
    """The processes of one experiment, by name.

    Each runs in a session of its own, so that Ctrl-C reaches only us, and we end them in good order: the last that was
    started goes first, with SIGTERM, and with SIGKILL to its whole group if it does not go.
    """

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def start(
        self, name: str, argv: Sequence[str], environment: Mapping[str, str], folder: Path | None = None
    ) -> subprocess.Popen[bytes]:
        """Start a process; its output is appended to `NAME.log`.

        Raises:
            ExperimentError: it cannot be started, or one of that name runs.
        """
        if self.running(name):
            raise ExperimentError(f"{name} runs already")
        self._logs.mkdir(parents=True, exist_ok=True)
        with self.log(name).open("ab") as output:
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
        return process

    def log(self, name: str) -> Path:
        """The file with what a process writes."""
        return self._logs / f"{name}.log"

    def running(self, name: str) -> bool:
        """Whether a process of that name runs."""
        return name in self._running and self._running[name].poll() is None

    def exit_code(self, name: str) -> int | None:
        """How a process ended; None while it runs.

        Raises:
            ExperimentError: there was none of that name.
        """
        if name not in self._running:
            raise ExperimentError(f"no process {name}; there are {', '.join(sorted(self._running)) or 'none'}")
        return self._running[name].poll()

    def dead(self) -> dict[str, int]:
        """Processes that have ended, with their exit codes."""
        return {name: code for name, process in self._running.items() if (code := process.poll()) is not None}

    def wait(self, name: str, condition: Callable[[], bool], timeout_s: float) -> None:
        """Wait until a condition holds while a process must run.

        Raises:
            ExperimentError: the process ended, or the time is over; the message ends with its last words.
        """
        deadline = time.monotonic() + timeout_s
        while not condition():
            if not self.running(name):
                raise ExperimentError(f"{name} ended with {self.exit_code(name)}: {self.last_words(name)}")
            if time.monotonic() > deadline:
                raise ExperimentError(f"{name} was not ready within {timeout_s:.0f} s: {self.last_words(name)}")
            time.sleep(POLL_S)

    def wait_end(self, name: str, timeout_s: float) -> int | None:
        """Wait for a process to end by itself; its exit code, None when it still runs after the time."""
        deadline = time.monotonic() + timeout_s
        while (code := self.exit_code(name)) is None and time.monotonic() < deadline:
            time.sleep(POLL_S)
        return code

    def last_words(self, name: str) -> str:
        """The end of a process' log, as one line."""
        path = self.log(name)
        text = path.read_bytes()[-_LAST_WORDS:].decode("utf-8", "replace") if path.exists() else ""
        return " | ".join(line.strip() for line in text.splitlines()[-4:] if line.strip()) or "it said nothing"

    def stop(self, *names: str, kill: bool = False) -> None:
        """End processes; those that run no more are passed over."""
        chosen = [self._running[name] for name in names if self.running(name)]
        for process in chosen:
            _signal(process, signal.SIGKILL if kill else signal.SIGTERM)
        deadline = time.monotonic() + GRACE_S
        for process in chosen:
            try:
                process.wait(max(deadline - time.monotonic(), 0.01))
            except subprocess.TimeoutExpired:
                _signal(process, signal.SIGKILL)
                process.wait(GRACE_S)

    def stop_all(self, *stages: Callable[[str], bool]) -> None:
        """End everything: first all processes that the first stage's predicate names, and so on, then the rest."""
        names = list(reversed(self._running))
        for stage in stages:
            chosen = [name for name in names if stage(name)]
            self.stop(*chosen)
            names = [name for name in names if name not in chosen]
        self.stop(*names)


def _signal(process: subprocess.Popen[bytes], number: signal.Signals) -> None:
    """Signal a process that has not been waited for, with its group when it must die."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        if number is signal.SIGKILL:
            os.killpg(process.pid, number)
        else:
            process.send_signal(number)


class Ports:
    """Free TCP ports of the loopback device; none is given out twice."""

    def __init__(self) -> None:
        self._given: set[int] = set()

    def take(self) -> int:
        """A port nobody listens on."""
        while True:
            with socket.socket() as probe:
                probe.bind(("127.0.0.1", 0))
                port = int(probe.getsockname()[1])
            if port not in self._given:
                self._given.add(port)
                return port

    def listen(self) -> socket.socket:
        """A socket that listens on a free port."""
        return socket.create_server(("127.0.0.1", self.take()))


def listening(port: int) -> bool:
    """Whether somebody accepts connections on a port of the loopback device."""
    with socket.socket() as probe:
        probe.settimeout(1.0)
        return probe.connect_ex(("127.0.0.1", port)) == 0

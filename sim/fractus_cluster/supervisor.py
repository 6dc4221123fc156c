"""The first process of a node or control plane: starts programs, restarts them, reaps orphans.

It runs on the standard library alone, in its own process, and is told what to run by a JSON file:
`{"units": [{"name", "argv", "log", "env", "needs"}]}`. It never ends; killing it ends all.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

_BACKOFF_FIRST_S = 0.2
_MAX_BACKOFF_S = 10.0
_STEADY_AFTER_S = 30.0
_LOG_LIMIT_BYTES = 20_000_000
_LOG_CHECK_S = 600.0
_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None, use_errno=True)
ENVIRONMENT = {
    "PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin",
    "HOME": "/root",
    "LANG": "C.UTF-8",
}
"""Of the daemons of nodes and control planes."""

_HANDLED = {signal.SIGCHLD, signal.SIGTERM}


@dataclass(slots=True)
class Unit:
    """A program to keep running.

    Attributes:
        name: Its name, for the log.
        argv: Program and arguments.
        log: File that its output is appended to.
        env: Its whole environment.
        needs: File without which it is not started yet; empty for none.
        oom_score_adj: How readily the kernel may kill it.
    """

    name: str
    argv: list[str]
    log: str
    env: dict[str, str]
    needs: str = ""
    oom_score_adj: int = -900
    process: subprocess.Popen[bytes] | None = None
    started_s: float = 0.0
    due_s: float = 0.0
    backoff_s: float = field(default=_BACKOFF_FIRST_S)

    def start(self, now_s: float) -> None:
        """Start the program; a failure to do so counts as an exit."""
        self.started_s = now_s
        with Path(self.log).open("ab") as output:
            try:
                self.process = subprocess.Popen(
                    self.argv,
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    env=self.env,
                    cwd="/",
                    start_new_session=True,
                    preexec_fn=self._prepare,  # noqa: PLW1509  (this process has one thread)
                )
            except OSError as error:
                _say(f"{self.name}: cannot start {self.argv[0]}: {error}")
                self.ended(now_s)

    def _prepare(self) -> None:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _HANDLED)
        _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        try:
            Path("/proc/self/oom_score_adj").write_text(str(self.oom_score_adj))
        except OSError:
            return  # not allowed in a container: then the kernel chooses

    def ended(self, now_s: float) -> None:
        """Note that the program ended, and when it is to start again."""
        self.process = None
        if now_s - self.started_s > _STEADY_AFTER_S:
            self.backoff_s = _BACKOFF_FIRST_S
        self.due_s = now_s + self.backoff_s
        self.backoff_s = min(2 * self.backoff_s, _MAX_BACKOFF_S)

    def trim_log(self) -> None:
        """Empty a log that has grown too long; what was in it stays in one older file."""
        path = Path(self.log)
        try:
            if path.stat().st_size > _LOG_LIMIT_BYTES:
                path.with_name(path.name + ".1").write_bytes(path.read_bytes())
                os.truncate(path, 0)  # the program appends, so it goes on at the new end
        except FileNotFoundError:
            return


def supervise(units: list[Unit]) -> None:
    """Keep the units running until SIGTERM; reap every child that ends."""
    signal.pthread_sigmask(signal.SIG_BLOCK, _HANDLED)
    trimmed_s = time.monotonic()
    while True:
        now_s = time.monotonic()
        for unit in units:
            if unit.process is None and unit.due_s <= now_s:
                if unit.needs and not Path(unit.needs).exists():
                    unit.due_s = now_s + _BACKOFF_FIRST_S
                else:
                    unit.start(now_s)
        if now_s - trimmed_s >= _LOG_CHECK_S:
            trimmed_s = now_s
            for unit in units:
                unit.trim_log()
        due_s = [unit.due_s for unit in units if unit.process is None]
        wait_s = max(0.0, min([*due_s, trimmed_s + _LOG_CHECK_S]) - now_s)
        caught = signal.sigtimedwait(_HANDLED, wait_s)
        if caught is not None and caught.si_signo == signal.SIGTERM:
            return
        _reap(units)


def _reap(units: list[Unit]) -> None:
    while True:
        try:
            pid, status = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return
        if pid == 0:
            return
        for unit in units:
            if unit.process is not None and unit.process.pid == pid:
                unit.process.returncode = os.waitstatus_to_exitcode(status)
                _say(f"{unit.name} ended with {unit.process.returncode}; starts again in {unit.backoff_s:.1f} s")
                unit.ended(time.monotonic())


def _say(text: str) -> None:
    print(time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()), text, flush=True)


def read_units(path: Path) -> list[Unit]:
    """Read the units that a JSON file lists."""
    return [Unit(**entry) for entry in json.loads(path.read_text())["units"]]


if __name__ == "__main__":
    supervise(read_units(Path(sys.argv[1])))

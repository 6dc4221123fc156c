"""First process of a node or control plane: starts and restarts programs, and reaps orphans.

The supervisor runs as a separate process. It imports no large library, because it must start fast. A JSON file lists
its programs: `{"units": [{"name", "argv", "log", "env", "needs"}]}`. When the supervisor is killed, all its programs
end.
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

from fractus_runtime.backoff import Backoff

_FIRST_RETRY_S = 0.4
_MAX_RETRY_S = 10.0
_NEEDS_POLL_S = 0.2
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
"""Environment of the daemons of nodes and control planes."""

_HANDLED = {signal.SIGCHLD, signal.SIGTERM}


@dataclass(slots=True)
class Unit:
    """A supervised program.

    Attributes:
        name: Name in the log.
        argv: Program and arguments.
        log: File that its output is appended to.
        env: Complete environment.
        needs: File that must exist before the program is started. Empty: none.
        oom_score_adj: OOM score adjustment in the kernel.
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
    backoff: Backoff = field(default_factory=lambda: Backoff(_FIRST_RETRY_S, _MAX_RETRY_S))

    def start(self, now_s: float) -> None:
        """Start the program. If it cannot be started, schedule another attempt."""
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
                _log(f"{self.name}: cannot start {self.argv[0]} (error={error})")
                self.ended(now_s)

    def _prepare(self) -> None:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _HANDLED)
        _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        try:
            Path("/proc/self/oom_score_adj").write_text(str(self.oom_score_adj))
        except OSError:
            return  # not permitted in some containers; the program then has the default score

    def ended(self, now_s: float) -> None:
        """Record the end of the program and schedule its restart."""
        self.process = None
        if now_s - self.started_s > _STEADY_AFTER_S:
            self.backoff.succeeded()
        delay_s = self.backoff.delay_s()
        self.due_s = now_s + delay_s
        _log(f"{self.name}: ended, restarting in {delay_s:.1f} s")

    def trim_log(self) -> None:
        """Truncate a log above the size limit. Its content is kept in a file with the suffix .1."""
        path = Path(self.log)
        try:
            if path.stat().st_size > _LOG_LIMIT_BYTES:
                path.with_name(path.name + ".1").write_bytes(path.read_bytes())
                os.truncate(path, 0)  # the program writes in append mode, so it continues at the new end of the file
        except FileNotFoundError:
            return


def supervise(units: list[Unit]) -> None:
    """Keep the units running until SIGTERM, and reap every child that ends."""
    signal.pthread_sigmask(signal.SIG_BLOCK, _HANDLED)
    trimmed_s = time.monotonic()
    while True:
        now_s = time.monotonic()
        for unit in units:
            if unit.process is None and unit.due_s <= now_s:
                if unit.needs and not Path(unit.needs).exists():
                    unit.due_s = now_s + _NEEDS_POLL_S
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
                _log(f"{unit.name}: exited (code={unit.process.returncode})")
                unit.ended(time.monotonic())


def _log(text: str) -> None:
    print(time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()), text, flush=True)


def read_units(path: Path) -> list[Unit]:
    """Read the units of a JSON file."""
    return [Unit(**entry) for entry in json.loads(path.read_text())["units"]]


if __name__ == "__main__":
    supervise(read_units(Path(sys.argv[1])))

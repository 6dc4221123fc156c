"""Guard process that kills process groups when the process that started them ends, even by SIGKILL."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterable

_CLOSE_S = 5.0


class ProcessGuard:
    """A guard process with a list of process groups. It kills them when its input pipe is closed."""

    def __init__(self) -> None:
        self._guard: subprocess.Popen[bytes] | None = None
        self._pipe = -1

    def hold(self, group: int) -> None:
        """Kill a process group when the current process ends."""
        if self._guard is None:
            read_end, self._pipe = os.pipe()
            try:
                self._guard = subprocess.Popen(
                    [sys.executable, "-I", "-S", __file__],
                    stdin=read_end,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    cwd="/",
                    start_new_session=True,
                )
            finally:
                os.close(read_end)
        self._send(group)

    def release(self, group: int) -> None:
        """Release a process group that has ended, because its id can be reused."""
        self._send(-group)

    def close(self) -> None:
        """Kill the process groups that are still held."""
        if self._guard is None:
            return
        guard = self._guard
        self._guard = None
        os.close(self._pipe)
        try:
            guard.wait(_CLOSE_S)
        except subprocess.TimeoutExpired:
            guard.kill()
            guard.wait(_CLOSE_S)

    def _send(self, number: int) -> None:
        if self._guard is not None:
            # The guard may have been killed. This process then stops the groups itself.
            with contextlib.suppress(BrokenPipeError):
                os.write(self._pipe, b"%d\n" % number)


def guard(lines: Iterable[str]) -> None:
    """Read ids of groups to hold (positive) and to release (negative) until end of input, then kill the held groups."""
    held: set[int] = set()
    for line in lines:
        number = int(line)
        if number > 0:
            held.add(number)
        else:
            held.discard(-number)
    for group in held:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(group, signal.SIGKILL)


if __name__ == "__main__":
    for ignored in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM):
        signal.signal(ignored, signal.SIG_IGN)
    guard(sys.stdin)

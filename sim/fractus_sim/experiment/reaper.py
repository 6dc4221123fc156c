"""Ends process groups when the process that started them is gone, even after SIGKILL."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterable

_CLOSE_S = 5.0


class Reaper:
    """A guard beside us that is told which process groups are ours, and kills them when our end of its pipe closes."""

    def __init__(self) -> None:
        self._guard: subprocess.Popen[bytes] | None = None
        self._pipe = -1

    def hold(self, group: int) -> None:
        """Have a group killed when we end."""
        if self._guard is None:
            theirs, self._pipe = os.pipe()
            try:
                self._guard = subprocess.Popen(
                    [sys.executable, "-I", "-S", __file__],
                    stdin=theirs,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    cwd="/",
                    start_new_session=True,
                )
            finally:
                os.close(theirs)
        self._say(group)

    def let_go(self, group: int) -> None:
        """Leave a group alone that is no more; its number may soon be another's."""
        self._say(-group)

    def close(self) -> None:
        """Have the groups that are still held killed."""
        if self._guard is None:
            return
        guard, self._guard = self._guard, None
        os.close(self._pipe)
        try:
            guard.wait(_CLOSE_S)
        except subprocess.TimeoutExpired:
            guard.kill()
            guard.wait(_CLOSE_S)

    def _say(self, number: int) -> None:
        if self._guard is not None:
            with contextlib.suppress(BrokenPipeError):  # the guard was killed; we end our processes ourselves
                os.write(self._pipe, b"%d\n" % number)


def guard(lines: Iterable[str]) -> None:
    """Read groups, and with a minus those to leave alone, to the end of the input; then kill the others."""
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

"""Tells when files of a directory change, by Linux' inotify: the usual library takes 2 MB of each service for it."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import os
from pathlib import Path
from typing import Self

_MODIFY, _ATTRIB, _CLOSE_WRITE, _MOVED_FROM, _MOVED_TO, _CREATE, _DELETE = 0x2, 0x4, 0x8, 0x40, 0x80, 0x100, 0x200
_DELETE_SELF, _MOVE_SELF = 0x400, 0x800
_CHANGES = (
    _MODIFY | _ATTRIB | _CLOSE_WRITE | _MOVED_FROM | _MOVED_TO | _CREATE | _DELETE | _DELETE_SELF | _MOVE_SELF
)  # fmt: skip
_DEBOUNCE_S = 0.05
"""Files are written in several steps; what reads them does so once."""
_READ_BYTES = 65536


class DirectoryWatch:
    """Watches a directory, which may be made again.

    Args:
        directory: the directory, without those below it.

    Raises:
        OSError: this system has no inotify, or no more of it.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._libc = ctypes.CDLL(None, use_errno=True)
        if not hasattr(self._libc, "inotify_init1"):
            raise OSError("this system has no inotify")
        self._events = self._checked(self._libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._events)

    async def changed(self, timeout_s: float) -> None:
        """Wait until something changed since the last call, for so long at most.

        Raises:
            OSError: the directory cannot be watched.
        """
        # Each time, since it may be another one of that name; where it is the same, this changes nothing. In a thread, as the
        # disk may hang.
        await asyncio.to_thread(self._watch)
        loop, happened = asyncio.get_running_loop(), asyncio.Event()
        loop.add_reader(self._events, happened.set)
        try:
            async with asyncio.timeout(timeout_s):
                await happened.wait()
        except TimeoutError:
            return
        finally:
            loop.remove_reader(self._events)
        await asyncio.sleep(_DEBOUNCE_S)
        with contextlib.suppress(BlockingIOError):
            while os.read(self._events, _READ_BYTES):
                """What changed does not matter."""

    def _watch(self) -> None:
        self._checked(self._libc.inotify_add_watch(self._events, os.fsencode(self._directory), _CHANGES))

    def _checked(self, result: int) -> int:
        if result < 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number), str(self._directory))
        return result

"""Ctrl-C, SIGTERM and SIGHUP: all of them break off what is under way, and none what must not be left half done."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def break_off_on_signals() -> None:
    """Let SIGTERM, and SIGHUP unless it is ignored as under nohup, do what Ctrl-C does: raise KeyboardInterrupt."""
    signal.signal(signal.SIGTERM, _interrupt)
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        signal.signal(signal.SIGHUP, _interrupt)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Let these signals wait until the block is over; the last that came is then acted on.

    For what is short or has time limits of its own. Only the main thread acts on signals, so elsewhere nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[signal.Signals] = []
    # Handlers rather than a mask: a mask would be inherited by the processes that the block starts.
    before = {number: signal.getsignal(number) for number in _SIGNALS}
    for number, handler in before.items():
        if handler not in (signal.SIG_IGN, None):
            signal.signal(number, lambda number, _frame: came.append(signal.Signals(number)))
    try:
        yield
    finally:
        for number, handler in before.items():
            if handler is not None:
                signal.signal(number, handler)
        if came:
            signal.raise_signal(came[-1])


def _interrupt(_number: int, _frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt

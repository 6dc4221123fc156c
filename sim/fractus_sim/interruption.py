"""Signal handling: Ctrl-C, SIGTERM and SIGHUP interrupt the current action, except in protected blocks."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def interrupt_on_signals() -> None:
    """Raise KeyboardInterrupt on SIGTERM and SIGHUP. A SIGHUP that is ignored (nohup) stays ignored."""
    signal.signal(signal.SIGTERM, _interrupt)
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        signal.signal(signal.SIGHUP, _interrupt)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Defer SIGINT, SIGTERM and SIGHUP until the end of the block. Then handle the last received signal.

    Use this for actions that are short or have a timeout. It has no effect outside of the main thread, because only the
    main thread handles signals.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    deferred: list[signal.Signals] = []
    # A signal mask is not used, because processes that the block starts would inherit it.
    handlers = {number: signal.getsignal(number) for number in _SIGNALS}
    for number, handler in handlers.items():
        if handler not in (signal.SIG_IGN, None):
            signal.signal(number, lambda number, _frame: deferred.append(signal.Signals(number)))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            if handler is not None:
                signal.signal(number, handler)
        if deferred:
            signal.raise_signal(deferred[-1])


def _interrupt(_number: int, _frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt

"""Background threads for actions that are repeated while a fault lasts."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_JOIN_S = 30.0


@contextmanager
def held(hold: Callable[[threading.Event], None]) -> Iterator[None]:
    """Run a function in a thread until the end of the block, which sets the event."""
    over = threading.Event()
    # Daemon thread: an interrupted run does not wait for faults because its cluster is removed.
    holder = threading.Thread(target=hold, args=(over,), daemon=True)
    holder.start()
    try:
        yield
    finally:
        over.set()
        holder.join(_JOIN_S)

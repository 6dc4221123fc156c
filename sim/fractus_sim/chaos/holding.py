"""What has to be done again and again as long as a fault lasts."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_JOIN_S = 30.0


@contextmanager
def held(hold: Callable[[threading.Event], None]) -> Iterator[None]:
    """Run something in a thread until the block is left, of which the event tells it."""
    over = threading.Event()
    # A run that is interrupted waits for no fault: its cluster is taken down.
    holder = threading.Thread(target=hold, args=(over,), daemon=True)
    holder.start()
    try:
        yield
    finally:
        over.set()
        holder.join(_JOIN_S)

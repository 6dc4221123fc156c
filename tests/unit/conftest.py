"""Unit tests are of one room's logic: they start no process and open no connection. What does is in tests/component."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator

import pytest

BEYOND = {"subprocess.Popen", "os.fork", "os.posix_spawn", "socket.bind", "socket.connect"}
"""Python's audit events of what leaves the process."""
seen: list[str] = []


def _hear(event: str, args: tuple[object, ...]) -> None:
    # A thread that a component test left behind in this process may still be at work.
    if event in BEYOND and threading.current_thread() is threading.main_thread():
        seen.append(f"{event}{args[:2]}")


sys.addaudithook(_hear)


@pytest.fixture(autouse=True)
def _within_the_process() -> Iterator[None]:
    seen.clear()
    yield
    assert not seen, "a component test: move it to tests/component"

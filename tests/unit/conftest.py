"""Check that unit tests start no process and open no connection. Such tests belong to tests/component."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator

import pytest

EXTERNAL = {"subprocess.Popen", "os.fork", "os.posix_spawn", "socket.bind", "socket.connect"}
"""Python audit events that show a new process or a connection."""
external_events: list[str] = []


def _record_external_event(event: str, args: tuple[object, ...]) -> None:
    # Ignore other threads, because threads of earlier component tests may still run in this process.
    if event in EXTERNAL and threading.current_thread() is threading.main_thread():
        external_events.append(f"{event}{args[:2]}")


sys.addaudithook(_record_external_event)


@pytest.fixture(autouse=True)
def _within_the_process() -> Iterator[None]:
    external_events.clear()
    yield
    assert not external_events, "the test starts a process or opens a connection: move it to tests/component"

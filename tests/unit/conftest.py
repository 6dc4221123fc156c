"""Unit tests start no process and open no connection. Tests that do are component tests."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator

import pytest

EXTERNAL = {"subprocess.Popen", "os.fork", "os.posix_spawn", "socket.bind", "socket.connect"}
"""Audit events of Python for processes and connections."""
external_events: list[str] = []


def _record_external_event(event: str, args: tuple[object, ...]) -> None:
    # A thread of an earlier component test in this process may still be running.
    if event in EXTERNAL and threading.current_thread() is threading.main_thread():
        external_events.append(f"{event}{args[:2]}")


sys.addaudithook(_record_external_event)


@pytest.fixture(autouse=True)
def _within_the_process() -> Iterator[None]:
    external_events.clear()
    yield
    assert not external_events, "the test starts a process or opens a connection: move it to tests/component"

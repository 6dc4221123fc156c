"""Lock of a service: its process ends when another process could lock its files."""

from __future__ import annotations

import asyncio
import queue
from collections.abc import Callable
from pathlib import Path

import pytest
from fractus_services import service_lock
from fractus_services.service_lock import ServiceLock


def _replace_file(state: Path) -> None:
    fresh = state / "fresh.lock"
    fresh.touch()
    fresh.replace(state / "mobility.lock")


def _remove_file(state: Path) -> None:
    (state / "mobility.lock").unlink()


def _move_directory(state: Path) -> None:
    state.rename(state.with_name("another-mount"))


@pytest.mark.parametrize("lose", [_replace_file, _remove_file, _move_directory])
async def test_process_ends_when_its_lock_file_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lose: Callable[[Path], None]
) -> None:
    monkeypatch.setattr(service_lock, "NEW_FILE_WAIT_S", 0.0)
    codes: queue.Queue[int] = queue.Queue()
    lock = ServiceLock("mobility", tmp_path / "state", tmp_path / "audit.jsonl", end=codes.put)
    assert await lock.acquire(1.0, asyncio.Event())
    with lock.watched():
        with pytest.raises(queue.Empty):
            await asyncio.to_thread(codes.get, timeout=2 * service_lock.CHECK_INTERVAL_S)
        lose(tmp_path / "state")
        assert await asyncio.to_thread(codes.get, timeout=10.0) == 1

"""`fractus.run` after the mission: in a pod it stays, and ends quietly when it is told to."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
from typing import Any

import fractus
import pytest
from fractus import running


@pytest.mark.parametrize("over", [True, False])
def test_a_mission_that_is_over_leaves_nothing_to_stop(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, *, over: bool
) -> None:
    async def fly(_program: running.Program, _drone: fractus.Mobility) -> None:
        asyncio.get_running_loop().call_soon(signal.raise_signal, signal.SIGTERM)
        if not over:
            await asyncio.Event().wait()

    def nothing(*_: Any, **_more: Any) -> contextlib.nullcontext[None]:
        return contextlib.nullcontext()

    async def program(_drone: fractus.Mobility, _control: fractus.Control) -> None:
        raise AssertionError("it is not begun")

    monkeypatch.setattr(running, "fly", fly)
    monkeypatch.setattr(running, "mobility", nothing)
    with caplog.at_level(logging.INFO):
        running.run(program, stay=True)
    assert ("told to stop" in caplog.text) != over
    assert ("the mission is over" in caplog.text) == over

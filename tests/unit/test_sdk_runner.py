"""`fractus.run` after the mission: in a pod it waits for SIGTERM."""

from __future__ import annotations

import asyncio
import logging
import signal

import fractus
import pytest
from fractus import runner


@pytest.mark.parametrize("over", [True, False])
def test_run_waits_for_sigterm_after_mission_in_a_pod(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, *, over: bool
) -> None:
    async def fly(_program: object, **_options: object) -> None:
        asyncio.get_running_loop().call_soon(signal.raise_signal, signal.SIGTERM)
        if not over:
            await asyncio.Event().wait()

    async def program(_drone: fractus.Mobility, _control: fractus.Control) -> None:
        raise AssertionError("the program must not start")

    monkeypatch.setattr(runner, "fly", fly)
    with caplog.at_level(logging.INFO):
        runner.run(program, stay=True)
    assert ("run: stopping" in caplog.text) != over
    assert ("run: mission complete" in caplog.text) == over

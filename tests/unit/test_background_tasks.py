"""Background tasks of a service: cancellation and errors."""

from __future__ import annotations

import asyncio
import gc
import warnings

import pytest
from fractus_services.background import Background
from fractus_services.errors import AutopilotError


def test_background_task_cancelled_before_start_never_runs() -> None:
    begun: list[str] = []

    async def work(name: str) -> None:
        begun.append(name)

    async def scene() -> None:
        background = Background()
        background.spawn(background.attempt(work, "never")).cancel()
        await background.spawn(background.attempt(work, name="once"))

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        asyncio.run(scene())
        gc.collect()
    assert begun == ["once"]


def test_background_attempt_logs_autopilot_error_and_raises_other_errors(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async def fail(error: Exception) -> None:
        raise error

    async def scene() -> None:
        background = Background()
        await background.attempt(fail, AutopilotError("no acknowledgement of command 176"))
        with pytest.raises(ValueError, match="ours"):
            await background.attempt(fail, ValueError("ours"))

    asyncio.run(scene())
    assert "no acknowledgement of command 176" in caplog.text

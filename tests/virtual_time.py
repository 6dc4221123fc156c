"""Event loop in virtual time: minutes pass in a fraction of a second, and runs are deterministic."""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

T = TypeVar("T")


class _SkippingSelector(selectors.DefaultSelector):
    """Selector that never waits. It advances the virtual time instead."""

    def __init__(self, advance: Callable[[float], None]) -> None:
        super().__init__()
        self._advance = advance

    def select(self, timeout: float | None = None) -> list[Any]:
        events = super().select(0.001 if timeout is None else 0)
        if not events and timeout:
            self._advance(timeout)
        return events


class Loop(asyncio.SelectorEventLoop):
    """Event loop that jumps to the time of the next event."""

    def __init__(self) -> None:
        self._now = 1000.0
        super().__init__(_SkippingSelector(self._advance))

    def _advance(self, seconds: float) -> None:
        self._now += seconds

    def time(self) -> float:
        return self._now

    def run_in_executor(self, _executor: Any, work: Callable[..., Any], *args: Any) -> asyncio.Future[Any]:  # type: ignore[override]
        """Run the work at once in this thread, because threads do not share the virtual time."""
        done = self.create_future()
        try:
            done.set_result(work(*args))
        except OSError as error:
            done.set_exception(error)
        return done


def fly(flight: Callable[[], Coroutine[Any, Any, None]]) -> None:
    """Run a flight to its end, at most for ten minutes of virtual time."""

    async def bounded() -> None:
        async with asyncio.timeout(600):
            await flight()

    with asyncio.Runner(loop_factory=Loop) as runner:
        runner.run(bounded())


def run(work: Coroutine[Any, Any, T]) -> T:
    """Run work in virtual time and return its result."""
    with asyncio.Runner(loop_factory=Loop) as runner:
        return runner.run(work)

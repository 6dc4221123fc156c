"""Time that jumps: minutes of virtual time pass in a fraction of a second, always the same."""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Callable, Coroutine
from typing import Any


class _Hurried(selectors.DefaultSelector):
    """Never waits: what others wait for is there at once."""

    def __init__(self, hurry: Callable[[float], None]) -> None:
        super().__init__()
        self._hurry = hurry

    def select(self, timeout: float | None = None) -> list[Any]:
        found = super().select(0.001 if timeout is None else 0)
        if not found and timeout:
            self._hurry(timeout)
        return found


class Loop(asyncio.SelectorEventLoop):
    """An event loop that jumps to the moment of the next event."""

    def __init__(self) -> None:
        self._now = 1000.0
        super().__init__(_Hurried(self._hurry))

    def _hurry(self, seconds: float) -> None:
        self._now += seconds

    def time(self) -> float:
        return self._now

    def run_in_executor(self, _executor: Any, work: Callable[..., Any], *args: Any) -> asyncio.Future[Any]:  # type: ignore[override]
        """What goes to a thread is done at once: no thread sees this loop's time."""
        done = self.create_future()
        try:
            done.set_result(work(*args))
        except OSError as error:
            done.set_exception(error)
        return done


def fly(flight: Callable[[], Coroutine[Any, Any, None]]) -> None:
    """Run a flight to its end; ten minutes of its time are the most."""

    async def bounded() -> None:
        async with asyncio.timeout(600):
            await flight()

    with asyncio.Runner(loop_factory=Loop) as runner:
        runner.run(bounded())

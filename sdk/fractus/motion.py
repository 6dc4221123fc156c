"""Motions that are awaited, or iterated for progress reports."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import AsyncGenerator, Awaitable, Callable, Generator
from contextlib import aclosing
from typing import Any

import grpc
import grpc.aio

from fractus.channel import Retries, ServiceChannel
from fractus.control import Control
from fractus.errors import Corrected, FractusError
from fractus.values import Progress

OnProgress = Callable[[Progress], Awaitable[None] | None]


class Motion:
    """A motion that starts when it is awaited or iterated.

    Awaiting it flies until the motion is complete, and returns the last `Progress`. Iterating it yields every progress
    report. Cancelling the task, or leaving the iteration early, stops the motion: the drone hovers. If the service
    restarts while this component holds control, the motion is requested again.

    Raises:
        PolicyDenied: Policies forbid the motion. The drone continues to hover.
        Corrected: The client is strict, and a policy changed the target. The motion is stopped.
        ControlLost: The system or a pilot took the drone.
        Unavailable: The service is unreachable and did not return in time.
    """

    def __init__(
        self,
        channel: ServiceChannel,
        control: Control | None,
        method: str,
        request: Any,
        *,
        strict: bool = False,
        progress: OnProgress | None = None,
        timeout_s: float | None = None,
    ) -> None:
        self._channel = channel
        self._control = control
        self._method = method
        self._request = request
        self._strict = strict
        self._progress = progress
        self._timeout_s = timeout_s

    def __await__(self) -> Generator[Any, None, Progress]:
        return self._complete().__await__()

    async def __aiter__(self) -> AsyncGenerator[Progress, None]:
        retries = Retries(self._channel, self._method, retried=self._control is not None)
        while True:
            if self._control is not None:
                await self._control.ready()
            try:
                async with aclosing(self._attempt()) as steps:
                    async for step in steps:
                        retries.reset()
                        yield step
            except grpc.aio.AioRpcError as error:
                await retries.pause(error)
            else:
                return

    async def _complete(self) -> Progress:
        last: Progress | None = None
        async with aclosing(self.__aiter__()) as steps:
            async for last in steps:
                if self._progress is not None:
                    outcome = self._progress(last)
                    if inspect.isawaitable(outcome):
                        await outcome
        if last is None or not last.complete:
            raise FractusError(f"{self._method}: the service ended the motion before it was complete")
        return last

    async def _attempt(self) -> AsyncGenerator[Progress, None]:
        first: Progress | None = None
        async with self._channel.stub() as stub:
            call = getattr(stub, self._method)(self._request, timeout=self._timeout_s)
            if self._control is not None:
                self._control.begin(call)
            try:
                async for message in call:
                    step = Progress.from_proto(message, first)
                    first = first or step
                    if self._strict and step.corrected:
                        raise Corrected(step)
                    yield step
                    if step.complete:
                        return
            except asyncio.CancelledError:
                if self._control is not None and self._control.lost is not None:
                    raise self._control.lost from None
                raise
            finally:
                call.cancel()
                if self._control is not None:
                    self._control.end(call)

"""Control lease of a driver, and the motions that it permits."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import logging
from collections.abc import AsyncGenerator, Awaitable, Callable, Generator, Sequence
from contextlib import aclosing
from types import TracebackType
from typing import Any, Self

import grpc
import grpc.aio
from fractus_proto.v1 import mobility_pb2

from fractus.channel import Retries, ServiceChannel
from fractus.control_point import ControlPoint
from fractus.errors import ControlLost, Corrected, FractusError, MissionComplete, NotConfigured, Unavailable
from fractus.forgotten import Pending
from fractus.values import Decision, Position, Progress

_log = logging.getLogger("fractus")
_Event = mobility_pb2.ControlEvent

MAX_RETRY_DELAY_S = 0.5
"""Longest delay between requests for control while the service restarts. The drone hovers only for the grace period."""

OnProgress = Callable[[Progress], Awaitable[None] | None]
"""Callback for a progress report of a motion. The callback may be a coroutine function."""

OnWait = Callable[[str], None]
"""Callback for the reason why control is not granted yet, for example "the autopilot is not ready to arm: ..."."""


RESPONSE_TIMEOUT_S = 5.0
"""Default time in seconds within which the program's event loop answers a liveness request of the service."""

CONFIRM_TIMEOUT_S = 2.0
"""Deadline of the answer to a liveness request."""


class Control:
    """Control lease for one control point: the right to move the drone.

    The lease lasts while its stream is open and the program's event loop answers the liveness requests of the service. If
    the process ends, or if the program blocks the event loop for longer than `response_timeout_s`, the drone hovers, and
    after the grace period the system flies it home. If the service restarts, the stream is reopened and motions continue.

    Use it as `async with drone.control() as control:`. Leaving the block normally returns control. Leaving it by an
    exception does not return control, so that this component can continue after a restart.
    """

    def __init__(
        self,
        channel: ServiceChannel,
        *,
        timeout_s: float | None = None,
        progress: OnWait | None = None,
        response_timeout_s: float = RESPONSE_TIMEOUT_S,
        before_return: Callable[[], None] = lambda: None,
    ) -> None:
        self._channel = channel
        self._before_return = before_return
        self._request = mobility_pb2.GetControlRequest(response_timeout_s=response_timeout_s)
        self._timeout_s = timeout_s
        self._progress = progress
        self._granted = asyncio.Event()
        self._lost: FractusError | None = None
        self._watcher: asyncio.Task[None] | None = None
        self._owner: asyncio.Task[Any] | None = None
        self._calls: dict[Any, asyncio.Task[Any] | None] = {}
        self._held = False
        self._returning = False
        self._interrupted = False
        self._cancellations = 0
        self.control_point = 0
        """Index of the control point, from 0. Log lines number control points from 1."""
        self.task = ControlPoint("")
        """Path or region of the control point, as declared by the application. Valid after control was granted."""
        self.waypoints_reached = 0
        """Number of completed waypoints, including those of earlier runs of this component."""
        self.begun: Sequence[object] | None = None
        """Waypoints of the mission that was started at this control point; None if no mission was started.

        `waypoints_reached` counts them.
        """
        self.mission_complete = False
        """True after control of the last control point was returned."""

    @property
    def lost(self) -> FractusError | None:
        """Reason why control was lost; None while control is held."""
        return self._lost

    async def acquire(self) -> Self:
        """Wait until the drone is at the control point and control is granted.

        Raises:
            MissionComplete: All control points of this component are complete.
            ControlLost: The system or a pilot keeps the drone.
            PolicyDenied: This component may not drive.
            Unavailable: The service did not respond, or the timeout expired.
        """
        self._watcher = asyncio.create_task(self._watch(), name="fractus-control")
        try:
            async with asyncio.timeout(self._timeout_s):
                await self.ready()
        except TimeoutError:
            await self.abandon()
            raise Unavailable(f"GetControl: control was not granted within {self._timeout_s:.0f} s") from None
        except BaseException:
            await self.abandon()
            raise
        return self

    async def ready(self) -> None:
        """Wait until control is granted again after a restart of the service.

        Raises:
            FractusError: The reason why control was lost.
        """
        if self._watcher is None:
            raise ControlLost("control was not acquired; use `async with drone.control():`")
        granted = asyncio.ensure_future(self._granted.wait())
        try:
            await asyncio.wait([granted, self._watcher], return_when=asyncio.FIRST_COMPLETED)
        finally:
            granted.cancel()
        if self._lost is not None:
            raise self._lost
        if not self._granted.is_set():
            raise ControlLost("control was returned")

    async def release(self) -> bool:
        """Return control at the end of the control point's task.

        Returns:
            True if this was the last control point. The system then flies the drone home.

        Raises:
            InvalidRequest: The client is strict, and a motion was not awaited. Control is abandoned.
        """
        try:
            self._before_return()
        except FractusError:
            await self.abandon()
            raise
        self._returning = True
        try:
            reply = await self._channel.unary("ReturnControl", mobility_pb2.ReturnControlRequest())
        finally:
            await self.abandon()
        self.mission_complete = bool(reply.mission_complete)
        return self.mission_complete

    async def report(self, waypoints: int) -> None:
        """Store the number of completed waypoints on the drone. A restarted component continues with the next waypoint.

        Args:
            waypoints: Number of reached or skipped waypoints. A lower number than before has no effect.
        """
        await self._channel.unary("ReportProgress", mobility_pb2.ReportProgressRequest(waypoints=waypoints))
        self.waypoints_reached = max(self.waypoints_reached, waypoints)

    async def remaining(self, waypoints: Sequence[Position] | None = None) -> AsyncGenerator[Position, None]:
        """Yield the waypoints that are not completed yet, and report each one when the next one is requested.

        Args:
            waypoints: Waypoints, the same in every run of this component; by default the path of the control point.
        """
        path = self.task.path if waypoints is None else waypoints
        for number in range(self.waypoints_reached, len(path)):
            yield path[number]
            await self.report(number + 1)

    async def abandon(self) -> None:
        """Close the stream without returning control: the drone hovers, then the system flies the drone home."""
        self._returning = True
        self._granted.clear()
        if self._watcher is not None:
            self._watcher.cancel()
            await asyncio.gather(self._watcher, return_exceptions=True)

    def begin(self, call: Any) -> None:
        """Register the call of a motion, which is cancelled when control is lost."""
        self._calls[call] = asyncio.current_task()

    def end(self, call: Any) -> None:
        """Unregister the call of a motion."""
        self._calls.pop(call, None)

    async def __aenter__(self) -> Self:
        self._owner = asyncio.current_task()
        self._cancellations = self._owner.cancelling() if self._owner else 0
        return await self.acquire()

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        owner = self._owner
        self._owner = None
        if kind is None and self._lost is None:
            await self.release()
            return
        try:
            await self.abandon()
        except asyncio.CancelledError:
            if not self._interrupted:
                raise
        # Like asyncio.timeout, convert a cancellation to an error only if this object cancelled the task.
        cancelled_here = self._interrupted and owner is not None and owner.uncancel() <= self._cancellations
        if self._lost is not None and (kind is None or (cancelled_here and kind is asyncio.CancelledError)):
            raise self._lost from error

    async def _watch(self) -> None:
        """Keep the stream open until control is lost or returned."""
        retries = Retries(self._channel, "GetControl", max_delay_s=MAX_RETRY_DELAY_S)
        while True:
            error: grpc.aio.AioRpcError | None = None
            try:
                await self._follow()
            except grpc.aio.AioRpcError as failed:
                error = failed
            except NotConfigured as failed:
                # The certificate is missing or invalid, so a retry cannot succeed.
                self._lose(failed)
                return
            if self._returning or self._lost is not None:
                return
            if self._granted.is_set():
                self._granted.clear()
                retries.reset()
                _log.warning(
                    "control: connection to the mobility service lost, reconnecting (timeout_s=%g)",
                    self._channel.reconnect_timeout_s,
                )
            try:
                await retries.pause(error)
            except FractusError as failure:
                self._lose(failure)
                return

    async def _follow(self) -> None:
        async with self._channel.stub() as stub:
            async for event in stub.GetControl(self._request):
                if event.state == _Event.STATE_GRANTED:
                    self.control_point = event.control_point
                    self.waypoints_reached = event.waypoints_reached
                    self.task = ControlPoint.from_proto(event.task)
                    self._held = True
                    self._granted.set()
                elif event.state == _Event.STATE_PING:
                    # A failed answer is not repeated, because the service repeats the request a second later.
                    with contextlib.suppress(grpc.aio.AioRpcError):
                        answer = mobility_pb2.ConfirmAliveRequest(ping=event.ping)
                        await stub.ConfirmAlive(answer, timeout=CONFIRM_TIMEOUT_S)
                elif event.state == _Event.STATE_WAITING:
                    if self._progress is not None and event.reason:
                        self._progress(event.reason)
                elif event.state == _Event.STATE_LOST:
                    decision = Decision.from_proto(event.decision) if event.HasField("decision") else None
                    self._lose(ControlLost(event.reason or "the system took the drone", decision))
                    return
                elif event.state == _Event.STATE_COMPLETE:
                    if not self._returning:
                        self._lose(MissionComplete(event.reason or "every control point is done"))
                    return

    def _lose(self, reason: FractusError) -> None:
        """Store the reason, and cancel the motions of this component."""
        if self._held and not isinstance(reason, (ControlLost, MissionComplete)):
            reason = ControlLost(str(reason))
        self._lost = reason
        owner_flies = False
        for call, task in list(self._calls.items()):
            owner_flies |= task is self._owner
            call.cancel()
        if self._owner is not None and self._held and not owner_flies:
            self._interrupted = True
            self._owner.cancel()


class Motion:
    """A motion that starts when it is awaited or iterated.

    Awaiting it flies until the motion is complete, and returns the last `Progress`. Iterating it yields every progress
    report. Cancelling the task, or leaving the iteration early, stops the motion: the drone hovers. If the service
    restarts while this component holds control, the motion is requested again.

    A motion that is neither awaited nor iterated warns as soon as it is discarded (`RuntimeWarning`). A strict client then
    raises `InvalidRequest` from its next call.

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
        pending: Pending,
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
        self._pending = pending

    def __await__(self) -> Generator[Any, None, Progress]:
        self._pending.begin()
        return self._complete().__await__()

    async def __aiter__(self) -> AsyncGenerator[Progress, None]:
        self._pending.begin()
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

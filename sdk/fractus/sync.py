"""Synchronous clients for programs without asyncio: `with fractus.sync.mobility() as drone: drone.arm()`.

Each method waits for the method of the same name of the asynchronous client, which runs in an event loop on another
thread. Arguments, results, exceptions and documentation are the same.
"""

from __future__ import annotations

import asyncio
import functools
import threading
from collections.abc import AsyncGenerator, Awaitable, Callable, Iterator, Sequence
from types import TracebackType
from typing import Any, Concatenate, Generic, ParamSpec, Protocol, Self, TypeVar

from fractus import control as _control
from fractus import drone as _drone
from fractus import mission as _missions
from fractus import pictures as _pictures
from fractus import telemetry as _telemetry
from fractus.control_point import ControlPoint
from fractus.environment import Endpoint
from fractus.errors import FractusError, PolicyDenied
from fractus.mission import Waypoint
from fractus.values import Position

JOIN_TIMEOUT_S = 10.0
"""Time for which `close` waits for the event loop's thread, in seconds."""

P = ParamSpec("P")
T = TypeVar("T")


class _End:
    """Marker for the end of an iteration."""


_END = _End()


class _Loop:
    """An event loop on a separate thread."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="fractus", daemon=True)
        self._thread.start()

    def run(self, work: Callable[[], Awaitable[T]]) -> T:
        """Run a coroutine on the loop and wait for its result. An interrupt, for example Ctrl-C, cancels the coroutine."""

        async def working() -> T:
            return await work()

        future = asyncio.run_coroutine_threadsafe(working(), self._loop)
        try:
            return future.result()
        except BaseException:
            future.cancel()
            raise

    def iterate(self, items: AsyncGenerator[T, None]) -> Iterator[T]:
        """Yield the items. Leaving the iteration closes the generator."""
        try:
            while not isinstance(item := self.run(lambda: anext(items, _END)), _End):
                yield item
        finally:
            self.run(items.aclose)

    def call(self, function: Callable[[], None]) -> None:
        """Schedule a function on the loop."""
        self._loop.call_soon_threadsafe(function)

    def close(self) -> None:
        """Stop the loop and its thread."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(timeout=JOIN_TIMEOUT_S)
        if not self._thread.is_alive():
            self._loop.close()


class _Closable(Protocol):
    async def close(self) -> None: ...


A = TypeVar("A")
C = TypeVar("C", bound=_Closable)


class _Wrapper(Generic[A]):
    """Wrapper of an asynchronous object and its event loop."""

    def __init__(self, loop: _Loop, wrapped: A) -> None:
        self._loop = loop
        self._async = wrapped


class _Client(_Wrapper[C]):
    """Client with its own event loop."""

    def __init__(self, wrapped: C) -> None:
        super().__init__(_Loop(), wrapped)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection. Control that is still held is abandoned."""
        self._loop.run(self._async.close)
        self._loop.close()


def _waiting(method: Callable[Concatenate[A, P], Awaitable[T]]) -> Callable[Concatenate[Any, P], T]:
    """Return a method that waits for an asynchronous method."""

    def waiting(self: _Wrapper[A], /, *args: P.args, **kwargs: P.kwargs) -> T:
        return self._loop.run(lambda: method(self._async, *args, **kwargs))

    functools.update_wrapper(waiting, method)
    return waiting


def _iterating(
    method: Callable[Concatenate[A, P], AsyncGenerator[T, None]],
) -> Callable[Concatenate[Any, P], Iterator[T]]:
    """Return a method that iterates over an asynchronous generator."""

    def iterating(self: _Wrapper[A], /, *args: P.args, **kwargs: P.kwargs) -> Iterator[T]:
        return self._loop.iterate(method(self._async, *args, **kwargs))

    functools.update_wrapper(iterating, method)
    return iterating


class Control(_Wrapper[_control.Control]):
    """Control lease for one control point; see `fractus.Control`.

    If control is lost, the current motion or the next call raises `ControlLost`.
    """

    @property
    def control_point(self) -> int:
        """Index of the control point, from 0."""
        return self._async.control_point

    @property
    def waypoints_reached(self) -> int:
        """Number of completed waypoints, including those of earlier runs of this component."""
        return self._async.waypoints_reached

    @property
    def task(self) -> ControlPoint:
        """Path or region of the control point, as declared by the application."""
        return self._async.task

    report = _waiting(_control.Control.report)
    remaining = _iterating(_control.Control.remaining)

    @property
    def mission_complete(self) -> bool:
        """True after control of the last control point was returned."""
        return self._async.mission_complete

    @property
    def lost(self) -> FractusError | None:
        """Reason why control was lost; None while control is held."""
        return self._async.lost

    def __enter__(self) -> Self:
        self._loop.run(self._async.acquire)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None and self.lost is None:
            self._loop.run(self._async.release)
            return
        self._loop.run(self._async.abandon)
        if kind is None and self.lost is not None:
            raise self.lost


class CanI(_Wrapper[_drone.CanI]):
    """Dry runs of calls; see `fractus.CanI`."""

    arm = _waiting(_drone.CanI.arm)
    disarm = _waiting(_drone.CanI.disarm)
    takeoff = _waiting(_drone.CanI.takeoff)
    land = _waiting(_drone.CanI.land)
    return_to_launch = _waiting(_drone.CanI.return_to_launch)
    hover = _waiting(_drone.CanI.hover)
    goto = _waiting(_drone.CanI.goto)
    set_speed = _waiting(_drone.CanI.set_speed)
    set_velocity = _waiting(_drone.CanI.set_velocity)
    point_gimbal = _waiting(_drone.CanI.point_gimbal)
    position = _waiting(_drone.CanI.position)
    speed = _waiting(_drone.CanI.speed)


class Watch(_Wrapper[_telemetry.Watch]):
    """Changes of one part of the drone's state; see `fractus.Watch`."""

    gps = _iterating(_telemetry.Watch.gps)
    battery = _iterating(_telemetry.Watch.battery)
    health = _iterating(_telemetry.Watch.health)
    attitude = _iterating(_telemetry.Watch.attitude)
    gimbal = _iterating(_telemetry.Watch.gimbal)
    wind = _iterating(_telemetry.Watch.wind)
    status_texts = _iterating(_telemetry.Watch.status_texts)


class Mission(_Wrapper[_missions.Mission]):
    """Mission that `fly` starts; see `fractus.Mission`."""

    fly = _waiting(_missions.Mission.fly)

    @property
    def refused(self) -> dict[int, PolicyDenied]:
        """Skipped legs by the number of their waypoint, from 1."""
        return self._async.refused

    def pause(self) -> None:
        """Stop the current leg from another thread. The drone hovers until `resume`."""
        self._loop.call(self._async.pause)

    def resume(self) -> None:
        """Continue the stopped leg."""
        self._loop.call(self._async.resume)


class Mobility(_Client[_drone.Mobility]):
    """Client of this node's mobility service; see `fractus.Mobility`."""

    def __init__(self, endpoint: Endpoint | None = None, *, strict: bool = False) -> None:
        super().__init__(_drone.mobility(endpoint, strict=strict))
        self.can_i = CanI(self._loop, self._async.can_i)
        """Dry runs: `drone.can_i.goto(lat, lon, 20)`."""
        self.watch = Watch(self._loop, self._async.watch)
        """Changes of one part of the drone's state: `for gps in drone.watch.gps()`."""

    def control(
        self,
        *,
        timeout_s: float | None = None,
        progress: _control.OnWait | None = None,
        response_timeout_s: float = _control.RESPONSE_TIMEOUT_S,
    ) -> Control:
        """Return the control lease for the next control point: `with drone.control() as control`.

        The event loop on the separate thread answers the liveness requests of the service, so the program may block.
        """
        lease = self._async.control(timeout_s=timeout_s, progress=progress, response_timeout_s=response_timeout_s)
        return Control(self._loop, lease)

    arm = _waiting(_drone.Mobility.arm)
    disarm = _waiting(_drone.Mobility.disarm)

    def mission(self, waypoints: Sequence[Waypoint | Position] | None = None, *, skip_refused: bool = False) -> Mission:
        """Return a mission that flies waypoints in order: `drone.mission(fractus.read_plan("survey.plan")).fly()`."""
        return Mission(self._loop, self._async.mission(waypoints, skip_refused=skip_refused))

    takeoff = _waiting(_drone.Mobility.takeoff)
    land = _waiting(_drone.Mobility.land)
    return_to_launch = _waiting(_drone.Mobility.return_to_launch)
    goto = _waiting(_drone.Mobility.goto)
    hover = _waiting(_drone.Mobility.hover)
    turn = _waiting(_drone.Mobility.turn)
    set_speed = _waiting(_drone.Mobility.set_speed)
    set_velocity = _waiting(_drone.Mobility.set_velocity)
    point_gimbal = _waiting(_drone.Mobility.point_gimbal)
    position = _waiting(_drone.Mobility.position)
    speed = _waiting(_drone.Mobility.speed)
    telemetry = _iterating(_drone.Mobility.telemetry)
    passenger = _iterating(_drone.Mobility.passenger)


class Camera(_Client[_pictures.Camera]):
    """Client of this node's camera service; see `fractus.Camera`."""

    def __init__(self, endpoint: Endpoint | None = None) -> None:
        super().__init__(_pictures.camera(endpoint))

    take = _waiting(_pictures.Camera.take)
    capture = _waiting(_pictures.Camera.capture)
    every = _iterating(_pictures.Camera.every)
    retrieve = _waiting(_pictures.Camera.retrieve)
    list = _waiting(_pictures.Camera.list)
    delete = _waiting(_pictures.Camera.delete)


def mobility(endpoint: Endpoint | None = None, *, strict: bool = False) -> Mobility:
    """Return a synchronous client of this node's mobility service."""
    return Mobility(endpoint, strict=strict)


def camera(endpoint: Endpoint | None = None) -> Camera:
    """Return a synchronous client of this node's camera service."""
    return Camera(endpoint)

"""The same clients for programs without asyncio: `with fractus.sync.mobility() as drone: drone.arm()`.

Each method here waits for the method of the same name of the asynchronous client, which runs on an event loop in a
thread of its own: same arguments, same answers, same errors, same documentation.
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
from fractus import dry_runs as _dry_runs
from fractus import missions as _missions
from fractus import pictures as _pictures
from fractus import telemetry as _telemetry
from fractus.environment import Endpoint
from fractus.errors import FractusError, PolicyDenied
from fractus.missions import Waypoint
from fractus.tasks import ControlPoint
from fractus.values import Position

JOIN_TIMEOUT_S = 10.0
"""How long `close` waits for the thread of the event loop to end."""

P = ParamSpec("P")
T = TypeVar("T")


class _End:
    """Nothing follows."""


_END = _End()


class _Loop:
    """An event loop on a thread of its own."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="fractus", daemon=True)
        self._thread.start()

    def run(self, work: Callable[[], Awaitable[T]]) -> T:
        """Wait for some work on the loop; an interrupt here (Ctrl-C, say) cancels it there."""

        async def working() -> T:
            return await work()

        future = asyncio.run_coroutine_threadsafe(working(), self._loop)
        try:
            return future.result()
        except BaseException:
            future.cancel()
            raise

    def iterate(self, items: AsyncGenerator[T, None]) -> Iterator[T]:
        """The items, one by one; leaving the iteration ends it there, too."""
        try:
            while not isinstance(item := self.run(lambda: anext(items, _END)), _End):
                yield item
        finally:
            self.run(items.aclose)

    def call(self, what: Callable[[], None]) -> None:
        """Do something on the loop, soon."""
        self._loop.call_soon_threadsafe(what)

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
    """An asynchronous object and the loop that it lives on."""

    def __init__(self, loop: _Loop, wrapped: A) -> None:
        self._loop = loop
        self._async = wrapped


class _Client(_Wrapper[C]):
    """A client with a loop of its own."""

    def __init__(self, wrapped: C) -> None:
        super().__init__(_Loop(), wrapped)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection; control that is still held breaks off."""
        self._loop.run(self._async.close)
        self._loop.close()


def _waiting(method: Callable[Concatenate[A, P], Awaitable[T]]) -> Callable[Concatenate[Any, P], T]:
    """The method that waits for an asynchronous one."""

    def waiting(self: _Wrapper[A], /, *args: P.args, **kwargs: P.kwargs) -> T:
        return self._loop.run(lambda: method(self._async, *args, **kwargs))

    functools.update_wrapper(waiting, method)
    return waiting


def _iterating(
    method: Callable[Concatenate[A, P], AsyncGenerator[T, None]],
) -> Callable[Concatenate[Any, P], Iterator[T]]:
    """The method that iterates over what an asynchronous one gives."""

    def iterating(self: _Wrapper[A], /, *args: P.args, **kwargs: P.kwargs) -> Iterator[T]:
        return self._loop.iterate(method(self._async, *args, **kwargs))

    functools.update_wrapper(iterating, method)
    return iterating


class Control(_Wrapper[_control.Control]):
    """Control of the drone for one control point; see `fractus.Control`.

    When it is lost, the motion in progress, or else the next call, raises `ControlLost`.
    """

    @property
    def control_point(self) -> int:
        """Index of the control point that this is for."""
        return self._async.control_point

    @property
    def waypoints_reached(self) -> int:
        """How many of its waypoints are done with, in this life of the component and in earlier ones."""
        return self._async.waypoints_reached

    @property
    def task(self) -> ControlPoint:
        """What is to be done there: path or region, as the application declares them."""
        return self._async.task

    report = _waiting(_control.Control.report)
    remaining = _iterating(_control.Control.remaining)

    @property
    def mission_complete(self) -> bool:
        """After control was returned: whether that was the last control point."""
        return self._async.mission_complete

    @property
    def lost(self) -> FractusError | None:
        """Why control was lost; None while it is ours."""
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


class CanI(_Wrapper[_dry_runs.CanI]):
    """Dry runs of calls; see `fractus.CanI`."""

    arm = _waiting(_dry_runs.CanI.arm)
    disarm = _waiting(_dry_runs.CanI.disarm)
    takeoff = _waiting(_dry_runs.CanI.takeoff)
    land = _waiting(_dry_runs.CanI.land)
    return_to_launch = _waiting(_dry_runs.CanI.return_to_launch)
    hover = _waiting(_dry_runs.CanI.hover)
    goto = _waiting(_dry_runs.CanI.goto)
    set_speed = _waiting(_dry_runs.CanI.set_speed)
    set_velocity = _waiting(_dry_runs.CanI.set_velocity)
    point_gimbal = _waiting(_dry_runs.CanI.point_gimbal)
    position = _waiting(_dry_runs.CanI.position)
    speed = _waiting(_dry_runs.CanI.speed)


class Watch(_Wrapper[_telemetry.Watch]):
    """One thing of the drone's state, each time it changes; see `fractus.Watch`."""

    gps = _iterating(_telemetry.Watch.gps)
    battery = _iterating(_telemetry.Watch.battery)
    health = _iterating(_telemetry.Watch.health)
    attitude = _iterating(_telemetry.Watch.attitude)
    gimbal = _iterating(_telemetry.Watch.gimbal)
    wind = _iterating(_telemetry.Watch.wind)
    status_texts = _iterating(_telemetry.Watch.status_texts)


class Mission(_Wrapper[_missions.Mission]):
    """Waypoints that `fly` flies; see `fractus.Mission`."""

    fly = _waiting(_missions.Mission.fly)

    @property
    def refused(self) -> dict[int, PolicyDenied]:
        """Legs that were passed over, by the number of their waypoint, from 1."""
        return self._async.refused

    def pause(self) -> None:
        """Stop the leg under way, from another thread: the drone hovers until `resume`."""
        self._loop.call(self._async.pause)

    def resume(self) -> None:
        """Go on with the leg that was stopped."""
        self._loop.call(self._async.resume)


class Mobility(_Client[_drone.Mobility]):
    """The mobility service of this node; see `fractus.Mobility`."""

    def __init__(self, endpoint: Endpoint | None = None, *, strict: bool = False) -> None:
        super().__init__(_drone.mobility(endpoint, strict=strict))
        self.can_i = CanI(self._loop, self._async.can_i)
        """Dry runs: `drone.can_i.goto(lat, lon, 20)`."""
        self.watch = Watch(self._loop, self._async.watch)
        """One thing of the drone's state, each time it changes: `for gps in drone.watch.gps()`."""

    def control(self, *, timeout_s: float | None = None, progress: _control.OnWait | None = None) -> Control:
        """Control of the drone for the next control point: `with drone.control() as control`."""
        return Control(self._loop, self._async.control(timeout_s=timeout_s, progress=progress))

    arm = _waiting(_drone.Mobility.arm)
    disarm = _waiting(_drone.Mobility.disarm)

    def mission(self, waypoints: Sequence[Waypoint | Position] | None = None, *, skip_refused: bool = False) -> Mission:
        """Waypoints to fly one after the other: `drone.mission(fractus.read_plan("survey.plan")).fly()`."""
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
    ride = _iterating(_drone.Mobility.ride)


class Camera(_Client[_pictures.Camera]):
    """The camera service of this node; see `fractus.Camera`."""

    def __init__(self, endpoint: Endpoint | None = None) -> None:
        super().__init__(_pictures.camera(endpoint))

    take = _waiting(_pictures.Camera.take)
    capture = _waiting(_pictures.Camera.capture)
    every = _iterating(_pictures.Camera.every)
    retrieve = _waiting(_pictures.Camera.retrieve)
    list = _waiting(_pictures.Camera.list)
    delete = _waiting(_pictures.Camera.delete)


def mobility(endpoint: Endpoint | None = None, *, strict: bool = False) -> Mobility:
    """The mobility service of this node, without asyncio."""
    return Mobility(endpoint, strict=strict)


def camera(endpoint: Endpoint | None = None) -> Camera:
    """The camera service of this node, without asyncio."""
    return Camera(endpoint)

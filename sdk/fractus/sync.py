"""The same clients for programs without asyncio: `with fractus.sync.mobility() as drone: drone.arm()`."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncGenerator, Callable, Coroutine, Iterator
from types import TracebackType
from typing import Any, Self, TypeVar

from fractus import drone as _drone
from fractus import pictures as _pictures
from fractus.control import Control as _AsyncControl
from fractus.environment import Endpoint
from fractus.errors import FractusError
from fractus.questions import CanI as _AsyncCanI
from fractus.values import (
    AltitudeReference,
    Check,
    ImageInfo,
    PositionResult,
    Progress,
    Result,
    Ride,
    SpeedResult,
    Telemetry,
    VelocityResult,
)

T = TypeVar("T")
OnProgress = Callable[[Progress], None]


class _End:
    """Nothing follows."""


_END = _End()


class _Loop:
    """An event loop on a thread of its own."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="fractus", daemon=True)
        self._thread.start()

    def run(self, coroutine: Coroutine[Any, Any, T]) -> T:
        """Wait for a coroutine; an interrupt here (Ctrl-C, say) cancels it there."""
        future = asyncio.run_coroutine_threadsafe(coroutine, self._loop)
        try:
            return future.result()
        except BaseException:
            future.cancel()
            raise

    def iterate(self, items: AsyncGenerator[T, None]) -> Iterator[T]:
        """The items, one by one; leaving the iteration ends it there, too."""

        async def following() -> T | _End:
            return await anext(items, _END)

        try:
            while not isinstance(item := self.run(following()), _End):
                yield item
        finally:
            self.run(items.aclose())

    def close(self) -> None:
        """Stop the loop and its thread."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(timeout=10)
        if not self._thread.is_alive():
            self._loop.close()


class Control:
    """Control of the drone for one control point; see `fractus.Control`.

    When it is lost, the motion in progress, or else the next call, raises `ControlLost`.
    """

    def __init__(self, loop: _Loop, control: _AsyncControl) -> None:
        self._loop = loop
        self._control = control

    @property
    def control_point(self) -> int:
        """Index of the control point that this is for."""
        return self._control.control_point

    @property
    def waypoints_reached(self) -> int:
        """How many of its waypoints were reached before, by an earlier life of this component."""
        return self._control.waypoints_reached

    @property
    def mission_complete(self) -> bool:
        """After control was returned: whether that was the last control point."""
        return self._control.mission_complete

    @property
    def lost(self) -> FractusError | None:
        """Why control was lost; None while it is ours."""
        return self._control.lost

    def __enter__(self) -> Self:
        self._loop.run(self._control.take())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None and self._control.lost is None:
            self._loop.run(self._control.give_back())
            return
        self._loop.run(self._control.abandon())
        if kind is None and self._control.lost is not None:
            raise self._control.lost


class CanI:
    """Dry runs of calls; see `fractus.CanI`."""

    def __init__(self, loop: _Loop, can_i: _AsyncCanI) -> None:
        self._loop = loop
        self._can_i = can_i

    def arm(self) -> Check:
        """Start the motors?"""
        return self._loop.run(self._can_i.arm())

    def disarm(self) -> Check:
        """Stop the motors?"""
        return self._loop.run(self._can_i.disarm())

    def takeoff(self, altitude_m: float) -> Check:
        """Climb to an altitude above home?"""
        return self._loop.run(self._can_i.takeoff(altitude_m))

    def land(self) -> Check:
        """Land here?"""
        return self._loop.run(self._can_i.land())

    def return_to_launch(self) -> Check:
        """Fly home and land there?"""
        return self._loop.run(self._can_i.return_to_launch())

    def hover(self) -> Check:
        """Stop and stay?"""
        return self._loop.run(self._can_i.hover())

    def goto(
        self,
        lat: float,
        lon: float,
        alt: float,
        *,
        reference: AltitudeReference = AltitudeReference.HOME,
        yaw_deg: float | None = None,
        speed_mps: float | None = None,
    ) -> Check:
        """Fly straight to a position?"""
        asked = self._can_i.goto(lat, lon, alt, reference=reference, yaw_deg=yaw_deg, speed_mps=speed_mps)
        return self._loop.run(asked)

    def set_speed(self, speed_mps: float) -> Check:
        """Fly at this speed?"""
        return self._loop.run(self._can_i.set_speed(speed_mps))

    def set_velocity(
        self,
        north_mps: float,
        east_mps: float,
        down_mps: float = 0.0,
        *,
        yaw_deg: float | None = None,
        hold_s: float = 0.0,
    ) -> Check:
        """Fly with this velocity?"""
        asked = self._can_i.set_velocity(north_mps, east_mps, down_mps, yaw_deg=yaw_deg, hold_s=hold_s)
        return self._loop.run(asked)

    def position(self) -> Check:
        """Ask where the drone is?"""
        return self._loop.run(self._can_i.position())

    def speed(self) -> Check:
        """Ask how fast the drone is?"""
        return self._loop.run(self._can_i.speed())


class Mobility:
    """The mobility service of this node; see `fractus.Mobility`."""

    def __init__(self, endpoint: Endpoint | None = None, *, strict: bool = False) -> None:
        drone = _drone.mobility(endpoint, strict=strict)
        self._loop = _Loop()
        self._drone = drone
        self.can_i = CanI(self._loop, drone.can_i)
        """Dry runs: `drone.can_i.goto(lat, lon, 20)`."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection; control that is still held breaks off."""
        self._loop.run(self._drone.close())
        self._loop.close()

    def control(self, *, timeout_s: float | None = None) -> Control:
        """Control of the drone for the next control point: `with drone.control() as control`."""
        return Control(self._loop, self._drone.control(timeout_s=timeout_s))

    def arm(self) -> Result:
        """Start the motors."""
        return self._loop.run(self._drone.arm())

    def disarm(self) -> Result:
        """Stop the motors; refused in the air."""
        return self._loop.run(self._drone.disarm())

    def hover(self) -> Result:
        """Stop and stay."""
        return self._loop.run(self._drone.hover())

    def set_speed(self, speed_mps: float) -> SpeedResult:
        """Fly at this speed over ground from now on."""
        return self._loop.run(self._drone.set_speed(speed_mps))

    def set_velocity(
        self,
        north_mps: float,
        east_mps: float,
        down_mps: float = 0.0,
        *,
        yaw_deg: float | None = None,
        hold_s: float = 0.0,
    ) -> VelocityResult:
        """Fly with this velocity until the next one, or until `hold_s` is over; see `fractus.Mobility.set_velocity`."""
        flying = self._drone.set_velocity(north_mps, east_mps, down_mps, yaw_deg=yaw_deg, hold_s=hold_s)
        return self._loop.run(flying)

    def telemetry(self, interval_s: float = 0.2) -> Iterator[Telemetry]:
        """The drone's state, every `interval_s` seconds, until the iteration is left."""
        return self._loop.iterate(self._drone.telemetry(interval_s))

    def ride(self) -> Iterator[Ride]:
        """For a passenger of an application without a driver; see `fractus.Mobility.ride`."""
        return self._loop.iterate(self._drone.ride())

    def speed(self) -> SpeedResult:
        """The speed over ground, as measured."""
        return self._loop.run(self._drone.speed())

    def position(self) -> PositionResult:
        """Where the drone is, above home, and how it moves."""
        return self._loop.run(self._drone.position())

    def takeoff(
        self, altitude_m: float, *, progress: OnProgress | None = None, timeout_s: float | None = None
    ) -> Progress:
        """Climb from the ground to an altitude above home."""
        return self._fly(self._drone.takeoff(altitude_m, progress=progress, timeout_s=timeout_s))

    def land(self, *, progress: OnProgress | None = None, timeout_s: float | None = None) -> Progress:
        """Land here, and disarm."""
        return self._fly(self._drone.land(progress=progress, timeout_s=timeout_s))

    def return_to_launch(self, *, progress: OnProgress | None = None, timeout_s: float | None = None) -> Progress:
        """Fly home and land there."""
        return self._fly(self._drone.return_to_launch(progress=progress, timeout_s=timeout_s))

    def goto(
        self,
        lat: float,
        lon: float,
        alt: float,
        *,
        reference: AltitudeReference = AltitudeReference.HOME,
        yaw_deg: float | None = None,
        speed_mps: float | None = None,
        acceptance_radius_m: float = 0.0,
        progress: OnProgress | None = None,
        timeout_s: float | None = None,
    ) -> Progress:
        """Fly straight to a position, and return when it is reached; see `fractus.Mobility.goto`."""
        return self._fly(
            self._drone.goto(
                lat,
                lon,
                alt,
                reference=reference,
                yaw_deg=yaw_deg,
                speed_mps=speed_mps,
                acceptance_radius_m=acceptance_radius_m,
                progress=progress,
                timeout_s=timeout_s,
            )
        )

    def _fly(self, motion: _drone.Motion) -> Progress:
        async def fly() -> Progress:
            return await motion

        return self._loop.run(fly())


class Camera:
    """The camera service of this node; see `fractus.Camera`."""

    def __init__(self, endpoint: Endpoint | None = None) -> None:
        camera = _pictures.camera(endpoint)
        self._loop = _Loop()
        self._camera = camera

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._loop.run(self._camera.close())
        self._loop.close()

    def capture(self, width: int = 0, height: int = 0) -> ImageInfo:
        """Take a picture; 0 leaves width and height to the camera."""
        return self._loop.run(self._camera.capture(width, height))

    def retrieve(self, name: str) -> bytes:
        """Fetch a picture, with what privacy policies demand already done to it."""
        return self._loop.run(self._camera.retrieve(name))

    def list(self) -> tuple[ImageInfo, ...]:
        """The pictures of this component on the node, oldest first."""
        return self._loop.run(self._camera.list())

    def delete(self, name: str) -> Result:
        """Delete a picture from the node."""
        return self._loop.run(self._camera.delete(name))


def mobility(endpoint: Endpoint | None = None, *, strict: bool = False) -> Mobility:
    """The mobility service of this node, without asyncio."""
    return Mobility(endpoint, strict=strict)


def camera(endpoint: Endpoint | None = None) -> Camera:
    """The camera service of this node, without asyncio."""
    return Camera(endpoint)

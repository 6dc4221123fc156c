"""The drone that this component rides on: motion, state, and control of it."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import AsyncGenerator, Awaitable, Callable, Generator
from contextlib import aclosing
from typing import Any, TypeVar

import grpc
import grpc.aio
from fractus_proto.v1 import mobility_pb2, mobility_pb2_grpc

from fractus.channel import CALL_TIMEOUT_S, RECONNECT_TIMEOUT_S, Retries, ServiceChannel, ServiceClient
from fractus.control import Control, OnWait
from fractus.dry_runs import CanI
from fractus.environment import Endpoint, endpoint
from fractus.errors import ControlLost, Corrected, FractusError
from fractus.requests import goto_request, speed_request, takeoff_request, velocity_request
from fractus.telemetry import Telemetry, Watch
from fractus.values import (
    AltitudeReference,
    Check,
    Decision,
    Position,
    PositionResult,
    Progress,
    Result,
    Ride,
    SpeedResult,
    Velocity,
    VelocityResult,
)

ARM_TIMEOUT_S = 60.0
"""An autopilot is ready some 40 s after it was switched on."""

R = TypeVar("R", bound=Result)
OnProgress = Callable[[Progress], Awaitable[None] | None]


class Motion:
    """A motion that starts when it is awaited or iterated.

    Awaiting it flies until the motion is complete and gives the last `Progress`; iterating gives every step of it.
    Cancelling the task, or leaving the iteration early, stops the motion: the drone hovers. When the service restarts
    while this component holds control, the motion is asked for again.

    Raises:
        PolicyDenied: policies forbid it; the drone goes on hovering.
        Corrected: the client is strict and a policy changed the target; the motion is stopped.
        ControlLost: the system or a pilot took the drone.
        Unavailable: the service is away, and did not come back.
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


class Mobility(ServiceClient):
    """The mobility service of the node that this component runs on.

    Passengers may ask where the drone is; a driver takes control and then moves it. Every answer tells what policies
    made of the call (`result.decision`, `result.corrected`).

    Args:
        endpoint: where the service is; by default, what the pod's environment says.
        strict: raise `Corrected` instead of accepting what a policy corrected.
        timeout_s: deadline of each call that is not a motion.
        reconnect_timeout_s: how long to wait for a service that is restarting.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        *,
        strict: bool = False,
        timeout_s: float = CALL_TIMEOUT_S,
        reconnect_timeout_s: float = RECONNECT_TIMEOUT_S,
    ) -> None:
        self._channel = ServiceChannel(
            endpoint,
            mobility_pb2_grpc.MobilityServiceStub,
            timeout_s=timeout_s,
            reconnect_timeout_s=reconnect_timeout_s,
        )
        self._strict = strict
        self._control: Control | None = None
        self.can_i = CanI(self._check)
        """Dry runs: `await drone.can_i.goto(lat, lon, 20)`."""
        self.watch = Watch(self.telemetry)
        """One thing of the drone's state, each time it changes: `async for gps in drone.watch.gps()`."""

    async def close(self) -> None:
        """Close the connection; control that is still held breaks off."""
        if self._control is not None:
            await self._control.abandon()
        await super().close()

    def control(self, *, timeout_s: float | None = None, progress: OnWait | None = None) -> Control:
        """Control of the drone for the next control point, as a context manager.

        Args:
            timeout_s: how long to wait for it; by default as long as the drone takes to get there.
            progress: called with what is waited for, each time that changes.
        """
        self._control = Control(self._channel, timeout_s=timeout_s, progress=progress)
        return self._control

    async def arm(self, *, timeout_s: float = ARM_TIMEOUT_S) -> Result:
        """Start the motors.

        Args:
            timeout_s: how long the service asks an autopilot again that is not ready yet.
        """
        return await self._unary("Arm", mobility_pb2.ArmRequest(), timeout_s=timeout_s)

    async def disarm(self) -> Result:
        """Stop the motors; refused in the air."""
        return await self._unary("Disarm", mobility_pb2.DisarmRequest())

    async def hover(self) -> Result:
        """Stop and stay."""
        return await self._unary("Hover", mobility_pb2.HoverRequest())

    async def set_speed(self, speed_mps: float) -> SpeedResult:
        """Fly at this speed over ground from now on.

        Returns:
            The speed in force, after correction.
        """
        reply = await self._call("SetSpeed", speed_request(speed_mps))
        return self._judged(SpeedResult(decision=Decision.from_proto(reply.decision), speed_mps=reply.speed_mps))

    async def set_velocity(
        self,
        north_mps: float,
        east_mps: float,
        down_mps: float = 0.0,
        *,
        yaw_deg: float | None = None,
        hold_s: float = 0.0,
    ) -> VelocityResult:
        """Fly with this velocity over ground until the next one is set.

        When no other follows in time, the drone hovers: call this again and again, ten times a second say.

        Args:
            north_mps: metres per second.
            east_mps: metres per second.
            down_mps: metres per second, positive down.
            yaw_deg: heading in degrees clockwise from true north; unset leaves it to the autopilot.
            hold_s: seconds until the drone hovers, 2 at most; 0 leaves it to the service (0.5 s).

        Returns:
            The velocity in force, after correction.
        """
        request = velocity_request(Velocity(north_mps, east_mps, down_mps), yaw_deg, hold_s)
        reply = await self._call("SetVelocity", request)
        decision, velocity = Decision.from_proto(reply.decision), Velocity.from_proto(reply.velocity)
        return self._judged(VelocityResult(decision=decision, velocity=velocity))

    async def speed(self) -> SpeedResult:
        """The speed over ground, as measured."""
        reply = await self._call("GetSpeed", mobility_pb2.GetSpeedRequest())
        return SpeedResult(decision=Decision.from_proto(reply.decision), speed_mps=reply.speed_mps)

    async def position(self) -> PositionResult:
        """Where the drone is, above home, and how it moves."""
        reply = await self._call("GetPosition", mobility_pb2.GetPositionRequest())
        return PositionResult(
            decision=Decision.from_proto(reply.decision),
            position=Position.from_proto(reply.position),
            velocity=Velocity.from_proto(reply.velocity),
        )

    def takeoff(
        self, altitude_m: float, *, progress: OnProgress | None = None, timeout_s: float | None = None
    ) -> Motion:
        """Climb from the ground to an altitude above home."""
        return self._motion("Takeoff", takeoff_request(altitude_m), progress, timeout_s)

    def land(self, *, progress: OnProgress | None = None, timeout_s: float | None = None) -> Motion:
        """Land here, and disarm."""
        return self._motion("Land", mobility_pb2.LandRequest(), progress, timeout_s)

    def return_to_launch(self, *, progress: OnProgress | None = None, timeout_s: float | None = None) -> Motion:
        """Fly home and land there."""
        return self._motion("ReturnToLaunch", mobility_pb2.ReturnToLaunchRequest(), progress, timeout_s)

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
    ) -> Motion:
        """Fly straight to a position.

        Args:
            lat: degrees north.
            lon: degrees east.
            alt: metres above `reference`.
            reference: what `alt` is measured from; by default the drone's home.
            yaw_deg: heading in degrees clockwise from true north; unset leaves it to the autopilot.
            speed_mps: horizontal speed of this leg; unset keeps the speed in force.
            acceptance_radius_m: how near counts as reached; 0 leaves it to the service (1 m).
            progress: called with each step of the way.
            timeout_s: gives up, and hovers, after this long.
        """
        request = goto_request(Position(lat, lon, alt, reference), yaw_deg, speed_mps, acceptance_radius_m)
        return self._motion("Goto", request, progress, timeout_s)

    async def telemetry(self, interval_s: float = 0.2) -> AsyncGenerator[Telemetry, None]:
        """The drone's state, every `interval_s` seconds, until the iteration is left; goes on after a restart.

        Raises:
            Unavailable: the service is away, and did not come back.
        """
        request = mobility_pb2.SubscribeTelemetryRequest(interval_s=interval_s)
        async with aclosing(self._stream("SubscribeTelemetry", request)) as samples:
            async for message in samples:
                yield Telemetry.from_proto(message)

    async def ride(self) -> AsyncGenerator[Ride, None]:
        """For a passenger of an application without a driver: how far the system is with its points of interest.

        The iteration ends when all were visited; the drone then flies home.

        Raises:
            ControlLost: the mission ended before.
            MissionComplete: it was complete before this began.
            Unavailable: the service is away, and did not come back.
        """
        states = mobility_pb2.ControlEvent
        async with aclosing(self._stream("GetControl", mobility_pb2.GetControlRequest())) as events:
            async for event in events:
                if event.state == states.STATE_LOST:
                    raise ControlLost(event.reason)
                complete = event.state == states.STATE_COMPLETE
                yield Ride(event.state == states.STATE_RIDING, event.waypoints_reached, complete, event.reason)
                if complete:
                    return

    async def _stream(self, method: str, request: Any) -> AsyncGenerator[Any, None]:
        """The messages of a stream that is opened again after the service restarts."""
        retries = Retries(self._channel, method)
        while True:
            try:
                async with self._channel.stub() as stub:
                    call = getattr(stub, method)(request)
                    try:
                        async for message in call:
                            yield message
                            retries.reset()
                    finally:
                        call.cancel()
            except grpc.aio.AioRpcError as error:
                await retries.pause(error)
            else:
                return

    async def _check(self, request: mobility_pb2.CheckCallRequest) -> Check:
        return Check.from_proto(await self._channel.unary("CheckCall", request))

    def _motion(self, method: str, request: Any, progress: OnProgress | None, timeout_s: float | None) -> Motion:
        return Motion(
            self._channel,
            self._control,
            method,
            request,
            strict=self._strict,
            progress=progress,
            timeout_s=timeout_s,
        )

    async def _unary(self, method: str, request: Any, *, timeout_s: float | None = None) -> Result:
        reply = await self._call(method, request, timeout_s=timeout_s)
        return self._judged(Result(decision=Decision.from_proto(reply.decision)))

    async def _call(self, method: str, request: Any, *, timeout_s: float | None = None) -> Any:
        if self._control is not None and self._control.lost is not None:
            raise self._control.lost
        return await self._channel.unary(method, request, timeout_s=timeout_s)

    def _judged(self, result: R) -> R:
        if self._strict and result.corrected:
            raise Corrected(result)
        return result


def mobility(
    target: Endpoint | None = None, *, strict: bool = False, reconnect_timeout_s: float = RECONNECT_TIMEOUT_S
) -> Mobility:
    """The mobility service of this node: `async with fractus.mobility() as drone`.

    Args:
        target: where it is; by default what the pod's environment says.
        strict: raise `Corrected` when a policy changes what was asked.
        reconnect_timeout_s: how long calls wait for a service that is restarting.

    Raises:
        NotConfigured: not in a pod of a Fractus application, and no target given.
    """
    return Mobility(target or endpoint("mobility"), strict=strict, reconnect_timeout_s=reconnect_timeout_s)

"""The drone that this component rides on: motion, state, and control of it."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Sequence
from contextlib import aclosing
from typing import Any, TypeVar

from fractus_proto.v1 import mobility_pb2, mobility_pb2_grpc

from fractus.channel import CALL_TIMEOUT_S, RECONNECT_TIMEOUT_S, ServiceChannel, ServiceClient
from fractus.control import Control, OnWait
from fractus.dry_runs import CanI
from fractus.environment import Endpoint, endpoint
from fractus.errors import ControlLost, Corrected
from fractus.missions import Mission, Waypoint
from fractus.motions import Motion, OnProgress
from fractus.requests import gimbal_request, goto_request, speed_request, takeoff_request, velocity_request
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
        stub = mobility_pb2_grpc.MobilityServiceStub
        self._channel = ServiceChannel(endpoint, stub, timeout_s=timeout_s, reconnect_timeout_s=reconnect_timeout_s)
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

    async def point_gimbal(self, pitch_deg: float, yaw_deg: float = 0.0) -> Result:
        """Turn the camera, and return once the autopilot has taken the command; `watch.gimbal()` tells where it points.

        Args:
            pitch_deg: over the horizon: 0 looks ahead, -90 straight down.
            yaw_deg: clockwise from the nose, which the camera then follows; -180 to 180.

        Raises:
            AutopilotRefused: there is no gimbal, or it does not turn that far.
            CameraFixed: the node's description says that its camera does not move.
        """
        return await self._unary("PointGimbal", gimbal_request(pitch_deg, yaw_deg))

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
        """Climb from the ground to an altitude above home; in the air climb on to it, or pass where the drone is high enough."""
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

    async def turn(self, yaw_deg: float) -> Progress:
        """Point the nose on the spot; needs the method GetPosition, too.

        Args:
            yaw_deg: degrees clockwise from true north.
        """
        here = (await self.position()).position
        return await self.goto(here.lat, here.lon, here.alt, yaw_deg=yaw_deg)

    def mission(self, waypoints: Sequence[Waypoint | Position] | None = None, *, skip_refused: bool = False) -> Mission:
        """Waypoints to fly one after the other: `await drone.mission(fractus.read_plan("survey.plan"))`.

        Args:
            waypoints: the same ones in each life of this component; by default the path of the control point.
            skip_refused: go on with the next one where policies forbid a leg.

        Raises:
            ControlLost: control was not taken.
            InvalidRequest: when it is flown: the control point has a mission of other waypoints.
        """
        if self._control is None:
            raise ControlLost("a mission is for a control point; use `async with drone.control():`")
        return Mission(self._fly, self._control, waypoints, skip_refused=skip_refused)

    def _fly(self, to: Waypoint, progress: OnProgress) -> Motion:
        request = goto_request(to.position, to.yaw_deg, to.speed_mps, to.acceptance_radius_m)
        return self._motion("Goto", request, progress, None)

    async def telemetry(self, interval_s: float = 0.2) -> AsyncGenerator[Telemetry, None]:
        """The drone's state, every `interval_s` seconds, until the iteration is left; goes on after a restart.

        Raises:
            Unavailable: the service is away, and did not come back.
        """
        request = mobility_pb2.SubscribeTelemetryRequest(interval_s=interval_s)
        async with aclosing(self._channel.stream("SubscribeTelemetry", request)) as samples:
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
        async with aclosing(self._channel.stream("GetControl", mobility_pb2.GetControlRequest())) as events:
            async for event in events:
                if event.state == states.STATE_LOST:
                    raise ControlLost(event.reason)
                complete = event.state == states.STATE_COMPLETE
                yield Ride(event.state == states.STATE_RIDING, event.waypoints_reached, complete, event.reason)
                if complete:
                    return

    async def _check(self, request: mobility_pb2.CheckCallRequest) -> Check:
        return Check.from_proto(await self._channel.unary("CheckCall", request))

    def _motion(self, method: str, request: Any, progress: OnProgress | None, timeout_s: float | None) -> Motion:
        strict = self._strict
        return Motion(
            self._channel, self._control, method, request, strict=strict, progress=progress, timeout_s=timeout_s
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

"""Client of the mobility service: motion, state, control and dry runs."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Awaitable, Callable, Sequence
from contextlib import aclosing
from typing import Any, TypeVar

from fractus_proto.v1 import mobility_pb2, mobility_pb2_grpc, types_pb2

from fractus.channel import CALL_TIMEOUT_S, RECONNECT_TIMEOUT_S, ServiceChannel, ServiceClient
from fractus.control import RESPONSE_TIMEOUT_S, Control, Motion, OnProgress, OnWait
from fractus.environment import Endpoint, endpoint
from fractus.errors import ControlLost, Corrected, InvalidRequest
from fractus.forgotten import Pending, check_forgotten
from fractus.mission import Mission, Waypoint
from fractus.telemetry import Telemetry, Watch
from fractus.values import (
    AltitudeReference,
    Check,
    Decision,
    Position,
    PositionResult,
    Progress,
    Result,
    SpeedResult,
    TourProgress,
    Velocity,
    VelocityResult,
)

ARM_TIMEOUT_S = 60.0
"""Default timeout of `arm`, in seconds. An autopilot is ready about 40 s after power-on."""

_RPC_NAMES = {"takeoff": "Takeoff", "land": "Land", "return_to_launch": "ReturnToLaunch", "goto": "Goto"}
"""Names of the motions in the service's interface."""

R = TypeVar("R", bound=Result)


class Mobility(ServiceClient):
    """Client of the mobility service of this component's node.

    Passengers may read the drone's state. A driver acquires control and then moves the drone. Every result contains the
    decision of the policy engine (`result.decision`, `result.corrected`).

    Args:
        endpoint: Address and certificates of the service.
        strict: Raise `Corrected` instead of accepting a correction by a policy.
        timeout_s: Deadline of each call that is not a motion, in seconds.
        reconnect_timeout_s: Time for which calls wait for a restarting service, in seconds.
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
        self._forgotten: list[str] = []
        self.can_i = CanI(self._check_call)
        """Dry runs: `await drone.can_i.goto(lat, lon, 20)`."""
        self.watch = Watch(self.telemetry)
        """Changes of one part of the drone's state: `async for gps in drone.watch.gps()`."""

    async def close(self) -> None:
        """Close the connection. Control that is still held is abandoned."""
        if self._control is not None:
            await self._control.abandon()
        await super().close()

    def control(
        self,
        *,
        timeout_s: float | None = None,
        progress: OnWait | None = None,
        response_timeout_s: float = RESPONSE_TIMEOUT_S,
    ) -> Control:
        """Return the control lease for the next control point, as a context manager.

        Args:
            timeout_s: Longest wait for control, in seconds; by default unlimited.
            progress: Callback for the reason of the wait, called on every change.
            response_timeout_s: Seconds for which the program may block its event loop before it loses control, from 1 to 60;
                0: a hanging program is not noticed, for example in a debugger.
        """
        self._control = Control(
            self._channel,
            timeout_s=timeout_s,
            progress=progress,
            response_timeout_s=response_timeout_s,
            before_return=self._check_forgotten,
        )
        return self._control

    async def arm(self, *, timeout_s: float = ARM_TIMEOUT_S) -> Result:
        """Start the motors.

        Args:
            timeout_s: Time for which the service repeats the command while the autopilot is not ready, in seconds.
        """
        return await self._unary("Arm", mobility_pb2.ArmRequest(), timeout_s=timeout_s)

    async def disarm(self) -> Result:
        """Stop the motors. The call is refused in the air."""
        return await self._unary("Disarm", mobility_pb2.DisarmRequest())

    async def hover(self) -> Result:
        """Stop and hold the position."""
        return await self._unary("Hover", mobility_pb2.HoverRequest())

    async def set_speed(self, speed_mps: float) -> SpeedResult:
        """Set the ground speed of further motions, in metres per second.

        Returns:
            The speed after correction.
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
        """Fly with this velocity over ground until the next setpoint.

        If no setpoint follows within `hold_s`, the drone hovers. Repeat the call, for example ten times per second.

        Args:
            north_mps: Metres per second.
            east_mps: Metres per second.
            down_mps: Metres per second, positive down.
            yaw_deg: Heading in degrees clockwise from true north; by default chosen by the autopilot.
            hold_s: Seconds until the drone hovers, at most 2; 0 selects the service's default (0.5 s).

        Returns:
            The velocity after correction.
        """
        request = velocity_request(Velocity(north_mps, east_mps, down_mps), yaw_deg, hold_s)
        reply = await self._call("SetVelocity", request)
        decision = Decision.from_proto(reply.decision)
        velocity = Velocity.from_proto(reply.velocity)
        return self._judged(VelocityResult(decision=decision, velocity=velocity))

    async def point_gimbal(self, pitch_deg: float, yaw_deg: float = 0.0) -> Result:
        """Turn the camera. The call returns when the autopilot has accepted the command.

        `watch.gimbal()` reports the measured attitude.

        Args:
            pitch_deg: Degrees above the horizon: 0 looks ahead, -90 straight down.
            yaw_deg: Degrees clockwise from the nose, which the camera then follows; -180 to 180.

        Raises:
            AutopilotRefused: There is no gimbal, or it cannot turn that far.
            CameraFixed: The node's description declares a fixed camera.
        """
        return await self._unary("PointGimbal", gimbal_request(pitch_deg, yaw_deg))

    async def speed(self) -> SpeedResult:
        """Return the measured ground speed."""
        reply = await self._call("GetSpeed", mobility_pb2.GetSpeedRequest())
        return SpeedResult(decision=Decision.from_proto(reply.decision), speed_mps=reply.speed_mps)

    async def position(self) -> PositionResult:
        """Return the drone's position (altitude above home) and velocity."""
        reply = await self._call("GetPosition", mobility_pb2.GetPositionRequest())
        return PositionResult(
            decision=Decision.from_proto(reply.decision),
            position=Position.from_proto(reply.position),
            velocity=Velocity.from_proto(reply.velocity),
        )

    def takeoff(
        self, altitude_m: float, *, progress: OnProgress | None = None, timeout_s: float | None = None
    ) -> Motion:
        """Climb to an altitude above home, in metres.

        In the air, the drone climbs further, or the motion completes at once if the drone is high enough.
        """
        return self._motion("takeoff", takeoff_request(altitude_m), progress, timeout_s)

    def land(self, *, progress: OnProgress | None = None, timeout_s: float | None = None) -> Motion:
        """Land at the current position, and disarm."""
        return self._motion("land", mobility_pb2.LandRequest(), progress, timeout_s)

    def return_to_launch(self, *, progress: OnProgress | None = None, timeout_s: float | None = None) -> Motion:
        """Fly home, land and disarm."""
        return self._motion("return_to_launch", mobility_pb2.ReturnToLaunchRequest(), progress, timeout_s)

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
            lat: Degrees north.
            lon: Degrees east.
            alt: Metres above `reference`.
            reference: Datum of `alt`; by default the drone's home.
            yaw_deg: Heading in degrees clockwise from true north; by default chosen by the autopilot.
            speed_mps: Horizontal speed of this leg; by default the current speed setting.
            acceptance_radius_m: Distance at which the target counts as reached; 0 selects the service's default (1 m).
            progress: Callback for each progress report.
            timeout_s: Seconds after which the motion is cancelled and the drone hovers; by default unlimited.
        """
        request = goto_request(Position(lat, lon, alt, reference), yaw_deg, speed_mps, acceptance_radius_m)
        return self._motion("goto", request, progress, timeout_s)

    async def turn(self, yaw_deg: float) -> Progress:
        """Turn the nose at the current position. The component also needs the method GetPosition.

        Args:
            yaw_deg: Degrees clockwise from true north.
        """
        position = (await self.position()).position
        return await self.goto(position.lat, position.lon, position.alt, yaw_deg=yaw_deg)

    def mission(self, waypoints: Sequence[Waypoint | Position] | None = None, *, skip_refused: bool = False) -> Mission:
        """Return a mission that flies waypoints in order: `await drone.mission(fractus.read_plan("survey.plan"))`.

        Args:
            waypoints: Waypoints, the same in every run of this component; by default the path of the control point.
            skip_refused: Continue with the next waypoint if policies forbid a leg.

        Raises:
            ControlLost: Control was not acquired.
        """
        if self._control is None:
            raise ControlLost("a mission is for a control point; use `async with drone.control():`")
        pending = Pending("mission", self._forgotten)
        return Mission(self._fly, self._control, waypoints, skip_refused=skip_refused, pending=pending)

    def _fly(self, to: Waypoint, progress: OnProgress) -> Motion:
        request = goto_request(to.position, to.yaw_deg, to.speed_mps, to.acceptance_radius_m)
        return self._motion("goto", request, progress, None)

    async def telemetry(self, interval_s: float = 0.2) -> AsyncGenerator[Telemetry, None]:
        """Yield the drone's state every `interval_s` seconds. The iteration continues after a restart of the service.

        Raises:
            Unavailable: The service is unreachable and did not return in time.
        """
        request = mobility_pb2.SubscribeTelemetryRequest(interval_s=interval_s)
        async with aclosing(self._channel.stream("SubscribeTelemetry", request)) as samples:
            async for message in samples:
                yield Telemetry.from_proto(message)

    async def passenger(self) -> AsyncGenerator[TourProgress, None]:
        """Yield the progress of the system's tour through this passenger's points of interest.

        For applications without a driver. The iteration ends when all points were visited; the drone then flies home.

        Raises:
            ControlLost: The mission ended before all points were visited.
            MissionComplete: The mission was complete before the call.
            Unavailable: The service is unreachable and did not return in time.
        """
        states = mobility_pb2.ControlEvent
        async with aclosing(self._channel.stream("GetControl", mobility_pb2.GetControlRequest())) as events:
            async for event in events:
                if event.state == states.STATE_LOST:
                    raise ControlLost(event.reason)
                complete = event.state == states.STATE_COMPLETE
                yield TourProgress(
                    event.state == states.STATE_PASSENGER, event.waypoints_reached, complete, event.reason
                )
                if complete:
                    return

    async def _check_call(self, request: mobility_pb2.CheckCallRequest) -> Check:
        return Check.from_proto(await self._channel.unary("CheckCall", request))

    def _motion(self, name: str, request: Any, progress: OnProgress | None, timeout_s: float | None) -> Motion:
        """Return the motion of a method of this class."""
        self._check_forgotten()
        return Motion(
            self._channel,
            self._control,
            _RPC_NAMES[name],
            request,
            strict=self._strict,
            progress=progress,
            timeout_s=timeout_s,
            pending=Pending(name, self._forgotten),
        )

    def _check_forgotten(self) -> None:
        """Raise `InvalidRequest` in a strict client if a motion was not awaited."""
        if self._strict:
            check_forgotten(self._forgotten)

    async def _unary(self, method: str, request: Any, *, timeout_s: float | None = None) -> Result:
        reply = await self._call(method, request, timeout_s=timeout_s)
        return self._judged(Result(decision=Decision.from_proto(reply.decision)))

    async def _call(self, method: str, request: Any, *, timeout_s: float | None = None) -> Any:
        self._check_forgotten()
        if self._control is not None and self._control.lost is not None:
            raise self._control.lost
        return await self._channel.unary(method, request, timeout_s=timeout_s)

    def _judged(self, result: R) -> R:
        if self._strict and result.corrected:
            raise Corrected(result)
        return result


class CanI:
    """Dry runs of the calls of `Mobility`, with the same arguments.

    Each method returns the policy engine's current verdict. The call is not carried out, and the system does not take the drone.
    The component needs a Grant, but not control of the drone.
    """

    def __init__(self, check: Callable[[mobility_pb2.CheckCallRequest], Awaitable[Check]]) -> None:
        self._check = check

    async def arm(self) -> Check:
        """Judge `Mobility.arm`."""
        return await self._judge(arm=mobility_pb2.ArmRequest())

    async def disarm(self) -> Check:
        """Judge `Mobility.disarm`."""
        return await self._judge(disarm=mobility_pb2.DisarmRequest())

    async def takeoff(self, altitude_m: float) -> Check:
        """Judge `Mobility.takeoff`."""
        return await self._judge(takeoff=takeoff_request(altitude_m))

    async def land(self) -> Check:
        """Judge `Mobility.land`."""
        return await self._judge(land=mobility_pb2.LandRequest())

    async def return_to_launch(self) -> Check:
        """Judge `Mobility.return_to_launch`."""
        return await self._judge(return_to_launch=mobility_pb2.ReturnToLaunchRequest())

    async def hover(self) -> Check:
        """Judge `Mobility.hover`."""
        return await self._judge(hover=mobility_pb2.HoverRequest())

    async def goto(
        self,
        lat: float,
        lon: float,
        alt: float,
        *,
        reference: AltitudeReference = AltitudeReference.HOME,
        yaw_deg: float | None = None,
        speed_mps: float | None = None,
    ) -> Check:
        """Judge `Mobility.goto`."""
        return await self._judge(goto=goto_request(Position(lat, lon, alt, reference), yaw_deg, speed_mps))

    async def set_speed(self, speed_mps: float) -> Check:
        """Judge `Mobility.set_speed`."""
        return await self._judge(set_speed=speed_request(speed_mps))

    async def set_velocity(
        self,
        north_mps: float,
        east_mps: float,
        down_mps: float = 0.0,
        *,
        yaw_deg: float | None = None,
        hold_s: float = 0.0,
    ) -> Check:
        """Judge `Mobility.set_velocity`."""
        request = velocity_request(Velocity(north_mps, east_mps, down_mps), yaw_deg, hold_s)
        return await self._judge(set_velocity=request)

    async def point_gimbal(self, pitch_deg: float, yaw_deg: float = 0.0) -> Check:
        """Judge `Mobility.point_gimbal`."""
        return await self._judge(point_gimbal=gimbal_request(pitch_deg, yaw_deg))

    async def position(self) -> Check:
        """Judge `Mobility.position`."""
        return await self._judge(get_position=mobility_pb2.GetPositionRequest())

    async def speed(self) -> Check:
        """Judge `Mobility.speed`."""
        return await self._judge(get_speed=mobility_pb2.GetSpeedRequest())

    async def _judge(self, **call: Any) -> Check:
        return await self._check(mobility_pb2.CheckCallRequest(**call))


def mobility(
    target: Endpoint | None = None, *, strict: bool = False, reconnect_timeout_s: float = RECONNECT_TIMEOUT_S
) -> Mobility:
    """Return a client of this node's mobility service: `async with fractus.mobility() as drone`.

    Args:
        target: Endpoint of the service; by default from the pod's environment.
        strict: Raise `Corrected` if a policy changes the request.
        reconnect_timeout_s: Time for which calls wait for a restarting service, in seconds.

    Raises:
        NotConfigured: The process is not in a pod of a Fractus application, and no target is given.
    """
    return Mobility(target or endpoint("mobility"), strict=strict, reconnect_timeout_s=reconnect_timeout_s)


def takeoff_request(altitude_m: float) -> mobility_pb2.TakeoffRequest:
    """Return the request of a takeoff."""
    return mobility_pb2.TakeoffRequest(altitude_m=_number("altitude_m", altitude_m))


def speed_request(speed_mps: float) -> mobility_pb2.SetSpeedRequest:
    """Return the request of a ground speed."""
    return mobility_pb2.SetSpeedRequest(speed_mps=_number("speed_mps", speed_mps))


def goto_request(
    target: Position, yaw_deg: float | None, speed_mps: float | None, acceptance_radius_m: float = 0.0
) -> mobility_pb2.GotoRequest:
    """Return the request of a leg to a position."""
    return mobility_pb2.GotoRequest(
        target=types_pb2.Position(
            latitude_deg=_number("lat", target.lat),
            longitude_deg=_number("lon", target.lon),
            altitude_m=_number("alt", target.alt),
            altitude_reference=target.reference.value,
        ),
        yaw_deg=None if yaw_deg is None else _number("yaw_deg", yaw_deg),
        speed_mps=None if speed_mps is None else _number("speed_mps", speed_mps),
        acceptance_radius_m=_number("acceptance_radius_m", acceptance_radius_m),
    )


def velocity_request(velocity: Velocity, yaw_deg: float | None, hold_s: float) -> mobility_pb2.SetVelocityRequest:
    """Return the request of a velocity setpoint."""
    return mobility_pb2.SetVelocityRequest(
        velocity=types_pb2.Velocity(
            north_mps=_number("north_mps", velocity.north),
            east_mps=_number("east_mps", velocity.east),
            down_mps=_number("down_mps", velocity.down),
        ),
        yaw_deg=None if yaw_deg is None else _number("yaw_deg", yaw_deg),
        hold_s=_number("hold_s", hold_s),
    )


def gimbal_request(pitch_deg: float, yaw_deg: float) -> mobility_pb2.PointGimbalRequest:
    """Return the request of a camera direction."""
    return mobility_pb2.PointGimbalRequest(
        pitch_deg=_number("pitch_deg", pitch_deg), yaw_deg=_number("yaw_deg", yaw_deg)
    )


def _number(name: str, value: Any) -> float:
    """Return an argument as a float. Protobuf would send zero for some values that are not numbers.

    Raises:
        InvalidRequest: The value is not a number.
    """
    if not isinstance(value, str | bytes | bool | None):
        try:
            return float(value)
        except (TypeError, ValueError, OverflowError):
            pass
    raise InvalidRequest(f"{name} must be a number, not {value!r:.40}; pass a float")

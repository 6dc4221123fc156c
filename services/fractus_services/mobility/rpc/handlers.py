"""gRPC handlers of the mobility service: parse the request, make one call, convert the result."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing
from typing import Protocol

from fractus_core.api.methods import Interface
from fractus_core.api.names import node_identity
from fractus_core.control import Authority
from fractus_core.policy.decision_types import Call, PointGimbalArgs, SetSpeedArgs, TakeoffArgs, Verdict
from fractus_proto.v1 import mobility_pb2, mobility_pb2_grpc

from fractus_services.clock import Clock
from fractus_services.error_details import decision
from fractus_services.errors import (
    AutopilotError,
    InvalidRequest,
    PolicyDenied,
    PreconditionFailed,
    Refused,
    Unavailable,
)
from fractus_services.grant_files import ActiveGrant, GrantFiles
from fractus_services.grpc_server import CallAdmission
from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.flight.authorization import CallAuthorizer
from fractus_services.mobility.flight.service import MobilityService, Progress
from fractus_services.mobility.rpc.control_streams import ControlStreams
from fractus_services.mobility.rpc.proto_conversion import (
    call_of,
    check_call_response,
    control_event,
    goto_args,
    motion_progress,
    return_altitude_m,
    velocity_args,
)
from fractus_services.mobility.rpc.telemetry import located, position_of, telemetry_of, velocity_of
from fractus_services.mobility.settings import SETTINGS


class CallContext(Protocol):
    """The part of `grpc.aio.ServicerContext` that the handlers use themselves."""

    def time_remaining(self) -> float | None:
        """Return the seconds until the deadline of the call; None if it has none."""

    async def write(
        self, message: mobility_pb2.ControlEvent | mobility_pb2.MotionProgress | mobility_pb2.Telemetry
    ) -> None:
        """Send one message of a stream."""


class MobilityHandlers(mobility_pb2_grpc.MobilityServiceServicer):
    """The gRPC service. The grant is looked up again after each wait, because it may have been revoked meanwhile.

    Args:
        service: Methods of the mobility service.
        control: Control state.
        streams: Control streams of drivers and passengers.
        grants: Grants of this node.
        node: Name of the node.
        clock: Unix time.
        on_passenger: Called with the Grant of the caller for every call of a component that is not a driver.
        fixed_camera: Returns True if the node description declares a camera that does not move.
        on_contact: Called with the seconds since the last contact of the node's agent with the API server.
        recording_problem: Returns why flights are not recorded; an empty string if there is no problem.
        interface: Protocol of the calls.
    """

    def __init__(
        self,
        service: MobilityService,
        control: ControlStore,
        streams: ControlStreams,
        *,
        grants: GrantFiles,
        node: str,
        clock: Clock,
        on_passenger: Callable[[ActiveGrant], None] = lambda _grant: None,
        fixed_camera: Callable[[], bool] = bool,
        recording_problem: Callable[[], str] = str,
        interface: Interface = "grpc",
        on_contact: Callable[[float], None] = lambda _age_s: None,
    ) -> None:
        self._on_contact = on_contact
        self._fixed_camera = fixed_camera
        self._recording_problem = recording_problem
        self._service = service
        self._control = control
        self._streams = streams
        self._node = node_identity(node)
        self._clock = clock
        self.admission = CallAdmission(
            grants, clock, _refusal_of, self._handle_internal_error, on_passenger, interface=interface
        )

    @property
    def calls(self) -> CallAuthorizer:
        """Authorizes calls."""
        return self._service.calls

    def _handle_internal_error(self, verdict: Verdict) -> None:
        """Brake if a driver is flying."""
        if self._control.authority is Authority.DRIVER and self._control.autopilot.vehicle.in_air:
            self._control.brake(verdict)

    # Control

    async def GetControl(self, request: mobility_pb2.GetControlRequest, context: CallContext) -> None:  # noqa: N802
        """See mobility.proto."""
        async with self.admission.call(context, lasting=True) as caller:
            grant = self.admission.grant_of(caller)
            self._service.calls.allow(Call("GetControl"), grant)
            try:
                # The stream ends at the latest when the certificate that authenticated the connection expires.
                async with (
                    asyncio.timeout(caller.left_s),
                    aclosing(self._streams.follow(grant, request.response_timeout_s)) as events,
                ):
                    async for event in events:
                        await context.write(control_event(event, grant.spec.control_points))
            except TimeoutError:
                caller.check()

    async def ConfirmAlive(  # noqa: N802
        self, request: mobility_pb2.ConfirmAliveRequest, context: CallContext
    ) -> mobility_pb2.ConfirmAliveResponse:
        """See mobility.proto."""
        async with self.admission.call(context, urgent=True) as caller:
            self._control.confirm_alive(self.admission.grant_of(caller), request.ping)
            return mobility_pb2.ConfirmAliveResponse()

    async def ReturnControl(  # noqa: N802
        self, _request: mobility_pb2.ReturnControlRequest, context: CallContext
    ) -> mobility_pb2.ReturnControlResponse:
        """See mobility.proto."""
        async with self.admission.call(context, urgent=True) as caller:
            grant = self.admission.grant_of(caller)
            self._service.calls.cancel_pending(grant)
            self._service.calls.allow(Call("ReturnControl"), grant)
            last = await self._control.return_control(grant)
            return mobility_pb2.ReturnControlResponse(mission_complete=last)

    async def ReportProgress(  # noqa: N802
        self, request: mobility_pb2.ReportProgressRequest, context: CallContext
    ) -> mobility_pb2.ReportProgressResponse:
        """See mobility.proto."""
        async with self.admission.call(context) as caller:
            await self._control.report_waypoints(self.admission.grant_of(caller), request.waypoints)
            return mobility_pb2.ReportProgressResponse()

    async def ReportContact(  # noqa: N802
        self, request: mobility_pb2.ReportContactRequest, context: CallContext
    ) -> mobility_pb2.ReportContactResponse:
        """See mobility.proto."""
        async with self.admission.call(context) as caller:
            if caller.identity != self._node:
                raise PolicyDenied("NotTheNode", "only the agent of this node may report its contact")
            if not (math.isfinite(request.age_s) and request.age_s >= 0.0):
                raise InvalidRequest("InvalidArgument", f"age_s must be at least 0 s, not {request.age_s:g}")
            self._on_contact(request.age_s)
            return mobility_pb2.ReportContactResponse()

    # Calls without a motion

    async def Arm(self, _request: mobility_pb2.ArmRequest, context: CallContext) -> mobility_pb2.ArmResponse:  # noqa: N802
        """See mobility.proto."""
        async with self.admission.call(context) as caller:
            patience_s = (context.time_remaining() or 0.0) - SETTINGS.arm_response_reserve_s
            verdict = await self._service.arm(self.admission.grant_of(caller), patience_s)
            return mobility_pb2.ArmResponse(decision=decision(verdict))

    async def Disarm(  # noqa: N802
        self, _request: mobility_pb2.DisarmRequest, context: CallContext
    ) -> mobility_pb2.DisarmResponse:
        """See mobility.proto."""
        async with self.admission.call(context) as caller:
            verdict = await self._service.disarm(self.admission.grant_of(caller))
            return mobility_pb2.DisarmResponse(decision=decision(verdict))

    async def Hover(  # noqa: N802
        self, _request: mobility_pb2.HoverRequest, context: CallContext
    ) -> mobility_pb2.HoverResponse:
        """See mobility.proto."""
        async with self.admission.call(context, urgent=True) as caller:
            verdict = await self._service.hover(self.admission.grant_of(caller))
            return mobility_pb2.HoverResponse(decision=decision(verdict))

    async def SetSpeed(  # noqa: N802
        self, request: mobility_pb2.SetSpeedRequest, context: CallContext
    ) -> mobility_pb2.SetSpeedResponse:
        """See mobility.proto."""
        async with self.admission.call(context) as caller:
            await self._service.calls.throttle(self.admission.grant_of(caller))
            verdict, speed = await self._service.set_speed(
                self.admission.grant_of(caller), SetSpeedArgs(request.speed_mps)
            )
            return mobility_pb2.SetSpeedResponse(decision=decision(verdict), speed_mps=speed)

    async def PointGimbal(  # noqa: N802
        self, request: mobility_pb2.PointGimbalRequest, context: CallContext
    ) -> mobility_pb2.PointGimbalResponse:
        """See mobility.proto."""
        async with self.admission.call(context) as caller:
            args = PointGimbalArgs(request.pitch_deg, request.yaw_deg)
            await self._service.calls.throttle(self.admission.grant_of(caller))
            fixed = self._fixed_camera()
            verdict = await self._service.point_gimbal(self.admission.grant_of(caller), args, fixed_camera=fixed)
            return mobility_pb2.PointGimbalResponse(decision=decision(verdict))

    async def GetSpeed(  # noqa: N802
        self, _request: mobility_pb2.GetSpeedRequest, context: CallContext
    ) -> mobility_pb2.GetSpeedResponse:
        """See mobility.proto."""
        async with self.admission.call(context) as caller:
            verdict = self._service.calls.allow(Call("GetSpeed"), self.admission.grant_of(caller))
            speed = self._control.autopilot.vehicle.speed_mps
            return mobility_pb2.GetSpeedResponse(decision=decision(verdict), speed_mps=speed)

    async def SetVelocity(  # noqa: N802
        self, request: mobility_pb2.SetVelocityRequest, context: CallContext
    ) -> mobility_pb2.SetVelocityResponse:
        """See mobility.proto."""
        async with self.admission.call(context) as caller:
            args = velocity_args(request)
            await self._service.calls.throttle_motion(self.admission.grant_of(caller))
            verdict, setpoint = await self._service.set_velocity(self.admission.grant_of(caller), args)
            response = mobility_pb2.SetVelocityResponse(decision=decision(verdict))
            response.velocity.north_mps = setpoint.north_mps
            response.velocity.east_mps = setpoint.east_mps
            response.velocity.down_mps = setpoint.down_mps
            return response

    async def CheckCall(  # noqa: N802
        self, request: mobility_pb2.CheckCallRequest, context: CallContext
    ) -> mobility_pb2.CheckCallResponse:
        """See mobility.proto."""
        async with self.admission.call(context) as caller:
            call = call_of(request)
            await self._service.calls.throttle(self.admission.grant_of(caller))
            return check_call_response(self._service.calls.check(call, self.admission.grant_of(caller)))

    async def GetPosition(  # noqa: N802
        self, _request: mobility_pb2.GetPositionRequest, context: CallContext
    ) -> mobility_pb2.GetPositionResponse:
        """See mobility.proto."""
        async with self.admission.call(context) as caller:
            verdict = self._service.calls.allow(Call("GetPosition"), self.admission.grant_of(caller))
            vehicle = self._control.autopilot.vehicle
            if not located(self._control):
                raise Unavailable("AutopilotUnavailable", "the drone's position is not known yet")
            return mobility_pb2.GetPositionResponse(
                decision=decision(verdict), position=position_of(vehicle), velocity=velocity_of(vehicle)
            )

    # Motions

    async def Takeoff(self, request: mobility_pb2.TakeoffRequest, context: CallContext) -> None:  # noqa: N802
        """See mobility.proto."""
        async with self.admission.call(context, lasting=True) as caller:
            await self._service.calls.throttle_motion(self.admission.grant_of(caller))
            progress = self._service.take_off(self.admission.grant_of(caller), TakeoffArgs(request.altitude_m))
            await self._send_progress(progress, context)

    async def Goto(self, request: mobility_pb2.GotoRequest, context: CallContext) -> None:  # noqa: N802
        """See mobility.proto."""
        async with self.admission.call(context, lasting=True) as caller:
            args = goto_args(request)
            await self._service.calls.throttle_motion(self.admission.grant_of(caller))
            progress = self._service.goto(self.admission.grant_of(caller), args, request.acceptance_radius_m)
            await self._send_progress(progress, context)

    async def Land(self, _request: mobility_pb2.LandRequest, context: CallContext) -> None:  # noqa: N802
        """See mobility.proto."""
        async with self.admission.call(context, urgent=True) as caller:
            await self._send_progress(self._service.land(self.admission.grant_of(caller)), context)

    async def ReturnToLaunch(  # noqa: N802
        self, request: mobility_pb2.ReturnToLaunchRequest, context: CallContext
    ) -> None:
        """See mobility.proto."""
        async with self.admission.call(context, urgent=True) as caller:
            altitude_m = return_altitude_m(request)
            progress = self._service.return_to_launch(self.admission.grant_of(caller), altitude_m)
            await self._send_progress(progress, context)

    async def _send_progress(self, progress: AsyncGenerator[Progress, None], context: CallContext) -> None:
        """Send every step of a motion. Only the first message contains the decision and the target."""
        first = True
        vehicle = self._control.autopilot.vehicle
        async with aclosing(progress) as steps:
            async for current in steps:
                await context.write(motion_progress(current.step, vehicle, current.verdict if first else None))
                first = False

    # Telemetry

    async def SubscribeTelemetry(  # noqa: N802
        self, request: mobility_pb2.SubscribeTelemetryRequest, context: CallContext
    ) -> None:
        """See mobility.proto."""
        async with self.admission.call(context, lasting=True) as caller:
            is_node = caller.identity == self._node
            interval_s = SETTINGS.telemetry_default_interval_s
            if math.isfinite(request.interval_s) and request.interval_s > 0:
                interval_s = max(request.interval_s, SETTINGS.telemetry_min_interval_s)
            loop = asyncio.get_running_loop()
            judged_at = -math.inf
            due = -math.inf
            last_text = 0
            while True:
                if loop.time() - judged_at >= SETTINGS.telemetry_judge_interval_s:
                    judged_at = loop.time()
                    caller.check()
                    if not is_node:
                        self._service.calls.allow(Call("GetPosition"), self.admission.grant_of(caller))
                if loop.time() >= due:
                    due = loop.time() + interval_s
                    sample = self._sample(missions=is_node, last_text=last_text)
                    last_text = sample.texts[-1].number if sample.texts else last_text
                    await context.write(sample)
                await asyncio.sleep(max(min(due - loop.time(), SETTINGS.telemetry_judge_interval_s), 0.0))

    def _sample(self, *, missions: bool, last_text: int) -> mobility_pb2.Telemetry:
        message = telemetry_of(
            self._control,
            self._clock(),
            missions=missions,
            not_ready_reason=self._control.arming_problem,
            last_text=last_text,
        )
        message.recording_problem = self._recording_problem()
        return message


def _refusal_of(error: Exception) -> Refused | None:
    """Return the refusal for an error of the autopilot; None for any other error."""
    if not isinstance(error, AutopilotError):
        return None
    if error.link:
        return Unavailable("AutopilotUnavailable", str(error))
    return PreconditionFailed("AutopilotRefused", str(error))

"""gRPC handlers of the mobility service: parse the request, make one call, translate the outcome."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing
from typing import Any

from fractus_core.api.names import node_identity
from fractus_core.control import Authority
from fractus_core.policy.decision_types import Call, PointGimbalArgs, SetSpeedArgs, TakeoffArgs, Verdict
from fractus_proto.v1 import mobility_pb2, mobility_pb2_grpc

from fractus_services.admission import CallAdmission
from fractus_services.auth import Caller
from fractus_services.clock import Clock
from fractus_services.error_details import decision
from fractus_services.errors import AutopilotError, PreconditionFailed, Refused, Unavailable
from fractus_services.grant_files import ActiveGrant, GrantFiles
from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.flight.pointing import point_gimbal
from fractus_services.mobility.flight.service import MobilityService, Progress
from fractus_services.mobility.rpc.arguments import (
    acceptance_radius_m,
    call_of,
    checked,
    control_event,
    goto_args,
    motion_progress,
    velocity_args,
)
from fractus_services.mobility.rpc.streams import Streams
from fractus_services.mobility.rpc.telemetry import located, position_of, telemetry_of, velocity_of

MIN_INTERVAL_S, DEFAULT_INTERVAL_S = 0.05, 0.2
ANSWER_S = 1.0
"""How long before its deadline a call is answered that waits for the autopilot."""

JUDGE_INTERVAL_S = 0.5
"""How often a stream of telemetry is judged again: a grant that is revoked ends it within a second."""


class MobilityHandlers(mobility_pb2_grpc.MobilityServiceServicer):
    """The service on the wire. A grant is looked up again after each wait: it may have been revoked meanwhile.

    Args:
        service: carries out.
        control: who has the drone.
        streams: of drivers and passengers.
        grants: grants of this node.
        node: its name.
        clock: Unix time.
        heard: told whose grant each call is made under.
        fixed_camera: whether the node's description says that its camera does not move.
        recording_problem: why flights are not recorded though they should be; empty when nothing is wrong.
    """

    def __init__(
        self,
        service: MobilityService,
        control: ControlStore,
        streams: Streams,
        *,
        grants: GrantFiles,
        node: str,
        clock: Clock,
        heard: Callable[[ActiveGrant], None] = lambda _grant: None,
        fixed_camera: Callable[[], bool] = bool,
        recording_problem: Callable[[], str] = str,
    ) -> None:
        self._fixed_camera, self._recording_problem = fixed_camera, recording_problem
        self._service = service
        self._control = control
        self._streams = streams
        self._heard = heard
        self._node = node_identity(node)
        self._clock = clock
        self.admission = CallAdmission(grants, clock, _known, self._failed)

    def _grant_of(self, caller: Caller) -> ActiveGrant:
        """The grant of a caller; a call also tells tours that a component of its application is there."""
        grant = self.admission.grant_of(caller)
        self._heard(grant)
        return grant

    def _failed(self, verdict: Verdict) -> None:
        """An error of ours: hold the drone of a driver where it is."""
        if self._control.authority is Authority.DRIVER and self._control.autopilot.vehicle.in_air:
            self._control.brake(verdict)

    # Control

    async def GetControl(self, _request: Any, context: Any) -> None:  # noqa: N802 - the protocol's name
        """See mobility.proto."""
        async with self.admission.call(context, lasting=True) as caller:
            grant = self._grant_of(caller)
            self._service.calls.allow(Call("GetControl"), grant)
            try:
                # A stream lives no longer than the certificate that its connection was authenticated with.
                async with (
                    asyncio.timeout(caller.left_s),
                    aclosing(self._streams.follow(grant)) as events,
                ):
                    async for event in events:
                        await context.write(control_event(event, grant.spec.control_points))
            except TimeoutError:
                caller.check()

    async def ReturnControl(self, _request: Any, context: Any) -> Any:  # noqa: N802
        """See mobility.proto."""
        async with self.admission.call(context, urgent=True) as caller:
            grant = self._grant_of(caller)
            self._service.calls.supersede(grant)
            self._service.calls.allow(Call("ReturnControl"), grant)
            last = await self._control.return_control(grant)
            return mobility_pb2.ReturnControlResponse(mission_complete=last)

    async def ReportProgress(self, request: Any, context: Any) -> Any:  # noqa: N802
        """See mobility.proto."""
        async with self.admission.call(context) as caller:
            await self._control.report_waypoints(self._grant_of(caller), request.waypoints)
            return mobility_pb2.ReportProgressResponse()

    # Calls that answer at once

    async def Arm(self, _request: Any, context: Any) -> Any:  # noqa: N802
        """See mobility.proto."""
        async with self.admission.call(context) as caller:
            # The refusal must be there before the caller stops waiting for it.
            patience_s = (context.time_remaining() or 0.0) - ANSWER_S
            return mobility_pb2.ArmResponse(
                decision=decision(await self._service.arm(self._grant_of(caller), patience_s))
            )

    async def Disarm(self, _request: Any, context: Any) -> Any:  # noqa: N802
        """See mobility.proto."""
        async with self.admission.call(context) as caller:
            return mobility_pb2.DisarmResponse(decision=decision(await self._service.disarm(self._grant_of(caller))))

    async def Hover(self, _request: Any, context: Any) -> Any:  # noqa: N802
        """See mobility.proto."""
        async with self.admission.call(context, urgent=True) as caller:
            return mobility_pb2.HoverResponse(decision=decision(await self._service.hover(self._grant_of(caller))))

    async def SetSpeed(self, request: Any, context: Any) -> Any:  # noqa: N802
        """See mobility.proto."""
        async with self.admission.call(context) as caller:
            await self._service.calls.turn(self._grant_of(caller))
            verdict, speed = await self._service.set_speed(self._grant_of(caller), SetSpeedArgs(request.speed_mps))
            return mobility_pb2.SetSpeedResponse(decision=decision(verdict), speed_mps=speed)

    async def PointGimbal(self, request: Any, context: Any) -> Any:  # noqa: N802
        """See mobility.proto."""
        async with self.admission.call(context) as caller:
            calls, args = self._service.calls, PointGimbalArgs(request.pitch_deg, request.yaw_deg)
            await calls.turn(self._grant_of(caller))
            fixed, grant = self._fixed_camera(), self._grant_of(caller)
            verdict = await point_gimbal(self._control, calls, grant, args, fixed_camera=fixed)
            return mobility_pb2.PointGimbalResponse(decision=decision(verdict))

    async def GetSpeed(self, _request: Any, context: Any) -> Any:  # noqa: N802
        """See mobility.proto."""
        async with self.admission.call(context) as caller:
            verdict = self._service.calls.allow(Call("GetSpeed"), self._grant_of(caller))
            speed = self._control.autopilot.vehicle.speed_mps
            return mobility_pb2.GetSpeedResponse(decision=decision(verdict), speed_mps=speed)

    async def SetVelocity(self, request: Any, context: Any) -> Any:  # noqa: N802
        """See mobility.proto."""
        async with self.admission.call(context) as caller:
            args = velocity_args(request)
            await self._service.calls.turn_to_move(self._grant_of(caller))
            verdict, flown = await self._service.set_velocity(self._grant_of(caller), args)
            reply = mobility_pb2.SetVelocityResponse(decision=decision(verdict))
            reply.velocity.north_mps, reply.velocity.east_mps = flown.north_mps, flown.east_mps
            reply.velocity.down_mps = flown.down_mps
            return reply

    async def CheckCall(self, request: Any, context: Any) -> Any:  # noqa: N802
        """See mobility.proto."""
        async with self.admission.call(context) as caller:
            call = call_of(request)
            await self._service.calls.turn(self._grant_of(caller))
            return checked(self._service.calls.check(call, self._grant_of(caller)))

    async def GetPosition(self, _request: Any, context: Any) -> Any:  # noqa: N802
        """See mobility.proto."""
        async with self.admission.call(context) as caller:
            verdict = self._service.calls.allow(Call("GetPosition"), self._grant_of(caller))
            vehicle = self._control.autopilot.vehicle
            if not located(self._control):
                raise Unavailable("AutopilotUnavailable", "the drone's position is not known yet")
            return mobility_pb2.GetPositionResponse(
                decision=decision(verdict), position=position_of(vehicle), velocity=velocity_of(vehicle)
            )

    # Motions

    async def Takeoff(self, request: Any, context: Any) -> None:  # noqa: N802
        """See mobility.proto."""
        async with self.admission.call(context, lasting=True) as caller:
            await self._service.calls.turn_to_move(self._grant_of(caller))
            progress = self._service.take_off(self._grant_of(caller), TakeoffArgs(request.altitude_m))
            await self._report(progress, context)

    async def Goto(self, request: Any, context: Any) -> None:  # noqa: N802
        """See mobility.proto."""
        async with self.admission.call(context, lasting=True) as caller:
            args, reached_m = goto_args(request), acceptance_radius_m(request)
            await self._service.calls.turn_to_move(self._grant_of(caller))
            progress = self._service.goto(self._grant_of(caller), args, reached_m)
            await self._report(progress, context)

    async def Land(self, _request: Any, context: Any) -> None:  # noqa: N802
        """See mobility.proto."""
        async with self.admission.call(context, urgent=True) as caller:
            await self._report(self._service.land(self._grant_of(caller)), context)

    async def ReturnToLaunch(self, _request: Any, context: Any) -> None:  # noqa: N802
        """See mobility.proto."""
        async with self.admission.call(context, urgent=True) as caller:
            await self._report(self._service.return_to_launch(self._grant_of(caller)), context)

    async def _report(self, progress: AsyncGenerator[Progress, None], context: Any) -> None:
        first = True
        vehicle = self._control.autopilot.vehicle
        async with aclosing(progress) as steps:
            async for at in steps:
                # Clients remember the decision and the target of the first message.
                await context.write(motion_progress(at.step, vehicle, at.verdict if first else None))
                first = False

    # Telemetry

    async def SubscribeTelemetry(self, request: Any, context: Any) -> None:  # noqa: N802
        """See mobility.proto."""
        async with self.admission.call(context, lasting=True) as caller:
            node = caller.identity == self._node
            wanted = request.interval_s
            interval = max(wanted, MIN_INTERVAL_S) if math.isfinite(wanted) and wanted > 0 else DEFAULT_INTERVAL_S
            loop = asyncio.get_running_loop()
            judged = due = -math.inf
            heard = 0
            while True:
                if loop.time() - judged >= JUDGE_INTERVAL_S:
                    judged = loop.time()
                    caller.check()
                    if not node:
                        self._service.calls.allow(Call("GetPosition"), self._grant_of(caller))
                if loop.time() >= due:
                    due = loop.time() + interval
                    sample = self._sample(missions=node, heard=heard)
                    heard = sample.texts[-1].number if sample.texts else heard
                    await context.write(sample)
                await asyncio.sleep(max(min(due - loop.time(), JUDGE_INTERVAL_S), 0.0))

    def _sample(self, *, missions: bool, heard: int) -> mobility_pb2.Telemetry:
        control = self._control
        message = telemetry_of(
            control, self._clock(), missions=missions, not_ready_reason=control.arming_problem, heard=heard
        )
        message.recording_problem = self._recording_problem()
        return message


def _known(error: Exception) -> Refused | None:
    if not isinstance(error, AutopilotError):
        return None
    code = "AutopilotUnavailable" if error.link else "AutopilotRefused"
    return (Unavailable if error.link else PreconditionFailed)(code, str(error))

"""Conversion between protobuf messages and the values of the policy engine and of flights."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, assert_never

from fractus_core.api.components import ControlPoint
from fractus_core.api.geometry import Area, Point, Reference
from fractus_core.api.methods import CONTROL_METHODS, MOBILITY_METHODS, Method
from fractus_core.control import ControlEvent, StreamState
from fractus_core.exhaustive import exhaustive
from fractus_core.policy.decision_types import (
    Args,
    Call,
    CaptureArgs,
    GotoArgs,
    PointGimbalArgs,
    SetSpeedArgs,
    TakeoffArgs,
    VelocityArgs,
    Verdict,
)
from fractus_proto.v1 import mobility_pb2, types_pb2
from pydantic.alias_generators import to_snake

from fractus_services.error_details import decision
from fractus_services.errors import InvalidRequest, Refused
from fractus_services.mobility.autopilot import VehicleState
from fractus_services.mobility.flight.motions import Step
from fractus_services.mobility.rpc.telemetry import position_of

DEFAULT_HOLD_S = 0.5
"""Hold time of a velocity if the request has none. In proto3 an absent number equals 0."""

_PROTO_REFERENCES: dict[Reference, types_pb2.AltitudeReference] = exhaustive(
    Reference,
    {
        "home": types_pb2.ALTITUDE_REFERENCE_HOME,
        "amsl": types_pb2.ALTITUDE_REFERENCE_AMSL,
        "terrain": types_pb2.ALTITUDE_REFERENCE_TERRAIN,
    },
)
_REFERENCES = {message: reference for reference, message in _PROTO_REFERENCES.items()}


def goto_args(request: mobility_pb2.GotoRequest) -> GotoArgs:
    """Return the arguments of a Goto request.

    Raises:
        Refused: The target is missing, its altitude reference is unknown, or the acceptance radius is negative or not finite.
    """
    if not request.HasField("target"):
        raise _invalid("target is missing; give the position to fly to")
    target = request.target
    if target.altitude_reference not in _REFERENCES:
        raise _invalid(f"target.altitude_reference {target.altitude_reference} is unknown; use home, amsl or terrain")
    if not math.isfinite(request.acceptance_radius_m) or request.acceptance_radius_m < 0:
        raise _invalid(f"the acceptance radius must be 0 m or more, not {request.acceptance_radius_m:g}")
    return GotoArgs(
        lat=target.latitude_deg,
        lon=target.longitude_deg,
        alt=target.altitude_m,
        reference=_REFERENCES[target.altitude_reference],
        yaw_deg=request.yaw_deg if request.HasField("yaw_deg") else None,
        speed_mps=request.speed_mps if request.speed_mps != 0.0 else None,
    )


MAX_RETURN_ALTITUDE_M = 1000.0


def return_altitude_m(request: mobility_pb2.ReturnToLaunchRequest) -> float | None:
    """Return the preferred altitude of a return flight; None if the request contains none.

    Raises:
        Refused: The altitude is out of range.
    """
    if not request.HasField("altitude_m"):
        return None
    if not 0.0 <= request.altitude_m <= MAX_RETURN_ALTITUDE_M:
        raise _invalid(f"altitude_m must be 0 to {MAX_RETURN_ALTITUDE_M:.0f} m above home, not {request.altitude_m:g}")
    return request.altitude_m


def velocity_args(request: mobility_pb2.SetVelocityRequest) -> VelocityArgs:
    """Return the arguments of a SetVelocity request.

    Raises:
        Refused: The velocity is missing.
    """
    if not request.HasField("velocity"):
        raise _invalid("velocity is missing; give north, east and down in m/s")
    return VelocityArgs(
        north_mps=request.velocity.north_mps,
        east_mps=request.velocity.east_mps,
        down_mps=request.velocity.down_mps,
        yaw_deg=request.yaw_deg if request.HasField("yaw_deg") else None,
        hold_s=request.hold_s if request.hold_s != 0.0 else DEFAULT_HOLD_S,
    )


def call_of(request: mobility_pb2.CheckCallRequest) -> Call:
    """Return the call of a CheckCall request.

    Raises:
        Refused: The method or an argument is missing.
    """
    which = request.WhichOneof("call")
    if which is None:
        raise _invalid("call is missing; name the method to check")
    read = _ARGUMENTS.get(which)
    return Call(_METHODS[which], None if read is None else read(getattr(request, which)))


def check_call_response(verdict: Verdict) -> mobility_pb2.CheckCallResponse:
    """Return the reply to a dry run."""
    reply = mobility_pb2.CheckCallResponse(
        decision=decision(verdict), takeover=verdict.takeover or "", brake_first=verdict.brake_first
    )
    match verdict.args if verdict.permits else None:
        case TakeoffArgs() as args:
            reply.takeoff.altitude_m = args.altitude_m
        case SetSpeedArgs() as args:
            reply.set_speed.speed_mps = args.speed_mps
        case GotoArgs() as args:
            _write_goto(reply.goto, args)
        case VelocityArgs() as args:
            _write_velocity(reply.set_velocity, args)
        case PointGimbalArgs() | CaptureArgs() | None:
            pass
        case never:
            assert_never(never)
    return reply


def control_event(event: ControlEvent, points: Sequence[ControlPoint]) -> mobility_pb2.ControlEvent:
    """Return an event of a control stream. The event that grants control contains the task of the control point.

    Args:
        event: Event of the control state machine.
        points: Control points of the caller.
    """
    message = mobility_pb2.ControlEvent(
        state=_STATES[event.state],
        control_point=event.control_point,
        reason=event.reason,
        waypoints_reached=event.waypoints_reached,
    )
    if event.state is StreamState.GRANTED and event.control_point < len(points):
        message.task.CopyFrom(_task(points[event.control_point]))
    message.ping = event.ping
    if event.code:
        message.decision.CopyFrom(decision(Verdict("takeover", None, event.code, event.reason, event.policies)))
    return message


def _task(point: ControlPoint) -> types_pb2.ControlPoint:
    message = types_pb2.ControlPoint(navigation=point.navigation)
    for waypoint in point.path or ():
        message.path.add(
            latitude_deg=waypoint.lat,
            longitude_deg=waypoint.lon,
            altitude_m=math.nan if waypoint.alt is None else waypoint.alt,
            altitude_reference=_PROTO_REFERENCES[waypoint.altitude_reference],
        )
    if point.region is not None:
        _write_area(message.region, point.region)
    return message


def _write_area(message: types_pb2.Area, area: Area) -> None:
    if area.circle is not None:
        message.circle.center.CopyFrom(_position(area.circle.center))
        message.circle.radius_m = area.circle.radius
    elif area.polygon is not None:
        message.polygon.exterior.corners.extend(map(_position, area.polygon.exterior))
        for hole in area.polygon.holes:
            message.polygon.holes.add().corners.extend(map(_position, hole))


def _position(point: Point) -> types_pb2.Position:
    return types_pb2.Position(latitude_deg=point.lat, longitude_deg=point.lon)


def motion_progress(step: Step, vehicle: VehicleState, verdict: Verdict | None) -> mobility_pb2.MotionProgress:
    """Return the progress of a motion. With a verdict, the message contains the decision and the target."""
    message = mobility_pb2.MotionProgress(
        position=position_of(vehicle), distance_m=step.distance_m, complete=step.complete
    )
    if verdict is not None:
        message.decision.CopyFrom(decision(verdict))
        _write_target(message, verdict, vehicle)
    return message


def _write_target(message: mobility_pb2.MotionProgress, verdict: Verdict, vehicle: VehicleState) -> None:
    """Set the target of the motion, with the corrections of the verdict."""
    args = verdict.args
    if isinstance(args, GotoArgs):
        message.target.latitude_deg = args.lat
        message.target.longitude_deg = args.lon
        message.target.altitude_m = args.alt if args.alt is not None else vehicle.altitude_m
    elif isinstance(args, TakeoffArgs):
        message.target.CopyFrom(position_of(vehicle))
        message.target.altitude_m = args.altitude_m
    elif vehicle.home is not None:
        message.target.latitude_deg = vehicle.home.lat
        message.target.longitude_deg = vehicle.home.lon


def _write_goto(message: mobility_pb2.GotoRequest, args: GotoArgs) -> None:
    message.target.latitude_deg = args.lat
    message.target.longitude_deg = args.lon
    message.target.altitude_m = args.alt or 0.0
    message.speed_mps = args.speed_mps or 0.0
    if args.yaw_deg is not None:
        message.yaw_deg = args.yaw_deg


def _write_velocity(message: mobility_pb2.SetVelocityRequest, args: VelocityArgs) -> None:
    message.velocity.north_mps = args.north_mps
    message.velocity.east_mps = args.east_mps
    message.velocity.down_mps = args.down_mps
    message.hold_s = args.hold_s
    if args.yaw_deg is not None:
        message.yaw_deg = args.yaw_deg


def _invalid(reason: str) -> Refused:
    return InvalidRequest("InvalidArgument", reason)


_STATES = {
    StreamState.WAITING: mobility_pb2.ControlEvent.STATE_WAITING,
    StreamState.PING: mobility_pb2.ControlEvent.STATE_PING,
    StreamState.PASSENGER: mobility_pb2.ControlEvent.STATE_PASSENGER,
    StreamState.GRANTED: mobility_pb2.ControlEvent.STATE_GRANTED,
    StreamState.LOST: mobility_pb2.ControlEvent.STATE_LOST,
    StreamState.COMPLETE: mobility_pb2.ControlEvent.STATE_COMPLETE,
}
_ARGUMENTS: dict[str, Callable[[Any], Args]] = {
    "takeoff": lambda request: TakeoffArgs(request.altitude_m),
    "goto": goto_args,
    "set_speed": lambda request: SetSpeedArgs(request.speed_mps),
    "set_velocity": velocity_args,
    "point_gimbal": lambda request: PointGimbalArgs(request.pitch_deg, request.yaw_deg),
}
_METHODS: dict[str, Method] = {to_snake(method): method for method in (*MOBILITY_METHODS, *CONTROL_METHODS)}
"""Methods by the field of CheckCallRequest that contains their request."""

"""The vehicle's state as subscribers see it."""

from __future__ import annotations

import math

from fractus_core.control import Outcome, OutcomeKind
from fractus_proto.v1 import mobility_pb2, types_pb2

from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.authority.home import home_altitude_inconsistent
from fractus_services.mobility.autopilot import MAX_POSITION_AGE_S, WIND_MAX_AGE_S, VehicleState


def position_of(vehicle: VehicleState) -> types_pb2.Position:
    """Position above home; zeros while it is unknown."""
    return types_pb2.Position(
        latitude_deg=vehicle.lat or 0.0, longitude_deg=vehicle.lon or 0.0, altitude_m=vehicle.altitude_m
    )


def velocity_of(vehicle: VehicleState) -> types_pb2.Velocity:
    """Velocity over ground."""
    return types_pb2.Velocity(north_mps=vehicle.north_mps, east_mps=vehicle.east_mps, down_mps=vehicle.down_mps)


def position_age_s(control: ControlStore) -> float:
    """How old the position is; infinite while there was none."""
    return control.autopilot.now - control.autopilot.vehicle.position_at


def located(control: ControlStore) -> bool:
    """Whether the position is known and fresh, and its altitude counts from where home was when the flight began.

    Pictures are judged by it, also while a pilot flies.
    """
    vehicle = control.autopilot.vehicle
    return (
        vehicle.lat is not None
        and vehicle.position_fresh(control.autopilot.now)
        and not home_altitude_inconsistent(control.state, vehicle)
    )


_KINDS = {
    OutcomeKind.COMPLETE: mobility_pb2.MissionOutcome.KIND_COMPLETE,
    OutcomeKind.REVOKED: mobility_pb2.MissionOutcome.KIND_REVOKED,
    OutcomeKind.FAILED: mobility_pb2.MissionOutcome.KIND_FAILED,
}


def _ended(outcome: Outcome) -> mobility_pb2.MissionOutcome:
    return mobility_pb2.MissionOutcome(kind=_KINDS[outcome.kind], reason=outcome.reason)


def telemetry_of(
    control: ControlStore, time_s: float, *, missions: bool, not_ready_reason: str, heard: int
) -> mobility_pb2.Telemetry:
    """The message that subscribers get.

    Args:
        control: who flies, and what.
        time_s: Unix time.
        missions: whether the subscriber may know of the missions of all applications, and of what ended their control.
        not_ready_reason: why the motors could not be started now; empty when they could.
        heard: number of the last of the autopilot's texts that the subscriber has.
    """
    vehicle = control.autopilot.vehicle
    message = mobility_pb2.Telemetry(
        altitude_amsl_m=vehicle.amsl_m,
        yaw_deg=vehicle.yaw_deg,
        battery_remaining=_known(vehicle.battery_remaining),
        battery_voltage_v=_known(vehicle.battery_v),
        battery_current_a=_known(vehicle.battery_a),
        armed=vehicle.armed,
        in_air=vehicle.in_air,
        mode=vehicle.mode.name,
        ready=not not_ready_reason,
        not_ready_reason=not_ready_reason,
        flight_state=vehicle.flight_state,
        controller=control.state.controller,
        controller_reason=control.effects.takeover_reason if missions else "",
        autopilot_connected=control.autopilot.connected,
        missions={key: _ended(outcome) for key, outcome in control.state.outcomes.items()} if missions else {},
    )
    message.time.FromNanoseconds(int(time_s * 1e9))
    # Ages count from when the fastest messages came; on their way they were for as long as this, at most.
    way_s = control.autopilot.way_s
    if located(control):
        message.position.CopyFrom(position_of(vehicle))
        message.velocity.CopyFrom(velocity_of(vehicle))
        age_s = max(position_age_s(control), 0.0)
        message.position_age_s = age_s + way_s
        message.position_error_m = vehicle.position_error_m + vehicle.speed_mps * age_s
    attitude_age_s = control.autopilot.now - vehicle.attitude_at
    if attitude_age_s <= MAX_POSITION_AGE_S:
        message.attitude_age_s = max(attitude_age_s, 0.0) + way_s
        message.attitude.roll_deg, message.attitude.pitch_deg = vehicle.roll_deg, vehicle.pitch_deg
        message.attitude.yaw_deg = vehicle.heading_deg
    gimbal_age_s = control.autopilot.now - vehicle.gimbal_at
    if vehicle.gimbal is not None and gimbal_age_s <= MAX_POSITION_AGE_S:
        message.gimbal_age_s = max(gimbal_age_s, 0.0) + way_s
        message.gimbal.roll_deg, message.gimbal.pitch_deg = vehicle.gimbal.roll_deg, vehicle.gimbal.pitch_deg
        message.gimbal.yaw_deg = vehicle.gimbal.yaw_deg
    if vehicle.satellites is not None:
        message.gps.fix_type, message.gps.satellites = vehicle.fix_type, vehicle.satellites
    if control.autopilot.now - vehicle.wind_at <= WIND_MAX_AGE_S:
        message.wind.from_deg, message.wind.speed_mps = vehicle.wind_from_deg, vehicle.wind_mps
    for number, severity, text in vehicle.reports:
        if number > heard:
            message.texts.add(number=number, severity=severity, text=text)
    if vehicle.home is not None:
        message.home.latitude_deg, message.home.longitude_deg = vehicle.home.lat, vehicle.home.lon
        message.home.altitude_m = vehicle.home.amsl_m
        message.home.altitude_reference = types_pb2.ALTITUDE_REFERENCE_AMSL
    return message


def _known(value: float) -> float:
    return value if math.isfinite(value) else 0.0

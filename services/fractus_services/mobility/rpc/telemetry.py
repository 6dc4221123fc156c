"""Telemetry messages for subscribers."""

from __future__ import annotations

import math

from fractus_core.control import Outcome, OutcomeKind
from fractus_proto.v1 import mobility_pb2, types_pb2

from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.autopilot import MAX_POSITION_AGE_S, WIND_MAX_AGE_S, VehicleState


def position_of(vehicle: VehicleState) -> types_pb2.Position:
    """Return the position with the altitude above home; zeros while it is unknown."""
    return types_pb2.Position(
        latitude_deg=vehicle.lat or 0.0, longitude_deg=vehicle.lon or 0.0, altitude_m=vehicle.altitude_m
    )


def velocity_of(vehicle: VehicleState) -> types_pb2.Velocity:
    """Return the velocity over ground."""
    return types_pb2.Velocity(north_mps=vehicle.north_mps, east_mps=vehicle.east_mps, down_mps=vehicle.down_mps)


def position_age_s(control: ControlStore) -> float:
    """Return the age of the position in seconds; infinite if there was none."""
    return control.autopilot.now - control.autopilot.vehicle.position_at


def located(control: ControlStore) -> bool:
    """Return True if the position is known and fresh, and its altitude is measured from the home of the flight.

    Pictures are judged by this position, also while a pilot flies.
    """
    vehicle = control.autopilot.vehicle
    return (
        vehicle.lat is not None
        and vehicle.position_fresh(control.autopilot.now)
        and not control.home_altitude_inconsistent
    )


_KINDS = {
    OutcomeKind.COMPLETE: mobility_pb2.MissionOutcome.KIND_COMPLETE,
    OutcomeKind.REVOKED: mobility_pb2.MissionOutcome.KIND_REVOKED,
    OutcomeKind.FAILED: mobility_pb2.MissionOutcome.KIND_FAILED,
}


def _outcome_message(outcome: Outcome) -> mobility_pb2.MissionOutcome:
    counts = outcome.waypoints
    return mobility_pb2.MissionOutcome(
        kind=_KINDS[outcome.kind],
        reason=outcome.reason,
        waypoints_reached=counts.reached,
        waypoints_skipped=counts.skipped,
        waypoints_corrected=counts.corrected,
    )


def telemetry_of(
    control: ControlStore, time_s: float, *, missions: bool, not_ready_reason: str, last_text: int
) -> mobility_pb2.Telemetry:
    """Return the current telemetry.

    Args:
        control: Control state.
        time_s: Unix time.
        missions: True if the subscriber may read the missions of all applications and the reason of takeovers.
        not_ready_reason: Reason why the motors could not be armed now; empty if they could.
        last_text: Number of the last status text that the subscriber received.
    """
    vehicle = control.autopilot.vehicle
    outcomes: dict[str, mobility_pb2.MissionOutcome] = {}
    if missions:
        outcomes = {key: _outcome_message(outcome) for key, outcome in control.state.outcomes.items()}
    message = mobility_pb2.Telemetry(
        altitude_amsl_m=vehicle.amsl_m,
        yaw_deg=vehicle.yaw_deg,
        battery_remaining=_finite_or_zero(vehicle.battery_remaining),
        battery_voltage_v=_finite_or_zero(vehicle.battery_v),
        battery_current_a=_finite_or_zero(vehicle.battery_a),
        armed=vehicle.armed,
        in_air=vehicle.in_air,
        mode=vehicle.mode.name,
        ready=not not_ready_reason,
        not_ready_reason=not_ready_reason,
        flight_state=vehicle.flight_state,
        controller=control.state.controller,
        controller_reason=control.effects.takeover_reason if missions else "",
        autopilot_connected=control.autopilot.connected,
        missions=outcomes,
    )
    message.time.FromNanoseconds(int(time_s * 1e9))
    # Ages are measured from the arrival of the fastest messages. Their latency is at most `downlink_latency_s`.
    downlink_latency_s = control.autopilot.downlink_latency_s
    if located(control):
        message.position.CopyFrom(position_of(vehicle))
        message.velocity.CopyFrom(velocity_of(vehicle))
        age_s = max(position_age_s(control), 0.0)
        message.position_age_s = age_s + downlink_latency_s
        message.position_error_m = vehicle.position_error_m + vehicle.speed_mps * age_s
    attitude_age_s = control.autopilot.now - vehicle.attitude_at
    if attitude_age_s <= MAX_POSITION_AGE_S:
        message.attitude_age_s = max(attitude_age_s, 0.0) + downlink_latency_s
        message.attitude.roll_deg = vehicle.roll_deg
        message.attitude.pitch_deg = vehicle.pitch_deg
        message.attitude.yaw_deg = vehicle.heading_deg
    gimbal_age_s = control.autopilot.now - vehicle.gimbal_at
    if vehicle.gimbal is not None and gimbal_age_s <= MAX_POSITION_AGE_S:
        message.gimbal_age_s = max(gimbal_age_s, 0.0) + downlink_latency_s
        message.gimbal.roll_deg = vehicle.gimbal.roll_deg
        message.gimbal.pitch_deg = vehicle.gimbal.pitch_deg
        message.gimbal.yaw_deg = vehicle.gimbal.yaw_deg
    if vehicle.satellites is not None:
        message.gps.fix_type = vehicle.fix_type
        message.gps.satellites = vehicle.satellites
    if control.autopilot.now - vehicle.wind_at <= WIND_MAX_AGE_S:
        message.wind.from_deg = vehicle.wind_from_deg
        message.wind.speed_mps = vehicle.wind_mps
    for text in vehicle.status_texts:
        if text.number > last_text:
            sent = message.texts.add(number=text.number, severity=text.severity, text=text.text)
            sent.time.FromNanoseconds(int((time_s - control.autopilot.now + text.at) * 1e9))
    if vehicle.home is not None:
        message.home.latitude_deg = vehicle.home.lat
        message.home.longitude_deg = vehicle.home.lon
        message.home.altitude_m = vehicle.home.amsl_m
        message.home.altitude_reference = types_pb2.ALTITUDE_REFERENCE_AMSL
    return message


def _finite_or_zero(value: float) -> float:
    return value if math.isfinite(value) else 0.0

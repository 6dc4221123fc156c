"""Prometheus metrics of the mobility service: telemetry age, control authority, failsafe state."""

from __future__ import annotations

from collections.abc import Iterator

from fractus_core.control import Authority
from fractus_runtime.metrics import gauge
from prometheus_client import Metric

from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.authority.supervisor import Supervisor
from fractus_services.service_metrics import telemetry_age


def flight_metrics(control: ControlStore, supervisor: Supervisor) -> Iterator[Metric]:
    """Yield the current metrics of the drone."""
    autopilot = control.autopilot
    vehicle = autopilot.vehicle
    yield telemetry_age(max(autopilot.now - vehicle.position_at, 0.0))
    yield gauge(
        "fractus_autopilot_heartbeat_age_seconds",
        "Seconds since the last heartbeat of the autopilot.",
        max(autopilot.now - vehicle.heartbeat_at, 0.0),
    )
    yield gauge("fractus_in_air", "1 while the drone is in the air, or if that is uncertain.", vehicle.in_air)
    yield gauge(
        "fractus_control_authority",
        "1 for the party that has control authority: driver, system or pilot.",
        {authority.value: float(authority is control.authority) for authority in Authority},
        "authority",
    )
    yield gauge(
        "fractus_companion_alive",
        "1 while the service sends heartbeats, because a driver, the system or a pilot is responsible for the drone.",
        supervisor.alive(),
    )
    yield gauge(
        "fractus_failsafes_verified",
        "1 while the autopilot's failsafes are verified.",
        control.failsafe_status is not None,
    )
    yield gauge(
        "fractus_battery_ratio",
        "Remaining charge of the battery, 0 to 1. NaN if unknown.",
        vehicle.battery_remaining,
    )

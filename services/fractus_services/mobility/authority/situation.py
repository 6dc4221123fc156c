"""The state of the drone as the policy engine judges it."""

from __future__ import annotations

import math
from dataclasses import replace

from fractus_core.control import Authority
from fractus_core.policy.compiled_grant import CompiledGrant
from fractus_core.policy.decision_types import Airframe, Situation

from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.authority.home import home_moved
from fractus_services.mobility.autopilot import LEG_MPS


def fences_of(control: ControlStore) -> CompiledGrant | None:
    """The fences by which the present flight is judged; None where no grant says anything of it.

    What the system flies, or the autopilot by itself, may be anywhere on the way between home and operation area.
    """
    if control.constraints is not None:
        return control.constraints.compiled
    alone = control.state.returning or control.autopilot.vehicle.mode.comes_down
    if control.authority is Authority.DRIVER or not alone:
        return control.mission_grant.compiled if control.mission_grant is not None else None
    return control.for_transit(control.last_grant) if control.last_grant is not None else None


def situation_of(control: ControlStore, time_s: float) -> Situation:
    """The state of the drone at this moment.

    A position that is stale, comes over too slow a link, or counts from a home that was moved, is unknown.

    Args:
        control: the drone.
        time_s: Unix time, by which policies have schedules; positions age by the monotonic clock.
    """
    autopilot, vehicle, motion = control.autopilot, control.autopilot.vehicle, control.motion
    airframe = control.checked.airframe if control.checked is not None else Airframe()
    if airframe.retraces and not control.retraces:
        airframe = replace(airframe, retraces=False)
    unlocated = Situation(
        time_s=time_s,
        home=vehicle.home,
        armed=vehicle.armed,
        in_air=vehicle.in_air,
        airframe=airframe,
        altitude_m=vehicle.altitude_m,
        speed_setpoint_mps=control.cruise_mps,
    )
    latency_s = autopilot.latency_s
    if not vehicle.position_fresh(autopilot.now) or not math.isfinite(latency_s) or home_moved(control.state, vehicle):
        return unlocated
    return replace(
        unlocated,
        lat=vehicle.lat,
        lon=vehicle.lon,
        north_mps=vehicle.north_mps,
        east_mps=vehicle.east_mps,
        down_mps=vehicle.down_mps,
        position_error_m=vehicle.position_error_m,
        latency_s=latency_s,
        forward_mps2=vehicle.forward_mps2,
        pending=_pending(control),
        vertical=vehicle.mode.comes_down
        or (motion is not None and motion.kind in {"Takeoff", "Land", "ReturnToLaunch"}),
    )


def _pending(control: ControlStore) -> tuple[tuple[float, float, float], ...]:
    """What the drone was told of late; a leg is flown no faster than it was told to."""
    pending, motion = control.autopilot.pending, control.motion
    most = max(control.cruise_mps, (motion.speed_mps or 0.0) if motion is not None else 0.0)

    def capped(velocity: tuple[float, float, float]) -> tuple[float, float, float]:
        north, east, down = velocity
        if max(map(abs, velocity)) < LEG_MPS / 2:
            return velocity
        return north * most / LEG_MPS, east * most / LEG_MPS, min(max(down, -most), most)

    return tuple(map(capped, pending))

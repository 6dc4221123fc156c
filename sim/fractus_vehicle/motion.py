"""Physics of one control step: controller output, battery, wind and failed motors to motion of the body."""

from __future__ import annotations

import math

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle.state import ARMING_DELAY_S, CONTROL_STEP_S, VehicleState

PHYSICS_PER_CONTROL = 2
# Share of full thrust at which armed motors idle.
IDLE_SPIN = 0.05
# Time after a reported ground contact in which further contacts (bounces) are not reported.
IMPACT_TEXTS_S = 1.0
# Range of the gyroscopes. If the rotation is faster, the vehicle loses its attitude estimate permanently.
GYRO_RANGE_RPS = math.radians(2000.0)
# Throttle stick position above which the vehicle lifts off in STABILIZE mode.
LIFT_THROTTLE_US = 1550


def move(v: VehicleState) -> None:
    """Advance body, battery and estimate by one control step."""
    dt = CONTROL_STEP_S / PHYSICS_PER_CONTROL
    body = v.body
    full = body.airframe.full_thrust_n
    # The mixer limits the motors to MOT_SPIN_MAX. Thrust is proportional to the square of motor speed.
    share = v.battery.thrust_share * v.params["MOT_SPIN_MAX"] ** 2
    lifting = v.armed and _may_lift(v)
    if body.on_ground and not lifting:
        spin = IDLE_SPIN * full if v.armed and v.time_s > v.armed_at_s + ARMING_DELAY_S else 0.0
        v.battery.step(CONTROL_STEP_S, 4.0 * spin / (body.airframe.mass_kg * 9.8))
        body.step(dt, (spin, spin, spin, spin), (0.0, 0.0, 0.0))
        v.est = v.estimator.estimate(body)
        return
    for _ in range(PHYSICS_PER_CONTROL):
        air = v.wind.step(dt, v.rng, -body.down)
        commands = (0.0, 0.0, 0.0, 0.0)
        if lifting and abs(body.r) < GYRO_RANGE_RPS:
            commands = v.control.step(dt, v.est, full * share)
        failed = int(v.params["SIM_ENGINE_FAIL"])
        if failed:
            left = v.params["SIM_ENGINE_MUL"]
            m = [c * left if failed >> at & 1 else c for at, c in enumerate(commands)]
            commands = (m[0], m[1], m[2], m[3])
        body.step(dt, commands, air)
        v.est = v.estimator.estimate(body)
    v.battery.step(CONTROL_STEP_S, sum(body.motors) / (body.airframe.mass_kg * 9.80665))
    if body.impacts > v.impacts_reported:
        v.impacts_reported = body.impacts
        if v.time_s - v.impact_reported_s > IMPACT_TEXTS_S:
            v.send_text(mavlink.MAV_SEVERITY_INFO, f"SIM Hit ground at {body.impact_mps:f} m/s")
        v.impact_reported_s = v.time_s
    if v.landed and not body.on_ground:
        v.landed = False


def _may_lift(v: VehicleState) -> bool:
    if not v.landed:
        return True
    if v.taking_off:
        return v.time_s >= v.lift_after_s
    return v.mode == mavlink.COPTER_MODE_STABILIZE and v.sticks[2] > LIFT_THROTTLE_US

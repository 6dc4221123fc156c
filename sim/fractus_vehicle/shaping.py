"""Motion shaping: approach a target under speed, acceleration and jerk limits.

Reimplements the square-root controller and kinematic shaping of ArduPilot (AP_Math/control.cpp) for scalars and pairs
of floats. Flight times and peak speeds depend on these functions.
"""

from __future__ import annotations

import math

# Share of the acceleration limit that is used to approach a position without overshoot. This value and
# `settings.JERK_SHARE` are fitted to a real ArduCopter, which flies 50 m in 9.3 s with a peak speed of 8.4 m/s.
BRAKING_SHARE = 0.5


def clamp(value: float, low: float, high: float) -> float:
    """Return `value` limited to [low, high]."""
    if value < low:
        return low
    return min(value, high)


def wrap_pi(angle_rad: float) -> float:
    """Wrap an angle to [-pi, pi)."""
    return (angle_rad + math.pi) % (2.0 * math.pi) - math.pi


def sqrt_controller(error: float, gain: float, limit: float, dt: float) -> float:
    """Return a correction for an error: linear near zero, a square root beyond.

    Its rate of change is at most `limit`.
    """
    linear = limit / (gain * gain)
    if error > linear:
        correction = math.sqrt(2.0 * limit * (error - linear / 2.0))
    elif error < -linear:
        correction = -math.sqrt(2.0 * limit * (-error - linear / 2.0))
    else:
        correction = error * gain
    bound = abs(error) / dt
    return clamp(correction, -bound, bound)


def shape_velocity(
    target: float, velocity: float, acceleration: float, *, accel_max: float, jerk_max: float, dt: float
) -> float:
    """Return the next acceleration that brings `velocity` to `target` within the acceleration and jerk limits."""
    demand = sqrt_controller(target - velocity, jerk_max / accel_max, jerk_max, dt)
    demand = clamp(demand, -accel_max, accel_max)
    step = jerk_max * dt
    return acceleration + clamp(demand - acceleration, -step, step)


def shape_position(
    error: float,
    velocity: float,
    acceleration: float,
    *,
    speed_low: float,
    speed_high: float,
    accel_max: float,
    jerk_max: float,
    dt: float,
) -> float:
    """Return the next acceleration that reduces a position `error` in one axis.

    Speeds are limited to [speed_low, speed_high].
    """
    target = sqrt_controller(error, 0.5 * jerk_max / accel_max, accel_max * BRAKING_SHARE, dt)
    return shape_velocity(
        clamp(target, speed_low, speed_high), velocity, acceleration, accel_max=accel_max, jerk_max=jerk_max, dt=dt
    )


def shape_velocity_xy(
    target: tuple[float, float],
    velocity: tuple[float, float],
    acceleration: tuple[float, float],
    *,
    accel_max: float,
    jerk_max: float,
    dt: float,
) -> tuple[float, float]:
    """`shape_velocity` for the horizontal plane. The limits apply to the length of the vector."""
    error_n = target[0] - velocity[0]
    error_e = target[1] - velocity[1]
    size = math.hypot(error_n, error_e)
    demand_n = 0.0
    demand_e = 0.0
    if size > 1e-9:
        scale = min(sqrt_controller(size, jerk_max / accel_max, jerk_max, dt), accel_max) / size
        demand_n = error_n * scale
        demand_e = error_e * scale
    delta_n = demand_n - acceleration[0]
    delta_e = demand_e - acceleration[1]
    size = math.hypot(delta_n, delta_e)
    step = jerk_max * dt
    scale = step / size if size > step else 1.0
    return acceleration[0] + delta_n * scale, acceleration[1] + delta_e * scale


def shape_position_xy(
    error: tuple[float, float],
    velocity: tuple[float, float],
    acceleration: tuple[float, float],
    *,
    speed_max: float,
    accel_max: float,
    jerk_max: float,
    dt: float,
    feedforward: tuple[float, float] = (0.0, 0.0),
) -> tuple[float, float]:
    """`shape_position` for the horizontal plane. `feedforward` is the velocity of the target."""
    size = math.hypot(error[0], error[1])
    target_n, target_e = feedforward
    if size > 1e-9:
        speed = sqrt_controller(size, 0.5 * jerk_max / accel_max, accel_max * BRAKING_SHARE, dt)
        scale = min(speed, speed_max) / size
        target_n += error[0] * scale
        target_e += error[1] * scale
    return shape_velocity_xy(
        (target_n, target_e), velocity, acceleration, accel_max=accel_max, jerk_max=jerk_max, dt=dt
    )

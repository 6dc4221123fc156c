"""Cascaded controller from target to motor thrust: trajectory shaping, position, velocity, attitude, rate, mixer.

Flight modes set the targets. `Control.step` computes motor thrusts in each physics step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from fractus_vehicle.body import GRAVITY, Airframe
from fractus_vehicle.shaping import (
    BRAKING_SHARE,
    clamp,
    shape_position,
    shape_position_xy,
    shape_velocity,
    shape_velocity_xy,
    wrap_pi,
)

# Speed below which the vehicle counts as stopped. It then holds its position.
STOPPED_MPS = 0.05


Vector = tuple[float, float, float]


class Axis(Enum):
    """Controlled quantity: a position, a velocity, an attitude, or the points of an external trajectory (PATH)."""

    POSITION = "position"
    VELOCITY = "velocity"
    ATTITUDE = "attitude"
    PATH = "path"


@dataclass(slots=True)
class Limits:
    """Motion limits, set from the parameters."""

    speed_mps: float = 10.0
    climb_mps: float = 2.5
    sink_mps: float = 1.5
    accel_mps2: float = 2.5
    accel_z_mps2: float = 1.0
    jerk_mps3: float = 3.0  # jerk limit for position targets
    velocity_jerk_mps3: float = 5.0  # jerk limit for velocity targets
    tilt_max_rad: float = math.radians(30.0)
    yaw_rate_rps: float = math.radians(60.0)

    def change_speed(self, kind: int, speed_mps: float) -> bool:
        """Handle DO_CHANGE_SPEED.

        Args:
            kind: 0 or 1 horizontal, 2 climb, 3 descent.
            speed_mps: New limit in m/s.

        Returns:
            False for another kind or an invalid speed.
        """
        if not speed_mps > 0.0 or not math.isfinite(speed_mps):
            return False
        if kind in (0, 1):
            self.speed_mps = max(speed_mps, 0.2)
        elif kind == 2:
            self.climb_mps = max(speed_mps, 0.1)
        elif kind == 3:
            self.sink_mps = max(speed_mps, 0.1)
        else:
            return False
        return True


class Estimate(NamedTuple):
    """Estimator output: local position and velocity (NED), attitude and body rates."""

    north: float
    east: float
    down: float
    vn: float
    ve: float
    vd: float
    roll: float
    pitch: float
    yaw: float
    p: float
    q: float
    r: float
    quaternion: tuple[float, float, float, float]


@dataclass(slots=True)
class Gains:
    """Feedback gains. Position and velocity gains are derived from ArduPilot's PSC parameters.

    `climb` is fitted to a real ArduCopter, which exceeds a commanded altitude by up to 0.11 m.
    """

    position: float = 1.0
    velocity: float = 2.0
    velocity_i: float = 1.0
    altitude: float = 1.0
    climb: float = 2.0
    climb_i: float = 1.0
    attitude: float = 8.0
    yaw: float = 2.5
    rate: float = 18.0
    yaw_accel: float = 6.0
    max_rate_rps: float = 4.0


class Control:
    """The controller. It shapes a trajectory towards the targets, and tracks the trajectory by feedback."""

    def __init__(self, airframe: Airframe) -> None:
        self.airframe = airframe
        self.limits = Limits()
        self.gains = Gains()
        self.horizontal = Axis.POSITION
        self.vertical = Axis.POSITION
        self.target = (0.0, 0.0)
        self.target_velocity = (0.0, 0.0)
        self.target_accel = (0.0, 0.0)
        self.target_down = 0.0
        self.target_vd = 0.0
        self.target_yaw = 0.0
        self.yaw_rate: float | None = None
        self.attitude = (0.0, 0.0)  # roll and pitch targets, radians, for Axis.ATTITUDE
        self.throttle: float | None = None  # direct thrust share, for STABILIZE
        self.pos = [0.0, 0.0, 0.0]
        self.vel = [0.0, 0.0, 0.0]
        self.acc = [0.0, 0.0, 0.0]
        self.yaw_setpoint = 0.0
        self._integral = [0.0, 0.0, 0.0]
        self._stopping = False
        self._stopped = False
        self._braking_mps2 = 0.0
        self.thrust_share = 0.0
        self.thrust_demand_n = (0.0, 0.0, 0.0, 0.0)  # thrust demand of each motor
        self.lean = (0.0, 0.0)

    def reset(self, est: Estimate) -> None:
        """Reset targets and trajectory to the current estimate."""
        self.horizontal = self.vertical = Axis.POSITION
        self._stopping = False
        self.pos = [est.north, est.east, est.down]
        self.vel = [est.vn, est.ve, est.vd]
        self.acc = [0.0, 0.0, 0.0]
        self.target = (est.north, est.east)
        self.target_down = est.down
        self.target_velocity = self.target_accel = (0.0, 0.0)
        self.target_vd = 0.0
        self.target_yaw = self.yaw_setpoint = est.yaw
        self.yaw_rate = None
        self.throttle = None
        self.attitude = (0.0, 0.0)
        self._integral = [0.0, 0.0, 0.0]

    def restart(self, est: Estimate) -> None:
        """Continue from the estimated horizontal position and velocity, as ArduCopter does when the controller changes.

        A vehicle that is stopped while it passes its target therefore stops beyond it.
        """
        self.pos[:2] = est.north, est.east
        self.vel[:2] = est.vn, est.ve

    def shift(self, north: float, east: float, down: float) -> None:
        """Move the trajectory with an estimate that was reset, as ArduCopter does.

        A vehicle that flies with a velocity, or has stopped, therefore does not react to the reset. A vehicle that flies to a point
        corrects its course. A vehicle whose altitude was reset returns to its altitude.
        """
        self.pos[0] += north
        self.pos[1] += east
        self.pos[2] += down
        if self._stopped:
            self.target = (self.target[0] + north, self.target[1] + east)

    def hold_position(self) -> None:
        """Stop as soon as the limits allow, then hold position and altitude."""
        self.stop()
        vd = self.vel[2]
        self.go_to_altitude(self.pos[2] + vd * abs(vd) / (2.0 * BRAKING_SHARE * self.limits.accel_z_mps2))

    def stop(self, accel_mps2: float | None = None) -> None:
        """Brake with the maximum acceleration, or with `accel_mps2`. Then hold the position."""
        vn = self.vel[0]
        ve = self.vel[1]
        speed = math.hypot(vn, ve)
        self._braking_mps2 = accel_mps2 or self.limits.accel_mps2
        reach = speed / (2.0 * self._braking_mps2)
        self.fly(0.0, 0.0)
        self.target = (self.pos[0] + vn * reach, self.pos[1] + ve * reach)
        self._stopping = True

    def go_to_altitude(self, down: float) -> None:
        """Climb or descend to an altitude (local, down) and hold it."""
        self.vertical = Axis.POSITION
        self.target_down = down
        self.target_vd = 0.0

    def go_to(self, north: float, east: float, down: float | None = None) -> None:
        """Fly to a point and hold it. Without `down` the vertical target is unchanged."""
        self.horizontal = Axis.POSITION
        self._stopping = self._stopped = False
        self.target = (north, east)
        self.target_velocity = (0.0, 0.0)
        if down is not None:
            self.go_to_altitude(down)

    def fly(self, vn: float, ve: float, vd: float | None = None) -> None:
        """Fly with a velocity. Without `vd` the vertical target is unchanged."""
        self.horizontal = Axis.VELOCITY
        self._stopping = False
        self.target_velocity = (vn, ve)
        if vd is not None:
            self.climb(vd)

    def track(self, position: Vector, velocity: Vector, acceleration: Vector) -> None:
        """Set the current point of a trajectory that the caller has shaped."""
        self.horizontal = self.vertical = Axis.PATH
        self._stopping = False
        self.pos[:] = position
        self.vel[:] = velocity
        self.acc[:] = acceleration

    def climb(self, vd: float) -> None:
        """Track a vertical speed (positive down)."""
        self.vertical = Axis.VELOCITY
        self.target_vd = vd

    def step(self, dt: float, est: Estimate, thrust_full_n: float) -> tuple[float, float, float, float]:
        """Advance the trajectory by `dt` seconds and return the thrust demand of each motor in newtons."""
        accel_n, accel_e = (0.0, 0.0) if self.horizontal is Axis.ATTITUDE else self._follow_xy(dt, est)
        accel_d = self._follow_z(dt, est)
        self._turn(dt)
        thrust = self._thrust_and_lean((accel_n, accel_e, accel_d), est, thrust_full_n)
        return self._mix(thrust, est, thrust_full_n)

    def _follow_xy(self, dt: float, est: Estimate) -> tuple[float, float]:
        limits = self.limits
        gains = self.gains
        pos = self.pos
        vel = self.vel
        acc = self.acc
        if self._stopping and math.hypot(vel[0], vel[1]) < STOPPED_MPS:
            self.go_to(pos[0], pos[1])
            self._stopped = True
        velocity = (vel[0], vel[1])
        bend = (acc[0], acc[1])
        if self.horizontal is Axis.POSITION:
            error = (self.target[0] - pos[0], self.target[1] - pos[1])
            acc[0], acc[1] = shape_position_xy(
                error,
                velocity,
                bend,
                speed_max=limits.speed_mps,
                accel_max=limits.accel_mps2,
                jerk_max=limits.jerk_mps3,
                dt=dt,
                feedforward=self.target_velocity,
            )
        elif self.horizontal is Axis.VELOCITY:
            accel = self._braking_mps2 if self._stopping else limits.accel_mps2
            acc[0], acc[1] = shape_velocity_xy(
                self.target_velocity, velocity, bend, accel_max=accel, jerk_max=limits.velocity_jerk_mps3, dt=dt
            )
        vel[0] += acc[0] * dt
        vel[1] += acc[1] * dt
        pos[0] += vel[0] * dt
        pos[1] += vel[1] * dt
        error_n = pos[0] - est.north
        error_e = pos[1] - est.east
        distance = math.hypot(error_n, error_e)
        if distance > 4.0:
            # If a gust or motor failure holds the vehicle back, keep the trajectory within 4 m of it.
            pos[0] = est.north + error_n * 4.0 / distance
            pos[1] = est.east + error_e * 4.0 / distance
        if self.horizontal is Axis.VELOCITY and distance > 2.0:
            pos[0] = est.north + error_n * 2.0 / distance
            pos[1] = est.east + error_e * 2.0 / distance
        slip_n = vel[0] + gains.position * error_n - est.vn
        slip_e = vel[1] + gains.position * error_e - est.ve
        integral = self._integral
        integral[0] = clamp(integral[0] + gains.velocity_i * slip_n * dt, -4.0, 4.0)
        integral[1] = clamp(integral[1] + gains.velocity_i * slip_e * dt, -4.0, 4.0)
        return (
            acc[0] + gains.velocity * slip_n + integral[0],
            acc[1] + gains.velocity * slip_e + integral[1],
        )

    def _follow_z(self, dt: float, est: Estimate) -> float:
        limits = self.limits
        gains = self.gains
        if self.throttle is not None:
            return 0.0
        pos = self.pos
        vel = self.vel
        acc = self.acc
        if self.vertical is Axis.POSITION:
            acc[2] = shape_position(
                self.target_down - pos[2],
                vel[2],
                acc[2],
                speed_low=-limits.climb_mps,
                speed_high=limits.sink_mps,
                accel_max=limits.accel_z_mps2,
                jerk_max=limits.jerk_mps3,
                dt=dt,
            )
        elif self.vertical is Axis.VELOCITY:
            acc[2] = shape_velocity(
                self.target_vd, vel[2], acc[2], accel_max=limits.accel_z_mps2, jerk_max=limits.jerk_mps3, dt=dt
            )
        vel[2] += acc[2] * dt
        pos[2] += vel[2] * dt
        error = clamp(pos[2] - est.down, -2.0, 2.0)
        pos[2] = est.down + error
        slip = vel[2] + gains.altitude * error - est.vd
        self._integral[2] = clamp(self._integral[2] + gains.climb_i * slip * dt, -3.0, 3.0)
        return acc[2] + gains.climb * slip + self._integral[2]

    def _turn(self, dt: float) -> None:
        if self.yaw_rate is not None:
            self.target_yaw = wrap_pi(self.target_yaw + clamp(self.yaw_rate, -3.0, 3.0) * dt)
            self.yaw_setpoint = self.target_yaw
            return
        step = self.limits.yaw_rate_rps * dt
        self.yaw_setpoint = wrap_pi(
            self.yaw_setpoint + clamp(wrap_pi(self.target_yaw - self.yaw_setpoint), -step, step)
        )

    def _thrust_and_lean(self, acceleration: tuple[float, float, float], est: Estimate, full: float) -> float:
        """Convert a demanded acceleration to a lean angle (set in `self.lean`) and a collective thrust in newtons."""
        an, ae, ad = acceleration
        yaw = self.yaw_setpoint
        vertical = clamp(GRAVITY - ad, 0.2 * GRAVITY, 3.0 * GRAVITY)
        if self.horizontal is Axis.ATTITUDE:
            roll, pitch = self.attitude
        else:
            level = math.hypot(an, ae)
            reach = GRAVITY * math.tan(self.limits.tilt_max_rad)
            if level > reach:
                an = an * reach / level
                ae = ae * reach / level
            forward = an * math.cos(yaw) + ae * math.sin(yaw)
            right = ae * math.cos(yaw) - an * math.sin(yaw)
            pitch = math.atan2(-forward, GRAVITY)
            roll = math.atan2(right * math.cos(pitch), GRAVITY)
        self.lean = (roll, pitch)
        if self.throttle is not None:
            return clamp(self.throttle, 0.0, 1.0) * 4.0 * full
        tilt = math.cos(est.roll) * math.cos(est.pitch)
        return self.airframe.mass_kg * vertical / max(tilt, 0.5)

    def _mix(self, thrust: float, est: Estimate, full: float) -> tuple[float, float, float, float]:
        gains = self.gains
        frame = self.airframe
        roll, pitch = self.lean
        # Direction of the demanded body down axis in the world frame, then in the body frame. Thrust direction and
        # heading are controlled separately, so that a change of heading does not bend the flight path.
        cr = math.cos(roll)
        sr = math.sin(roll)
        cp = math.cos(pitch)
        sp = math.sin(pitch)
        cy = math.cos(self.yaw_setpoint)
        sy = math.sin(self.yaw_setpoint)
        dn = cr * sp * cy + sr * sy
        de = cr * sp * sy - sr * cy
        dd = cr * cp
        w, x, y, z = est.quaternion
        ax = (1.0 - 2.0 * (y * y + z * z)) * dn + 2.0 * (x * y + w * z) * de + 2.0 * (x * z - w * y) * dd
        ay = 2.0 * (x * y - w * z) * dn + (1.0 - 2.0 * (x * x + z * z)) * de + 2.0 * (y * z + w * x) * dd
        az = 2.0 * (x * z + w * y) * dn + 2.0 * (y * z - w * x) * de + (1.0 - 2.0 * (x * x + y * y)) * dd
        level = math.hypot(ax, ay)
        turn = math.atan2(level, az) / level if level > 1e-9 else 1.0
        top = gains.max_rate_rps
        rate_p = clamp(-gains.attitude * turn * ay, -top, top)
        rate_q = clamp(gains.attitude * turn * ax, -top, top)
        rate_r = clamp(gains.yaw * wrap_pi(self.yaw_setpoint - est.yaw), -1.5, 1.5) + (self.yaw_rate or 0.0)
        tau_x = frame.inertia_xy * gains.rate * (rate_p - est.p) / frame.arm_m
        tau_y = frame.inertia_xy * gains.rate * (rate_q - est.q) / frame.arm_m
        tau_z = frame.inertia_z * gains.yaw_accel * (rate_r - est.r) / frame.yaw_lever_m
        limit = 0.4 * full
        tau_z = clamp(tau_z, -limit, limit)
        self.thrust_share = thrust / (4.0 * full)
        base = thrust / 4.0
        x4 = tau_x / 4.0
        y4 = tau_y / 4.0
        z4 = tau_z / 4.0
        low = 0.02 * full
        self.thrust_demand_n = (
            clamp(base - x4 + y4 + z4, low, full),
            clamp(base + x4 - y4 + z4, low, full),
            clamp(base + x4 + y4 - z4, low, full),
            clamp(base - x4 - y4 - z4, low, full),
        )
        return self.thrust_demand_n

"""Straight leg, flown from rest to rest with the jerk limit WPNAV_JERK, like ArduPilot's waypoint controller."""

from __future__ import annotations

import math

from fractus_vehicle.control import Axis
from fractus_vehicle.profile import Profile
from fractus_vehicle.shaping import clamp, shape_velocity, shape_velocity_xy
from fractus_vehicle.state import CONTROL_STEP_S, VehicleState

# Speed below which the motion before a leg counts as stopped. STOP_STEPS limits the control steps until then.
RESTING_MPS = 0.02
_STILL = (0.0, 0.0, 0.0)
STOP_STEPS = 3000


Vector = tuple[float, float, float]


def _stopping(v: VehicleState) -> list[tuple[Vector, Vector, Vector]]:
    """Simulate how the vehicle stops.

    Return position, velocity and acceleration for each control step until it rests.
    """
    control = v.control
    limits = v.control.limits
    dt = CONTROL_STEP_S
    pos = list(control.pos)
    vel = list(control.vel)
    acc = list(control.acc)
    rest: list[tuple[Vector, Vector, Vector]] = []
    while math.hypot(*vel) > RESTING_MPS and len(rest) < STOP_STEPS:
        acc[0], acc[1] = shape_velocity_xy(
            (0.0, 0.0),
            (vel[0], vel[1]),
            (acc[0], acc[1]),
            accel_max=limits.accel_mps2,
            jerk_max=limits.velocity_jerk_mps3,
            dt=dt,
        )
        acc[2] = shape_velocity(
            0.0, vel[2], acc[2], accel_max=limits.accel_z_mps2, jerk_max=limits.velocity_jerk_mps3, dt=dt
        )
        for axis in range(3):
            vel[axis] += acc[axis] * dt
            pos[axis] += vel[axis] * dt
        rest.append(((pos[0], pos[1], pos[2]), (vel[0], vel[1], vel[2]), (acc[0], acc[1], acc[2])))
    return rest


def resting_place(v: VehicleState) -> Vector:
    """Return the position where the current trajectory would come to rest."""
    rest = _stopping(v)
    return rest[-1][0] if rest else (v.control.pos[0], v.control.pos[1], v.control.pos[2])


class Leg:
    """Leg of the simulated vehicle to a local point.

    The leg starts at the position where the current motion of the vehicle would come to rest. Create the object
    when the leg begins. Then call `step` in each control step while the vehicle flies the leg.
    """

    def __init__(self, v: VehicleState, north: float, east: float, down: float) -> None:
        control = v.control
        limits = v.control.limits
        self.end = (north, east, down)
        self._rest = _stopping(v)
        last = resting_place(v)
        self._start = last
        displacement = (north - last[0], east - last[1], down - last[2])
        length = math.hypot(*displacement)
        self._along = (
            (displacement[0] / length, displacement[1] / length, displacement[2] / length)
            if length > 0.0
            else (0.0, 0.0, 0.0)
        )
        level = math.hypot(self._along[0], self._along[1])
        rise = self._along[2]
        vertical = limits.climb_mps if rise < 0.0 else limits.sink_mps
        self._speed_mps = min(
            limits.speed_mps / level if level > 0.0 else math.inf, vertical / abs(rise) if rise else math.inf
        )
        accel = min(
            limits.accel_mps2 / level if level > 0.0 else math.inf,
            limits.accel_z_mps2 / abs(rise) if rise else math.inf,
        )
        jerk = max(v.params["WPNAV_JERK"], 0.1)
        speed = min(self._speed_mps, 1e3)
        accel = min(accel, 1e3)
        self._profile = Profile(length, speed, accel, jerk)
        self._begun_mps = limits.speed_mps
        self._pace = 1.0
        self._time_s = 0.0
        self._at = 0
        control.target = (north, east)
        control.target_down = down
        control.target_velocity = (0.0, 0.0)

    @property
    def finished(self) -> bool:
        """True if the trajectory has reached the end of the leg."""
        return self._at >= len(self._rest) and self._time_s >= self._profile.duration_s

    def step(self, v: VehicleState) -> None:
        """Advance the trajectory by one control step.

        If the speed limit has changed, approach it with limited acceleration.
        """
        control = v.control
        limits = v.control.limits
        dt = CONTROL_STEP_S
        if self.finished:
            if control.horizontal is Axis.PATH:
                control.track(self.end, _STILL, _STILL)
                control.go_to(*self.end)
            return
        change = limits.accel_mps2 / max(self._begun_mps, 0.1) * dt
        self._pace += clamp(limits.speed_mps / self._begun_mps - self._pace, -change, change)
        self._time_s += dt * self._pace
        distance, speed, accel = self._profile.at(self._time_s)
        speed *= self._pace
        moving = self._rest[self._at] if self._at < len(self._rest) else (self._start, _STILL, _STILL)
        self._at += 1
        north, east, down = self._along
        position, velocity, acceleration = moving
        control.track(
            (position[0] + distance * north, position[1] + distance * east, position[2] + distance * down),
            (velocity[0] + speed * north, velocity[1] + speed * east, velocity[2] + speed * down),
            (acceleration[0] + accel * north, acceleration[1] + accel * east, acceleration[2] + accel * down),
        )

    def reached(self, v: VehicleState, radius_m: float) -> bool:
        """Return True if the vehicle is within a radius of the end of the leg."""
        return math.dist((v.est.north, v.est.east, v.est.down), self.end) <= radius_m

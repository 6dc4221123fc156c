"""A straight line in space: the climb keeps step with the way over ground, as a real waypoint controller flies."""

from __future__ import annotations

import math

from fractus_vehicle.shaping import clamp
from fractus_vehicle.state import VehicleState

# Shorter ways over ground are climbs.
UPRIGHT_M = 0.5
# How fast a deviation from the line is corrected, 1/s.
LINE_GAIN = 1.0


class Leg:
    """From where the trajectory is to a local point; made when the leg begins, and stepped until it is left."""

    def __init__(self, v: VehicleState, north: float, east: float, down: float) -> None:
        control = v.control
        self.end = (north, east, down)
        self._start = (control.pos[0], control.pos[1], control.pos[2])
        way_n, way_e, rise = north - self._start[0], east - self._start[1], down - self._start[2]
        self._length = math.hypot(way_n, way_e)
        control.go_to(north, east, down)
        if self._length < UPRIGHT_M:
            self._slope = 0.0
            return
        self._along = (way_n / self._length, way_e / self._length)
        self._slope = rise / self._length
        vertical = control.limits.climb_mps if rise < 0.0 else control.limits.sink_mps
        if self._slope:
            control.speed_cap_mps = vertical / abs(self._slope)

    def step(self, v: VehicleState) -> None:
        """Let the altitude follow the line."""
        if not self._slope:
            return
        control = v.control
        pos, vel, limits = control.pos, control.vel, control.limits
        done = (pos[0] - self._start[0]) * self._along[0] + (pos[1] - self._start[1]) * self._along[1]
        if done >= self._length - UPRIGHT_M:
            control.go_to_altitude(self.end[2])
            return
        on_line = self._start[2] + self._slope * max(done, 0.0)
        keep_up = self._slope * (vel[0] * self._along[0] + vel[1] * self._along[1])
        control.climb(clamp(keep_up + LINE_GAIN * (on_line - pos[2]), -limits.climb_mps, limits.sink_mps))

    def reached(self, v: VehicleState, radius_m: float) -> bool:
        """Whether the vehicle is within a radius of the end."""
        return math.dist((v.est.north, v.est.east, v.est.down), self.end) <= radius_m

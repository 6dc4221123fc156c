"""Curved mission leg: a cubic Hermite curve between its ends, like ArduPilot's spline waypoints."""

from __future__ import annotations

import math

from fractus_vehicle.breadcrumbs import Point
from fractus_vehicle.control import Axis
from fractus_vehicle.shaping import BRAKING_SHARE, shape_velocity, sqrt_controller
from fractus_vehicle.state import CONTROL_STEP_S, VehicleState

_SAMPLES = 64
_SLOWEST_MPS = 0.3
# Length of the tangent at an end where the vehicle rests, as a share of the distance. A tangent of length zero would
# have no direction.
AT_REST = 0.1


class SplineLeg:
    """Curve from the current trajectory to a local point, with given directions at both ends."""

    def __init__(self, v: VehicleState, end: Point, leave: Point, arrive: Point) -> None:
        pos = v.control.pos
        vel = v.control.vel
        self.end = end
        self._stops = not any(arrive)
        start = (pos[0], pos[1], pos[2])
        straight = (end[0] - start[0], end[1] - start[1], end[2] - start[2])
        self._speed_mps = math.hypot(vel[0], vel[1], vel[2]) if any(leave) else 0.0
        leave = leave if any(leave) else _scaled(straight, AT_REST)
        arrive = _scaled(straight, AT_REST) if self._stops else arrive
        size = math.hypot(*leave) + math.hypot(*arrive)
        room = 4.0 * math.dist(start, end)
        scale = room / size if size > room else 1.0
        self._curve = tuple(
            (a, la, -3.0 * a - 2.0 * la + 3.0 * b - lb, 2.0 * a + la - 2.0 * b + lb)
            for a, b, la, lb in zip(start, end, _scaled(leave, scale), _scaled(arrive, scale), strict=True)
        )
        self._share = 0.0
        self._accel_mps2 = 0.0
        self._allowed_mps = self._profile(v)

    def _profile(self, v: VehicleState) -> list[float]:
        """Return the maximum speed at each sample of the curve.

        From these speeds, the vehicle can brake in time for bends, climbs and the end of the curve.
        """
        allowed = [self._local_limit(v, step / _SAMPLES) for step in range(_SAMPLES + 1)]
        allowed[-1] = 0.0 if self._stops else allowed[-1]
        limits = v.control.limits
        left_m = 0.0
        braking = 2.0 * BRAKING_SHARE * limits.accel_mps2
        for step in range(_SAMPLES - 1, -1, -1):
            distance_m = math.dist(self.at(step / _SAMPLES), self.at((step + 1) / _SAMPLES))
            allowed[step] = min(allowed[step], math.sqrt(allowed[step + 1] ** 2 + braking * distance_m))
            left_m += distance_m
            if self._stops:  # the jerk limit restricts the speed of the approach to the end
                gain = 0.5 * limits.jerk_mps3 / limits.accel_mps2
                slower = sqrt_controller(left_m, gain, BRAKING_SHARE * limits.accel_mps2, CONTROL_STEP_S)
                allowed[step] = min(allowed[step], slower)
        return allowed

    def at(self, share: float) -> Point:
        """Return the point of the curve at a parameter from 0 to 1."""
        x, y, z = (((d * share + c) * share + b) * share + a for a, b, c, d in self._curve)
        return (x, y, z)

    def _slopes(self, share: float) -> tuple[Point, Point]:
        dx, dy, dz = ((3.0 * d * share + 2.0 * c) * share + b for _, b, c, d in self._curve)
        ddx, ddy, ddz = (6.0 * d * share + 2.0 * c for _, _, c, d in self._curve)
        return (dx, dy, dz), (ddx, ddy, ddz)

    def _local_limit(self, v: VehicleState, share: float) -> float:
        limits = v.control.limits
        slope, bend = self._slopes(share)
        size = max(math.hypot(*slope), 1e-6)
        level = max(math.hypot(slope[0], slope[1]), 1e-6)
        speed_mps = limits.speed_mps * size / level
        if slope[2]:
            speed_mps = min(speed_mps, (limits.climb_mps if slope[2] < 0.0 else limits.sink_mps) * size / abs(slope[2]))
        curvature = abs(slope[0] * bend[1] - slope[1] * bend[0]) / level**3
        return min(speed_mps, math.sqrt(limits.accel_mps2 / curvature)) if curvature > 1e-6 else speed_mps

    def step(self, v: VehicleState) -> None:
        """Advance the trajectory along the curve by one control step."""
        control = v.control
        dt = CONTROL_STEP_S
        if self._share >= 1.0:
            if control.horizontal is Axis.PATH:
                if self._stops:
                    control.track(self.end, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
                control.go_to(*self.end)
            return
        at = self._share * _SAMPLES
        low = min(int(at), _SAMPLES - 1)
        speed_mps = self._allowed_mps[low] + (at - low) * (self._allowed_mps[low + 1] - self._allowed_mps[low])
        speed_mps = max(speed_mps, _SLOWEST_MPS)
        self._accel_mps2 = shape_velocity(
            speed_mps,
            self._speed_mps,
            self._accel_mps2,
            accel_max=control.limits.accel_mps2,
            jerk_max=control.limits.jerk_mps3,
            dt=dt,
        )
        if self._speed_mps + self._accel_mps2 * dt > speed_mps:
            # Brake exactly as the profile requires, because its speeds already include the braking distance. With jerk
            # limits, the vehicle would arrive too fast.
            self._accel_mps2 = max((speed_mps - self._speed_mps) / dt, -control.limits.accel_mps2)
        self._speed_mps = max(self._speed_mps + self._accel_mps2 * dt, 0.0)
        slope, bend = self._slopes(self._share)
        pace = self._speed_mps / max(math.hypot(*slope), 1e-6)
        self._share = min(1.0, self._share + pace * dt)
        control.target = self.end[:2]
        control.target_down = self.end[2]
        control.track(
            self.at(self._share),
            (slope[0] * pace, slope[1] * pace, slope[2] * pace),
            self._acceleration(slope, bend, pace, control.limits.accel_mps2),
        )

    def _acceleration(self, slope: Point, bend: Point, pace: float, most_mps2: float) -> Point:
        """Return the acceleration that keeps the vehicle on the curve and changes its speed."""
        size2 = max(slope[0] ** 2 + slope[1] ** 2 + slope[2] ** 2, 1e-12)
        along = (slope[0] * bend[0] + slope[1] * bend[1] + slope[2] * bend[2]) / size2
        push = self._accel_mps2 / math.sqrt(size2)
        pace2 = pace * pace
        demand = (
            (bend[0] - along * slope[0]) * pace2 + push * slope[0],
            (bend[1] - along * slope[1]) * pace2 + push * slope[1],
            (bend[2] - along * slope[2]) * pace2 + push * slope[2],
        )
        # A short tangent may bend the curve more sharply than the vehicle can fly.
        return _scaled(demand, min(1.0, most_mps2 / max(math.hypot(*demand), 1e-6)))

    @property
    def finished(self) -> bool:
        """True if the trajectory has reached the end of the curve."""
        return self._share >= 1.0

    def reached(self, v: VehicleState, radius_m: float) -> bool:
        """Return True if the curve is complete."""
        position = (v.est.north, v.est.east, v.est.down)
        return self.finished and (not self._stops or math.dist(position, self.end) <= radius_m)


def _scaled(vector: Point, scale: float) -> Point:
    return (vector[0] * scale, vector[1] * scale, vector[2] * scale)

"""Seven-phase motion profile along a line, from rest to rest, with speed, acceleration and jerk limits."""

from __future__ import annotations

import math


class Profile:
    """Distance, speed and acceleration over time. The second half of the profile mirrors the first half."""

    def __init__(self, length_m: float, speed_mps: float, accel_mps2: float, jerk_mps3: float) -> None:
        speed = min(speed_mps, self._fastest(length_m, accel_mps2, jerk_mps3))
        self.length_m = length_m
        self.speed_mps = speed
        self._jerk = jerk_mps3
        self._bend_s = min(accel_mps2 / jerk_mps3, math.sqrt(speed / jerk_mps3))
        accel = self._bend_s * jerk_mps3
        self._rise_s = self._bend_s + speed / accel if accel > 0.0 else 0.0
        cruise_m = max(length_m - speed * self._rise_s, 0.0)
        self.duration_s = 2.0 * self._rise_s + (cruise_m / speed if speed > 0.0 else 0.0)

    @staticmethod
    def _fastest(length_m: float, accel: float, jerk: float) -> float:
        """Return the maximum speed that can be reached at half of the distance."""
        speed = 0.5 * accel * (math.sqrt((accel / jerk) ** 2 + 4.0 * length_m / accel) - accel / jerk)
        return speed if speed * jerk >= accel * accel else (length_m * length_m * jerk / 4.0) ** (1.0 / 3.0)

    def at(self, time_s: float) -> tuple[float, float, float]:
        """Return distance, speed and acceleration after `time_s` seconds."""
        left_s = self.duration_s - time_s
        if left_s <= 0.0:
            return self.length_m, 0.0, 0.0
        if left_s < self._rise_s:
            distance, speed, accel = self._rise(left_s)
            return self.length_m - distance, speed, -accel
        if time_s <= self._rise_s:
            return self._rise(max(time_s, 0.0))
        return self.speed_mps * (time_s - 0.5 * self._rise_s), self.speed_mps, 0.0

    def _rise(self, t: float) -> tuple[float, float, float]:
        """Return distance, speed and acceleration while accelerating: jerk, constant acceleration, opposite jerk."""
        jerk = self._jerk
        bend = self._bend_s
        if t <= bend:
            return jerk * t**3 / 6.0, 0.5 * jerk * t * t, jerk * t
        if t <= self._rise_s - bend:
            steady = t - bend
            accel = jerk * bend
            base = 0.5 * jerk * bend * bend
            return jerk * bend**3 / 6.0 + base * steady + 0.5 * accel * steady * steady, base + accel * steady, accel
        rest = self._rise_s - t
        distance = 0.5 * self.speed_mps * self._rise_s - self.speed_mps * rest + jerk * rest**3 / 6.0
        return distance, self.speed_mps - 0.5 * jerk * rest * rest, jerk * rest

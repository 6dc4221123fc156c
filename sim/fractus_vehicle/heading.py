"""Heading control in automatic flight: along the course, at a fixed angle, or towards a region of interest."""

from __future__ import annotations

import math

from fractus_vehicle.control import Control, Estimate
from fractus_vehicle.params import Parameters
from fractus_vehicle.shaping import clamp, wrap_pi

# Share of the speed limit below which the vehicle keeps its heading instead of following the course.
COURSE_SHARE = 0.05
# A commanded direction is ignored if the heading is this close to the target. Otherwise the vehicle would turn by almost 360
# degrees for a tiny difference on the other side.
ANGLE_REACHED_RAD = math.radians(0.5)


class Heading:
    """Sets the heading target of the controller."""

    def __init__(self, control: Control, params: Parameters) -> None:
        self._control = control
        self._params = params
        self._roi: tuple[float, float] | None = None
        self._fixed = False
        self._left = 0.0
        self._rate_rps = 0.0

    def follow_course(self) -> None:
        """Point the nose along the course, as with the default of WP_YAW_BEHAVIOR."""
        self._left = 0.0
        self._roi = None
        self._fixed = False

    def hold(self) -> None:
        """Keep the heading target of the controller."""
        self._left = 0.0
        self._roi = None
        self._fixed = True

    def look_at(self, point: tuple[float, float] | None) -> None:
        """Point the nose at a local position. None: follow the course again."""
        self._left = 0.0
        self._roi = point
        self._fixed = False

    def turn_to(self, angle_deg: float, rate_dps: float, direction: int, *, relative: bool) -> None:
        """Handle CONDITION_YAW.

        Args:
            angle_deg: Target angle, or the angle to turn if `relative`.
            rate_dps: Turn rate; 0 for the default.
            direction: -1 left, 1 right, 0 the shorter way.
            relative: Measure the angle from the current heading.
        """
        control = self._control
        angle = math.radians(angle_deg)
        control.target_yaw = control.yaw_setpoint
        if relative:
            self._left = -angle if direction < 0 else angle
        else:
            self._left = wrap_pi(angle - control.target_yaw)
            if direction * self._left < 0.0 and abs(self._left) > ANGLE_REACHED_RAD:
                self._left += math.copysign(2.0 * math.pi, direction)
        fastest = math.radians(self._params["ATC_SLEW_YAW"] / 100.0)
        self._rate_rps = min(math.radians(rate_dps), fastest) if rate_dps > 0.0 else fastest
        control.yaw_rate = None
        self._roi = None
        self._fixed = True

    @property
    def turned(self) -> bool:
        """True if the commanded turn is complete."""
        return self._left == 0.0

    def step(self, est: Estimate, dt: float) -> None:
        """Continue a turn, or follow the course or the region of interest."""
        control = self._control
        if self._left:
            step = clamp(self._left, -self._rate_rps * dt, self._rate_rps * dt)
            self._left -= step
            control.target_yaw = wrap_pi(control.target_yaw + step)
        elif self._roi is not None:
            dn = self._roi[0] - est.north
            de = self._roi[1] - est.east
            if math.hypot(dn, de) > 1.0:
                control.target_yaw = math.atan2(de, dn)
        elif not self._fixed and int(self._params["WP_YAW_BEHAVIOR"]) in (1, 2, 3):
            speed = math.hypot(control.vel[0], control.vel[1])
            if speed > COURSE_SHARE * control.limits.speed_mps:
                control.target_yaw = math.atan2(control.vel[1], control.vel[0])

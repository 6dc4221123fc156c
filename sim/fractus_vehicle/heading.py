"""Where the nose points in automatic flight: along the course, at an angle, or at a place."""

from __future__ import annotations

import math

from fractus_vehicle.control import Control, Estimate
from fractus_vehicle.params import Parameters
from fractus_vehicle.shaping import wrap_pi

# Below this share of the speed allowed the nose keeps its heading instead of following the course.
COURSE_SHARE = 0.05


class Heading:
    """Sets the controller's heading target."""

    def __init__(self, control: Control, params: Parameters) -> None:
        self._control = control
        self._params = params
        self._roi: tuple[float, float] | None = None
        self._fixed = False

    def follow_course(self) -> None:
        """The default of WP_YAW_BEHAVIOR."""
        self._roi = None
        self._fixed = False

    def hold(self) -> None:
        """Keep the heading that was set in the controller."""
        self._roi = None
        self._fixed = True

    def look_at(self, point: tuple[float, float] | None) -> None:
        """Keep the nose on a local point; None ends it."""
        self._roi = point
        self._fixed = False

    def turn_to(self, angle_deg: float, rate_dps: float, direction: int, *, relative: bool) -> bool:
        """CONDITION_YAW; False for an angle that is none."""
        if not math.isfinite(angle_deg) or not 0.0 <= abs(angle_deg) <= 360.0:
            return False
        control = self._control
        if relative:
            sign = -1.0 if direction < 0 else 1.0
            control.target_yaw = wrap_pi(control.yaw_setpoint + sign * math.radians(angle_deg))
        else:
            control.target_yaw = wrap_pi(math.radians(angle_deg))
        control.yaw_rate = None
        default = math.radians(self._params["ATC_SLEW_YAW"] / 100.0)
        control.limits.yaw_rate_rps = math.radians(rate_dps) if rate_dps > 0.0 else default
        self.hold()
        return True

    def step(self, est: Estimate) -> None:
        """Follow the course or the place."""
        control = self._control
        if self._roi is not None:
            dn, de = self._roi[0] - est.north, self._roi[1] - est.east
            if math.hypot(dn, de) > 1.0:
                control.target_yaw = math.atan2(de, dn)
        elif not self._fixed and int(self._params["WP_YAW_BEHAVIOR"]) in (1, 2, 3):
            speed = math.hypot(control.vel[0], control.vel[1])
            if speed > COURSE_SHARE * control.limits.speed_mps:
                control.target_yaw = math.atan2(control.vel[1], control.vel[0])

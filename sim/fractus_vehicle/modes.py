"""The flight modes: what each does when it begins and at every control step."""

from __future__ import annotations

import math
from enum import Enum
from typing import TYPE_CHECKING

from fractus_vehicle.auto import AutoFlight
from fractus_vehicle.control import Axis
from fractus_vehicle.descent import LANDING_CONFIRMED_S, descend
from fractus_vehicle.flight import Flight
from fractus_vehicle.guided import GuidedFlight
from fractus_vehicle.mav import Mode
from fractus_vehicle.shaping import clamp
from fractus_vehicle.smart_return import SmartReturn

if TYPE_CHECKING:
    from fractus_vehicle.vehicle import Vehicle

# BRAKE decelerates with this, whatever WPNAV_ACCEL says.
BRAKE_MPS2 = 5.0
# A landing that a failsafe begins waits so long, for a pilot to object.
FAILSAFE_PAUSE_S = 4.0


def stick_rate(pwm: int, dead_zone: int = 30) -> float:
    """A stick's deflection from its centre, -1 to 1."""
    offset = pwm - 1500
    if abs(offset) <= dead_zone:
        return 0.0
    return clamp((offset - math.copysign(dead_zone, offset)) / (500.0 - dead_zone), -1.0, 1.0)


def pilot_climb(v: Vehicle) -> None:
    """Climb and yaw rates from the sticks, as in ALT_HOLD and LOITER; takes off when the pilot raises throttle."""
    up = v.params["PILOT_SPEED_UP"] / 100.0
    down = (v.params["PILOT_SPEED_DN"] / 100.0) or up
    throttle = stick_rate(v.sticks[2], 100)
    if v.landed and throttle > 0.0:
        v.begin_takeoff(v.est.down - 1.0)
        v.taking_off_until_m = None
        v.landed = False
    rate = -throttle * (up if throttle > 0.0 else down)
    if rate == 0.0:
        if v.control.vertical is Axis.VELOCITY:
            v.control.vertical = Axis.POSITION
            v.control.go_to_altitude(v.est.down)
    elif not v.landed:
        v.control.climb(rate)
    yaw = stick_rate(v.sticks[3])
    v.control.yaw_rate = yaw * math.radians(120.0) if yaw else None
    if not yaw:
        v.control.target_yaw = v.control.yaw_setpoint
    if v.body.on_ground and rate > 0.0:
        v.touch_time_s += v.control_step_s
        if v.touch_time_s >= LANDING_CONFIRMED_S:
            v.land_complete()
    else:
        v.touch_time_s = 0.0


class Stabilize(Flight):
    """Sticks set lean angles and thrust."""

    needs_position = False
    manual_throttle = True

    def begin(self, v: Vehicle) -> None:
        """Hand the lean angles to the sticks."""
        v.control.horizontal = Axis.ATTITUDE

    def step(self, v: Vehicle, dt: float) -> None:
        """Follow the sticks."""
        share = clamp((v.sticks[2] - 1000) / 1000.0, 0.0, 1.0)
        lean = v.control.limits.tilt_max_rad
        v.control.attitude = (stick_rate(v.sticks[0]) * lean, stick_rate(v.sticks[1]) * lean)
        v.control.throttle = share * 2.0 * v.body.airframe.hover_share
        yaw = stick_rate(v.sticks[3])
        v.control.yaw_rate = yaw * math.radians(120.0) if yaw else None
        if share > 0.55 and v.landed:
            v.landed = False
        if v.body.on_ground and share < 0.1:
            v.land_complete()


class AltHold(Flight):
    """Sticks set lean angles; the altitude holds unless the throttle leaves its centre."""

    needs_position = False

    def begin(self, v: Vehicle) -> None:
        """Hold the altitude."""
        v.control.hold_here()
        v.control.horizontal = Axis.ATTITUDE

    def step(self, v: Vehicle, dt: float) -> None:
        """Follow the sticks."""
        lean = v.control.limits.tilt_max_rad
        v.control.attitude = (stick_rate(v.sticks[0]) * lean, stick_rate(v.sticks[1]) * lean)
        pilot_climb(v)


class Loiter(Flight):
    """Holds position; sticks move it."""

    def __init__(self) -> None:
        self._moving = False

    def begin(self, v: Vehicle) -> None:
        """Stop and hold."""
        v.control.hold_here()

    def step(self, v: Vehicle, dt: float) -> None:
        """Follow the sticks."""
        forward, right = -stick_rate(v.sticks[1]), stick_rate(v.sticks[0])
        if forward or right:
            speed = v.params["LOIT_SPEED"] / 100.0
            yaw = v.est.yaw
            v.control.fly(
                speed * (forward * math.cos(yaw) - right * math.sin(yaw)),
                speed * (forward * math.sin(yaw) + right * math.cos(yaw)),
            )
        elif self._moving:
            v.control.stop()
        self._moving = bool(forward or right)
        pilot_climb(v)


class Brake(Flight):
    """Stops at once and holds."""

    def begin(self, v: Vehicle) -> None:
        """Stop hard and hold."""
        v.control.hold_here()
        v.control.stop(BRAKE_MPS2)


class Land(Flight):
    """Descends where it is and disarms."""

    needs_position = False

    def __init__(self) -> None:
        self._sink_from_s = 0.0

    @property
    def landing(self) -> bool:
        """Always."""
        return True

    def pause(self, v: Vehicle) -> None:
        """Wait before the descent, as every failsafe that lands does."""
        self._sink_from_s = v.time_s + FAILSAFE_PAUSE_S
        v.control.climb(0.0)

    def begin(self, v: Vehicle) -> None:
        """Stop, or keep level when the position is unknown."""
        v.touch_time_s = 0.0
        if v.position_ok:
            v.control.stop()
        else:
            v.control.horizontal = Axis.ATTITUDE
            v.control.attitude = (0.0, 0.0)
        v.control.yaw_rate = None
        v.control.target_yaw = v.control.yaw_setpoint

    def step(self, v: Vehicle, dt: float) -> None:
        """Sink."""
        if v.control.horizontal is not Axis.ATTITUDE and not v.position_ok:
            v.control.horizontal = Axis.ATTITUDE
            v.control.attitude = (0.0, 0.0)
        if v.time_s >= self._sink_from_s or v.body.on_ground:
            descend(v)


class RtlStage(Enum):
    """The stages of RTL."""

    CLIMB = 1
    RETURN = 2
    LOITER = 3
    LAND = 4
    HOLD = 5


class ReturnToLaunch(Flight):
    """Climbs, returns to home (or the nearest rally point), waits, lands, disarms."""

    def __init__(self) -> None:
        self.stage = RtlStage.CLIMB
        self._loiter_until_s = 0.0
        self._target = (0.0, 0.0)

    @property
    def landing(self) -> bool:
        """Whether it comes down for good."""
        return self.stage is RtlStage.LAND

    def begin(self, v: Vehicle) -> None:
        """Choose target and altitude, and climb."""
        p = v.params
        point = v.return_point()
        self._target, base_down = (point.north, point.east), point.base_down
        distance = point.distance_m((v.est.north, v.est.east))
        height = base_down - v.est.down
        wanted = max(height + p["RTL_CLIMB_MIN"] / 100.0, p["RTL_ALT"] / 100.0, point.altitude_m, 2.0)
        if p["RTL_CONE_SLOPE"] >= 0.5:
            wanted = min(wanted, max(distance * p["RTL_CONE_SLOPE"], 2.0))
        ceiling = v.fence.alt_max_m - p["FENCE_MARGIN"]
        if v.fence.enabled and v.fence.types & 1:
            wanted = min(wanted, ceiling)
        wanted = max(wanted, height)
        if p["RTL_SPEED"] > 0.0:
            v.control.limits.speed_mps = p["RTL_SPEED"] / 100.0
        v.control.stop()
        v.control.go_to_altitude(base_down - wanted)
        v.control.yaw_rate = None
        v.control.target_yaw = v.control.yaw_setpoint
        v.touch_time_s = 0.0

    def step(self, v: Vehicle, dt: float) -> None:
        """Go through the stages."""
        control = v.control
        if self.stage is RtlStage.CLIMB:
            if abs(v.est.down - control.target_down) < 0.5 or v.est.down < control.target_down:
                self.stage = RtlStage.RETURN
                control.go_to(*self._target)
        elif self.stage is RtlStage.RETURN:
            near = math.hypot(self._target[0] - v.est.north, self._target[1] - v.est.east)
            if near < max(v.params["WPNAV_RADIUS"] / 100.0, 0.5):
                self.stage = RtlStage.LOITER
                self._loiter_until_s = v.time_s + v.params["RTL_LOIT_TIME"] / 1000.0
                control.target_yaw = v.armed_heading
        elif self.stage is RtlStage.LOITER:
            if v.time_s >= self._loiter_until_s:
                final = v.params["RTL_ALT_FINAL"] / 100.0
                self.stage = RtlStage.HOLD if final > 0.0 else RtlStage.LAND
                if final > 0.0:
                    control.go_to(*self._target, v.return_point().base_down - final)
        elif self.stage is RtlStage.LAND:
            descend(v)


FLIGHTS: dict[Mode, type[Flight]] = {
    Mode.GUIDED: GuidedFlight,
    Mode.AUTO: AutoFlight,
    Mode.STABILIZE: Stabilize,
    Mode.ALT_HOLD: AltHold,
    Mode.LOITER: Loiter,
    Mode.BRAKE: Brake,
    Mode.LAND: Land,
    Mode.RTL: ReturnToLaunch,
    Mode.SMART_RTL: SmartReturn,
}


def new_flight(mode: Mode) -> Flight:
    """The object that flies a mode."""
    return FLIGHTS[mode]()

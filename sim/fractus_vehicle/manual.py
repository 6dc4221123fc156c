"""Pilot modes: controlled by the sticks."""

from __future__ import annotations

import math

from fractus_vehicle.control import Axis
from fractus_vehicle.descent import LANDING_CONFIRMED_S
from fractus_vehicle.flight import Flight
from fractus_vehicle.shaping import clamp
from fractus_vehicle.state import CONTROL_STEP_S, VehicleState


def stick_rate(pwm: int, dead_zone: int = 30) -> float:
    """Return the deflection of a stick from its centre, -1 to 1."""
    offset = pwm - 1500
    if abs(offset) <= dead_zone:
        return 0.0
    return clamp((offset - math.copysign(dead_zone, offset)) / (500.0 - dead_zone), -1.0, 1.0)


def pilot_climb(v: VehicleState) -> None:
    """Set climb and yaw rates from the sticks, as in ALT_HOLD and LOITER.

    Take off when the pilot raises the throttle.
    """
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
        v.touch_time_s += CONTROL_STEP_S
        if v.touch_time_s >= LANDING_CONFIRMED_S:
            v.land_complete()
    else:
        v.touch_time_s = 0.0


class Stabilize(Flight):
    """STABILIZE mode: the sticks set lean angles and thrust."""

    def begin(self, v: VehicleState) -> None:
        """Switch to attitude control."""
        v.control.horizontal = Axis.ATTITUDE

    def step(self, v: VehicleState) -> None:
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


class Acro(Stabilize):
    """ACRO mode: the sticks set rotation rates and thrust.

    If they are released, the vehicle levels (ACRO_TRAINER 2).
    """

    def step(self, v: VehicleState) -> None:
        """Follow the sticks."""
        roll, pitch = v.control.attitude
        super().step(v)
        turn = math.radians(v.params["ACRO_RP_RATE"]) * CONTROL_STEP_S
        lean = v.control.limits.tilt_max_rad
        right = stick_rate(v.sticks[0])
        forward = stick_rate(v.sticks[1])
        v.control.attitude = (
            clamp(roll + right * turn, -lean, lean) if right else 0.0,
            clamp(pitch + forward * turn, -lean, lean) if forward else 0.0,
        )


class Throw(Flight):
    """THROW mode: waits with stopped motors for a throw, which is not simulated."""


class AltHold(Flight):
    """ALT_HOLD mode: the sticks set lean angles. The altitude is held while the throttle stick is centred."""

    def begin(self, v: VehicleState) -> None:
        """Hold the altitude."""
        v.control.hold_position()
        v.control.horizontal = Axis.ATTITUDE

    def step(self, v: VehicleState) -> None:
        """Follow the sticks."""
        lean = v.control.limits.tilt_max_rad
        v.control.attitude = (stick_rate(v.sticks[0]) * lean, stick_rate(v.sticks[1]) * lean)
        pilot_climb(v)


class Loiter(Flight):
    """LOITER mode: holds the position while the sticks are centred."""

    def __init__(self) -> None:
        self._moving = False

    def begin(self, v: VehicleState) -> None:
        """Stop and hold."""
        v.control.hold_position()

    def step(self, v: VehicleState) -> None:
        """Follow the sticks."""
        forward = -stick_rate(v.sticks[1])
        right = stick_rate(v.sticks[0])
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


class Circle(Flight):
    """CIRCLE mode: circles around a point CIRCLE_RADIUS ahead with the nose towards it.

    The throttle stick sets the climb rate.
    """

    def __init__(self) -> None:
        self._centre = (0.0, 0.0)
        self._angle = 0.0

    def begin(self, v: VehicleState) -> None:
        """Set the centre CIRCLE_RADIUS ahead of the stopping position."""
        v.control.hold_position()
        radius = v.params["CIRCLE_RADIUS"] / 100.0
        yaw = v.est.yaw
        north, east = v.control.target
        self._centre = (north + radius * math.cos(yaw), east + radius * math.sin(yaw))
        self._angle = yaw + math.pi

    def step(self, v: VehicleState) -> None:
        """Advance along the circle."""
        radius = v.params["CIRCLE_RADIUS"] / 100.0
        pilot_climb(v)
        fastest = v.control.limits.speed_mps / max(radius, 1.0)
        self._angle += clamp(math.radians(v.params["CIRCLE_RATE"]), -fastest, fastest) * CONTROL_STEP_S
        north, east = self._centre
        v.control.go_to(north + radius * math.cos(self._angle), east + radius * math.sin(self._angle))
        v.control.target_yaw = math.atan2(east - v.est.east, north - v.est.north)

"""GUIDED mode: takeoff, position, velocity and attitude targets of a companion computer."""

from __future__ import annotations

import math
from enum import Enum

from fractus_vehicle.control import Axis
from fractus_vehicle.flight import Flight
from fractus_vehicle.settings import leg_speeds_mps
from fractus_vehicle.shaping import clamp, sqrt_controller
from fractus_vehicle.state import CONTROL_STEP_S, VehicleState

# Factor by which fence avoidance overestimates the braking ability. A real ArduCopter at 6 m/s flies 2 m beyond a fence
# circle of 30 m.
AVOIDANCE_OPTIMISM = 1.3


class Task(Enum):
    """Current task of GUIDED mode."""

    IDLE = "idle"
    TAKEOFF = "takeoff"
    POSITION = "position"
    VELOCITY = "velocity"
    ATTITUDE = "attitude"


class GuidedFlight(Flight):
    """GUIDED mode."""

    def __init__(self) -> None:
        self.task = Task.IDLE
        self.updated_s = 0.0
        self._controller = Task.VELOCITY
        self.paused = False
        self._commanded_velocity: tuple[float, float, float] | None = None
        self._resume: tuple[float, float, float] | None = None

    def begin(self, v: VehicleState) -> None:
        """Stop and wait for a target."""
        self.task = Task.IDLE
        v.control.hold_position()
        v.heading.follow_course()

    def use(self, v: VehicleState, controller: Task) -> None:
        """Select the position or velocity controller.

        As in ArduCopter, a change of the controller discards a commanded speed, because the new controller uses the
        speeds of the parameters, and restarts its trajectory from the estimate. `stop` keeps the controller and the
        commanded speed.
        """
        if controller is not self._controller:
            self._controller = controller
            v.control.restart(v.est)
            limits = v.control.limits
            limits.speed_mps, limits.climb_mps, limits.sink_mps = leg_speeds_mps(v.params)

    def take_off(self, v: VehicleState, down: float) -> None:
        """Climb straight up to `down` (local, metres)."""
        self._controller = Task.TAKEOFF
        self.task = Task.TAKEOFF
        v.begin_takeoff(down)

    def go_to(self, v: VehicleState, north: float, east: float, down: float) -> None:
        """Fly to a local position. While the flight is paused, store the position until it is resumed."""
        if self.paused:
            self._resume = (north, east, down)
            return
        self.use(v, Task.POSITION)
        self.task = Task.POSITION
        self.updated_s = v.time_s
        v.control.go_to(north, east, down)

    def fly(
        self,
        v: VehicleState,
        velocity: tuple[float, float, float],
        position: tuple[float, float, float] | None = None,
    ) -> None:
        """Fly with a velocity until GUID_TIMEOUT. With a position, follow a point that moves from it with the velocity.

        The target is ignored while the flight is paused.
        """
        if self.paused:
            return
        self.use(v, Task.VELOCITY)
        self.task = Task.VELOCITY
        self.updated_s = v.time_s
        velocity = _limited(v, velocity)
        control = v.control
        self._commanded_velocity = velocity if position is None else None
        if position is None:
            self._avoid(v)
            control.climb(velocity[2])
        else:
            control.go_to(*position)
            control.target_velocity = velocity[:2]
            control.target_vd = velocity[2]

    def _avoid(self, v: VehicleState) -> None:
        """Fly the commanded velocity, slowed down in front of the fence."""
        if self._commanded_velocity is None:
            return
        vn, ve, _ = self._commanded_velocity
        speed = math.hypot(vn, ve)
        braking = AVOIDANCE_OPTIMISM * (v.params["AVOID_ACCEL_MAX"] or v.control.limits.accel_mps2)
        scale = 1.0
        if speed > 0.0:
            allowed = v.fence.speed_allowed(
                v.est.north,
                v.est.east,
                v.home_xy,
                (vn / speed, ve / speed),
                lambda ahead_m: sqrt_controller(ahead_m, v.control.gains.position, braking, CONTROL_STEP_S),
            )
            scale = min(1.0, allowed / speed)
        v.fence.limiting = scale < 1.0
        v.control.fly(vn * scale, ve * scale)

    def lean(self, v: VehicleState, roll: float, pitch: float, yaw: float | None, climb_mps: float) -> None:
        """Hold an attitude with a climb rate, until GUID_TIMEOUT."""
        self._controller = self.task = Task.ATTITUDE
        self.updated_s = v.time_s
        v.control.horizontal = Axis.ATTITUDE
        v.control.attitude = (roll, pitch)
        if yaw is not None:
            v.heading.hold()
        v.control.climb(-climb_mps)

    def stop(self, v: VehicleState) -> None:
        """Stop and hold."""
        self.task = Task.POSITION
        self._commanded_velocity = None
        v.control.hold_position()

    def pause(self, v: VehicleState, *, paused: bool) -> None:
        """Handle DO_PAUSE_CONTINUE: hold the current position, or continue to the last target."""
        if paused and not self.paused:
            self._resume = (*v.control.target, v.control.target_down) if self.task is Task.POSITION else None
            self.stop(v)
        before = self.paused
        self.paused = paused
        if before and not paused and self._resume is not None:
            self.go_to(v, *self._resume)

    def step(self, v: VehicleState) -> None:
        """Track the target, and stop when it has timed out."""
        if self.task is Task.TAKEOFF:
            if v.takeoff_done():
                self.task = Task.POSITION
        elif self.task in (Task.VELOCITY, Task.ATTITUDE):
            if v.time_s - self.updated_s > v.params["GUID_TIMEOUT"]:
                if self.task is Task.ATTITUDE:
                    v.control.pos[0] = v.est.north
                    v.control.pos[1] = v.est.east
                    v.control.vel[0] = v.est.vn
                    v.control.vel[1] = v.est.ve
                self.stop(v)
            elif self._commanded_velocity is not None and self.task is Task.VELOCITY:
                self._avoid(v)
            elif v.control.horizontal is Axis.POSITION and self.task is Task.VELOCITY:
                vn, ve = v.control.target_velocity
                north, east = v.control.target
                v.control.target = (north + vn * CONTROL_STEP_S, east + ve * CONTROL_STEP_S)
                v.control.target_down += v.control.target_vd * CONTROL_STEP_S
        v.heading.step(v.est, CONTROL_STEP_S)


class GuidedWithoutGps(GuidedFlight):
    """GUIDED_NOGPS mode: accepts attitude targets only. The vehicle stays level until it receives a target."""

    def begin(self, v: VehicleState) -> None:
        """Level out."""
        v.control.hold_position()
        self.lean(v, 0.0, 0.0, None, 0.0)

    def go_to(self, _v: VehicleState, _north: float, _east: float, _down: float) -> None:
        """Ignore the target, because the mode has no position estimate."""

    def fly(
        self,
        _v: VehicleState,
        _velocity: tuple[float, float, float],
        _position: tuple[float, float, float] | None = None,
    ) -> None:
        """Ignore the target, because the mode has no position estimate."""

    def stop(self, v: VehicleState) -> None:
        """Level out."""
        self.lean(v, 0.0, 0.0, None, 0.0)


def _limited(v: VehicleState, velocity: tuple[float, float, float]) -> tuple[float, float, float]:
    limits = v.control.limits
    size = math.hypot(velocity[0], velocity[1])
    scale = limits.speed_mps / size if size > limits.speed_mps else 1.0
    return (velocity[0] * scale, velocity[1] * scale, clamp(velocity[2], -limits.climb_mps, limits.sink_mps))

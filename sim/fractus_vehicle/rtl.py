"""RTL mode: climb, return to home or a rally point, land."""

from __future__ import annotations

from enum import Enum

from fractus_vehicle.descent import descend
from fractus_vehicle.flight import Flight
from fractus_vehicle.leg import Leg, resting_place
from fractus_vehicle.return_points import return_point
from fractus_vehicle.state import VehicleState


class RtlStage(Enum):
    """The stages of RTL."""

    CLIMB = 1
    RETURN = 2
    LOITER = 3
    LAND = 4
    HOLD = 5


class ReturnToLaunch(Flight):
    """RTL mode: climb, return to home or the nearest rally point, wait, land, disarm."""

    def __init__(self) -> None:
        self.stage = RtlStage.CLIMB
        self._leg: Leg | None = None
        self._loiter_until_s = 0.0
        self._target = (0.0, 0.0)
        self._down = 0.0

    @property
    def landing(self) -> bool:
        """True during the final descent."""
        return self.stage is RtlStage.LAND

    def begin(self, v: VehicleState) -> None:
        """Choose the destination and altitude, and begin to climb."""
        p = v.params
        point = return_point(v)
        self._target = (point.north, point.east)
        base_down = point.base_down
        distance = point.distance_m((v.est.north, v.est.east))
        height = base_down - v.est.down
        least = max(height + p["RTL_CLIMB_MIN"] / 100.0, 2.0)
        altitude_m = max(least, p["RTL_ALT"] / 100.0, point.altitude_m)
        if p["RTL_CONE_SLOPE"] >= 0.5:
            altitude_m = min(altitude_m, max(distance * p["RTL_CONE_SLOPE"], least))
        ceiling = v.fence.alt_max_m - p["FENCE_MARGIN"]
        if v.fence.enabled and v.fence.types & 1:
            altitude_m = min(altitude_m, ceiling)
        altitude_m = max(altitude_m, height)
        if p["RTL_SPEED"] > 0.0:
            v.control.limits.speed_mps = p["RTL_SPEED"] / 100.0
        self._down = base_down - altitude_m
        v.control.yaw_rate = None
        v.control.target_yaw = v.control.yaw_setpoint
        v.touch_time_s = 0.0

    def step(self, v: VehicleState) -> None:
        """Fly the current stage. Switch to the next stage when it is complete."""
        control = v.control
        if self._leg is not None:
            self._leg.step(v)
        if self.stage is RtlStage.CLIMB:
            self._climb(v)
        elif self.stage is RtlStage.RETURN:
            if self._arrived(v):
                self.stage = RtlStage.LOITER
                self._leg = None
                self._loiter_until_s = v.time_s + v.params["RTL_LOIT_TIME"] / 1000.0
                control.target_yaw = v.armed_heading
        elif self.stage is RtlStage.LOITER:
            if v.time_s >= self._loiter_until_s:
                final = v.params["RTL_ALT_FINAL"] / 100.0
                self.stage = RtlStage.HOLD if final > 0.0 else RtlStage.LAND
                if final > 0.0:
                    control.go_to(*self._target, return_point(v).base_down - final)
        elif self.stage is RtlStage.LAND:
            descend(v)

    def _climb(self, v: VehicleState) -> None:
        """Stop, and climb at the position where the vehicle comes to rest. Then begin the return leg."""
        if self._leg is None:
            self._leg = Leg(v, *resting_place(v)[:2], self._down)
        elif self._arrived(v):
            self.stage = RtlStage.RETURN
            self._leg = Leg(v, *self._target, self._down)

    def _arrived(self, v: VehicleState) -> bool:
        leg = self._leg
        radius_m = max(v.params["WPNAV_RADIUS"] / 100.0, 0.5)
        return leg is not None and leg.finished and leg.reached(v, radius_m)

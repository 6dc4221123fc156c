"""SMART_RTL mode: return along the flown path and land at its start."""

from __future__ import annotations

import math
from collections.abc import Iterator
from enum import Enum

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle.breadcrumbs import Point
from fractus_vehicle.descent import descend
from fractus_vehicle.flight import Flight
from fractus_vehicle.leg import Leg
from fractus_vehicle.return_points import return_point
from fractus_vehicle.state import CONTROL_STEP_S, VehicleState

# Height of the approach above the last point of the path.
ABOVE_LAST_M = 2.0
STOPPED_MPS = 0.5


class SmartStage(Enum):
    """Stages of SMART_RTL, with ArduCopter's names."""

    WAIT_FOR_PATH_CLEANUP = 1
    PATH_FOLLOW = 2
    PRELAND_POSITION = 3
    DESCEND = 4
    LAND = 5


class SmartReturn(Flight):
    """SMART_RTL mode: stop, simplify the path, follow it backwards, pause 2 m above its start, land, disarm."""

    def __init__(self) -> None:
        self.stage = SmartStage.WAIT_FOR_PATH_CLEANUP
        self._cleanup: Iterator[None] = iter(())
        self._leg: Leg | None = None
        self._popped: Point | None = None

    @property
    def landing(self) -> bool:
        """True during the final descent."""
        return self.stage is SmartStage.LAND

    def begin(self, v: VehicleState) -> None:
        """Stop and begin to simplify the path."""
        v.control.hold_position()
        v.heading.follow_course()
        v.touch_time_s = 0.0
        self._cleanup = v.breadcrumbs.simplify_fully()

    def end(self, v: VehicleState) -> None:
        """Put the current target point back into the path if it was not reached, so that the path stays complete."""
        if self.stage is SmartStage.PATH_FOLLOW and self._popped is not None and not v.breadcrumbs.add(self._popped):
            v.send_text(mavlink.MAV_SEVERITY_ERROR, "SmartRTL: lost one point")

    def step(self, v: VehicleState) -> None:
        """Fly the current stage. Switch to the next stage when it is complete."""
        if self.stage is SmartStage.WAIT_FOR_PATH_CLEANUP:
            try:
                next(self._cleanup)
            except StopIteration:
                self.stage = SmartStage.PATH_FOLLOW
        elif self.stage is SmartStage.PATH_FOLLOW:
            self._follow(v)
        elif self.stage is SmartStage.PRELAND_POSITION:
            self._come_down(v)
        elif self.stage is SmartStage.LAND:
            descend(v)
        if self._leg is not None:
            self._leg.step(v)
        if self.stage is not SmartStage.LAND:
            v.heading.step(v.est, CONTROL_STEP_S)

    def _follow(self, v: VehicleState) -> None:
        waiting = not self._stopped(v) if self._leg is None else not self._leg.reached(v, _radius_m(v))
        if waiting:
            return
        if not v.breadcrumbs.path:
            self.stage = SmartStage.PRELAND_POSITION
            return
        north, east, down = self._popped = v.breadcrumbs.pop()
        if not v.breadcrumbs.path:
            self.stage = SmartStage.PRELAND_POSITION
            down -= ABOVE_LAST_M
        self._leg = Leg(v, north, east, down)

    @staticmethod
    def _stopped(v: VehicleState) -> bool:
        return math.hypot(v.est.vn, v.est.ve) < STOPPED_MPS

    def _come_down(self, v: VehicleState) -> None:
        if self._leg is not None and not (self._leg.finished and self._leg.reached(v, _radius_m(v))):
            return
        final_m = v.params["RTL_ALT_FINAL"] / 100.0
        if final_m <= 0.0 or v.failsafes.radio or self._leg is None:
            self.stage = SmartStage.LAND
        else:
            self.stage = SmartStage.DESCEND
            north, east, _ = self._leg.end
            v.control.go_to(north, east, return_point(v).base_down - final_m)
        self._leg = None


def _radius_m(v: VehicleState) -> float:
    return max(v.params["WPNAV_RADIUS"] / 100.0, 0.3)

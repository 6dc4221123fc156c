"""BRAKE, AVOID_ADSB and LAND: the modes that stop, and that come down where the vehicle is."""

from __future__ import annotations

from fractus_vehicle.control import Axis
from fractus_vehicle.descent import descend
from fractus_vehicle.flight import Flight
from fractus_vehicle.state import VehicleState

# BRAKE may decelerate with this, whatever WPNAV_ACCEL says; PSC_JERK_XY keeps it from doing so below some 11 m/s.
BRAKE_MPS2 = 7.5
# A landing that a failsafe begins waits so long, for a pilot to object.
FAILSAFE_PAUSE_S = 4.0


class Hold(Flight):
    """Stops and holds: AVOID_ADSB with nothing to avoid."""

    def begin(self, v: VehicleState) -> None:
        """Stop and hold."""
        v.control.hold_here()


class Brake(Flight):
    """Stops at once and holds."""

    def begin(self, v: VehicleState) -> None:
        """Stop hard and hold."""
        v.control.hold_here()
        v.control.stop(BRAKE_MPS2)


class Land(Flight):
    """Descends where it is and disarms."""

    def __init__(self) -> None:
        self._sink_from_s = 0.0

    @property
    def landing(self) -> bool:
        """Always."""
        return True

    def pause(self, v: VehicleState) -> None:
        """Wait before the descent, as every failsafe that lands does."""
        self._sink_from_s = v.time_s + FAILSAFE_PAUSE_S
        v.control.climb(0.0)

    def begin(self, v: VehicleState) -> None:
        """Stop, or keep level when the position is unknown."""
        v.touch_time_s = 0.0
        if v.position_ok:
            v.control.stop()
        else:
            v.control.horizontal = Axis.ATTITUDE
            v.control.attitude = (0.0, 0.0)
        v.control.yaw_rate = None
        v.control.target_yaw = v.control.yaw_setpoint

    def step(self, v: VehicleState) -> None:
        """Sink."""
        if v.control.horizontal is not Axis.ATTITUDE and not v.position_ok:
            v.control.horizontal = Axis.ATTITUDE
            v.control.attitude = (0.0, 0.0)
        if v.time_s >= self._sink_from_s or v.body.on_ground:
            descend(v)

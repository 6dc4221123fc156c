"""BRAKE, AVOID_ADSB and LAND modes."""

from __future__ import annotations

from fractus_vehicle.control import Axis
from fractus_vehicle.descent import descend
from fractus_vehicle.flight import Flight
from fractus_vehicle.state import VehicleState

# Maximum deceleration of BRAKE, independent of WPNAV_ACCEL. Below about 11 m/s, the vehicle does not reach it, because
# PSC_JERK_XY limits the jerk.
BRAKE_MPS2 = 7.5
# Delay of a landing that a failsafe has started, so that a pilot can intervene.
FAILSAFE_PAUSE_S = 4.0


class Hold(Flight):
    """AVOID_ADSB mode without traffic: stop and hold."""

    def begin(self, v: VehicleState) -> None:
        """Stop and hold."""
        v.control.hold_position()


class Brake(Flight):
    """BRAKE mode: stop at maximum deceleration and hold."""

    def begin(self, v: VehicleState) -> None:
        """Stop with `BRAKE_MPS2` and hold."""
        v.control.hold_position()
        v.control.stop(BRAKE_MPS2)


class Land(Flight):
    """LAND mode: descend at the current position and disarm."""

    def __init__(self) -> None:
        self._sink_from_s = 0.0

    @property
    def landing(self) -> bool:
        """True: the whole mode is a final descent."""
        return True

    def pause(self, v: VehicleState) -> None:
        """Delay the descent. All failsafe landings do this."""
        self._sink_from_s = v.time_s + FAILSAFE_PAUSE_S
        v.control.climb(0.0)

    def begin(self, v: VehicleState) -> None:
        """Stop, or keep level if the position is unknown."""
        v.touch_time_s = 0.0
        if v.position_ok:
            v.control.stop()
        else:
            v.control.horizontal = Axis.ATTITUDE
            v.control.attitude = (0.0, 0.0)
        v.control.yaw_rate = None
        v.control.target_yaw = v.control.yaw_setpoint

    def step(self, v: VehicleState) -> None:
        """Descend after the delay."""
        if v.control.horizontal is not Axis.ATTITUDE and not v.position_ok:
            v.control.horizontal = Axis.ATTITUDE
            v.control.attitude = (0.0, 0.0)
        if v.time_s >= self._sink_from_s or v.body.on_ground:
            descend(v)

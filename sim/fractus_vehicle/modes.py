"""Current flight mode and mode changes."""

from __future__ import annotations

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle.auto import AutoFlight
from fractus_vehicle.copter import TRAITS, UNAVAILABLE, mode_title
from fractus_vehicle.flight import Flight
from fractus_vehicle.guided import GuidedFlight, GuidedWithoutGps
from fractus_vehicle.landing import Brake, Hold, Land
from fractus_vehicle.manual import Acro, AltHold, Circle, Loiter, Stabilize, Throw
from fractus_vehicle.rtl import ReturnToLaunch
from fractus_vehicle.settings import set_limits
from fractus_vehicle.smart_rtl import SmartReturn
from fractus_vehicle.state import VehicleState
from fractus_vehicle.telemetry import send_on_all

# If the mode changes during a fence breach, the fence is not checked for this number of seconds.
MANUAL_RECOVERY_S = 10.0

_FLIGHTS: dict[int, type[Flight]] = {
    mavlink.COPTER_MODE_GUIDED: GuidedFlight,
    mavlink.COPTER_MODE_STABILIZE: Stabilize,
    mavlink.COPTER_MODE_ALT_HOLD: AltHold,
    mavlink.COPTER_MODE_LOITER: Loiter,
    mavlink.COPTER_MODE_BRAKE: Brake,
    mavlink.COPTER_MODE_LAND: Land,
    mavlink.COPTER_MODE_RTL: ReturnToLaunch,
    mavlink.COPTER_MODE_SMART_RTL: SmartReturn,
    mavlink.COPTER_MODE_ACRO: Acro,
    mavlink.COPTER_MODE_CIRCLE: Circle,
    mavlink.COPTER_MODE_DRIFT: Stabilize,
    mavlink.COPTER_MODE_POSHOLD: Loiter,
    mavlink.COPTER_MODE_THROW: Throw,
    mavlink.COPTER_MODE_AVOID_ADSB: Hold,
    mavlink.COPTER_MODE_GUIDED_NOGPS: GuidedWithoutGps,
    mavlink.COPTER_MODE_ZIGZAG: Loiter,
}


class FlightModes:
    """Current flight mode. Each mode change creates a new `Flight` object."""

    def __init__(self, state: VehicleState) -> None:
        self._state = state
        self.flight = self._new_flight(state.mode)

    def _refusal(self, mode: int) -> str | None:
        """Return the reason why a mode cannot be entered now, or None. A disarmed vehicle may enter most modes."""
        v = self._state
        if mode in UNAVAILABLE:
            for text in UNAVAILABLE[mode][0]:
                v.send_text(mavlink.MAV_SEVERITY_WARNING, text)
            return UNAVAILABLE[mode][1]
        if v.armed and TRAITS[mode].needs_position and not v.position_ok:
            return "requires position"
        match mode:
            case mavlink.COPTER_MODE_SMART_RTL:
                begins = v.breadcrumbs.active
            case mavlink.COPTER_MODE_THROW:
                begins = not v.armed
            case mavlink.COPTER_MODE_AUTO:
                begins = not v.armed or self._has_mission()
            case _:
                begins = True
        return None if begins else "init failed"

    def _has_mission(self) -> bool:
        """Return True if the mission can be flown from the current state.

        If the vehicle is on the ground, the mission must begin with a takeoff.
        """
        v = self._state
        if len(v.mission.items) <= 1:
            return False
        if v.landed and not v.mission.takes_off(0 if int(v.params["MIS_RESTART"]) == 1 else v.mission.current):
            v.send_text(mavlink.MAV_SEVERITY_CRITICAL, "Auto: Missing Takeoff Cmd")
            return False
        return True

    def change(self, mode: int) -> bool:
        """Change the mode on request. Return False if the change is refused."""
        if mode == self._state.mode:
            return True
        refusal = self._refusal(mode)
        if refusal is not None:
            self._state.send_text(mavlink.MAV_SEVERITY_WARNING, f"Mode change to {mode_title(mode)} failed: {refusal}")
            return False
        self.force(mode)
        return True

    def force(self, mode: int) -> None:
        """Change the mode without checks."""
        v = self._state
        self.flight.end(v)
        v.mode = mode
        self.flight = self._new_flight(mode)
        set_limits(v.params, v.control)
        v.control.throttle = None
        v.control.yaw_rate = None
        if v.landed or not v.armed:
            v.control.reset(v.est)
        v.taking_off_until_m = None
        if v.fence.breaches:
            v.fence.recovery_until_s = v.time_s + MANUAL_RECOVERY_S
            v.send_text(mavlink.MAV_SEVERITY_INFO, "Manual recovery started")
        self.flight.begin(v)
        send_on_all(v, "HEARTBEAT")

    def _new_flight(self, mode: int) -> Flight:
        # AUTO gets `change`, because a mission may end with a change to another mode.
        return AutoFlight(self.change) if mode == mavlink.COPTER_MODE_AUTO else _FLIGHTS[mode]()

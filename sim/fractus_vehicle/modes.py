"""The flight mode in use, and the change to another one."""

from __future__ import annotations

from fractus_mavlink.enums import COPTER_MODE, MAV_SEVERITY

from fractus_vehicle.auto import AutoFlight
from fractus_vehicle.copter import mode_title
from fractus_vehicle.flight import Flight
from fractus_vehicle.guided import GuidedFlight
from fractus_vehicle.landing import Brake, Land
from fractus_vehicle.manual import AltHold, Loiter, Stabilize
from fractus_vehicle.readiness import WITHOUT_POSITION
from fractus_vehicle.rtl import ReturnToLaunch
from fractus_vehicle.settings import set_limits
from fractus_vehicle.smart_rtl import SmartReturn
from fractus_vehicle.state import VehicleState
from fractus_vehicle.telemetry import send_on_all

_FLIGHTS: dict[COPTER_MODE, type[Flight]] = {
    COPTER_MODE.GUIDED: GuidedFlight,
    COPTER_MODE.STABILIZE: Stabilize,
    COPTER_MODE.ALT_HOLD: AltHold,
    COPTER_MODE.LOITER: Loiter,
    COPTER_MODE.BRAKE: Brake,
    COPTER_MODE.LAND: Land,
    COPTER_MODE.RTL: ReturnToLaunch,
    COPTER_MODE.SMART_RTL: SmartReturn,
}


class FlightModes:
    """Which mode flies the vehicle; each change makes a new flight."""

    def __init__(self, state: VehicleState) -> None:
        self._state = state
        self.flight = self._new_flight(state.mode)

    def refusal(self, mode: COPTER_MODE) -> str | None:
        """Why a mode cannot be entered now, or None; on the ground with the motors off every mode can."""
        v = self._state
        if mode is COPTER_MODE.SMART_RTL and not v.breadcrumbs.active:
            return f"Mode change to {mode_title(mode)} failed: init failed"
        if not v.armed:
            return None
        if mode not in WITHOUT_POSITION and not v.position_ok:
            return f"Mode change to {mode_title(mode)} failed: requires position"
        if mode is COPTER_MODE.AUTO and len(v.mission.items) <= 1:
            return "Mode change to AUTO failed: init failed"
        return None

    def change(self, mode: COPTER_MODE) -> bool:
        """Change the mode as a ground station asks; False when it is refused."""
        if mode is self._state.mode:
            return True
        refusal = self.refusal(mode)
        if refusal is not None:
            self._state.say(MAV_SEVERITY.WARNING, refusal)
            return False
        self.force(mode)
        return True

    def force(self, mode: COPTER_MODE) -> None:
        """Change the mode without asking."""
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
        self.flight.begin(v)
        send_on_all(v, "HEARTBEAT")

    def _new_flight(self, mode: COPTER_MODE) -> Flight:
        # A mission may end itself by another mode.
        return AutoFlight(self.change) if mode is COPTER_MODE.AUTO else _FLIGHTS[mode]()

"""The flight mode in use, and the change to another one."""

from __future__ import annotations

from fractus_mavlink.enums import COPTER_MODE, MAV_SEVERITY

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

# After a change of mode in a breach, the fence is not checked for so long.
MANUAL_RECOVERY_S = 10.0

_FLIGHTS: dict[COPTER_MODE, type[Flight]] = {
    COPTER_MODE.GUIDED: GuidedFlight,
    COPTER_MODE.STABILIZE: Stabilize,
    COPTER_MODE.ALT_HOLD: AltHold,
    COPTER_MODE.LOITER: Loiter,
    COPTER_MODE.BRAKE: Brake,
    COPTER_MODE.LAND: Land,
    COPTER_MODE.RTL: ReturnToLaunch,
    COPTER_MODE.SMART_RTL: SmartReturn,
    COPTER_MODE.ACRO: Acro,
    COPTER_MODE.CIRCLE: Circle,
    COPTER_MODE.DRIFT: Stabilize,
    COPTER_MODE.POSHOLD: Loiter,
    COPTER_MODE.THROW: Throw,
    COPTER_MODE.AVOID_ADSB: Hold,
    COPTER_MODE.GUIDED_NOGPS: GuidedWithoutGps,
    COPTER_MODE.ZIGZAG: Loiter,
}


class FlightModes:
    """Which mode flies the vehicle; each change makes a new flight."""

    def __init__(self, state: VehicleState) -> None:
        self._state = state
        self.flight = self._new_flight(state.mode)

    def _refusal(self, mode: COPTER_MODE) -> str | None:
        """Why a mode cannot be entered now, or None; on the ground with the motors off nearly every mode can."""
        v = self._state
        if mode in UNAVAILABLE:
            for text in UNAVAILABLE[mode][0]:
                v.say(MAV_SEVERITY.WARNING, text)
            return UNAVAILABLE[mode][1]
        if v.armed and TRAITS[mode].needs_position and not v.position_ok:
            return "requires position"
        match mode:
            case COPTER_MODE.SMART_RTL:
                begins = v.breadcrumbs.active
            case COPTER_MODE.THROW:
                begins = not v.armed
            case COPTER_MODE.AUTO:
                begins = not v.armed or self._has_mission()
            case _:
                begins = True
        return None if begins else "init failed"

    def _has_mission(self) -> bool:
        """Whether there is a mission that can be flown from where the vehicle is: on the ground, one that takes off."""
        v = self._state
        if len(v.mission.items) <= 1:
            return False
        if v.landed and not v.mission.takes_off(restart=int(v.params["MIS_RESTART"]) == 1):
            v.say(MAV_SEVERITY.CRITICAL, "Auto: Missing Takeoff Cmd")
            return False
        return True

    def change(self, mode: COPTER_MODE) -> bool:
        """Change the mode as a ground station asks; False when it is refused."""
        if mode is self._state.mode:
            return True
        refusal = self._refusal(mode)
        if refusal is not None:
            self._state.say(MAV_SEVERITY.WARNING, f"Mode change to {mode_title(mode)} failed: {refusal}")
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
        if v.fence.breaches:
            v.fence.recovery_until_s = v.time_s + MANUAL_RECOVERY_S
            v.say(MAV_SEVERITY.INFO, "Manual recovery started")
        self.flight.begin(v)
        send_on_all(v, "HEARTBEAT")

    def _new_flight(self, mode: COPTER_MODE) -> Flight:
        # A mission may end itself by another mode.
        return AutoFlight(self.change) if mode is COPTER_MODE.AUTO else _FLIGHTS[mode]()

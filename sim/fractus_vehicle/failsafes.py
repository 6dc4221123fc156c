"""Failsafes: ground station or radio lost, battery low, position lost, fence breached, thrust loss, crash."""

from __future__ import annotations

import math
from enum import IntFlag

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle.copter import mode_title
from fractus_vehicle.failsafe_actions import FENCE_ACTIONS, GCS_ACTIONS, RADIO_ACTIONS, Action, execute_action
from fractus_vehicle.fence import NO_BREACH, breach_names
from fractus_vehicle.modes import FlightModes
from fractus_vehicle.state import VehicleState

CHECK_INTERVAL_S = 0.1
POSITION_LOST_S = 1.0
CRASH_ANGLE_DEG = 30.0
CRASH_CONFIRMED_S = 2.0

# Distance outside the fence beyond which the autopilot lands instead of the fence action.
FENCE_GIVE_UP_M = 100.0
# FS_EKF_ACTION
EKF_REPORTS_ONLY = 0
EKF_HOLDS_ALTITUDE = 2
EKF_LANDS_ALWAYS = 3
# If a level vehicle sinks at more than THRUST_LOST_SHARE of full thrust for THRUST_LOST_S, a motor may have failed.
THRUST_LOST_S = 1.0
THRUST_LOST_SHARE = 0.9
_PILOT_MODES = frozenset({mavlink.COPTER_MODE_STABILIZE, mavlink.COPTER_MODE_ALT_HOLD, mavlink.COPTER_MODE_LOITER})
_LAND_ACTIONS = frozenset({Action.LAND, Action.TERMINATE})


class Option(IntFlag):
    """FS_OPTIONS: activities that continue despite a failsafe."""

    AUTO_ON_RADIO = 1
    AUTO_ON_GCS = 2
    GUIDED_ON_RADIO = 4
    LANDING = 8
    PILOT_ON_GCS = 16


class Failsafes:
    """Detect and clear the failsafes of a vehicle, and start their actions.

    Each field `_*_since_s` is the time since which a condition has been true.
    """

    def __init__(self, state: VehicleState, modes: FlightModes) -> None:
        self._state = state
        self._modes = modes
        self._gcs_seen_s: float | None = None
        self._battery_action = Action.NONE
        self._radio_lost_s: float | None = None
        self._low_since_s: float | None = None
        self._critical_since_s: float | None = None
        self._lost_since_s: float | None = None
        self._crash_since_s: float | None = None
        self._weak_since_s: float | None = None
        self._next_check_s = 0.0

    def record_gcs_heartbeat(self) -> None:
        """Record a heartbeat of the monitored ground station (SYSID_MYGCS)."""
        self._gcs_seen_s = self._state.time_s

    def step(self) -> None:
        """Run all checks if they are due (10 Hz). Call this in each control step."""
        v = self._state
        if v.time_s < self._next_check_s:
            return
        self._next_check_s = v.time_s + CHECK_INTERVAL_S
        self._check_gcs(v)
        self._check_radio(v)
        self._check_battery(v)
        self._check_position(v)
        self._check_fence(v)
        self._check_thrust(v)
        self._check_crash(v)

    def _check_thrust(self, v: VehicleState) -> None:
        """Warn if the vehicle sinks in level flight at full thrust."""
        roll, pitch, _ = v.body.euler()
        level = math.hypot(roll - v.control.lean[0], pitch - v.control.lean[1]) < math.radians(CRASH_ANGLE_DEG)
        weak = v.armed and not v.landed and level and v.control.thrust_share > THRUST_LOST_SHARE and v.body.vd > 0.0
        if not weak:
            self._weak_since_s = None
            return
        self._weak_since_s = v.time_s if self._weak_since_s is None else self._weak_since_s
        if v.time_s - self._weak_since_s >= THRUST_LOST_S:
            self._weak_since_s = None
            hardest = max(range(len(v.body.motors)), key=lambda at: v.control.thrust_demand_n[at])
            v.send_text(mavlink.MAV_SEVERITY_EMERGENCY, f"Potential Thrust Loss ({hardest + 1})")

    def _check_crash(self, v: VehicleState) -> None:
        roll, pitch, _ = v.body.euler()
        error_deg = math.degrees(math.hypot(roll - v.control.lean[0], pitch - v.control.lean[1]))
        fallen = v.body.crashed or (v.body.on_ground and error_deg > CRASH_ANGLE_DEG)
        if not (v.armed and fallen and not v.landed and int(v.params["FS_CRASH_CHECK"])):
            self._crash_since_s = None
            return
        self._crash_since_s = v.time_s if self._crash_since_s is None else self._crash_since_s
        if v.time_s - self._crash_since_s >= CRASH_CONFIRMED_S:
            v.send_text(
                mavlink.MAV_SEVERITY_EMERGENCY,
                f"Crash: Disarming: AngErr={error_deg:.0f}>{CRASH_ANGLE_DEG:.0f}, Accel=0.0<3.0",
            )
            v.land_complete()
            v.disarm(force=True)

    def _check_gcs(self, v: VehicleState) -> None:
        setting = int(v.params["FS_GCS_ENABLE"])
        if setting == 0 or self._gcs_seen_s is None:
            return
        silent = v.time_s - self._gcs_seen_s > max(v.params["FS_GCS_TIMEOUT"], 0.0)
        if silent == v.failsafes.gcs:
            return
        v.failsafes.gcs = silent
        if not silent:
            v.send_text(mavlink.MAV_SEVERITY_WARNING, "GCS Failsafe Cleared")
            return
        v.receiver.release()
        options = Option(int(v.params["FS_OPTIONS"]) & 31)
        if v.armed and v.mode == mavlink.COPTER_MODE_AUTO and Option.AUTO_ON_GCS in options:
            self._announce(v, "GCS", "Continuing Auto Mode")
        elif v.armed and not v.landed and v.mode in _PILOT_MODES and Option.PILOT_ON_GCS in options:
            self._announce(v, "GCS", "Continuing Pilot Control")
        else:
            self._take_over(v, "GCS", GCS_ACTIONS.get(setting, Action.RTL))

    def _check_radio(self, v: VehicleState) -> None:
        """Check the simulated radio receiver.

        With SIM_RC_FAIL it has no signal, unless a ground station overrides channels. A throttle below FS_THR_VALUE also
        counts as a lost signal.
        """
        setting = int(v.params["FS_THR_ENABLE"])
        silent = int(v.params["SIM_RC_FAIL"]) != 0 and not v.receiver.overridden
        if not silent:
            self._radio_lost_s = None
        elif self._radio_lost_s is None:
            self._radio_lost_s = v.time_s
        lost = self._radio_lost_s is not None and v.time_s - self._radio_lost_s >= v.params["RC_FS_TIMEOUT"]
        lost = (lost or v.throttle_below_failsafe) and setting != 0
        if lost == v.failsafes.radio:
            return
        v.failsafes.radio = lost
        if not lost:
            v.send_text(mavlink.MAV_SEVERITY_WARNING, "Radio Failsafe Cleared")
            return
        options = Option(int(v.params["FS_OPTIONS"]) & 31)
        watched = int(v.params["FS_GCS_ENABLE"]) != 0
        if v.armed and v.mode == mavlink.COPTER_MODE_AUTO and Option.AUTO_ON_RADIO in options:
            self._announce(v, "Radio", "Continuing Auto Mode")
        elif v.armed and v.mode == mavlink.COPTER_MODE_GUIDED and Option.GUIDED_ON_RADIO in options and watched:
            self._announce(v, "Radio", "Continuing Guided Mode")
        else:
            self._take_over(v, "Radio", RADIO_ACTIONS.get(setting, Action.LAND))

    def _take_over(self, v: VehicleState, cause: str, action: Action) -> None:
        """Announce a failsafe, and execute its action unless the vehicle is disarmed, on the ground or landing."""
        options = Option(int(v.params["FS_OPTIONS"]) & 31)
        if not v.armed:
            self._announce(v, cause)
        elif v.landed and not v.taking_off:
            self._announce(v, cause, "Disarming")
            v.disarm()
        elif self._modes.flight.landing and v.failsafes.battery and self._battery_action in _LAND_ACTIONS:
            self._announce(v, f"{cause} + Battery", "Continuing Landing")
            execute_action(v, self._modes, Action.LAND)
        elif self._modes.flight.landing and Option.LANDING in options:
            self._announce(v, cause, "Continuing Landing")
            execute_action(v, self._modes, Action.LAND)
        else:
            self._announce(v, cause)
            execute_action(v, self._modes, action)

    @staticmethod
    def _announce(v: VehicleState, cause: str, done: str = "") -> None:
        v.send_text(mavlink.MAV_SEVERITY_WARNING, f"{cause} Failsafe - {done}" if done else f"{cause} Failsafe")

    def _check_battery(self, v: VehicleState) -> None:
        if not v.armed:
            self._low_since_s = self._critical_since_s = None
            return
        p = v.params
        battery = v.battery
        left = max(battery.capacity_mah - battery.used_mah, 0.0)
        timer = p["BATT_LOW_TIMER"]
        critical = 0.0 < battery.voltage_v < p["BATT_CRT_VOLT"]
        low = 0.0 < battery.voltage_v < p["BATT_LOW_VOLT"]
        self._critical_since_s = (self._critical_since_s or v.time_s) if critical else None
        self._low_since_s = (self._low_since_s or v.time_s) if low else None
        critical_now = self._critical_since_s is not None and v.time_s - self._critical_since_s > timer
        low_now = self._low_since_s is not None and v.time_s - self._low_since_s > timer
        critical_now = critical_now or left < p["BATT_CRT_MAH"]
        low_now = low_now or left < p["BATT_LOW_MAH"]
        if critical_now and not v.failsafes.battery_critical:
            v.failsafes.battery = v.failsafes.battery_critical = True
            self._battery_event(v, "critical", int(p["BATT_FS_CRT_ACT"]))
        elif low_now and not v.failsafes.battery:
            v.failsafes.battery = True
            self._battery_event(v, "low", int(p["BATT_FS_LOW_ACT"]))

    def _battery_event(self, v: VehicleState, level: str, setting: int) -> None:
        battery = v.battery
        v.send_text(
            mavlink.MAV_SEVERITY_WARNING,
            f"Battery 1 is {level} {battery.voltage_v:.2f}V used {battery.used_mah:.0f} mAh",
        )
        action = Action(setting) if setting in set(Action) else Action.NONE
        self._battery_action = action
        landing = self._modes.flight.landing and Option.LANDING in Option(int(v.params["FS_OPTIONS"]) & 31)
        if v.landed and not v.taking_off:
            self._announce(v, "Battery", "Disarming")
            v.disarm()
        elif landing and action is not Action.NONE:
            self._announce(v, "Battery", "Continuing Landing")
            execute_action(v, self._modes, Action.LAND)
        else:
            self._announce(v, "Battery")
            execute_action(v, self._modes, action)

    def _check_position(self, v: VehicleState) -> None:
        if v.position_ok or v.origin is None:
            if v.failsafes.ekf:
                v.failsafes.ekf = False
                v.send_text(mavlink.MAV_SEVERITY_CRITICAL, "EKF Failsafe Cleared")
            self._lost_since_s = None
            return
        self._lost_since_s = self._lost_since_s if self._lost_since_s is not None else v.time_s
        if v.failsafes.ekf or not v.armed or v.time_s - self._lost_since_s < POSITION_LOST_S:
            return
        v.failsafes.ekf = True
        v.send_text(mavlink.MAV_SEVERITY_CRITICAL, "EKF variance")
        setting = int(v.params["FS_EKF_ACTION"])
        if setting == EKF_REPORTS_ONLY or v.landed or v.mode == mavlink.COPTER_MODE_LAND:
            return
        if v.mode in (mavlink.COPTER_MODE_STABILIZE, mavlink.COPTER_MODE_ALT_HOLD) and setting != EKF_LANDS_ALWAYS:
            return
        if setting != EKF_HOLDS_ALTITUDE or v.failsafes.radio or not self._modes.change(mavlink.COPTER_MODE_ALT_HOLD):
            execute_action(v, self._modes, Action.LAND)
        v.send_text(mavlink.MAV_SEVERITY_CRITICAL, f"EKF Failsafe: changed to {mode_title(v.mode)} Mode")

    def _check_fence(self, v: VehicleState) -> None:
        fence = v.fence
        if not fence.enabled or v.home is None or v.origin is None or not v.armed or v.landed:
            fence.breaches = NO_BREACH
            return
        if v.time_s < fence.recovery_until_s:
            return
        before = fence.breaches
        new = fence.check(v.est.north, v.est.east, v.altitude_m, v.home_xy, v.time_s)
        if before and not fence.breaches:
            v.send_text(mavlink.MAV_SEVERITY_NOTICE, "Fence breach cleared")
        if not new:
            return
        v.send_text(mavlink.MAV_SEVERITY_NOTICE, f"{breach_names(new)} breached")
        action = FENCE_ACTIONS.get(int(v.params["FENCE_ACTION"]), Action.NONE)
        if action is not Action.NONE and v.mode != mavlink.COPTER_MODE_LAND:
            far = fence.distance_m(v.est.north, v.est.east, v.altitude_m, v.home_xy) > FENCE_GIVE_UP_M
            execute_action(v, self._modes, Action.LAND if far else action)

"""When the autopilot takes over by itself: ground station lost, battery low, position lost, fence breached."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from fractus_sim.vehicle.fence import Breach, breach_names
from fractus_sim.vehicle.mav import Mode, Severity

if TYPE_CHECKING:
    from fractus_sim.vehicle.vehicle import Vehicle

CHECK_INTERVAL_S = 0.1
POSITION_LOST_S = 1.0
CRASH_ANGLE_DEG = 30.0
CRASH_CONFIRMED_S = 2.0

CONTINUE_IN_AUTO_ON_GCS = 1 << 1
CONTINUE_IF_LANDING = 1 << 3
CONTINUE_PILOT_ON_GCS = 1 << 4

_LANDING_MODES = frozenset({Mode.LAND})
_PILOT_MODES = frozenset({Mode.STABILIZE, Mode.ALT_HOLD, Mode.LOITER})
# FS_GCS_ENABLE and BATT_FS_*_ACT to the mode that they ask for (SmartRTL falls back as ArduPilot does).
_GCS_ACTIONS = {1: Mode.RTL, 2: Mode.RTL, 3: Mode.RTL, 4: Mode.LAND, 5: Mode.LAND, 6: Mode.RTL, 7: Mode.BRAKE}
_BATTERY_ACTIONS = {1: Mode.LAND, 2: Mode.RTL, 3: Mode.RTL, 4: Mode.LAND, 6: Mode.RTL, 7: Mode.BRAKE}
_FENCE_ACTIONS = {1: Mode.RTL, 2: Mode.LAND, 3: Mode.RTL, 4: Mode.BRAKE, 5: Mode.LAND}
_TERMINATE = 5


@dataclass(slots=True)
class Failsafes:
    """Which failsafes are active, and since when their conditions hold."""

    gcs: bool = False
    battery: bool = False
    battery_critical: bool = False
    ekf: bool = False
    gcs_seen_s: float | None = None
    _low_since_s: float | None = None
    _critical_since_s: float | None = None
    _lost_since_s: float | None = None
    _crash_since_s: float | None = None
    _next_check_s: float = 0.0

    @property
    def any_active(self) -> bool:
        """Whether any failsafe is active."""
        return self.gcs or self.battery or self.ekf

    def step(self, v: Vehicle) -> None:
        """Check everything; called at each control step, works at 10 Hz."""
        if v.time_s < self._next_check_s:
            return
        self._next_check_s = v.time_s + CHECK_INTERVAL_S
        self._check_gcs(v)
        self._check_battery(v)
        self._check_position(v)
        self._check_fence(v)
        self._check_crash(v)

    def _check_crash(self, v: Vehicle) -> None:
        roll, pitch, _ = v.body.euler()
        error_deg = math.degrees(math.hypot(roll - v.control.lean[0], pitch - v.control.lean[1]))
        fallen = v.body.crashed or (v.body.on_ground and error_deg > CRASH_ANGLE_DEG)
        if not (v.armed and fallen and not v.landed and int(v.params["FS_CRASH_CHECK"])):
            self._crash_since_s = None
            return
        self._crash_since_s = v.time_s if self._crash_since_s is None else self._crash_since_s
        if v.time_s - self._crash_since_s >= CRASH_CONFIRMED_S:
            v.say(
                Severity.EMERGENCY,
                f"Crash: Disarming: AngErr={error_deg:.0f}>{CRASH_ANGLE_DEG:.0f}, Accel=0.0<3.0",
            )
            v.land_complete()
            v.disarm("crash", force=True)

    def _check_gcs(self, v: Vehicle) -> None:
        setting = int(v.params["FS_GCS_ENABLE"])
        if setting == 0 or self.gcs_seen_s is None:
            return
        silent = v.time_s - self.gcs_seen_s > max(v.params["FS_GCS_TIMEOUT"], 0.0)
        if not silent:
            if self.gcs:
                self.gcs = False
                v.say(Severity.WARNING, "GCS Failsafe Cleared")
            return
        if self.gcs:
            return
        self.gcs = True
        options = int(v.params["FS_OPTIONS"])
        if not v.armed:
            v.say(Severity.WARNING, "GCS Failsafe")
        elif v.landed and not v.flying_wanted:
            v.say(Severity.WARNING, "GCS Failsafe - Disarming")
            v.disarm("GCS failsafe")
        elif v.mode is Mode.AUTO and options & CONTINUE_IN_AUTO_ON_GCS:
            v.say(Severity.WARNING, "GCS Failsafe - Continuing Auto Mode")
        elif v.mode in _LANDING_MODES and options & CONTINUE_IF_LANDING:
            v.say(Severity.WARNING, "GCS Failsafe - Continuing Landing")
        elif v.mode in _PILOT_MODES and options & CONTINUE_PILOT_ON_GCS:
            v.say(Severity.WARNING, "GCS Failsafe - Continuing Pilot Control")
        else:
            v.say(Severity.WARNING, "GCS Failsafe")
            self._act(v, _GCS_ACTIONS.get(setting))

    def _check_battery(self, v: Vehicle) -> None:
        if not v.armed:
            self._low_since_s = self._critical_since_s = None
            return
        p, battery = v.params, v.battery
        left = battery.capacity_mah - battery.used_mah
        timer = p["BATT_LOW_TIMER"]
        critical = 0.0 < battery.voltage_v < p["BATT_CRT_VOLT"]
        low = 0.0 < battery.voltage_v < p["BATT_LOW_VOLT"]
        self._critical_since_s = (self._critical_since_s or v.time_s) if critical else None
        self._low_since_s = (self._low_since_s or v.time_s) if low else None
        critical_now = self._critical_since_s is not None and v.time_s - self._critical_since_s > timer
        low_now = self._low_since_s is not None and v.time_s - self._low_since_s > timer
        critical_now = critical_now or left < p["BATT_CRT_MAH"]
        low_now = low_now or left < p["BATT_LOW_MAH"]
        if critical_now and not self.battery_critical:
            self.battery = self.battery_critical = True
            self._announce_battery(v, "critical", int(p["BATT_FS_CRT_ACT"]))
        elif low_now and not self.battery:
            self.battery = True
            self._announce_battery(v, "low", int(p["BATT_FS_LOW_ACT"]))

    def _announce_battery(self, v: Vehicle, level: str, action: int) -> None:
        battery = v.battery
        v.say(
            Severity.WARNING,
            f"Battery 1 is {level} {battery.voltage_v:.2f}V used {battery.used_mah:.0f} mAh",
        )
        if v.landed and not v.flying_wanted:
            v.say(Severity.WARNING, "Battery Failsafe - Disarming")
            v.disarm("battery failsafe")
            return
        landing = v.mode in _LANDING_MODES and int(v.params["FS_OPTIONS"]) & CONTINUE_IF_LANDING
        if landing and action != 0 and level != "critical":
            v.say(Severity.WARNING, "Battery Failsafe - Continuing Landing")
            return
        v.say(Severity.WARNING, "Battery Failsafe")
        if action == _TERMINATE:
            v.disarm("battery failsafe", force=True)
            return
        self._act(v, _BATTERY_ACTIONS.get(action))

    def _check_position(self, v: Vehicle) -> None:
        if v.position_ok or v.origin is None:
            if self.ekf:
                self.ekf = False
                v.say(Severity.WARNING, "EKF Failsafe Cleared")
            self._lost_since_s = None
            return
        self._lost_since_s = self._lost_since_s if self._lost_since_s is not None else v.time_s
        if self.ekf or not v.armed or v.time_s - self._lost_since_s < POSITION_LOST_S:
            return
        self.ekf = True
        v.say(Severity.CRITICAL, "EKF variance: over thresholds")
        action = int(v.params["FS_EKF_ACTION"])
        if action == 0 or v.landed or v.mode in (Mode.STABILIZE, Mode.LAND):
            return
        if v.mode is Mode.ALT_HOLD and action != 3:
            return
        v.force_mode(Mode.ALT_HOLD if action == 2 else Mode.LAND, "EKF failsafe")
        v.say(Severity.CRITICAL, f"EKF Failsafe: changed to {v.mode.name} Mode")

    def _check_fence(self, v: Vehicle) -> None:
        if not v.fence.enabled or v.home is None or v.origin is None:
            v.fence.breaches = Breach.NONE
            return
        if not v.armed or v.landed:
            v.fence.breaches = Breach.NONE
            return
        new = v.fence.check(v.est.north, v.est.east, v.altitude_m, v.home_xy, v.time_s)
        if not new:
            return
        v.say(Severity.NOTICE, f"{breach_names(new)} breached")
        action = int(v.params["FENCE_ACTION"])
        if action == 0 or v.mode is Mode.LAND:
            return
        self._act(v, _FENCE_ACTIONS.get(action))

    @staticmethod
    def _act(v: Vehicle, wanted: Mode | None) -> None:
        """Change to a mode, or to LAND when that mode cannot be flown now."""
        if wanted is None or not v.armed or v.mode is wanted:
            return
        if wanted is not Mode.LAND and v.mode_refusal(wanted) is not None:
            wanted = Mode.LAND
        if v.mode is not wanted:
            v.force_mode(wanted, "failsafe")

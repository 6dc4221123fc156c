"""One simulated ArduCopter, advanced in fixed steps."""

from __future__ import annotations

import math

from fractus_services.mavlink_server.channel import Channel
from fractus_services.mavlink_server.mission_transfer import Transfers
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle.accessories import charge_at_depot, end_motor_test
from fractus_vehicle.estimator import HOME_SET_S
from fractus_vehicle.failsafes import Failsafes
from fractus_vehicle.home import set_home
from fractus_vehicle.modes import FlightModes
from fractus_vehicle.motion import move
from fractus_vehicle.plans import clear_items, replace_items, stores_of
from fractus_vehicle.readiness import arming_refusals
from fractus_vehicle.report_units import UNKNOWN_U16
from fractus_vehicle.settings import LIMIT_PREFIXES, accelerometers_differ, set_battery, set_fence, set_limits, set_wind
from fractus_vehicle.state import CONTROL_STEP_S, VehicleConfig, VehicleState
from fractus_vehicle.telemetry import attach, follow_rate, send_on_all, send_parameter, serve

# Modes that disarm immediately after landing.
_LANDING_MODES = frozenset({mavlink.COPTER_MODE_LAND, mavlink.COPTER_MODE_RTL, mavlink.COPTER_MODE_SMART_RTL})

# Intervals at which a disarmed vehicle reports failed arming checks and the ground pressure.
CHECKS_REPORT_INTERVAL_S = 30.0
PRESSURE_REPORT_INTERVAL_S = 10.0
FIRST_PRESSURE_S = 1.0
# Time for which the accelerometers must agree after a difference.
ACCELS_AGREE_S = 10.0


class Vehicle:
    """The vehicle: state, flight mode, failsafes and mission protocol."""

    def __init__(self, config: VehicleConfig) -> None:
        self.state = VehicleState(config)
        self.modes = FlightModes(self.state)
        self.failsafes = Failsafes(self.state, self.modes)
        self.transfers = Transfers(
            stores_of(self.state),
            lambda store, items: replace_items(self.state, store, items),
            lambda store: clear_items(self.state, store),
            self.state.send_text,
        )
        self.signing_key: bytes | None = None
        self.reboot_requested = False
        self._next_checks_s = 0.5 * CHECKS_REPORT_INTERVAL_S
        self._next_pressure_s = FIRST_PRESSURE_S
        self.state.params.watch(self._parameter_changed)
        if accelerometers_differ(self.state.params):
            self.state.accels_agree_from_s = math.inf

    def attach(self, channel: Channel) -> None:
        """Open a link."""
        attach(self.state, channel)

    def detach(self, channel: Channel) -> None:
        """Close a link."""
        self.state.channels.remove(channel)
        self.transfers.detach(channel)

    def arm(self) -> None:
        """Start the motors. The caller must have run the arming checks."""
        v = self.state
        v.armed = True
        v.armed_at_s = v.idle_since_s = v.time_s
        v.armed_heading = v.est.yaw
        v.landed = True
        v.taking_off_until_m = None
        v.touch_time_s = 0.0
        if not v.home_locked and v.position_ok:
            set_home(v, v.place)
        v.control.reset(v.est)
        v.breadcrumbs.restart(v.time_s, v.known_position)
        v.send_text(mavlink.MAV_SEVERITY_INFO, "Arming motors")

    def step(self) -> None:
        """Advance by one control step."""
        v = self.state
        v.advance_time()
        v.estimator.step(v.time_s, v.body)
        shift = v.estimator.take_shift()
        if any(shift):
            v.est = v.estimator.estimate(v.body)
            v.control.shift(*shift)
        if v.home is None and v.origin is not None and v.estimator.since_boot(HOME_SET_S):
            set_home(v, v.place)
        self.failsafes.step()
        v.breadcrumbs.step(v.time_s, v.known_position, v.mode, armed=v.armed)
        v.receiver.step(v.time_s)
        if v.armed:
            self.modes.flight.step(v)
            self._check_idle()
        else:
            self.modes.flight.wait(v)
            end_motor_test(v)
            charge_at_depot(v)
            self._report_while_disarmed()
        if v.item_reached is not None:
            v.last_item_reached = v.item_reached
            v.item_reached = None
            send_on_all(v, "MISSION_ITEM_REACHED")
        move(v)
        v.gimbal.step(CONTROL_STEP_S)
        if self.transfers.uploads:
            self.transfers.step(v.time_s)
        for channel in v.channels:
            serve(v, channel)

    def _report_while_disarmed(self) -> None:
        """Report failed arming checks and the ground pressure at intervals."""
        v = self.state
        if v.time_s >= self._next_checks_s:
            self._next_checks_s += CHECKS_REPORT_INTERVAL_S
            for refusal in arming_refusals(v):
                v.send_text(mavlink.MAV_SEVERITY_CRITICAL, f"PreArm: {refusal}")
        if v.time_s >= self._next_pressure_s:
            self._next_pressure_s = v.time_s + PRESSURE_REPORT_INTERVAL_S
            for channel in v.channels:
                for name in ("BARO1_GND_PRESS", "BARO2_GND_PRESS"):
                    send_parameter(v, channel, name, -1, UNKNOWN_U16)

    def _check_idle(self) -> None:
        v = self.state
        delay = v.params["DISARM_DELAY"]
        idle_s = v.time_s - v.idle_since_s
        if not v.landed or v.taking_off:
            v.idle_since_s = v.time_s
        elif (v.mode in _LANDING_MODES and idle_s > 1.0) or 0.0 < delay <= idle_s:
            v.disarm()

    def _compare_accelerometers(self) -> None:
        v = self.state
        if accelerometers_differ(v.params):
            v.accels_agree_from_s = math.inf
        elif v.accels_agree_from_s == math.inf:
            v.accels_agree_from_s = v.time_s + ACCELS_AGREE_S

    def _parameter_changed(self, name: str) -> None:
        v = self.state
        prefix = name.split("_", 1)[0]
        if prefix in LIMIT_PREFIXES:
            set_limits(v.params, v.control)
        elif prefix in ("FENCE", "AVOID"):
            set_fence(v.params, v.fence, name)
        elif name.startswith("SIM_WIND"):
            set_wind(v.params, v.wind)
        elif name.startswith("SIM_ACC") or name == "ARMING_ACCTHRESH":
            self._compare_accelerometers()
        elif prefix in ("SIM", "BATT"):
            set_battery(v.params, v.battery)
        elif prefix[:2] == "SR" and prefix[2:].isdigit():
            follow_rate(v, name)

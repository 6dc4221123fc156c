"""Simulated EKF: startup sequence, local origin, estimate errors and validity of the position."""

from __future__ import annotations

import math
import random
from collections.abc import Callable

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle.altitude_source import AltitudeSource
from fractus_vehicle.body import Body, euler_of
from fractus_vehicle.control import Estimate
from fractus_vehicle.earth import Place
from fractus_vehicle.gps_receivers import GpsReceivers
from fractus_vehicle.params import Parameters
from fractus_vehicle.sensor_selection import SensorSelection
from fractus_vehicle.sensors import Drift

GPS_INTERVAL_S = 0.2
GPS_TIMEOUT_S = 7.0

# Reaction to a wrong GPS position, as measured on a real autopilot. The estimator rejects a fix that is farther from its
# estimate than the gate. A smaller difference is followed within seconds.
GPS_GATE_M = 5.0
GPS_FUSION_S = 1.5
GLITCH_REPORTED_S = 1.0
GLITCH_ACCEPTED_S = 8.5
GLITCH_CLEARED_S = 11.5

# Times of startup events, as measured on a real autopilot that is ready after FULL_START_S. A different `ready_after_s`
# scales all of them.
FULL_START_S = 41.0
INITIALISED_S = 2.6
FILTER_STARTED_S = 5.0
FILTER_ACTIVE_S = 5.2
TILT_ALIGNED_S = 7.0
ACCELS_CONSISTENT_S = 12.0
FIRST_FIX_S = 11.0
ORIGIN_SET_S = 21.0
HOME_SET_S = 21.5
ANNOUNCEMENTS = (
    (1.0, "Calibrating barometer"),
    (2.4, "Barometer 1 calibration complete"),
    (2.4, "Barometer 2 calibration complete"),
    (INITIALISED_S, "ArduPilot Ready"),
    (3.0, "AHRS: DCM active"),
    (3.2, "RC7: SaveWaypoint LOW"),
    (FILTER_STARTED_S, "EKF3 IMU0 initialised"),
    (FILTER_STARTED_S, "EKF3 IMU1 initialised"),
    (FILTER_ACTIVE_S, "AHRS: EKF3 active"),
    (TILT_ALIGNED_S, "EKF3 IMU0 tilt alignment complete"),
    (TILT_ALIGNED_S, "EKF3 IMU1 tilt alignment complete"),
    (8.0, "EKF3 IMU0 MAG0 initial yaw alignment complete"),
    (8.0, "EKF3 IMU1 MAG0 initial yaw alignment complete"),
    (9.5, "GPS 1: probing for u-blox at 230400 baud"),
    (FIRST_FIX_S, "GPS 1: detected u-blox"),
)
# Height at which the EKF aligns its heading again, in the first climb.
FINAL_ALIGNMENT_M = 2.5

_FLAGS_NO_POSITION = (
    mavlink.EKF_ATTITUDE
    | mavlink.EKF_VELOCITY_HORIZ
    | mavlink.EKF_VELOCITY_VERT
    | mavlink.EKF_POS_VERT_ABS
    | mavlink.EKF_CONST_POS_MODE
)
_FLAGS_READY = (
    mavlink.EKF_ATTITUDE
    | mavlink.EKF_VELOCITY_HORIZ
    | mavlink.EKF_VELOCITY_VERT
    | mavlink.EKF_POS_HORIZ_REL
    | mavlink.EKF_POS_HORIZ_ABS
    | mavlink.EKF_POS_VERT_ABS
    | mavlink.EKF_PRED_POS_HORIZ_REL
    | mavlink.EKF_PRED_POS_HORIZ_ABS
)


def _tilted(q: tuple[float, float, float, float], tilt: list[float]) -> tuple[float, float, float, float]:
    """Rotate an attitude by small angles about the body axes, accurate to second order."""
    w, x, y, z = q
    a = 0.5 * tilt[0]
    b = 0.5 * tilt[1]
    c = 0.5 * tilt[2]
    return (w - x * a - y * b - z * c, x + w * a + y * c - z * b, y + w * b + z * a - x * c, z + w * c + x * b - y * a)


class Estimator:
    """Position, velocity and attitude estimate with the errors of a GPS-aided EKF."""

    def __init__(
        self,
        start: Place,
        *,
        ready_after_s: float,
        noise_m: float,
        rng: random.Random,
        params: Parameters,
        send_text: Callable[[int, str], None],
    ) -> None:
        self._start = start
        self._ready_after_s = ready_after_s
        self._send_text = send_text
        self.gps_receivers = GpsReceivers(start, noise_m=noise_m, rng=rng, params=params)
        self.altitude = AltitudeSource(params)
        self.sensors = SensorSelection(params, send_text)
        self.origin: Place | None = None
        self.position_ok = False
        self._drift = Drift(rng, noise_m)
        self._time_s = 0.0
        self._next_fix_s = 0.0
        self._fix_s = -1e9
        self._announced = 0
        self._finally_aligned = False
        self._gps_error = (0.0, 0.0)  # north and east error of the estimate that it took from the GPS, in metres
        self._rejected_since_s: float | None = None
        self._rejected_s = -math.inf
        self._glitching = False
        self._shift = (0.0, 0.0)

    def since_boot(self, boot_s: float) -> bool:
        """Return True if startup has reached the event that a full startup reaches after `boot_s` seconds."""
        return self._time_s * FULL_START_S >= boot_s * self._ready_after_s

    @property
    def initialised(self) -> bool:
        """True if the autopilot has completed its initialisation and runs the main loop."""
        return self.since_boot(INITIALISED_S)

    @property
    def active(self) -> bool:
        """True if the autopilot uses the EKF."""
        return self.since_boot(FILTER_ACTIVE_S)

    @property
    def aligned(self) -> bool:
        """True if attitude and height are valid."""
        return self.since_boot(TILT_ALIGNED_S)

    @property
    def consistent(self) -> bool:
        """True if the accelerometers have been consistent for as long as arming requires."""
        return self.since_boot(ACCELS_CONSISTENT_S)

    @property
    def flags(self) -> int:
        """Flags of EKF_STATUS_REPORT."""
        if self.position_ok:
            return _FLAGS_READY | (mavlink.EKF_GPS_GLITCHING if self._glitching else 0)
        return _FLAGS_NO_POSITION if self.aligned else mavlink.EKF_UNINITIALIZED

    def estimate(self, body: Body) -> Estimate:
        """Return the current estimate."""
        drift = self._drift
        quaternion = _tilted(body.quaternion, drift.tilt)
        roll, pitch, yaw = euler_of(quaternion)
        return Estimate(
            body.north + drift.north + self._gps_error[0],
            body.east + drift.east + self._gps_error[1],
            body.down + drift.down - self.altitude.error_m,
            body.vn + drift.rate_n,
            body.ve + drift.rate_e,
            body.vd,
            roll,
            pitch,
            yaw,
            body.p,
            body.q,
            body.r,
            quaternion,
        )

    def step(self, time_s: float, body: Body) -> None:
        """Take a GPS fix when it is due, and update the validity of the position."""
        self._time_s = time_s
        if time_s < self._next_fix_s:
            return
        self._next_fix_s += GPS_INTERVAL_S
        self.gps_receivers.step(
            time_s, body, found=self.since_boot(FIRST_FIX_S), powered=self.since_boot(FILTER_STARTED_S)
        )
        if self.gps_receivers.fix_type >= mavlink.GPS_FIX_TYPE_3D_FIX:
            self._fix_s = time_s
        if self.aligned:
            self.altitude.step(GPS_INTERVAL_S)
            self.sensors.step(GPS_INTERVAL_S)
        self._announce(body)
        self._update_position(time_s)
        if self.position_ok and self._fix_s == time_s:
            self._follow_gps(time_s)

    def take_shift(self) -> tuple[float, float, float]:
        """Return by how far the estimate was reset to its sensors since the last call, north, east and down in metres."""
        north, east = self._shift
        self._shift = (0.0, 0.0)
        return north, east, -self.altitude.take_reset()

    def reset_position(self, north_m: float, east_m: float) -> None:
        """Move the estimate by an offset at once, as a change of the lane may."""
        self._shift = (self._shift[0] + north_m, self._shift[1] + east_m)
        self._gps_error = (self._gps_error[0] + north_m, self._gps_error[1] + east_m)

    def _follow_gps(self, time_s: float) -> None:
        """Follow the GPS position, or reject it while it is too far away. After a long rejection, jump to it."""
        glitch_n, glitch_e = self.gps_receivers.error
        off_n = glitch_n - self._gps_error[0]
        off_e = glitch_e - self._gps_error[1]
        follow = 1.0 - math.exp(-GPS_INTERVAL_S / GPS_FUSION_S)
        if math.hypot(off_n, off_e) > GPS_GATE_M:
            if self._rejected_since_s is None:
                self._rejected_since_s = time_s
            self._rejected_s = time_s
            follow = 0.0
            if time_s - self._rejected_since_s >= GLITCH_ACCEPTED_S - GPS_INTERVAL_S / 2:
                self._shift = (self._shift[0] + off_n, self._shift[1] + off_e)
                self._rejected_since_s = None
                follow = 1.0
        else:
            self._rejected_since_s = None
        self._gps_error = (self._gps_error[0] + follow * off_n, self._gps_error[1] + follow * off_e)
        since_s = self._rejected_since_s
        if since_s is not None and time_s - since_s >= GLITCH_REPORTED_S and not self._glitching:
            self._glitching = True
            self._send_text(mavlink.MAV_SEVERITY_CRITICAL, "GPS Glitch or Compass error")
        elif self._glitching and time_s - self._rejected_s >= GLITCH_CLEARED_S:
            self._glitching = False
            self._send_text(mavlink.MAV_SEVERITY_CRITICAL, "Glitch cleared")

    def _announce(self, body: Body) -> None:
        """Send the STATUSTEXTs of the startup sequence and of the first climb."""
        while self._announced < len(ANNOUNCEMENTS) and self.since_boot(ANNOUNCEMENTS[self._announced][0]):
            self._inform(ANNOUNCEMENTS[self._announced][1])
            self._announced += 1
        if not self._finally_aligned and self.position_ok and -body.down > FINAL_ALIGNMENT_M:
            self._finally_aligned = True
            for unit in (0, 1):
                self._inform(f"EKF3 IMU{unit} MAG0 in-flight yaw alignment complete")

    def _inform(self, text: str) -> None:
        self._send_text(mavlink.MAV_SEVERITY_INFO, text)

    def _update_position(self, time_s: float) -> None:
        age_s = time_s - self._fix_s
        self._drift.step(GPS_INTERVAL_S, aided=self.origin is None or age_s <= 2.0 * GPS_INTERVAL_S)
        if (
            self.origin is None
            and self.gps_receivers.fix_type >= mavlink.GPS_FIX_TYPE_3D_FIX
            and self.since_boot(ORIGIN_SET_S)
        ):
            self.origin = self._start
            self._inform("EKF3 IMU0 origin set")
            self._inform(f"Field Elevation Set: {self._start.alt_m:.0f}m")
            self._inform("EKF3 IMU1 origin set")
        ok = self.origin is not None and self.since_boot(FULL_START_S) and age_s < GPS_TIMEOUT_S
        if ok != self.position_ok:
            for unit in (0, 1):
                self._inform(f"EKF3 IMU{unit} is using GPS" if ok else f"EKF3 IMU{unit} stopped aiding")
        self.position_ok = ok

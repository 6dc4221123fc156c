"""Sensors that the EKF uses: its compass, and its lane with one accelerometer and gyroscope."""

from __future__ import annotations

import math
from collections.abc import Callable

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle.params import Parameters

COMPASSES = (1, 2, 3)
CORRECT_OFFSETS = (5.0, 13.0, -18.0)
"""Offsets in milligauss for which the compasses are calibrated: the defaults of SIM_MAGn_OFS_X, _Y and _Z."""
GATE_MGAUSS = 150.0
# Innovation gate of the compass: EK3_MAG_I_GATE 3 times EK3_MAG_M_NSE 50 mG.
COMPASS_TIMEOUT_S = 10.0
VARIANCE_FILTER_S = 0.5
NORMAL_VARIANCE = 0.01


class SensorSelection:
    """Compass and lane in use, and the variance of the compass.

    Attributes:
        compass_variance: `compass_variance` of EKF_STATUS_REPORT.
        lane: Lane in use, 0 or 1.
    """

    def __init__(self, params: Parameters, send_text: Callable[[int, str], None]) -> None:
        self._params = params
        self._send_text = send_text
        self._compass = 0
        self._rejected_s = 0.0
        self.compass_variance = NORMAL_VARIANCE
        self.lane = 0

    def step(self, dt: float) -> None:
        """Advance by `dt` seconds."""
        self._check_compass(dt)
        if self._failed(self.lane) and not self._failed(1 - self.lane):
            self.lane = 1 - self.lane
            self._send_text(mavlink.MAV_SEVERITY_CRITICAL, f"EKF3 lane switch {self.lane}")
            self._send_text(mavlink.MAV_SEVERITY_WARNING, f"EKF primary changed:{self.lane}")

    def _failed(self, lane: int) -> bool:
        """Return True if the accelerometer or gyroscope of a lane has failed."""
        masks = int(self._params["SIM_ACC_FAIL_MSK"]) | int(self._params["SIM_GYR_FAIL_MSK"])
        return bool(masks >> lane & 1)

    def _check_compass(self, dt: float) -> None:
        error = self._compass_error()
        self.compass_variance += (error - self.compass_variance) * (1.0 - math.exp(-dt / VARIANCE_FILTER_S))
        self.compass_variance = max(self.compass_variance, NORMAL_VARIANCE)
        broken = bool(int(self._params[f"SIM_MAG{COMPASSES[self._compass]}_FAIL"]))
        self._rejected_s = self._rejected_s + dt if error >= 1.0 else 0.0
        if not broken and self._rejected_s < COMPASS_TIMEOUT_S:
            return
        for step in range(1, len(COMPASSES)):
            other = (self._compass + step) % len(COMPASSES)
            if not int(self._params[f"SIM_MAG{COMPASSES[other]}_FAIL"]):
                self._compass = other
                self._rejected_s = 0.0
                for unit in (0, 1):
                    self._send_text(mavlink.MAV_SEVERITY_INFO, f"EKF3 IMU{unit} switching to compass {other}")
                return

    def _compass_error(self) -> float:
        """Return the error of the compass in use as a multiple of its gate."""
        number = COMPASSES[self._compass]
        if int(self._params[f"SIM_MAG{number}_FAIL"]):
            return 0.0
        offsets = [self._params[f"SIM_MAG{number}_OFS_{axis}"] for axis in "XYZ"]
        return math.dist(offsets, CORRECT_OFFSETS) / GATE_MGAUSS

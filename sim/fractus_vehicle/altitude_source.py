"""Altitude of the EKF: follows the barometer, rejects a large error for some seconds, and then jumps to it."""

from __future__ import annotations

import math

from fractus_vehicle.params import Parameters

# Innovation gate of the height: EK3_HGT_I_GATE 5 times EK3_ALT_M_NSE 2 m.
GATE_M = 10.0
# The EKF resets its height after this time of rejection, if it also has a vertical velocity from GPS.
RETRY_S = 10.0
FUSION_S = 3.0
NORMAL_VARIANCE = 0.01


class AltitudeSource:
    """Error of the estimated altitude that the barometer causes.

    Attributes:
        error_m: Estimated minus true altitude.
        variance: `pos_vert_variance` of EKF_STATUS_REPORT.
    """

    def __init__(self, params: Parameters) -> None:
        self._params = params
        self._drift_m = 0.0
        self._rejected_s = 0.0
        self._reset_m = 0.0
        self.error_m = 0.0
        self.variance = NORMAL_VARIANCE

    @property
    def barometer_error_m(self) -> float:
        """Error of the barometer that the EKF uses. A disabled barometer is replaced by the second one, which is correct."""
        if int(self._params["SIM_BARO_DISABLE"]):
            return 0.0
        return self._params["SIM_BARO_GLITCH"] + self._drift_m

    def step(self, dt: float) -> None:
        """Advance by `dt` seconds."""
        self._drift_m += self._params["SIM_BARO_DRIFT"] * dt
        off_m = self.barometer_error_m - self.error_m
        self.variance = max(abs(off_m) / GATE_M, NORMAL_VARIANCE)
        if abs(off_m) <= GATE_M:
            self._rejected_s = 0.0
            self.error_m += (1.0 - math.exp(-dt / FUSION_S)) * off_m
            return
        self._rejected_s += dt
        if self._rejected_s >= RETRY_S:
            self._rejected_s = 0.0
            self._reset_m += off_m
            self.error_m += off_m

    def take_reset(self) -> float:
        """Return by how far the altitude was reset since the last call, metres up."""
        reset_m = self._reset_m
        self._reset_m = 0.0
        return reset_m

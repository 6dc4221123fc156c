"""Battery, GPS receiver, and errors of the state estimate."""

from __future__ import annotations

import itertools
import math
import random
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle.earth import Place
from fractus_vehicle.shaping import clamp

# Open-circuit voltage of a lithium polymer cell by state of charge.
_CELL_CURVE = ((0.0, 3.27), (0.05, 3.60), (0.1, 3.69), (0.2, 3.75), (0.4, 3.80), (0.6, 3.90), (0.8, 4.03), (1.0, 4.20))
# Standard deviation of the estimated attitude: roll, pitch, yaw.
TILT_SIGMA_RAD = (math.radians(0.15), math.radians(0.15), math.radians(0.6))
TILT_CORRELATION_S = 20.0
HOVER_CURRENT_A = 14.0
# Horizontal dilution of precision of the simulated GPS, in hundredths.
GPS_HDOP = 121


class Battery:
    """Lithium polymer pack, discharged by the motors.

    Its voltage drops with the charge only if SIM_BATT_CAP_AH is set.
    """

    def __init__(self, full_v: float, capacity_mah: float, resistance_ohm: float = 0.035) -> None:
        self.full_v = full_v
        self.capacity_mah = max(capacity_mah, 1.0)
        self.pack_mah = 0.0  # capacity of the simulated pack; 0 for unlimited
        self.resistance_ohm = resistance_ohm
        self.used_mah = 0.0
        self.used_j = 0.0
        self.current_a = 0.0
        self.voltage_v = full_v
        self._rest_v = full_v
        self._rest_for: tuple[float, float] | None = None

    @property
    def left(self) -> float:
        """State of charge, 0 to 1."""
        return clamp(1.0 - self.used_mah / self.capacity_mah, 0.0, 1.0)

    @property
    def percent(self) -> int:
        """State of charge in percent, as reported by the autopilot."""
        return round(self.left * 100.0)

    def _rest_voltage(self) -> float:
        """Return the open-circuit voltage, cached per thousandth of the charge."""
        left = round(clamp(1.0 - self.used_mah / self.pack_mah, 0.0, 1.0), 3)
        if self._rest_for != (left, self.full_v):
            self._rest_for = (left, self.full_v)
            self._rest_v = self._curve(left)
        return self._rest_v

    def _curve(self, left: float) -> float:
        for (low, low_v), (high, high_v) in itertools.pairwise(_CELL_CURVE):
            if left <= high:
                return self.full_v / 4.2 * (low_v + (high_v - low_v) * (left - low) / (high - low))
        return self.full_v

    def step(self, dt: float, load: float) -> None:
        """Draw current for `dt` seconds; `load` is thrust as a multiple of the hover thrust."""
        demand_a = HOVER_CURRENT_A * max(load, 0.0) ** 1.5
        self.current_a += (demand_a - self.current_a) * min(1.0, dt / 0.1)
        self.used_mah += self.current_a * dt / 3.6
        self.used_j += self.current_a * self.voltage_v * dt
        if self.pack_mah > 0.0:
            self.voltage_v = max(self._rest_voltage() - self.current_a * self.resistance_ohm, 0.0)
        else:
            self.voltage_v = max(self.full_v, 0.0)

    @property
    def thrust_share(self) -> float:
        """Full thrust at the current voltage, relative to a full battery."""
        return clamp(self.voltage_v / 12.6, 0.3, 1.4) ** 2


@dataclass(slots=True)
class Gps:
    """GPS receiver: fix type and measured position.

    Attributes:
        fix_s: Time of the last fix.
        error: Injected error of the position, north and east in metres.
        accuracy_m: Horizontal accuracy that the receiver reports.
    """

    fix_type: int = mavlink.GPS_FIX_TYPE_NO_GPS
    satellites: int = 0
    place: Place | None = None
    vn: float = 0.0
    ve: float = 0.0
    fix_s: float = 0.0
    error: tuple[float, float] = (0.0, 0.0)
    accuracy_m: float = 0.0

    def update(
        self, truth: Place, velocity: tuple[float, float], *, noise_m: float, satellites: int, rng: random.Random
    ) -> None:
        """Take a fix at the true position with noise."""
        if noise_m > 0.0:
            truth = truth.offset(rng.gauss(0.0, noise_m), rng.gauss(0.0, noise_m), rng.gauss(0.0, 1.5 * noise_m))
        self.place = truth
        self.vn, self.ve = velocity
        self.satellites = satellites
        if satellites >= 10:
            self.fix_type = mavlink.GPS_FIX_TYPE_RTK_FIXED
        else:
            self.fix_type = mavlink.GPS_FIX_TYPE_3D_FIX if satellites >= 6 else mavlink.GPS_FIX_TYPE_NO_FIX

    def lose(self) -> None:
        """Lose the fix."""
        self.fix_type = mavlink.GPS_FIX_TYPE_NO_FIX
        self.satellites = 0


class Drift:
    """Error of the position estimate: bounded drift with GPS, unbounded dead-reckoning drift without."""

    def __init__(self, rng: random.Random, sigma_m: float = 0.12, correlation_s: float = 40.0) -> None:
        self._rng = rng
        self._sigma_m = sigma_m
        self._correlation_s = correlation_s
        self._wander = [0.0, 0.0]
        self._blind = [0.0, 0.0]
        self._blind_rate = [0.0, 0.0]
        self.north = self.east = self.down = 0.0
        self.tilt = [0.0, 0.0, 0.0]  # attitude error about the body axes in radians
        self.rate_n = self.rate_e = 0.0

    def step(self, dt: float, *, aided: bool) -> None:
        """Advance the errors by `dt` seconds."""
        keep = math.exp(-dt / self._correlation_s)
        kick = self._sigma_m * math.sqrt(1.0 - keep * keep)
        gauss = self._rng.gauss
        for axis in (0, 1):
            self._wander[axis] = self._wander[axis] * keep + kick * gauss(0.0, 1.0)
            if aided:
                fade = math.exp(-dt / 1.5)
                self._blind[axis] *= fade
                self._blind_rate[axis] = 0.0
            else:
                self._blind_rate[axis] += 0.05 * gauss(0.0, 1.0) * math.sqrt(dt)
                self._blind[axis] += self._blind_rate[axis] * dt
        if self._sigma_m > 0.0:
            steady = math.exp(-dt / TILT_CORRELATION_S)
            for axis, sigma in enumerate(TILT_SIGMA_RAD):
                kick_rad = sigma * math.sqrt(1.0 - steady * steady)
                self.tilt[axis] = self.tilt[axis] * steady + kick_rad * gauss(0.0, 1.0)
        self.down = self.down * keep + 0.4 * kick * gauss(0.0, 1.0)
        self.north = self._wander[0] + self._blind[0]
        self.east = self._wander[1] + self._blind[1]
        self.rate_n, self.rate_e = self._blind_rate

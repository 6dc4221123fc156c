"""The two GPS receivers: fixes with injected errors, positions from GPS_INPUT, and the receivers that the EKF uses."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle.body import Body
from fractus_vehicle.earth import UNIT, Place
from fractus_vehicle.params import Parameters
from fractus_vehicle.sensors import Gps

INPUT_TYPE = 14
"""Value of GPS1_TYPE and GPS2_TYPE of a receiver whose positions come from GPS_INPUT."""
INPUT_TIMEOUT_S = 4.0

# Values of GPS_AUTO_SWITCH.
USE_BEST = 1
BLEND = 2
USE_PRIMARY_WITH_FIX = 4
# Of two receivers with the same type of fix, the receiver with at least this many more satellites is better.
MORE_SATELLITES = 2

# Parameters of the two receivers, by purpose.
NAMES = (
    {"disable": "SIM_GPS_DISABLE", "glitch": "SIM_GPS_GLITCH_", "type": "GPS1_TYPE"}
    | {name: f"SIM_GPS_{name}" for name in ("NOISE", "NUMSATS", "ACC")},
    {"disable": "SIM_GPS2_DISABLE", "glitch": "SIM_GPS2_GLTCH_", "type": "GPS2_TYPE"}
    | {name: f"SIM_GPS2_{name}" for name in ("NOISE", "NUMSATS", "ACC")},
)


@dataclass(frozen=True, slots=True)
class InputFix:
    """Position from GPS_INPUT."""

    place: Place
    fix_type: int
    satellites: int
    accuracy_m: float
    time_s: float


class GpsReceivers:
    """Both receivers. The second one exists if GPS2_TYPE is not 0 and SIM_GPS2_DISABLE is 0, or if its type is GPS_INPUT."""

    def __init__(self, start: Place, *, noise_m: float, rng: random.Random, params: Parameters) -> None:
        self._start = start
        self._noise_m = noise_m
        self._rng = rng
        self._params = params
        self._inputs: dict[int, InputFix] = {}
        self._best = 0
        self.receivers = (Gps(), Gps())

    def take_input(self, number: int, fix: InputFix) -> None:
        """Process GPS_INPUT. It is ignored unless the receiver has this type."""
        if number in (0, 1) and int(self._params[NAMES[number]["type"]]) == INPUT_TYPE:
            self._inputs[number] = fix

    @property
    def has_second(self) -> bool:
        """True if the vehicle has a second receiver."""
        kind = int(self._params["GPS2_TYPE"])
        return kind == INPUT_TYPE or (kind != 0 and not int(self._params["SIM_GPS2_DISABLE"]))

    def step(self, time_s: float, body: Body, *, found: bool, powered: bool) -> None:
        """Take the fixes that are due.

        Args:
            time_s: Time since boot.
            body: True motion.
            found: True if the receivers have their first fix.
            powered: True if the receivers are searched.
        """
        for number, receiver in enumerate(self.receivers):
            names = NAMES[number]
            if number == 1 and not self.has_second:
                receiver.lose()
            elif int(self._params[names["type"]]) == INPUT_TYPE:
                self._follow_input(number, time_s, body)
            elif not int(self._params[names["disable"]]) and found:
                self._measure(number, time_s, body)
            elif powered:
                receiver.lose()

    def _measure(self, number: int, time_s: float, body: Body) -> None:
        names = NAMES[number]
        receiver = self.receivers[number]
        north, east, down = self._glitch(names["glitch"])
        receiver.update(
            self._start.offset(body.north + north, body.east + east, body.down + down),
            (body.vn, body.ve),
            noise_m=max(self._params[names["NOISE"]], 0.0) + self._noise_m,
            satellites=int(self._params[names["NUMSATS"]]),
            rng=self._rng,
        )
        receiver.fix_s = time_s
        receiver.error = (north, east)
        receiver.accuracy_m = max(self._params[names["ACC"]], 0.0)

    def _glitch(self, prefix: str) -> tuple[float, float, float]:
        """Return the injected error of a receiver's position (north, east, down) in metres."""
        north_deg, east_deg, up_m = (self._params[f"{prefix}{axis}"] for axis in "XYZ")
        start = self._start
        wrong = Place(start.lat_e7 + round(north_deg / UNIT), start.lon_e7 + round(east_deg / UNIT), start.alt_m + up_m)
        return start.vector_to(wrong)

    def _follow_input(self, number: int, time_s: float, body: Body) -> None:
        receiver = self.receivers[number]
        fix = self._inputs.get(number)
        if fix is None or time_s - fix.time_s > INPUT_TIMEOUT_S:
            receiver.lose()
            return
        north, east, _ = self._start.vector_to(fix.place)
        receiver.place = fix.place
        receiver.fix_type = fix.fix_type
        receiver.satellites = fix.satellites
        receiver.fix_s = fix.time_s
        receiver.error = (north - body.north, east - body.east)
        receiver.accuracy_m = fix.accuracy_m

    @property
    def _weights(self) -> tuple[float, float]:
        """Weights of the receivers in the position that the EKF uses."""
        first, second = self.receivers
        usable = [each.fix_type >= mavlink.GPS_FIX_TYPE_3D_FIX for each in self.receivers]
        switch = int(self._params["GPS_AUTO_SWITCH"])
        primary = 1 if int(self._params["GPS_PRIMARY"]) == 1 else 0
        if not self.has_second:
            number = 0
        elif switch == BLEND and all(usable):
            shares = [1.0 / max(each.accuracy_m, 0.1) ** 2 for each in (first, second)]
            return shares[0] / sum(shares), shares[1] / sum(shares)
        elif switch in (USE_BEST, BLEND):
            self._best = self._better(self._best)
            number = self._best
        elif switch == USE_PRIMARY_WITH_FIX and not usable[primary]:
            number = 1 - primary
        else:
            number = primary
        return (1.0, 0.0) if number == 0 else (0.0, 1.0)

    def _better(self, used: int) -> int:
        other = 1 - used
        now = self.receivers[used]
        rival = self.receivers[other]
        if rival.fix_type != now.fix_type:
            return other if rival.fix_type > now.fix_type else used
        return other if rival.satellites >= now.satellites + MORE_SATELLITES else used

    @property
    def fix_type(self) -> int:
        """Fix type of the position that the EKF uses."""
        weights = self._weights
        return max(each.fix_type for each, weight in zip(self.receivers, weights, strict=True) if weight > 0.0)

    @property
    def error(self) -> tuple[float, float]:
        """Injected error of the position that the EKF uses, north and east in metres."""
        first, second = self.receivers
        weights = self._weights
        return (
            math.fsum((weights[0] * first.error[0], weights[1] * second.error[0])),
            math.fsum((weights[0] * first.error[1], weights[1] * second.error[1])),
        )

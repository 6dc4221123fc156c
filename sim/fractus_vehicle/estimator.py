"""The estimator: waits for the sensors at the start, knows the local origin, and says whether position can be trusted."""

from __future__ import annotations

import random
from collections.abc import Callable

from fractus_mavlink.enums import EKF_STATUS_FLAGS, GPS_FIX_TYPE, MAV_SEVERITY

from fractus_vehicle.body import Body, euler_of
from fractus_vehicle.control import Estimate
from fractus_vehicle.earth import Place
from fractus_vehicle.params import Parameters
from fractus_vehicle.sensors import Drift, Gps

GPS_INTERVAL_S = 0.2
GPS_TIMEOUT_S = 5.0

# Shares of the time to readiness at which things happen, and what is said then.
FIRST_FIX = 0.35
ORIGIN_SET = 0.8
ANNOUNCEMENTS = (
    (0.05, "EKF3 IMU0 initialised"),
    (0.1, "AHRS: EKF3 active"),
    (0.12, "EKF3 IMU0 tilt alignment complete"),
    (0.15, "EKF3 IMU0 MAG0 initial yaw alignment complete"),
    (FIRST_FIX, "GPS 1: detected u-blox"),
    (ORIGIN_SET, "EKF3 IMU0 origin set"),
)

_FLAGS_STARTING = (
    EKF_STATUS_FLAGS.ATTITUDE
    | EKF_STATUS_FLAGS.VELOCITY_VERT
    | EKF_STATUS_FLAGS.POS_VERT_ABS
    | EKF_STATUS_FLAGS.CONST_POS_MODE
)
_FLAGS_NO_POSITION = _FLAGS_STARTING | EKF_STATUS_FLAGS.VELOCITY_HORIZ
_FLAGS_READY = (
    EKF_STATUS_FLAGS.ATTITUDE
    | EKF_STATUS_FLAGS.VELOCITY_HORIZ
    | EKF_STATUS_FLAGS.VELOCITY_VERT
    | EKF_STATUS_FLAGS.POS_HORIZ_REL
    | EKF_STATUS_FLAGS.POS_HORIZ_ABS
    | EKF_STATUS_FLAGS.POS_VERT_ABS
    | EKF_STATUS_FLAGS.PRED_POS_HORIZ_REL
    | EKF_STATUS_FLAGS.PRED_POS_HORIZ_ABS
)


def _tilted(q: tuple[float, float, float, float], tilt: list[float]) -> tuple[float, float, float, float]:
    """An attitude turned by small angles about the body axes; exact enough to second order."""
    w, x, y, z = q
    a, b, c = 0.5 * tilt[0], 0.5 * tilt[1], 0.5 * tilt[2]
    return (w - x * a - y * b - z * c, x + w * a + y * c - z * b, y + w * b + z * a - x * c, z + w * c + x * b - y * a)


class Estimator:
    """Position, velocity and attitude with the errors of a GPS-aided estimate."""

    def __init__(
        self,
        start: Place,
        *,
        ready_after_s: float,
        noise_m: float,
        rng: random.Random,
        params: Parameters,
        say: Callable[[MAV_SEVERITY, str], None],
    ) -> None:
        self._start = start
        self._ready_after_s = ready_after_s
        self._noise_m = noise_m
        self._rng = rng
        self._params = params
        self._say = say
        self.gps = Gps()
        self.origin: Place | None = None
        self.position_ok = False
        self.ready = False  # whether the start is over
        self._drift = Drift(rng, noise_m)
        self._time_s = 0.0
        self._next_fix_s = 0.0
        self._fix_s = -1e9
        self._announced = 0

    @property
    def healthy(self) -> bool:
        """Whether the filter runs at all."""
        return self._time_s >= 0.5 * self._ready_after_s

    @property
    def flags(self) -> EKF_STATUS_FLAGS:
        """What EKF_STATUS_REPORT says of the filter."""
        if self.position_ok:
            return _FLAGS_READY
        if self.origin is not None:
            return _FLAGS_NO_POSITION
        return EKF_STATUS_FLAGS.UNINITIALIZED if self._time_s < 0.1 * self._ready_after_s else _FLAGS_STARTING

    def estimate(self, body: Body) -> Estimate:
        """The estimate of the moment."""
        drift = self._drift
        quaternion = _tilted(body.quaternion, drift.tilt)
        roll, pitch, yaw = euler_of(quaternion)
        return Estimate(
            body.north + drift.north,
            body.east + drift.east,
            body.down + drift.down,
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
        """Take a GPS fix when one is due and judge the position."""
        self._time_s = time_s
        if time_s < self._next_fix_s:
            return
        self._next_fix_s += GPS_INTERVAL_S
        if int(self._params["SIM_GPS1_ENABLE"]) and time_s >= FIRST_FIX * self._ready_after_s:
            self.gps.update(
                self._start.offset(body.north, body.east, body.down),
                (body.vn, body.ve),
                noise_m=max(self._params["SIM_GPS1_NOISE"], 0.0) + self._noise_m,
                satellites=int(self._params["SIM_GPS1_NUMSATS"]),
                rng=self._rng,
            )
            if self.gps.fix_type >= GPS_FIX_TYPE.TYPE_3D_FIX:
                self._fix_s = time_s
        elif time_s >= 0.05 * self._ready_after_s:
            self.gps.lose()
        self._judge(time_s)
        while (
            self._announced < len(ANNOUNCEMENTS) and time_s >= ANNOUNCEMENTS[self._announced][0] * self._ready_after_s
        ):
            self._say(MAV_SEVERITY.INFO, ANNOUNCEMENTS[self._announced][1])
            self._announced += 1

    def _judge(self, time_s: float) -> None:
        age_s = time_s - self._fix_s
        self._drift.step(GPS_INTERVAL_S, aided=self.origin is None or age_s <= 2.0 * GPS_INTERVAL_S)
        if (
            self.origin is None
            and self.gps.fix_type >= GPS_FIX_TYPE.TYPE_3D_FIX
            and time_s >= ORIGIN_SET * self._ready_after_s
        ):
            self.origin = self._start
        self.ready = time_s >= self._ready_after_s
        ok = self.origin is not None and self.ready and age_s < GPS_TIMEOUT_S
        if ok != self.position_ok:
            self._say(MAV_SEVERITY.INFO, "EKF3 IMU0 is using GPS" if ok else "EKF3 IMU0 stopped aiding")
        self.position_ok = ok

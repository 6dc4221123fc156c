"""The airframe: a rigid quadcopter with six degrees of freedom, four lagging motors, drag, wind and the ground.

World axes are north, east, down. Body axes are forward, right, down. The quaternion rotates from body to world axes.
The code uses plain floats, because for one vehicle they are several times faster than small numpy arrays.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

GRAVITY = 9.80665
# The propellers break if the vehicle hits the ground while it leans, or while it both falls and rotates fast. A fall
# without lean and rotation does no damage, as in SITL.
CRASH_IMPACT_MPS = 4.0
CRASH_TURN_RPS = 1.0
CRASH_LEAN_COSINE = 0.5
CRASHED_ROLL_RAD = math.radians(75.0)


@dataclass(frozen=True, slots=True)
class Airframe:
    """Constants of the quadcopter, an X frame with values close to ArduPilot's simulated quadcopter."""

    mass_kg: float = 1.8
    arm_m: float = 0.17  # lever arm of a motor about the roll and pitch axes
    inertia_xy: float = 0.022
    inertia_z: float = 0.04
    yaw_lever_m: float = 0.06  # reaction torque per newton of thrust
    hover_share: float = 0.39  # thrust at hover as a share of full thrust on a full battery
    motor_lag_s: float = 0.04
    drag_linear: float = 0.10  # acceleration per m/s of air speed
    drag_quadratic: float = 0.008

    @property
    def full_thrust_n(self) -> float:
        """Thrust of one motor on a full battery."""
        return self.mass_kg * GRAVITY / (4.0 * self.hover_share)


@dataclass(slots=True)
class Wind:
    """A mean wind with gusts that follow a first-order (Gauss-Markov) process."""

    speed_mps: float = 0.0
    from_deg: float = 0.0
    turbulence_mps: float = 0.0
    correlation_s: float = 2.5
    gust_n: float = 0.0
    gust_e: float = 0.0
    gust_d: float = 0.0

    def step(self, dt: float, rng: random.Random, height_m: float) -> tuple[float, float, float]:
        """Return the velocity of the air (NED, m/s) at a height. Wind fades out in the last metres above the ground."""
        if self.turbulence_mps > 0.0:
            keep = math.exp(-dt / self.correlation_s)
            kick = self.turbulence_mps * math.sqrt(1.0 - keep * keep)
            self.gust_n = self.gust_n * keep + kick * rng.gauss(0.0, 1.0)
            self.gust_e = self.gust_e * keep + kick * rng.gauss(0.0, 1.0)
            self.gust_d = self.gust_d * keep + 0.5 * kick * rng.gauss(0.0, 1.0)
        elif self.speed_mps == 0.0:
            return (0.0, 0.0, 0.0)
        share = 0.0 if height_m <= 0.0 else min(1.0, 0.3 + 0.07 * height_m)
        toward = math.radians(self.from_deg + 180.0)
        return (
            share * (self.speed_mps * math.cos(toward) + self.gust_n),
            share * (self.speed_mps * math.sin(toward) + self.gust_e),
            share * self.gust_d,
        )


def euler_of(quaternion: tuple[float, float, float, float]) -> tuple[float, float, float]:
    """Convert an attitude quaternion to roll, pitch and yaw in radians."""
    w, x, y, z = quaternion
    sine = 2.0 * (w * y - z * x)
    return (
        math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        math.asin(1.0 if sine > 1.0 else max(sine, -1.0)),
        math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )


class Body:
    """Rigid-body state: position, velocity, attitude, body rates and motor thrusts."""

    __slots__ = (
        "_ixy",
        "_iz",
        "accel",
        "airframe",
        "crashed",
        "down",
        "east",
        "impact_mps",
        "impacts",
        "motors",
        "north",
        "on_ground",
        "p",
        "q",
        "quaternion",
        "r",
        "specific_force",
        "vd",
        "ve",
        "vn",
    )

    def __init__(self, airframe: Airframe, heading_deg: float = 0.0) -> None:
        self.airframe = airframe
        self._ixy = airframe.inertia_xy
        self._iz = airframe.inertia_z
        self.north = self.east = self.down = 0.0
        self.vn = self.ve = self.vd = 0.0
        half = math.radians(heading_deg) / 2.0
        self.quaternion = (math.cos(half), 0.0, 0.0, math.sin(half))
        self.p = self.q = self.r = 0.0
        self.motors = (0.0, 0.0, 0.0, 0.0)
        self.accel = (0.0, 0.0, 0.0)
        self.specific_force = (0.0, 0.0, -GRAVITY)
        self.on_ground = True
        self.crashed = False
        self.impact_mps = 0.0
        self.impacts = 0

    def euler(self) -> tuple[float, float, float]:
        """Roll, pitch, yaw in radians."""
        return euler_of(self.quaternion)

    def step(self, dt: float, commands: tuple[float, float, float, float], air: tuple[float, float, float]) -> None:
        """Advance by `dt` seconds.

        Args:
            dt: Time step in seconds.
            commands: Thrust demand of each motor in newtons.
            air: Velocity of the air (NED, m/s).
        """
        frame = self.airframe
        if self.crashed:
            commands = (0.0, 0.0, 0.0, 0.0)
        blend = dt / (frame.motor_lag_s + dt)
        m1, m2, m3, m4 = self.motors
        m1 += (commands[0] - m1) * blend
        m2 += (commands[1] - m2) * blend
        m3 += (commands[2] - m3) * blend
        m4 += (commands[3] - m4) * blend
        self.motors = (m1, m2, m3, m4)
        self._translate(dt, (m1 + m2 + m3 + m4) / frame.mass_kg, air)
        if self.on_ground:
            self._rest(dt)
        else:
            lever = frame.arm_m
            self._rotate(
                dt,
                lever * (m2 + m3 - m1 - m4),
                lever * (m1 + m3 - m2 - m4),
                frame.yaw_lever_m * (m1 + m2 - m3 - m4),
            )

    def _translate(self, dt: float, lift: float, air: tuple[float, float, float]) -> None:
        frame = self.airframe
        w, x, y, z = self.quaternion
        rn = self.vn - air[0]
        re = self.ve - air[1]
        rd = self.vd - air[2]
        drag = frame.drag_linear + frame.drag_quadratic * math.sqrt(rn * rn + re * re + rd * rd)
        fn = -lift * 2.0 * (x * z + w * y) - drag * rn
        fe = -lift * 2.0 * (y * z - w * x) - drag * re
        fd = -lift * (1.0 - 2.0 * (x * x + y * y)) - drag * rd
        ad = fd + GRAVITY
        if self.on_ground:
            if ad >= 0.0:
                self.accel = (0.0, 0.0, 0.0)
                self.specific_force = (0.0, 0.0, -GRAVITY)
                self.vn = self.ve = self.vd = 0.0
                return
            self.on_ground = False
        self.accel = (fn, fe, ad)
        self.specific_force = (fn, fe, fd)
        self.vn += fn * dt
        self.ve += fe * dt
        self.vd += ad * dt
        self.north += self.vn * dt
        self.east += self.ve * dt
        self.down += self.vd * dt
        if self.down >= 0.0 and self.vd > 0.0:
            self.impact_mps = self.vd
            self.impacts += 1
            leans = 1.0 - 2.0 * (x * x + y * y) < CRASH_LEAN_COSINE
            tumbles = self.vd > CRASH_IMPACT_MPS and max(abs(self.p), abs(self.q), abs(self.r)) > CRASH_TURN_RPS
            if tumbles and not (self.crashed or leans):
                self._topple()
            self.crashed = self.crashed or leans or tumbles
            self.down = 0.0
            self.vn = self.ve = self.vd = 0.0
            self.on_ground = True

    def _topple(self) -> None:
        """Roll the crashed vehicle onto its side."""
        half = CRASHED_ROLL_RAD / 2.0
        w, x, y, z = self.quaternion
        c = math.cos(half)
        s = math.sin(half)
        self.quaternion = (w * c - x * s, x * c + w * s, y * c + z * s, z * c - y * s)

    def _rest(self, dt: float) -> None:
        self.p = self.q = self.r = 0.0
        w, x, y, z = self.quaternion
        if self.crashed:
            return
        if abs(x) + abs(y) < 1e-6:
            return
        keep = math.exp(-dt / 0.1)
        x = x * keep
        y = y * keep
        size = math.sqrt(w * w + x * x + y * y + z * z) or 1.0
        self.quaternion = (w / size, x / size, y / size, z / size)

    def _rotate(self, dt: float, tx: float, ty: float, tz: float) -> None:
        ixy = self._ixy
        iz = self._iz
        p = self.p
        q = self.q
        r = self.r
        p += dt * (tx - (iz - ixy) * q * r) / ixy
        q += dt * (ty - (ixy - iz) * p * r) / ixy
        r += dt * tz / iz
        self.p = p
        self.q = q
        self.r = r
        w, x, y, z = self.quaternion
        h = 0.5 * dt
        nw = w - h * (p * x + q * y + r * z)
        nx = x + h * (p * w + r * y - q * z)
        ny = y + h * (q * w - r * x + p * z)
        nz = z + h * (r * w + q * x - p * y)
        scale = 1.0 / math.sqrt(nw * nw + nx * nx + ny * ny + nz * nz)
        self.quaternion = (nw * scale, nx * scale, ny * scale, nz * scale)

"""A three-axis gimbal: keeps the camera level, turns it at a limited rate, and measures where it points."""

from __future__ import annotations

import math
from dataclasses import dataclass

from fractus_vehicle.shaping import clamp

TURN_DEG_S = 60.0
# ArduPilot's defaults of MNT1_PITCH_MIN and so on.
PITCH_DEG, YAW_DEG, ROLL_DEG = (-90.0, 20.0), (-180.0, 180.0), (-30.0, 30.0)
# Types of ArduPilot that measure nothing and report what they were told: servos, and motors that are driven like servos.
SERVOS = frozenset({1, 7})


@dataclass(slots=True)
class Gimbal:
    """Where the camera points, in degrees: pitch over the horizon, yaw from the nose.

    Attributes:
        kind: MNT1_TYPE at the start; 0 for none.
    """

    kind: int
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0
    target: tuple[float, float] = (0.0, 0.0)

    def point(self, pitch_deg: float, yaw_deg: float) -> None:
        """Begin to turn, as far as it turns."""
        self.target = clamp(pitch_deg, *PITCH_DEG), clamp(yaw_deg, *YAW_DEG)

    def step(self, step_s: float) -> None:
        """Turn on."""
        most = TURN_DEG_S * step_s
        self.pitch_deg += clamp(self.target[0] - self.pitch_deg, -most, most)
        self.yaw_deg += clamp(self.target[1] - self.yaw_deg, -most, most)

    @property
    def told(self) -> tuple[float, float, float, float]:
        """The quaternion that is reported: measured, or for servos what they were told."""
        angles = self.target if self.kind in SERVOS else (self.pitch_deg, self.yaw_deg)
        pitch, yaw = (math.radians(angle) / 2 for angle in angles)
        cp, sp, cy, sy = math.cos(pitch), math.sin(pitch), math.cos(yaw), math.sin(yaw)
        return cp * cy, -sp * sy, sp * cy, cp * sy

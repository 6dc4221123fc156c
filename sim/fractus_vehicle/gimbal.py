"""Three-axis gimbal: holds the camera angles relative to the horizon, and rotates at a limited rate."""

from __future__ import annotations

import math
from dataclasses import dataclass

from fractus_vehicle.shaping import clamp

TURN_DEG_S = 60.0
# Angle limits: ArduPilot's defaults of MNT1_PITCH_MIN, MNT1_PITCH_MAX and so on.
PITCH_DEG = (-90.0, 20.0)
YAW_DEG = (-180.0, 180.0)
ROLL_DEG = (-30.0, 30.0)
# MNT1_TYPE values without feedback (servo and brushless PWM). Their target is reported as the measured attitude.
SERVOS = frozenset({1, 7})


@dataclass(slots=True)
class Gimbal:
    """Gimbal attitude in degrees: pitch relative to the horizon, yaw relative to the nose.

    Attributes:
        kind: MNT1_TYPE at startup; 0 for no gimbal.
    """

    kind: int
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0
    target: tuple[float, float] = (0.0, 0.0)

    def point(self, pitch_deg: float, yaw_deg: float) -> None:
        """Set the target angles, limited to the range of the gimbal."""
        self.target = clamp(pitch_deg, *PITCH_DEG), clamp(yaw_deg, *YAW_DEG)

    def step(self, step_s: float) -> None:
        """Rotate towards the target for one control step."""
        most = TURN_DEG_S * step_s
        self.pitch_deg += clamp(self.target[0] - self.pitch_deg, -most, most)
        self.yaw_deg += clamp(self.target[1] - self.yaw_deg, -most, most)

    @property
    def reported_quaternion(self) -> tuple[float, float, float, float]:
        """Attitude quaternion for telemetry: the measured attitude, or the target for servo gimbals."""
        angles = self.target if self.kind in SERVOS else (self.pitch_deg, self.yaw_deg)
        pitch, yaw = (math.radians(angle) / 2 for angle in angles)
        cp = math.cos(pitch)
        sp = math.sin(pitch)
        cy = math.cos(yaw)
        sy = math.sin(yaw)
        return cp * cy, -sp * sy, sp * cy, cp * sy

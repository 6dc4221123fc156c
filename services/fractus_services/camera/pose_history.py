"""Poses of a drone's camera during the last seconds, with errors that cover all motion between two measurements.

Policies judge an image by everything that the camera may have seen while the image was taken. The error of each pose is the error
of the autopilot's estimate, plus the distance and angle by which the airframe can move between measurements.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

from fractus_core.policy.decision_types import Attitude, Lens, Situation
from fractus_core.policy.footprint import camera_axes

MAX_AGE_S = 1.0
"""Maximum age of a measurement. An older measurement is stale."""
HISTORY_S = 30.0
"""Time for which measurements are kept. It is longer than any exposure."""
ALTITUDE_ERROR_M = 1.0
TILT_ERROR_DEG = 5.0
YAW_ERROR_DEG = 15.0
"""Bounds of the autopilot's errors: altitude error, angle of the combined roll and pitch error, and yaw error."""
MAX_TURN_DEG_S = 60.0
MAX_ACCELERATION_MPS2 = 5.0
"""Maximum turn rate and acceleration of a multicopter between two measurements."""
MAX_GIMBAL_TURN_DEG_S = 120.0
"""Maximum turn rate of a gimbal beyond the measured rotation between two measurements. The yaw rate of the airframe is added."""

_LEVEL = Attitude(0.0, 0.0, 0.0)
_FORWARD_CAMERA = Lens(1.0, 1.0, pitch_deg=0.0)


@dataclass(frozen=True, slots=True)
class Measurement:
    """A measurement by the mobility service. Times are monotonic seconds.

    Attributes:
        received_at: Time of arrival.
        position_at: Time at which the position was measured.
        attitude_at: Time at which the attitude of the airframe, or of the gimbal that turns the camera, was measured.
        situation: Measured state. `position_error_m` is the error that the mobility service reports. The attitude errors are
            not set yet. `lat` is None if the position is unknown.
    """

    received_at: float
    position_at: float
    attitude_at: float
    situation: Situation


@dataclass(frozen=True, slots=True)
class _Gap:
    """Bounds of the unmeasured motion around a pose.

    Attributes:
        moved_s: Time during which the airframe may have moved, in seconds.
        turned_s: Time during which the airframe may have turned, in seconds.
        tilt_deg: Measured change of roll and pitch. For a gimbal, the entire measured rotation.
        yaw_deg: Measured change of yaw.
    """

    moved_s: float = 0.0
    turned_s: float = 0.0
    tilt_deg: float = 0.0
    yaw_deg: float = 0.0

    @classmethod
    def after(cls, last: Measurement, now_s: float) -> _Gap:
        """Return the gap between the last measurement and now."""
        return cls(max(now_s - last.position_at, 0.0), max(now_s - last.attitude_at, 0.0))

    @classmethod
    def between(cls, measurement: Measurement, neighbour: Measurement, *, gimbal: bool) -> _Gap:
        """Return the half of the gap between two measurements that is nearer to the first measurement."""
        moved_s = abs(neighbour.position_at - measurement.position_at)
        turned_s = abs(neighbour.attitude_at - measurement.attitude_at)
        attitude = measurement.situation.attitude or _LEVEL
        other = neighbour.situation.attitude or _LEVEL
        if gimbal:
            # Use the entire rotation, because roll and yaw of a gimbal that points nearly straight down are not well-defined.
            tilt_deg = _rotation_deg(attitude, other)
            yaw_deg = 0.0
        else:
            roll_deg = _turn_deg(attitude.roll_deg, other.roll_deg)
            tilt_deg = roll_deg + _turn_deg(attitude.pitch_deg, other.pitch_deg)
            yaw_deg = _turn_deg(attitude.yaw_deg, other.yaw_deg)
        return cls(
            moved_s / 2 if moved_s <= MAX_AGE_S else math.inf,
            turned_s / 2 if turned_s <= MAX_AGE_S else math.inf,
            tilt_deg / 2,
            yaw_deg / 2,
        )

    def merge(self, other: _Gap) -> _Gap:
        """Return a gap with the larger value of each bound of the two gaps."""
        return _Gap(
            max(self.moved_s, other.moved_s),
            max(self.turned_s, other.turned_s),
            max(self.tilt_deg, other.tilt_deg),
            max(self.yaw_deg, other.yaw_deg),
        )


class PoseHistory:
    """`PoseProvider` of a drone, fed with measurements as they arrive.

    Args:
        now: Returns monotonic seconds.
        lens: Lens of the camera, or None if it is unknown.
        relief_m: Maximum depth of the surrounding ground below home, in metres.
        gimbal: True if the attitudes were measured by a gimbal.
    """

    fixed = False

    def __init__(
        self, now: Callable[[], float], *, lens: Lens | None = None, relief_m: float = 0.0, gimbal: bool = False
    ) -> None:
        self._now = now
        self._lens = lens
        self._relief_m = relief_m
        self._gimbal = gimbal
        self._measurements: deque[Measurement] = deque()

    def __len__(self) -> int:
        """Return the number of measurements that are kept."""
        return len(self._measurements)

    @property
    def age_s(self) -> float:
        """Age of the latest position in seconds, or infinity if there is no position."""
        return self._now() - self._measurements[-1].position_at if self._measurements else math.inf

    def add(self, measurement: Measurement) -> None:
        """Append the latest measurement, and drop measurements that are older than `HISTORY_S`."""
        self._measurements.append(measurement)
        while self._measurements[0].received_at < measurement.received_at - HISTORY_S:
            self._measurements.popleft()

    def situation(self, time_s: float) -> Situation:
        """See `PoseProvider`. The pose is unknown if the latest measurement is stale."""
        if not self._measurements:
            return self._unknown(time_s)
        last = self._measurements[-1]
        return self._situation(last, _Gap.after(last, self._now()), time_s)

    def situations_since(self, start_s: float, time_s: float) -> tuple[Situation, ...]:
        """See `PoseProvider`.

        The errors of each pose cover the motion during half of the time to the neighbouring measurements. In this time, the
        rotation from the pose is at most half of the difference between the two poses, plus the rotation that `MAX_TURN_DEG_S`
        allows. The poses together cover all motion between measurements.
        """
        measurements = list(self._measurements)
        first = next((i for i in reversed(range(len(measurements))) if measurements[i].received_at <= start_s), None)
        # The view before the first measurement is unknown. Policies assume that the camera sees everything.
        situations = [self._unknown(time_s)] if first is None else []
        measurements = measurements[first or 0 :]
        for i, measurement in enumerate(measurements):
            gap = _Gap() if i < len(measurements) - 1 else _Gap.after(measurement, self._now())
            for neighbour in (*measurements[max(i - 1, 0) : i], *measurements[i + 1 : i + 2]):
                gap = gap.merge(_Gap.between(measurement, neighbour, gimbal=self._gimbal))
            situations.append(self._situation(measurement, gap, time_s))
        return tuple(situations)

    def _unknown(self, time_s: float) -> Situation:
        return Situation(time_s=time_s, lens=self._lens, relief_m=self._relief_m)

    def _situation(self, measurement: Measurement, gap: _Gap, time_s: float) -> Situation:
        measured = measurement.situation
        if measured.lat is None or gap.moved_s > MAX_AGE_S:
            return self._unknown(time_s)
        horizontal_mps = math.hypot(measured.north_mps, measured.east_mps)
        return replace(
            measured,
            time_s=time_s,
            position_error_m=measured.position_error_m + _reach_m(horizontal_mps, gap.moved_s),
            altitude_error_m=ALTITUDE_ERROR_M + _reach_m(abs(measured.down_mps), gap.moved_s),
            attitude=_with_errors(measured.attitude, gap, gimbal=self._gimbal),
            lens=self._lens,
            relief_m=self._relief_m,
        )


def _reach_m(speed_mps: float, time_s: float) -> float:
    """Return the distance that a drone covers from a speed with maximum acceleration, in metres."""
    return (speed_mps + MAX_ACCELERATION_MPS2 * time_s / 2) * time_s


def _turn_deg(first_deg: float, second_deg: float) -> float:
    """Return the angle between two directions. It is 2 degrees between 359 and 1."""
    return abs(math.remainder(first_deg - second_deg, 360.0))


def _rotation_deg(first: Attitude, second: Attitude) -> float:
    """Return the angle of the rotation between two attitudes. No ray of the camera rotates by more."""
    axes = zip(camera_axes(_FORWARD_CAMERA, first), camera_axes(_FORWARD_CAMERA, second), strict=True)
    trace = sum(a * b for first_axis, second_axis in axes for a, b in zip(first_axis, second_axis, strict=True))
    return math.degrees(math.acos(max(-1.0, min(1.0, (trace - 1.0) / 2.0))))


def _with_errors(attitude: Attitude | None, gap: _Gap, *, gimbal: bool) -> Attitude | None:
    """Return an attitude with the errors of a gap, or None if the attitude is unknown or stale."""
    if attitude is None or gap.turned_s > MAX_AGE_S:
        return None
    tilt_rate_deg_s = MAX_GIMBAL_TURN_DEG_S if gimbal else MAX_TURN_DEG_S
    return replace(
        attitude,
        tilt_error_deg=TILT_ERROR_DEG + tilt_rate_deg_s * gap.turned_s + gap.tilt_deg,
        yaw_error_deg=YAW_ERROR_DEG + MAX_TURN_DEG_S * gap.turned_s + gap.yaw_deg,
    )

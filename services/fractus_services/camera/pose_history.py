"""The poses of a drone's camera during the last seconds, with errors that cover every motion between two measurements.

A picture is judged by all that its camera may have seen while it was taken. The error of each pose is a budget: what the
autopilot's own estimate may be off by, plus what the airframe can move and turn in the time nothing was measured.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

from fractus_core.policy.decision_types import Attitude, Lens, Situation
from fractus_core.policy.footprint import camera_axes

MAX_AGE_S = 1.0
"""A measurement that is older says nothing about the present."""
KEPT_S = 30.0
"""Longer than any exposure."""
ALTITUDE_ERROR_M = 1.0
TILT_ERROR_DEG = 5.0
YAW_ERROR_DEG = 15.0
"""Bounds of an autopilot's attitude errors: roll and pitch together, and the compass."""
MAX_TURN_DEG_S = 60.0
MAX_ACCELERATION_MPS2 = 5.0
"""How fast a multicopter turns and speeds up at most; between two measurements it may do both."""
MAX_GIMBAL_TURN_DEG_S = 120.0
"""How fast a gimbal turns its camera at most, beyond what two measurements tell; the airframe's yaw comes on top."""

_LEVEL = Attitude(0.0, 0.0, 0.0)
_CAMERA = Lens(1.0, 1.0, pitch_deg=0.0)


@dataclass(frozen=True, slots=True)
class Measurement:
    """What the mobility service measured; times are monotonic seconds.

    Attributes:
        received_at: when it arrived here.
        position_at: when the position was measured.
        attitude_at: when the attitude was measured: that of the airframe, or of the gimbal that turns the camera.
        situation: the state as measured: `position_error_m` is that of the position alone, the attitude has no errors yet,
            and `lat` is None while the position is unknown.
    """

    received_at: float
    position_at: float
    attitude_at: float
    situation: Situation


@dataclass(frozen=True, slots=True)
class _Gap:
    """What may have happened around a pose without being measured.

    Attributes:
        moved_s: seconds for which the airframe may have moved on.
        turned_s: seconds for which it may have turned on.
        tilt_deg: how much further from the pose its roll and pitch are known to have been; of a gimbal, all of its turn.
        yaw_deg: how much further from the pose its yaw is known to have been.
    """

    moved_s: float = 0.0
    turned_s: float = 0.0
    tilt_deg: float = 0.0
    yaw_deg: float = 0.0

    @classmethod
    def after(cls, last: Measurement, now_s: float) -> _Gap:
        """From the last measurement until now."""
        return cls(max(now_s - last.position_at, 0.0), max(now_s - last.attitude_at, 0.0))

    @classmethod
    def between(cls, one: Measurement, other: Measurement, *, gimbal: bool) -> _Gap:
        """The half of the time to the next or previous measurement that lies nearer to this one."""
        moved_s, turned_s = abs(other.position_at - one.position_at), abs(other.attitude_at - one.attitude_at)
        here, there = one.situation.attitude or _LEVEL, other.situation.attitude or _LEVEL
        # Near straight down, where gimbals point, roll and yaw say little one by one.
        tilt_deg = (
            _rotation_deg(here, there)
            if gimbal
            else _turn_deg(here.roll_deg, there.roll_deg) + _turn_deg(here.pitch_deg, there.pitch_deg)
        )
        return cls(
            moved_s / 2 if moved_s <= MAX_AGE_S else math.inf,
            turned_s / 2 if turned_s <= MAX_AGE_S else math.inf,
            tilt_deg / 2,
            0.0 if gimbal else _turn_deg(here.yaw_deg, there.yaw_deg) / 2,
        )

    def joined(self, other: _Gap) -> _Gap:
        """The larger of each."""
        return _Gap(
            max(self.moved_s, other.moved_s),
            max(self.turned_s, other.turned_s),
            max(self.tilt_deg, other.tilt_deg),
            max(self.yaw_deg, other.yaw_deg),
        )


class PoseHistory:
    """The poses of a drone, as measurements arrive; a `PoseProvider`.

    Args:
        now: monotonic seconds.
        lens: what the camera sees; None when it is unknown.
        relief_m: how far the ground around may lie below home.
        gimbal: whether the attitudes are those of a gimbal.
    """

    def __init__(
        self, now: Callable[[], float], *, lens: Lens | None = None, relief_m: float = 0.0, gimbal: bool = False
    ) -> None:
        self._now = now
        self._lens = lens
        self._relief_m = relief_m
        self._gimbal = gimbal
        self._measurements: deque[Measurement] = deque()

    def __len__(self) -> int:
        """Measurements that are kept."""
        return len(self._measurements)

    @property
    def age_s(self) -> float:
        """Age of the newest position; infinite when there is none."""
        return self._now() - self._measurements[-1].position_at if self._measurements else math.inf

    def add(self, measurement: Measurement) -> None:
        """Append the newest measurement, and forget those that are too old for any exposure."""
        self._measurements.append(measurement)
        while self._measurements[0].received_at < measurement.received_at - KEPT_S:
            self._measurements.popleft()

    def situation(self, time_s: float) -> Situation:
        """See `PoseProvider`; unknown when the mobility service is silent."""
        if not self._measurements:
            return self._unknown(time_s)
        last = self._measurements[-1]
        return self._situation(last, _Gap.after(last, self._now()), time_s)

    def situations_since(self, begun_s: float, time_s: float) -> tuple[Situation, ...]:
        """See `PoseProvider`.

        The errors of each pose cover half of the time to its neighbours as well: the drone was there at most that long
        before or after, and turned away from it by at most half of what the two poses differ by, plus what
        `MAX_TURN_DEG_S` allows. So no motion between two measurements is left out.
        """
        kept = list(self._measurements)
        first = next((i for i in reversed(range(len(kept))) if kept[i].received_at <= begun_s), None)
        # What was seen before the first measurement is unknown, and counts as everything.
        situations = [self._unknown(time_s)] if first is None else []
        kept = kept[first or 0 :]
        for i, one in enumerate(kept):
            gap = _Gap() if i < len(kept) - 1 else _Gap.after(one, self._now())
            for neighbour in (*kept[max(i - 1, 0) : i], *kept[i + 1 : i + 2]):
                gap = gap.joined(_Gap.between(one, neighbour, gimbal=self._gimbal))
            situations.append(self._situation(one, gap, time_s))
        return tuple(situations)

    def _unknown(self, time_s: float) -> Situation:
        return Situation(time_s=time_s, lens=self._lens, relief_m=self._relief_m)

    def _situation(self, measured: Measurement, gap: _Gap, time_s: float) -> Situation:
        known = measured.situation
        if known.lat is None or gap.moved_s > MAX_AGE_S:
            return self._unknown(time_s)
        return replace(
            known,
            time_s=time_s,
            position_error_m=known.position_error_m
            + _reach_m(math.hypot(known.north_mps, known.east_mps), gap.moved_s),
            altitude_error_m=ALTITUDE_ERROR_M + _reach_m(abs(known.down_mps), gap.moved_s),
            attitude=_with_errors(known.attitude, gap, gimbal=self._gimbal),
            lens=self._lens,
            relief_m=self._relief_m,
        )


def _reach_m(speed_mps: float, time_s: float) -> float:
    """How far a drone gets at this speed while it accelerates as fast as it can."""
    return (speed_mps + MAX_ACCELERATION_MPS2 * time_s / 2) * time_s


def _turn_deg(one_deg: float, other_deg: float) -> float:
    """The angle between two directions; they wrap, so from 359 to 1 degree it is 2."""
    return abs(math.remainder(one_deg - other_deg, 360.0))


def _rotation_deg(one: Attitude, other: Attitude) -> float:
    """The angle of the one turn that leads from an attitude to another: no ray of a camera moves by more."""
    axes = zip(camera_axes(_CAMERA, one), camera_axes(_CAMERA, other), strict=True)
    trace = sum(a * b for here, there in axes for a, b in zip(here, there, strict=True))
    return math.degrees(math.acos(max(-1.0, min(1.0, (trace - 1.0) / 2.0))))


def _with_errors(attitude: Attitude | None, gap: _Gap, *, gimbal: bool) -> Attitude | None:
    if attitude is None or gap.turned_s > MAX_AGE_S:
        return None
    tilted_deg_s = MAX_GIMBAL_TURN_DEG_S if gimbal else MAX_TURN_DEG_S
    return replace(
        attitude,
        tilt_error_deg=TILT_ERROR_DEG + tilted_deg_s * gap.turned_s + gap.tilt_deg,
        yaw_error_deg=YAW_ERROR_DEG + MAX_TURN_DEG_S * gap.turned_s + gap.yaw_deg,
    )

"""Signs of a wrong position although the estimator reports one: a GPS glitch, large variances, a jump, two positions that disagree.

A GPS receiver that reflections or a jammer mislead reports a wrong position with a small error. ArduCopter rejects such a position
for some seconds, then accepts it: its own position jumps, and it flies to its target from there. The reported error does not change.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

from fractus_core.geo import LocalFrame
from pymavlink.dialects.v20 import ardupilotmega as mavlink

QUIET_S = 5.0
"""Seconds of the vehicle's clock without a sign of a wrong position after which the position is trusted again."""

DEFAULT_VARIANCE_LIMIT = 0.8
"""Default of FS_EKF_THRESH. At 1, the estimator rejects its measurements."""

VARIANCES = {
    "velocity_variance": "velocity",
    "pos_horiz_variance": "horizontal position",
    "pos_vert_variance": "altitude",
    "compass_variance": "compass",
}

ERROR_FACTOR = 3.0
"""Multiple of the position error (1 sigma) that two correct positions may be apart."""

MAX_TOLERATED_ERROR_M = 2.0
"""Largest position error (1 sigma) that increases the permitted distances.

The receiver that may be wrong reports the error. Without this limit, a receiver that reports a large error could not be found wrong.
"""

JUMP_M = 1.0
"""Distance by which the estimator may correct the position, in addition to the position error, without a jump."""

RETURNED_M = 5.0
"""Distance from the expected position, in addition to the position error, within which a position that jumped has returned.

The expected position is the last trusted position plus the distance flown since then. This distance is computed from
velocities, which are inaccurate.
"""

ALTITUDE_JUMP_M = 3.0
"""Distance by which the estimator may correct the altitude, in metres. A larger correction is a jump."""

DISAGREEMENT_M = 2.0
"""Permitted distance between the GPS position and the estimate, in addition to the position error.

It covers the offset of the antenna, and the flight between the times of the two positions.
"""

MAX_ACCEL_MPS2 = 10.0
"""Largest acceleration of a copter between two positions: a lean angle of 45 degrees, or free fall."""

MAX_SPEED_MPS = 30.0
"""Largest mean speed between two positions."""

GAP_S = 1.0
"""Seconds between two positions up to which the velocities give the distance that was flown."""

GAP_ACCEL_MPS2 = 1.5
"""Mean acceleration of a copter that starts and stops between two positions.

It bounds the distance that the velocities before and after a longer interruption do not show. The service stops a drone whose
position is not trusted, so a larger mean acceleration is not expected.
"""

LOST_CLOCK_S = 10.0
"""Seconds by which the vehicle's clock must be behind, compared with the last position, to show that the vehicle has restarted.

Less may be a delayed message, or a simulator that stalled.
"""

PATH_S = 1.0
"""Seconds of the vehicle's clock for which positions are kept. The position of the GPS is older than the estimate."""

DISAGREEMENTS = 2
"""Number of consecutive GPS positions that must disagree with the estimate.

A single GPS position may be an outlier, which the estimator rejects.
"""


@dataclass(frozen=True, slots=True)
class ReportedPosition:
    """Position that the estimator reported.

    Attributes:
        boot_s: Reading of the vehicle's clock.
        lat, lon: Degrees.
        amsl_m: Altitude above mean sea level.
        north_mps, east_mps, down_mps: Velocity.
    """

    boot_s: float
    lat: float
    lon: float
    amsl_m: float
    north_mps: float
    east_mps: float
    down_mps: float

    @property
    def speed_mps(self) -> float:
        """Horizontal speed."""
        return math.hypot(self.north_mps, self.east_mps)

    def offset_m(self, other: ReportedPosition) -> tuple[float, float]:
        """Return the horizontal vector to another position, metres east and north."""
        return LocalFrame(self.lat, self.lon).xy(other.lat, other.lon)


@dataclass(frozen=True, slots=True)
class ExpectedPosition:
    """Position at which a vehicle is expected whose reported position is not trusted.

    Attributes:
        position: Last trusted position, moved by the distance flown since then.
        unseen_m: Distance that may have been flown during interruptions, in addition.
        moves: True if the motors run.
        reason: Why the reported position is not trusted.
    """

    position: ReportedPosition
    unseen_m: float
    moves: bool
    reason: str


@dataclass(frozen=True, slots=True)
class GpsFix:
    """Position that a GPS receiver reported.

    Attributes:
        message: Name of the MAVLink message.
        lat, lon: Degrees.
        error_m: Position error, 1 sigma.
        fix_us: Time of the fix on the receiver's clock; 0 if it is unknown.
    """

    message: str
    lat: float
    lon: float
    error_m: float
    fix_us: int


@dataclass(slots=True)
class _Receiver:
    """Comparison of one GPS receiver with the estimate.

    Attributes:
        fix_us: Time of its last fix.
        disagreements: Number of consecutive fixes that disagree with the estimate.
        problem: The disagreement as text; empty if there is none.
    """

    fix_us: int = 0
    disagreements: int = 0
    problem: str = ""


class PositionChecks:
    """Collects signs of a wrong position. Times are monotonic seconds unless they are stated to be on the vehicle's clock.

    Attributes:
        variance_limit: FS_EKF_THRESH of the vehicle: a variance of this size or larger is a sign.
        pace: Seconds of the vehicle's clock per second of real time.
        blind: True while the expected position is unknown, because the record of an earlier process cannot be read.
    """

    def __init__(self) -> None:
        self.variance_limit = DEFAULT_VARIANCE_LIMIT
        self.pace = 1.0
        self.blind = False
        self._path: deque[ReportedPosition] = deque()
        self._path_at = -math.inf
        self._estimator_problem = ""
        self._receivers: dict[str, _Receiver] = {}
        self._displacement = ""
        self._trusted: ReportedPosition | None = None
        self._flown_m = (0.0, 0.0)
        self._climbed_m = 0.0
        self._unseen_m = 0.0
        self._moved = False
        self._reason = ""
        self._seen_at = -math.inf

    def problem(self, now: float) -> str:
        """Return why the position is not trusted; empty if it is.

        A sign of EKF_STATUS_REPORT or GPS_RAW_INT lasts until a later message without this sign. A position that jumped is not
        trusted before it has jumped back, because either the position before or the position after the jump may be wrong.
        """
        gps_problem = next((each.problem for each in self._receivers.values() if each.problem), "")
        lasting = self._estimator_problem or gps_problem or self._displacement
        if lasting:
            self._see(lasting, now)
        return self._reason if now - self._seen_at < QUIET_S / self.pace else ""

    def _see(self, reason: str, now: float) -> None:
        self._reason = reason
        self._seen_at = max(self._seen_at, now)

    @property
    def expected(self) -> ExpectedPosition | None:
        """Position at which the vehicle is expected while its reported position is not trusted; None if it is trusted or unknown."""
        if self._trusted is None or not self._path:
            return None
        lat, lon = LocalFrame(self._trusted.lat, self._trusted.lon).latlon(*self._flown_m)
        position = replace(self._path[-1], lat=lat, lon=lon, amsl_m=self._trusted.amsl_m + self._climbed_m)
        return ExpectedPosition(position, self._unseen_m, moves=self._moved, reason=self._reason)

    def restore(self, expected: ExpectedPosition) -> None:
        """Continue from the expected position of an earlier process. Reported positions are compared with it."""
        self._trusted = expected.position
        self._path.append(expected.position)
        self._unseen_m = expected.unseen_m
        self._moved = expected.moves
        self._displacement = expected.reason

    def distrust(self, reason: str) -> None:
        """Trust no position until the vehicle has restarted, because the record of the expected position cannot be read."""
        self.blind = True
        self._displacement = reason

    def set_variance_limit(self, limit: float) -> None:
        """Use the vehicle's FS_EKF_THRESH. Use the default if the value disables the failsafe, or triggers it too late."""
        self.variance_limit = limit if 0.0 < limit <= 1.0 else DEFAULT_VARIANCE_LIMIT

    def take_estimator(self, flags: int, variances: dict[str, float], now: float, *, positioned: bool) -> None:
        """Process EKF_STATUS_REPORT.

        Args:
            flags: Flags of the estimator.
            variances: Variances by their names in the message.
            now: Time of the report.
            positioned: True if the estimator has an absolute position. A report without one clears no earlier sign. Its variances do
                not count, because they are large during each start.
        """
        self.problem(now)  # The previous report holds until now.
        excessive = [VARIANCES[name] for name, value in variances.items() if not value < self.variance_limit]
        problem = ""
        if flags & mavlink.EKF_GPS_GLITCHING:
            problem = "the autopilot reports a GPS glitch (EKF_STATUS_REPORT)"
        elif excessive and positioned:
            problem = (
                f"the estimator's variance of {', '.join(excessive)} is {self.variance_limit:g} or larger"
                " (EKF_STATUS_REPORT, FS_EKF_THRESH)"
            )
        if problem or positioned:
            self._estimator_problem = problem

    def take_estimator_switch(self, now: float) -> None:
        """Process a status text that reports a change of the estimator. The position of the new estimator may differ."""
        self._see("the autopilot has switched to another estimator (EKF lane)", now)

    def take_position(self, reported: ReportedPosition, error_m: float, now: float, *, moves: bool) -> bool:
        """Look for a jump since the previous position. Return True if the vehicle has restarted between the two.

        Args:
            reported: The position.
            error_m: Position error, 1 sigma.
            now: Time of the position.
            moves: True if the motors run. Jumps on the ground are ignored, because the estimator then corrects itself by resets.
        """
        error_m = min(error_m, MAX_TOLERATED_ERROR_M)
        restarted = False
        if self._path:
            last = self._path[-1]
            elapsed_s = reported.boot_s - last.boot_s
            if elapsed_s == 0.0:
                return False  # The same position again.
            restarted = self._has_restarted(reported, elapsed_s, now, moves=moves)
            if restarted:
                self._path.clear()
                self._receivers.clear()
                self._trusted = None
                self._displacement = ""
                self.blind = False
            else:
                if moves:
                    self._look_for_jump(last, reported, elapsed_s, error_m, now)
                if not self.blind:
                    self._follow(last, reported, elapsed_s, error_m, now, moves=moves)
        self._moved = moves
        self._path.append(reported)
        while self._path[0].boot_s < reported.boot_s - PATH_S:
            self._path.popleft()
        self._path_at = now
        return restarted

    def _has_restarted(self, reported: ReportedPosition, elapsed_s: float, now: float, *, moves: bool) -> bool:
        """Return True if the vehicle has restarted since the last position. Overtaken positions are dropped before.

        After a long interruption, the clock of a restarted vehicle may read more than before. It is then behind, and reads at
        most the duration of the interruption. A restarted vehicle has stopped its motors.
        """
        if elapsed_s < 0.0:
            return True
        silent_s = (now - self._path_at) * self.pace
        if moves or not math.isfinite(silent_s):
            return False
        return elapsed_s < silent_s - LOST_CLOCK_S and reported.boot_s < silent_s

    def _follow(
        self,
        last: ReportedPosition,
        reported: ReportedPosition,
        elapsed_s: float,
        error_m: float,
        now: float,
        *,
        moves: bool,
    ) -> None:
        """While the position is not trusted, compare it with the position that follows from the velocities.

        The comparison begins in flight. It continues on the ground, because the vehicle could otherwise arm at a wrong position.
        """
        if not self.problem(now):
            self._trusted = None
            return
        if self._trusted is None:
            if not moves:
                return
            self._trusted = last
            self._flown_m = (0.0, 0.0)
            self._climbed_m = 0.0
            self._unseen_m = 0.0
        self._flown_m = (
            self._flown_m[0] + (last.east_mps + reported.east_mps) / 2 * elapsed_s,
            self._flown_m[1] + (last.north_mps + reported.north_mps) / 2 * elapsed_s,
        )
        self._climbed_m -= (last.down_mps + reported.down_mps) / 2 * elapsed_s
        if moves or self._moved:
            self._unseen_m += GAP_ACCEL_MPS2 * max(elapsed_s - GAP_S, 0.0) ** 2 / 4
        away_m = math.dist(self._trusted.offset_m(reported), self._flown_m)
        off_m = abs(reported.amsl_m - self._trusted.amsl_m - self._climbed_m)
        self._displacement = ""
        if away_m > RETURNED_M + ERROR_FACTOR * error_m + self._unseen_m:
            self._displacement = f"the reported position is {away_m:.0f} m from the expected position"
        elif off_m > RETURNED_M + self._unseen_m:
            self._displacement = f"the reported altitude is {off_m:.0f} m from the expected altitude"

    def _look_for_jump(
        self, last: ReportedPosition, reported: ReportedPosition, elapsed_s: float, error_m: float, now: float
    ) -> None:
        moved_m = math.hypot(*last.offset_m(reported))
        if moved_m > _reach_m(last.speed_mps, reported.speed_mps, elapsed_s) + JUMP_M + ERROR_FACTOR * error_m:
            self._see(f"the reported position jumped by {moved_m:.0f} m within {elapsed_s:.2f} s", now)
        climbed_m = abs(reported.amsl_m - last.amsl_m)
        if climbed_m > _reach_m(abs(last.down_mps), abs(reported.down_mps), elapsed_s) + ALTITUDE_JUMP_M:
            self._see(f"the reported altitude jumped by {climbed_m:.0f} m within {elapsed_s:.2f} s", now)

    def take_gps(self, fix: GpsFix, now: float) -> None:
        """Compare a position of a GPS receiver with the estimator's positions of the last second. A repeated fix does not count again.

        The estimator uses one receiver, or a mean of two. If two receivers disagree, at least one disagrees with the estimate.
        """
        self.problem(now)
        receiver = self._receivers.setdefault(fix.message, _Receiver())
        repeated = fix.fix_us != 0 and fix.fix_us == receiver.fix_us
        receiver.fix_us = fix.fix_us
        if repeated or not self._path or now - self._path_at > PATH_S / self.pace:
            return  # No recent position to compare with, so an earlier disagreement remains.
        frame = LocalFrame(fix.lat, fix.lon)
        apart_m = min(math.hypot(*frame.xy(known.lat, known.lon)) for known in self._path)
        agrees = apart_m <= DISAGREEMENT_M + ERROR_FACTOR * min(fix.error_m, MAX_TOLERATED_ERROR_M)
        receiver.disagreements = 0 if agrees else receiver.disagreements + 1
        receiver.problem = ""
        if receiver.disagreements >= DISAGREEMENTS:
            receiver.problem = f"{fix.message} and GLOBAL_POSITION_INT are {apart_m:.0f} m apart"

    def forget_gps(self, message: str, now: float) -> None:
        """Forget a receiver that has no fix. The estimator does not use it."""
        self.problem(now)
        self._receivers.pop(message, None)


def _reach_m(first_mps: float, second_mps: float, elapsed_s: float) -> float:
    """Return an upper bound of the distance between two positions with these speeds."""
    fastest_mps = (first_mps + second_mps + MAX_ACCEL_MPS2 * elapsed_s) / 2
    return min(fastest_mps, max(MAX_SPEED_MPS, first_mps, second_mps)) * elapsed_s

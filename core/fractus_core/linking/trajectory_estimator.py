"""Trajectory estimate of the drone from telemetry and the path that its driver announced.

All positions are converted to one local frame, whose origin is the first known position of the drone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from fractus_core.api.geometry import Position
from fractus_core.linking.values import LocalPosition, Track
from fractus_core.local_frame import LocalFrame

ARRIVED_M = 5.0
"""Distance to a waypoint, in metres, within which the waypoint counts as reached."""
MIN_SPEED_MPS = 0.5
"""Speed below which the drone counts as standing, so that its direction is ignored, in m/s."""
ON_COURSE = 0.5
"""Minimum cosine of the angle between velocity and bearing to the next waypoint for a drone that follows its path."""
TURN_S = 3.0
"""Time after a waypoint during which the drone may still be turning, in seconds."""


@dataclass(frozen=True, slots=True)
class TelemetrySample:
    """Telemetry of the drone at one moment.

    Attributes:
        lat: Latitude in degrees.
        lon: Longitude in degrees.
        above_home_m: Height above home, in metres.
        home_amsl_m: Height of home above mean sea level, in metres.
        velocity_mps: East, north and up velocity, in m/s.
    """

    lat: float
    lon: float
    above_home_m: float
    home_amsl_m: float
    velocity_mps: LocalPosition


def local_position(frame: LocalFrame, position: Position, sample: TelemetrySample) -> LocalPosition:
    """Convert a position of a manifest to metres east and north of the frame's origin, and metres above home.

    A position without altitude gets the drone's altitude. The terrain is assumed to be as high as home.
    """
    if position.alt is None:
        up_m = sample.above_home_m
    elif position.altitude_reference == "amsl":
        up_m = position.alt - sample.home_amsl_m
    else:
        up_m = position.alt
    return *frame.xy(position.lat, position.lon), up_m


class TrajectoryEstimator:
    """Follows the drone along its announced path. Progress never goes back, but the path may be flown again.

    Args:
        path: Waypoints in the order flown, empty in region navigation.
    """

    def __init__(self, path: Sequence[Position]) -> None:
        self.path = tuple(path)
        self._frame: LocalFrame | None = None
        self._next: int | None = None

    def estimate(self, sample: TelemetrySample) -> tuple[LocalFrame, Track]:
        """Return the local frame, and the drone's position and expected motion in it."""
        if self._frame is None:
            self._frame = LocalFrame(sample.lat, sample.lon)
        position = (*self._frame.xy(sample.lat, sample.lon), sample.above_home_m)
        points = [local_position(self._frame, waypoint, sample) for waypoint in self.path]
        if points:
            self._next = _next_waypoint(self._next, position, points)
        speed_mps = math.dist(sample.velocity_mps, (0.0, 0.0, 0.0))
        remaining = tuple(points[self._next :]) if self._next is not None else ()
        if remaining and speed_mps >= MIN_SPEED_MPS:
            turning = self._next and math.dist(position, points[self._next - 1]) <= max(ARRIVED_M, TURN_S * speed_mps)
            if turning or _heads_for(remaining[0], position, sample.velocity_mps, speed_mps):
                return self._frame, Track(position, speed_mps, remaining, sample.velocity_mps)
        velocity_mps = sample.velocity_mps if speed_mps >= MIN_SPEED_MPS else (0.0, 0.0, 0.0)
        return self._frame, Track(position, velocity_mps=velocity_mps)


def _next_waypoint(previous: int | None, position: LocalPosition, points: Sequence[LocalPosition]) -> int:
    """Return the index of the waypoint that the drone flies to, or the number of waypoints after the last one."""
    index = previous
    if index is None:
        # The agent may start in flight: use the nearest leg, including the leg to the first waypoint.
        legs = [(_leg_distance(position, points[i - 1], points[i])[0], i) for i in range(1, len(points))]
        legs = [leg for leg in legs if leg[0] <= ARRIVED_M]
        index = min(legs)[1] if legs else 0
    if index >= len(points):
        return 1 if len(points) > 1 and math.dist(position, points[0]) <= ARRIVED_M else index
    while index < len(points) and _is_passed(index, position, points):
        index += 1
    return index


def _is_passed(index: int, position: LocalPosition, points: Sequence[LocalPosition]) -> bool:
    """Return True if the drone is at a waypoint, or already on the leg after it."""
    if math.dist(position, points[index]) <= ARRIVED_M:
        return True
    if index == 0 or index + 1 >= len(points):
        return False
    distance_m, share = _leg_distance(position, points[index], points[index + 1])
    return share > 0 and distance_m < _leg_distance(position, points[index - 1], points[index])[0]


def _leg_distance(position: LocalPosition, begin: LocalPosition, end: LocalPosition) -> tuple[float, float]:
    """Return the distance from a position to the nearest point of a leg, and the place of that point on the leg.

    Returns:
        Distance in metres, and the place as a share of the leg's length: 0 at its begin, 1 at its end.
    """
    along = [b - a for a, b in zip(begin, end, strict=True)]
    square = sum(a * a for a in along)
    share = sum(a * (p - b) for a, p, b in zip(along, position, begin, strict=True)) / square if square else 0.0
    share = min(max(share, 0.0), 1.0)
    return math.dist(position, [b + share * a for b, a in zip(begin, along, strict=True)]), share


def _heads_for(point: LocalPosition, position: LocalPosition, velocity: LocalPosition, speed_mps: float) -> bool:
    distance_m = math.dist(point, position)
    closing = sum(v * (p - h) for v, p, h in zip(velocity, point, position, strict=True))
    return distance_m <= ARRIVED_M or closing >= ON_COURSE * speed_mps * distance_m

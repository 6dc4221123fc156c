"""The drone's track from what is known of its flight: where it is, how fast, and the path that its driver said it would fly.

Everything is put into one local frame, whose horizontal error grows to a hundredth of a per cent at 10 km: nothing beside
what is known of a radio's reach. (The frame of `fractus_core.geo` needs numerical libraries, which an agent does without.)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from fractus_core.api.geometry import Position as Place
from fractus_core.linking.values import Position, Track

_SEMI_MAJOR_M = 6_378_137.0
_E2 = 0.00669437999014

ARRIVED_M = 5.0
"""So near to a waypoint the drone counts as having been there."""
MIN_SPEED_MPS = 0.5
"""Slower than this it stands, and its direction says nothing."""
ON_COURSE = 0.5
"""Cosine of the angle between its velocity and the way to the next waypoint, below which it does not fly its path."""
TURN_S = 3.0
"""So long after a waypoint it may still be turning."""


@dataclass(frozen=True, slots=True)
class Seen:
    """What telemetry says of the drone.

    Attributes:
        lat: degrees north.
        lon: degrees east.
        above_home_m: height above home.
        home_amsl_m: home above mean sea level.
        velocity_mps: east, north and up.
    """

    lat: float
    lon: float
    above_home_m: float
    home_amsl_m: float
    velocity_mps: Position


class Frame:
    """Metres east, north and up of an origin on the ellipsoid, up above the drone's home.

    Args:
        lat: of the origin, degrees north.
        lon: of the origin, degrees east.
    """

    def __init__(self, lat: float, lon: float) -> None:
        self._lat, self._lon = lat, lon
        root = math.sqrt(1 - _E2 * math.sin(math.radians(lat)) ** 2)
        self._north_m = math.radians(_SEMI_MAJOR_M * (1 - _E2) / root**3)
        self._east_m = math.radians(_SEMI_MAJOR_M / root) * math.cos(math.radians(lat))

    def position(self, lat: float, lon: float, up_m: float) -> Position:
        """A place in degrees, and a height above home."""
        east = (lon - self._lon + 180.0) % 360.0 - 180.0
        return east * self._east_m, (lat - self._lat) * self._north_m, up_m

    def place(self, place: Place, seen: Seen) -> Position:
        """A place of a manifest; one without a height is as high as the drone, and the ground as high as its home."""
        if place.alt is None:
            up_m = seen.above_home_m
        elif place.altitude_reference == "amsl":
            up_m = place.alt - seen.home_amsl_m
        else:
            up_m = place.alt
        return self.position(place.lat, place.lon, up_m)


class Course:
    """Follows the drone along the path that it was to fly; progress never goes back, but a path may be flown again.

    Args:
        path: its waypoints in the order flown; empty in region navigation.
    """

    def __init__(self, path: Sequence[Place]) -> None:
        self.path = tuple(path)
        self._frame: Frame | None = None
        self._next: int | None = None

    def track(self, seen: Seen) -> tuple[Frame, Track]:
        """Where the drone is and will be, and the frame that says so."""
        if self._frame is None:
            self._frame = Frame(seen.lat, seen.lon)
        here = self._frame.position(seen.lat, seen.lon, seen.above_home_m)
        points = [self._frame.place(place, seen) for place in self.path]
        if points:
            self._next = _progress(self._next, here, points)
        speed = math.dist(seen.velocity_mps, (0.0, 0.0, 0.0))
        coming = tuple(points[self._next :]) if self._next is not None else ()
        if coming and speed >= MIN_SPEED_MPS:
            turns = self._next and math.dist(here, points[self._next - 1]) <= max(ARRIVED_M, TURN_S * speed)
            if turns or _heads_for(coming[0], here, seen.velocity_mps, speed):
                return self._frame, Track(here, speed, coming, seen.velocity_mps)
        return self._frame, Track(here, velocity_mps=seen.velocity_mps if speed >= MIN_SPEED_MPS else (0.0, 0.0, 0.0))


def _progress(before: int | None, here: Position, points: Sequence[Position]) -> int:
    """The number of the waypoint that the drone flies to; their count when it has been everywhere."""
    if before is None:
        # An agent that starts in flight: the leg that the drone is nearest to, the way to the first waypoint included.
        legs = [(_to_leg(here, points[i - 1], points[i])[0], i) for i in range(1, len(points))]
        legs = [leg for leg in legs if leg[0] <= ARRIVED_M]
        before = min(legs)[1] if legs else 0
    if before >= len(points):
        return 1 if len(points) > 1 and math.dist(here, points[0]) <= ARRIVED_M else before
    while before < len(points) and _passed(before, here, points):
        before += 1
    return before


def _passed(number: int, here: Position, points: Sequence[Position]) -> bool:
    """Whether the drone is at a waypoint, or on the leg behind it already."""
    if math.dist(here, points[number]) <= ARRIVED_M:
        return True
    if number == 0 or number + 1 >= len(points):
        return False
    behind, share = _to_leg(here, points[number], points[number + 1])
    return share > 0 and behind < _to_leg(here, points[number - 1], points[number])[0]


def _to_leg(here: Position, begin: Position, end: Position) -> tuple[float, float]:
    """How far a leg is, and at which share of it it is nearest."""
    along = [b - a for a, b in zip(begin, end, strict=True)]
    square = sum(a * a for a in along)
    share = sum(a * (h - b) for a, h, b in zip(along, here, begin, strict=True)) / square if square else 0.0
    share = min(max(share, 0.0), 1.0)
    return math.dist(here, [b + share * a for b, a in zip(begin, along, strict=True)]), share


def _heads_for(point: Position, here: Position, velocity: Position, speed: float) -> bool:
    away = math.dist(point, here)
    along = sum(v * (p - h) for v, p, h in zip(velocity, point, here, strict=True))
    return away <= ARRIVED_M or along >= ON_COURSE * speed * away

"""Triggers: moments of a flight at which a test acts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from fractus_core.api.geometry import Point
from fractus_core.geo import geodesic_m
from fractus_sim.errors import ExperimentError
from fractus_sim.report.track import Sample

REACHED_M = 2.5
"""Distance from a waypoint at which the waypoint counts as reached, horizontally and vertically."""


class Observed(Protocol):
    """A drone whose flight is observed."""

    @property
    def name(self) -> str:
        """Name of the drone in the test."""

    @property
    def samples(self) -> Sequence[Sample]:
        """Positions so far, in order."""

    @property
    def plan_samples(self) -> Sequence[Sample]:
        """Positions since the current flight plan applies, in order."""

    @property
    def waypoints(self) -> Sequence[tuple[float, float, float]]:
        """Waypoints of the flight plan: latitude, longitude, altitude above home."""

    @property
    def now_s(self) -> float:
        """Seconds since all vehicles were ready."""


@dataclass(frozen=True)
class Trigger:
    """A moment of a flight.

    Attributes:
        title: Description for error messages.
        fired: Returns True from this moment on.
    """

    title: str
    fired: Callable[[], bool]


def until(
    drone: Observed, *, reached: int | None = None, altitude: float | None = None, time: float | None = None
) -> Trigger:
    """Return the trigger for a moment of a drone's flight. Specify exactly one condition.

    Args:
        drone: Drone.
        reached: Number of waypoints of the current flight plan that the drone has reached in order since the plan applies,
            from 1.
        altitude: Altitude that the drone has reached, metres above home.
        time: Seconds since all vehicles were ready.

    Raises:
        ExperimentError: There is not exactly one condition, or the flight plan has fewer waypoints.
    """
    if [reached, altitude, time].count(None) != 2:
        raise ExperimentError("until() needs exactly one of reached, altitude and time")
    if reached is not None:
        number = reached
        if not 1 <= number <= len(drone.waypoints):
            raise ExperimentError(
                f"until(reached={number}): the flight plan of {drone.name} has {len(drone.waypoints)} waypoints; specify the"
                " waypoints as `path` of its FlightPlan, also with a `region`, or wait for an altitude or a time"
            )
        return Trigger(
            f"{drone.name} reaches waypoint {number}",
            lambda: waypoints_reached(drone.plan_samples, drone.waypoints) >= number,
        )
    if altitude is not None:
        metres = altitude
        return Trigger(
            f"{drone.name} reaches {metres:g} m", lambda: any(s.place.alt_m >= metres for s in drone.samples)
        )
    seconds = time or 0.0
    return Trigger(f"{seconds:g} s have passed", lambda: drone.now_s >= seconds)


def waypoints_reached(samples: Sequence[Sample], waypoints: Sequence[tuple[float, float, float]]) -> int:
    """Return the number of waypoints that a flight has reached in order."""
    count = 0
    for sample in samples:
        if count == len(waypoints):
            break
        lat, lon, alt = waypoints[count]
        level = abs(sample.place.alt_m - alt) <= REACHED_M
        if sample.in_air and level and geodesic_m(sample.place.ground, Point(lat=lat, lon=lon)) <= REACHED_M:
            count += 1
    return count

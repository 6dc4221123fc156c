"""Setpoints that were sent recently and that the vehicle's reported state may not show yet."""

from __future__ import annotations

import math
from collections import deque

from fractus_core.geo import LocalFrame
from fractus_core.policy.decision_types import STATIONARY_MPS

from fractus_services.mobility.autopilot import LEG_MPS, VehicleState

Velocity = tuple[float, float, float]
"""North, east and down, m/s."""

MAX_SETPOINTS = 200
"""More setpoints than can be sent within the longest latency with which the service flies."""

TURNED_MPS = 0.5
"""A vehicle whose drift across its course is no faster than this has turned onto the course."""

LEVEL_M = 0.3
"""A leg that ends within this height of the vehicle neither climbs nor sinks."""


class RecentSetpoints:
    """Velocity setpoints, each with the times at which it was first and last sent."""

    def __init__(self) -> None:
        self._sent: deque[tuple[float, float, Velocity]] = deque(maxlen=MAX_SETPOINTS)

    def fly(self, velocity: Velocity, now: float) -> None:
        """Add a velocity setpoint that is being sent."""
        first = self._sent.pop()[0] if self._sent and self._sent[-1][2] == velocity else now
        self._sent.append((first, now, velocity))

    def go_to(self, lat: float, lon: float, altitude_m: float, vehicle: VehicleState, now: float) -> None:
        """Add a leg from the vehicle's position to a point. The leg counts as a velocity of `LEG_MPS` towards the point."""
        if vehicle.lat is None or vehicle.lon is None:
            return
        east, north = LocalFrame(vehicle.lat, vehicle.lon).xy(lat, lon)
        share = LEG_MPS / max(math.hypot(east, north), 1e-3)
        sink = vehicle.altitude_m - altitude_m
        down = math.copysign(LEG_MPS, sink) if abs(sink) > LEVEL_M else 0.0
        self.fly((north * share, east * share, down), now)

    def since(self, earliest: float, measured: Velocity) -> tuple[Velocity, ...]:
        """Return the setpoints that the vehicle may still be reacting to, the latest last; drop older ones.

        Setpoints sent after `earliest` always count. The setpoint that was in force at `earliest` counts if the vehicle still
        reacts to it. A vehicle that slows down to a held velocity does not continue to brake. A vehicle that turns onto a leg
        does not continue in its measured direction.

        Args:
            earliest: Time on the clock of `fly`.
            measured: The vehicle's measured velocity.
        """
        while len(self._sent) > 1 and self._sent[1][0] < earliest:
            self._sent.popleft()
        if self._sent and self._sent[0][1] < earliest:
            setpoint = self._sent[0][2]
            if not _is_held(setpoint) and not is_turning(measured, setpoint):
                self._sent.popleft()
        return tuple(dict.fromkeys(velocity for *_, velocity in reversed(self._sent)))[::-1]


def _is_held(velocity: Velocity) -> bool:
    """Return True for a velocity that the vehicle holds, False for a stop or a leg."""
    return is_moving(velocity) and max(map(abs, velocity)) < LEG_MPS / 2


def is_turning(velocity: Velocity, setpoint: Velocity) -> bool:
    """Return True if a moving vehicle does not fly in the direction of its setpoint yet."""
    north, east, _ = velocity
    to_north, to_east, _ = setpoint
    length = math.hypot(to_north, to_east)
    if math.hypot(north, east) < STATIONARY_MPS or length < STATIONARY_MPS:
        return False
    along = (north * to_north + east * to_east) / length
    across = (north * to_east - east * to_north) / length
    return along < -TURNED_MPS or abs(across) > TURNED_MPS


def is_moving(velocity: Velocity) -> bool:
    """Return True if a vehicle with this velocity is not stationary."""
    north, east, down = velocity
    return math.hypot(north, east) >= STATIONARY_MPS or abs(down) >= STATIONARY_MPS

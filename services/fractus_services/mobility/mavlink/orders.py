"""What a vehicle was told of late: velocities and legs that its state may not show yet."""

from __future__ import annotations

import math
from collections import deque

from fractus_core.geo import LocalFrame
from fractus_core.policy.decision_types import STATIONARY_MPS

from fractus_services.mobility.autopilot import LEG_MPS, VehicleState

Velocity = tuple[float, float, float]

MAX_ORDERS = 200
"""More commands than can be given in the longest latency that is flown with."""

TURNED_MPS = 0.5
"""A vehicle that drifts no faster than this across its course has turned onto it."""

LEVEL_M = 0.3
"""A leg that ends this near to the present height neither climbs nor sinks."""


class Orders:
    """Velocities north, east and down, each with the moments at which it was sent first and last."""

    def __init__(self) -> None:
        self._sent: deque[tuple[float, float, Velocity]] = deque(maxlen=MAX_ORDERS)

    def fly(self, velocity: Velocity, now: float) -> None:
        """A velocity is sent."""
        first = self._sent.pop()[0] if self._sent and self._sent[-1][2] == velocity else now
        self._sent.append((first, now, velocity))

    def go_to(self, lat: float, lon: float, altitude_m: float, vehicle: VehicleState, now: float) -> None:
        """A leg is begun from where the vehicle is."""
        if vehicle.lat is None or vehicle.lon is None:
            return
        east, north = LocalFrame(vehicle.lat, vehicle.lon).xy(lat, lon)
        share, sink = LEG_MPS / max(math.hypot(east, north), 1e-3), vehicle.altitude_m - altitude_m
        down = math.copysign(LEG_MPS, sink) if abs(sink) > LEVEL_M else 0.0
        self.fly((north * share, east * share, down), now)

    def since(self, moment: float, moves_with: Velocity) -> tuple[Velocity, ...]:
        """What was sent after a moment, the latest last, and what is in force since before if it still acts; the rest is forgotten.

        A vehicle that slows down to a velocity to be held does not go on braking, and one that turns onto a leg does not fly on
        as it does now.

        Args:
            moment: by the clock of `fly`.
            moves_with: the vehicle's velocity as it is known.
        """
        while len(self._sent) > 1 and self._sent[1][0] < moment:
            self._sent.popleft()
        if self._sent and self._sent[0][1] < moment:
            order = self._sent[0][2]
            if not _holds(order) and not turns(moves_with, order):
                self._sent.popleft()
        return tuple(dict.fromkeys(velocity for *_, velocity in reversed(self._sent)))[::-1]


def _holds(velocity: Velocity) -> bool:
    """Whether it is a velocity to be held, neither a stop nor a leg."""
    return moves(velocity) and max(map(abs, velocity)) < LEG_MPS / 2


def turns(velocity: Velocity, order: Velocity) -> bool:
    """Whether a vehicle in motion does not yet fly in the direction that it was told to."""
    (north, east, _), (to_north, to_east, _) = velocity, order
    length = math.hypot(to_north, to_east)
    if math.hypot(north, east) < STATIONARY_MPS or length < STATIONARY_MPS:
        return False
    along, aside = (north * to_north + east * to_east) / length, (north * to_east - east * to_north) / length
    return along < -TURNED_MPS or abs(aside) > TURNED_MPS


def moves(velocity: Velocity) -> bool:
    """Whether a vehicle with this velocity does not stand."""
    north, east, down = velocity
    return math.hypot(north, east) >= STATIONARY_MPS or abs(down) >= STATIONARY_MPS

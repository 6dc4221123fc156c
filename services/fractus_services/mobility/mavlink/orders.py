"""What a vehicle was told of late: velocities and legs that its state may not show yet."""

from __future__ import annotations

import math
from collections import deque

from fractus_core.geo import LocalFrame
from fractus_core.policy.values import STANDING_MPS

from fractus_services.mobility.autopilot import LEG_MPS, VehicleState

Velocity = tuple[float, float, float]

MAX_ORDERS = 200
"""More commands than can be given in the longest latency that is flown with."""

LEVEL_M = 0.3
"""A leg that ends this near to the present height neither climbs nor sinks."""


class Orders:
    """Velocities north, east and down, each with the moment at which it was sent last."""

    def __init__(self) -> None:
        self._sent: deque[tuple[float, Velocity]] = deque(maxlen=MAX_ORDERS)

    def fly(self, velocity: Velocity, now: float) -> None:
        """A velocity is sent."""
        if self._sent and self._sent[-1][1] == velocity:
            self._sent.pop()
        self._sent.append((now, velocity))

    def go_to(self, lat: float, lon: float, altitude_m: float, vehicle: VehicleState, now: float) -> None:
        """A leg is begun from where the vehicle is."""
        if vehicle.lat is None or vehicle.lon is None:
            return
        east, north = LocalFrame(vehicle.lat, vehicle.lon).xy(lat, lon)
        share, sink = LEG_MPS / max(math.hypot(east, north), 1e-3), vehicle.altitude_m - altitude_m
        down = math.copysign(LEG_MPS, sink) if abs(sink) > LEVEL_M else 0.0
        self.fly((north * share, east * share, down), now)

    def since(self, moment: float) -> tuple[Velocity, ...]:
        """What was sent after a moment, the latest last, and a velocity that is in force since before; the rest is forgotten.

        A vehicle that slows down to that velocity does not go on braking.
        """
        while self._sent and self._sent[0][0] < moment and not (len(self._sent) == 1 and _holds(self._sent[0][1])):
            self._sent.popleft()
        return tuple(dict.fromkeys(velocity for _, velocity in reversed(self._sent)))[::-1]


def _holds(velocity: Velocity) -> bool:
    """Whether it is a velocity to be held, neither a stop nor a leg."""
    return moves(velocity) and max(map(abs, velocity)) < LEG_MPS / 2


def moves(velocity: Velocity) -> bool:
    """Whether a vehicle with this velocity does not stand."""
    north, east, down = velocity
    return math.hypot(north, east) >= STANDING_MPS or abs(down) >= STANDING_MPS

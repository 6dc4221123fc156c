"""Whether home has moved without a word: the news of that may be lost, while each position shows that heights count from elsewhere."""

from __future__ import annotations

import asyncio
import math
from contextlib import suppress
from typing import Protocol

from fractus_services.errors import AutopilotError
from fractus_services.mobility.mavlink.vehicle import Vehicle

JUMP_M = 1.0
"""Heights above home and above sea level are of one estimate: their difference changes only with home."""

AGAIN_S = 0.3
"""How long home may take that was asked for, and said to come, before it is taken for lost."""


class Asker(Protocol):
    """The autopilot, as far as home is asked of it."""

    vehicle: Vehicle

    @property
    def connected(self) -> bool:
        """Whether the vehicle is heard."""

    async def ask_home(self) -> None:
        """Ask for the home position now."""


class HomeWatch:
    """Compares each position with the one before, and asks for home until it is told.

    Where home is moved over ground alone, nothing but its own message tells.

    Args:
        autopilot: is asked.
    """

    def __init__(self, autopilot: Asker) -> None:
        self._autopilot = autopilot
        self._asking: asyncio.Task[None] | None = None
        self.forget()

    def forget(self) -> None:
        """The link broke: what is told next may be of another vehicle, or flight."""
        self._home_amsl_m = math.nan
        self._doubted = False

    def take(self, told: str) -> None:
        """The vehicle's state has taken a message of a kind."""
        vehicle = self._autopilot.vehicle
        if told == "HOME_POSITION":
            self._doubted = False
        elif told == "GLOBAL_POSITION_INT":
            amsl_m = vehicle.amsl_m - vehicle.altitude_m
            self._doubted = self._doubted or (vehicle.in_air and abs(amsl_m - self._home_amsl_m) > JUMP_M)
            self._home_amsl_m = amsl_m
        if self._doubted and self._autopilot.connected and (self._asking is None or self._asking.done()):
            self._asking = asyncio.get_running_loop().create_task(self._ask())

    async def _ask(self) -> None:
        with suppress(AutopilotError):
            await self._autopilot.ask_home()
        await asyncio.sleep(AGAIN_S)

"""How the autopilot flies during a mission, home by itself above all: as that and its limits ask for, and as its owner chose after it."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Callable
from pathlib import Path

from fractus_core.policy.return_route import ReturnBounds
from fractus_runtime.files import write_file

from fractus_services.errors import AutopilotError
from fractus_services.mobility.mavlink.autopilot import MavlinkAutopilot
from fractus_services.mobility.mavlink.parameters import same

log = logging.getLogger(__name__)


class MavlinkReturn:
    """Lowers height and speed of RTL and SmartRTL, and lets hold what a mission needs, see `ReturnLimits`. What the owner had is on disk before it is changed.

    Args:
        autopilot: the link.
        directory: the service's state directory.
    """

    def __init__(self, autopilot: MavlinkAutopilot, directory: Path) -> None:
        self._parameters = autopilot.vehicle_parameters
        self._stack = autopilot.stack
        self._names = (*self._stack.returning, *(setting.names for setting in self._stack.flown))
        self._path = directory / "return.json"
        self._lock = asyncio.Lock()
        self._owned = self._load()
        self._remember()

    @property
    def limited(self) -> bool:
        """Whether the vehicle has values of ours."""
        return bool(self._owned)

    async def limit(self, bounds: ReturnBounds) -> tuple[str, ...]:
        """Set what is above the bounds, and what was lowered more than they ask; what changed, in sentences.

        Raises:
            AutopilotError: it cannot be set, or the link broke.
            OSError: what the owner had cannot be stored.
        """
        async with self._lock:
            told = await self._parameters.read(self._names)
            # What the file says of another release's names is not this vehicle's.
            owned = told | {name: value for name, value in self._owned.items() if name in told}
            wanted = self._stack.return_values(owned, bounds) | self._flown(owned)
            changed = {name: value for name, value in wanted.items() if not same(told[name], value)}
            if changed:
                self._owned = {name: owned[name] for name in wanted}
                await asyncio.to_thread(write_file, self._path, json.dumps(self._owned).encode())
                self._remember()
                await self._set(changed)
            return tuple(f"{name} was {told[name]:g} and is {value:g}" for name, value in changed.items())

    async def lift(self, idle: Callable[[], bool]) -> None:
        """Put back what the owner had, if anything was changed.

        Args:
            idle: whether no mission needs the limits; asked when no other change of them is under way.

        Raises:
            AutopilotError: it cannot be; it is tried again next time.
        """
        async with self._lock:
            if not idle() or not self._owned:
                return
            told = await self._parameters.read(self._names)
            await self._set({name: value for name, value in self._owned.items() if name in told})
            await asyncio.to_thread(self._path.unlink, True)
            self._owned = {}
            self._remember()
            log.info("returning: as the vehicle's owner left it")

    def _flown(self, owned: dict[str, float]) -> dict[str, float]:
        """What must hold during a mission, as far as the vehicle has it; the owner's where that will do."""
        return {
            name: owned[name] if setting.holds(owned[name]) else setting.value
            for setting in self._stack.flown
            for name in setting.names
            if name in owned
        }

    async def _set(self, values: dict[str, float]) -> None:
        for name, value in values.items():
            after = await self._parameters.write(name, value)
            if not same(after, value):
                raise AutopilotError(f"{name} cannot be set to {value:g}; it stays {after:g}")
            log.info("returning: set (name=%s, value=%g)", name, value)

    def _remember(self) -> None:
        """Legs are flown with the owner's speed, as far as limits on them allow, not with that of the autopilot's return."""
        self._parameters.leg_speed = {n: v for n, v in self._owned.items() if n in self._stack.leg_speed}

    def _load(self) -> dict[str, float]:
        try:
            return {str(name): float(value) for name, value in json.loads(self._path.read_bytes()).items()}
        except FileNotFoundError:
            return {}
        except (ValueError, AttributeError, TypeError) as error:
            log.critical("returning: the owner's values are lost (file=%s, error=%s)", self._path, error)
            return {}

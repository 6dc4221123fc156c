"""Flight parameters of the autopilot during a mission, above all of RTL and SmartRTL; the owner's values are restored afterwards."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Callable
from pathlib import Path

from fractus_core.policy.return_route import ReturnBounds
from fractus_runtime.files import UnsuitableFile, read_json, write_file

from fractus_services.errors import AutopilotError
from fractus_services.mobility.mavlink.mavlink_autopilot import MavlinkAutopilot
from fractus_services.mobility.mavlink.parameters import same

log = logging.getLogger(__name__)


class RtlParameters:
    """Lowers altitude and speed of RTL and SmartRTL and sets the parameters that a mission needs, see `ReturnLimits`.

    The owner's values are stored on disk before they are changed.

    Args:
        autopilot: Link to the vehicle.
        directory: State directory of the service.
    """

    def __init__(self, autopilot: MavlinkAutopilot, directory: Path) -> None:
        self._parameters = autopilot.vehicle_parameters
        self._stack = autopilot.stack
        self._names = (*self._stack.returning, *(setting.names for setting in self._stack.mission_settings))
        self._path = directory / "return.json"
        self._lock = asyncio.Lock()
        self._owned = self._load()
        self._update_leg_speed()

    @property
    def limited(self) -> bool:
        """True while the vehicle has parameter values that this service set in place of the owner's values."""
        return bool(self._owned)

    async def limit(self, bounds: ReturnBounds) -> tuple[str, ...]:
        """Limit the parameters to the bounds, and undo unnecessary limits. Return the changes as sentences.

        Raises:
            AutopilotError: A parameter cannot be set, or the link broke.
            OSError: The owner's values cannot be stored.
        """
        async with self._lock:
            current = await self._parameters.read(self._names)
            # The firmware may have been replaced by another release since the values were stored.
            owned = current | self._stack.under_names_of(current, self._owned)
            values = self._stack.return_values(owned, bounds) | self._mission_values(owned)
            changed = {name: value for name, value in values.items() if not same(current[name], value)}
            if changed:
                self._owned = {name: owned[name] for name in values}
                await asyncio.to_thread(write_file, self._path, json.dumps(self._owned).encode())
                self._update_leg_speed()
                await self._set(changed)
            return tuple(f"{name} was {current[name]:g} and is {value:g}" for name, value in changed.items())

    async def lift(self, idle: Callable[[], bool]) -> None:
        """Restore the owner's values.

        Args:
            idle: Returns True if no mission needs the limits. Called while no other change is in progress.

        Raises:
            AutopilotError: A value cannot be restored. The next call tries again.
        """
        async with self._lock:
            if not idle() or not self._owned:
                return
            current = await self._parameters.read(self._names)
            await self._set(self._stack.under_names_of(current, self._owned))
            await asyncio.to_thread(self._path.unlink, True)
            self._owned = {}
            self._update_leg_speed()
            log.info("rtl: owner's parameters restored")

    def _mission_values(self, owned: dict[str, float]) -> dict[str, float]:
        """Return the values that a mission needs, for the parameters that the vehicle has. Suitable values of the owner stay."""
        return {
            name: owned[name] if setting.holds(owned[name]) else setting.value
            for setting in self._stack.mission_settings
            for name in setting.names
            if name in owned
        }

    async def _set(self, values: dict[str, float]) -> None:
        for name, value in values.items():
            after = await self._parameters.write(name, value)
            if not same(after, value):
                raise AutopilotError(f"{name} cannot be set to {value:g}; it remains {after:g}")
            log.info("rtl: parameter set (name=%s, value=%g)", name, value)

    def _update_leg_speed(self) -> None:
        """Use the owner's speed for legs. The same parameter of the vehicle now contains the limited speed of the return."""
        self._parameters.leg_speed = {
            name: value for name, value in self._owned.items() if name in self._stack.leg_speed
        }

    def _load(self) -> dict[str, float]:
        try:
            return {str(name): float(value) for name, value in read_json(self._path).items()}
        except FileNotFoundError:
            return {}
        except (UnsuitableFile, ValueError, AttributeError, TypeError) as error:
            log.critical(
                "rtl: cannot read the owner's parameters, they are lost (file=%s, error=%s)", self._path, error
            )
            return {}

"""The vehicle's own fence as the last line: raised around a mission's outer bounds, and put back as it was after it."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from fractus_core.api.plans import GrantSpec
from fractus_storage import write_file

from fractus_services.errors import AutopilotError
from fractus_services.mobility.mavlink.autopilot import MavlinkAutopilot
from fractus_services.mobility.mavlink.bounds import Bounds, Item, bounds_of
from fractus_services.mobility.mavlink.itemlists import NoLists, download, upload

log = logging.getLogger(__name__)

_RESTORE_TIMEOUT_S = 5.0
_CLOSE_E7 = 2
"""Autopilots that store floats give positions back a few centimetres off."""


@dataclass(frozen=True, slots=True)
class Owned:
    """The fence that the vehicle's owner left.

    Attributes:
        parameters: those that the vehicle has.
        items: its polygons and circles.
    """

    parameters: dict[str, float]
    items: tuple[Item, ...]


class MissionFence:
    """Raises and lowers the vehicle's fence. What the owner had is on disk before anything is changed.

    Where the owner's own fence is in force, it stays so: the mission's is added, and the lower ceiling counts.

    Args:
        autopilot: the link.
        directory: the service's state directory.

    Attributes:
        missing: why there is no fence; empty when the autopilot offers one.
    """

    def __init__(self, autopilot: MavlinkAutopilot, directory: Path) -> None:
        self._autopilot = autopilot
        self._stack = autopilot.stack
        self._path = directory / "fence.json"
        self._lock = asyncio.Lock()
        self.missing = ""

    @property
    def raised(self) -> bool:
        """Whether the vehicle has a fence of ours."""
        return self._path.exists()

    async def raise_around(self, spec: GrantSpec, *, retraces: bool) -> None:
        """Load the outer bounds of a grant, switch the fence on, and read all of it back.

        An autopilot without fences is left as it is, see `missing`.

        Args:
            spec: the grant.
            retraces: whether the vehicle that breaches it is to fly back the way it came.

        Raises:
            AutopilotError: the fence does not stand, or the motors run; the text says why.
            OSError: what the owner had cannot be stored.
        """
        bounds = bounds_of(spec)
        if bounds is None:
            return
        async with self._lock:
            if not await self._offered():
                return
            try:
                await self._raise(bounds, retraces)
            except NoLists as error:
                self._lacks(str(error))

    async def lower(self, idle: Callable[[], bool]) -> None:
        """Put back what the owner had, if anything was changed.

        Args:
            idle: whether no mission needs the fence; asked when no other change of it is under way.

        Raises:
            AutopilotError: it cannot be; it is tried again next time.
        """
        async with self._lock:
            owned = await asyncio.to_thread(self._load) if idle() else None
            if owned is None:
                return
            await self._put_back(owned)

    async def _offered(self) -> bool:
        """Whether the autopilot knows fences; only one that answers other questions surely does not."""
        if await self._autopilot.read_parameter(self._stack.fence_switch) is not None:
            self.missing = ""
            return True
        if await self._autopilot.read_parameter(self._stack.witness) is None:
            raise AutopilotError("the autopilot stopped answering while its fence was asked for", link=True)
        self._lacks(f"the autopilot has no {self._stack.fence_switch}")
        return False

    def _lacks(self, why: str) -> None:
        self.missing = why
        log.warning("fence: the vehicle has none of its own as a last line (reason=%s)", why)

    async def _raise(self, bounds: Bounds, retraces: bool) -> None:
        owned = await asyncio.to_thread(self._load)
        if owned is None:
            owned = await self._read()
            await asyncio.to_thread(self._store, owned)
        switch = self._stack.fence_switch
        kept = owned.items if owned.parameters.get(switch, 0.0) else ()
        if self._autopilot.vehicle.armed:
            raise AutopilotError("the motors run; the fence stays as it is")
        # ArduPilot works out which kinds of fence are in force when it is switched on, and not again: so off first.
        try:
            await self._set({switch: 0.0})
            await self._write((*kept, *bounds.items))
            await self._set(
                self._stack.fence_values(
                    owned.parameters, ceiling_m=bounds.altitude_m, polygon=bool(bounds.items), retraces=retraces
                )
            )
        except (AutopilotError, asyncio.CancelledError):
            await self._recover(owned)
            raise
        log.info("fence: raised (vertices=%d, ceiling_m=%s)", len(bounds.items), bounds.altitude_m)

    async def _recover(self, owned: Owned) -> None:
        """After a failure, put back what the owner had if that is possible at once; `lower` tries again later."""
        try:
            async with asyncio.timeout(_RESTORE_TIMEOUT_S):
                await self._put_back(owned)
        except (AutopilotError, OSError) as error:
            log.warning("fence: the owner's is not put back yet (error=%s)", str(error) or "it takes too long")

    async def _put_back(self, owned: Owned) -> None:
        await self._set({self._stack.fence_switch: 0.0})
        await self._write(owned.items)
        await self._set(owned.parameters)
        await asyncio.to_thread(self._path.unlink, True)
        log.info("fence: as its owner left it")

    async def _read(self) -> Owned:
        found = {name: await self._autopilot.read_parameter(name) for name in self._stack.fence_parameters}
        parameters = {name: value for name, value in found.items() if value is not None}
        return Owned(parameters, await download(self._autopilot))

    async def _write(self, items: Sequence[Item]) -> None:
        await upload(self._autopilot, items)
        stored = await download(self._autopilot)
        if not _same(stored, items):
            raise AutopilotError(
                f"the autopilot stores {len(stored)} fence items that are not the {len(items)} it was sent"
            )

    async def _set(self, values: dict[str, float]) -> None:
        for name in self._stack.fence_parameters:
            if name not in values or await self._autopilot.read_parameter(name) == values[name]:
                continue
            if name == self._stack.fence_switch and not values[name] and self._autopilot.vehicle.armed:
                raise AutopilotError("the motors run; the fence is not switched off")
            after = await self._autopilot.write_parameter(name, values[name])
            if after is None or abs(after - values[name]) > 1e-3 * max(1.0, abs(values[name])):
                raise AutopilotError(f"{name} cannot be set to {values[name]:g}; it stays {after}")

    def _load(self) -> Owned | None:
        try:
            stored = json.loads(self._path.read_bytes())
            return Owned(dict(stored["parameters"]), tuple(Item(**item) for item in stored["items"]))
        except FileNotFoundError:
            return None
        except (ValueError, KeyError, TypeError) as error:
            log.critical(
                "fence: the owner's is not put back, its file cannot be read (file=%s, error=%s)", self._path, error
            )
            return None

    def _store(self, owned: Owned) -> None:
        write_file(self._path, json.dumps(asdict(owned)).encode())


def _same(stored: Sequence[Item], sent: Sequence[Item]) -> bool:
    return len(stored) == len(sent) and all(
        a.command == b.command
        and abs(a.param1 - b.param1) < 1e-3
        and abs(a.lat_e7 - b.lat_e7) <= _CLOSE_E7
        and abs(a.lon_e7 - b.lon_e7) <= _CLOSE_E7
        for a, b in zip(stored, sent, strict=True)
    )

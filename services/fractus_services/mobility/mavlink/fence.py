"""The vehicle's own fence as the last line: raised around a mission's outer bounds, and put back as it was after it."""

from __future__ import annotations

import asyncio
import json
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from fractus_core.api.grants import GrantSpec
from fractus_runtime.files import remove_temporary, write_file
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.errors import AutopilotError
from fractus_services.mobility.mavlink.autopilot import MavlinkAutopilot
from fractus_services.mobility.mavlink.bounds import MAX_VERTICES, Bounds, Item, bounds_of
from fractus_services.mobility.mavlink.itemlists import NoLists, NoSpace, download, upload
from fractus_services.mobility.mavlink.parameters import same

log = logging.getLogger(__name__)

_RESTORE_TIMEOUT_S = 5.0
ITEMS_AGAIN_S = 60.0
"""In flight the items are read again after this time: of others in their place, as many as there were, no message tells."""

_SWITCHED = mavlink.FENCE_TYPE_ALT_MAX | mavlink.FENCE_TYPE_CIRCLE | mavlink.FENCE_TYPE_POLYGON
"""Without the floor, which the autopilot switches by itself."""

_CLOSE_E7 = 2
"""Autopilots that store floats give positions back a few centimetres off."""


@dataclass(frozen=True, slots=True)
class Owned:
    """The fence that the vehicle's owner left.

    Attributes:
        parameters: those that the vehicle has.
        items: its polygons and circles.
        raised: the parameters of the mission's fence, once that stands.
        around: its items, beside those of the owner that are in force; None of a fence that an older release raised.
    """

    parameters: dict[str, float]
    items: tuple[Item, ...]
    raised: dict[str, float] = field(default_factory=dict)
    around: tuple[Item, ...] | None = None


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
        self._parameters = autopilot.vehicle_parameters
        self._path = directory / "fence.json"
        self._lock = asyncio.Lock()
        self._standing: tuple[Bounds, bool] | None = None
        self._compared_at = self._switched_at = -math.inf
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
                await self._raise(spec, bounds, retraces)
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

    async def hold(self) -> tuple[str, ...]:
        """Set back what another station changed of the fence that is raised; what that was, in sentences.

        Raises:
            AutopilotError: it cannot be, or the vehicle has other fence items by now.
        """
        async with self._lock:
            owned = await asyncio.to_thread(self._load)
            if owned is None or not owned.raised:
                return ()
            return await self._keep(owned)

    async def _keep(self, owned: Owned) -> tuple[str, ...]:
        raised, total = owned.raised, self._stack.fence_total
        changed = await self._set(raised) + await self._switch_on()
        if total in raised:
            items = (await self._parameters.read([(total,)])).get(total, 0.0)
            if items != raised[total]:
                raise AutopilotError(
                    f"another station changed its fence, which has {items:g} items and had {raised[total]:g}"
                )
        if owned.around is not None and self._autopilot.now - self._compared_at >= ITEMS_AGAIN_S:
            if not _same(await download(self._autopilot), owned.around):
                raise AutopilotError("another station changed its fence, which has other items than were loaded")
            self._compared_at = self._autopilot.now
        return changed

    async def _switch_on(self) -> tuple[str, ...]:
        """Switch on the fence that a command of another station, or a radio's switch, switched off: no parameter tells of that.

        Not while the autopilot comes down, which may do so itself, nor under a pilot, whose switch it is.
        """
        vehicle = self._autopilot.vehicle
        left_alone = vehicle.armed and not vehicle.mode.commanded
        if vehicle.fenced is not False or vehicle.checks_at <= self._switched_at or left_alone:
            return ()
        await self._autopilot.command(mavlink.MAV_CMD_DO_FENCE_ENABLE, 1, _SWITCHED)
        self._switched_at = self._autopilot.now
        return ("the fence was switched off and is on",)

    async def _offered(self) -> bool:
        """Whether the autopilot knows fences."""
        if await self._parameters.read([(self._stack.fence_switch,)]):
            self.missing = ""
            return True
        self._lacks(f"the autopilot has no {self._stack.fence_switch}")
        return False

    def _lacks(self, why: str) -> None:
        self.missing = why
        log.warning("fence: the vehicle has none of its own as a last line (reason=%s)", why)

    async def _raise(self, spec: GrantSpec, bounds: Bounds, retraces: bool) -> None:
        owned = await asyncio.to_thread(self._load)
        if owned is None:
            owned = await self._read()
            await asyncio.to_thread(self._store, owned)
        switch = self._stack.fence_switch
        kept = owned.items if owned.parameters.get(switch, 0.0) else ()
        if self._autopilot.vehicle.armed:
            raise AutopilotError("the motors run; the fence stays as it is")
        if self._standing == (bounds, retraces) and await self._stands(owned):
            return
        self._standing = None
        # ArduPilot works out which kinds of fence are in force when it is switched on, and not again: so off first.
        try:
            await self._set({switch: 0.0})
            around = await self._load_around(spec, kept)
            values = self._stack.fence_values(
                owned.parameters, ceiling_m=bounds.altitude_m, polygon=bool(bounds.items), retraces=retraces
            )
            await self._set(values)
            total = await self._parameters.read([(self._stack.fence_total,)])
            await asyncio.to_thread(self._store, replace(owned, raised=values | total, around=around))
            self._standing = bounds, retraces
            self._compared_at = self._switched_at = self._autopilot.now
        except (AutopilotError, asyncio.CancelledError):
            await self._recover(owned)
            raise
        log.info("fence: raised (vertices=%d, ceiling_m=%s)", len(around) - len(kept), bounds.altitude_m)

    async def _load_around(self, spec: GrantSpec, kept: Sequence[Item]) -> tuple[Item, ...]:
        """Load the outer bounds beside what is kept, with fewer vertices where the vehicle has no space; what was loaded."""
        tried = -1
        for vertices in MAX_VERTICES:
            bounds = bounds_of(spec, vertices)
            items = bounds.items if bounds is not None else ()
            if len(items) == tried:
                continue
            tried = len(items)
            try:
                await self._write((*kept, *items))
            except NoSpace as error:
                log.warning("fence: too many items (vertices=%d, kept=%d, error=%s)", tried, len(kept), error)
                refused = error
            else:
                return (*kept, *items)
        raise refused

    async def _stands(self, owned: Owned) -> bool:
        """Whether the fence is as it was raised before: arming that is tried again need not load it again."""
        try:
            self._compared_at = -math.inf
            await self._keep(owned)
        except AutopilotError as error:
            if error.link:
                raise
            return False
        return True

    async def _recover(self, owned: Owned) -> None:
        """After a failure, put back what the owner had if that is possible at once; `lower` tries again later."""
        try:
            async with asyncio.timeout(_RESTORE_TIMEOUT_S):
                await self._put_back(owned)
        except (AutopilotError, OSError) as error:
            log.warning("fence: the owner's is not put back yet (error=%s)", str(error) or "it takes too long")

    async def _put_back(self, owned: Owned) -> None:
        self._standing = None
        await self._set({self._stack.fence_switch: 0.0})
        await self._write(owned.items)
        await self._set(owned.parameters)
        await asyncio.to_thread(self._path.unlink, True)
        log.info("fence: as its owner left it")

    async def _read(self) -> Owned:
        parameters = await self._parameters.read([(name,) for name in self._stack.fence_parameters])
        return Owned(parameters, await download(self._autopilot))

    async def _write(self, items: Sequence[Item]) -> None:
        await upload(self._autopilot, items)
        stored = await download(self._autopilot)
        if not _same(stored, items):
            raise AutopilotError(
                f"the autopilot stores {len(stored)} fence items that are not the {len(items)} it was sent"
            )

    async def _set(self, values: Mapping[str, float]) -> tuple[str, ...]:
        """Set parameters of the fence in their order, those that differ; which, in sentences.

        Raises:
            AutopilotError: one cannot be set, or the motors run and the fence would be switched off.
        """
        told = await self._parameters.read([(name,) for name in values])
        changed = []
        for name in self._stack.fence_parameters:
            if name not in values or same(told.get(name, math.nan), values[name]):
                continue
            if name == self._stack.fence_switch and not values[name] and self._autopilot.vehicle.armed:
                raise AutopilotError("the motors run; the fence is not switched off")
            after = await self._parameters.write(name, values[name])
            if not same(after, values[name]):
                raise AutopilotError(f"{name} cannot be set to {values[name]:g}; it stays {after:g}")
            changed.append(f"{name} was {told.get(name, math.nan):g} and is {after:g}")
        return tuple(changed)

    def _load(self) -> Owned | None:
        remove_temporary(self._path)
        try:
            stored = json.loads(self._path.read_bytes())
            items, around = (
                tuple(Item(**item) for item in found) if found is not None else None
                for found in (stored["items"], stored.get("around"))
            )
            return Owned(dict(stored["parameters"]), items or (), stored.get("raised", {}), around)
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

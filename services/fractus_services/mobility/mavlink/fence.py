"""The vehicle's own geofence as the last line of defence: raised around a mission's outer bounds, and restored afterwards."""

from __future__ import annotations

import asyncio
import json
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import shapely
from fractus_core.api.grants import GrantSpec
from fractus_core.geo import LocalFrame, area_center, area_polygon
from fractus_runtime.files import UnsuitableFile, read_json, remove_temporary, write_file
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.errors import AutopilotError
from fractus_services.mobility.mavlink.mavlink_autopilot import MavlinkAutopilot
from fractus_services.mobility.mavlink.mission_protocol import ItemsUnsupported, MissionItem, NoSpace, download, upload
from fractus_services.mobility.mavlink.parameters import same

log = logging.getLogger(__name__)

_RESTORE_TIMEOUT_S = 5.0
ITEMS_AGAIN_S = 60.0
"""Interval at which the fence items are read in flight, in seconds.

Reading them detects that another station replaced them by the same number of items.
"""

_SWITCHED = mavlink.FENCE_TYPE_ALT_MAX | mavlink.FENCE_TYPE_CIRCLE | mavlink.FENCE_TYPE_POLYGON
"""All fence types except the minimum altitude, which the autopilot enables automatically."""

_CLOSE_E7 = 2
"""Tolerated difference of positions, degrees times 1e7. Autopilots that store floats are off by a few centimetres."""


FENCE_MARGIN_M = 10.0
"""Margin between the granted area and the fence, in metres. The service's own monitor acts long before the fence."""

CEILING_MARGIN_M = 5.0
"""Margin between the maximum altitude of the grant and the ceiling of the fence, in metres."""

MAX_VERTICES = (60, 30, 15, 8, 4)
"""Maximum numbers of vertices of the polygon.

They are tried in this order until the polygon fits. The capacity depends on the autopilot's board and on the owner's
fence.
"""

_SIMPLER_M = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)


@dataclass(frozen=True, slots=True)
class FenceBounds:
    """Outer bounds that the vehicle itself must not leave.

    Attributes:
        items: Vertices of the polygon; empty if the grant has no area.
        altitude_m: Altitude above home; None if the grant has no limit.
    """

    items: tuple[MissionItem, ...]
    altitude_m: float | None


def fence_bounds(spec: GrantSpec, vertices: int = MAX_VERTICES[0]) -> FenceBounds | None:
    """Return the outer bounds of operation area, corridor and airframe, with a margin; None if the grant has no bounds.

    A vehicle must be inside every inclusion polygon of its fence. Areas that do not touch are therefore replaced by their convex
    hull.

    Args:
        spec: Specification of the Grant.
        vertices: Maximum number of vertices, at least 4. With fewer vertices, the polygon is larger and never smaller.
    """
    altitude = spec.limits.max_altitude + CEILING_MARGIN_M if spec.limits is not None else None
    items: tuple[MissionItem, ...] = ()
    if spec.operation_area:
        frame = LocalFrame.at(area_center(spec.operation_area[0]))
        whole = shapely.union_all([area_polygon(frame, area) for area in (*spec.operation_area, *spec.corridor)])
        corners = [frame.latlon(x, y) for x, y in list(_outline(whole, vertices).exterior.coords)[:-1]]
        count = len(corners)
        items = tuple(
            MissionItem(
                mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION, float(count), round(lat * 1e7), round(lon * 1e7)
            )
            for lat, lon in corners
        )
    return FenceBounds(items, altitude) if items or altitude is not None else None


def _outline(whole: shapely.Geometry, vertices: int) -> shapely.Polygon:
    """Return a polygon with at most `vertices` vertices that contains a geometry and its margin.

    Several simplified outlines are computed. The outline with the smallest area is returned.
    """
    outlines: list[shapely.Geometry] = []
    for simpler_m in _SIMPLER_M:
        # Simplification may shrink the shape by about its tolerance, so it is enlarged by the tolerance first.
        grown = whole.buffer(FENCE_MARGIN_M + simpler_m, join_style="mitre", mitre_limit=2.0).simplify(simpler_m)
        outlines += [grown, grown.convex_hull]
    box = whole.buffer(FENCE_MARGIN_M + _SIMPLER_M[0]).minimum_rotated_rectangle
    rings = [shapely.Polygon(outline.exterior) for outline in (*outlines, box) if isinstance(outline, shapely.Polygon)]
    # GEOS may also drop the first corner of a ring. Such a ring may be too small and is rejected here.
    candidates = (ring for ring in rings if ring.exterior.distance(whole) >= FENCE_MARGIN_M)
    return min(
        (ring for ring in candidates if len(ring.exterior.coords) - 1 <= vertices), key=lambda ring: float(ring.area)
    )


@dataclass(frozen=True, slots=True)
class OwnerFence:
    """The fence of the vehicle's owner.

    Attributes:
        parameters: Fence parameters that the vehicle has.
        items: Polygons and circles.
        raised: Fence parameters during the mission. Empty before the mission's fence is raised.
        mission_items: Items of the mission's fence, including active items of the owner. None for a fence that an older release
            raised.
    """

    parameters: dict[str, float]
    items: tuple[MissionItem, ...]
    raised: dict[str, float] = field(default_factory=dict)
    mission_items: tuple[MissionItem, ...] | None = None


class MissionFence:
    """Raises and lowers the vehicle's fence. The owner's fence is stored on disk before the first change.

    An active fence of the owner stays active: the mission's fence is added to it, and the lower ceiling applies.

    Args:
        autopilot: Link to the vehicle.
        directory: State directory of the service.

    Attributes:
        missing: Reason why the vehicle has no fence; empty if it has one.
    """

    def __init__(self, autopilot: MavlinkAutopilot, directory: Path) -> None:
        self._autopilot = autopilot
        self._stack = autopilot.stack
        self._parameters = autopilot.vehicle_parameters
        self._path = directory / "fence.json"
        self._lock = asyncio.Lock()
        self._raised_bounds: tuple[FenceBounds, bool] | None = None
        self._compared_at = self._switched_at = -math.inf
        self.missing = ""

    @property
    def raised(self) -> bool:
        """True while the vehicle has a fence that this service set."""
        return self._path.exists()

    async def raise_around(self, spec: GrantSpec, *, retraces: bool) -> None:
        """Load the outer bounds of a grant, enable the fence, and verify everything by reading it back.

        If the autopilot does not support fences, nothing is changed, and `missing` contains the reason.

        Args:
            spec: Specification of the Grant.
            retraces: True if a vehicle that breaches the fence should return along its path.

        Raises:
            AutopilotError: The fence is not raised, or the motors run. The text states the reason.
            OSError: The owner's fence cannot be stored.
        """
        bounds = fence_bounds(spec)
        if bounds is None:
            return
        async with self._lock:
            if not await self._is_supported():
                return
            try:
                await self._raise(spec, bounds, retraces)
            except ItemsUnsupported as error:
                self._set_missing(str(error))

    async def lower(self, idle: Callable[[], bool]) -> None:
        """Restore the owner's fence.

        Args:
            idle: Returns True if no mission needs the fence. Called while no other change is in progress.

        Raises:
            AutopilotError: The fence cannot be restored. The next call tries again.
        """
        async with self._lock:
            owned = await asyncio.to_thread(self._load) if idle() else None
            if owned is None:
                return
            await self._restore(owned)

    async def hold(self) -> tuple[str, ...]:
        """Revert changes that another station made to the raised fence. Return a description of each change.

        Raises:
            AutopilotError: The fence cannot be restored, or the vehicle has other fence items.
        """
        async with self._lock:
            owned = await asyncio.to_thread(self._load)
            if owned is None or not owned.raised:
                return ()
            return await self._revert_changes(owned)

    async def _revert_changes(self, owned: OwnerFence) -> tuple[str, ...]:
        raised = owned.raised
        total = self._stack.fence_total
        changed = await self._set(raised) + await self._switch_on()
        if total in raised:
            items = (await self._parameters.read([(total,)])).get(total, 0.0)
            if items != raised[total]:
                raise AutopilotError(f"another station changed its fence from {raised[total]:g} to {items:g} items")
        if owned.mission_items is not None and self._autopilot.now - self._compared_at >= ITEMS_AGAIN_S:
            if not _same(await download(self._autopilot), owned.mission_items):
                raise AutopilotError("another station replaced the items of its fence")
            self._compared_at = self._autopilot.now
        return changed

    async def _switch_on(self) -> tuple[str, ...]:
        """Enable the fence again if a command of another station or a switch of the radio disabled it. No parameter shows this.

        The fence stays disabled while a pilot flies, and while the autopilot lands or returns, because it may have disabled the fence
        itself.
        """
        vehicle = self._autopilot.vehicle
        left_alone = vehicle.armed and not vehicle.mode.commanded
        if vehicle.fence_enabled is not False or vehicle.checks_at <= self._switched_at or left_alone:
            return ()
        await self._autopilot.command(mavlink.MAV_CMD_DO_FENCE_ENABLE, 1, _SWITCHED)
        self._switched_at = self._autopilot.now
        return ("the fence was disabled and is enabled again",)

    async def _is_supported(self) -> bool:
        """Return True if the autopilot supports fences."""
        if await self._parameters.read([(self._stack.fence_switch,)]):
            self.missing = ""
            return True
        self._set_missing(f"the autopilot has no {self._stack.fence_switch}")
        return False

    def _set_missing(self, reason: str) -> None:
        self.missing = reason
        log.warning("fence: not supported by the vehicle (reason=%s)", reason)

    async def _raise(self, spec: GrantSpec, bounds: FenceBounds, retraces: bool) -> None:
        owned = await asyncio.to_thread(self._load)
        if owned is None:
            owned = await self._read()
            await asyncio.to_thread(self._store, owned)
        switch = self._stack.fence_switch
        kept = owned.items if owned.parameters.get(switch, 0.0) else ()
        if self._autopilot.vehicle.armed:
            raise AutopilotError("the motors are running; the fence cannot be changed")
        if self._raised_bounds == (bounds, retraces) and await self._is_raised(owned):
            return
        self._raised_bounds = None
        # ArduPilot reads the fence types only when the fence is enabled, so disable it first.
        try:
            await self._set({switch: 0.0})
            mission_items = await self._load_around(spec, kept)
            values = self._stack.fence_values(
                owned.parameters, ceiling_m=bounds.altitude_m, polygon=bool(bounds.items), retraces=retraces
            )
            await self._set(values)
            total = await self._parameters.read([(self._stack.fence_total,)])
            await asyncio.to_thread(self._store, replace(owned, raised=values | total, mission_items=mission_items))
            self._raised_bounds = bounds, retraces
            self._compared_at = self._switched_at = self._autopilot.now
        except (AutopilotError, asyncio.CancelledError):
            await self._recover(owned)
            raise
        log.info("fence: raised (vertices=%d, ceiling_m=%s)", len(mission_items) - len(kept), bounds.altitude_m)

    async def _load_around(self, spec: GrantSpec, kept: Sequence[MissionItem]) -> tuple[MissionItem, ...]:
        """Load the outer bounds in addition to the kept items. Reduce the number of vertices if the capacity is exceeded.

        Returns:
            The loaded items.
        """
        tried = -1
        for vertices in MAX_VERTICES:
            bounds = fence_bounds(spec, vertices)
            items = bounds.items if bounds is not None else ()
            if len(items) == tried:
                continue
            tried = len(items)
            try:
                await self._write((*kept, *items))
            except NoSpace as error:
                log.warning(
                    "fence: item list exceeds the capacity (vertices=%d, kept=%d, error=%s)", tried, len(kept), error
                )
                refused = error
            else:
                return (*kept, *items)
        raise refused

    async def _is_raised(self, owned: OwnerFence) -> bool:
        """Return True if the fence of an earlier arming attempt is still raised. It is then not loaded again."""
        try:
            self._compared_at = -math.inf
            await self._revert_changes(owned)
        except AutopilotError as error:
            if error.link:
                raise
            return False
        return True

    async def _recover(self, owned: OwnerFence) -> None:
        """Try to restore the owner's fence after a failure. If that fails, `lower` tries again later."""
        try:
            async with asyncio.timeout(_RESTORE_TIMEOUT_S):
                await self._restore(owned)
        except (AutopilotError, OSError) as error:
            log.warning("fence: owner's fence not restored yet (error=%s)", str(error) or "timeout")

    async def _restore(self, owned: OwnerFence) -> None:
        """Restore the owner's fence. The owner's enabled fence is not disabled before everything else is restored.

        If a parameter was restored, the fence is then disabled and enabled again. If the service ends between the two, the
        fence stays disabled until the next start of the service. That start continues to restore the owner's fence, because
        the owner's fence stays on disk until the end.
        """
        self._raised_bounds = None
        if self._autopilot.vehicle.armed:
            raise AutopilotError("the motors are running; the fence cannot be changed")
        switch = self._stack.fence_switch
        if not owned.parameters.get(switch, 0.0):
            await self._set({switch: 0.0})
        await self._write(owned.items)
        others = {name: value for name, value in owned.parameters.items() if name != switch}
        if await self._set(others) and owned.parameters.get(switch, 0.0):
            await self._set({switch: 0.0})  # ArduPilot reads the fence types only when the fence is enabled.
        await self._set(owned.parameters)
        await asyncio.to_thread(self._path.unlink, True)
        log.info("fence: owner's fence restored")

    async def _read(self) -> OwnerFence:
        parameters = await self._parameters.read([(name,) for name in self._stack.fence_parameters])
        return OwnerFence(parameters, await download(self._autopilot))

    async def _write(self, items: Sequence[MissionItem]) -> None:
        await upload(self._autopilot, items)
        stored = await download(self._autopilot)
        if not _same(stored, items):
            raise AutopilotError(
                f"the autopilot stored {len(stored)} fence items that differ from the {len(items)} items sent"
            )

    async def _set(self, values: Mapping[str, float]) -> tuple[str, ...]:
        """Set the fence parameters that differ, in their order, and return the changes as sentences.

        Raises:
            AutopilotError: A parameter cannot be set, or the fence would be disabled while the motors run.
        """
        current = await self._parameters.read([(name,) for name in values])
        changed = []
        for name in self._stack.fence_parameters:
            if name not in values or same(current.get(name, math.nan), values[name]):
                continue
            if name == self._stack.fence_switch and not values[name] and self._autopilot.vehicle.armed:
                raise AutopilotError("the motors are running; the fence cannot be disabled")
            after = await self._parameters.write(name, values[name])
            if not same(after, values[name]):
                raise AutopilotError(f"{name} cannot be set to {values[name]:g}; it remains {after:g}")
            changed.append(f"{name} was {current.get(name, math.nan):g} and is {after:g}")
        return tuple(changed)

    def _load(self) -> OwnerFence | None:
        remove_temporary(self._path)
        try:
            stored = read_json(self._path)
            items = tuple(MissionItem(**item) for item in stored["items"])
            mission_items = None
            if stored.get("mission_items") is not None:
                mission_items = tuple(MissionItem(**item) for item in stored["mission_items"])
            return OwnerFence(dict(stored["parameters"]), items, stored.get("raised", {}), mission_items)
        except FileNotFoundError:
            return None
        except (UnsuitableFile, ValueError, KeyError, TypeError, AttributeError) as error:
            log.critical(
                "fence: cannot restore the owner's fence, its file is invalid (file=%s, error=%s)", self._path, error
            )
            return None

    def _store(self, owned: OwnerFence) -> None:
        write_file(self._path, json.dumps(asdict(owned)).encode())


def _same(stored: Sequence[MissionItem], sent: Sequence[MissionItem]) -> bool:
    return len(stored) == len(sent) and all(
        a.command == b.command
        and abs(a.param1 - b.param1) < 1e-3
        and abs(a.lat_e7 - b.lat_e7) <= _CLOSE_E7
        and abs(a.lon_e7 - b.lon_e7) <= _CLOSE_E7
        for a, b in zip(stored, sent, strict=True)
    )

"""What storing a list of items changes on the vehicle: mission, fence and rally points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import assert_never

from fractus_vehicle.earth import Place
from fractus_vehicle.fence import FenceItem, FenceShapeError, build_shapes
from fractus_vehicle.mav import MissionKind, MissionResult, Mode, Severity
from fractus_vehicle.mission_items import Item, ItemStore, home_item
from fractus_vehicle.state import VehicleState


def stores_of(v: VehicleState) -> dict[MissionKind, ItemStore]:
    """The three lists of one vehicle."""
    return {store.kind: store for store in (v.mission.store, v.fence_items, v.rally)}


def restore(v: VehicleState, kept: VehicleState) -> None:
    """Take over the lists that were stored before a reboot."""
    for mine, theirs in zip(stores_of(v).values(), stores_of(kept).values(), strict=True):
        if theirs.items:
            replace_items(v, mine, list(theirs.items))


def replace_items(v: VehicleState, store: ItemStore, items: list[Item]) -> MissionResult:
    """Store a list in place of what is there, unless the vehicle cannot use it."""
    result = _accept(v, store.kind, items)
    if result is MissionResult.ACCEPTED:
        store.items = items
    return result


def _accept(v: VehicleState, kind: MissionKind, items: list[Item]) -> MissionResult:
    match kind:
        case MissionKind.MISSION:
            if items and v.home is not None:
                items[0] = home_item(v.home)
            v.params.assign("MIS_TOTAL", len(items))
            if v.mode is not Mode.AUTO:
                v.mission.rewind()
        case MissionKind.FENCE:
            try:
                v.fence.shapes = build_shapes(_local(v, items))
            except FenceShapeError as error:
                v.say(Severity.WARNING, f"Fence: {error}")
                return MissionResult.INVALID
            v.params.assign("FENCE_TOTAL", len(items))
        case MissionKind.RALLY:
            v.params.assign("RALLY_TOTAL", len(items))
        case _:
            assert_never(kind)
    return MissionResult.ACCEPTED


def _local(v: VehicleState, items: Sequence[Item]) -> list[FenceItem]:
    local = []
    for item in items:
        north, east, _ = v.start.vector_to(Place(item.x, item.y, 0.0))
        local.append(FenceItem(item.command, item.param1, north, east))
    return local

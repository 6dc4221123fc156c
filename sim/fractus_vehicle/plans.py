"""What storing a list of items changes on the vehicle: mission, fence and rally points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import assert_never

from fractus_mavlink.enums import COPTER_MODE, MAV_MISSION_RESULT, MAV_MISSION_TYPE, MAV_SEVERITY, MISSION_STATE

from fractus_vehicle.earth import Place, valid_coordinates
from fractus_vehicle.fence import FenceItem, FenceShapeError, build_shapes
from fractus_vehicle.mission_items import Item, ItemStore, home_item
from fractus_vehicle.state import VehicleState


def stores_of(v: VehicleState) -> dict[MAV_MISSION_TYPE, ItemStore]:
    """The three lists of one vehicle."""
    return {store.kind: store for store in (v.mission.store, v.fence_items, v.rally)}


def restore(v: VehicleState, kept: VehicleState) -> None:
    """Take over the lists that were stored before a reboot."""
    for mine, theirs in zip(stores_of(v).values(), stores_of(kept).values(), strict=True):
        if theirs.items:
            replace_items(v, mine, list(theirs.items))


def replace_items(v: VehicleState, store: ItemStore, items: list[Item]) -> MAV_MISSION_RESULT:
    """Store a list in place of what is there, unless the vehicle cannot use it."""
    result = _accept(v, store.kind, items)
    if result is MAV_MISSION_RESULT.ACCEPTED:
        store.items = items
    return result


def clear_items(v: VehicleState, store: ItemStore) -> MAV_MISSION_RESULT:
    """Empty a list; a mission is kept while it is flown."""
    if store.kind is MAV_MISSION_TYPE.MISSION and v.armed and v.mission.state(v.mode) is MISSION_STATE.ACTIVE:
        return MAV_MISSION_RESULT.ERROR
    return replace_items(v, store, [])


def _accept(v: VehicleState, kind: MAV_MISSION_TYPE, items: list[Item]) -> MAV_MISSION_RESULT:
    match kind:
        case MAV_MISSION_TYPE.MISSION:
            if items and v.home is not None:
                items[0] = home_item(v.home)
            v.params.assign("MIS_TOTAL", len(items))
            if v.mode is not COPTER_MODE.AUTO:
                v.mission.rewind()
        case MAV_MISSION_TYPE.FENCE:
            try:
                v.fence.shapes = build_shapes(_local(v, items))
            except FenceShapeError as error:
                severity = MAV_SEVERITY.INFO if "item count" in str(error) else MAV_SEVERITY.WARNING
                v.say(severity, str(error))
                v.say(MAV_SEVERITY.WARNING, "Fence validation failed")
                return MAV_MISSION_RESULT.ERROR
            v.params.assign("FENCE_TOTAL", len(items))
        case MAV_MISSION_TYPE.RALLY:
            v.params.assign("RALLY_TOTAL", len(items))
        case MAV_MISSION_TYPE.ALL:
            raise ValueError("plans: a list has one kind; only MISSION_CLEAR_ALL names all of them")
        case _:
            assert_never(kind)
    return MAV_MISSION_RESULT.ACCEPTED


def _local(v: VehicleState, items: Sequence[Item]) -> list[FenceItem]:
    local = []
    for item in items:
        north, east, _ = v.start.vector_to(Place(item.x, item.y, 0.0))
        local.append(FenceItem(item.command, item.param1, north, east, valid_coordinates(item.x, item.y)))
    return local

"""Storage of missions, fences and rally points, with their effects on the vehicle."""

from __future__ import annotations

from collections.abc import Sequence

from fractus_services.mavlink_server.coordinates import valid_coordinates
from fractus_services.mavlink_server.fence_shapes import FenceItem, FenceShapeError, build_shapes
from fractus_services.mavlink_server.mission_items import Item, ItemStore, home_item
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle.earth import Place
from fractus_vehicle.state import VehicleState


def stores_of(v: VehicleState) -> dict[int, ItemStore]:
    """Return the mission, fence and rally lists by MAV_MISSION_TYPE."""
    return {store.kind: store for store in (v.mission.store, v.fence_items, v.rally)}


def restore(v: VehicleState, kept: VehicleState) -> None:
    """Restore the lists stored before a reboot."""
    for mine, theirs in zip(stores_of(v).values(), stores_of(kept).values(), strict=True):
        if theirs.items:
            replace_items(v, mine, list(theirs.items))


def replace_items(v: VehicleState, store: ItemStore, items: list[Item]) -> int:
    """Replace a stored list if the vehicle accepts the new one. Return the MAV_MISSION_RESULT."""
    result = _accept(v, store.kind, items)
    if result == mavlink.MAV_MISSION_ACCEPTED:
        store.items = items
    return result


def clear_items(v: VehicleState, store: ItemStore) -> int:
    """Clear a list. Return an error for a mission that is active."""
    if store.kind == mavlink.MAV_MISSION_TYPE_MISSION:
        if v.mission.state(v.mode) == mavlink.MISSION_STATE_ACTIVE:
            return mavlink.MAV_MISSION_ERROR
        v.mission.reset()
    return replace_items(v, store, [])


def _accept(v: VehicleState, kind: int, items: list[Item]) -> int:
    match kind:
        case mavlink.MAV_MISSION_TYPE_MISSION:
            if items and v.home is not None:
                items[0] = home_item(v.home.lat_e7, v.home.lon_e7, v.home.alt_m)
            v.params.assign("MIS_TOTAL", len(items))
        case mavlink.MAV_MISSION_TYPE_FENCE:
            try:
                v.fence.shapes = build_shapes(_local(v, items))
            except FenceShapeError as error:
                severity = mavlink.MAV_SEVERITY_INFO if "item count" in str(error) else mavlink.MAV_SEVERITY_WARNING
                v.send_text(severity, str(error))
                v.send_text(mavlink.MAV_SEVERITY_WARNING, "Fence validation failed")
                return mavlink.MAV_MISSION_ERROR
            v.params.assign("FENCE_TOTAL", len(items))
        case mavlink.MAV_MISSION_TYPE_RALLY:
            v.params.assign("RALLY_TOTAL", len(items))
        case mavlink.MAV_MISSION_TYPE_ALL:
            raise ValueError("MAV_MISSION_TYPE_ALL is valid in MISSION_CLEAR_ALL only")
        case _:
            raise ValueError(f"unknown MAV_MISSION_TYPE {kind}")
    return mavlink.MAV_MISSION_ACCEPTED


def _local(v: VehicleState, items: Sequence[Item]) -> list[FenceItem]:
    local = []
    for item in items:
        north, east, _ = v.start.vector_to(Place(item.x, item.y, 0.0))
        local.append(FenceItem(item.command, item.param1, north, east, valid_coordinates(item.x, item.y)))
    return local

"""What clients store on the vehicle: mission, fence and rally points, and what accepting each list changes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from fractus_vehicle.earth import Place
from fractus_vehicle.fence import FenceItem, FenceShapeError, build_shapes
from fractus_vehicle.mav import MissionKind, MissionResult, Mode, Severity
from fractus_vehicle.mission import Item, ItemStore, Mission, Transfers

if TYPE_CHECKING:
    from fractus_vehicle.params import Parameters
    from fractus_vehicle.vehicle import Vehicle


@dataclass(frozen=True, slots=True)
class ReturnPoint:
    """Where a return leads (local metres), what its altitudes count from, and how high above that it asks to be."""

    north: float
    east: float
    base_down: float
    altitude_m: float

    def distance_m(self, here: tuple[float, float]) -> float:
        """Distance over ground."""
        return math.dist((self.north, self.east), here)


class Plans:
    """The three lists of one vehicle."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self.mission = Mission()
        self.mission.store.accept = self._accept_mission
        self.fence = ItemStore(MissionKind.FENCE, accept=self._accept_fence)
        self.rally = ItemStore(MissionKind.RALLY, accept=self._accept_rally)
        stores = (self.mission.store, self.fence, self.rally)
        self.transfers = Transfers({store.kind: store for store in stores})

    def restore(self, kept: Plans) -> None:
        """Take over the lists that were stored before a reboot."""
        for mine, theirs in (
            (self.mission.store, kept.mission.store),
            (self.fence, kept.fence),
            (self.rally, kept.rally),
        ):
            if theirs.items and mine.accept(list(theirs.items)) is MissionResult.ACCEPTED:
                mine.items = list(theirs.items)

    def return_point(self, params: Parameters, origin: Place, home: Place, here: tuple[float, float]) -> ReturnPoint:
        """Home or the nearest rally point within RALLY_LIMIT_KM."""
        to_home = origin.vector_to(home)
        at_home = ReturnPoint(*to_home, altitude_m=0.0)
        limit_m = params["RALLY_LIMIT_KM"] * 1000.0
        rallies = [self._rally(item, origin, home) for item in self.rally.items]
        reachable = [rally for rally in rallies if limit_m <= 0.0 or rally.distance_m(here) <= limit_m]
        if not reachable:
            return at_home
        nearest = min(reachable, key=lambda rally: rally.distance_m(here))
        home_is_near = at_home.distance_m(here) <= nearest.distance_m(here)
        return at_home if int(params["RALLY_INCL_HOME"]) and home_is_near else nearest

    def _rally(self, item: Item, origin: Place, home: Place) -> ReturnPoint:
        north, east, base_down = origin.vector_to(Place(item.x, item.y, home.alt_m))
        base = self._vehicle.altitude_base_m(item.frame)
        altitude_m = item.z if base is None else base + item.z - home.alt_m
        return ReturnPoint(north, east, base_down, altitude_m)

    def _accept_mission(self, items: list[Item]) -> MissionResult:
        vehicle = self._vehicle
        if items and vehicle.home is not None:
            home = vehicle.home
            items[0] = Item(command=16, frame=0, x=home.lat_e7, y=home.lon_e7, z=home.alt_m)
        vehicle.params.assign("MIS_TOTAL", len(items))
        if vehicle.mode is not Mode.AUTO:
            self.mission.rewind()
        return MissionResult.ACCEPTED

    def _accept_fence(self, items: list[Item]) -> MissionResult:
        vehicle = self._vehicle
        local = []
        for item in items:
            north, east, _ = vehicle.start.vector_to(Place(item.x, item.y, 0.0))
            local.append(FenceItem(item.command, item.param1, north, east))
        try:
            vehicle.fence.shapes = build_shapes(local)
        except FenceShapeError as error:
            vehicle.say(Severity.WARNING, f"Fence: {error}")
            return MissionResult.INVALID
        vehicle.params.assign("FENCE_TOTAL", len(items))
        return MissionResult.ACCEPTED

    def _accept_rally(self, items: list[Item]) -> MissionResult:
        self._vehicle.params.assign("RALLY_TOTAL", len(items))
        return MissionResult.ACCEPTED

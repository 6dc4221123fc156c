"""Missions, fences and rally points that the programs of one instance have stored."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from dataclasses import astuple
from pathlib import Path

from fractus_core.geo import LocalFrame
from fractus_runtime.files import read_json, write_file
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.gateway.mission_route import ItemRefused, check_item
from fractus_services.gateway.virtual_vehicle import VirtualVehicle
from fractus_services.mavlink_server.coordinates import valid_coordinates
from fractus_services.mavlink_server.fence_shapes import FenceItem, FenceShapeError, Shape, build_shapes
from fractus_services.mavlink_server.mission_items import Item, ItemStore, validate_item
from fractus_services.mavlink_server.mission_transfer import Transfers
from fractus_services.mavlink_server.stored_mission import Mission

log = logging.getLogger(__name__)

_FENCE = mavlink.MAV_MISSION_TYPE_FENCE
_MISSION = mavlink.MAV_MISSION_TYPE_MISSION


def _ignore(_severity: int, _text: str) -> None:
    """Send nothing."""


class MissionLists:
    """Stored lists of one instance. An uploaded mission is stored after `conclude`, when its route has been judged.

    Args:
        vehicle: Vehicle as the instance sees it.
        file: File that keeps the lists when the gateway restarts; None to keep them in memory only.
        send_text: Sends a text with a severity to all sessions of the instance.

    Attributes:
        mission: Stored mission and its progress.
        transfers: Transfers of all sessions of the instance.
        problem: Reason for the latest refusal of an item or a list; empty if there is none.
        fence_enabled: True if the fence applies.
    """

    def __init__(
        self, vehicle: VirtualVehicle, file: Path | None = None, send_text: Callable[[int, str], None] = _ignore
    ) -> None:
        self._vehicle = vehicle
        self._file = file
        self.mission = Mission()
        self._stores = {
            _MISSION: self.mission.store,
            _FENCE: ItemStore(_FENCE),
            mavlink.MAV_MISSION_TYPE_RALLY: ItemStore(mavlink.MAV_MISSION_TYPE_RALLY),
        }
        self._shapes: tuple[Shape, ...] = ()
        self._frame = LocalFrame(0.0, 0.0)
        self.transfers = Transfers(
            self._stores,
            self._replace,
            self._clear,
            send_text,
            judge_item=self._judge_item,
            stored_by_item=frozenset(),
        )
        self._judged: list[Item] | None = None
        self._uploaded = False
        self.problem = ""
        self.fence_enabled = False
        self._load()

    # Mission

    def update_home(self) -> None:
        """Set item 0 of the mission to the present home."""
        home = self._vehicle.home()
        if home is not None:
            lat, lon, amsl_m = home
            self.mission.set_home(round(lat * 1e7), round(lon * 1e7), amsl_m)

    def take_uploaded(self) -> list[Item] | None:
        """Return a mission that has arrived completely since the last call; None if there is none."""
        uploaded = self._judged if self._uploaded else None
        self._uploaded = False
        return uploaded

    def conclude(self, items: list[Item], problem: str) -> None:
        """Store or refuse an uploaded mission, unless another upload has replaced it.

        Args:
            items: The uploaded mission.
            problem: Reason for the refusal; empty to store the mission.
        """
        if self._judged is not items:
            return
        self._judged = None
        if not problem:
            self.mission.store.items = items
            if not self._vehicle.in_mission or self.mission.current >= len(items):
                self.mission.rewind()
            self._save()
        self.transfers.conclude(_MISSION, mavlink.MAV_MISSION_DENIED if problem else mavlink.MAV_MISSION_ACCEPTED)

    def with_items(self, items: list[Item]) -> Mission:
        """Return a mission with other items that has not begun."""
        mission = Mission()
        mission.store.items = items
        return mission

    def _replace(self, store: ItemStore, items: list[Item]) -> int | None:
        if not items:
            return self._clear(store)
        if store.kind == _MISSION:
            self._judged = items
            self._uploaded = True
            return None
        return self._store(store, items)

    def _clear(self, store: ItemStore) -> int:
        if store.kind == _MISSION:
            if self.mission.state(self._vehicle.mode) == mavlink.MISSION_STATE_ACTIVE:
                self.problem = "the mission is being flown; change the mode to GUIDED first"
                return mavlink.MAV_MISSION_ERROR
            self._judged = None  # otherwise the verdict on an earlier upload would fill the list again
            self._uploaded = False
            self.transfers.conclude(_MISSION, mavlink.MAV_MISSION_OPERATION_CANCELLED)
            self.mission.rewind()
        return self._store(store, [])

    def _store(self, store: ItemStore, items: list[Item]) -> int:
        if store.kind == _FENCE:
            try:
                self._build_fence(items)
            except FenceShapeError as error:
                self.problem = f"fence: {str(error).strip()}"
                return mavlink.MAV_MISSION_ERROR
        store.items = items
        self._save()
        return mavlink.MAV_MISSION_ACCEPTED

    def _judge_item(self, item: Item, kind: int, number: int) -> int:
        result = validate_item(item, kind)
        if result != mavlink.MAV_MISSION_ACCEPTED:
            name = mavlink.enums["MAV_MISSION_RESULT"][result].name
            self.problem = f"item {number}: {name}"
        elif kind == _MISSION:
            try:
                check_item(item)
            except ItemRefused as refusal:
                self.problem = f"item {number}: {refusal}"
                return refusal.result
        return result

    # Fence

    def fence_problem(self, lat: float, lon: float) -> str:
        """Return why a place is outside the enabled fence, or an empty string."""
        if not self.fence_enabled:
            return ""
        east, north = self._frame.xy(lat, lon)
        outside = any(shape.contains(north, east) != shape.inclusion for shape in self._shapes)
        return "outside the fence that the program has uploaded" if outside else ""

    def enable_fence(self, enabled: bool) -> bool:
        """Enable or disable the fence. Return False if there is no fence to enable."""
        if enabled and not self._shapes:
            return False
        if enabled != self.fence_enabled:
            self.fence_enabled = enabled
            self._save()
        return True

    def _build_fence(self, items: list[Item]) -> None:
        frame = LocalFrame(items[0].x / 1e7, items[0].y / 1e7) if items else self._frame
        placed = []
        for item in items:
            valid = valid_coordinates(item.x, item.y)
            east, north = frame.xy(item.x / 1e7, item.y / 1e7) if valid else (0.0, 0.0)
            placed.append(FenceItem(item.command, item.param1, north, east, valid))
        self._shapes = build_shapes(placed)
        self._frame = frame
        self.fence_enabled = self.fence_enabled and bool(self._shapes)

    # File

    def _save(self) -> None:
        if self._file is None:
            return
        content = {
            "lists": {str(int(kind)): [astuple(item) for item in store.items] for kind, store in self._stores.items()},
            "fenceEnabled": self.fence_enabled,
        }
        try:
            self._file.parent.mkdir(parents=True, exist_ok=True)
            write_file(self._file, json.dumps(content).encode(), durable=False)
        except OSError as error:
            log.warning("gateway: missions not stored (file=%s error=%s)", self._file, error)

    def _load(self) -> None:
        if self._file is None or not self._file.exists():
            return
        try:
            content = read_json(self._file)
            lists = {kind: [Item(*values) for values in content["lists"][str(int(kind))]] for kind in self._stores}
            self._build_fence(lists[_FENCE])
        except (OSError, ValueError, LookupError, TypeError) as error:
            log.warning(
                "gateway: stored missions are not readable, starting without (file=%s error=%s)", self._file, error
            )
            return
        for kind, items in lists.items():
            self._stores[kind].items = items
        self.fence_enabled = bool(content.get("fenceEnabled")) and bool(self._shapes)

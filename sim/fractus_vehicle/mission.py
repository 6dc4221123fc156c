"""Stored mission and the state of its execution."""

from __future__ import annotations

from collections.abc import Callable

from fractus_services.mavlink_server.mission_items import TAKEOFFS, Item, ItemStore, home_item
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle.earth import Place


class Mission:
    """Stored mission and its current item. Item 0 is home, as in ArduPilot."""

    def __init__(self) -> None:
        self.store = ItemStore(
            mavlink.MAV_MISSION_TYPE_MISSION, home=Item(mavlink.MAV_CMD_NAV_WAYPOINT, frame=mavlink.MAV_FRAME_GLOBAL)
        )
        self.current = 0
        self.complete = False
        self._jumps: dict[int, int] = {}

    def state(self, mode: int) -> int:
        """Return MISSION_STATE for MISSION_CURRENT."""
        if len(self.items) <= 1:
            return mavlink.MISSION_STATE_NO_MISSION
        if self.complete:
            return mavlink.MISSION_STATE_COMPLETE
        return mavlink.MISSION_STATE_ACTIVE if mode == mavlink.COPTER_MODE_AUTO else mavlink.MISSION_STATE_NOT_STARTED

    @property
    def items(self) -> list[Item]:
        """The stored items."""
        return self.store.items

    def reset(self) -> None:
        """Go back to the beginning. A completed mission stays complete until it is started again."""
        self.current = 0
        self._jumps.clear()

    def rewind(self) -> None:
        """Go back to the beginning of a mission that is not complete."""
        self.reset()
        self.complete = False

    def first_navigating(self, index: int) -> int | None:
        """Return the index of the first NAV item at or after `index`, excluding home, or None."""
        return next((at for at in range(max(index, 1), len(self.items)) if self.items[at].navigates), None)

    def takes_off(self, index: int) -> bool:
        """Return True if the first NAV item at or after `index` is a takeoff. Delays are skipped."""
        at = self.first_navigating(index)
        while at is not None and self.items[at].command == mavlink.MAV_CMD_NAV_DELAY:
            at = self.first_navigating(at + 1)
        return at is not None and self.items[at].command in TAKEOFFS

    def peek_after(self, index: int) -> int | None:
        """Return the index of the next NAV item, without changing the counters of jumps.

        Returns None if there is no further NAV item, or if jumps form a loop.
        """
        jumps = dict(self._jumps)
        at = self.next_after(index)
        for _ in self.items:
            if at is None or self.items[at].navigates:
                break
            at = self.next_after(at)
        else:
            at = None
        self._jumps = jumps
        return at

    def next_after(self, index: int, report: Callable[[str], None] | None = None) -> int | None:
        """Return the index of the item to execute after `index`. Follow jumps. Return None at the end.

        Args:
            index: Index of the item that ends.
            report: Called with the STATUSTEXT of each counted jump.
        """
        at = index + 1
        for _ in range(100):
            if at >= len(self.items):
                return None
            item = self.items[at]
            if item.command not in (mavlink.MAV_CMD_DO_JUMP, mavlink.MAV_CMD_DO_JUMP_TAG):
                return at
            target = (
                self.find_tag(int(item.param1)) if item.command == mavlink.MAV_CMD_DO_JUMP_TAG else int(item.param1)
            )
            if target is None or not 0 < target < len(self.items):
                return None
            done = self._jumps.get(at, 0)
            times = int(item.param2)
            if times < 0:
                at = target
            elif done < times:
                self._jumps[at] = done + 1
                if report is not None:
                    report(f"Mission: {at} Jump {done + 1}/{times}")
                at = target
            else:
                at += 1
        return None

    def find_tag(self, tag: int) -> int | None:
        """Return the index of the first JUMP_TAG item with a tag, or None."""
        marks = (
            at for at, item in enumerate(self.items) if item.command == mavlink.MAV_CMD_JUMP_TAG and item.param1 == tag
        )
        return next(marks, None)

    def set_home(self, home: Place) -> None:
        """Update item 0 to the home position."""
        self.store.home = home_item(home.lat_e7, home.lon_e7, home.alt_m)
        if self.items:
            self.items[0] = self.store.home

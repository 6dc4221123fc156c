"""Stored mission, the state of its execution, and the texts and messages that report it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from fractus_runtime.mavlink_codec import Value
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.mavlink_server.mission_items import TAKEOFFS, Item, ItemStore, home_item

# Waypoint commands that can be passed without a stop.
CURVES = frozenset({mavlink.MAV_CMD_NAV_WAYPOINT, mavlink.MAV_CMD_NAV_SPLINE_WAYPOINT})
# Commands whose end is reported in a STATUSTEXT.
ARRIVALS = CURVES | {mavlink.MAV_CMD_NAV_LOITER_TIME}


class Mission:
    """Stored mission and its current item. Item 0 is home, as in ArduPilot.

    Attributes:
        store: Stored items. A changed list of items is a new list object, except that item 0 follows home.
        current: Index of the current item.
        complete: True if the mission is complete.
        jumps_passed: Number of jump items that `next_after` has followed or skipped.
    """

    def __init__(self) -> None:
        self.store = ItemStore(
            mavlink.MAV_MISSION_TYPE_MISSION, home=Item(mavlink.MAV_CMD_NAV_WAYPOINT, frame=mavlink.MAV_FRAME_GLOBAL)
        )
        self.current = 0
        self.complete = False
        self.jumps_passed = 0
        self._jumps: dict[int, int] = {}
        self._tagged: list[Item] = []
        self._tags: dict[float, int] = {}

    def report(self, mode: int) -> Mapping[str, Value]:
        """Return the fields of MISSION_CURRENT."""
        return {
            "seq": self.current,
            "total": max(0, len(self.items) - 1),
            "mission_state": self.state(mode),
            "mission_mode": 1 if mode == mavlink.COPTER_MODE_AUTO else 0,
        }

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
            self.jumps_passed += 1
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
        if self._tagged is not self.items:
            self._tagged = self.items
            marks = [at for at, item in enumerate(self.items) if item.command == mavlink.MAV_CMD_JUMP_TAG]
            self._tags = {self.items[at].param1: at for at in reversed(marks)}
        return self._tags.get(tag)

    def set_home(self, lat_e7: int, lon_e7: int, amsl_m: float) -> None:
        """Update item 0 to the home position."""
        self.store.home = home_item(lat_e7, lon_e7, amsl_m)
        if self.items:
            self.items[0] = self.store.home


def hold_s(item: Item) -> float:
    """Return how long an item lasts after the vehicle has arrived, in seconds. Infinite if only a client can end it."""
    match item.command:
        case mavlink.MAV_CMD_NAV_LOITER_UNLIM:
            return math.inf
        case mavlink.MAV_CMD_NAV_GUIDED_ENABLE:
            return math.inf if item.param1 > 0.0 else 0.0
        case mavlink.MAV_CMD_NAV_SCRIPT_TIME:
            return item.param2 if item.param2 > 0.0 else math.inf  # there are no scripts that could end earlier
        case (
            mavlink.MAV_CMD_NAV_WAYPOINT
            | mavlink.MAV_CMD_NAV_SPLINE_WAYPOINT
            | mavlink.MAV_CMD_NAV_LOITER_TIME
            | mavlink.MAV_CMD_NAV_DELAY
            | mavlink.MAV_CMD_NAV_ATTITUDE_TIME
        ):
            return max(item.param1, 0.0)
        case _:
            return 0.0


_TITLES: dict[int, str] = {
    mavlink.MAV_CMD_NAV_WAYPOINT: "WP",
    mavlink.MAV_CMD_NAV_SPLINE_WAYPOINT: "SplineWP",
    mavlink.MAV_CMD_NAV_TAKEOFF: "Takeoff",
    mavlink.MAV_CMD_NAV_LAND: "Land",
    mavlink.MAV_CMD_NAV_VTOL_TAKEOFF: "VTOLTakeoff",
    mavlink.MAV_CMD_NAV_VTOL_LAND: "VTOLLand",
    mavlink.MAV_CMD_NAV_GUIDED_ENABLE: "GuidedEnable",
    mavlink.MAV_CMD_NAV_PAYLOAD_PLACE: "PayloadPlace",
    mavlink.MAV_CMD_NAV_SCRIPT_TIME: "NavScriptTime",
    mavlink.MAV_CMD_NAV_ATTITUDE_TIME: "NavAttitudeTime",
    mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: "RTL",
    mavlink.MAV_CMD_NAV_LOITER_UNLIM: "LoitUnlim",
    mavlink.MAV_CMD_NAV_LOITER_TIME: "LoitTime",
    mavlink.MAV_CMD_NAV_LOITER_TURNS: "LoitTurns",
    mavlink.MAV_CMD_NAV_LOITER_TO_ALT: "LoitAltitude",
    mavlink.MAV_CMD_NAV_DELAY: "Delay",
    mavlink.MAV_CMD_CONDITION_DELAY: "CondDelay",
    mavlink.MAV_CMD_CONDITION_DISTANCE: "CondDist",
    mavlink.MAV_CMD_CONDITION_YAW: "CondYaw",
    mavlink.MAV_CMD_DO_CHANGE_SPEED: "ChangeSpeed",
    mavlink.MAV_CMD_DO_SET_HOME: "SetHome",
    mavlink.MAV_CMD_DO_SET_SERVO: "SetServo",
    mavlink.MAV_CMD_DO_SET_RELAY: "SetRelay",
    mavlink.MAV_CMD_DO_SET_ROI: "SetROI",
    mavlink.MAV_CMD_DO_REPEAT_SERVO: "RepeatServo",
    mavlink.MAV_CMD_DO_REPEAT_RELAY: "RepeatRelay",
    mavlink.MAV_CMD_DO_DIGICAM_CONFIGURE: "DigiCamCfg",
    mavlink.MAV_CMD_DO_DIGICAM_CONTROL: "DigiCamCtrl",
    mavlink.MAV_CMD_DO_SET_CAM_TRIGG_DIST: "SetCamTrigDst",
    mavlink.MAV_CMD_DO_FENCE_ENABLE: "FenceEnable",
    mavlink.MAV_CMD_DO_SET_REVERSE: "SetReverse",
    mavlink.MAV_CMD_DO_SET_RESUME_REPEAT_DIST: "SetRepeatDist",
    mavlink.MAV_CMD_DO_ENGINE_CONTROL: "EngineControl",
    mavlink.MAV_CMD_DO_PAUSE_CONTINUE: "PauseContinue",
    mavlink.MAV_CMD_DO_LAND_START: "LandStart",
    mavlink.MAV_CMD_DO_MOUNT_CONTROL: "MountControl",
    mavlink.MAV_CMD_DO_GRIPPER: "Gripper",
    mavlink.MAV_CMD_DO_PARACHUTE: "Parachute",
    mavlink.MAV_CMD_DO_SPRAYER: "Sprayer",
    mavlink.MAV_CMD_DO_AUX_FUNCTION: "AuxFunction",
    mavlink.MAV_CMD_DO_WINCH: "Winch",
    mavlink.MAV_CMD_DO_GUIDED_LIMITS: "GuidedLimits",
    mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW: "GimbalPitchYaw",
    mavlink.MAV_CMD_JUMP_TAG: "JumpTag",
}


def title(item: Item) -> str:
    """Return ArduPilot's name of a command in STATUSTEXTs."""
    return _TITLES.get(item.command, "Cmd")

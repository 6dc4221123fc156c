"""DO and CONDITION commands of a mission, executed in order during NAV commands."""

from __future__ import annotations

import math
from collections import deque

from fractus_services.mavlink_server.mission_items import Item
from fractus_services.mavlink_server.stored_mission import title
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle.accessories import set_relay, set_servo
from fractus_vehicle.home import set_home_at, set_home_to_position
from fractus_vehicle.shaping import wrap_pi
from fractus_vehicle.state import VehicleState

YAW_REACHED_RAD = math.radians(2.0)


class MissionCommands:
    """Queue of DO and CONDITION commands. When the next NAV command begins, pending commands are discarded."""

    def __init__(self) -> None:
        self._indices: deque[int] = deque()
        self._index: int | None = None
        self._begun_s = 0.0

    def begin(self, v: VehicleState, indices: list[int]) -> None:
        """Queue the commands that precede the current NAV command, and start the first one."""
        self._indices = deque(indices)
        self._index = None
        self.step(v)

    def step(self, v: VehicleState) -> None:
        """Start the next command, or end the current one if its condition is met.

        Each takes one step, as on ArduPilot. Otherwise, only the last one of several commands could be reported as
        reached.
        """
        if self._index is None:
            self._start_next(v)
            return
        index = self._index
        if index >= len(v.mission.items):
            self._index = None
        elif _fulfilled(v, v.mission.items[index], v.time_s - self._begun_s):
            self._index = None
            v.item_reached = index

    def _start_next(self, v: VehicleState) -> None:
        if not self._indices:
            return
        index = self._indices.popleft()
        if index >= len(v.mission.items):
            self._indices.clear()
            return
        self._index = index
        self._begun_s = v.time_s
        item = v.mission.items[index]
        v.send_text(mavlink.MAV_SEVERITY_INFO, f"Mission: {index} {title(item)}")
        _do(v, item)


def _fulfilled(v: VehicleState, item: Item, waited_s: float) -> bool:
    match item.command:
        case mavlink.MAV_CMD_CONDITION_DELAY:
            return waited_s >= item.param1
        case mavlink.MAV_CMD_CONDITION_DISTANCE:
            target = v.control.target
            return math.hypot(target[0] - v.est.north, target[1] - v.est.east) <= max(item.param1, 0.0)
        case mavlink.MAV_CMD_CONDITION_YAW:
            return v.heading.turned and abs(wrap_pi(v.control.target_yaw - v.est.yaw)) <= YAW_REACHED_RAD
        case _:
            return True


def _do(v: VehicleState, item: Item) -> None:
    match item.command:
        case mavlink.MAV_CMD_DO_CHANGE_SPEED:
            v.control.limits.change_speed(int(item.param1), item.param2)
        case mavlink.MAV_CMD_CONDITION_YAW:
            v.heading.turn_to(item.param1, item.param2, int(item.param3), relative=item.param4 > 0.5)
        case mavlink.MAV_CMD_DO_SET_ROI | mavlink.MAV_CMD_DO_SET_ROI_LOCATION:
            north, east, _ = item_target(v, item)
            v.heading.look_at((north, east) if item.has_place else None)
        case mavlink.MAV_CMD_DO_SET_ROI_NONE:
            v.heading.look_at(None)
        case mavlink.MAV_CMD_DO_FENCE_ENABLE:
            switch_fence(v, item.param1)
        case mavlink.MAV_CMD_DO_SET_SERVO | mavlink.MAV_CMD_DO_REPEAT_SERVO:
            set_servo(v, item.param1, item.param2)
        case mavlink.MAV_CMD_DO_SET_RELAY:
            set_relay(v, item.param1, item.param2)
        case mavlink.MAV_CMD_DO_SET_HOME:
            set_home_to_position(v) if item.param1 > 0.5 else set_home_at(v, item.x, item.y, item.z)
        case _:
            pass  # commands for cameras, mounts and grippers have no effect


def switch_fence(v: VehicleState, action: float) -> bool:
    """Handle DO_FENCE_ENABLE: 0 disables the fence, 1 enables it, 2 disables only the minimum altitude.

    Returns:
        False if no fence is present, or the action is unknown.
    """
    if action == 2.0:
        v.fence.types &= ~mavlink.FENCE_TYPE_ALT_MIN
        return True
    if action not in (0.0, 1.0) or (action == 1.0 and not v.fence.present):
        return False
    v.fence.enabled = bool(action)
    return True


def item_target(v: VehicleState, item: Item) -> tuple[float, float, float]:
    """Return the local position (north, east, down) of an item.

    An item without coordinates gets the horizontal position of the current target.
    """
    origin = v.origin or v.start
    base = v.altitude_base_m(item.frame)
    if base is None:
        base = (v.home or origin).alt_m
    down = origin.alt_m - (base + item.z)
    if not item.has_place:
        return (v.control.target[0], v.control.target[1], down)
    north, east, _ = origin.vector_to(type(origin)(item.x, item.y, 0.0))
    return (north, east, down)

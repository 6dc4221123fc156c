"""AUTO mode: fly the stored mission."""

from __future__ import annotations

import math
from collections.abc import Callable

from fractus_services.mavlink_server.mission_items import LANDINGS, TAKEOFFS, Item
from fractus_services.mavlink_server.stored_mission import ARRIVALS, CURVES, hold_s, title
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle.breadcrumbs import Point
from fractus_vehicle.descent import descend
from fractus_vehicle.flight import Flight
from fractus_vehicle.leg import Leg
from fractus_vehicle.mission_commands import MissionCommands, item_target
from fractus_vehicle.rtl import ReturnToLaunch
from fractus_vehicle.spline import SplineLeg
from fractus_vehicle.state import CONTROL_STEP_S, VehicleState

# Bit of MIS_OPTIONS: the mission goes on after a landing. Otherwise it does so only if it takes off again.
CONTINUE_AFTER_LAND = 4
# Commands for which the vehicle holds its position.
HOLDS = frozenset(
    {
        mavlink.MAV_CMD_NAV_DELAY,
        mavlink.MAV_CMD_NAV_GUIDED_ENABLE,
        mavlink.MAV_CMD_NAV_SCRIPT_TIME,
        mavlink.MAV_CMD_NAV_ATTITUDE_TIME,
    }
)
# LOITER_TURNS: a vehicle farther from the circle than CIRCLE_NEAR_M first flies to it. CIRCLE_ACCEL_MIN_RPS2 is the smallest
# angular acceleration.
CIRCLE_NEAR_M = 3.0
CIRCLE_ACCEL_MIN_RPS2 = math.radians(2.0)


class AutoFlight(Flight):
    """AUTO mode: run the NAV commands in order, and run the DO commands before a NAV command when it begins."""

    def __init__(self, set_mode: Callable[[int], bool]) -> None:
        self._set_mode = set_mode
        self._item: Item | None = None
        self._index = 0
        self._arrived_s: float | None = None
        self._started = False
        self._started_s = 0.0
        self._announced = False
        self._landing = False
        self._returning: ReturnToLaunch | None = None
        self.paused = False
        self._leg: Leg | SplineLeg | None = None
        self._track: Point = (0.0, 0.0, 0.0)  # direction at the end of the current leg; zero if the vehicle stops there
        self._commands = MissionCommands()
        self._circle_centre = (0.0, 0.0)
        self._turned = 0.0
        self._turn_rate_rps = 0.0
        self._angle = 0.0

    @property
    def landing(self) -> bool:
        """True if the landing or return of the mission is in its final descent."""
        return self._landing or (self._returning is not None and self._returning.landing)

    def begin(self, v: VehicleState) -> None:
        """Hold position. The mission starts in the first step with running motors. A completed one starts again."""
        v.control.hold_position()
        v.heading.follow_course()
        if v.mission.complete:
            v.mission.rewind()

    def _start(self, v: VehicleState) -> None:
        """Start the mission at its current item, or at its beginning."""
        self._started = True
        self._started_s = v.time_s
        mission = v.mission
        if int(v.params["MIS_RESTART"]) == 1 or mission.current == 0:
            mission.rewind()
            self._start_from(v, mission.next_after(0))
        else:
            self._start_from(v, mission.current)

    def wait(self, v: VehicleState) -> None:
        """Report the first item of the mission in a STATUSTEXT while the motors are off.

        A mission that was running when the motors stopped was reset. It waits at its first item.
        """
        if self._started:
            self._reset()
        if not self._announced and v.origin is not None and not v.mission.complete:
            self._announced = True
            self._announce(v)

    def _reset(self) -> None:
        """Reset the progress of this mode. The mission itself was reset when the motors stopped."""
        self._started = False
        self._announced = False
        self._item = self._leg = self._returning = None
        self._landing = False

    def start_by_command(self, v: VehicleState) -> None:
        """Handle MISSION_START: report the first item in a STATUSTEXT if the mission is not running yet.

        `step` reports the item again when it starts the mission.
        """
        if v.mission.complete:
            v.mission.rewind()
            self._started = False
            self._announced = False
        if not self._started and not self._announced:
            self._announce(v)

    def _announce(self, v: VehicleState) -> None:
        index = v.mission.first_navigating(v.mission.current)
        if index is not None:
            v.mission.current = index
            v.send_text(mavlink.MAV_SEVERITY_INFO, f"Mission: {index} {title(v.mission.items[index])}")

    def pause(self, v: VehicleState, *, paused: bool) -> None:
        """Handle DO_PAUSE_CONTINUE: hold the current position, or restart the current item."""
        if paused and not self.paused:
            v.control.hold_position()
        elif not paused and self.paused and self._item is not None:
            self._begin_item(v, self._index, self._item)
        self.paused = paused

    def jump_to(self, v: VehicleState, index: int) -> None:
        """Continue at item `index` (DO_SET_MISSION_CURRENT)."""
        self._started = True
        self._started_s = v.time_s
        self._returning = None
        self._landing = False
        v.mission.complete = False
        self._start_from(v, index)

    def _advance(self, v: VehicleState) -> None:
        """Begin the item after the current one."""

        def report(text: str) -> None:
            v.send_text(mavlink.MAV_SEVERITY_INFO, text)

        self._start_from(v, v.mission.next_after(self._index, report))

    def _start_from(self, v: VehicleState, index: int | None) -> None:
        """Begin the next NAV command from `index` on. The DO and CONDITION commands before it run while it is flown."""
        waiting: list[int] = []
        for _ in range(len(v.mission.items) + 1):
            if index is None or index >= len(v.mission.items):
                self._commands.begin(v, waiting)
                self._finish(v)
                return
            item = v.mission.items[index]
            if item.navigates:
                v.mission.current = index
                self._commands.begin(v, waiting)
                v.send_text(mavlink.MAV_SEVERITY_INFO, f"Mission: {index} {title(item)}")
                self._begin_item(v, index, item)
                return
            waiting.append(index)
            index = v.mission.next_after(index)

    def _finish(self, v: VehicleState) -> None:
        self._item = self._leg = None
        v.mission.complete = True
        if v.landed:
            v.disarm()
        else:
            v.control.hold_position()

    def _begin_item(self, v: VehicleState, index: int, item: Item) -> None:
        self._item = item
        self._index = index
        self._arrived_s = None
        self._landing = False
        self._returning = self._leg = None
        track = self._track
        self._track = (0.0, 0.0, 0.0)
        if item.has_place and v.altitude_base_m(item.frame) is None:
            v.send_text(mavlink.MAV_SEVERITY_CRITICAL, "Failsafe: Terrain data missing")
            if not self._set_mode(mavlink.COPTER_MODE_RTL):
                self._set_mode(mavlink.COPTER_MODE_LAND)
            return
        north, east, down = item_target(v, item)
        match item.command:
            case mavlink.MAV_CMD_NAV_TAKEOFF | mavlink.MAV_CMD_NAV_VTOL_TAKEOFF:
                if v.landed:
                    v.begin_takeoff(down)
                else:
                    v.control.go_to(*v.control.target, down)
            case mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH:
                self._returning = ReturnToLaunch()
                self._returning.begin(v)
            case mavlink.MAV_CMD_NAV_LOITER_TURNS:
                self._begin_turns(v, item, (north, east, down))
            case mavlink.MAV_CMD_NAV_SPLINE_WAYPOINT:
                position = (v.control.pos[0], v.control.pos[1], v.control.pos[2])
                self._track = self._arrival(v, item, position, (north, east, down))
                self._leg = SplineLeg(v, (north, east, down), track, self._track)
            case mavlink.MAV_CMD_NAV_LAND | mavlink.MAV_CMD_NAV_VTOL_LAND:
                v.control.go_to(north, east)
            case command if command in HOLDS:
                self._hold(v, item)
            case _:
                position = (v.control.pos[0], v.control.pos[1], v.control.pos[2])
                if self._following(v, item) is not None:
                    self._track = (north - position[0], east - position[1], down - position[2])
                self._leg = Leg(v, north, east, down)

    def _hold(self, v: VehicleState, item: Item) -> None:
        self._arrived_s = v.time_s
        v.control.hold_position()
        if item.command == mavlink.MAV_CMD_NAV_DELAY:
            v.send_text(mavlink.MAV_SEVERITY_INFO, f"Delaying {max(int(item.param1), 0)} sec")

    def _following(self, v: VehicleState, item: Item) -> Item | None:
        """Return the next NAV item if the vehicle flies on to it without a stop.

        Return None if the vehicle stops at `item`.
        """
        at = v.mission.peek_after(self._index)
        if item.command not in CURVES or item.param1 > 0.0 or at is None:
            return None
        following = v.mission.items[at]
        return following if following.command in CURVES else None

    def _arrival(self, v: VehicleState, item: Item, start: Point, end: Point) -> Point:
        """Return the direction at the end of a spline leg, or zero if the vehicle stops there.

        If the next leg is straight, it is the direction of that leg. If the next leg is a spline, it is the direction
        from the start of this leg to the end of the next leg.
        """
        following = self._following(v, item)
        if following is None:
            return (0.0, 0.0, 0.0)
        north, east, down = item_target(v, following)
        base = start if following.command == mavlink.MAV_CMD_NAV_SPLINE_WAYPOINT else end
        return (north - base[0], east - base[1], down - base[2])

    def step(self, v: VehicleState) -> None:
        """Fly the current item, and begin the next item when it is complete. A completed mission is not started."""
        if self._started and v.armed_at_s > self._started_s:
            self._reset()  # the motors stopped and started between two steps
        if not self._started and not v.mission.complete:
            self._start(v)
        item = self._item
        if item is None or self.paused:
            return
        if self._returning is not None:
            self._returning.step(v)
            self._finish_if_down(v)
            return
        if self._leg is not None:
            self._leg.step(v)
        if item.command in LANDINGS:
            self._land(v)
        elif item.command == mavlink.MAV_CMD_NAV_LOITER_TURNS:
            self._turn(v, item)
        elif self._done(v, item):
            v.item_reached = self._index
            if item.command in ARRIVALS:
                v.send_text(mavlink.MAV_SEVERITY_INFO, f"Reached command #{self._index}")
            self._advance(v)
        self._commands.step(v)
        v.heading.step(v.est, CONTROL_STEP_S)

    def _land(self, v: VehicleState) -> None:
        north, east = v.control.target
        if not self._landing and math.hypot(north - v.est.north, east - v.est.east) < 2.0:
            self._landing = True
            v.touch_time_s = 0.0
        if not self._landing:
            return
        goes_on = v.mission.takes_off(self._index + 1) or bool(int(v.params["MIS_OPTIONS"]) & CONTINUE_AFTER_LAND)
        # The motors stop, and the mission is reset, before this item is complete. It is therefore not reported.
        descend(v, disarm=not goes_on)
        if goes_on and v.landed:
            self._landing = False
            v.item_reached = self._index
            self._advance(v)

    def _finish_if_down(self, v: VehicleState) -> None:
        """Complete a return item if the motors have stopped."""
        if v.armed:
            return
        v.item_reached = self._index
        v.mission.complete = v.mission.peek_after(self._index) is None

    def _begin_turns(self, v: VehicleState, item: Item, centre: Point) -> None:
        """Begin LOITER_TURNS. If the vehicle is far from the circle, it flies to the nearest point of it first."""
        north, east, down = centre
        self._circle_centre = (north, east)
        self._turned = 0.0
        self._turn_rate_rps = 0.0
        self._angle = math.atan2(v.est.east - east, v.est.north - north)
        edge = (*self._circle_point(_radius_m(v, item)), down)
        if math.dist((v.est.north, v.est.east, v.est.down), edge) > CIRCLE_NEAR_M:
            self._leg = Leg(v, *edge)
        else:
            v.control.go_to(*edge)

    def _circle_point(self, radius_m: float) -> tuple[float, float]:
        north, east = self._circle_centre
        return (north + radius_m * math.cos(self._angle), east + radius_m * math.sin(self._angle))

    def _turn(self, v: VehicleState, item: Item) -> None:
        if self._leg is not None:
            if not self._arrived(v, self._leg):
                return
            self._leg = None
            v.control.go_to(*v.control.target, v.control.target_down)
        radius_m = _radius_m(v, item)
        fastest_mps = min(v.control.limits.speed_mps, math.sqrt(0.5 * v.control.limits.accel_mps2 * radius_m))
        rate_rps = min(math.radians(abs(v.params["CIRCLE_RATE"])), fastest_mps / radius_m)
        # The full rate is reached after one second.
        accel_rps2 = max(rate_rps, CIRCLE_ACCEL_MIN_RPS2)
        self._turn_rate_rps = min(self._turn_rate_rps + accel_rps2 * CONTROL_STEP_S, rate_rps)
        step = self._turn_rate_rps * CONTROL_STEP_S
        self._angle += math.copysign(step, item.param3 or 1.0)
        self._turned += step
        v.control.target = self._circle_point(radius_m)
        if self._turned >= 2.0 * math.pi * item.param1:
            v.item_reached = self._index
            self._advance(v)

    def _arrived(self, v: VehicleState, leg: Leg | SplineLeg) -> bool:
        """Return True if the vehicle is near the end of a leg and, unless it passes without a stop, has stopped there."""
        passes = any(self._track)
        return leg.reached(v, max(v.params["WPNAV_RADIUS"] / 100.0, 0.3)) and (passes or leg.finished)

    def _done(self, v: VehicleState, item: Item) -> bool:
        if item.command in TAKEOFFS:
            return v.takeoff_done()
        if self._arrived_s is None:
            if self._leg is None or not self._arrived(v, self._leg):
                return False
            self._arrived_s = v.time_s
        return v.time_s - self._arrived_s >= hold_s(item)


def _radius_m(v: VehicleState, item: Item) -> float:
    """Return the radius of a LOITER_TURNS item in metres."""
    return min(max(abs(item.param3) or v.params["CIRCLE_RADIUS"] / 100.0, 1.0), 500.0)

"""Calls of the mobility service that fly the items of a mission. Each function is pure."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from fractus_core.geo import LocalFrame
from fractus_proto.v1 import mobility_pb2, types_pb2
from fractus_runtime.mavlink_codec import enum_name
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.gateway import translate
from fractus_services.gateway.translate import Request, Untranslatable
from fractus_services.mavlink_server.coordinates import ABSOLUTE_FRAMES, RELATIVE_FRAMES, TERRAIN_FRAMES
from fractus_services.mavlink_server.mission_items import LANDINGS, PLACED, TAKEOFFS, Item
from fractus_services.mavlink_server.stored_mission import Mission

MAX_STEPS = 1000
"""Maximum number of items of a route, with repetitions and jumps, and maximum number of its calls.

The request to the mobility service has a limited size, and other instances wait while a route is determined.
"""

JUDGED_REPETITIONS = 2
"""Number of repetitions of a jump that are judged. Further repetitions fly the same legs as the second repetition."""

LEGS_PER_TURN = 16
"""Number of straight legs that replace a circle. They are at most 2 % of the radius inside of it."""

DEFAULT_RADIUS_M = 10.0
"""Radius of a circle whose item contains none."""

_LEGS = frozenset(
    {
        mavlink.MAV_CMD_NAV_WAYPOINT,
        mavlink.MAV_CMD_NAV_SPLINE_WAYPOINT,
        mavlink.MAV_CMD_NAV_LOITER_UNLIM,
        mavlink.MAV_CMD_NAV_LOITER_TIME,
        mavlink.MAV_CMD_NAV_LOITER_TO_ALT,
    }
)
_JUMPS = frozenset({mavlink.MAV_CMD_DO_JUMP, mavlink.MAV_CMD_DO_JUMP_TAG})
_CONDITIONS = frozenset(
    {mavlink.MAV_CMD_CONDITION_DELAY, mavlink.MAV_CMD_CONDITION_DISTANCE, mavlink.MAV_CMD_CONDITION_YAW}
)
_WITHOUT_CALL = _JUMPS | {mavlink.MAV_CMD_JUMP_TAG, mavlink.MAV_CMD_DO_LAND_START, mavlink.MAV_CMD_NAV_DELAY}
_ENDS = LANDINGS | {mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH}
_GIMBAL = frozenset({mavlink.MAV_CMD_DO_MOUNT_CONTROL, mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW})
_OTHERS = frozenset({mavlink.MAV_CMD_NAV_LOITER_TURNS, mavlink.MAV_CMD_DO_CHANGE_SPEED})
AVAILABLE = _LEGS | TAKEOFFS | _ENDS | _WITHOUT_CALL | _CONDITIONS | _GIMBAL | _OTHERS
"""Commands that a mission may contain."""


@dataclass(frozen=True, slots=True)
class Place:
    """A place in degrees, and metres above the altitude reference.

    Attributes:
        yaw_deg: Heading of the next leg, clockwise from true north; None for the heading behaviour of the autopilot.
    """

    lat: float
    lon: float
    altitude_m: float
    reference: int = types_pb2.ALTITUDE_REFERENCE_HOME
    yaw_deg: float | None = None


class ItemRefused(Exception):
    """An item is not available to programs. The text is one sentence for the program.

    Attributes:
        result: MAV_MISSION_RESULT.
    """

    def __init__(self, result: int, reason: str) -> None:
        super().__init__(reason)
        self.result = result


def check_item(item: Item) -> None:
    """Check an item that ArduCopter accepts.

    Raises:
        ItemRefused: The item is not available.
    """
    name = enum_name("MAV_CMD", item.command)
    if item.command not in AVAILABLE:
        reason = translate.UNSUPPORTED.get(name, f"{name} is not available in missions of programs")
        raise ItemRefused(mavlink.MAV_MISSION_UNSUPPORTED, reason)
    if item.command in PLACED and item.frame in TERRAIN_FRAMES:
        reason = f"{name}: altitudes above terrain are not supported; use MAV_FRAME_GLOBAL_RELATIVE_ALT"
        raise ItemRefused(mavlink.MAV_MISSION_UNSUPPORTED_FRAME, reason)
    if item.command in TAKEOFFS and item.frame not in RELATIVE_FRAMES:
        reason = "the altitude of a takeoff must be relative to home; use MAV_FRAME_GLOBAL_RELATIVE_ALT"
        raise ItemRefused(mavlink.MAV_MISSION_UNSUPPORTED_FRAME, reason)
    speed_types = {mavlink.SPEED_TYPE_AIRSPEED, mavlink.SPEED_TYPE_GROUNDSPEED}
    if item.command == mavlink.MAV_CMD_DO_CHANGE_SPEED and item.param1 not in speed_types:
        raise ItemRefused(mavlink.MAV_MISSION_INVALID_PARAM1, "only the ground speed can be changed")
    if item.command == mavlink.MAV_CMD_CONDITION_YAW and item.param4 != 0.0:
        reason = "CONDITION_YAW: a relative angle is not supported; set param4 to 0"
        raise ItemRefused(mavlink.MAV_MISSION_INVALID_PARAM4, reason)
    targeting = mavlink.MAV_MOUNT_MODE_MAVLINK_TARGETING
    if item.command == mavlink.MAV_CMD_DO_MOUNT_CONTROL and item.z != targeting:
        reason = "only MAV_MOUNT_MODE_MAVLINK_TARGETING is supported"
        raise ItemRefused(mavlink.MAV_MISSION_INVALID_PARAM7, reason)


def lands(item: Item) -> bool:
    """Return True if a mission ends with this item, because the motors then stop."""
    return item.command in _ENDS


def requests_of(mission: Mission, number: int, at: Place) -> tuple[list[Request], Place]:
    """Return the calls that fly an item, and the place to which they lead.

    Args:
        mission: Mission. Its state does not change, except for `jumps_passed`.
        number: Number of an item that `check_item` accepts.
        at: Place at which the item begins. It replaces missing coordinates and a missing altitude of the item.
    """
    item = mission.items[number]
    if item.command == mavlink.MAV_CMD_CONDITION_YAW:
        return [], replace(at, yaw_deg=item.param1 % 360.0)
    if item.command == mavlink.MAV_CMD_CONDITION_DISTANCE:
        places = _approach(mission, number, at)
    elif item.command == mavlink.MAV_CMD_NAV_LOITER_TURNS:
        places = _circle(item, at)
    elif item.command in _LEGS:
        places = [_target(item, at)]
    elif item.command in LANDINGS and item.has_place:
        # The drone flies to the place at its present altitude, and lands there.
        places = [replace(at, lat=item.x / 1e7, lon=item.y / 1e7)]
    else:
        requests, at = _requests_without_leg(item, at)
        return requests, replace(at, yaw_deg=None) if item.navigates else at
    requests = [_goto(place) for place in places]
    if item.command in LANDINGS:
        requests.append(_automatic(translate.land()))
    at = places[-1] if places else at
    return requests, replace(at, yaw_deg=None) if item.navigates else at


def _requests_without_leg(item: Item, at: Place) -> tuple[list[Request], Place]:
    """Return the call of an item that flies no leg, and the place to which it leads."""
    request: Request | None = None
    match item.command:
        case mavlink.MAV_CMD_NAV_TAKEOFF | mavlink.MAV_CMD_NAV_VTOL_TAKEOFF:
            request = _automatic(Request("Takeoff", mobility_pb2.TakeoffRequest(altitude_m=item.z)))
            at = replace(at, altitude_m=item.z, reference=types_pb2.ALTITUDE_REFERENCE_HOME)
        case mavlink.MAV_CMD_NAV_LAND | mavlink.MAV_CMD_NAV_VTOL_LAND:
            request = _automatic(translate.land())
        case mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH:
            request = _automatic(translate.return_to_launch())
        case mavlink.MAV_CMD_DO_CHANGE_SPEED if item.param2 > 0.0:
            request = translate.set_speed(item.param2)
        case mavlink.MAV_CMD_DO_MOUNT_CONTROL:
            request = translate.gimbal(item.param1, item.param3)
        case mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW:
            request = translate.gimbal(item.param1, item.param2)
    return [] if request is None else [request], at


def route_of(mission: Mission, first: int, at: Place, *, on_ground: bool) -> list[tuple[int, Request]]:
    """Return the calls that fly a mission, with the number of the item of each call.

    Args:
        mission: Mission. Its state does not change.
        first: Number of the first item.
        at: Present place of the drone.
        on_ground: True if the drone has to take off. If the mission does not begin with a takeoff, the route begins with
            a takeoff to the altitude of its first leg.

    Raises:
        Untranslatable: The route has too many steps.
    """
    probe = Mission()
    probe.store.items = [_limited(item) for item in mission.items]
    route: list[tuple[int, Request]] = []
    number: int | None = first
    steps = 0
    while number is not None:
        steps += 1
        if steps + probe.jumps_passed > MAX_STEPS:
            raise Untranslatable(f"the mission has more than {MAX_STEPS} steps; use fewer items or jumps")
        item = probe.items[number]
        requests, at = requests_of(probe, number, at)
        approaches = item.command == mavlink.MAV_CMD_CONDITION_DISTANCE and bool(requests)
        if on_ground and (approaches or (item.navigates and item.command != mavlink.MAV_CMD_NAV_DELAY)):
            on_ground = False
            if item.command not in TAKEOFFS and at.reference == types_pb2.ALTITUDE_REFERENCE_HOME:
                takeoff = Request("Takeoff", mobility_pb2.TakeoffRequest(altitude_m=at.altitude_m))
                requests = [takeoff, *requests]
        route += [(number, request) for request in requests]
        if len(route) > MAX_STEPS:
            raise Untranslatable(
                f"the mission has more than {MAX_STEPS} legs and other calls; use fewer items or circles"
            )
        if lands(item):
            return route
        number = probe.next_after(number)
    return route


def _target(item: Item, at: Place) -> Place:
    """Return the target of a leg. As on ArduCopter, an altitude of 0 keeps the altitude."""
    lat = item.x / 1e7 if item.has_place else at.lat
    lon = item.y / 1e7 if item.has_place else at.lon
    if item.z == 0.0:
        return replace(at, lat=lat, lon=lon)
    absolute = item.frame in ABSOLUTE_FRAMES
    reference = types_pb2.ALTITUDE_REFERENCE_AMSL if absolute else types_pb2.ALTITUDE_REFERENCE_HOME
    return replace(at, lat=lat, lon=lon, altitude_m=item.z, reference=reference)


def _circle(item: Item, at: Place) -> list[Place]:
    """Return the corners of the legs that replace a circle. The first one is the nearest point of the circle, as on ArduCopter."""
    centre = _target(item, at)
    radius_m = abs(item.param3) or DEFAULT_RADIUS_M
    frame = LocalFrame(centre.lat, centre.lon)
    east, north = frame.xy(at.lat, at.lon)
    begin = math.atan2(east, north)
    step = math.copysign(math.tau / LEGS_PER_TURN, item.param3)
    corners: list[Place] = []
    for number in range(round(item.param1 * LEGS_PER_TURN) + 1):
        angle = begin + number * step
        lat, lon = frame.latlon(radius_m * math.sin(angle), radius_m * math.cos(angle))
        corners.append(replace(centre, lat=lat, lon=lon))
    return corners


def _approach(mission: Mission, number: int, at: Place) -> list[Place]:
    """Return the place at which a CONDITION_DISTANCE ends, or no place if the drone is already nearer to the next waypoint."""
    following = mission.peek_after(number)
    if following is None or mission.items[following].command not in _LEGS:
        return []
    end = _target(mission.items[following], at)
    frame = LocalFrame(end.lat, end.lon)
    east, north = frame.xy(at.lat, at.lon)
    distance_m = math.hypot(east, north)
    rest_m = max(mission.items[number].param1, 0.0)
    if distance_m <= rest_m:
        return []
    share = rest_m / distance_m
    lat, lon = frame.latlon(east * share, north * share)
    place = replace(end, lat=lat, lon=lon)
    if at.reference == end.reference:
        place = replace(place, altitude_m=end.altitude_m + (at.altitude_m - end.altitude_m) * share)
    return [place]


def _goto(place: Place) -> Request:
    return _automatic(translate.goto(place.lat, place.lon, place.altitude_m, place.reference, place.yaw_deg))


def _automatic(request: Request) -> Request:
    return replace(request, mode=mavlink.COPTER_MODE_AUTO)


def _limited(item: Item) -> Item:
    """Return an item with a limited number of repetitions of a jump. Each turn of a circle flies the same legs."""
    if item.command == mavlink.MAV_CMD_NAV_LOITER_TURNS:
        return replace(item, param1=min(item.param1, 1.0))
    if item.command not in _JUMPS:
        return item
    endless = item.param2 < 0.0
    return replace(item, param2=JUDGED_REPETITIONS if endless else min(item.param2, JUDGED_REPETITIONS))

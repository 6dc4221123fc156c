"""Flies a vehicle's task from a ground station, a step at a time; each generator goes on at every poll."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence

from fractus_mavlink.enums import COPTER_MODE, MAV_CMD, MAV_FRAME, MAV_RESULT, SPEED_TYPE
from fractus_vehicle import earth
from fractus_vehicle.copter import POSITION_ONLY

from fractus_sim.experiment.station import Station
from fractus_sim.experiment.tasks import (
    FlyMission,
    Goto,
    Hold,
    Land,
    Place,
    ReturnToLaunch,
    SetMode,
    Speed,
    Step,
    Takeoff,
)

ANSWER_S = 1.0
ATTEMPTS = 5
ARM_S = 60.0
RELATIVE_FRAME = MAV_FRAME.GLOBAL_RELATIVE_ALT_INT
REMIND_S = 5.0
CLIMBED = 0.95
Flight = Generator[None, None, None]


class TaskFailed(Exception):
    """The vehicle refused a step, or its autopilot took over; the text says what happened."""


def fly(station: Station, steps: Sequence[Step], tell: Callable[[str], None]) -> Flight:
    """Fly a task.

    Args:
        station: The link to the vehicle.
        steps: What to fly.
        tell: Gets the name of each step as it begins.

    Raises:
        TaskFailed: a step was refused, or the autopilot changed its mode by itself.
    """
    speed_mps: float | None = None
    for step in steps:
        tell(step.title)
        match step:
            case Takeoff():
                yield from _take_off(station, step.alt)
            case Goto():
                yield from _go(station, step, speed_mps)
            case Speed():
                speed_mps = step.speed
                yield from _command(station, MAV_CMD.DO_CHANGE_SPEED, SPEED_TYPE.GROUNDSPEED, speed_mps, -1)
            case Hold():
                yield from _hold(station, step.seconds)
            case SetMode():
                yield from _enter(station, COPTER_MODE[step.mode])
            case FlyMission():
                yield from _mission(station, step)
            case ReturnToLaunch():
                yield from _down(station, COPTER_MODE.RTL)
            case Land():
                yield from _down(station, COPTER_MODE.LAND)


def _command(station: Station, command: MAV_CMD, *params: float) -> Flight:
    """Send a command until it is answered.

    Raises:
        TaskFailed: it was refused, or never answered.
    """
    for _ in range(ATTEMPTS):
        station.command(command, *params)
        deadline = station.now_s + ANSWER_S
        while station.now_s < deadline:
            yield
            if command in station.acks:
                result = MAV_RESULT(station.acks[command])
                if result is not MAV_RESULT.ACCEPTED:
                    said = f": {station.state.texts[-1][2]}" if station.state.texts else ""
                    raise TaskFailed(f"{command.name} was answered {result.name}{said}")
                return
    raise TaskFailed(f"{command.name} was not answered")


def _enter(station: Station, mode: COPTER_MODE) -> Flight:
    yield from _command(station, MAV_CMD.DO_SET_MODE, 1, mode)
    deadline = station.now_s + 3.0
    while station.state.mode != mode.name:
        if station.now_s > deadline:
            raise TaskFailed(f"mode {mode.name} was accepted, but the vehicle is in {station.state.mode}")
        yield


def _arm(station: Station) -> Flight:
    deadline = station.now_s + ARM_S
    while not station.state.armed:
        station.command(MAV_CMD.COMPONENT_ARM_DISARM, 1)
        again = station.now_s + ANSWER_S
        while station.now_s < again and not station.state.armed:
            yield
        if station.now_s > deadline:
            said = station.state.texts[-1][2] if station.state.texts else "it says nothing"
            raise TaskFailed(f"the vehicle does not arm: {said}")


def _take_off(station: Station, altitude_m: float) -> Flight:
    yield from _enter(station, COPTER_MODE.GUIDED)
    yield from _arm(station)
    yield from _command(station, MAV_CMD.NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, altitude_m)
    while station.state.alt_m < CLIMBED * altitude_m:
        _expect(station, COPTER_MODE.GUIDED)
        yield


def _go(station: Station, step: Goto, speed_mps: float | None) -> Flight:
    target = _point(station, step)
    lat, lon = target.lat_e7, target.lon_e7
    remind_s = station.now_s
    while True:
        if station.now_s >= remind_s:
            remind_s = station.now_s + REMIND_S
            where = {"lat_int": lat, "lon_int": lon, "alt": step.alt}
            frame = {"coordinate_frame": int(RELATIVE_FRAME), "type_mask": int(POSITION_ONLY)}
            station.tell("SET_POSITION_TARGET_GLOBAL_INT", {**where, **frame})
            if speed_mps is not None:  # the first leg begins with the parameters' speed, whatever was set before
                station.command(MAV_CMD.DO_CHANGE_SPEED, SPEED_TYPE.GROUNDSPEED, speed_mps, -1)
        yield
        _expect(station, COPTER_MODE.GUIDED)
        here = earth.Place.from_degrees(station.state.lat, station.state.lon, 0.0)
        north, east, _ = here.vector_to(target)
        if math.hypot(north, east, step.alt - station.state.alt_m) <= step.within:
            return


def _hold(station: Station, seconds: float) -> Flight:
    mode, end = station.state.mode, station.now_s + seconds
    while station.now_s < end:
        yield
        if station.state.mode != mode:
            raise TaskFailed(f"the autopilot changed to {station.state.mode}")


def _down(station: Station, mode: COPTER_MODE) -> Flight:
    yield from _enter(station, mode)
    while station.state.armed:
        if station.state.mode not in {mode.name, "LAND"}:
            raise TaskFailed(f"the autopilot changed to {station.state.mode}")
        yield


def _expect(station: Station, mode: COPTER_MODE) -> None:
    if station.state.mode != mode.name:
        raise TaskFailed(f"the autopilot changed to {station.state.mode}")
    if not station.state.armed:
        raise TaskFailed("the vehicle disarmed")


def _point(station: Station, place: Place) -> earth.Place:
    """The place in degrees times 1e7.

    Raises:
        TaskFailed: it is relative to home, and the vehicle has none yet.
    """
    if place.lat is not None and place.lon is not None:
        return earth.Place.from_degrees(place.lat, place.lon, 0.0)
    home = station.state.home
    if home is None:
        raise TaskFailed("the vehicle has no home yet, so metres from home mean nothing")
    return earth.Place.from_degrees(home[0], home[1], 0.0).offset(place.north or 0.0, place.east or 0.0)


def _mission(station: Station, step: FlyMission) -> Flight:
    yield from _upload(station, _items(station, step))
    yield from _enter(station, COPTER_MODE.GUIDED)
    yield from _arm(station)
    yield from _enter(station, COPTER_MODE.AUTO)
    yield from _command(station, MAV_CMD.MISSION_START, 0, 0)
    while station.state.armed:
        if station.state.mode != "AUTO":
            raise TaskFailed(f"the autopilot changed to {station.state.mode}")
        yield


def _items(station: Station, step: FlyMission) -> list[dict[str, float]]:
    """The mission as MISSION_ITEM_INT fields; the first is home, as ArduPilot keeps it."""
    first: dict[str, float] = {"command": int(MAV_CMD.NAV_WAYPOINT), "frame": MAV_FRAME.GLOBAL}
    items: list[dict[str, float]] = [
        first,
        {"command": int(MAV_CMD.NAV_TAKEOFF), "frame": RELATIVE_FRAME, "z": step.takeoff},
    ]
    for waypoint in step.waypoints:
        at = _point(station, waypoint)
        place = {"x": at.lat_e7, "y": at.lon_e7, "z": waypoint.alt}
        items.append({"command": int(MAV_CMD.NAV_WAYPOINT), "frame": RELATIVE_FRAME, "param1": waypoint.hold, **place})
    last = MAV_CMD.NAV_RETURN_TO_LAUNCH if step.land == "home" else MAV_CMD.NAV_LAND
    return [*items, {"command": int(last), "frame": RELATIVE_FRAME}]


def _upload(station: Station, items: Sequence[dict[str, float]]) -> Flight:
    """Upload a mission.

    Raises:
        TaskFailed: the vehicle refused it, or does not ask for it.
    """
    station.tell("MISSION_COUNT", {"count": len(items)})
    deadline = station.now_s + ANSWER_S * ATTEMPTS
    while station.now_s < deadline:
        yield
        for message in station.inbox:
            if message.name in {"MISSION_REQUEST", "MISSION_REQUEST_INT"}:
                seq = message.integer("seq")
                deadline = station.now_s + ANSWER_S * ATTEMPTS
                if seq < len(items):
                    station.tell("MISSION_ITEM_INT", {"seq": seq, "autocontinue": 1, **items[seq]})
            elif message.name == "MISSION_ACK":
                if message.integer("type"):
                    raise TaskFailed(f"the mission was refused with {message.integer('type')}")
                return
    raise TaskFailed("the vehicle did not take the mission")

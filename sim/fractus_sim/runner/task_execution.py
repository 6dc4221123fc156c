"""Execution of a vehicle's task by a ground station. Each task is a generator that is resumed at every poll."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence

from fractus_runtime.mavlink_codec import enum_name, enum_names
from fractus_vehicle import earth
from fractus_vehicle.copter import POSITION_ONLY
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_sim.experiment.task_steps import (
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
from fractus_sim.testbeds.ground_station import Station

ANSWER_S = 1.0
ATTEMPTS = 5
ARM_S = 60.0
RELATIVE_FRAME = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
REMIND_S = 5.0
CLIMBED = 0.95
_MODES = {name: mode for mode, name in enum_names("COPTER_MODE").items()}
Flight = Generator[None, None, None]


class TaskFailed(Exception):
    """The vehicle rejected a step, or the autopilot took over. The message says what happened."""


def fly(station: Station, steps: Sequence[Step], tell: Callable[[str], None]) -> Flight:
    """Fly a task.

    Args:
        station: Link to the vehicle.
        steps: Steps of the task.
        tell: Called with the title of each step when it begins.

    Raises:
        TaskFailed: A step was rejected, or the autopilot changed its mode.
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
                yield from _command(
                    station, mavlink.MAV_CMD_DO_CHANGE_SPEED, mavlink.SPEED_TYPE_GROUNDSPEED, speed_mps, -1
                )
            case Hold():
                yield from _hold(station, step.seconds)
            case SetMode():
                yield from _enter(station, _MODES[step.mode])
            case FlyMission():
                yield from _mission(station, step)
            case ReturnToLaunch():
                yield from _down(station, mavlink.COPTER_MODE_RTL)
            case Land():
                yield from _down(station, mavlink.COPTER_MODE_LAND)


def _command(station: Station, command: int, *params: float) -> Flight:
    """Send a command until it is acknowledged.

    Raises:
        TaskFailed: The command was rejected or not acknowledged.
    """
    for _ in range(ATTEMPTS):
        station.command(command, *params)
        deadline = station.now_s + ANSWER_S
        while station.now_s < deadline:
            yield
            if command in station.acks:
                result = station.acks[command]
                if result != mavlink.MAV_RESULT_ACCEPTED:
                    detail = f": {station.state.texts[-1][2]}" if station.state.texts else ""
                    raise TaskFailed(
                        f"{enum_name('MAV_CMD', command)} was rejected with {enum_name('MAV_RESULT', result)}{detail}"
                    )
                return
    raise TaskFailed(f"{enum_name('MAV_CMD', command)} was not acknowledged")


def _enter(station: Station, mode: int) -> Flight:
    yield from _command(station, mavlink.MAV_CMD_DO_SET_MODE, 1, mode)
    deadline = station.now_s + 3.0
    while station.state.mode != enum_name("COPTER_MODE", mode):
        if station.now_s > deadline:
            raise TaskFailed(
                f"mode {enum_name('COPTER_MODE', mode)} was accepted, but the vehicle is in {station.state.mode}"
            )
        yield


def _arm(station: Station) -> Flight:
    deadline = station.now_s + ARM_S
    while not station.state.armed:
        station.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
        again = station.now_s + ANSWER_S
        while station.now_s < again and not station.state.armed:
            yield
        if station.now_s > deadline:
            detail = station.state.texts[-1][2] if station.state.texts else "no STATUSTEXT received"
            raise TaskFailed(f"the vehicle does not arm: {detail}")


def _take_off(station: Station, altitude_m: float) -> Flight:
    yield from _enter(station, mavlink.COPTER_MODE_GUIDED)
    yield from _arm(station)
    yield from _command(station, mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, altitude_m)
    while station.state.alt_m < CLIMBED * altitude_m:
        _expect(station, mavlink.COPTER_MODE_GUIDED)
        yield


def _go(station: Station, step: Goto, speed_mps: float | None) -> Flight:
    target = _point(station, step)
    lat = target.lat_e7
    lon = target.lon_e7
    remind_s = station.now_s
    while True:
        if station.now_s >= remind_s:
            remind_s = station.now_s + REMIND_S
            where = {"lat_int": lat, "lon_int": lon, "alt": step.alt}
            frame = {"coordinate_frame": int(RELATIVE_FRAME), "type_mask": int(POSITION_ONLY)}
            station.tell("SET_POSITION_TARGET_GLOBAL_INT", {**where, **frame})
            # # The first leg starts with the speed of the parameters, regardless of earlier commands.
            if speed_mps is not None:
                station.command(mavlink.MAV_CMD_DO_CHANGE_SPEED, mavlink.SPEED_TYPE_GROUNDSPEED, speed_mps, -1)
        yield
        _expect(station, mavlink.COPTER_MODE_GUIDED)
        here = earth.Place.from_degrees(station.state.lat, station.state.lon, 0.0)
        north, east, _ = here.vector_to(target)
        if math.hypot(north, east, step.alt - station.state.alt_m) <= step.within:
            return


def _hold(station: Station, seconds: float) -> Flight:
    mode = station.state.mode
    end = station.now_s + seconds
    while station.now_s < end:
        yield
        if station.state.mode != mode:
            raise TaskFailed(f"the autopilot changed to {station.state.mode}")


def _down(station: Station, mode: int) -> Flight:
    yield from _enter(station, mode)
    while station.state.armed:
        if station.state.mode not in {enum_name("COPTER_MODE", mode), "LAND"}:
            raise TaskFailed(f"the autopilot changed to {station.state.mode}")
        yield


def _expect(station: Station, mode: int) -> None:
    if station.state.mode != enum_name("COPTER_MODE", mode):
        raise TaskFailed(f"the autopilot changed to {station.state.mode}")
    if not station.state.armed:
        raise TaskFailed("the vehicle disarmed")


def _point(station: Station, place: Place) -> earth.Place:
    """Resolve a place of the experiment file.

    Raises:
        TaskFailed: The place is relative to home, and the home position is unknown.
    """
    if place.lat is not None and place.lon is not None:
        return earth.Place.from_degrees(place.lat, place.lon, 0.0)
    home = station.state.home
    if home is None:
        raise TaskFailed("home position unknown; cannot resolve a position in metres from home")
    return earth.Place.from_degrees(home[0], home[1], 0.0).offset(place.north or 0.0, place.east or 0.0)


def _mission(station: Station, step: FlyMission) -> Flight:
    yield from _upload(station, _items(station, step))
    yield from _enter(station, mavlink.COPTER_MODE_GUIDED)
    yield from _arm(station)
    yield from _enter(station, mavlink.COPTER_MODE_AUTO)
    yield from _command(station, mavlink.MAV_CMD_MISSION_START, 0, 0)
    while station.state.armed:
        if station.state.mode != "AUTO":
            raise TaskFailed(f"the autopilot changed to {station.state.mode}")
        yield


def _items(station: Station, step: FlyMission) -> list[dict[str, float]]:
    """Return the mission as MISSION_ITEM_INT fields. Item 0 is home, as in ArduPilot."""
    first: dict[str, float] = {"command": int(mavlink.MAV_CMD_NAV_WAYPOINT), "frame": mavlink.MAV_FRAME_GLOBAL}
    items: list[dict[str, float]] = [
        first,
        {"command": int(mavlink.MAV_CMD_NAV_TAKEOFF), "frame": RELATIVE_FRAME, "z": step.takeoff},
    ]
    for waypoint in step.waypoints:
        at = _point(station, waypoint)
        place = {"x": at.lat_e7, "y": at.lon_e7, "z": waypoint.alt}
        items.append(
            {"command": int(mavlink.MAV_CMD_NAV_WAYPOINT), "frame": RELATIVE_FRAME, "param1": waypoint.hold, **place}
        )
    last = mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH if step.land == "home" else mavlink.MAV_CMD_NAV_LAND
    return [*items, {"command": int(last), "frame": RELATIVE_FRAME}]


def _upload(station: Station, items: Sequence[dict[str, float]]) -> Flight:
    """Upload a mission.

    Raises:
        TaskFailed: The vehicle rejected the mission or does not request its items.
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
                    raise TaskFailed(f"the mission was rejected with MAV_MISSION_RESULT {message.integer('type')}")
                return
    raise TaskFailed("the vehicle did not complete the mission upload")

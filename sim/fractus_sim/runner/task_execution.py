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

RESPONSE_TIMEOUT_S = 1.0
ATTEMPTS = 5
ARM_TIMEOUT_S = 60.0
MODE_TIMEOUT_S = 3.0
RELATIVE_FRAME = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
REPEAT_S = 5.0
"""Interval of repeated position targets."""

TAKEOFF_SHARE = 0.95
"""Share of the takeoff altitude at which the takeoff is complete."""

_MODES = {name: mode for mode, name in enum_names("COPTER_MODE").items()}
Task = Generator[None, None, None]


class TaskFailed(Exception):
    """The vehicle rejected a step, or the autopilot took over. The message says what happened."""


def fly_task(station: Station, steps: Sequence[Step], report: Callable[[str], None]) -> Task:
    """Fly a task.

    Args:
        station: Link to the vehicle.
        steps: Steps of the task.
        report: Called with the title of each step when it begins.

    Raises:
        TaskFailed: A step was rejected, or the autopilot changed its mode.
    """
    speed_mps: float | None = None
    for step in steps:
        report(step.title)
        match step:
            case Takeoff():
                yield from _take_off(station, step.alt)
            case Goto():
                yield from _fly_to(station, step, speed_mps)
            case Speed():
                speed_mps = step.speed
                yield from _command(
                    station, mavlink.MAV_CMD_DO_CHANGE_SPEED, mavlink.SPEED_TYPE_GROUNDSPEED, speed_mps, -1
                )
            case Hold():
                yield from _hold(station, step.seconds)
            case SetMode():
                yield from _set_mode(station, _MODES[step.mode])
            case FlyMission():
                yield from _fly_mission(station, step)
            case ReturnToLaunch():
                yield from _land(station, mavlink.COPTER_MODE_RTL)
            case Land():
                yield from _land(station, mavlink.COPTER_MODE_LAND)


def _command(station: Station, command: int, *params: float) -> Task:
    """Send a command until it is acknowledged.

    Raises:
        TaskFailed: The command was rejected or not acknowledged.
    """
    for _ in range(ATTEMPTS):
        station.command(command, *params)
        deadline = station.now_s + RESPONSE_TIMEOUT_S
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


def _set_mode(station: Station, mode: int) -> Task:
    """Change the flight mode, and wait until the vehicle reports it.

    Raises:
        TaskFailed: The vehicle rejected the mode or did not enter it in time.
    """
    yield from _command(station, mavlink.MAV_CMD_DO_SET_MODE, 1, mode)
    deadline = station.now_s + MODE_TIMEOUT_S
    while station.state.mode != enum_name("COPTER_MODE", mode):
        if station.now_s > deadline:
            raise TaskFailed(
                f"mode {enum_name('COPTER_MODE', mode)} was accepted, but the vehicle is in {station.state.mode}"
            )
        yield


def _arm(station: Station) -> Task:
    deadline = station.now_s + ARM_TIMEOUT_S
    while not station.state.armed:
        station.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
        retry_s = station.now_s + RESPONSE_TIMEOUT_S
        while station.now_s < retry_s and not station.state.armed:
            yield
        if station.now_s > deadline:
            raise TaskFailed(f"the vehicle does not arm: {station.state.last_text}")


def _take_off(station: Station, altitude_m: float) -> Task:
    yield from _set_mode(station, mavlink.COPTER_MODE_GUIDED)
    yield from _arm(station)
    yield from _command(station, mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, altitude_m)
    while station.state.alt_m < TAKEOFF_SHARE * altitude_m:
        _require_mode(station, mavlink.COPTER_MODE_GUIDED)
        yield


def _fly_to(station: Station, step: Goto, speed_mps: float | None) -> Task:
    target = _resolve(station, step)
    repeat_s = station.now_s
    while True:
        if station.now_s >= repeat_s:
            repeat_s = station.now_s + REPEAT_S
            position = {"lat_int": target.lat_e7, "lon_int": target.lon_e7, "alt": step.alt}
            frame = {"coordinate_frame": int(RELATIVE_FRAME), "type_mask": int(POSITION_ONLY)}
            station.send_to_autopilot("SET_POSITION_TARGET_GLOBAL_INT", {**position, **frame})
            # The first leg starts with the speed of the parameters, so the speed command is sent after the target.
            if speed_mps is not None:
                station.command(mavlink.MAV_CMD_DO_CHANGE_SPEED, mavlink.SPEED_TYPE_GROUNDSPEED, speed_mps, -1)
        yield
        _require_mode(station, mavlink.COPTER_MODE_GUIDED)
        position_now = earth.Place.from_degrees(station.state.lat, station.state.lon, 0.0)
        north, east, _ = position_now.vector_to(target)
        if math.hypot(north, east, step.alt - station.state.alt_m) <= step.within:
            return


def _hold(station: Station, seconds: float) -> Task:
    mode = station.state.mode
    end = station.now_s + seconds
    while station.now_s < end:
        yield
        if station.state.mode != mode:
            raise TaskFailed(f"the autopilot changed to {station.state.mode}")


def _land(station: Station, mode: int) -> Task:
    yield from _set_mode(station, mode)
    while station.state.armed:
        if station.state.mode not in {enum_name("COPTER_MODE", mode), "LAND"}:
            raise TaskFailed(f"the autopilot changed to {station.state.mode}")
        yield


def _require_mode(station: Station, mode: int) -> None:
    """Check that the vehicle is still armed in a mode.

    Raises:
        TaskFailed: The vehicle is in another mode, or disarmed.
    """
    if station.state.mode != enum_name("COPTER_MODE", mode):
        raise TaskFailed(f"the autopilot changed to {station.state.mode}")
    if not station.state.armed:
        raise TaskFailed("the vehicle disarmed")


def _resolve(station: Station, place: Place) -> earth.Place:
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


def _fly_mission(station: Station, step: FlyMission) -> Task:
    yield from _upload_mission(station, _mission_items(station, step))
    yield from _set_mode(station, mavlink.COPTER_MODE_GUIDED)
    yield from _arm(station)
    yield from _set_mode(station, mavlink.COPTER_MODE_AUTO)
    yield from _command(station, mavlink.MAV_CMD_MISSION_START, 0, 0)
    while station.state.armed:
        if station.state.mode != "AUTO":
            raise TaskFailed(f"the autopilot changed to {station.state.mode}")
        yield


def _mission_items(station: Station, step: FlyMission) -> list[dict[str, float]]:
    """Return the mission as MISSION_ITEM_INT fields. Item 0 is home, as in ArduPilot."""
    home: dict[str, float] = {"command": int(mavlink.MAV_CMD_NAV_WAYPOINT), "frame": mavlink.MAV_FRAME_GLOBAL}
    items: list[dict[str, float]] = [
        home,
        {"command": int(mavlink.MAV_CMD_NAV_TAKEOFF), "frame": RELATIVE_FRAME, "z": step.takeoff},
    ]
    for waypoint in step.waypoints:
        target = _resolve(station, waypoint)
        place = {"x": target.lat_e7, "y": target.lon_e7, "z": waypoint.alt}
        items.append(
            {"command": int(mavlink.MAV_CMD_NAV_WAYPOINT), "frame": RELATIVE_FRAME, "param1": waypoint.hold, **place}
        )
    last = mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH if step.land == "home" else mavlink.MAV_CMD_NAV_LAND
    return [*items, {"command": int(last), "frame": RELATIVE_FRAME}]


def _upload_mission(station: Station, items: Sequence[dict[str, float]]) -> Task:
    """Upload a mission.

    Raises:
        TaskFailed: The vehicle rejected the mission or does not request its items.
    """
    station.send_to_autopilot("MISSION_COUNT", {"count": len(items)})
    deadline = station.now_s + RESPONSE_TIMEOUT_S * ATTEMPTS
    while station.now_s < deadline:
        yield
        for message in station.inbox:
            if message.name in {"MISSION_REQUEST", "MISSION_REQUEST_INT"}:
                seq = message.integer("seq")
                deadline = station.now_s + RESPONSE_TIMEOUT_S * ATTEMPTS
                if seq < len(items):
                    station.send_to_autopilot("MISSION_ITEM_INT", {"seq": seq, "autocontinue": 1, **items[seq]})
            elif message.name == "MISSION_ACK":
                if message.integer("type"):
                    raise TaskFailed(f"the mission was rejected with MAV_MISSION_RESULT {message.integer('type')}")
                return
    raise TaskFailed("the vehicle did not complete the mission upload")

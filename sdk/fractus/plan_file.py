"""Plan files of QGroundControl (.plan) as waypoints of a mission."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from fractus.errors import InvalidRequest
from fractus.mission import Waypoint
from fractus.values import AltitudeReference, Position

_REFERENCES = {
    **dict.fromkeys((0, 5), AltitudeReference.AMSL),
    **dict.fromkeys((3, 6), AltitudeReference.HOME),
    **dict.fromkeys((10, 11), AltitudeReference.TERRAIN),
}
"""Altitude references by MAV_FRAME."""

_NAV_WAYPOINT = 16
_NAV_TAKEOFF = 22
_ENDS = frozenset({20, 21})
_DO_CHANGE_SPEED = 178
_GROUND_SPEEDS = (0, 1)
_VERTICAL_SPEEDS = (2, 3)
_SAME_SPEED = -1
_DEFAULT_SPEED = -2

_COMMANDS = {
    16: "NAV_WAYPOINT", 17: "NAV_LOITER_UNLIM", 18: "NAV_LOITER_TURNS", 19: "NAV_LOITER_TIME", 20: "NAV_RETURN_TO_LAUNCH",
    21: "NAV_LAND", 22: "NAV_TAKEOFF", 30: "NAV_CONTINUE_AND_CHANGE_ALT", 31: "NAV_LOITER_TO_ALT", 34: "DO_ORBIT",
    36: "NAV_ARC_WAYPOINT", 80: "NAV_ROI", 82: "NAV_SPLINE_WAYPOINT", 83: "NAV_ALTITUDE_WAIT", 84: "NAV_VTOL_TAKEOFF",
    85: "NAV_VTOL_LAND", 92: "NAV_GUIDED_ENABLE", 93: "NAV_DELAY", 94: "NAV_PAYLOAD_PLACE", 112: "CONDITION_DELAY",
    113: "CONDITION_CHANGE_ALT", 114: "CONDITION_DISTANCE", 115: "CONDITION_YAW", 176: "DO_SET_MODE", 177: "DO_JUMP",
    178: "DO_CHANGE_SPEED", 179: "DO_SET_HOME", 180: "DO_SET_PARAMETER", 181: "DO_SET_RELAY", 182: "DO_REPEAT_RELAY",
    183: "DO_SET_SERVO", 184: "DO_REPEAT_SERVO", 185: "DO_FLIGHTTERMINATION", 186: "DO_CHANGE_ALTITUDE", 187: "DO_SET_ACTUATOR",
    188: "DO_RETURN_PATH_START", 189: "DO_LAND_START", 192: "DO_REPOSITION", 193: "DO_PAUSE_CONTINUE", 194: "DO_SET_REVERSE",
    207: "DO_FENCE_ENABLE", 208: "DO_PARACHUTE", 209: "DO_MOTOR_TEST", 210: "DO_INVERTED_FLIGHT", 211: "DO_GRIPPER",
    212: "DO_AUTOTUNE_ENABLE", 213: "NAV_SET_YAW_SPEED", 215: "DO_SET_RESUME_REPEAT_DIST", 216: "DO_SPRAYER",
    217: "DO_SEND_SCRIPT_MESSAGE", 218: "DO_AUX_FUNCTION", 222: "DO_GUIDED_LIMITS", 223: "DO_ENGINE_CONTROL",
    600: "JUMP_TAG", 601: "DO_JUMP_TAG", 4501: "CONDITION_GATE", 42600: "DO_WINCH", 42702: "NAV_SCRIPT_TIME", 42703: "NAV_ATTITUDE_TIME",
}  # fmt: skip
"""Names of the MAVLink commands that occur in missions, by their number, without the prefix MAV_CMD."""

_CAMERA_COMMANDS = {
    195: "DO_SET_ROI_LOCATION", 196: "DO_SET_ROI_WPNEXT_OFFSET", 197: "DO_SET_ROI_NONE", 198: "DO_SET_ROI_SYSID",
    200: "DO_CONTROL_VIDEO", 201: "DO_SET_ROI", 202: "DO_DIGICAM_CONFIGURE", 203: "DO_DIGICAM_CONTROL", 204: "DO_MOUNT_CONFIGURE",
    205: "DO_MOUNT_CONTROL", 206: "DO_SET_CAM_TRIGG_DIST", 214: "DO_SET_CAM_TRIGG_INTERVAL", 220: "DO_MOUNT_CONTROL_QUAT",
    530: "SET_CAMERA_MODE", 531: "SET_CAMERA_ZOOM", 532: "SET_CAMERA_FOCUS", 534: "SET_CAMERA_SOURCE",
    1000: "DO_GIMBAL_MANAGER_PITCHYAW", 1001: "DO_GIMBAL_MANAGER_CONFIGURE", 2000: "IMAGE_START_CAPTURE", 2001: "IMAGE_STOP_CAPTURE",
    2003: "DO_TRIGGER_CONTROL", 2500: "VIDEO_START_CAPTURE", 2501: "VIDEO_STOP_CAPTURE",
}  # fmt: skip
"""Commands for cameras and gimbals. They do not change the path, so they are omitted."""

_log = logging.getLogger("fractus")


@dataclass(frozen=True, slots=True)
class _Item:
    """A command of a plan, with its place in error messages (`survey.plan: item 3`)."""

    place: str
    command: int
    fields: dict[str, Any]

    @property
    def name(self) -> str:
        name = _COMMANDS.get(self.command) or _CAMERA_COMMANDS.get(self.command)
        return f"MAV_CMD_{name}" if name else f"MAV_CMD {self.command}"

    def refuse(self, problem: str) -> NoReturn:
        raise InvalidRequest(f"{self.place} ({self.name}) {problem}")

    def parameters(self) -> list[float | None]:
        """Return the seven parameters. None is an unset parameter (NaN in MAVLink).

        Raises:
            InvalidRequest: They are missing, or not numbers.
        """
        params = self.fields.get("params")
        if "coordinate" in self.fields or (isinstance(params, list) and len(params) == 4):
            self.refuse(
                "is of an old version of QGroundControl; open the plan with a current version and save it again"
            )
        if not isinstance(params, list) or len(params) != 7:
            self.refuse("must have a list of 7 params; save the plan again")
        for i, value in enumerate(params, start=1):
            if value is not None and not _is_number(value):
                self.refuse(f"has the param {i} {value!r:.40}, which must be a number or null; save the plan again")
        return [None if value is None else float(value) for value in params]


def read_plan(path: str | Path) -> tuple[Waypoint, ...]:
    """Return the waypoints of a QGroundControl plan (.plan) with speeds, headings and stays, including surveys.

    The first takeoff and the last landing or return are omitted, because the program takes off and the system flies home.
    Commands for cameras and gimbals are omitted with a warning, because pictures are taken through the camera service, and
    so are climb and descent speeds, fences and rally points. Every other command is refused.

    Raises:
        InvalidRequest: The file is not a plan, or contains a command that cannot be flown. The message names the item by
            its number in QGroundControl's order, from 1, and the command.
    """
    try:
        plan = json.loads(Path(path).read_bytes())
    except OSError as error:
        raise InvalidRequest(f"{path}: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise InvalidRequest(f"{path}: not a QGroundControl plan, which is JSON; save it as .plan ({error})") from None
    if isinstance(plan, dict) and plan.get("fileType", "Plan") != "Plan":
        raise InvalidRequest(
            f"{path}: fileType must be Plan, not {plan['fileType']!r:.40}; save the plan with QGroundControl"
        )
    mission = plan.get("mission") if isinstance(plan, dict) else None
    items = mission.get("items") if isinstance(mission, dict) else None
    if not isinstance(items, list):
        raise InvalidRequest(
            f"{path}: not a QGroundControl plan, because it has no list mission.items; save the plan again"
        )
    for part in ("geoFence", "rallyPoints"):
        contents = plan.get(part)
        lists = contents.values() if isinstance(contents, dict) else ()
        if any(isinstance(value, list) and value for value in lists):
            _log.warning("mission: plan part omitted (file=%s part=%s)", path, part)
    waypoints = tuple(_waypoints(list(_commands(items, f"{path}: item"))))
    if not waypoints:
        raise InvalidRequest(f"{path}: the plan contains no waypoint; add waypoints or a survey")
    return waypoints


def _commands(items: list[Any], place: str, *, in_pattern: bool = False) -> Iterator[_Item]:
    """Yield the commands of a plan, including those inside surveys and corridor scans.

    Raises:
        InvalidRequest: An item has no command, or is a pattern without commands.
    """
    for number, fields in enumerate(items, start=1):
        here = f"{place} {number}"
        if not isinstance(fields, dict):
            raise InvalidRequest(f"{here} must be an object, not {fields!r:.40}; save the plan again")
        if fields.get("type") == "ComplexItem":
            kind = fields.get("complexItemType", "ComplexItem")
            inner = fields.get("TransectStyleComplexItem", fields)
            parts = inner.get("Items") if isinstance(inner, dict) else None
            if in_pattern or not isinstance(parts, list) or not parts:
                raise InvalidRequest(
                    f"{here} ({kind}) contains no waypoints and cannot be flown; replace it by waypoints or a survey"
                )
            yield from _commands(parts, f"{here} ({kind}), part", in_pattern=True)
            continue
        command = fields.get("command")
        if not isinstance(command, int) or isinstance(command, bool):
            raise InvalidRequest(f"{here} has no MAV_CMD as command, but {command!r:.40}; save the plan again")
        yield _Item(here, command, fields)


def _waypoints(items: list[_Item]) -> Iterator[Waypoint]:
    """Yield the waypoints in order, each with the speed of the commands before it."""
    speed_mps: float | None = None
    flown = [i for i, item in enumerate(items) if item.command == _NAV_WAYPOINT]
    for i, item in enumerate(items):
        if item.command == _NAV_WAYPOINT:
            yield _waypoint(item, speed_mps)
        elif item.command == _DO_CHANGE_SPEED:
            speed_mps = _speed_mps(item, speed_mps)
        elif item.command in _CAMERA_COMMANDS:
            _log.warning("mission: plan item omitted (%s command=%s)", item.place, item.name)
        elif item.command == _NAV_TAKEOFF:
            if flown and i > flown[0]:
                item.refuse("comes after a waypoint and cannot be flown; split the plan there")
        elif item.command in _ENDS:
            if flown and i < flown[-1]:
                item.refuse("comes before a waypoint and cannot be flown; split the plan there")
        else:
            item.refuse("cannot be flown; remove it from the plan")


def _waypoint(item: _Item, speed_mps: float | None) -> Waypoint:
    frame = item.fields.get("frame")
    if not isinstance(frame, int) or frame not in _REFERENCES:
        item.refuse(f"has the unsupported frame {frame!r:.40}; use altitudes above home, AMSL or terrain")
    stay_s, radius_m, pass_m, yaw_deg, lat, lon, alt = item.parameters()
    if alt is None and item.fields.get("AltitudeMode") == 3:  # QGroundControl's "calculated above terrain"
        item.refuse("has no altitude above mean sea level (AltitudeMode 3); save the plan when terrain data is loaded")
    if lat is None or lon is None or alt is None:
        item.refuse("has no complete position; give latitude, longitude and altitude")
    if not (-90 <= lat <= 90 and -180 <= lon <= 180):
        item.refuse(f"has the position {lat}, {lon}, which is not a place on Earth; correct it")
    if lat == lon == 0:
        item.refuse("has the position 0, 0, which ArduPilot treats as the current position; place it on the map")
    if yaw_deg is not None and abs(yaw_deg) > 360:
        item.refuse(f"has the heading {yaw_deg:g} degrees; set param 4 to -360 to 360")
    if pass_m:
        item.refuse(f"passes its position at {pass_m} m, which cannot be flown; set param 3 to 0")
    if (stay_s or 0.0) < 0 or (radius_m or 0.0) < 0:
        item.refuse("has a negative stay or acceptance radius; set params 1 and 2 to 0 or more")
    position = Position(lat, lon, alt, _REFERENCES[frame])
    return Waypoint(position, yaw_deg, speed_mps, radius_m or 0.0, stay_s or 0.0)


def _speed_mps(item: _Item, current_mps: float | None) -> float | None:
    """Return the horizontal speed after DO_CHANGE_SPEED. A vertical speed does not change it."""
    kind, speed_mps, _, relative, *_ = item.parameters()
    if kind in _VERTICAL_SPEEDS:
        _log.warning("mission: plan item omitted (%s command=%s speed_type=%d)", item.place, item.name, kind)
        return current_mps
    if kind not in _GROUND_SPEEDS or relative:
        item.refuse("has an unknown speed type; use a ground speed (param 1: 1, param 4: 0)")
    if speed_mps == _DEFAULT_SPEED:
        return None
    if speed_mps is not None and speed_mps < 0 and speed_mps != _SAME_SPEED:
        item.refuse(f"has the speed {speed_mps:g} m/s; set param 2 to a speed above 0")
    return speed_mps if speed_mps is not None and speed_mps > 0 else current_mps


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e12

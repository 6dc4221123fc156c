"""Translation of MAVLink targets and commands to requests of the mobility service. Each function is pure."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from fractus_core.geo import LocalFrame
from fractus_proto.v1 import mobility_pb2, types_pb2
from fractus_runtime.mavlink_codec import Message, enum_name
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.gateway.virtual_vehicle import Pose, VirtualVehicle
from fractus_services.mavlink_server.coordinates import ABSOLUTE_FRAMES, RELATIVE_FRAMES, valid_coordinates

FORCE_MAGIC = 21196
FORCE_ARM_MAGIC = 2989

_POSITION = 0b111
_VELOCITY = 0b111 << 3
_YAW = mavlink.POSITION_TARGET_TYPEMASK_YAW_IGNORE
_YAW_RATE = mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE

_BODY_FRAMES = frozenset({mavlink.MAV_FRAME_BODY_NED, mavlink.MAV_FRAME_BODY_OFFSET_NED})
_LOCAL_FRAMES = _BODY_FRAMES | {mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_LOCAL_OFFSET_NED}

RETURN_MODES = frozenset({mavlink.COPTER_MODE_RTL, mavlink.COPTER_MODE_SMART_RTL})
HOVER_MODES = frozenset({mavlink.COPTER_MODE_BRAKE, mavlink.COPTER_MODE_LOITER, mavlink.COPTER_MODE_POSHOLD})


class Untranslatable(Exception):
    """The contents of a message cannot be translated to a call. The text is one sentence for the program.

    Attributes:
        result: MAV_RESULT for the acknowledgement of a command.
    """

    def __init__(self, reason: str, result: int = mavlink.MAV_RESULT_DENIED) -> None:
        super().__init__(reason)
        self.result = result


_CAMERA = "the camera is not available over MAVLink; use the camera service with the SDK"
_ROI = "a region of interest is not supported; point the camera with DO_GIMBAL_MANAGER_PITCHYAW"

UNSUPPORTED: Mapping[str, str] = {
    "NAV_LOITER_TURNS": "circles are flown as mission items only, as on ArduCopter",
    "CONDITION_DELAY": "conditions are mission items only, as on ArduCopter",
    "CONDITION_DISTANCE": "conditions are mission items only, as on ArduCopter",
    **dict.fromkeys(
        (
            "DO_CONTROL_VIDEO", "DO_DIGICAM_CONFIGURE", "DO_DIGICAM_CONTROL", "DO_SET_CAM_TRIGG_DIST",
            "DO_SET_CAM_TRIGG_INTERVAL", "REQUEST_CAMERA_INFORMATION", "REQUEST_CAMERA_SETTINGS",
            "REQUEST_CAMERA_CAPTURE_STATUS", "RESET_CAMERA_SETTINGS", "SET_CAMERA_MODE", "SET_CAMERA_ZOOM",
            "SET_CAMERA_FOCUS", "SET_CAMERA_SOURCE", "IMAGE_START_CAPTURE", "IMAGE_STOP_CAPTURE",
            "REQUEST_CAMERA_IMAGE_CAPTURE", "CAMERA_TRACK_POINT", "CAMERA_TRACK_RECTANGLE", "CAMERA_STOP_TRACKING",
            "VIDEO_START_CAPTURE", "VIDEO_STOP_CAPTURE", "VIDEO_START_STREAMING", "VIDEO_STOP_STREAMING",
            "REQUEST_VIDEO_STREAM_INFORMATION", "REQUEST_VIDEO_STREAM_STATUS",
        ),
        _CAMERA,
    ),
    **dict.fromkeys(
        (
            "NAV_ROI", "DO_SET_ROI", "DO_SET_ROI_LOCATION", "DO_SET_ROI_NONE", "DO_SET_ROI_SYSID",
            "DO_SET_ROI_WPNEXT_OFFSET",
        ),
        _ROI,
    ),
}  # fmt: skip
"""Commands that the gateway does not support, with the sentence for the program. Their result is UNSUPPORTED."""

FLY_MISSION = "FlyMission"
CHECK_MISSION = "CheckMission"
"""Requests that the gateway carries out by several calls: fly the stored mission, and judge an uploaded mission."""


@dataclass(frozen=True, slots=True)
class Request:
    """A call of the mobility service.

    Attributes:
        method: Method of MobilityService, `FLY_MISSION` or `CHECK_MISSION`.
        message: Request message of the method. For `FLY_MISSION` the number of the first item, or None to continue; for
            `CHECK_MISSION` the items.
        mode: Virtual mode after the call was accepted; None if the call does not change the mode.
    """

    method: str
    message: Any
    mode: int | None = None


def hover() -> Request:
    """Return a call that stops the drone."""
    return Request("Hover", mobility_pb2.HoverRequest(), mavlink.COPTER_MODE_BRAKE)


def land() -> Request:
    """Return a call that lands the drone."""
    return Request("Land", mobility_pb2.LandRequest(), mavlink.COPTER_MODE_LAND)


def return_to_launch() -> Request:
    """Return a call that brings the drone home."""
    return Request("ReturnToLaunch", mobility_pb2.ReturnToLaunchRequest(), mavlink.COPTER_MODE_RTL)


def fly_mission(number: int | None = None) -> Request:
    """Return a request that flies the stored mission from an item on, or from the current item."""
    return Request(FLY_MISSION, number, mavlink.COPTER_MODE_AUTO)


def goto(lat: float, lon: float, altitude_m: float, reference: int, yaw_deg: float | None = None) -> Request:
    """Return a call that flies to a place, in degrees and metres above the reference."""
    target = types_pb2.Position(latitude_deg=lat, longitude_deg=lon, altitude_m=altitude_m)
    target.altitude_reference = reference  # type: ignore[assignment]  # protobuf enumerations are integers
    message = mobility_pb2.GotoRequest(target=target)
    if yaw_deg is not None:
        message.yaw_deg = yaw_deg
    return Request("Goto", message, mavlink.COPTER_MODE_GUIDED)


def set_speed(speed_mps: float) -> Request:
    """Return a call that sets the speed of legs.

    Raises:
        Untranslatable: The speed is not positive.
    """
    if not (math.isfinite(speed_mps) and speed_mps > 0.0):
        raise Untranslatable(f"the speed must be above 0 m/s, not {speed_mps:g}")
    return Request("SetSpeed", mobility_pb2.SetSpeedRequest(speed_mps=speed_mps))


def place_target(frame: int, lat_e7: int, lon_e7: int, altitude_m: float, yaw_deg: float | None = None) -> Request:
    """Return a call that flies to geographic coordinates.

    Raises:
        Untranslatable: The frame, the coordinates or the altitude are not supported.
    """
    if frame in ABSOLUTE_FRAMES:
        reference = types_pb2.ALTITUDE_REFERENCE_AMSL
    elif frame in RELATIVE_FRAMES:
        reference = types_pb2.ALTITUDE_REFERENCE_HOME
    else:
        raise Untranslatable(f"frame {_frame(frame)} is not supported; use MAV_FRAME_GLOBAL_RELATIVE_ALT")
    if not valid_coordinates(lat_e7, lon_e7):
        raise Untranslatable("latitude or longitude is out of range")
    if not math.isfinite(altitude_m):
        raise Untranslatable("the altitude is not a number")
    return goto(lat_e7 / 1e7, lon_e7 / 1e7, altitude_m, reference, yaw_deg)


def global_target(message: Message, hold_s: float, _vehicle: VirtualVehicle, _now: float) -> Request:
    """Return the call for SET_POSITION_TARGET_GLOBAL_INT: a position, or a velocity.

    Raises:
        Untranslatable: The mask, the frame or a value is not supported.
    """
    mask = message.integer("type_mask")
    yaw_deg = _yaw(message, mask, 0.0)
    if not mask & _POSITION:
        return place_target(
            message.integer("coordinate_frame"),
            message.integer("lat_int"),
            message.integer("lon_int"),
            message.real("alt"),
            yaw_deg,
        )
    return _velocity(message, mask, 0.0, yaw_deg, hold_s)


def local_target(message: Message, hold_s: float, vehicle: VirtualVehicle, now: float) -> Request:
    """Return the call for SET_POSITION_TARGET_LOCAL_NED: a position, an offset, or a velocity.

    Raises:
        Untranslatable: The mask, the frame or a value is not supported, or the present position is unknown.
    """
    mask = message.integer("type_mask")
    frame = message.integer("coordinate_frame")
    if frame not in _LOCAL_FRAMES:
        raise Untranslatable(f"frame {_frame(frame)} is not supported; use MAV_FRAME_LOCAL_NED")
    heading_deg = 0.0
    if frame in _BODY_FRAMES:
        heading_deg = _pose(vehicle, now).heading_deg
    yaw_deg = _yaw(message, mask, heading_deg)
    if mask & _POSITION:
        return _velocity(message, mask, heading_deg, yaw_deg, hold_s)
    north, east = _rotated(message.real("x"), message.real("y"), heading_deg)
    down = message.real("z")
    if not all(map(math.isfinite, (north, east, down))):
        raise Untranslatable("the position is not a number")
    if frame == mavlink.MAV_FRAME_LOCAL_NED:
        origin = vehicle.origin()
        if origin is None:
            raise Untranslatable("the origin of MAV_FRAME_LOCAL_NED is not known yet; use global coordinates")
        lat, lon, amsl_m = origin
        place = _offset(lat, lon, north, east)
        return goto(*place, amsl_m - down, types_pb2.ALTITUDE_REFERENCE_AMSL, yaw_deg)
    pose = _pose(vehicle, now)
    place = _offset(pose.lat, pose.lon, north, east)
    return goto(*place, pose.altitude_m - down, types_pb2.ALTITUDE_REFERENCE_HOME, yaw_deg)


def turn(target_deg: float, direction: float, relative: bool, vehicle: VirtualVehicle, now: float) -> Request:
    """Return the call for CONDITION_YAW: fly to the present target with a heading.

    Raises:
        Untranslatable: The angle is not a number, or the present position is unknown.
    """
    if not math.isfinite(target_deg):
        raise Untranslatable("the angle is not a number")
    pose = _pose(vehicle, now)
    yaw_deg = target_deg
    if relative:
        yaw_deg = pose.heading_deg + (-target_deg if direction < 0 else target_deg)
    lat, lon, altitude_m = vehicle.target or (pose.lat, pose.lon, pose.altitude_m)
    return goto(lat, lon, altitude_m, types_pb2.ALTITUDE_REFERENCE_HOME, yaw_deg % 360.0)


def gimbal(pitch_deg: float, yaw_deg: float) -> Request:
    """Return a call that points the camera. An angle that is not a number keeps its default of 0 degrees.

    Raises:
        Untranslatable: An angle is infinite.
    """
    angles = [0.0 if math.isnan(angle) else angle for angle in (pitch_deg, yaw_deg)]
    if not all(map(math.isfinite, angles)):
        raise Untranslatable("the angles of the gimbal are not numbers")
    return Request("PointGimbal", mobility_pb2.PointGimbalRequest(pitch_deg=angles[0], yaw_deg=angles[1]))


def _velocity(message: Message, mask: int, heading_deg: float, yaw_deg: float | None, hold_s: float) -> Request:
    if mask & _VELOCITY:
        raise Untranslatable("the type_mask selects neither a complete position nor a complete velocity")
    if mask & _POSITION != _POSITION:
        raise Untranslatable("the type_mask selects only a part of a position; select x, y and z, or none of them")
    north, east = _rotated(message.real("vx"), message.real("vy"), heading_deg)
    down = message.real("vz")
    if not all(map(math.isfinite, (north, east, down))):
        raise Untranslatable("the velocity is not a number")
    request = mobility_pb2.SetVelocityRequest(hold_s=hold_s)
    request.velocity.north_mps = north
    request.velocity.east_mps = east
    request.velocity.down_mps = down
    if yaw_deg is not None:
        request.yaw_deg = yaw_deg
    return Request("SetVelocity", request, mavlink.COPTER_MODE_GUIDED)


def _yaw(message: Message, mask: int, heading_deg: float) -> float | None:
    """Return the heading in degrees that a target selects; None if it selects none."""
    yaw_rate = message.real("yaw_rate")
    if not mask & _YAW_RATE and yaw_rate != 0.0:
        raise Untranslatable("a yaw rate is not supported; set bit 2048 of type_mask")
    if mask & _YAW:
        return None
    yaw = message.real("yaw")
    if not math.isfinite(yaw):
        raise Untranslatable("the yaw is not a number; set bit 1024 of type_mask to keep the heading")
    return (math.degrees(yaw) + heading_deg) % 360.0


def _pose(vehicle: VirtualVehicle, now: float) -> Pose:
    pose = vehicle.pose(now)
    if pose is None:
        raise Untranslatable("the drone's position is not known")
    return pose


def _rotated(forward: float, right: float, heading_deg: float) -> tuple[float, float]:
    """Return north and east of a vector that is given relative to a heading."""
    angle = math.radians(heading_deg)
    return (
        forward * math.cos(angle) - right * math.sin(angle),
        forward * math.sin(angle) + right * math.cos(angle),
    )


MAX_OFFSET_M = 50_000.0
"""Largest offset from the origin or the drone. A flat local frame is inaccurate beyond it."""


def _offset(lat: float, lon: float, north_m: float, east_m: float) -> tuple[float, float]:
    if math.hypot(north_m, east_m) > MAX_OFFSET_M:
        raise Untranslatable(f"the target is more than {MAX_OFFSET_M / 1000:.0f} km away")
    return LocalFrame(lat, lon).latlon(east_m, north_m)


def _frame(number: int) -> str:
    return f"MAV_FRAME_{enum_name('MAV_FRAME', number)}"


Target = Callable[[Message, float, VirtualVehicle, float], Request]

TARGETS: Mapping[str, Target] = {
    "SET_POSITION_TARGET_LOCAL_NED": local_target,
    "SET_POSITION_TARGET_GLOBAL_INT": global_target,
}

"""Protobuf requests of calls. Arguments that are not numbers are refused here, because protobuf would send zero."""

from __future__ import annotations

import operator
from typing import Any, SupportsIndex

from fractus_proto.v1 import camera_pb2, mobility_pb2

from fractus.errors import InvalidRequest
from fractus.values import Position, Velocity

MAX_PIXELS = 2**31 - 1


def takeoff_request(altitude_m: float) -> mobility_pb2.TakeoffRequest:
    """Return the request of a takeoff."""
    return mobility_pb2.TakeoffRequest(altitude_m=_number("altitude_m", altitude_m))


def speed_request(speed_mps: float) -> mobility_pb2.SetSpeedRequest:
    """Return the request of a ground speed."""
    return mobility_pb2.SetSpeedRequest(speed_mps=_number("speed_mps", speed_mps))


def goto_request(
    target: Position, yaw_deg: float | None, speed_mps: float | None, acceptance_radius_m: float = 0.0
) -> mobility_pb2.GotoRequest:
    """Return the request of a leg to a position."""
    for name, value in (("lat", target.lat), ("lon", target.lon), ("alt", target.alt)):
        _number(name, value)
    return mobility_pb2.GotoRequest(
        target=target.to_proto(),
        yaw_deg=_optional("yaw_deg", yaw_deg),
        speed_mps=_optional("speed_mps", speed_mps) or 0.0,
        acceptance_radius_m=_number("acceptance_radius_m", acceptance_radius_m),
    )


def velocity_request(velocity: Velocity, yaw_deg: float | None, hold_s: float) -> mobility_pb2.SetVelocityRequest:
    """Return the request of a velocity setpoint."""
    for name, value in (("north_mps", velocity.north), ("east_mps", velocity.east), ("down_mps", velocity.down)):
        _number(name, value)
    return mobility_pb2.SetVelocityRequest(
        velocity=velocity.to_proto(), yaw_deg=_optional("yaw_deg", yaw_deg), hold_s=_number("hold_s", hold_s)
    )


def gimbal_request(pitch_deg: float, yaw_deg: float) -> mobility_pb2.PointGimbalRequest:
    """Return the request of a camera direction."""
    return mobility_pb2.PointGimbalRequest(
        pitch_deg=_number("pitch_deg", pitch_deg), yaw_deg=_number("yaw_deg", yaw_deg)
    )


def capture_request(width: int, height: int) -> camera_pb2.CaptureImageRequest:
    """Return the request of a picture with a size in pixels."""
    for name, value in (("width", width), ("height", height)):
        if not isinstance(value, SupportsIndex) or not 0 <= operator.index(value) <= MAX_PIXELS:
            raise InvalidRequest(
                f"CaptureImage: {name} must be a whole number of pixels, not {value!r:.40}; 0 selects the camera's default"
            )
    return camera_pb2.CaptureImageRequest(width=width, height=height)


def _optional(name: str, value: Any) -> float | None:
    return None if value is None else _number(name, value)


def _number(name: str, value: Any) -> float:
    """Return the value as a float.

    Raises:
        InvalidRequest: The value is not a number.
    """
    if not isinstance(value, str | bytes | bool | None):
        try:
            return float(value)
        except (TypeError, ValueError, OverflowError):
            pass
    raise InvalidRequest(f"{name} must be a number, not {value!r:.40}; give it as a float")

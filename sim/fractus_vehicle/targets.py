"""Target messages of a companion computer in GUIDED mode: validation and conversion to flight targets."""

from __future__ import annotations

import math
from typing import NamedTuple

from fractus_runtime.mavlink_codec import Message
from fractus_services.mavlink_server.coordinates import GLOBAL_FRAMES, valid_coordinates
from fractus_services.mavlink_server.mission_items import item_from
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle.copter import IGNORE_ACCELERATION, IGNORE_POSITION, IGNORE_VELOCITY
from fractus_vehicle.earth import Place
from fractus_vehicle.flight import Flight
from fractus_vehicle.guided import GuidedFlight
from fractus_vehicle.shaping import clamp, wrap_pi
from fractus_vehicle.state import VehicleState

_BODY_FRAMES = frozenset({mavlink.MAV_FRAME_BODY_NED, mavlink.MAV_FRAME_BODY_OFFSET_NED})
_OFFSET_FRAMES = frozenset({mavlink.MAV_FRAME_LOCAL_OFFSET_NED}) | _BODY_FRAMES
_LOCAL_FRAMES = frozenset({mavlink.MAV_FRAME_LOCAL_NED}) | _OFFSET_FRAMES

# Velocities above this limit are rejected as errors.
SANE_MPS = 1000.0

_NO_ATTITUDE = mavlink.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE
_NO_THRUST = mavlink.ATTITUDE_TARGET_TYPEMASK_THROTTLE_IGNORE
_RATES = (
    mavlink.ATTITUDE_TARGET_TYPEMASK_BODY_ROLL_RATE_IGNORE
    | mavlink.ATTITUDE_TARGET_TYPEMASK_BODY_PITCH_RATE_IGNORE
    | mavlink.ATTITUDE_TARGET_TYPEMASK_BODY_YAW_RATE_IGNORE
)
# Tolerance of the squared length of a unit quaternion.
UNIT_TOLERANCE = 1e-3

Vector = tuple[float, float, float]


def _vector(m: Message, x: str, y: str, z: str) -> Vector:
    return (m.real(x), m.real(y), m.real(z))


def _rotated(v: VehicleState, vector: Vector) -> Vector:
    cosine = math.cos(v.est.yaw)
    sine = math.sin(v.est.yaw)
    return (vector[0] * cosine - vector[1] * sine, vector[0] * sine + vector[1] * cosine, vector[2])


class Setpoint(NamedTuple):
    """Local position, velocity and acceleration of a message, before the type mask is applied."""

    position: Vector
    velocity: Vector
    accel: Vector


def local_target(v: VehicleState, flight: Flight, m: Message) -> None:
    """Handle SET_POSITION_TARGET_LOCAL_NED."""
    frame = m.integer("coordinate_frame")
    if frame not in _LOCAL_FRAMES:
        _stop(v, flight)
        return
    position = _vector(m, "x", "y", "z")
    velocity = _vector(m, "vx", "vy", "vz")
    accel = _vector(m, "afx", "afy", "afz")
    if frame in _BODY_FRAMES:
        position = _rotated(v, position)
        velocity = _rotated(v, velocity)
        accel = _rotated(v, accel)
    if frame in _OFFSET_FRAMES:
        e = v.est
        position = (position[0] + e.north, position[1] + e.east, position[2] + e.down)
    _target(v, flight, m, Setpoint(position, velocity, accel))


def global_target(v: VehicleState, flight: Flight, m: Message) -> None:
    """Handle SET_POSITION_TARGET_GLOBAL_INT."""
    frame = m.integer("coordinate_frame")
    lat = m.integer("lat_int")
    lon = m.integer("lon_int")
    alt = m.real("alt")
    origin = v.origin
    position = (0.0, 0.0, 0.0)
    if origin is None or not isinstance(flight, GuidedFlight):
        return
    if not m.integer("type_mask") & IGNORE_POSITION:  # otherwise frame and coordinates are ignored
        if not valid_coordinates(lat, lon):
            _stop(v, flight)
            return
        base = v.altitude_base_m(frame)
        if frame not in GLOBAL_FRAMES:
            v.send_text(mavlink.MAV_SEVERITY_INFO, f"Unknown mavlink coordinate frame {frame}")
        if base is None:
            _stop(v, flight)
            return
        position = origin.vector_to(Place(lat, lon, base + alt))
    _target(v, flight, m, Setpoint(position, _vector(m, "vx", "vy", "vz"), _vector(m, "afx", "afy", "afz")))


def _stop(v: VehicleState, flight: Flight) -> None:
    """Stop the vehicle, as ArduCopter does when it receives an invalid target."""
    if isinstance(flight, GuidedFlight) and v.armed and not v.landed:
        v.taking_off_until_m = None
        flight.stop(v)


def _target(v: VehicleState, flight: Flight, m: Message, setpoint: Setpoint) -> None:
    """Validate the type mask and pass the target to GUIDED. Silently drop targets outside the fence."""
    if not isinstance(flight, GuidedFlight) or not v.armed:
        return
    # As in ArduCopter, a target aborts a takeoff. The vehicle stays on the ground if it has not left it yet.
    v.taking_off_until_m = None
    if v.landed:
        return
    mask = m.integer("type_mask")
    position = setpoint.position if not mask & IGNORE_POSITION else None
    velocity = setpoint.velocity if not mask & IGNORE_VELOCITY else None
    accel = setpoint.accel if not mask & IGNORE_ACCELERATION else None
    understood = velocity is not None or (position is None) != (accel is None)
    if not understood or (mask & mavlink.POSITION_TARGET_TYPEMASK_FORCE_SET and accel is not None):
        flight.stop(v)
        return
    yaw = m.real("yaw") if not mask & mavlink.POSITION_TARGET_TYPEMASK_YAW_IGNORE else None
    yaw_rate = m.real("yaw_rate") if not mask & mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE else None
    if velocity is not None and not all(abs(value) <= SANE_MPS for value in velocity):
        flight.stop(v)
        return
    numbers = (*(position or ()), *(velocity or ()), *(accel or ()), yaw or 0.0, yaw_rate or 0.0)
    if not all(math.isfinite(value) for value in numbers):
        return
    if position is not None and v.outside_fence(*position):
        return
    _fly(v, flight, position, velocity, setpoint.accel)
    # In body frames the heading is relative to the nose.
    relative = m.name == "SET_POSITION_TARGET_LOCAL_NED" and m.integer("coordinate_frame") in _BODY_FRAMES
    _turn(v, yaw, yaw_rate, relative=relative)


def _fly(
    v: VehicleState, flight: GuidedFlight, position: Vector | None, velocity: Vector | None, accel: Vector
) -> None:
    if velocity is not None:
        flight.fly(v, velocity, position)
    elif position is not None:
        flight.go_to(v, *position)
    else:
        e = v.control.vel
        flight.fly(v, (e[0] + accel[0], e[1] + accel[1], e[2] + accel[2]))


def _turn(v: VehicleState, yaw: float | None, yaw_rate: float | None, *, relative: bool) -> None:
    if yaw is not None and relative:
        v.heading.turn_to(math.degrees(yaw), 0.0, 0, relative=True)
    elif yaw is not None:
        v.control.yaw_rate = None
        v.control.target_yaw = wrap_pi(yaw)
        v.heading.hold()
    elif yaw_rate is not None:
        v.control.yaw_rate = clamp(yaw_rate, -2.0, 2.0)
        v.heading.hold()
    else:
        v.control.yaw_rate = None
        v.heading.follow_course()


def attitude_target(v: VehicleState, flight: Flight, m: Message) -> None:
    """Handle SET_ATTITUDE_TARGET."""
    if not isinstance(flight, GuidedFlight) or not v.armed or m.integer("type_mask") & _NO_ATTITUDE:
        return
    w, x, y, z = m.array("q")
    size = math.sqrt(w * w + x * x + y * y + z * z)
    rates = m.integer("type_mask") & _RATES
    ill_defined = m.integer("type_mask") & _NO_THRUST or rates not in (0, _RATES)
    if ill_defined or not abs(size * size - 1.0) < UNIT_TOLERANCE:
        _stop(v, flight)
        return
    thrust = m.real("thrust")
    thrust = clamp(thrust if math.isfinite(thrust) else 0.5, 0.0, 1.0)
    lean = v.control.limits.tilt_max_rad
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(clamp(2.0 * (w * y - z * x) / (size * size), -1.0, 1.0))
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    limits = v.control.limits
    climb = (thrust - 0.5) * 2.0 * (limits.climb_mps if thrust > 0.5 else limits.sink_mps)
    if v.landed:
        return
    v.control.target_yaw = yaw
    flight.lean(v, clamp(roll, -lean, lean), clamp(pitch, -lean, lean), yaw, climb)


def guided_item(v: VehicleState, flight: Flight, m: Message) -> bool:
    """Handle a mission item with `current` 2 (guided target) or 3 (altitude change).

    Both are deprecated but still accepted by ArduPilot.

    Returns:
        False if the target is refused.
    """
    item = item_from(m)
    base = v.altitude_base_m(item.frame)
    if not isinstance(flight, GuidedFlight) or not v.armed or v.landed or v.origin is None or base is None:
        return False
    if not valid_coordinates(item.x, item.y) or not math.isfinite(item.z):
        return False
    north, east, down = v.origin.vector_to(Place(item.x, item.y, base + item.z))
    if m.integer("current") == 3:
        north, east = v.control.target
    if v.outside_fence(north, east, down):
        return False
    flight.go_to(v, north, east, down)
    return True

"""Messages that arrive, by name: each to what it means for the vehicle."""

from __future__ import annotations

import math
from collections.abc import Callable

from fractus_mavlink import Message, Signing

from fractus_vehicle.channel import Channel
from fractus_vehicle.commands import handle_command, outside_fence, set_current, set_mode_number
from fractus_vehicle.earth import Place, valid_coordinates
from fractus_vehicle.guided import GuidedFlight
from fractus_vehicle.mav import (
    FORCE_SET,
    IGNORE_ACCELERATION,
    IGNORE_POSITION,
    IGNORE_VELOCITY,
    IGNORE_YAW,
    IGNORE_YAW_RATE,
    Frame,
    Severity,
)
from fractus_vehicle.mission import item_from
from fractus_vehicle.shaping import clamp, wrap_pi
from fractus_vehicle.streams import ALL_GROUPS, GROUPS
from fractus_vehicle.vehicle import Vehicle

_FTP_NAK = 129
_FTP_UNKNOWN = 7
_BODY_FRAMES = frozenset({Frame.BODY_NED, Frame.BODY_OFFSET_NED})
_OFFSET_FRAMES = frozenset({Frame.LOCAL_OFFSET_NED}) | _BODY_FRAMES
_LOCAL_FRAMES = frozenset({Frame.LOCAL_NED}) | _OFFSET_FRAMES

Vector = tuple[float, float, float]
Handler = Callable[[Vehicle, Message, Channel], None]


def dispatch(v: Vehicle, message: Message, channel: Channel) -> None:
    """Handle one message; what is not for this vehicle or not known is ignored."""
    if message.sysid == v.sysid and message.compid == v.compid:
        return
    if message.has("target_system") and message.integer("target_system") not in (0, v.sysid):
        return
    if message.has("target_component") and message.integer("target_component") not in (0, v.compid):
        return
    handler = HANDLERS.get(message.name)
    if handler is not None:
        handler(v, message, channel)


def _heartbeat(v: Vehicle, m: Message, _c: Channel) -> None:
    v.heard(m)


def _set_mode(v: Vehicle, m: Message, _c: Channel) -> None:
    set_mode_number(v, m.integer("base_mode"), m.integer("custom_mode"))


def _request_stream(v: Vehicle, m: Message, c: Channel) -> None:
    group = m.integer("req_stream_id")
    rate = m.integer("req_message_rate") if m.integer("start_stop") else 0
    for number in ALL_GROUPS if group == 0 else (group,):
        for name in GROUPS.get(number, ("", ()))[1]:
            c.set_interval(name, 1.0 / min(rate, 100) if rate > 0 else None)


def _parameter_list(v: Vehicle, _m: Message, c: Channel) -> None:
    c.parameters.clear()
    c.parameters.extend(range(len(v.params)))


def _parameter_read(v: Vehicle, m: Message, c: Channel) -> None:
    index = m.integer("param_index")
    v.voice.send_parameter(c, m.text("param_id"), index)


def _parameter_set(v: Vehicle, m: Message, c: Channel) -> None:
    name, value = m.text("param_id"), m.real("param_value")
    if not math.isfinite(value):
        return
    if not v.params.set(name, value) and v.params.find(name) is not None:
        v.say(Severity.WARNING, f"Param write denied ({name})")
    for channel in v.channels:
        if channel is c or not channel.signing:
            v.voice.send_parameter(channel, name, -1, 65535)


def _timesync(v: Vehicle, m: Message, c: Channel) -> None:
    if m.integer("tc1") == 0:
        c.send("TIMESYNC", {"tc1": int(v.time_s * 1e9), "ts1": m.integer("ts1")})


def _ping(v: Vehicle, m: Message, c: Channel) -> None:
    if m.integer("target_system") == 0:
        c.send(
            "PING",
            {
                "time_usec": m.integer("time_usec"),
                "seq": m.integer("seq"),
                "target_system": m.sysid,
                "target_component": m.compid,
            },
        )


def _version(v: Vehicle, c: Channel) -> None:
    v.send(c, "AUTOPILOT_VERSION")


def _file_transfer(_v: Vehicle, m: Message, c: Channel) -> None:
    """There is no file system: every request is refused at once, so that clients use the plain protocols instead."""
    request = bytes(int(value) for value in m.array("payload"))
    sequence = (int.from_bytes(request[:2], "little") + 1) & 0xFFFF
    answer = sequence.to_bytes(2, "little") + bytes(
        (request[2], _FTP_NAK, 1, request[3], 0, 0, 0, 0, 0, 0, _FTP_UNKNOWN)
    )
    c.send(
        "FILE_TRANSFER_PROTOCOL",
        {"target_system": m.sysid, "target_component": m.compid, "payload": tuple(answer)},
    )


def _vector(m: Message, names: tuple[str, str, str]) -> Vector:
    return (m.real(names[0]), m.real(names[1]), m.real(names[2]))


def _rotated(v: Vehicle, vector: Vector) -> Vector:
    cosine, sine = math.cos(v.est.yaw), math.sin(v.est.yaw)
    return (vector[0] * cosine - vector[1] * sine, vector[0] * sine + vector[1] * cosine, vector[2])


def _local_target(v: Vehicle, m: Message) -> None:
    frame = m.integer("coordinate_frame")
    if frame not in _LOCAL_FRAMES:
        _stop(v)
        return
    position, velocity = _vector(m, ("x", "y", "z")), _vector(m, ("vx", "vy", "vz"))
    accel = _vector(m, ("afx", "afy", "afz"))
    if frame in _BODY_FRAMES:
        position, velocity, accel = _rotated(v, position), _rotated(v, velocity), _rotated(v, accel)
    if frame in _OFFSET_FRAMES:
        e = v.est
        position = (position[0] + e.north, position[1] + e.east, position[2] + e.down)
    _target(v, m, position, velocity, accel)


def _global_target(v: Vehicle, m: Message) -> None:
    frame = m.integer("coordinate_frame")
    lat, lon, alt = m.integer("lat_int"), m.integer("lon_int"), m.real("alt")
    origin = v.origin
    if origin is None:
        return
    base = v.altitude_base_m(frame)
    if base is None or not valid_coordinates(lat, lon):
        _stop(v)
        return
    position = origin.vector_to(Place(lat, lon, base + alt))
    _target(v, m, position, _vector(m, ("vx", "vy", "vz")), _vector(m, ("afx", "afy", "afz")))


def _stop(v: Vehicle) -> None:
    """What ArduCopter does with a target that it does not understand."""
    if isinstance(v.flight, GuidedFlight) and v.armed and not v.landed:
        v.taking_off_until_m = None
        v.flight.stop(v)


def _target(v: Vehicle, m: Message, position: Vector, velocity: Vector, accel: Vector) -> None:
    """Judge type_mask and hand the target to GUIDED; a target outside the fence is dropped in silence."""
    flight = v.flight
    if not isinstance(flight, GuidedFlight) or not v.armed:
        return
    # A target ends a takeoff, even one that has not left the ground: then the vehicle stays there, as the real one.
    v.taking_off_until_m = None
    if v.landed:
        return
    mask = m.integer("type_mask")
    use_position, use_velocity = not mask & IGNORE_POSITION, not mask & IGNORE_VELOCITY
    use_accel = not mask & IGNORE_ACCELERATION
    yaw = m.real("yaw") if not mask & IGNORE_YAW else None
    yaw_rate = m.real("yaw_rate") if not mask & IGNORE_YAW_RATE else None
    understood = use_velocity or use_position != use_accel
    if not understood or (mask & FORCE_SET and use_accel):
        flight.stop(v)
        return
    used: list[float] = []
    used += position if use_position else ()
    used += velocity if use_velocity else ()
    used += accel if use_accel else ()
    used += [value for value in (yaw, yaw_rate) if value is not None]
    if not all(math.isfinite(value) for value in used):
        return
    if use_position and outside_fence(v, *position):
        return
    if use_velocity:
        flight.fly(v, velocity, position if use_position else None)
    elif use_position:
        flight.go_to(v, *position)
    else:
        e = v.control.vel
        flight.fly(v, (e[0] + accel[0], e[1] + accel[1], e[2] + accel[2]))
    _turn(v, yaw, yaw_rate)


def _turn(v: Vehicle, yaw: float | None, yaw_rate: float | None) -> None:
    if yaw is not None:
        v.control.yaw_rate = None
        v.control.target_yaw = wrap_pi(yaw)
        v.yaw.hold(yaw)
    elif yaw_rate is not None:
        v.control.yaw_rate = clamp(yaw_rate, -2.0, 2.0)
        v.yaw.hold(v.est.yaw)
    else:
        v.control.yaw_rate = None
        v.yaw.follow_course()


def _attitude_target(v: Vehicle, m: Message, _c: Channel) -> None:
    flight = v.flight
    if not isinstance(flight, GuidedFlight) or not v.armed or m.integer("type_mask") & 0x80:
        return
    w, x, y, z = m.array("q")
    size = math.sqrt(w * w + x * x + y * y + z * z)
    if not math.isfinite(size) or not 0.9 < size < 1.1:
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


def _mission(v: Vehicle, m: Message, c: Channel) -> None:
    if m.name in ("MISSION_ITEM", "MISSION_ITEM_INT") and m.integer("current") in (2, 3):
        _guided_item(v, m, c)
        return
    v.plans.transfers.handle(c, m, v.time_s)


def _guided_item(v: Vehicle, m: Message, c: Channel) -> None:
    """`current` 2 is a guided target, 3 a change of altitude (both deprecated, both still accepted)."""
    item = item_from(m)
    flight = v.flight
    ok = isinstance(flight, GuidedFlight) and v.armed and not v.landed and v.origin is not None
    base = v.altitude_base_m(item.frame)
    ok = ok and base is not None and valid_coordinates(item.x, item.y) and math.isfinite(item.z)
    if ok and isinstance(flight, GuidedFlight) and v.origin is not None and base is not None:
        north, east, down = v.origin.vector_to(Place(item.x, item.y, base + item.z))
        if m.integer("current") == 3:
            north, east = v.control.target
        ok = not outside_fence(v, north, east, down)
        if ok:
            flight.go_to(v, north, east, down)
    c.send(
        "MISSION_ACK",
        {"target_system": m.sysid, "target_component": m.compid, "type": 0 if ok else 1, "mission_type": 0},
    )


def _mission_set_current(v: Vehicle, m: Message, c: Channel) -> None:
    if set_current(v, m.integer("seq")):
        v.send(c, "MISSION_CURRENT")


def _sticks(v: Vehicle, m: Message, _c: Channel) -> None:
    if m.sysid == int(v.params["SYSID_MYGCS"]):
        v.set_sticks(tuple(m.integer(f"chan{at}_raw") for at in range(1, 19)))


def _manual(v: Vehicle, m: Message, _c: Channel) -> None:
    if m.integer("target") not in (0, v.sysid) or m.sysid != int(v.params["SYSID_MYGCS"]):
        return
    x, y, z, r = (m.integer(name) for name in ("x", "y", "z", "r"))
    if all(abs(value) <= 1000 for value in (x, y, z, r)):
        v.set_sticks((1500 + y // 2, 1500 - x // 2, 1000 + max(z, 0), 1500 + r // 2))


def _set_origin(v: Vehicle, _m: Message, c: Channel) -> None:
    """The origin comes from GPS here; the answer tells where it is."""
    v.send(c, "GPS_GLOBAL_ORIGIN")


def _set_home(v: Vehicle, m: Message, _c: Channel) -> None:
    v.set_home_at(m.integer("latitude"), m.integer("longitude"), m.integer("altitude") / 1000.0)


def _setup_signing(v: Vehicle, m: Message, _c: Channel) -> None:
    """A key of zeros turns signing off; refused while armed, as ArduPilot."""
    if v.armed:
        v.say(Severity.DEBUG, "ERROR: Won't setup signing when armed")
        return
    key = bytes(int(value) for value in m.array("secret_key"))
    started = m.integer("initial_timestamp")
    for channel in v.channels:
        channel.signing = Signing(key, started) if any(key) else None
    v.signing_key = key if any(key) else None
    v.say(Severity.INFO, "Signing key set" if any(key) else "Signing off")


HANDLERS: dict[str, Handler] = {
    "HEARTBEAT": _heartbeat,
    "COMMAND_LONG": handle_command,
    "COMMAND_INT": handle_command,
    "SET_MODE": _set_mode,
    "REQUEST_DATA_STREAM": _request_stream,
    "PARAM_REQUEST_LIST": _parameter_list,
    "PARAM_REQUEST_READ": _parameter_read,
    "PARAM_SET": _parameter_set,
    "FILE_TRANSFER_PROTOCOL": _file_transfer,
    "TIMESYNC": _timesync,
    "PING": _ping,
    "AUTOPILOT_VERSION_REQUEST": lambda v, _m, c: _version(v, c),
    "SET_POSITION_TARGET_LOCAL_NED": lambda v, m, _c: _local_target(v, m),
    "SET_POSITION_TARGET_GLOBAL_INT": lambda v, m, _c: _global_target(v, m),
    "SET_ATTITUDE_TARGET": _attitude_target,
    "MISSION_SET_CURRENT": _mission_set_current,
    "RC_CHANNELS_OVERRIDE": _sticks,
    "MANUAL_CONTROL": _manual,
    "SET_GPS_GLOBAL_ORIGIN": _set_origin,
    "SET_HOME_POSITION": _set_home,
    "SETUP_SIGNING": _setup_signing,
    **dict.fromkeys(
        (
            "MISSION_COUNT",
            "MISSION_ITEM",
            "MISSION_ITEM_INT",
            "MISSION_REQUEST",
            "MISSION_REQUEST_INT",
            "MISSION_REQUEST_LIST",
            "MISSION_CLEAR_ALL",
            "MISSION_ACK",
            "MISSION_WRITE_PARTIAL_LIST",
            "MISSION_REQUEST_PARTIAL_LIST",
        ),
        _mission,
    ),
}

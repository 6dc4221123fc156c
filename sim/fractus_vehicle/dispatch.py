"""Dispatch of received messages to their handlers, by message name."""

from __future__ import annotations

import math
from collections.abc import Callable

from fractus_runtime.mavlink_codec import Message
from fractus_services.mavlink_server.channel import Channel
from fractus_services.mavlink_server.stream_groups import ALL_GROUPS, GROUPS
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle.commands import handle_command, set_mode_number
from fractus_vehicle.earth import Place, valid_place
from fractus_vehicle.flight import Flight
from fractus_vehicle.gps_receivers import InputFix
from fractus_vehicle.home import set_home_at
from fractus_vehicle.mission_orders import set_current
from fractus_vehicle.report_units import UNKNOWN_U16
from fractus_vehicle.state import VehicleState
from fractus_vehicle.status_reports import mission_current
from fractus_vehicle.targets import attitude_target, global_target, guided_item, local_target
from fractus_vehicle.telemetry import send, send_parameter
from fractus_vehicle.vehicle import Vehicle

Handler = Callable[[Vehicle, Message, Channel], None]


def dispatch(vehicle: Vehicle, message: Message, channel: Channel) -> None:
    """Handle one message. Ignore unknown messages and messages addressed to another system or component."""
    v = vehicle.state
    if message.sysid == v.sysid and message.compid == v.compid:
        return
    if message.has("target_system") and message.integer("target_system") not in (0, v.sysid):
        return
    if message.has("target_component") and _is_for_other_component(v, message.integer("target_component")):
        return
    handler = HANDLERS.get(message.name)
    if handler is not None:
        handler(vehicle, message, channel)


def _is_for_other_component(v: VehicleState, component: int) -> bool:
    """Return True if a message is addressed to another component that is a known peer."""
    if component in (0, v.compid):
        return False
    return any((v.sysid, component) in channel.peers for channel in v.channels)


def _reply_with(name: str) -> Handler:
    def answer(vehicle: Vehicle, _m: Message, c: Channel) -> None:
        send(vehicle.state, c, name)

    return answer


def _target(take: Callable[[VehicleState, Flight, Message], None]) -> Handler:
    def target(vehicle: Vehicle, m: Message, _c: Channel) -> None:
        take(vehicle.state, vehicle.modes.flight, m)

    return target


def _heartbeat(vehicle: Vehicle, m: Message, _c: Channel) -> None:
    if m.sysid == int(vehicle.state.params["SYSID_MYGCS"]):
        vehicle.failsafes.record_gcs_heartbeat()


def _set_mode(vehicle: Vehicle, m: Message, _c: Channel) -> None:
    set_mode_number(vehicle, m.integer("base_mode"), m.integer("custom_mode"))


def _request_stream(vehicle: Vehicle, m: Message, c: Channel) -> None:
    v = vehicle.state
    group = m.integer("req_stream_id")
    rate = m.integer("req_message_rate") if m.integer("start_stop") else 0
    for number in ALL_GROUPS if group == mavlink.MAV_DATA_STREAM_ALL else (group,):
        label, names = GROUPS.get(number, ("", ()))
        if label and c.port is not None:
            v.params.assign(f"SR{min(c.port, 6)}_{label}", rate)
        for name in names:
            c.set_default(name, 1.0 / min(rate, 100) if rate > 0 else None)


def _parameter_list(vehicle: Vehicle, _m: Message, c: Channel) -> None:
    v = vehicle.state
    c.parameters.clear()
    c.parameters.extend(range(len(v.params)))


def _parameter_read(vehicle: Vehicle, m: Message, c: Channel) -> None:
    v = vehicle.state
    index = m.integer("param_index")
    send_parameter(v, c, m.text("param_id"), index, UNKNOWN_U16 if index < 0 else None)


def _parameter_set(vehicle: Vehicle, m: Message, c: Channel) -> None:
    v = vehicle.state
    name = m.text("param_id").upper()
    value = m.real("param_value")
    if not math.isfinite(value):
        return
    if not v.params.set(name, value) and v.params.find(name) is not None:
        v.send_text(mavlink.MAV_SEVERITY_WARNING, f"Param write denied ({name})")
    for channel in v.channels:
        if channel is c or not channel.signed:
            send_parameter(v, channel, name, -1, UNKNOWN_U16)


def _timesync(vehicle: Vehicle, m: Message, c: Channel) -> None:
    v = vehicle.state
    if m.integer("tc1") == 0:
        c.send("TIMESYNC", {"tc1": int(v.time_s * 1e9), "ts1": m.integer("ts1")})


def _file_transfer(_vehicle: Vehicle, m: Message, c: Channel) -> None:
    """Refuse every MAVFTP request, because there is no file system.

    Clients then use the parameter and mission protocols.
    """
    request = bytes(int(value) for value in m.array("payload"))
    sequence = (int.from_bytes(request[:2], "little") + 1) & 0xFFFF
    answer = sequence.to_bytes(2, "little") + bytes(
        (request[2], mavlink.MAV_FTP_OPCODE_NAK, 1, request[3], 0, 0, 0, 0, 0, 0, mavlink.MAV_FTP_ERR_UNKNOWNCOMMAND)
    )
    c.send(
        "FILE_TRANSFER_PROTOCOL",
        {"target_system": m.sysid, "target_component": m.compid, "payload": tuple(answer)},
    )


def _log_list(_vehicle: Vehicle, _m: Message, c: Channel) -> None:
    """Report an empty list of logs, because the vehicle stores none."""
    c.send("LOG_ENTRY", {"id": 0, "num_logs": 0, "last_log_num": 0, "time_utc": 0, "size": 0})


def _mission(vehicle: Vehicle, m: Message, c: Channel) -> None:
    if m.name not in ("MISSION_ITEM", "MISSION_ITEM_INT") or m.integer("current") not in (2, 3):
        vehicle.transfers.handle(c, m, vehicle.state.time_s)
        return
    taken = guided_item(vehicle.state, vehicle.modes.flight, m)
    c.send(
        "MISSION_ACK",
        {
            "target_system": m.sysid,
            "target_component": m.compid,
            "type": int(mavlink.MAV_MISSION_ACCEPTED if taken else mavlink.MAV_MISSION_ERROR),
            "mission_type": int(mavlink.MAV_MISSION_TYPE_MISSION),
        },
    )


def _mission_set_current(vehicle: Vehicle, m: Message, c: Channel) -> None:
    """Set the current item and reply with the requested number.

    Clients expect the requested number as acknowledgement, even if a different item is current after the request.
    """
    if set_current(vehicle, m.integer("seq")):
        c.send("MISSION_CURRENT", {**mission_current(vehicle.state), "seq": m.integer("seq")})


def _sticks(vehicle: Vehicle, m: Message, _c: Channel) -> None:
    if m.sysid == int(vehicle.state.params["SYSID_MYGCS"]):
        _override(vehicle, tuple(m.integer(f"chan{at}_raw") for at in range(1, 19)))


def _manual(vehicle: Vehicle, m: Message, _c: Channel) -> None:
    v = vehicle.state
    if m.integer("target") not in (0, v.sysid) or m.sysid != int(v.params["SYSID_MYGCS"]):
        return
    x, y, z, r = (m.integer(name) for name in ("x", "y", "z", "r"))
    if all(abs(value) <= 1000 for value in (x, y, z, r)):
        _override(vehicle, (1500 + y // 2, 1500 - x // 2, 1000 + max(z, 0), 1500 + r // 2))


def _override(vehicle: Vehicle, sticks: tuple[int, ...]) -> None:
    v = vehicle.state
    v.receiver.override(sticks, v.time_s + max(v.params["RC_OVERRIDE_TIME"], 0.0))


def _set_home(vehicle: Vehicle, m: Message, _c: Channel) -> None:
    set_home_at(vehicle.state, m.integer("latitude"), m.integer("longitude"), m.integer("altitude") / 1000.0)


def _setup_signing(vehicle: Vehicle, m: Message, _c: Channel) -> None:
    """Set the signing key, or disable signing if the key is all zeros. As in ArduPilot, this is refused while armed."""
    v = vehicle.state
    if v.armed:
        v.send_text(mavlink.MAV_SEVERITY_DEBUG, "ERROR: Won't setup signing when armed")
        return
    key = bytes(int(value) for value in m.array("secret_key"))
    started = m.integer("initial_timestamp")
    for channel in v.channels:
        channel.set_signing(key if any(key) else None, started)
    vehicle.signing_key = key if any(key) else None
    v.send_text(mavlink.MAV_SEVERITY_INFO, "Signing key set" if any(key) else "Signing off")


def _gps_input(vehicle: Vehicle, m: Message, _c: Channel) -> None:
    v = vehicle.state
    if valid_place(m.integer("lat"), m.integer("lon"), m.real("alt")):
        fix = InputFix(
            Place(m.integer("lat"), m.integer("lon"), m.real("alt")),
            m.integer("fix_type"),
            m.integer("satellites_visible"),
            max(m.real("horiz_accuracy"), 0.0),
            v.time_s,
        )
        v.estimator.gps_receivers.take_input(m.integer("gps_id"), fix)


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
    "LOG_REQUEST_LIST": _log_list,
    "TIMESYNC": _timesync,
    "AUTOPILOT_VERSION_REQUEST": _reply_with("AUTOPILOT_VERSION"),
    "SET_POSITION_TARGET_LOCAL_NED": _target(local_target),
    "SET_POSITION_TARGET_GLOBAL_INT": _target(global_target),
    "SET_ATTITUDE_TARGET": _target(attitude_target),
    "MISSION_SET_CURRENT": _mission_set_current,
    "RC_CHANNELS_OVERRIDE": _sticks,
    "MANUAL_CONTROL": _manual,
    # The vehicle keeps its origin from GPS, and replies with it.
    "SET_GPS_GLOBAL_ORIGIN": _reply_with("GPS_GLOBAL_ORIGIN"),
    "SET_HOME_POSITION": _set_home,
    "SETUP_SIGNING": _setup_signing,
    "GPS_INPUT": _gps_input,
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

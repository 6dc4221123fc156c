"""Ground station of a vehicle: heartbeats, commands, parameters, and the state that the vehicle reports."""

from __future__ import annotations

import contextlib
import math
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from fractus_runtime.mavlink_codec import Endpoint, Message, Value, enum_names, message_id
from fractus_services.mavlink_server.channel import Channel
from fractus_vehicle.simulation import Craft
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_sim.errors import ExperimentError
from fractus_sim.testbeds.tlog import TlogWriter

GROUND_STATION_ID = 255
OBSERVER_ID = 254
STATION_COMPONENT = mavlink.MAV_COMP_ID_MISSIONPLANNER
HEARTBEAT_S = 1.0
FLYING_STATES = frozenset(
    {mavlink.MAV_LANDED_STATE_IN_AIR, mavlink.MAV_LANDED_STATE_TAKEOFF, mavlink.MAV_LANDED_STATE_LANDING}
)
RATES_HZ: Mapping[str, float] = {
    "GLOBAL_POSITION_INT": 5.0,
    "ATTITUDE": 5.0,
    "VFR_HUD": 2.0,
    "SYS_STATUS": 2.0,
    "BATTERY_STATUS": 1.0,
    "GPS_RAW_INT": 2.0,
    "EXTENDED_SYS_STATE": 5.0,
    "EKF_STATUS_REPORT": 1.0,
    "HOME_POSITION": 1.0,
    "MISSION_CURRENT": 1.0,
    "SYSTEM_TIME": 1.0,
    "WIND": 2.0,
}


class Link(Protocol):
    """A non-blocking byte link to a vehicle."""

    def send(self, data: bytes) -> None:
        """Send bytes."""

    def receive(self) -> bytes:
        """Return the bytes received since the last call."""

    def close(self) -> None:
        """Close the link."""


class ChannelLink:
    """A link to a vehicle in the same process."""

    def __init__(self, craft: Craft, name: str) -> None:
        self._craft = craft
        self._channel: Channel = craft.open(name)

    def send(self, data: bytes) -> None:
        """Pass bytes to the vehicle."""
        self._craft.receive(self._channel, data)

    def receive(self) -> bytes:
        """Return the bytes that the vehicle has sent since the last call."""
        return self._channel.take()

    def close(self) -> None:
        """Close the channel."""
        self._craft.close(self._channel)


class TcpLink:
    """A link over TCP."""

    def __init__(self, connection: socket.socket, name: str) -> None:
        self._socket = connection
        self._name = name
        self._socket.setblocking(False)

    @classmethod
    def connect(cls, host: str, port: int, timeout_s: float) -> TcpLink:
        """Connect, and retry until the timeout.

        Raises:
            ExperimentError: The connection failed.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                return cls(socket.create_connection((host, port), 2.0), f"tcp:{host}:{port}")
            except OSError as error:
                if time.monotonic() > deadline:
                    raise ExperimentError(
                        f"cannot connect to the autopilot at tcp:{host}:{port}: {error.strerror}"
                    ) from None
                time.sleep(0.1)

    def send(self, data: bytes) -> None:
        """Send bytes. Bytes that exceed the socket buffer are dropped, as on a radio.

        Raises:
            ExperimentError: The vehicle closed the link.
        """
        try:
            self._socket.send(data)
        except BlockingIOError:
            return
        except OSError as error:
            raise ExperimentError(f"link {self._name}: {error.strerror}") from None

    def receive(self) -> bytes:
        """Return the bytes received since the last call.

        Raises:
            ExperimentError: The vehicle closed the link.
        """
        parts: list[bytes] = []
        while True:
            try:
                data = self._socket.recv(65536)
            except BlockingIOError:
                return b"".join(parts)
            except OSError as error:
                raise ExperimentError(f"link {self._name}: {error.strerror}") from None
            if not data:
                raise ExperimentError(f"link {self._name}: closed by the autopilot")
            parts.append(data)

    def close(self) -> None:
        """Close the socket."""
        with contextlib.suppress(OSError):
            self._socket.close()


@dataclass(slots=True)
class State:
    """Last reported state of the vehicle. Units: degrees, metres, volts, amperes.

    Attributes:
        received: True after the first heartbeat.
        prearm_ok: True if the pre-arm checks pass in the current mode.
        position_known: True if the estimator has a position.
        alt_m: Altitude above home.
        amsl_m: Altitude above mean sea level.
        battery: Share of the full charge.
        fix: GPS fix type.
        home: Latitude and longitude of the home position.
        texts: STATUSTEXT messages: time, severity and text.
    """

    received: bool = False
    mode: str = ""
    armed: bool = False
    prearm_ok: bool = False
    position_known: bool = False
    flying: bool = False
    lat: float = 0.0
    lon: float = 0.0
    alt_m: float = 0.0
    amsl_m: float = 0.0
    speed_mps: float = 0.0
    climb_mps: float = 0.0
    heading_deg: float = 0.0
    battery: float = 1.0
    voltage_v: float = 0.0
    current_a: float = 0.0
    fix: int = 0
    satellites: int = 0
    home: tuple[float, float] | None = None
    texts: list[tuple[float, int, str]] = field(default_factory=list)

    @property
    def ready(self) -> bool:
        """True if the vehicle would arm in a mode that needs a position."""
        return self.prearm_ok and self.position_known and self.home is not None

    @property
    def last_text(self) -> str:
        """Text of the last STATUSTEXT message."""
        return self.texts[-1][2] if self.texts else "no STATUSTEXT received"


class Station:
    """A ground station that communicates with one vehicle.

    Attributes:
        now_s: Time of the last poll, on the clock of the caller.
        state: Last reported state of the vehicle.
        cut: True while the link drops all traffic.
        acks: Results of acknowledged commands.
        parameters: Values of parameters that the vehicle reported.
        inbox: Messages of the autopilot in the last poll.
    """

    def __init__(
        self,
        link: Link,
        system_id: int,
        log: TlogWriter | None,
        *,
        own_id: int = GROUND_STATION_ID,
        sends_heartbeats: bool = True,
    ) -> None:
        self.state = State()
        self.cut = False
        self.now_s = 0.0
        self.acks: dict[int, int] = {}
        self.parameters: dict[str, float] = {}
        self.inbox: list[Message] = []
        self._link = link
        self._system_id = system_id
        self._log = log
        self._sends_heartbeats = sends_heartbeats
        self._endpoint = Endpoint(own_id, STATION_COMPONENT, saturate=True)
        self._unix_us = 0
        self._next_heartbeat_s = -math.inf
        self._streams_requested = False

    def poll(self, now_s: float, unix_us: int) -> list[Message]:
        """Process received messages, and send a heartbeat if it is due.

        Raises:
            ExperimentError: The link was closed.
        """
        self.now_s = now_s
        self._unix_us = unix_us
        data = self._link.receive()
        messages = [] if self.cut else self._endpoint.decode(data)
        self.inbox = [m for m in messages if m.sysid == self._system_id and m.compid == mavlink.MAV_COMP_ID_AUTOPILOT1]
        for message in messages:
            if self._log is not None:
                self._log.write(unix_us, message.frame)
        for message in self.inbox:
            handler = _HANDLERS.get(message.name)
            if handler is not None:
                handler(self, message)
        if self._sends_heartbeats and now_s >= self._next_heartbeat_s:
            self._next_heartbeat_s = now_s + HEARTBEAT_S
            self.send(
                "HEARTBEAT",
                {"type": mavlink.MAV_TYPE_GCS, "autopilot": mavlink.MAV_AUTOPILOT_INVALID, "mavlink_version": 3},
            )
        if self.state.received and not self._streams_requested:
            self._streams_requested = True
            self._request_streams()
        return self.inbox

    def send(self, name: str, values: Mapping[str, Value]) -> None:
        """Send a message, unless the link is cut."""
        frame = self._endpoint.encode(name, values)
        if self.cut:
            return
        if self._log is not None:
            self._log.write(self._unix_us, frame)
        self._link.send(frame)

    def send_to_autopilot(self, name: str, values: Mapping[str, Value]) -> None:
        """Send a message to the autopilot of the vehicle."""
        self.send(name, {**values, "target_system": self._system_id, "target_component": 1})

    def command(self, command: int, *params: float) -> None:
        """Send COMMAND_LONG. The result is stored in `acks`."""
        self.acks.pop(command, None)
        values: dict[str, Value] = {f"param{at}": float(value) for at, value in enumerate(params, start=1)}
        self.send_to_autopilot("COMMAND_LONG", {**values, "command": command})

    def read_parameter(self, name: str) -> None:
        """Request a parameter. Its value is stored in `parameters`."""
        self.parameters.pop(name, None)
        self.send_to_autopilot("PARAM_REQUEST_READ", {"param_id": name.encode("ascii"), "param_index": -1})

    def set_parameter(self, name: str, value: float) -> None:
        """Set a parameter. The value that the vehicle reports is stored in `parameters`."""
        self.parameters.pop(name, None)
        self.send_to_autopilot(
            "PARAM_SET",
            {"param_id": name.encode("ascii"), "param_value": value, "param_type": mavlink.MAV_PARAM_TYPE_REAL32},
        )

    def close(self) -> None:
        """Close link and log."""
        self._link.close()
        if self._log is not None:
            self._log.close()

    def _request_streams(self) -> None:
        for name, rate_hz in RATES_HZ.items():
            self.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id(name), 1e6 / rate_hz)


def _on_heartbeat(station: Station, message: Message) -> None:
    state = station.state
    state.received = True
    state.armed = bool(message.integer("base_mode") & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
    number = message.integer("custom_mode")
    state.mode = enum_names("COPTER_MODE").get(number, f"MODE_{number}")


def _on_position(station: Station, message: Message) -> None:
    state = station.state
    state.lat = message.integer("lat") / 1e7
    state.lon = message.integer("lon") / 1e7
    state.alt_m = message.integer("relative_alt") / 1000.0
    state.amsl_m = message.integer("alt") / 1000.0
    north = message.integer("vx") / 100.0
    east = message.integer("vy") / 100.0
    state.speed_mps = (north * north + east * east) ** 0.5
    state.climb_mps = -message.integer("vz") / 100.0
    state.heading_deg = message.integer("hdg") / 100.0


def _on_sys_status(station: Station, message: Message) -> None:
    state = station.state
    state.prearm_ok = bool(message.integer("onboard_control_sensors_health") & mavlink.MAV_SYS_STATUS_PREARM_CHECK)
    state.voltage_v = message.integer("voltage_battery") / 1000.0
    state.current_a = message.integer("current_battery") / 100.0
    remaining = message.integer("battery_remaining")
    state.battery = remaining / 100.0 if remaining >= 0 else state.battery


def _on_landed_state(station: Station, message: Message) -> None:
    station.state.flying = message.integer("landed_state") in FLYING_STATES


def _on_estimator_status(station: Station, message: Message) -> None:
    required = mavlink.EKF_POS_HORIZ_ABS | mavlink.EKF_PRED_POS_HORIZ_ABS
    station.state.position_known = message.integer("flags") & required == required


def _on_gps(station: Station, message: Message) -> None:
    station.state.fix = message.integer("fix_type")
    station.state.satellites = message.integer("satellites_visible")


def _on_home(station: Station, message: Message) -> None:
    station.state.home = (message.integer("latitude") / 1e7, message.integer("longitude") / 1e7)


def _on_text(station: Station, message: Message) -> None:
    station.state.texts.append((station.now_s, message.integer("severity"), message.text("text")))


def _on_ack(station: Station, message: Message) -> None:
    station.acks[message.integer("command")] = message.integer("result")


def _on_parameter(station: Station, message: Message) -> None:
    station.parameters[message.text("param_id")] = message.real("param_value")


_HANDLERS: Mapping[str, Callable[[Station, Message], None]] = {
    "HEARTBEAT": _on_heartbeat,
    "GLOBAL_POSITION_INT": _on_position,
    "SYS_STATUS": _on_sys_status,
    "EXTENDED_SYS_STATE": _on_landed_state,
    "EKF_STATUS_REPORT": _on_estimator_status,
    "GPS_RAW_INT": _on_gps,
    "HOME_POSITION": _on_home,
    "STATUSTEXT": _on_text,
    "COMMAND_ACK": _on_ack,
    "PARAM_VALUE": _on_parameter,
}

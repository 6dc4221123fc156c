"""Scripts of MAVLink exchanges that can be played on any autopilot, with the recorded responses of a real ArduCopter.

    python tests/component/vehicle_script.py [--autopilot tcp:HOST:PORT] [--all] [--steps FILE]

Each row of `tests/golden/vehicle/arducopter-*.tsv` is a step: name, action, recorded response and note. A note explains
an intended difference of the simulated vehicle, or why a step cannot be repeated. Numbers in responses may have a
tolerance: `4.2~10%` accepts a deviation of 10 %, and `4.2~0.5` a deviation of 0.5.

Without --autopilot, the script is played on the simulated vehicle after a cold start, in simulated time. With --autopilot, steps that
abort SITL are not played. If the link is lost, the script continues after a reconnection, and the summary is printed in any case.
"""

from __future__ import annotations

import argparse
import math
import select
import socket
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from fractus_runtime.mavlink_codec import Endpoint, Message, Value, enum_name, message_id
from fractus_vehicle.earth import Place
from fractus_vehicle.simulation import Simulation
from fractus_vehicle.state import VehicleConfig
from pymavlink.dialects.v20 import ardupilotmega as mavlink

RECORDINGS = Path(__file__).parents[1] / "golden/vehicle"
STEPS = RECORDINGS / "arducopter-4.6.3.tsv"
MISSION_STEPS = RECORDINGS / "arducopter-4.6.2.tsv"
"""Arming checks and flown missions of ArduCopter 4.6.2."""
HOME = Place.from_degrees(50.864, 4.679, 0.1)
"""Position of the recorded vehicle."""

RECONNECT_TIMEOUT_S = 20.0
"""Time within which a lost link must be open again. A vehicle that has aborted does not return."""

LONGEST_INTERVAL_US = 2.0**31
"""Message interval above which the conversion to an integer aborts SITL, in microseconds."""

ELSEWHERE_M = 5_000.0
"""A vehicle at least this far from the recorded position, in metres, has another home."""
TARGET: dict[str, Value] = {"target_system": 1, "target_component": 1}
GUIDED = 4
RTL = 6
LAND = 9
BRAKE = 17
KINDS = {"mission": 0, "fence": 1, "rally": 2}
LOCAL_FRAMES = (1, 7, 8, 9, 12, 20, 21)
BODY_FRAMES = (8, 9)
TEXTS_S = 0.6
# STATUSTEXTs that an autopilot sends without a request.
SPONTANEOUS = ("EKF3", "GPS 1", "AHRS", "Field", "Barometer", "Calibrating", "RC7", "ArduPilot", "SIM ", "PreArm")
# Item of a list to upload: command, frame, metres north of home (None: no position, inf: invalid latitude), metres east
# of home, altitude, first parameters.
Row = tuple[int, int, float | None, float, float, tuple[float, ...]]
_HOME_ROW: Row = (16, 0, 0.0, 0.0, 0.0, ())
_TAKEOFF: Row = (22, 3, None, 0.0, 12.0, ())
_RTL: Row = (20, 3, None, 0.0, 0.0, ())
_CLIMB: tuple[Row, Row] = (_HOME_ROW, _TAKEOFF)


def _waypoint(north: float, east: float, command: int = 16, frame: int = 3, *params: float) -> Row:
    return (command, frame, north, east, 12.0, params)


def _mission(third: Row) -> list[Row]:
    return [_HOME_ROW, _TAKEOFF, third, _waypoint(25.0, 25.0), _RTL]


def _fence_polygon(declared: tuple[float, ...]) -> list[Row]:
    corners = ((-60.0, -60.0), (-60.0, 60.0), (60.0, 60.0), (60.0, -60.0))
    return [(5001, 0, *corners[at % 4], 0.0, (count,)) for at, count in enumerate(declared)]


LISTS: dict[str, list[Row]] = {
    "good": _mission(_waypoint(25.0, 0.0)),
    "lat200": _mission(_waypoint(math.inf, 0.0)),
    "unknown_cmd": _mission(_waypoint(25.0, 0.0, 4000)),
    "unsupported_cmd": _mission(_waypoint(25.0, 0.0, 189 + 3800)),
    "bad_frame": _mission(_waypoint(25.0, 0.0, 16, 99)),
    "local_frame": _mission(_waypoint(25.0, 0.0, 16, 1)),
    "terrain": _mission(_waypoint(25.0, 0.0, 16, 10)),
    "frame_mission": _mission((178, 2, None, 0.0, 0.0, (1.0, 3.0))),
    "spline": _mission(_waypoint(25.0, 0.0, 82)),
    "p1_300": _mission(_waypoint(25.0, 0.0, 16, 3, 300.0, 300.0)),
    "nan_p4": _mission(_waypoint(25.0, 0.0, 16, 3, 0.0, 0.0, 0.0, math.nan)),
    "tour": [
        *(_HOME_ROW, _TAKEOFF, (178, 3, None, 0.0, 0.0, (1.0, 4.0))),
        *(_waypoint(25.0, 0.0), _waypoint(25.0, 25.0), _waypoint(0.0, 25.0, 82), _RTL),
    ],
    "none": [],
    # The positions of these missions are not recorded. They are chosen so that the legs take about the recorded time.
    "jump": [*_CLIMB, _waypoint(15.0, 0.0), _waypoint(15.0, 15.0), (177, 3, None, 0.0, 0.0, (2.0, 1.0)), _RTL],
    "loiter_time_land": [
        *(*_CLIMB, _waypoint(20.0, 15.0, 19, 3, 5.0), (112, 3, None, 0.0, 0.0, (3.0,))),
        *((178, 3, None, 0.0, 0.0, (1.0, 3.0)), _waypoint(30.0, 10.0), (115, 3, None, 0.0, 0.0, (90.0, 10.0, 1.0))),
        (21, 3, 5.0, 5.0, 0.0, ()),
    ],
    "spline_turns": [
        *(*_CLIMB, _waypoint(27.0, 5.0, 82), _waypoint(27.0, 27.0, 82), _waypoint(5.0, 27.0, 82)),
        *(_waypoint(25.0, 37.0, 18, 3, 1.0, 0.0, 5.0), (93, 3, None, 0.0, 0.0, (3.0,)), _RTL),
    ],
    "no_end": [*_CLIMB, _waypoint(0.0, 15.0)],
    "no_takeoff": [_HOME_ROW, _waypoint(0.0, 15.0), _RTL],
    "jumpcur": [
        *(*_CLIMB, _waypoint(80.0, 15.0), _waypoint(80.0, 40.0), _waypoint(0.0, 35.0), _waypoint(20.0, 35.0), _RTL),
    ],
    "clear_air": [*_CLIMB, _waypoint(36.0, 15.0), _waypoint(36.0, 65.0), _RTL],
    "ring": _fence_polygon((4, 4, 4, 4)),
    "two": _fence_polygon((2, 2)),
    "short": _fence_polygon((5, 5, 5, 5)),
    "mixed": _fence_polygon((4, 4, 4, 3)),
    "circle": [(5003, 0, 0.0, 0.0, 0.0, (50.0,))],
    "circle_negative": [(5003, 0, 0.0, 0.0, 0.0, (-50.0,))],
    "circle_zero": [(5003, 0, 0.0, 0.0, 0.0, (0.0,))],
    "circle_nan": [(5003, 0, 0.0, 0.0, 0.0, (math.nan,))],
    "circle_lat200": [(5003, 0, math.inf, 0.0, 0.0, (50.0,))],
    "circle_frame3": [(5003, 3, 0.0, 0.0, 0.0, (50.0,))],
    "ring_return": [*_fence_polygon((4, 4, 4, 4)), (5000, 0, 0.0, 0.0, 0.0, ())],
    "two_returns": [(5000, 0, 0.0, 0.0, 0.0, ()), (5000, 0, 1.0, 0.0, 0.0, ())],
    "rally": [(5100, 3, 10.0, 10.0, 20.0, ())],
}


def _is_disarmed(heartbeat: Message) -> bool:
    return not heartbeat.integer("base_mode") & mavlink.MAV_MODE_FLAG_SAFETY_ARMED


def mission_result(value: int) -> str:
    """Return the name of a MAV_MISSION_RESULT without its prefix."""
    return enum_name("MAV_MISSION_RESULT", value).removeprefix("MAV_MISSION_")


class Connection(Protocol):
    """Link to one autopilot."""

    now_s: float

    def send(self, name: str, values: dict[str, Value]) -> None:
        """Send a message."""

    def receive(self) -> list[Message]:
        """Return the messages received since the last call. Time advances by a small step."""

    def reconnect(self) -> bool:
        """Open a lost link again. Return False if that failed."""


class SimulatedConnection:
    """The simulated vehicle after a cold start, in simulated time."""

    def __init__(self) -> None:
        self._simulation = Simulation([VehicleConfig(start=HOME, throttle_us=1000)])
        self._craft = self._simulation.crafts[0]
        self._channel = self._craft.open("script", 0)
        self._endpoint = Endpoint(255, mavlink.MAV_COMP_ID_MISSIONPLANNER, saturate=True)
        self.now_s = 0.0

    def send(self, name: str, values: dict[str, Value]) -> None:
        """Send a message."""
        self._craft.receive(self._channel, self._endpoint.encode(name, values))

    def receive(self) -> list[Message]:
        """Advance by one control step."""
        self._simulation.step()
        self.now_s = self._simulation.time_s
        return self._endpoint.decode(self._channel.take())

    def reconnect(self) -> bool:
        """Return True, because this link is never lost."""
        return True


class TcpConnection:
    """An autopilot behind a TCP link, in real time."""

    def __init__(self, address: str) -> None:
        _, host, port = address.split(":")
        self._address = host, int(port)
        self._socket = socket.create_connection(self._address, 10.0)
        self._endpoint = Endpoint(255, mavlink.MAV_COMP_ID_MISSIONPLANNER, saturate=True)
        self._begun_s = time.monotonic()
        self.now_s = 0.0

    def send(self, name: str, values: dict[str, Value]) -> None:
        """Send a message."""
        self._socket.sendall(self._endpoint.encode(name, values))

    def receive(self) -> list[Message]:
        """Wait briefly for bytes."""
        ready = select.select([self._socket], [], [], 0.02)[0]
        data = self._socket.recv(65536) if ready else b""
        if ready and not data:
            raise ConnectionError("the autopilot closed the link")
        self.now_s = time.monotonic() - self._begun_s
        return self._endpoint.decode(data)

    def reconnect(self) -> bool:
        """Try to connect for `RECONNECT_TIMEOUT_S`."""
        self._socket.close()
        deadline = time.monotonic() + RECONNECT_TIMEOUT_S
        while time.monotonic() < deadline:
            try:
                self._socket = socket.create_connection(self._address, 1.0)
            except OSError:
                time.sleep(0.5)
            else:
                return True
        return False


@dataclass(frozen=True, slots=True)
class Step:
    """Step of the script, from one row of the file."""

    name: str
    action: str
    recorded: str
    note: str


def steps(path: Path = STEPS) -> list[Step]:
    """Return all steps of the script."""
    rows = (line.split("\t") for line in path.read_text(encoding="utf-8").splitlines() if line and line[0] != "#")
    return [Step(*row) for row in rows]


def matches(recorded: str, response: str) -> bool:
    """Return True if a response matches the recorded one. Numbers may have a tolerance."""
    expected = recorded.split()
    actual = response.split()
    return len(expected) == len(actual) and all(map(_same, expected, actual))


def _same(expected: str, actual: str) -> bool:
    key, tilde, tolerance = expected.partition("~")
    if not tilde:
        return expected == actual
    name, _, number = key.rpartition("=")
    got_name, _, got_number = actual.rpartition("=")
    slack = abs(float(number)) * float(tolerance[:-1]) / 100.0 if tolerance.endswith("%") else float(tolerance)
    try:
        return name == got_name and abs(float(got_number) - float(number)) <= slack
    except ValueError:
        return False


@dataclass(slots=True)
class FlightRecord:
    """Mission progress of one flight.

    Attributes:
        begun_s: Time of MISSION_START.
        texts_from: Number of STATUSTEXTs received before.
        reached: Reached items, with the seconds since `begun_s`.
        current: Current items with their MISSION_STATE, without repetitions.
    """

    begun_s: float
    texts_from: int
    reached: list[str] = field(default_factory=list)
    current: list[str] = field(default_factory=list)

    def add(self, message: Message, now_s: float) -> None:
        """Record the message if it reports progress of the mission."""
        if message.name == "MISSION_ITEM_REACHED":
            self.reached.append(f"{message.integer('seq')}={now_s - self.begun_s:.0f}")
        if message.name == "MISSION_CURRENT":
            now = f"{message.integer('seq')}/{message.integer('mission_state')}"
            if self.current[-1:] != [now]:
                self.current.append(now)


class Player:
    """Plays steps on a connection and returns the responses."""

    def __init__(self, connection: Connection) -> None:
        self.connection = connection
        self.last: dict[str, Message] = {}
        self.texts: list[str] = []
        self.home = HOME
        self._next_beat_s = 0.0
        self._chunks = ""
        self._flight = FlightRecord(0.0, 0)
        self._following = False

    # -- communication -----------------------------------------------------------------------------------------

    def _receive(self) -> list[Message]:
        if self.connection.now_s >= self._next_beat_s:
            self._next_beat_s = self.connection.now_s + 1.0
            self.connection.send("HEARTBEAT", {"type": mavlink.MAV_TYPE_GCS, "autopilot": 8, "mavlink_version": 3})
        messages = self.connection.receive()
        for message in messages:
            self.last[message.name] = message
            if self._following:
                self._flight.add(message, self.connection.now_s)
            if message.name == "GLOBAL_POSITION_INT":
                self._set_home(Place(message.integer("lat"), message.integer("lon"), 0.0))
            if message.name == "STATUSTEXT":
                self._chunks += message.text("text")
                if not message.integer("id") or len(message.text("text")) < 50:
                    self.texts.append(f"[{message.integer('severity')}] {self._chunks.strip()}")
                    self._chunks = ""
        return messages

    def _set_home(self, position: Place) -> None:
        """Use the vehicle's position as home, unless the vehicle is near the recorded position."""
        if position.lat_e7 and math.hypot(*self.home.vector_to(position)[:2]) > ELSEWHERE_M:
            self.home = position

    def _datum_m(self, frame: int) -> float:
        """Return the altitude of home in a frame: above mean sea level in frames 0 and 5, and 0 in all other frames."""
        at = self.last["GLOBAL_POSITION_INT"]
        return (at.integer("alt") - at.integer("relative_alt")) / 1000.0 if frame in {0, 5} else 0.0

    def _stream(self, duration_s: float) -> Iterator[Message]:
        end = self.connection.now_s + duration_s
        while self.connection.now_s < end:
            yield from self._receive()

    def _until(self, name: str, timeout_s: float, fits: Callable[[Message], bool] = lambda _m: True) -> Message | None:
        return next((m for m in self._stream(timeout_s) if m.name == name and fits(m)), None)

    def _statustexts_since(self, before: int) -> str:
        """Return the STATUSTEXTs received since the last call, except unsolicited ones."""
        for _ in self._stream(TEXTS_S):
            pass
        texts = [t for t in self.texts[before:] if not t[4:].startswith(SPONTANEOUS)]
        return "".join(f" | {'; '.join(texts)}" for _ in texts[:1])

    def _ack(self, command: int) -> str:
        ack = self._until("COMMAND_ACK", 3.0, lambda m: m.integer("command") == command)
        return "no ack" if ack is None else enum_name("MAV_RESULT", ack.integer("result"))

    def _send_command(self, command: int, params: list[float], component: int = 1) -> str:
        before = len(self.texts)
        values: dict[str, Value] = {f"param{at}": value for at, value in enumerate(params, start=1)}
        self.connection.send("COMMAND_LONG", values | TARGET | {"target_component": component, "command": command})
        return self._ack(command) + self._statustexts_since(before)

    def _mode(self) -> int:
        beat = self._until("HEARTBEAT", 3.0)
        return -1 if beat is None else beat.integer("custom_mode")

    def _set(self, name: str, value: float) -> Message | None:
        values = {"param_id": name.encode("ascii"), "param_value": value, "param_type": 9}
        self.connection.send("PARAM_SET", TARGET | values)
        return self._until("PARAM_VALUE", 1.5, lambda m: m.text("param_id") == name)

    @staticmethod
    def _shown(message: Message | None) -> str:
        if message is None:
            return "no reply"
        value = message.real("param_value")
        index = message.integer("param_index")
        kind = message.integer("param_type")
        return f"PARAM_VALUE {message.text('param_id')} idx={index} type={kind} val={value:g}"

    def _position(self) -> tuple[float, float, float]:
        at = self._until("GLOBAL_POSITION_INT", 3.0)
        if at is None:
            raise TimeoutError("no GLOBAL_POSITION_INT")
        north, east, _ = self.home.vector_to(Place(at.integer("lat"), at.integer("lon"), 0.0))
        return north, east, at.integer("relative_alt") / 1000.0

    # -- step types --------------------------------------------------------------------------------------------

    def play(self, action: str) -> str:
        """Execute one step and return the response."""
        verb, *words = action.split()
        method: Callable[..., str] = getattr(self, f"do_{verb}")
        return method(*words)

    def do_heartbeat(self) -> str:
        beat = self._until("HEARTBEAT", 3.0)
        names = (("type", "type"), ("autopilot", "ap"), ("base_mode", "base"), ("custom_mode", "custom"))
        assert beat is not None
        return " ".join(f"{short}={beat.integer(name)}" for name, short in (*names, ("system_status", "status")))

    def do_receive(self, duration: str) -> str:
        return " ".join(sorted({m.name for m in self._stream(float(duration))} | set(self.last)))

    def do_texts(self) -> str:
        return "; ".join(self.texts)

    def do_wait(self, duration: str) -> str:
        for _ in self._stream(float(duration)):
            pass
        return "done"

    def do_command(self, command: str, *params: str) -> str:
        component = next((int(p[1:]) for p in params if p[0] == "@"), 1)
        return self._send_command(int(command), [float(p) for p in params if p[0] != "@"], component)

    def do_prearm(self) -> str:
        before = len(self.texts)
        self.connection.send("COMMAND_LONG", TARGET | {"command": mavlink.MAV_CMD_RUN_PREARM_CHECKS})
        result = self._ack(mavlink.MAV_CMD_RUN_PREARM_CHECKS)
        self._statustexts_since(before)
        return f"{result} | {'; '.join(t for t in self.texts[before:] if t[4:].startswith('PreArm'))}"

    def do_int(self, command: str, frame: str, north: str, east: str, alt: str, *params: str) -> str:
        before = len(self.texts)
        place = self.home.offset(float(north), float(east))
        values: dict[str, Value] = {f"param{at}": float(p) for at, p in enumerate(params, start=1)}
        target: dict[str, Value] = {"x": place.lat_e7, "y": place.lon_e7, "z": float(alt), "frame": int(frame)}
        self.connection.send("COMMAND_INT", values | target | TARGET | {"command": int(command)})
        return self._ack(int(command)) + self._statustexts_since(before)

    def do_mode(self, number: str) -> str:
        response = self._send_command(mavlink.MAV_CMD_DO_SET_MODE, [1.0, float(number)])
        return f"{response} -> {self._mode()}"

    def do_arm(self, number: str) -> str:
        self._send_command(mavlink.MAV_CMD_DO_SET_MODE, [1.0, float(number)])
        mode = self._mode()
        response = self._send_command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, [1.0])
        if response.startswith("ACCEPTED"):
            self._send_command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, [0.0])
        return f"mode={mode} {response}"

    def do_list(self) -> str:
        self.connection.send("PARAM_REQUEST_LIST", TARGET)
        indexes: set[int] = set()
        for message in self._stream(4.0):
            if message.name == "PARAM_VALUE" and message.integer("param_index") < 65535:
                indexes.add(message.integer("param_index"))
        return f"count={self.last['PARAM_VALUE'].integer('param_count')} got={len(indexes)}"

    def do_read(self, name: str) -> str:
        self.connection.send("PARAM_REQUEST_READ", TARGET | {"param_id": name.encode("ascii"), "param_index": -1})
        return self._shown(self._until("PARAM_VALUE", 1.5, lambda m: m.text("param_id") == name))

    def do_index(self, index: str) -> str:
        self.connection.send("PARAM_REQUEST_READ", TARGET | {"param_index": int(index)})
        return self._shown(self._until("PARAM_VALUE", 1.5, lambda m: m.integer("param_index") == int(index)))

    def do_set(self, name: str, value: str) -> str:
        return self._shown(self._set(name, float(value)))

    def do_request(self, name: str) -> str:
        self.connection.send(
            "COMMAND_LONG", TARGET | {"command": mavlink.MAV_CMD_REQUEST_MESSAGE, "param1": message_id(name)}
        )
        messages = list(self._stream(1.0))
        acks = [m for m in messages if m.name == "COMMAND_ACK"]
        result = enum_name("MAV_RESULT", acks[-1].integer("result")) if acks else "no ack"
        return f"{result} sent={'yes' if any(m.name == name for m in messages) else 'no'}"

    def do_fields(self, name: str, *fields: str) -> str:
        self.connection.send(
            "COMMAND_LONG", TARGET | {"command": mavlink.MAV_CMD_REQUEST_MESSAGE, "param1": message_id(name)}
        )
        message = self._until(name, 2.0)
        return "none" if message is None else " ".join(f"{field}={message.integer(field):#x}" for field in fields)

    def do_interval(self, number: str, interval_us: str) -> str:
        return self._send_command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, [float(number), float(interval_us)])

    def do_rate(self, number: str, interval_us: str) -> str:
        result = self._send_command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, [float(number), float(interval_us)])
        layout = mavlink.mavlink_map.get(int(number))
        duration_s = 3.0
        assert layout is not None
        count = sum(message.name == layout.msgname for message in self._stream(duration_s))
        return f"{result.split(' ')[0]} hz={count / duration_s:.1f}"

    def do_streams(self, rate: str) -> str:
        self.do_request_streams(rate)
        ignored = {"STATUSTEXT", "PARAM_VALUE", "COMMAND_ACK", "TIMESYNC"}
        return " ".join(sorted({m.name for m in self._stream(3.0)} - ignored))

    def do_request_streams(self, rate: str) -> str:
        """Request all streams, without a check of what is sent."""
        values = {"req_stream_id": 0, "req_message_rate": int(rate), "start_stop": 1}
        self.connection.send("REQUEST_DATA_STREAM", TARGET | values)
        return "done"

    def do_ready(self) -> str:
        """Wait in an automatic mode until the checks pass. Return the EKF flags before and after."""
        self._send_command(mavlink.MAV_CMD_DO_SET_MODE, [1.0, GUIDED])
        for number in (1, 193):
            self._send_command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, [float(number), 250_000.0])
        bit = mavlink.MAV_SYS_STATUS_PREARM_CHECK
        healthy = self._until("SYS_STATUS", 120.0, lambda m: bool(m.integer("onboard_control_sensors_health") & bit))
        flags = self._until("EKF_STATUS_REPORT", 2.0)
        assert flags is not None
        return f"{'ready' if healthy else 'not ready'} flags={flags.integer('flags')}"

    def do_status(self, *fields: str) -> str:
        status = self._until("SYS_STATUS", 3.0)
        assert status is not None
        return " ".join(f"{field}={status.integer('onboard_control_sensors_' + field):#x}" for field in fields)

    # -- lists -------------------------------------------------------------------------------------------------

    def _item(self, kind: int, seq: int, row: Row) -> dict[str, Value]:
        command, frame, north, east, alt, params = row
        if north is None:
            x = 0
            y = 0
        elif math.isinf(north):
            x = 2_000_000_000
            y = self.home.lon_e7
        else:
            place = self.home.offset(north, east)
            x = place.lat_e7
            y = place.lon_e7
        values: dict[str, Value] = {f"param{at}": float(p) for at, p in enumerate(params, start=1)}
        target: dict[str, Value] = {"seq": seq, "frame": frame, "command": command, "x": x, "y": y, "z": alt}
        return values | target | TARGET | {"autocontinue": 1, "mission_type": kind}

    def do_upload(self, kind_name: str, name: str, old: str = "") -> str:
        before = len(self.texts)
        kind = KINDS[kind_name]
        rows = LISTS[name]
        self.connection.send("MISSION_COUNT", TARGET | {"count": len(rows), "mission_type": kind})
        requested = 0
        end = self.connection.now_s + 6.0
        while self.connection.now_s < end:
            for message in self._receive():
                if message.name in ("MISSION_REQUEST", "MISSION_REQUEST_INT"):
                    requested += 1
                    seq = message.integer("seq")
                    item = self._item(kind, seq, rows[seq])
                    if old:
                        item |= {"x": float(str(item["x"])) * 1e-7, "y": float(str(item["y"])) * 1e-7}
                    self.connection.send("MISSION_ITEM" if old else "MISSION_ITEM_INT", item)
                elif message.name == "MISSION_ACK":
                    result = mission_result(message.integer("type"))
                    return f"{result} mt={message.integer('mission_type')} after {requested}{self._statustexts_since(before)}"
        return f"no ack after {requested} requests"

    def do_count(self, kind_name: str, count: str) -> str:
        before = len(self.texts)
        self.connection.send("MISSION_COUNT", TARGET | {"count": int(count), "mission_type": KINDS[kind_name]})
        ack = self._until("MISSION_ACK", 2.0)
        result = "no ack" if ack is None else mission_result(ack.integer("type"))
        return f"{result}{self._statustexts_since(before)}"

    def do_clear(self, kind: str) -> str:
        self.connection.send("MISSION_CLEAR_ALL", TARGET | {"mission_type": int(kind)})
        ack = self._until("MISSION_ACK", 2.0)
        assert ack is not None
        return f"{mission_result(ack.integer('type'))} mt={ack.integer('mission_type')}"

    def do_stored(self, kind_name: str, bad: str = "") -> str:
        """Return the number of stored items. If `bad` is set, upload this invalid list first."""
        if bad:
            self.do_upload(kind_name, bad)
        self.connection.send("MISSION_REQUEST_LIST", TARGET | {"mission_type": KINDS[kind_name]})
        count = self._until("MISSION_COUNT", 2.0)
        return f"count={-1 if count is None else count.integer('count')}"

    def do_item(self, kind_name: str, seq: str, *fields: str) -> str:
        self.connection.send("MISSION_REQUEST_INT", TARGET | {"seq": int(seq), "mission_type": KINDS[kind_name]})
        names = ("MISSION_ITEM_INT", "MISSION_ACK")
        message = next((m for m in self._stream(2.0) if m.name in names), None)
        assert message is not None
        shown = fields if message.name == "MISSION_ITEM_INT" else ("type",)
        return " ".join((message.name, *(f"{field}={message.integer(field)}" for field in shown)))

    # -- flying ------------------------------------------------------------------------------------------------

    def do_fly(self, altitude: str) -> str:
        """Arm in GUIDED, climb and hover."""
        self._send_command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, [33.0, 100_000.0])
        self.do_ready()
        armed = self._send_command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, [1.0])
        up_m = float(altitude)
        begun_s = self.connection.now_s
        taken = self._send_command(mavlink.MAV_CMD_NAV_TAKEOFF, [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, up_m])
        while self.connection.now_s < begun_s + 40.0 and self._position()[2] < up_m - 0.5:
            pass
        reached_s = self.connection.now_s - begun_s
        self.do_wait("4")
        return f"arm={armed.split(' ')[0]} takeoff={taken.split(' ')[0]} reached_s={reached_s:.1f}"

    def _speed_and_latitude(self) -> tuple[float, float]:
        at = self._until("GLOBAL_POSITION_INT", 3.0)
        if at is None:
            raise TimeoutError("no GLOBAL_POSITION_INT")
        return math.hypot(at.integer("vx"), at.integer("vy")) / 100.0, at.integer("lat") / 1e7

    def do_goto(self, frame: str, north: str, east: str, up: str) -> str:
        """Send a position target relative to the vehicle. Return distance and highest speed of the first 6 s."""
        before = len(self.texts)
        (n0, e0, u0) = self._position()
        place = self.home.offset(n0 + float(north), e0 + float(east))
        alt_m = self._datum_m(int(frame)) + u0 + float(up)
        values: dict[str, Value] = {"coordinate_frame": int(frame), "type_mask": 0xDF8, "alt": alt_m}
        self.connection.send(
            "SET_POSITION_TARGET_GLOBAL_INT", TARGET | values | {"lat_int": place.lat_e7, "lon_int": place.lon_e7}
        )
        peak = 0.0
        end = self.connection.now_s + 6.0
        while self.connection.now_s < end:
            peak = max(peak, self._speed_and_latitude()[0])
        n1, e1, u1 = self._position()
        texts = self._statustexts_since(before)
        return f"E={e1 - e0:.1f} N={n1 - n0:.1f} U={u1 - u0:.1f} vmax={peak:.1f}{texts}"

    def do_target(self, frame: str, duration: str, *fields: str) -> str:
        """Send a target five times a second. Return the distance (F and R: forward and right), highest speed and
        heading.

        `x` is metres north of the vehicle, or ahead in body frames. All other fields are those of the message. Missing
        fields are zero.
        """
        fields_by_name = {name: float(value) for name, _, value in (field.partition("=") for field in fields)}
        (n0, e0, u0) = self._position()
        number = int(frame)
        before = len(self.texts)
        heading = math.radians(self.last["GLOBAL_POSITION_INT"].integer("hdg") / 100.0)
        x = fields_by_name.pop("x", 0.0)
        values: dict[str, Value] = TARGET | {"coordinate_frame": number, **fields_by_name}
        values |= {name: int(fields_by_name[name]) for name in ("type_mask", "target_system") if name in fields_by_name}
        if number in LOCAL_FRAMES:
            name = "SET_POSITION_TARGET_LOCAL_NED"
            values |= {"x": x + n0, "y": e0, "z": -u0} if number == 1 else {"x": x}
        else:
            place = self.home.offset(n0 + x, e0)
            name = "SET_POSITION_TARGET_GLOBAL_INT"
            values |= {"lat_int": place.lat_e7, "lon_int": place.lon_e7, "alt": self._datum_m(number) + u0}
            values |= {"lat_int": int(fields_by_name["lat_int"])} if "lat_int" in fields_by_name else {}
        peak = 0.0
        end = self.connection.now_s + float(duration)
        has_position = "x" in {f.partition("=")[0] for f in fields}
        self.connection.send(name, values)
        while self.connection.now_s < end:
            next_send_s = min(self.connection.now_s + 0.2, end)
            while self.connection.now_s < next_send_s:
                peak = max(peak, self._speed_and_latitude()[0])
            if not has_position:
                self.connection.send(name, values)
        n1, e1, u1 = self._position()
        heading_deg = self.last["GLOBAL_POSITION_INT"].integer("hdg") / 100.0
        turned = (heading_deg - math.degrees(heading) + 180.0) % 360.0 - 180.0
        north = n1 - n0
        east = e1 - e0
        ahead = north * math.cos(heading) + east * math.sin(heading)
        right = east * math.cos(heading) - north * math.sin(heading)
        distance = f"F={ahead:.1f} R={right:.1f}" if number in BODY_FRAMES else f"E={east:.1f} N={north:.1f}"
        texts = self._statustexts_since(before)
        self._until_still()
        yaw = (
            f" turned={turned:.0f}"
            if "yaw_rate" in fields_by_name
            else f" hdg={heading_deg:.0f}"
            if "yaw" in fields_by_name
            else ""
        )
        return f"{distance} U={u1 - u0:.1f} vmax={peak:.1f}{yaw}{texts}"

    def _until_still(self) -> None:
        self.connection.send("SET_POSITION_TARGET_LOCAL_NED", TARGET | {"coordinate_frame": 1, "type_mask": 0xDC7})
        self._stopped(0.2)

    def _run(self, speed: float, duration_s: float = 8.0) -> None:
        end = self.connection.now_s + duration_s
        while self.connection.now_s < end:
            values: dict[str, Value] = {"coordinate_frame": 1, "type_mask": 0xDC7, "vx": speed}
            self.connection.send("SET_POSITION_TARGET_LOCAL_NED", TARGET | values)
            self.do_wait("0.2")

    def _stopped(self, slow_mps: float) -> tuple[float, float]:
        """Return the seconds until the vehicle stops, and the distance."""
        begun_s = self.connection.now_s
        (n0, e0, _) = self._position()
        while self.connection.now_s < begun_s + 15.0 and self._speed_and_latitude()[0] > slow_mps:
            pass
        stop_s = self.connection.now_s - begun_s
        self.do_wait("2")
        n1, e1, _ = self._position()
        return stop_s, math.hypot(n1 - n0, e1 - e0)

    def do_brake(self, speed: str) -> str:
        self._run(float(speed))
        self.connection.send("SET_MODE", {"target_system": 1, "base_mode": 1, "custom_mode": BRAKE})
        stop_s, distance_m = self._stopped(0.5)
        self._send_command(mavlink.MAV_CMD_DO_SET_MODE, [1.0, GUIDED])
        return f"stop_s={stop_s:.2f} dist={distance_m:.1f}"

    def do_stop(self, speed: str) -> str:
        self._run(float(speed))
        self.connection.send("SET_POSITION_TARGET_LOCAL_NED", TARGET | {"coordinate_frame": 1, "type_mask": 0xDC7})
        stop_s, distance_m = self._stopped(0.5)
        return f"stop_s={stop_s:.2f} dist={distance_m:.1f}"

    def do_timeout(self, timeout: str) -> str:
        self._set("GUID_TIMEOUT", float(timeout))
        self._run(3.0, 4.0)
        return f"s={0.2 + self._stopped(0.15)[0]:.1f}"

    def do_breach(self, speed: str) -> str:
        """Fly north with a velocity until the fence acts. Return the farthest distance from home."""
        before = len(self.texts)
        farthest = 0.0
        end = self.connection.now_s + 40.0
        while self.connection.now_s < end and self._mode() == GUIDED:
            self._run(float(speed), 0.6)
            farthest = max(farthest, self._position()[0])
        for _ in range(20):
            farthest = max(farthest, self._position()[0])
        return f"N={farthest:.0f} mode={self._mode()}{self._statustexts_since(before)}"

    def do_home(self) -> str:
        """Fly RTL and return the seconds until the motors stop."""
        begun_s = self.connection.now_s
        self._send_command(mavlink.MAV_CMD_DO_SET_MODE, [1.0, RTL])
        self._until("HEARTBEAT", 150.0, lambda m: not m.integer("base_mode") & 128)
        return f"s={self.connection.now_s - begun_s:.0f}"

    def do_tour(self, last: str) -> str:
        """Arm in GUIDED and fly the stored mission to its last item. Return reached items and STATUSTEXTs in order."""
        self._send_command(mavlink.MAV_CMD_DO_SET_MODE, [1.0, GUIDED])
        self._send_command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, [1.0])
        before = len(self.texts)
        sequences = {"MISSION_ITEM_REACHED": [""], "MISSION_CURRENT": [""]}
        self._send_command(mavlink.MAV_CMD_MISSION_START, [])
        for message in self._stream(150.0):
            if message.name in sequences and sequences[message.name][-1] != str(message.integer("seq")):
                sequences[message.name].append(str(message.integer("seq")))
            if sequences["MISSION_CURRENT"][-1] == last:
                break
        mission_texts = [t for t in self.texts[before:] if t[4:].startswith(("Mission", "Reached"))]
        distinct = [text for at, text in enumerate(mission_texts) if text not in mission_texts[at - 1 : at]]
        return f"reached={','.join(sequences['MISSION_ITEM_REACHED'][1:])} | {'; '.join(distinct)}"

    def do_check(self, name: str, value: str) -> str:
        """Set one parameter, try to arm in GUIDED, and restore the parameter. Return result, PREARM bit and texts."""
        self.connection.send("PARAM_REQUEST_READ", TARGET | {"param_id": name.encode("ascii"), "param_index": -1})
        before = self._until("PARAM_VALUE", 1.5, lambda m: m.text("param_id") == name)
        assert before is not None
        self._set(name, float(value))
        self.do_wait("2")
        response = self._send_command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, [1.0])
        if response.startswith("ACCEPTED"):
            self._send_command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, [0.0])
        status = self._until("SYS_STATUS", 3.0)
        assert status is not None
        healthy = status.integer("onboard_control_sensors_health") & mavlink.MAV_SYS_STATUS_PREARM_CHECK
        self._set(name, before.real("param_value"))
        result, _, texts = response.partition(" | ")
        return f"{result} prearm={1 if healthy else 0}{' | ' if texts else ''}{texts}"

    def do_start(self) -> str:
        """Arm in GUIDED and start the stored mission. The record of the flight begins."""
        self._send_command(mavlink.MAV_CMD_DO_SET_MODE, [1.0, GUIDED])
        armed = self._send_command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, [1.0])
        self._flight = FlightRecord(self.connection.now_s, len(self.texts))
        return f"{armed} {self._send_command(mavlink.MAV_CMD_MISSION_START, [])}"

    def do_follow(self, until: str) -> str:
        """Wait until the motors stop, at most until `until` seconds after the start. Return the final state.

        Progress is recorded during this wait only, as in the probe that was run on the real vehicle.
        """
        self._following = True
        left_s = self._flight.begun_s + float(until) - self.connection.now_s
        disarmed = self._until("HEARTBEAT", left_s, _is_disarmed)
        self._following = False
        after_s = self.connection.now_s - self._flight.begun_s
        north, east, up = self._position()
        return f"armed={disarmed is None} mode={self._mode()} t={after_s:.0f} N={north:.0f} E={east:.0f} alt={up:.0f}"

    def do_progress(self, kind: str) -> str:
        """Return the `reached` or `current` items of the flight, or its `texts`."""
        if kind == "texts":
            texts = self.texts[self._flight.texts_from :]
            return "; ".join(text for text in texts if not text[4:].startswith(SPONTANEOUS))
        return " ".join(self._flight.reached if kind == "reached" else self._flight.current) or "none"

    def do_where(self) -> str:
        """Return mode and altitude."""
        return f"mode={self._mode()} alt={self._position()[2]:.0f}"

    def do_land(self) -> str:
        """Change to LAND and return the seconds until the motors stop."""
        begun_s = self.connection.now_s
        self._send_command(mavlink.MAV_CMD_DO_SET_MODE, [1.0, LAND])
        self._until("HEARTBEAT", 90.0, _is_disarmed)
        return f"s={self.connection.now_s - begun_s:.1f}"

    def do_until(self, timeout: str, *words: str) -> str:
        """Wait for a STATUSTEXT. Return the elapsed seconds and the mode."""
        begun_s = self.connection.now_s
        before = len(self.texts)
        text = " ".join(words)
        while self.connection.now_s < begun_s + float(timeout) and not any(text in t for t in self.texts[before:]):
            self._receive()
        waited_s = self.connection.now_s - begun_s
        return f"s={waited_s:.1f} mode={self._mode()}"


def abort_reason(action: str) -> str:
    """Return why a step aborts SITL. Such a step is played on the simulated vehicle only. The text is empty for all other steps."""
    verb, *words = action.split()
    lists = words[1:2] if verb in ("upload", "stored") and words[0] == "fence" else []
    if any(not math.isfinite(value) for name in lists for *_, params in LISTS.get(name, ()) for value in params):
        return "a fence item that is not a number aborts SITL"
    intervals = words[1:2] if verb in ("interval", "rate") else []
    if verb == "command" and words[:1] == [str(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL)]:
        intervals = words[2:3]
    # The comparison is also False for NaN.
    if any(not float(interval) < LONGEST_INTERVAL_US for interval in intervals):
        return "this message interval aborts SITL"
    return ""


@dataclass(slots=True)
class Summary:
    """Result of a comparison.

    Attributes:
        played: Number of steps with a response.
        wrong: Number of steps that differ unintentionally.
        lost: True if the link was lost and did not return.
    """

    played: int = 0
    wrong: int = 0
    lost: bool = False


def compare(
    connection: Connection,
    report: Callable[[Step, str, str], None],
    script: Sequence[Step],
    summary: Summary,
    *,
    simulated: bool,
) -> None:
    """Play and report all steps: `same`, `differs`, `intended` or `not played`.

    Args:
        connection: Link to the autopilot.
        report: Called with each step, its response (or the reason why it was not played) and the verdict.
        script: Steps.
        summary: Updated with each step, so that it is valid after an interruption.
        simulated: True if the autopilot is the simulated vehicle, on which all steps are played.
    """
    player = Player(connection)
    for step in script:
        if summary.lost or not step.action:
            report(step, "the link was lost" if summary.lost else "", "not played")
            continue
        if not simulated and (reason := abort_reason(step.action)):
            report(step, reason, "not played")
            continue
        try:
            response = player.play(step.action)
        except OSError as error:
            # TimeoutError of the player is an OSError too, but then the link still works.
            response = f"no response ({error})"
            summary.lost = not isinstance(error, TimeoutError) and not connection.reconnect()
        except (AssertionError, LookupError) as error:
            response = f"no response ({error or type(error).__name__})"
        verdict = "same" if matches(step.recorded, response) else "intended" if step.note else "differs"
        summary.played += 1
        summary.wrong += verdict == "differs"
        report(step, response, verdict)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table, and return the exit code: 0 if all steps were played and none differs unintentionally."""
    parser = argparse.ArgumentParser(description="Compare an autopilot with a real ArduCopter 4.6.")
    parser.add_argument("--autopilot", help="tcp:HOST:PORT, freshly booted; default: the simulated vehicle")
    parser.add_argument(
        "--all", action="store_true", help="also print steps without differences and steps that are not played"
    )
    parser.add_argument("--steps", type=Path, default=STEPS, help="another script in the same format")
    options = parser.parse_args(arguments)
    connection: Connection
    try:
        connection = TcpConnection(options.autopilot) if options.autopilot else SimulatedConnection()
    except (OSError, ValueError) as error:
        parser.error(f"cannot connect to {options.autopilot}: {error}; expected tcp:HOST:PORT of a running autopilot")

    script = steps(options.steps)
    begun_s = time.monotonic()
    reported = 0

    def report(step: Step, response: str, verdict: str) -> None:
        nonlocal reported
        reported += 1
        if options.all or verdict in ("differs", "intended"):
            print(f"{verdict:10} | {step.name} | {step.recorded} | {response} | {step.note}", flush=True)
        progress = f"{reported} of {len(script)} steps, {time.monotonic() - begun_s:.0f} s"
        print(progress, end="\r" if sys.stderr.isatty() else "\n", file=sys.stderr, flush=True)

    summary = Summary()
    interrupted = False
    try:
        compare(connection, report, script, summary, simulated=not options.autopilot)
    except KeyboardInterrupt:
        interrupted = True
    ending = ""
    if summary.lost:
        ending = "; the link to the autopilot was lost"
    elif interrupted:
        ending = "; interrupted"
    print(
        f"{summary.wrong} of {summary.played} played steps differ unintentionally, {len(script)} steps in total{ending}"
    )
    return 1 if summary.wrong or ending else 0


if __name__ == "__main__":
    sys.exit(main())

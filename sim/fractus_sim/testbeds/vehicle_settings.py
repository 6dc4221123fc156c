"""Settings of a running autopilot, read over MAVLink: all parameters, the fence and the rally points."""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from fractus_radio.follower import parse_address
from fractus_runtime.mavlink_codec import Endpoint, Message, Value, message_id
from fractus_services.mobility.mavlink.companion import COMPONENT_ID, SYSTEM_ID
from fractus_services.mobility.mavlink.parameters import same
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_sim.errors import ExperimentError
from fractus_sim.testbeds.ground_station import TcpLink

CONNECT_TIMEOUT_S = 5.0
HEARTBEAT_TIMEOUT_S = 15.0
REQUEST_INTERVAL_S = 1.0
LINK_POLL_S = 0.02
RESPONSE_TIMEOUT_S = 1.0
ATTEMPTS = 8
LIST_QUIET_S = 2.0
"""Time without a further parameter after which the autopilot has stopped sending its list."""

LIST_TIMEOUT_S = 180.0
"""Longest time for the transfer of the parameter list. It takes half a minute at 57,600 baud."""

MISSING_WINDOW = 12
"""Number of missing parameters that are requested together."""

_LISTS = {"fence": mavlink.MAV_MISSION_TYPE_FENCE, "rally point": mavlink.MAV_MISSION_TYPE_RALLY}
_ITEM_FIELDS = ("command", "frame", "param1", "param2", "param3", "param4", "x", "y", "z")

_MEASURED = re.compile(
    r"STAT_|SIM_|BARO\d*_GND_PRESS|INS\d*_GYR\w*(OFFS|CALTEMP)|COMPASS_(OFS|DEC)|MOT_THST_HOVER|AHRS_ORIG"
)
"""Parameters that ArduPilot itself writes: counters, calibrations and learned values, and the parameters of a simulation."""

Item = tuple[float, ...]
"""Fields of MISSION_ITEM_INT, in the order of `_ITEM_FIELDS`."""


@dataclass(frozen=True, slots=True)
class VehicleSettings:
    """Settings of an autopilot.

    Attributes:
        identity: MAVLink system id, and the serial number of the board if the autopilot reports one.
        parameters: Values by name.
        fence: Fence items.
        rally: Rally points.
    """

    identity: str
    parameters: Mapping[str, float]
    fence: tuple[Item, ...]
    rally: tuple[Item, ...]

    def to_json(self) -> bytes:
        """Return the settings as JSON."""
        content = {
            "identity": self.identity,
            "parameters": dict(sorted(self.parameters.items())),
            "fence": self.fence,
            "rally": self.rally,
        }
        return json.dumps(content, indent=1).encode()

    @classmethod
    def from_dict(cls, content: Any) -> VehicleSettings:
        """Return the settings from the value of `to_json`.

        Raises:
            ValueError, KeyError, TypeError, AttributeError: The content has another structure.
        """
        parameters = {str(name): float(value) for name, value in content["parameters"].items()}
        fence, rally = (tuple(tuple(map(float, item)) for item in content[kind]) for kind in ("fence", "rally"))
        return cls(str(content["identity"]), parameters, fence, rally)

    def changed_parameters(self, later: VehicleSettings) -> list[str]:
        """Return the names of parameters that differ in later settings, except those that the autopilot itself writes."""
        names = sorted(self.parameters.keys() | later.parameters.keys())
        return [
            name
            for name in names
            if not _MEASURED.match(name) and not _same(self.parameters.get(name), later.parameters.get(name))
        ]

    def differences(self, later: VehicleSettings) -> list[str]:
        """Return the differences of later settings as sentences, without parameters that the autopilot itself writes."""
        found = [
            f"{name} was {_text(self.parameters.get(name))} and is {_text(later.parameters.get(name))}"
            for name in self.changed_parameters(later)
        ]
        for name, before, after in (("fence", self.fence, later.fence), ("rally points", self.rally, later.rally)):
            if len(before) != len(after):
                found.append(f"the {name} had {len(before)} items and has {len(after)}")
            elif not all(_same_item(a, b) for a, b in zip(before, after, strict=True)):
                found.append(f"items of the {name} changed")
        return found


def _same(before: float | None, after: float | None) -> bool:
    if before is None or after is None:
        return before is after
    return same(before, after) or (math.isnan(before) and math.isnan(after))


def _same_item(before: Item, after: Item) -> bool:
    return all(_same(a, b) for a, b in zip(before, after, strict=True))


def _text(value: float | None) -> str:
    return "missing" if value is None else f"{value:g}"


def parse_link(text: str) -> tuple[str, int]:
    """Parse `tcp:HOST:PORT`.

    Raises:
        ExperimentError: The text has a different format.
    """
    try:
        return parse_address(text)
    except ValueError:
        raise ExperimentError(f"autopilot {text!r}: expected tcp:HOST:PORT") from None


class AutopilotConnection:
    """A connection to an autopilot on which no other program waits for replies.

    Requests have the system id of the companion computer, because an autopilot may ignore other stations. Use `open`.

    Attributes:
        system_id: MAVLink system id of the vehicle.
    """

    def __init__(self, link: str, connection: TcpLink) -> None:
        self.system_id = 0
        self._name = link
        self._link = connection
        self._endpoint = Endpoint(SYSTEM_ID, COMPONENT_ID)

    @classmethod
    @contextmanager
    def open(cls, link: str) -> Iterator[AutopilotConnection]:
        """Connect to a disarmed ArduPilot, and close the link at the end of the block.

        Raises:
            ExperimentError: The link is not `tcp:HOST:PORT`, there is no heartbeat, the autopilot is not ArduPilot, or the vehicle is
                armed.
        """
        host, port = parse_link(link)
        connection = cls(link, TcpLink.connect(host, port, CONNECT_TIMEOUT_S))
        try:
            connection._find()
            yield connection
        finally:
            connection._link.close()

    def _find(self) -> None:
        heartbeat = self.wait(
            lambda m: m.name == "HEARTBEAT" and m.compid == mavlink.MAV_COMP_ID_AUTOPILOT1,
            HEARTBEAT_TIMEOUT_S,
            "no heartbeat",
        )
        if heartbeat.integer("autopilot") != mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA:
            raise ExperimentError(f"the autopilot at {self._name} is not ArduPilot")
        if heartbeat.integer("base_mode") & mavlink.MAV_MODE_FLAG_SAFETY_ARMED:
            raise ExperimentError(f"the vehicle at {self._name} is armed; land and disarm it first")
        self.system_id = heartbeat.sysid

    def request(self, name: str) -> None:
        """Request one message of a type."""
        self.send("COMMAND_LONG", {"command": int(mavlink.MAV_CMD_REQUEST_MESSAGE), "param1": float(message_id(name))})

    def send(self, name: str, values: Mapping[str, Value]) -> None:
        """Send a message to the autopilot."""
        target: dict[str, Value] = {"target_system": self.system_id, "target_component": 1}
        self._link.send(self._endpoint.encode(name, {**values, **target}))

    def wait(self, matches: Callable[[Message], bool], timeout_s: float, missing: str, requested: str = "") -> Message:
        """Return the first message that matches.

        Args:
            matches: Condition of the message.
            timeout_s: Maximum time to wait, seconds.
            missing: Description of the message for the error.
            requested: Name of a message to request every second.

        Raises:
            ExperimentError: No message matched before the timeout.
        """
        deadline = time.monotonic() + timeout_s
        next_request_s = time.monotonic()
        while time.monotonic() < deadline:
            if requested and time.monotonic() >= next_request_s:
                next_request_s += REQUEST_INTERVAL_S
                self.request(requested)
            for message in self._receive():
                if matches(message):
                    return message
        raise ExperimentError(f"{missing} from the autopilot within {timeout_s:.0f} s")

    def read_settings(self) -> VehicleSettings:
        """Read identity, parameters, fence and rally points.

        Raises:
            ExperimentError: The autopilot stopped answering.
        """
        parameters = self._read_parameters()
        fence, rally = (self._read_list(name) for name in _LISTS)
        return VehicleSettings(self._read_identity(), parameters, fence, rally)

    def write_parameter(self, name: str, value: float) -> None:
        """Set a parameter. The caller must read it back.

        Raises:
            ExperimentError: The autopilot does not answer.
        """
        values: dict[str, Value] = {
            "param_id": name.encode("ascii"),
            "param_value": value,
            "param_type": mavlink.MAV_PARAM_TYPE_REAL32,
        }
        for _ in range(ATTEMPTS):
            self.send("PARAM_SET", values)
            if self._next(lambda m: m.name == "PARAM_VALUE" and m.text("param_id") == name) is not None:
                return
        raise ExperimentError(f"{name} cannot be set: the autopilot does not answer")

    def _receive(self) -> list[Message]:
        """Return the received messages, after a short wait if there are none."""
        messages = self._endpoint.decode(self._link.receive())
        if not messages:
            time.sleep(LINK_POLL_S)
        return [m for m in messages if self.system_id in (0, m.sysid)]

    def _next(self, matches: Callable[[Message], bool]) -> Message | None:
        """Return the first message that matches, or None after `RESPONSE_TIMEOUT_S`."""
        deadline = time.monotonic() + RESPONSE_TIMEOUT_S
        while time.monotonic() < deadline:
            for message in self._receive():
                if matches(message):
                    return message
        return None

    def _read_identity(self) -> str:
        """Return the system id, and the serial number if AUTOPILOT_VERSION contains one."""
        serial = ""
        for _ in range(ATTEMPTS):
            self.request("AUTOPILOT_VERSION")
            version = self._next(lambda m: m.name == "AUTOPILOT_VERSION")
            if version is not None:
                number = bytes(int(part) for part in version.array("uid2")) if version.has("uid2") else b""
                serial = number.hex() if any(number) else f"{version.integer('uid') or ''}"
                break
        return f"system {self.system_id}" + (f", serial number {serial}" if serial else "")

    def _read_parameters(self) -> dict[str, float]:
        """Read the complete parameter list."""
        received: dict[int, tuple[str, float]] = {}
        size: int | None = None
        deadline = time.monotonic() + LIST_TIMEOUT_S
        silent = 0
        while silent < ATTEMPTS and time.monotonic() < deadline:
            if size is None or size - len(received) > MISSING_WINDOW:
                self.send("PARAM_REQUEST_LIST", {})
            else:
                missing = [index for index in range(size) if index not in received][:MISSING_WINDOW]
                for index in missing:
                    self.send("PARAM_REQUEST_READ", {"param_index": index, "param_id": b""})
            before = len(received)
            quiet_since_s = time.monotonic()
            while time.monotonic() - quiet_since_s < LIST_QUIET_S:
                for message in self._receive():
                    if message.name != "PARAM_VALUE" or message.integer("param_index") >= message.integer(
                        "param_count"
                    ):
                        continue
                    if message.integer("param_count") != size:
                        # Enabling a feature changes the length and the indices of the list.
                        size = message.integer("param_count")
                        received = {}
                    received[message.integer("param_index")] = message.text("param_id"), message.real("param_value")
                    quiet_since_s = time.monotonic()
                if size is not None and len(received) == size:
                    return dict(received.values())
            silent = 0 if len(received) > before else silent + 1
        raise ExperimentError(
            f"the autopilot at {self._name} does not send its complete parameter list ({len(received)} of {size or '?'} received)"
        )

    def _read_list(self, name: str) -> tuple[Item, ...]:
        """Read the fence or the rally points. An autopilot without such a list has no items."""
        kind = _LISTS[name]
        answers = ("MISSION_COUNT", "MISSION_ACK")
        count = self._ask("MISSION_REQUEST_LIST", {}, kind, name, lambda m: m.name in answers)
        if count.name == "MISSION_ACK":
            return ()
        items = []
        for seq in range(count.integer("count")):

            def is_item(message: Message, seq: int = seq) -> bool:
                return message.name == "MISSION_ITEM_INT" and message.integer("seq") == seq

            item = self._ask("MISSION_REQUEST_INT", {"seq": seq}, kind, name, is_item)
            items.append(tuple(item.real(field) for field in _ITEM_FIELDS))
        self.send("MISSION_ACK", {"mission_type": kind})
        return tuple(items)

    def _ask(
        self, request: str, values: Mapping[str, Value], kind: int, name: str, matches: Callable[[Message], bool]
    ) -> Message:
        """Send a request of the mission protocol until the answer of the same list arrives."""

        def answers(message: Message) -> bool:
            return matches(message) and message.integer("mission_type") == kind

        for _ in range(ATTEMPTS):
            self.send(request, {**values, "mission_type": kind})
            answer = self._next(answers)
            if answer is not None:
                return answer
        raise ExperimentError(f"the autopilot at {self._name} stopped answering while its {name} items were read")

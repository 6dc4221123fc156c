"""State of one connection of a MAVLink program: frames in, calls and frames out. It does no I/O and reads no clock."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from fractus_proto.v1 import mobility_pb2
from fractus_runtime.mavlink_codec import Message, Value, enum_names
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.gateway import translate
from fractus_services.gateway.decisions import DECISIONS
from fractus_services.gateway.gateway_metrics import Verdict, ignore_verdict
from fractus_services.gateway.missions import MissionLists
from fractus_services.gateway.parameters import ParameterView
from fractus_services.gateway.translate import Request, Untranslatable
from fractus_services.gateway.virtual_vehicle import DESCENTS, VirtualVehicle
from fractus_services.mavlink_server.channel import PARAMETERS_PER_TICK, Channel
from fractus_services.mavlink_server.coordinates import RELATIVE_FRAMES
from fractus_services.mavlink_server.stream_groups import ALL_GROUPS, GROUPS

MAX_FRAMES_PER_S = 1000.0
MAX_BYTES_PER_S = 100_000.0
"""Rates above which the gateway delays reading, so that TCP slows the program down. Damaged frames count too."""

MAX_INTERVAL_HZ = 50.0
"""Maximum rate of a message, in Hz."""

HEARTBEAT_SILENCE_S = 5.0
"""Time without a HEARTBEAT after which a program that sends heartbeats counts as silent."""

IN_PROGRESS_S = 1.0
"""Interval at which a command in progress is reported."""

TEXT_INTERVAL_S = 5.0
"""Interval between two texts about the same kind of refused message."""

MAX_TEXTS = 20.0
TEXTS_PER_S = 2.0
"""Burst and rate of texts. Further texts are dropped."""

FIRST_HOLD_S = 1.5
MAX_HOLD_S = 2.0
HOLD_PERIODS = 1.5
"""Time for which a velocity is held: for the first velocity, at most, and in observed periods between velocities."""

RESERVED_SOURCES = frozenset({(1, mavlink.MAV_COMP_ID_AUTOPILOT1), (244, mavlink.MAV_COMP_ID_ONBOARD_COMPUTER)})
"""System and component ids of the autopilot and of the mobility service. A HEARTBEAT with such ids is refused."""

TEXT_BYTES = 50
VERSION = 0x040603FF
"""Version that AUTOPILOT_VERSION reports: ArduCopter 4.6.3. The gateway offers the interface of this version."""

CAPABILITIES = (
    mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_FLOAT
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_FENCE
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_RALLY
    | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
    | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_GLOBAL_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
    | mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
)


def ignore(_frame: bytes) -> None:
    """Record nothing."""


Source = tuple[int, int]
"""System and component id of the sender."""


@dataclass(frozen=True, slots=True)
class Call:
    """A request of a program to the mobility service.

    Attributes:
        request: Method and request message.
        name: MAVLink name of the command or message, for texts.
        source: Sender, to which the response is addressed.
        command: MAV_CMD or message id that COMMAND_ACK contains; None if the message has another response.
        mission_ack: True if the response is a MISSION_ACK.
        parameter: Parameter that the call sets; empty if it sets none.
        before: Value of the parameter before the write.
    """

    request: Request
    name: str
    source: Source
    command: int | None = None
    mission_ack: bool = False
    parameter: str = ""
    before: float = 0.0

    @property
    def is_setpoint(self) -> bool:
        """True if the message has no response, so that a later message may replace the call."""
        others = {translate.FLY_MISSION, translate.CHECK_MISSION}
        return (
            self.command is None and not self.mission_ack and not self.parameter and self.request.method not in others
        )

    @property
    def key(self) -> tuple[Source, int | None]:
        """Key of a command in progress."""
        return self.source, self.command


@dataclass(frozen=True, slots=True)
class Refusal:
    """A message or command that the gateway refused, for the audit log."""

    name: str
    reason: str


@dataclass(slots=True)
class _InProgress:
    call: Call
    report_due_s: float


@dataclass(slots=True)
class _VelocityRate:
    """Observed period between velocities of the program."""

    at: float = -math.inf

    def hold_s(self, now: float) -> float:
        period_s = now - self.at
        self.at = now
        if period_s > FIRST_HOLD_S:
            return FIRST_HOLD_S
        return min(max(HOLD_PERIODS * period_s, 0.1), MAX_HOLD_S)


@dataclass(slots=True)
class _CommandFields:
    """Fields of COMMAND_LONG or COMMAND_INT."""

    number: int
    params: tuple[float, float, float, float]
    x: float
    y: float
    z: float
    frame: int | None = field(default=None)


class Session:
    """Protocol state of one connection.

    Args:
        vehicle: Vehicle as the instance sees it, shared by the sessions of the instance.
        parameters: Parameters of the instance.
        missions: Stored missions, fences and rally points of the instance.
        record: Callback that receives each valid frame of the program.
        count: Callback that receives the verdict on each message.

    Attributes:
        refusals: Refusals since the last call of `take_refusals`.
        reopen: True if the program requests control again after it lost control.
        frames: Number of valid frames that were received.
    """

    def __init__(
        self,
        vehicle: VirtualVehicle,
        parameters: ParameterView,
        missions: MissionLists,
        record: Callable[[bytes], None] = ignore,
        count: Callable[[Verdict], None] = ignore_verdict,
    ) -> None:
        self._missions = missions
        self._count = count
        self._decision: Verdict = "respond"
        self._vehicle = vehicle
        self._parameters = parameters
        self._record = record
        self._channel = Channel(1, mavlink.MAV_COMP_ID_AUTOPILOT1)
        self._channel.set_default("HEARTBEAT", 1.0)
        self._in_progress: dict[tuple[Source, int | None], _InProgress] = {}
        self._sent_at: dict[str, float] = {}
        self._text_at: dict[str, float] = {}
        self._text_id = 0
        self._texts = MAX_TEXTS
        self._texts_at = -math.inf
        self._velocity = _VelocityRate()
        self._heartbeat_at = -math.inf
        self._versions: set[int] = set()  # first bytes of the received frames
        self._list_requested = False
        self._busy_until = -math.inf
        self.refusals: list[Refusal] = []
        self.reopen = False
        self.frames = 0

    # Input

    def receive(self, data: bytes, now: float) -> list[Call]:
        """Process received bytes and return the calls that they cause."""
        calls: list[Call] = []
        bad = self._channel.parser.bad
        messages = self._channel.receive(data)
        frames = len(messages) + self._channel.parser.bad - bad
        cost_s = max(frames / MAX_FRAMES_PER_S, len(data) / MAX_BYTES_PER_S)
        self._busy_until = max(self._busy_until, now) + cost_s
        for message in messages:
            self.frames += 1
            self._record(message.frame)
            self._versions.add(message.frame[0])
            self._channel.mavlink1 = self._versions == {mavlink.PROTOCOL_MARKER_V1}
            if not _addresses_vehicle(message):
                self._count("consume")
                continue
            caused: list[Call] = []
            self._decision = "respond"
            try:
                caused = self._handle(message, now)
            except Untranslatable as problem:
                self._refuse(message.name, str(problem), now)
            if not caused:
                self._count(self._decision)  # calls are counted when they have a verdict
            calls += caused
        return calls

    def delay_s(self, now: float) -> float:
        """Return the time for which no further bytes should be read, in seconds."""
        return max(self._busy_until - now, 0.0)

    def silent(self, now: float) -> bool:
        """Return True if the program has sent heartbeats before, but none for `HEARTBEAT_SILENCE_S`."""
        return math.isfinite(self._heartbeat_at) and now - self._heartbeat_at > HEARTBEAT_SILENCE_S

    def _handle(self, message: Message, now: float) -> list[Call]:
        decision = DECISIONS.received.get(message.name, "refuse")
        if decision == "consume":
            self._decision = "consume"
            if message.name == "HEARTBEAT":
                if (message.sysid, message.compid) in RESERVED_SOURCES:
                    raise Untranslatable("the ids 1/1 and 244/191 belong to the drone; send heartbeats with other ids")
                self._heartbeat_at = now
            return []
        if decision == "respond":
            _RESPONSES[message.name](self, message, now)
            return []
        if decision == "refuse":
            if message.name == "FILE_TRANSFER_PROTOCOL":
                self._refuse_file_transfer(message)
            raise Untranslatable("programs may not send this message")
        return self._translate(message, now)

    def _translate(self, message: Message, now: float) -> list[Call]:
        source = (message.sysid, message.compid)
        match message.name:
            case "COMMAND_LONG" | "COMMAND_INT":
                return self._command(message, source, now)
            case "SET_MODE":
                custom = message.integer("custom_mode")
                return self._set_mode(custom, mavlink.MAVLINK_MSG_ID_SET_MODE, "SET_MODE", source, now)
            case "MISSION_ITEM" | "MISSION_ITEM_INT" | "MISSION_COUNT" | "MISSION_SET_CURRENT":
                return self._mission_message(message, source, now)
            case "PARAM_SET":
                return self._set_parameter(message, source, now)
            case "GIMBAL_MANAGER_SET_PITCHYAW":
                pitch_deg = math.degrees(message.real("pitch"))
                return [Call(translate.gimbal(pitch_deg, math.degrees(message.real("yaw"))), message.name, source)]
            case _:
                self._require_guided()
                hold_s = self._velocity.hold_s(now)
                request = translate.TARGETS[message.name](message, hold_s, self._vehicle, now)
                return [Call(request, message.name, source)]

    # Commands

    def _command(self, message: Message, source: Source, now: float) -> list[Call]:
        fields = _fields_of(message)
        name = enum_names("MAV_CMD").get(fields.number, str(fields.number))
        decision = DECISIONS.commands.get(name, "refuse")
        if decision == "respond":
            self._acknowledge(source, fields.number, _COMMAND_RESPONSES[name](self, fields, now))
            return []
        if name != "DO_SET_MODE" and (source, fields.number) in self._in_progress:
            # The program repeats a command whose acknowledgement it has not received yet.
            self._acknowledge(source, fields.number, mavlink.MAV_RESULT_IN_PROGRESS)
            return []
        try:
            if name in translate.UNSUPPORTED:
                raise Untranslatable(translate.UNSUPPORTED[name], mavlink.MAV_RESULT_UNSUPPORTED)
            if decision == "refuse":
                raise Untranslatable("programs may not send this command")
            if name == "DO_SET_MODE":
                return self._set_mode(_mode_number(fields), fields.number, name, source, now)
            if name in _MISSION_COMMANDS:
                return _MISSION_COMMANDS[name](self, fields, name, source, now)
            request = _COMMANDS[name](self, fields, now)
        except Untranslatable as problem:
            self._acknowledge(source, fields.number, problem.result)
            self._refuse(name, str(problem), now)
            return []
        return self._begin(Call(request, name, source, fields.number), now)

    def _begin(self, call: Call, now: float) -> list[Call]:
        progress = self._in_progress.get(call.key)
        if progress is not None and progress.call.request == call.request:
            # The program repeats a mode. Another mode would be a new call.
            self._acknowledge(call.source, call.command or 0, mavlink.MAV_RESULT_IN_PROGRESS)
            return []
        if call.request.method == "Arm":
            self._acknowledge(call.source, call.command or 0, mavlink.MAV_RESULT_IN_PROGRESS)
        self._in_progress[call.key] = _InProgress(call, now + IN_PROGRESS_S)
        return [call]

    def _set_mode(self, mode: int, command: int, name: str, source: Source, now: float) -> list[Call]:
        vehicle = self._vehicle
        if mode == mavlink.COPTER_MODE_GUIDED:
            if not vehicle.granted:
                self._reject_without_control("GUIDED", command, source, now)
                return []
            if vehicle.in_mission or (vehicle.flying_mode in DESCENTS and vehicle.armed):
                stop = Request("Hover", mobility_pb2.HoverRequest(), mavlink.COPTER_MODE_GUIDED)
                return self._begin(Call(stop, name, source, command), now)
            vehicle.flying_mode = mavlink.COPTER_MODE_GUIDED
            self._acknowledge(source, command, mavlink.MAV_RESULT_ACCEPTED)
            return []
        if mode == mavlink.COPTER_MODE_AUTO:
            return self._fly_mission(None, command, name, source, now)
        if mode in translate.RETURN_MODES:
            request = translate.return_to_launch()
        elif mode == mavlink.COPTER_MODE_LAND:
            request = translate.land()
        elif mode in translate.HOVER_MODES:
            request = translate.hover()
        else:
            title = enum_names("COPTER_MODE").get(mode, str(mode))
            self._acknowledge(source, command, mavlink.MAV_RESULT_DENIED)
            self._refuse(name, f"mode {title} is not available; use GUIDED, AUTO, BRAKE, RTL or LAND", now)
            return []
        return self._begin(Call(request, name, source, command), now)

    # Missions

    def _mission_message(self, message: Message, source: Source, now: float) -> list[Call]:
        if message.name == "MISSION_SET_CURRENT":
            return self._set_current(message.integer("seq"), None, message.name, source, now)
        if message.name != "MISSION_COUNT" and message.integer("current") in {2, 3}:
            return self._guided_item(message, source, now)
        return self._transfer(message, source, now)

    def _require_guided(self) -> None:
        """Refuse targets while the drone flies its mission, returns or lands, as ArduCopter does.

        Raises:
            Untranslatable: The mode is AUTO, RTL or LAND.
        """
        vehicle = self._vehicle
        if vehicle.in_mission or (vehicle.granted and vehicle.armed and vehicle.flying_mode in DESCENTS):
            title = enum_names("COPTER_MODE")[vehicle.flying_mode]
            raise Untranslatable(f"the mode is {title}; change the mode to GUIDED first")

    def _fly_mission(
        self, number: int | None, command: int | None, name: str, source: Source, now: float
    ) -> list[Call]:
        """Return the call that flies the stored mission from an item on, or from the current item."""
        if not self._vehicle.granted:
            self._reject_without_control("AUTO", command, source, now)
            return []
        if len(self._missions.mission.items) <= 1:
            if command is not None:
                self._acknowledge(source, command, mavlink.MAV_RESULT_FAILED)
            self.send_text(mavlink.MAV_SEVERITY_WARNING, "Mode change to AUTO failed: there is no mission", now)
            return []
        call = Call(translate.fly_mission(number), name, source, command)
        return [call] if command is None else self._begin(call, now)

    def _reject_without_control(self, mode: str, command: int | None, source: Source, now: float) -> None:
        self.reopen = True
        if command is not None:
            self._acknowledge(source, command, mavlink.MAV_RESULT_TEMPORARILY_REJECTED)
        self.send_text(mavlink.MAV_SEVERITY_WARNING, f"{mode}: {self._vehicle.waiting_reason}", now)

    def _set_current(self, number: int, command: int | None, name: str, source: Source, now: float) -> list[Call]:
        """Set the current item of the mission. In flight in AUTO mode, the mission continues there."""
        mission = self._missions.mission
        first = mission.first_navigating(number)
        if not 0 <= number < len(mission.items) or first is None:
            raise Untranslatable(f"the mission has no item {number} to fly")
        if self._vehicle.in_mission and self._vehicle.armed:
            return self._fly_mission(max(number, 1), command, name, source, now)
        if number == 0 or mission.complete:
            mission.rewind()
        mission.current = first
        if command is not None:
            self._acknowledge(source, command, mavlink.MAV_RESULT_ACCEPTED)
        self._report_current(number)
        return []

    def _transfer(self, message: Message, source: Source, now: float) -> list[Call]:
        """Process a message of the mission protocol. A mission that has arrived completely is judged."""
        missions = self._missions
        missions.update_home()
        missions.transfers.handle(self._channel, message, now)
        if missions.problem:
            self.refusals.append(Refusal(message.name, missions.problem))
            self.send_text(mavlink.MAV_SEVERITY_WARNING, f"Mission: {missions.problem}", now)
            missions.problem = ""
        uploaded = missions.take_uploaded()
        if uploaded is None:
            return []
        return [Call(Request(translate.CHECK_MISSION, uploaded), "Mission", source)]

    def close(self) -> None:
        """End the transfers of the connection."""
        self._missions.transfers.detach(self._channel)

    def report_reached(self, number: int) -> None:
        """Report that an item of the mission is complete."""
        self._channel.send("MISSION_ITEM_REACHED", {"seq": number})

    def report_current(self) -> None:
        """Report the current item of the mission."""
        self._report_current(self._missions.mission.current)

    def _report_current(self, number: int) -> None:
        """Report the state of the mission. Clients wait for the item number that they have set."""
        report = self._missions.mission.report(self._vehicle.mode)
        self._channel.send("MISSION_CURRENT", {**report, "seq": number})

    def _guided_item(self, message: Message, source: Source, now: float) -> list[Call]:
        """Return the call for a MISSION_ITEM with `current` 2 (target) or 3 (altitude)."""
        current = message.integer("current")
        try:
            self._require_guided()
            if message.integer("command") != mavlink.MAV_CMD_NAV_WAYPOINT:
                raise Untranslatable("a guided target must be a NAV_WAYPOINT")
            if current == 2:
                x, y = _coordinates_e7(message)
            else:
                pose = self._vehicle.pose(now)
                if pose is None:
                    raise Untranslatable("the drone's position is not known")
                x, y = round(pose.lat * 1e7), round(pose.lon * 1e7)
            request = translate.place_target(message.integer("frame"), x, y, message.real("z"))
        except Untranslatable:
            self._send_mission_ack(source, mavlink.MAV_MISSION_DENIED)
            raise
        return [Call(request, message.name, source, mission_ack=True)]

    def _set_parameter(self, message: Message, source: Source, now: float) -> list[Call]:
        """Return the call for a write. Report the new value at once, because clients do not wait for a verdict."""
        name = message.text("param_id")
        value = message.real("param_value")
        before = self._parameters.values.get(name, 0.0)
        try:
            request = self._parameters.write(name, value)
        except Untranslatable:
            self._report_parameter(name)
            raise
        if request is not None:
            self._parameters.values[name] = value
        self._report_parameter(name)
        return [] if request is None else [Call(request, f"PARAM_SET {name}", source, parameter=name, before=before)]

    # Results of calls

    def finish(self, call: Call, result: int, text: str, now: float) -> None:
        """Send the result of a call to the program.

        Args:
            call: The call.
            result: MAV_RESULT.
            text: Sentence with the reason of a refusal or a correction; empty for other calls.
            now: Monotonic time in seconds.
        """
        progress = self._in_progress.get(call.key)
        if progress is not None and progress.call is call:
            del self._in_progress[call.key]
        accepted = result == mavlink.MAV_RESULT_ACCEPTED
        self._count(_verdict(accepted, text))
        if call.request.method == translate.CHECK_MISSION:
            self._missions.conclude(call.request.message, "" if accepted else text)
            if not accepted:
                self.refusals.append(Refusal(call.name, text))
        elif call.request.method == translate.FLY_MISSION and accepted and call.request.message is not None:
            self._report_current(call.request.message)
        if call.command is not None:
            self._acknowledge(call.source, call.command, result)
        elif call.mission_ack:
            self._send_mission_ack(
                call.source, mavlink.MAV_MISSION_ACCEPTED if accepted else mavlink.MAV_MISSION_DENIED
            )
        elif call.parameter and not accepted:
            self._parameters.values[call.parameter] = call.before
            self._report_parameter(call.parameter)
        if text and accepted:
            self.send_text(mavlink.MAV_SEVERITY_NOTICE, text, now)
        elif text and not call.is_setpoint and not call.parameter:
            self.send_text(mavlink.MAV_SEVERITY_WARNING, f"{call.name}: {text}", now)
        elif text:
            self._refuse(call.name, text, now, audited=False)

    # Output

    def step(self, now: float) -> None:
        """Send the messages that are due."""
        for progress in self._in_progress.values():
            if progress.call.request.method == "Arm" and now >= progress.report_due_s:
                progress.report_due_s = now + IN_PROGRESS_S
                self._acknowledge(progress.call.source, progress.call.command or 0, mavlink.MAV_RESULT_IN_PROGRESS)
        self._missions.transfers.step(now)
        connected = self._vehicle.connected(now)
        for name in self._channel.due(now):
            if name == "HEARTBEAT":
                if connected:
                    self._channel.send(name, self._vehicle.heartbeat())
            elif name == "MISSION_CURRENT":
                self.report_current()
            elif self._vehicle.received_at.get(name, -math.inf) > self._sent_at.get(name, -math.inf):
                self._send_latest(name)
        parameters = self._channel.parameters
        if self._list_requested and self._parameters.loaded:
            self._list_requested = False
            parameters.clear()
            parameters.extend(range(len(self._parameters.values)))
        for _ in range(min(PARAMETERS_PER_TICK, len(parameters))):
            index = parameters.popleft()
            if index < len(self._parameters.values):
                self._channel.send("PARAM_VALUE", self._parameters.report(index))

    def take(self) -> bytes:
        """Remove and return the bytes for the program."""
        return self._channel.take()

    def take_refusals(self) -> list[Refusal]:
        """Remove and return the refusals for the audit log."""
        refusals = self.refusals
        self.refusals = []
        return refusals

    def deliver_text(self, message: Message) -> None:
        """Send a STATUSTEXT of the vehicle."""
        self._channel.send(message.name, message.values)

    def send_text(self, severity: int, sentence: str, now: float) -> None:
        """Send a sentence as STATUSTEXTs of 50 bytes each. Texts above the limit are dropped."""
        self._texts = min(self._texts + min(now - self._texts_at, MAX_TEXTS) * TEXTS_PER_S, MAX_TEXTS)
        self._texts_at = now
        if self._texts < 1.0:
            return
        self._texts -= 1.0
        self._text_id = self._text_id % 0xFFFF + 1
        data = sentence.encode("ascii", "replace")
        for number, begin in enumerate(range(0, max(len(data), 1), TEXT_BYTES)):
            chunk = data[begin : begin + TEXT_BYTES]
            self._channel.send(
                "STATUSTEXT", {"severity": severity, "text": chunk, "id": self._text_id, "chunk_seq": number}
            )

    def _refuse(self, name: str, reason: str, now: float, *, audited: bool = True) -> None:
        """Report a refused message, at most once in `TEXT_INTERVAL_S` for each name. Unknown commands share a name."""
        self._decision = "refuse"
        kind = "unknown command" if name.isdecimal() else name
        if now - self._text_at.get(kind, -math.inf) < TEXT_INTERVAL_S:
            return
        self._text_at[kind] = now
        if audited:
            self.refusals.append(Refusal(name, reason))
        self.send_text(mavlink.MAV_SEVERITY_WARNING, f"{name}: {reason}", now)

    def _acknowledge(self, source: Source, command: int, result: int) -> None:
        values: dict[str, Value] = {"command": command & 0xFFFF, "result": int(result)}
        self._channel.send("COMMAND_ACK", values | {"target_system": source[0], "target_component": source[1]})

    def _send_mission_ack(self, source: Source, result: int, mission_type: int = 0) -> None:
        values: dict[str, Value] = {"type": int(result), "mission_type": mission_type}
        self._channel.send("MISSION_ACK", values | {"target_system": source[0], "target_component": source[1]})

    def _report_parameter(self, name: str) -> None:
        if name in self._parameters.values:
            self._channel.send("PARAM_VALUE", self._parameters.report(list(self._parameters.values).index(name)))

    def _send_latest(self, name: str) -> bool:
        """Send the latest message of the vehicle with this name. Return False if there is none."""
        message = self._vehicle.latest.get(name)
        if message is None or DECISIONS.sent[name] != "deliver":
            return False
        self._sent_at[name] = self._vehicle.received_at[name]
        self._channel.send(name, message.values)
        return True

    # Responses to messages

    def _request_parameters(self, _message: Message, _now: float) -> None:
        self._list_requested = True

    def _read_parameter(self, message: Message, _now: float) -> None:
        index = self._parameters.find(message) if self._parameters.loaded else None
        if index is not None:
            self._channel.send("PARAM_VALUE", self._parameters.report(index))

    def _request_stream(self, message: Message, _now: float) -> None:
        group = message.integer("req_stream_id")
        rate_hz = message.integer("req_message_rate") if message.integer("start_stop") else 0
        for number in ALL_GROUPS if group == mavlink.MAV_DATA_STREAM_ALL else (group,):
            for name in GROUPS.get(number, ("", ()))[1]:
                self._channel.set_default(name, 1.0 / min(rate_hz, MAX_INTERVAL_HZ) if rate_hz > 0 else None)

    def _answer_timesync(self, message: Message, now: float) -> None:
        if message.integer("tc1") == 0:
            self._channel.send("TIMESYNC", {"tc1": int(now * 1e9), "ts1": message.integer("ts1")})

    def _answer_ping(self, message: Message, _now: float) -> None:
        if message.integer("target_system") == 0:
            values = {"time_usec": message.integer("time_usec"), "seq": message.integer("seq")}
            self._channel.send("PING", values | {"target_system": message.sysid, "target_component": message.compid})

    def _answer_log_list(self, _message: Message, _now: float) -> None:
        self._channel.send("LOG_ENTRY", {})

    def _send_version(self, _message: Message, _now: float) -> None:
        self._channel.send("AUTOPILOT_VERSION", {"capabilities": CAPABILITIES, "flight_sw_version": VERSION})

    def _handle_transfer(self, message: Message, now: float) -> None:
        """Process a message of the mission protocol that cannot complete an upload."""
        self._transfer(message, (message.sysid, message.compid), now)

    def _refuse_file_transfer(self, message: Message) -> None:
        """Send a NAK with the error "file not found". Without it, clients repeat their request many times."""
        payload = bytes(int(value) & 0xFF for value in message.array("payload")[:12]).ljust(12, b"\0")
        sequence = int.from_bytes(payload[:2], "little")
        session = payload[2]
        operation = payload[3]
        nak = (sequence + 1 & 0xFFFF).to_bytes(2, "little") + bytes((session, 129, 1, operation, 0, 0, 0, 0, 0, 0, 10))
        address = {"target_system": message.sysid, "target_component": message.compid}
        self._channel.send("FILE_TRANSFER_PROTOCOL", {**address, "payload": tuple(nak.ljust(251, b"\0"))})

    # Responses to commands

    def _set_interval(self, fields: _CommandFields, _now: float) -> int:
        name = _message_name(fields.params[0])
        interval_us = fields.params[1]
        if name is None or not math.isfinite(interval_us) or interval_us < -1.0:
            return mavlink.MAV_RESULT_DENIED
        if interval_us == 0.0:
            self._channel.reset_interval(name)
        else:
            self._channel.set_interval(name, max(interval_us / 1e6, 1.0 / MAX_INTERVAL_HZ) if interval_us > 0 else None)
        return mavlink.MAV_RESULT_ACCEPTED

    def _get_interval(self, fields: _CommandFields, _now: float) -> int:
        name = _message_name(fields.params[0])
        if name is None:
            return mavlink.MAV_RESULT_FAILED
        stream = self._channel.streams.get(name)
        interval_us = -1 if stream is None else round(stream.interval_s * 1e6)
        self._channel.send("MESSAGE_INTERVAL", {"message_id": int(fields.params[0]), "interval_us": interval_us})
        return mavlink.MAV_RESULT_ACCEPTED

    def _request_message(self, fields: _CommandFields, _now: float) -> int:
        name = _message_name(fields.params[0])
        if name == "HEARTBEAT":
            self._channel.send(name, self._vehicle.heartbeat())
        elif name == "MISSION_CURRENT":
            self.report_current()
        elif name == "AUTOPILOT_VERSION":
            self._channel.send(name, {"capabilities": CAPABILITIES, "flight_sw_version": VERSION})
        elif name is None or not self._send_latest(name):
            return mavlink.MAV_RESULT_FAILED
        return mavlink.MAV_RESULT_ACCEPTED

    def _request_capabilities(self, fields: _CommandFields, _now: float) -> int:
        if fields.params[0] != 1.0:
            return mavlink.MAV_RESULT_FAILED
        self._channel.send("AUTOPILOT_VERSION", {"capabilities": CAPABILITIES, "flight_sw_version": VERSION})
        return mavlink.MAV_RESULT_ACCEPTED

    def _enable_fence(self, fields: _CommandFields, _now: float) -> int:
        if fields.params[0] not in {0.0, 1.0}:
            return mavlink.MAV_RESULT_FAILED
        enabled = self._missions.enable_fence(fields.params[0] == 1.0)
        return mavlink.MAV_RESULT_ACCEPTED if enabled else mavlink.MAV_RESULT_FAILED

    def _get_home(self, _fields: _CommandFields, _now: float) -> int:
        sent = self._send_latest("HOME_POSITION")
        self._send_latest("GPS_GLOBAL_ORIGIN")
        return mavlink.MAV_RESULT_ACCEPTED if sent else mavlink.MAV_RESULT_FAILED

    # Commands that become calls

    def _take_off(self, fields: _CommandFields, _now: float) -> Request:
        self._require_guided()
        if fields.frame is not None and fields.frame not in RELATIVE_FRAMES:
            raise Untranslatable(
                "the altitude of a takeoff must be relative to home; use MAV_FRAME_GLOBAL_RELATIVE_ALT"
            )
        if not math.isfinite(fields.z):
            raise Untranslatable("the altitude is not a number")
        return Request("Takeoff", mobility_pb2.TakeoffRequest(altitude_m=fields.z), mavlink.COPTER_MODE_GUIDED)

    def _arm(self, fields: _CommandFields, _now: float) -> Request:
        if fields.params[1] in {translate.FORCE_MAGIC, translate.FORCE_ARM_MAGIC}:
            raise Untranslatable("programs may not arm or disarm by force")
        if fields.params[0] not in {0.0, 1.0}:
            raise Untranslatable("the first parameter must be 1 (arm) or 0 (disarm)")
        if fields.params[0] and self._vehicle.in_mission:
            raise Untranslatable("AUTO mode is not armable; arm in GUIDED mode", mavlink.MAV_RESULT_FAILED)
        if fields.params[0]:
            return Request("Arm", mobility_pb2.ArmRequest())
        return Request("Disarm", mobility_pb2.DisarmRequest())

    def _reposition(self, fields: _CommandFields, _now: float) -> Request:
        flags = fields.params[1]
        if not (math.isfinite(flags) and int(flags) & mavlink.MAV_DO_REPOSITION_FLAGS_CHANGE_MODE):
            self._require_guided()
        if fields.frame is None:
            raise Untranslatable("send DO_REPOSITION as COMMAND_INT, because COMMAND_LONG holds no accurate position")
        request = translate.place_target(fields.frame, int(fields.x), int(fields.y), fields.z)
        if math.isfinite(fields.params[0]) and fields.params[0] > 0.0:
            request.message.speed_mps = fields.params[0]
        return request

    def _change_speed(self, fields: _CommandFields, _now: float) -> Request:
        if fields.params[0] not in {mavlink.SPEED_TYPE_AIRSPEED, mavlink.SPEED_TYPE_GROUNDSPEED}:
            raise Untranslatable("only the ground speed can be changed")
        return translate.set_speed(fields.params[1])

    def _turn(self, fields: _CommandFields, now: float) -> Request:
        self._require_guided()
        angle_deg, _, direction, relative = fields.params
        return translate.turn(angle_deg, direction, relative == 1.0, self._vehicle, now)

    def _pause(self, fields: _CommandFields, name: str, source: Source, now: float) -> list[Call]:
        """Stop at the present position, or continue the mission. A paused mission stays in AUTO mode, as on ArduCopter."""
        if fields.params[0] not in {0.0, 1.0}:
            raise Untranslatable("the first parameter must be 0 (pause) or 1 (continue)")
        if fields.params[0] == 1.0:
            if len(self._missions.mission.items) <= 1:
                raise Untranslatable("there is no mission to continue")
            return self._fly_mission(None, fields.number, name, source, now)
        request = translate.hover()
        if self._vehicle.in_mission:
            request = replace(request, mode=mavlink.COPTER_MODE_AUTO)
        return self._begin(Call(request, name, source, fields.number), now)

    def _start_mission(self, fields: _CommandFields, name: str, source: Source, now: float) -> list[Call]:
        if fields.params[:2] != (0.0, 0.0):
            raise Untranslatable("only the whole mission can be started; the first two parameters must be 0")
        return self._fly_mission(None, fields.number, name, source, now)

    def _set_mission_current(self, fields: _CommandFields, name: str, source: Source, now: float) -> list[Call]:
        number = fields.params[0]
        if not math.isfinite(number):
            raise Untranslatable("the number of the item is not a number")
        if fields.params[1] == 1.0:
            self._missions.mission.rewind()
        return self._set_current(int(number), fields.number, name, source, now)

    def _point_mount(self, fields: _CommandFields, _now: float) -> Request:
        if int(fields.z if math.isfinite(fields.z) else 0) != mavlink.MAV_MOUNT_MODE_MAVLINK_TARGETING:
            raise Untranslatable("only MAV_MOUNT_MODE_MAVLINK_TARGETING is supported")
        return translate.gimbal(fields.params[0], fields.params[2])

    def _point_gimbal(self, fields: _CommandFields, _now: float) -> Request:
        return translate.gimbal(fields.params[0], fields.params[1])


def _addresses_vehicle(message: Message) -> bool:
    """Return True unless the message is addressed to another system or component. 0 is a broadcast."""
    system = message.integer("target_system") if message.has("target_system") else 0
    component = message.integer("target_component") if message.has("target_component") else 0
    return system in {0, 1} and component in {0, mavlink.MAV_COMP_ID_AUTOPILOT1}


def _verdict(accepted: bool, text: str) -> Verdict:
    if not accepted:
        return "deny"
    return "correct" if text else "allow"


def _fields_of(message: Message) -> _CommandFields:
    params = tuple(message.real(f"param{number}") for number in range(1, 5))
    place = ("x", "y", "z") if message.name == "COMMAND_INT" else ("param5", "param6", "param7")
    x, y, z = (message.real(field_name) for field_name in place)
    frame = message.integer("frame") if message.name == "COMMAND_INT" else None
    return _CommandFields(message.integer("command"), (params[0], params[1], params[2], params[3]), x, y, z, frame)


def _coordinates_e7(message: Message) -> tuple[int, int]:
    """Return latitude and longitude of a MISSION_ITEM or MISSION_ITEM_INT in 1e-7 degrees."""
    scale = 1e7 if message.name == "MISSION_ITEM" else 1.0
    lat = message.real("x") * scale
    lon = message.real("y") * scale
    if not (math.isfinite(lat) and math.isfinite(lon)):
        raise Untranslatable("latitude or longitude is not a number")
    return round(lat), round(lon)


def _mode_number(fields: _CommandFields) -> int:
    custom = fields.params[1]
    enabled = math.isfinite(fields.params[0]) and int(fields.params[0]) & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    if not enabled or not math.isfinite(custom):
        raise Untranslatable("the first parameter must contain MAV_MODE_FLAG_CUSTOM_MODE_ENABLED")
    return int(custom)


def _message_name(number: float) -> str | None:
    """Return the name of a message that programs may receive; None for other numbers."""
    if not math.isfinite(number) or number < 0.0:
        return None
    kind = mavlink.mavlink_map.get(int(number))
    if kind is None or DECISIONS.sent[kind.msgname] == "withhold":
        return None
    return str(kind.msgname)


_RESPONSES: Mapping[str, Callable[[Session, Message, float], None]] = {
    "PARAM_REQUEST_LIST": Session._request_parameters,
    "PARAM_REQUEST_READ": Session._read_parameter,
    "REQUEST_DATA_STREAM": Session._request_stream,
    "MISSION_REQUEST_LIST": Session._handle_transfer,
    "MISSION_REQUEST": Session._handle_transfer,
    "MISSION_REQUEST_INT": Session._handle_transfer,
    "MISSION_REQUEST_PARTIAL_LIST": Session._handle_transfer,
    "MISSION_CLEAR_ALL": Session._handle_transfer,
    "MISSION_WRITE_PARTIAL_LIST": Session._handle_transfer,
    "TIMESYNC": Session._answer_timesync,
    "PING": Session._answer_ping,
    "LOG_REQUEST_LIST": Session._answer_log_list,
    "AUTOPILOT_VERSION_REQUEST": Session._send_version,
}

_COMMAND_RESPONSES: Mapping[str, Callable[[Session, _CommandFields, float], int]] = {
    "SET_MESSAGE_INTERVAL": Session._set_interval,
    "GET_MESSAGE_INTERVAL": Session._get_interval,
    "REQUEST_MESSAGE": Session._request_message,
    "REQUEST_AUTOPILOT_CAPABILITIES": Session._request_capabilities,
    "GET_HOME_POSITION": Session._get_home,
    "DO_FENCE_ENABLE": Session._enable_fence,
}

_COMMANDS: Mapping[str, Callable[[Session, _CommandFields, float], Request]] = {
    "NAV_RETURN_TO_LAUNCH": lambda _session, _fields, _now: translate.return_to_launch(),
    "NAV_LAND": lambda _session, _fields, _now: translate.land(),
    "NAV_LOITER_UNLIM": lambda _session, _fields, _now: translate.hover(),
    "NAV_TAKEOFF": Session._take_off,
    "COMPONENT_ARM_DISARM": Session._arm,
    "DO_CHANGE_SPEED": Session._change_speed,
    "CONDITION_YAW": Session._turn,
    "DO_REPOSITION": Session._reposition,
    "DO_MOUNT_CONTROL": Session._point_mount,
    "DO_GIMBAL_MANAGER_PITCHYAW": Session._point_gimbal,
}

_MISSION_COMMANDS: Mapping[str, Callable[[Session, _CommandFields, str, Source, float], list[Call]]] = {
    "DO_PAUSE_CONTINUE": Session._pause,
    "MISSION_START": Session._start_mission,
    "DO_SET_MISSION_CURRENT": Session._set_mission_current,
}

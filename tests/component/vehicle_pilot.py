"""Ground station for tests and benchmarks. It flies a simulated vehicle in the same process, in lockstep."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from fractus_runtime.mavlink_codec import Endpoint, Message, Value
from fractus_vehicle.copter import POSITION_ONLY
from fractus_vehicle.readiness import arming_refusals
from fractus_vehicle.simulation import Craft, Simulation
from pymavlink.dialects.v20 import ardupilotmega as mavlink

HEARTBEAT_INTERVAL_S = 1.0


class PilotTimeoutError(TimeoutError):
    """An expected event did not happen within its simulated time."""


class Pilot:
    """Ground station with a link to one vehicle. Each wait advances the simulation of all vehicles."""

    def __init__(
        self, simulation: Simulation, craft: Craft, sysid: int = 255, compid: int = mavlink.MAV_COMP_ID_MISSIONPLANNER
    ) -> None:
        self.simulation = simulation
        self.craft = craft
        self.channel = craft.open("pilot")
        self.endpoint = Endpoint(sysid, compid, saturate=True)
        self.last: dict[str, Message] = {}
        self.texts: list[str] = []
        self.heartbeats = True
        self._next_heartbeat_s = 0.0

    def send(self, name: str, values: Mapping[str, Value]) -> None:
        """Send a message to the vehicle."""
        self.craft.receive(self.channel, self.endpoint.encode(name, values))

    def read(self) -> list[Message]:
        """Return the messages that the vehicle has sent since the last call."""
        messages = self.endpoint.decode(self.channel.take())
        for message in messages:
            self.last[message.name] = message
            if message.name == "STATUSTEXT":
                self.texts.append(message.text("text"))
        return messages

    def step(self) -> list[Message]:
        """Advance by one control step, and return the received messages. Send a heartbeat once a second."""
        if self.heartbeats and self.simulation.time_s >= self._next_heartbeat_s:
            self._next_heartbeat_s = self.simulation.time_s + HEARTBEAT_INTERVAL_S
            self.send(
                "HEARTBEAT",
                {"type": mavlink.MAV_TYPE_GCS, "autopilot": mavlink.MAV_AUTOPILOT_INVALID, "mavlink_version": 3},
            )
        self.simulation.step()
        return self.read()

    def wait(self, condition: Callable[[], bool], timeout_s: float) -> float:
        """Advance until a condition holds and return the elapsed simulated seconds.

        Raises:
            PilotTimeoutError: The condition did not hold within `timeout_s`.
        """
        begun = self.simulation.time_s
        while not condition():
            if self.simulation.time_s - begun > timeout_s:
                raise PilotTimeoutError(f"not within {timeout_s} s; last texts: {self.texts[-5:]}")
            self.step()
        return self.simulation.time_s - begun

    def fly_on(self, duration_s: float) -> None:
        """Advance the simulation by a duration."""
        end = self.simulation.time_s + duration_s
        while self.simulation.time_s < end:
            self.step()

    def expect(self, name: str, timeout_s: float = 2.0) -> Message:
        """Advance until a message of that name arrives and return it.

        Raises:
            PilotTimeoutError: No message arrived within `timeout_s`.
        """
        end = self.simulation.time_s + timeout_s
        matching = [message for message in self.read() if message.name == name]
        while not matching:
            if self.simulation.time_s > end:
                raise PilotTimeoutError(f"no {name} within {timeout_s} s")
            matching = [message for message in self.step() if message.name == name]
        return matching[-1]

    def command(self, command: int, *params: float) -> int:
        """Send COMMAND_LONG and return the result."""
        values: dict[str, Value] = {f"param{at}": float(value) for at, value in enumerate(params, start=1)}
        target: dict[str, Value] = {"target_system": self.craft.config.sysid, "target_component": 1}
        self.send("COMMAND_LONG", values | target | {"command": command})
        return self.expect("COMMAND_ACK").integer("result")

    def command_int(self, command: int, values: Mapping[str, Value]) -> int:
        """Send COMMAND_INT and return the result."""
        target: dict[str, Value] = {"target_system": self.craft.config.sysid, "target_component": 1}
        self.send("COMMAND_INT", dict(values) | target | {"command": command})
        return self.expect("COMMAND_ACK").integer("result")

    def mode(self, mode: int) -> int:
        """Request a mode."""
        return self.command(mavlink.MAV_CMD_DO_SET_MODE, mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, mode)

    def parameter(self, name: str, value: float) -> float:
        """Set a parameter and return the value the vehicle reports."""
        self.send(
            "PARAM_SET",
            {
                "target_system": self.craft.config.sysid,
                "target_component": 1,
                "param_id": name.encode("ascii"),
                "param_value": value,
                "param_type": mavlink.MAV_PARAM_TYPE_REAL32,
            },
        )
        while True:
            response = self.expect("PARAM_VALUE")
            if response.text("param_id") == name:
                return response.real("param_value")

    def take_off(self, altitude_m: float, timeout_s: float = 90.0) -> float:
        """Switch to GUIDED, arm and climb. Return the seconds from the takeoff command to 95 % of the altitude.

        Raises:
            PilotTimeoutError: A step was refused or took too long.
        """
        v = self.craft.vehicle.state
        if self.mode(mavlink.COPTER_MODE_GUIDED) != mavlink.MAV_RESULT_ACCEPTED:
            raise PilotTimeoutError("GUIDED was refused")
        self.wait(lambda: not arming_refusals(v), timeout_s)
        if self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) != mavlink.MAV_RESULT_ACCEPTED:
            raise PilotTimeoutError(f"arming was refused: {self.texts[-1:]}")
        if self.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, altitude_m) != mavlink.MAV_RESULT_ACCEPTED:
            raise PilotTimeoutError("takeoff was refused")
        return self.wait(lambda: v.altitude_m > 0.95 * altitude_m, timeout_s)

    def go_to(self, north_m: float, east_m: float, altitude_m: float) -> None:
        """Send a position target in the local frame."""
        self.send(
            "SET_POSITION_TARGET_LOCAL_NED",
            {
                "target_system": self.craft.config.sysid,
                "target_component": 1,
                "coordinate_frame": mavlink.MAV_FRAME_LOCAL_NED,
                "type_mask": POSITION_ONLY,
                "x": north_m,
                "y": east_m,
                "z": -altitude_m,
            },
        )

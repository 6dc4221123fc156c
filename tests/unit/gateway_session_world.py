"""A session of the gateway without I/O: a program that has control of a flying drone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fractus_runtime.mavlink_codec import Endpoint, Message, Parser
from fractus_services.gateway.missions import MissionLists
from fractus_services.gateway.parameters import ParameterView
from fractus_services.gateway.session import Call, Session
from fractus_services.gateway.virtual_vehicle import VirtualVehicle
from pymavlink.dialects.v20 import ardupilotmega as mavlink

HOME = (39.36, 22.95, 10.0)
ARMED = mavlink.MAV_MODE_FLAG_SAFETY_ARMED


class World:
    """A session of a program that has control of a flying drone 20 m above home, with its nose to the east."""

    def __init__(self, *, granted: bool = True, file: Path | None = None) -> None:
        self.vehicle = VirtualVehicle(granted=granted)
        self.parameters = ParameterView()
        self.parameters.replace({"WPNAV_SPEED": 1000.0, "RTL_ALT": 1500.0, "FS_GCS_ENABLE": 1.0})
        self.missions = MissionLists(self.vehicle, file)
        self.verdicts: list[str] = []
        self.session = Session(self.vehicle, self.parameters, self.missions, count=self.verdicts.append)
        self.program = Endpoint(255, 190)
        self.now = 100.0
        self._parser = Parser()
        self._drone = Endpoint(1, 1)
        place = {"latitude": round(HOME[0] * 1e7), "longitude": round(HOME[1] * 1e7), "altitude": 10_000}
        self.report("HEARTBEAT", base_mode=ARMED, custom_mode=mavlink.COPTER_MODE_GUIDED, autopilot=3, type=2)
        self.report("GPS_GLOBAL_ORIGIN", **place)
        self.report("HOME_POSITION", **place)
        self.report(
            "GLOBAL_POSITION_INT",
            lat=place["latitude"],
            lon=place["longitude"],
            alt=30_000,
            relative_alt=20_000,
            hdg=9_000,
        )
        self.sent()

    def report(self, name: str, **values: Any) -> None:
        """Process a message of the real vehicle."""
        for message in self._parser.feed(self._drone.encode(name, values)):
            self.vehicle.take(message, self.now)

    def send(self, name: str, **values: Any) -> list[Call]:
        """Send a message of the program, and return the calls."""
        return self.session.receive(self.program.encode(name, values), self.now)

    def command(self, number: int, *params: float) -> list[Call]:
        """Send a COMMAND_LONG."""
        values = {f"param{at}": value for at, value in enumerate(params, 1)}
        return self.send("COMMAND_LONG", command=number, target_system=1, target_component=1, **values)

    def sent(self) -> list[Message]:
        """Return the messages for the program."""
        self.session.step(self.now)
        return Parser().feed(self.session.take())

    def results(self) -> list[tuple[int, int]]:
        """Return command and result of each COMMAND_ACK."""
        return [(m.integer("command"), m.integer("result")) for m in self.sent() if m.name == "COMMAND_ACK"]

    def texts(self) -> str:
        """Return the STATUSTEXTs, joined."""
        return "".join(m.text("text") for m in self.sent() if m.name == "STATUSTEXT")

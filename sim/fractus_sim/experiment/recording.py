"""Writes down what vehicles say: samples for checks and pictures, and an MCAP file for Foxglove and the like."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fractus_mavlink import Message
from mcap.writer import Writer

from fractus_sim.experiment.station import Station
from fractus_sim.report.track import Place, Sample, Track

_NUMBER = {"type": "number"}
_TEXT = {"type": "string"}
_TIME = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}


def _schema(name: str, /, **properties: Mapping[str, Any]) -> tuple[str, bytes]:
    return name, json.dumps({"title": name, "type": "object", "properties": properties}).encode()


_SCHEMAS = {
    "location": _schema(
        "foxglove.LocationFix", timestamp=_TIME, frame_id=_TEXT, latitude=_NUMBER, longitude=_NUMBER, altitude=_NUMBER,
        position_covariance={"type": "array", "items": _NUMBER}, position_covariance_type={"type": "integer"},
    ),
    "state": _schema(
        "fractus.VehicleState", time_s=_NUMBER, mode=_TEXT, armed={"type": "boolean"}, in_air={"type": "boolean"},
        altitude_m=_NUMBER, speed_mps=_NUMBER, climb_mps=_NUMBER, heading_deg=_NUMBER, battery_percent=_NUMBER,
        voltage_v=_NUMBER, current_a=_NUMBER, satellites={"type": "integer"}, fix={"type": "integer"},
    ),
    "attitude": _schema("fractus.Attitude", time_s=_NUMBER, roll_rad=_NUMBER, pitch_rad=_NUMBER, yaw_rad=_NUMBER),
    "text": _schema(
        "foxglove.Log", timestamp=_TIME, level={"type": "integer"}, message=_TEXT, name=_TEXT, file=_TEXT,
        line={"type": "integer"},
    ),
    "event": _schema("fractus.Event", time_s=_NUMBER, text=_TEXT),
}  # fmt: skip
# MAV_SEVERITY to foxglove.Log levels: debug 1, info 2, warning 3, error 4, fatal 5.
_LEVELS = (5, 5, 5, 4, 3, 2, 2, 1)


class McapLog:
    """One MCAP file with a channel for each topic."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self._writer = Writer(self._file)
        self._writer.start(profile="", library="fractus")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def write(self, topic: str, kind: str, unix_us: int, content: Mapping[str, Any]) -> None:
        """Append one message."""
        if kind not in self._schemas:
            name, data = _SCHEMAS[kind]
            self._schemas[kind] = self._writer.register_schema(name=name, encoding="jsonschema", data=data)
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(
                topic=topic, message_encoding="json", schema_id=self._schemas[kind]
            )
        stamp_ns = unix_us * 1000
        data = json.dumps(content, separators=(",", ":")).encode()
        self._writer.add_message(self._channels[topic], log_time=stamp_ns, data=data, publish_time=stamp_ns)

    def close(self) -> None:
        """Write the index and close the file."""
        self._writer.finish()  # type: ignore[no-untyped-call]  # the package has no types
        self._file.close()


@dataclass(frozen=True, slots=True)
class Text:
    """A STATUSTEXT."""

    time_s: float
    severity: int
    text: str


@dataclass
class Flight:
    """What was seen of one vehicle; seconds of the experiment.

    Attributes:
        armed_at_end: whether its motors were on when it was last heard.
        task: how its task ended: empty while it goes on, `done`, or why not.
    """

    name: str
    samples: list[Sample] = field(default_factory=list)
    texts: list[Text] = field(default_factory=list)
    modes: list[tuple[float, str]] = field(default_factory=list)
    armed_at_end: bool = False
    task: str = ""

    @property
    def track(self) -> Track:
        """The flight as pictures and pages take it."""
        return Track(self.name, tuple(self.samples))


class Recorder:
    """Takes down what one vehicle says to its observer."""

    def __init__(self, flight: Flight, log: McapLog) -> None:
        self.flight = flight
        self._log = log
        self._topic = f"/{flight.name}"

    def take(self, station: Station, messages: list[Message], now_s: float, unix_us: int) -> None:
        """Write down messages, in order."""
        state, flight = station.state, self.flight
        for message in messages:
            if message.name == "GLOBAL_POSITION_INT" and (state.lat or state.lon):
                place = Place(state.lat, state.lon, state.alt_m)
                flight.samples.append(
                    Sample(now_s, place, state.speed_mps, state.mode, state.flying, state.battery, state.voltage_v)
                )
                self._position(station, now_s, unix_us)
            elif message.name == "ATTITUDE":
                angles = {f"{axis}_rad": round(message.real(axis), 5) for axis in ("roll", "pitch", "yaw")}
                self._log.write(f"{self._topic}/attitude", "attitude", unix_us, {"time_s": round(now_s, 3), **angles})
            elif message.name == "STATUSTEXT":
                text = Text(now_s, message.integer("severity"), message.text("text"))
                flight.texts.append(text)
                self._text(text, unix_us)
            elif message.name == "HEARTBEAT":
                flight.armed_at_end = state.armed
                if not flight.modes or flight.modes[-1][1] != state.mode:
                    flight.modes.append((now_s, state.mode))

    def _position(self, station: Station, now_s: float, unix_us: int) -> None:
        state = station.state
        location = {
            "timestamp": _stamp(unix_us), "frame_id": self.flight.name, "latitude": state.lat, "longitude": state.lon,
            "altitude": state.amsl_m, "position_covariance": [0.0] * 9, "position_covariance_type": 0,
        }  # fmt: skip
        self._log.write(f"{self._topic}/location", "location", unix_us, location)
        content = {
            "time_s": round(now_s, 3), "mode": state.mode, "armed": state.armed, "in_air": state.flying,
            "altitude_m": state.alt_m, "speed_mps": round(state.speed_mps, 3), "climb_mps": state.climb_mps,
            "heading_deg": state.heading_deg, "battery_percent": round(state.battery * 100),
            "voltage_v": state.voltage_v, "current_a": state.current_a, "satellites": state.satellites, "fix": state.fix,
        }  # fmt: skip
        self._log.write(f"{self._topic}/state", "state", unix_us, content)

    def _text(self, text: Text, unix_us: int) -> None:
        content = {
            "timestamp": _stamp(unix_us), "level": _LEVELS[min(text.severity, 7)], "message": text.text,
            "name": self.flight.name, "file": "", "line": 0,
        }  # fmt: skip
        self._log.write(f"{self._topic}/text", "text", unix_us, content)


def _stamp(unix_us: int) -> dict[str, int]:
    return {"sec": unix_us // 1_000_000, "nsec": unix_us % 1_000_000 * 1000}

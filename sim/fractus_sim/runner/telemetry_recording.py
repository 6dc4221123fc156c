"""Recording of vehicle telemetry: samples for checks and figures, and an MCAP file for Foxglove."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from fractus_runtime.mavlink_codec import Message
from fractus_services.recording.messages import Record, location, schema, text
from fractus_services.recording.segment_writer import McapWriter

from fractus_sim.report.track import Place, Sample, Track
from fractus_sim.testbeds.ground_station import Station

_NUMBER = {"type": "number"}
_TEXT = {"type": "string"}
_FLAG = {"type": "boolean"}
_INTEGER = {"type": "integer"}
_SCHEMAS = dict(
    (
        schema(
            "fractus.VehicleState", time_s=_NUMBER, mode=_TEXT, armed=_FLAG, in_air=_FLAG, altitude_m=_NUMBER,
            speed_mps=_NUMBER, climb_mps=_NUMBER, heading_deg=_NUMBER, battery_percent=_NUMBER, voltage_v=_NUMBER,
            current_a=_NUMBER, satellites=_INTEGER, fix=_INTEGER,
        ),
        schema("fractus.Attitude", time_s=_NUMBER, roll_rad=_NUMBER, pitch_rad=_NUMBER, yaw_rad=_NUMBER),
        schema("fractus.Event", time_s=_NUMBER, text=_TEXT),
    )
)  # fmt: skip
_FOXGLOVE_LEVELS = (5, 5, 5, 4, 3, 2, 2, 1)
"""Level of foxglove.Log by MAV_SEVERITY: debug 1, info 2, warning 3, error 4, fatal 5."""


class McapLog(McapWriter):
    """The MCAP file of an experiment."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        super().__init__(self._file, _SCHEMAS)

    def close(self) -> None:
        """Write the index and close the file."""
        super().close()
        self._file.close()


@dataclass(frozen=True, slots=True)
class Text:
    """A STATUSTEXT message."""

    time_s: float
    severity: int
    text: str


@dataclass
class Flight:
    """Recording of one vehicle. Times are seconds of the experiment.

    Attributes:
        armed_at_end: True if the vehicle was armed in its last message.
        task: Result of the task: empty while it runs, `done`, or the reason of its failure.
    """

    name: str
    samples: list[Sample] = field(default_factory=list)
    texts: list[Text] = field(default_factory=list)
    modes: list[tuple[float, str]] = field(default_factory=list)
    armed_at_end: bool = False
    task: str = ""

    @property
    def track(self) -> Track:
        """The flight as a track for figures and pages."""
        return Track(self.name, tuple(self.samples))


class Recorder:
    """Records the messages of one vehicle."""

    def __init__(self, flight: Flight, log: McapLog) -> None:
        self.flight = flight
        self._log = log

    def record(self, station: Station, messages: list[Message], now_s: float, unix_us: int) -> None:
        """Record messages in order."""
        state = station.state
        flight = self.flight
        for message in messages:
            if message.name == "GLOBAL_POSITION_INT" and (state.lat or state.lon):
                place = Place(state.lat, state.lon, state.alt_m)
                flight.samples.append(
                    Sample(now_s, place, state.speed_mps, state.mode, state.flying, state.battery, state.voltage_v)
                )
                self._record_position(station, now_s, unix_us)
            elif message.name == "ATTITUDE":
                angles = {f"{axis}_rad": round(message.real(axis), 5) for axis in ("roll", "pitch", "yaw")}
                content = {"time_s": round(now_s, 3), **angles}
                self._write(Record("attitude", "fractus.Attitude", unix_us * 1000, content))
            elif message.name == "STATUSTEXT":
                status_text = Text(now_s, message.integer("severity"), message.text("text"))
                flight.texts.append(status_text)
                self._write(
                    text(
                        unix_us * 1000,
                        "text",
                        flight.name,
                        _FOXGLOVE_LEVELS[min(status_text.severity, 7)],
                        status_text.text,
                    )
                )
            elif message.name == "HEARTBEAT":
                flight.armed_at_end = state.armed
                if not flight.modes or flight.modes[-1][1] != state.mode:
                    flight.modes.append((now_s, state.mode))

    def _record_position(self, station: Station, now_s: float, unix_us: int) -> None:
        state = station.state
        time_ns = unix_us * 1000
        self._write(location(time_ns, self.flight.name, state.lat, state.lon, state.amsl_m))
        content = {
            "time_s": round(now_s, 3), "mode": state.mode, "armed": state.armed, "in_air": state.flying,
            "altitude_m": state.alt_m, "speed_mps": round(state.speed_mps, 3), "climb_mps": state.climb_mps,
            "heading_deg": state.heading_deg, "battery_percent": round(state.battery * 100),
            "voltage_v": state.voltage_v, "current_a": state.current_a, "satellites": state.satellites, "fix": state.fix,
        }  # fmt: skip
        self._write(Record("state", "fractus.VehicleState", time_ns, content))

    def _write(self, record: Record) -> None:
        self._log.write(f"/{self.flight.name}/{record.topic}", record.schema, record.time_ns, record.content)

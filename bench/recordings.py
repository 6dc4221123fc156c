"""Cost of recording in the mobility service: processor time and memory of the recorder thread during a flight.

The messages have the rates of a real flight. Only the work of the recorder thread is measured. `service.py` measures
the service without a recording.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

from fractus_runtime.mavlink_codec import Endpoint
from fractus_services.mobility.rpc import server as _server  # noqa: F401  (the service has loaded it already)
from fractus_services.recording.segment_directory import SegmentDirectory
from harness import Report, memory_mb, parser

BEFORE_MB = memory_mb()["resident"]
"""Memory of this process before it imports the recorder. A service without recordings does not import it."""

from fractus_services.recording.mavlink_messages import MavlinkDecoder  # noqa: E402
from fractus_services.recording.recorder import FlightWriter  # noqa: E402

RECEIVED_HZ = {
    "GLOBAL_POSITION_INT": 20, "ATTITUDE": 10, "EXTENDED_SYS_STATE": 5, "SYS_STATUS": 1, "EKF_STATUS_REPORT": 1,
    "GPS_RAW_INT": 2, "HEARTBEAT": 1, "WIND": 1, "TIMESYNC": 10,
}  # fmt: skip
SENT_HZ = {"HEARTBEAT": 1, "TIMESYNC": 10, "SET_POSITION_TARGET_LOCAL_NED": 10}
STATES_HZ = 2
"""Rate of the entries with the state of the drone."""

FIELDS = {
    "HEARTBEAT": {"autopilot": 3, "base_mode": 128},
    "GLOBAL_POSITION_INT": {"lat": 393600000, "lon": 229500000},
}
STATE = {
    "kind": "state", "time": "2026-06-01T12:00:00.000+00:00", "lat": 39.36, "lon": 22.95, "alt": 20.0, "amsl": 30.0,
}  # fmt: skip


def record(writer: FlightWriter, seconds: int) -> None:
    """Record the messages and entries of a flight of some seconds."""
    vehicle = Endpoint(1, 1)
    companion = Endpoint(244, 191)
    for second in range(seconds):
        now_ns = (1_780_000_000 + second) * 1_000_000_000
        for name, rate in RECEIVED_HZ.items():
            for _ in range(rate):
                writer.received(now_ns, vehicle.encode(name, FIELDS.get(name, {})))
        for name, rate in SENT_HZ.items():
            for _ in range(rate):
                writer.sent(now_ns, companion.encode(name, {}))
        for _ in range(STATES_HZ):
            writer.entry(now_ns, STATE)
        if second % 3 == 0:
            writer.flush()
        writer.tick()


def main() -> int:
    arguments = parser(__doc__, quick="a flight of 20 s")
    arguments.add_argument("--seconds", type=int, default=120, help="duration of the flight")
    options = arguments.parse_args()
    seconds = 20 if options.quick else options.seconds
    with tempfile.TemporaryDirectory() as directory:
        segments = SegmentDirectory(Path(directory), 500_000_000, reserve_bytes=0)
        writer = FlightWriter(segments, "drone-1", MavlinkDecoder("drone-1"))
        writer.begin()
        begun_s = time.process_time()
        record(writer, seconds)
        writer.close()
        cpu = (time.process_time() - begun_s) / seconds * 100
        rate_kb_s = sum(path.stat().st_size for path in Path(directory).iterdir()) / seconds / 1e3
    report = Report("recordings", options)
    report.add("cpu", cpu)
    report.add("memory", memory_mb()["resident"] - BEFORE_MB)
    report.add("rate", rate_kb_s)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())

"""What recording takes of the mobility service: the work of its thread for some minutes of a flight, counted by the kernel.

The rates are those that the service asks for in flight. The figures are the thread's own: the service's, without a recording, are
in `service.py`.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fractus_runtime.mavlink_codec import Endpoint
    from fractus_services.recording.recorder import FlightWriter

MAX_CPU = 2.0
MAX_MB = 16.0
"""Percent of a core and megabytes that recording may add."""

RATES = {
    "GLOBAL_POSITION_INT": 20, "ATTITUDE": 10, "EXTENDED_SYS_STATE": 5, "SYS_STATUS": 1, "EKF_STATUS_REPORT": 1,
    "GPS_RAW_INT": 2, "HEARTBEAT": 1, "WIND": 1, "TIMESYNC": 10,
}  # fmt: skip
SENT = {"HEARTBEAT": 1, "TIMESYNC": 10, "SET_POSITION_TARGET_LOCAL_NED": 10}
STATES = 2
"""Entries of the flight recorder; the others are messages a second."""


def resident_mb() -> float:
    found = re.search(r"VmRSS:\s+(\d+) kB", Path("/proc/self/status").read_text())
    return int(found[1]) / 1e3 if found else 0.0


GIVEN = {
    "HEARTBEAT": {"autopilot": 3, "base_mode": 128},
    "GLOBAL_POSITION_INT": {"lat": 393600000, "lon": 229500000},
}
STATE = {
    "kind": "state", "time": "2026-06-01T12:00:00.000+00:00", "lat": 39.36, "lon": 22.95, "alt": 20.0, "amsl": 30.0,
}  # fmt: skip


def record(writer: FlightWriter, seconds: int, vehicle: Endpoint, companion: Endpoint) -> None:
    """Give the writer what the service would in a flight."""
    for second in range(seconds):
        now_ns = (1_780_000_000 + second) * 1_000_000_000
        for name, rate in RATES.items():
            for _ in range(rate):
                writer.received(now_ns, vehicle.encode(name, GIVEN.get(name, {})))
        for name, rate in SENT.items():
            for _ in range(rate):
                writer.sent(now_ns, companion.encode(name, {}))
        for _ in range(STATES):
            writer.entry(now_ns, STATE)
        if second % 3 == 0:
            writer.flush()
        writer.tick()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a flight of 20 s")
    parser.add_argument("--seconds", type=int, default=120, help="how long the flight is")
    parser.add_argument("--json", type=Path, help="write the claims to a file")
    options = parser.parse_args()
    seconds = 20 if options.quick else options.seconds
    # What the service has loaded without a recording, so that memory is only what recording adds.
    from fractus_runtime.mavlink_codec import Endpoint  # noqa: PLC0415
    from fractus_services.mobility.rpc import server as _server  # noqa: F401, PLC0415
    from fractus_services.recording.segment_directory import SegmentDirectory  # noqa: PLC0415

    vehicle = Endpoint(1, 1)
    companion = Endpoint(244, 191)
    before_mb = resident_mb()
    from fractus_services.recording.mavlink_messages import MavlinkDecoder  # noqa: PLC0415
    from fractus_services.recording.recorder import FlightWriter  # noqa: PLC0415

    with tempfile.TemporaryDirectory() as directory:
        segments = SegmentDirectory(Path(directory), 500_000_000, reserve_bytes=0)
        writer = FlightWriter(segments, "drone-1", MavlinkDecoder("drone-1"))
        writer.begin()
        begun_s = time.process_time()
        record(writer, seconds, vehicle, companion)
        writer.close()
        cpu = (time.process_time() - begun_s) / seconds * 100
        rate_kb = sum(path.stat().st_size for path in Path(directory).iterdir()) / seconds / 1e3
    more_mb = resident_mb() - before_mb
    print(f"recording adds {cpu:.2f} % of a core and {more_mb:.1f} MB; it writes {rate_kb:.2f} kB/s")
    claims = [
        {
            "name": "CPU that recording adds in flight", "ours": cpu, "theirs": 0.0, "unit": "% of a core",
            "ratio": cpu, "target": MAX_CPU, "holds": cpu <= MAX_CPU,
        },
        {
            "name": "memory that recording adds", "ours": before_mb + more_mb, "theirs": before_mb, "unit": "MB",
            "ratio": more_mb, "target": MAX_MB, "holds": more_mb <= MAX_MB,
        },
    ]  # fmt: skip
    if options.json:
        options.json.write_text(json.dumps({"claims": claims}, indent=1))
    return 0 if all(claim["holds"] for claim in claims) else 1


if __name__ == "__main__":
    sys.exit(main())

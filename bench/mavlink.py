"""Our MAVLink codec beside pymavlink's: what an import costs, and a message out and in.

    uv run python bench/mavlink.py [--quick] [--json FILE]

Imports are measured in fresh interpreters. Times are of one core's processor, the best of several rounds, so that others on
the machine count little.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pymavlink.dialects.v20.ardupilotmega as dialect
from fractus_mavlink import Endpoint

POSITION = {
    "time_boot_ms": 1_234_567, "lat": 482_000_000, "lon": 163_700_000, "alt": 150_000, "relative_alt": 10_000,
    "vx": 100, "vy": -20, "vz": 3, "hdg": 9_000,
}  # fmt: skip
IMPORT = """
import time
def resident_kb():
    return int(next(line for line in open("/proc/self/status") if line.startswith("VmRSS")).split()[1])
before, begun = resident_kb(), time.process_time()
import {module}
print((time.process_time() - begun) * 1e3, (resident_kb() - before) / 1024)
"""


def imported(module: str) -> tuple[float, float]:
    """Milliseconds and megabytes of an import."""
    run = [
        subprocess.run([sys.executable, "-c", IMPORT.format(module=module)], capture_output=True, text=True, check=True)
        for _ in range(3)
    ]
    figures = [tuple(map(float, done.stdout.split())) for done in run]
    return min(time_ms for time_ms, _ in figures), min(memory_mb for _, memory_mb in figures)


def fastest_us(call: Callable[[], object], rounds: int) -> float:
    """Processor time of one call."""
    times = []
    for _ in range(rounds):
        begun = time.process_time()
        for _ in range(10_000):
            call()
        times.append((time.process_time() - begun) * 100.0)
    return min(times)


def main() -> None:
    """Measure and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rounds = 3 if arguments.quick else 10
    endpoint, theirs = Endpoint(1, 1), dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    frame = endpoint.encode("GLOBAL_POSITION_INT", POSITION)
    ours_ms, ours_mb = imported("fractus_mavlink.enums")
    their_ms, their_mb = imported("pymavlink.dialects.v20.ardupilotmega")
    figures = [
        ("import, time", ours_ms, their_ms, "ms", 0.5),
        ("import, memory", ours_mb, their_mb, "MB", 0.2),
        (
            "GLOBAL_POSITION_INT out",
            fastest_us(lambda: endpoint.encode("GLOBAL_POSITION_INT", POSITION), rounds),
            fastest_us(lambda: theirs.global_position_int_encode(*POSITION.values()).pack(theirs), rounds),
            "µs",
            0.8,
        ),
        (
            "GLOBAL_POSITION_INT in",
            fastest_us(lambda: endpoint.decode(frame), rounds),
            fastest_us(lambda: theirs.parse_buffer(frame), rounds),
            "µs",
            0.8,
        ),
    ]
    claims = []
    for name, ours, pymavlink, unit, limit in figures:
        ratio = ours / pymavlink
        holds = ratio <= limit
        print(
            f"{name:<24} {ours:8.1f} {unit:<3} pymavlink {pymavlink:8.1f}  {ratio:5.2f}  {'holds' if holds else 'MISSED'}"
        )
        claims.append(
            {"name": name, "ours": round(ours, 3), "theirs": round(pymavlink, 3), "unit": unit,
             "ratio": round(ratio, 3), "target": f"<= {limit:g}", "holds": holds}
        )  # fmt: skip
    if arguments.json is not None:
        arguments.json.write_text(json.dumps({"claims": claims}, indent=2) + "\n")


if __name__ == "__main__":
    main()

"""What the mobility service takes of a companion computer, against MAVProxy on a link to the same vehicle.

Both run beside each other for the same time, the vehicle stands ready on the ground, and the kernel counts.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fractus_cli.standalone import StandalonePki
from fractus_cluster.ports import free_port

NODE = "bench"
TARGET = 10.0
HOME = "39.36,22.95,10"


@dataclass(frozen=True, slots=True)
class Usage:
    """What a process has used.

    Attributes:
        cpu_s: in user and kernel mode.
        resident_mb: resident memory.
        own_mb: of that, what it shares with no one.
        threads: how many it has.
    """

    cpu_s: float
    resident_mb: float
    own_mb: float
    threads: int


def usage(pid: int) -> Usage:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    memory = dict(re.findall(r"^(\w+):\s+(\d+) kB", Path(f"/proc/{pid}/smaps_rollup").read_text(), re.MULTILINE))
    own = int(memory["Private_Clean"]) + int(memory["Private_Dirty"])
    ticks = os.sysconf("SC_CLK_TCK")
    return Usage((int(fields[11]) + int(fields[12])) / ticks, int(memory["Rss"]) / 1e3, own / 1e3, int(fields[17]))


class Processes:
    """Processes that end with the block."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._running: list[subprocess.Popen[bytes]] = []

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, *_: object) -> None:
        for process in reversed(self._running):
            process.kill()
            process.wait(10)

    def start(self, name: str, *command: str, **environment: str) -> int:
        """Start one; its process id."""
        with (self._folder / f"{name}.log").open("wb") as log:
            process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=log, stderr=log, cwd=self._folder,
                env={**os.environ, **environment},
            )  # fmt: skip
        self._running.append(process)
        return process.pid

    def log(self, name: str) -> str:
        return (self._folder / f"{name}.log").read_text(errors="replace")

    def check(self) -> None:
        """See that all of them run."""
        for process in self._running:
            if process.poll() is not None:
                raise SystemExit(f"{process.args} ended with {process.returncode}")


def wait_for(condition: Any, what: str, timeout_s: float = 60.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline:
            raise SystemExit(f"waited {timeout_s:.0f} s without success for {what}")
        time.sleep(0.2)


def side_by_side(folder: Path, seconds: float, stream_rate: int) -> dict[str, tuple[Usage, Usage, float]]:
    """Usage at the begin and at the end of the same time, of our service and of MAVProxy."""
    ours, theirs = (f"tcp:127.0.0.1:{free_port()}" for _ in range(2))
    pki = StandalonePki.create(folder / "pki")
    (folder / "grants").mkdir()
    program = Path(sys.executable).with_name("mavproxy.py")
    if not program.exists():
        raise SystemExit(f"bench: {program} is missing; install MAVProxy into this environment (pip install MAVProxy)")
    with Processes(folder) as processes:
        processes.start(
            "vehicle", sys.executable, "-m", "fractus_vehicle", "--listen", ours, "--listen", theirs, "--home", HOME
        )
        pids = {
            "mobility service": processes.start(
                "service", sys.executable, "-m", "fractus_services.mobility", "serve", "--node", NODE,
                "--autopilot", ours, "--grants", str(folder / "grants"), "--tls", str(pki.node(NODE)),
                "--state", str(folder / "state"), "--audit", str(folder / "audit.jsonl"),
                "--listen", f"127.0.0.1:{free_port()}", "--description", str(folder / "none.yaml"),
            ),
            "MAVProxy": processes.start(
                "mavproxy", sys.executable, str(program), f"--master={theirs}", "--non-interactive", "--daemon",
                f"--streamrate={stream_rate}", "--state-basedir", str(folder),
                HOME=str(folder), MPLBACKEND="agg",
            ),
        }  # fmt: skip
        wait_for(lambda: "mobility: serving" in processes.log("service"), "the service")
        wait_for(lambda: "failsafes: set" in processes.log("service"), "the service's link")
        wait_for(lambda: "Detected vehicle" in processes.log("mavproxy"), "MAVProxy")
        time.sleep(15.0)
        processes.check()
        before = {name: usage(pid) for name, pid in pids.items()}
        begun = time.monotonic()
        time.sleep(seconds)
        took = time.monotonic() - begun
        processes.check()
        return {name: (before[name], usage(pid), took) for name, pid in pids.items()}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="ten seconds")
    parser.add_argument("--seconds", type=float, default=60.0, help="how long to watch")
    parser.add_argument(
        "--stream-rate", type=int, default=4, help="messages a second that MAVProxy asks for; 4 unless told"
    )
    parser.add_argument("--json", type=Path, help="write the claims to a file")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        found = side_by_side(Path(directory), 10.0 if options.quick else options.seconds, options.stream_rate)
    cpu = {name: (end.cpu_s - begin.cpu_s) / took * 100 for name, (begin, end, took) in found.items()}
    print(f"{'':18} {'CPU':>9} {'resident':>10} {'its own':>10} {'threads':>8}")
    for name, (_, end, _) in found.items():
        print(f"{name:18} {cpu[name]:7.2f} % {end.resident_mb:7.1f} MB {end.own_mb:7.1f} MB {end.threads:8d}")
    ours, theirs = (found[name][1] for name in ("mobility service", "MAVProxy"))
    ratio = cpu["MAVProxy"] / max(cpu["mobility service"], 0.01)
    print(f"MAVProxy takes {ratio:.1f} times the CPU (target {TARGET:.0f}){'' if ratio >= TARGET else '  MISSED'}")
    claims = [
        {
            "name": "idle CPU of the mobility service", "ours": cpu["mobility service"], "theirs": cpu["MAVProxy"],
            "unit": "% of a core", "ratio": ratio, "target": TARGET, "holds": ratio >= TARGET,
        },
        {
            "name": "resident memory of the mobility service", "ours": ours.resident_mb, "theirs": theirs.resident_mb,
            "unit": "MB", "ratio": theirs.resident_mb / ours.resident_mb, "target": 1.0,
            "holds": ours.resident_mb <= theirs.resident_mb,
        },
    ]  # fmt: skip
    if options.json:
        options.json.write_text(json.dumps({"claims": claims}, indent=1))
    return 0 if claims[0]["holds"] else 1


if __name__ == "__main__":
    sys.exit(main())

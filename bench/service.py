"""Processor time and memory of the mobility service, against MAVProxy on a link to the same vehicle.

Both programs run at the same time while the vehicle stands on the ground, ready to arm. Needs MAVProxy
(`uv pip install MAVProxy`).
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

from fractus_cli.standalone import StandalonePki
from fractus_cluster.ports import free_port
from harness import Processes, Report, cpu_s, memory_mb, parser

NODE = "bench"
HOME = "39.36,22.95,10"
SETTLE_S = 15.0


def start_all(processes: Processes, directory: Path, stream_rate: int) -> dict[str, int]:
    """Start the vehicle and both programs, and return the process ids of the programs."""
    links = [f"tcp:127.0.0.1:{free_port()}" for _ in range(2)]
    pki = StandalonePki.create(directory / "pki")
    (directory / "grants").mkdir()
    listen = [word for link in links for word in ("--listen", link)]
    processes.start("vehicle", sys.executable, "-m", "fractus_vehicle", *listen, "--home", HOME)
    service = [
        "serve", "--node", NODE, "--autopilot", links[0], "--grants", directory / "grants", "--tls", pki.node(NODE),
        "--state", directory / "state", "--audit", directory / "audit.jsonl",
        "--listen", f"127.0.0.1:{free_port()}", "--description", directory / "none.yaml",
    ]  # fmt: skip
    mavproxy = [
        Path(sys.executable).with_name("mavproxy.py"), f"--master={links[1]}", "--non-interactive", "--daemon",
        f"--streamrate={stream_rate}", "--state-basedir", directory,
    ]  # fmt: skip
    pids = {
        "service": processes.start("service", sys.executable, "-m", "fractus_services.mobility", *service),
        "mavproxy": processes.start("mavproxy", sys.executable, *mavproxy, HOME=str(directory), MPLBACKEND="agg"),
    }
    processes.wait_for_log("service", "mobility: serving")
    processes.wait_for_log("service", "failsafes: set")
    processes.wait_for_log("mavproxy", "Detected vehicle")
    return pids


def main() -> int:
    arguments = parser(__doc__, quick="watch for 10 s")
    arguments.add_argument("--seconds", type=float, default=60.0, help="duration of the measurement")
    arguments.add_argument("--stream-rate", type=int, default=4, help="messages per second that MAVProxy requests")
    options = arguments.parse_args()
    if not Path(sys.executable).with_name("mavproxy.py").exists():
        raise SystemExit("bench: MAVProxy is missing; install it into this environment (uv pip install MAVProxy)")
    with tempfile.TemporaryDirectory() as name, Processes(Path(name)) as processes:
        pids = start_all(processes, Path(name), options.stream_rate)
        time.sleep(SETTLE_S)
        processes.check()
        before_s = {name: cpu_s(pid) for name, pid in pids.items()}
        begun_s = time.monotonic()
        time.sleep(10.0 if options.quick else options.seconds)
        took_s = time.monotonic() - begun_s
        processes.check()
        cpu = {name: 100 * (cpu_s(pid) - before_s[name]) / took_s for name, pid in pids.items()}
        memory = {name: memory_mb(pid)["resident"] for name, pid in pids.items()}
    report = Report("service", options)
    report.add("cpu", max(cpu["service"], 0.01), cpu["mavproxy"])
    report.add("memory", memory["service"], memory["mavproxy"])
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())

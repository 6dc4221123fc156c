"""A scripted MAVProxy session: parameters, arm, takeoff, guided, mission, fence, return."""

from __future__ import annotations

import re
import subprocess
import sys
import threading
import time
from pathlib import Path

MISSION = """QGC WPL 110
0\t1\t0\t16\t0\t0\t0\t0\t48.2\t16.37\t150\t1
1\t0\t3\t22\t0\t0\t0\t0\t0\t0\t10\t1
2\t0\t3\t16\t0\t0\t0\t0\t48.2001\t16.37\t12\t1
3\t0\t3\t16\t0\t0\t0\t0\t48.2001\t16.3702\t12\t1
"""
CORNERS = ((-0.01, -0.01), (0.01, -0.01), (0.01, 0.01), (-0.01, 0.01))
FENCE = "QGC WPL 110\n" + "".join(
    f"{at}\t0\t0\t5001\t4\t0\t0\t0\t{48.2 + north}\t{16.37 + east}\t0\t1\n" for at, (north, east) in enumerate(CORNERS)
)


class Session:
    """MAVProxy as a process, with its prompt as input and output."""

    def __init__(self, address: str, directory: Path) -> None:
        program = Path(sys.executable).with_name("mavproxy.py")
        arguments = ["--master", address, "--state-basedir", str(directory), "--logfile", str(directory / "mav.tlog")]
        self._process = subprocess.Popen(
            [sys.executable, "-u", str(program), *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self._output = ""
        self._news = threading.Condition()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for character in iter(lambda: self._process.stdout.read(1), ""):  # type: ignore[union-attr]
            sys.stdout.write(character)
            with self._news:
                self._output += character
                self._news.notify_all()

    def wait(self, pattern: str, timeout_s: float = 40.0) -> None:
        """Wait for a pattern in the output since the last command."""
        with self._news:
            if not self._news.wait_for(lambda: re.search(pattern, self._output) is not None, timeout_s):
                raise SystemExit(f"timeout: {pattern}")

    def do(self, command: str, pattern: str, timeout_s: float = 40.0) -> None:
        """Type a command and wait for a pattern in its output."""
        assert self._process.stdin is not None
        with self._news:
            self._output = ""
        self._process.stdin.write(command + "\n")
        self._process.stdin.flush()
        self.wait(pattern, timeout_s)

    def repeat(self, command: str, pattern: str, timeout_s: float = 40.0) -> None:
        """Type a command repeatedly until its output contains the pattern."""
        end = time.monotonic() + timeout_s
        while True:
            try:
                self.do(command, pattern, 0.5)
            except SystemExit:
                if time.monotonic() > end:
                    raise
            else:
                return

    def close(self) -> None:
        """End MAVProxy."""
        self._process.kill()
        self._process.wait(10)


def fly(session: Session, directory: Path) -> None:
    """Type the commands of the flight."""
    session.wait(r"Received \d+ parameters")
    session.do("param show WPNAV_SPEED", r"WPNAV_SPEED +10")
    session.do("param set WPNAV_SPEED 800", "")
    session.repeat("param show WPNAV_SPEED", r"WPNAV_SPEED +800")
    session.do("mode GUIDED", "Mode GUIDED")
    session.do("arm throttle", "ARMED")
    session.do("takeoff 10", "NAV_TAKEOFF: ACCEPTED")
    session.repeat("status GLOBAL_POSITION_INT", r"relative_alt : (9[5-9]|10)\d\d\b")
    session.do("guided 48.2003 16.37 12", "Got COMMAND_ACK: DO_REPOSITION: ACCEPTED")
    session.repeat("status GLOBAL_POSITION_INT", r"lat : 48200(29|30)")
    (directory / "mission.txt").write_text(MISSION)
    session.do(f"wp load {directory / 'mission.txt'}", "MISSION_ACK: TYPE_MISSION: ACCEPTED")
    session.do("wp list", "Saved 4 waypoints")
    session.do("mode AUTO", "Mode AUTO")
    session.wait("Reached command #3")
    (directory / "fence.txt").write_text(FENCE)
    session.do(f"fence load {directory / 'fence.txt'}", "MISSION_ACK: TYPE_FENCE: ACCEPTED")
    session.do("fence enable", "DO_FENCE_ENABLE: ACCEPTED")
    session.do("rtl", "Mode RTL")
    session.wait("DISARMED", 60.0)
    print("DONE")


def main(address: str, directory: Path) -> None:
    """Fly with MAVProxy, and end MAVProxy."""
    session = Session(address, directory)
    try:
        fly(session, directory)
    finally:
        session.close()


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))

"""The simulated vehicle as a process, and a pymavlink client."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

from pymavlink import mavutil

HOME = (48.2, 16.37, 150.0)


@contextlib.contextmanager
def running_vehicle(*arguments: str, links: tuple[str, ...]) -> Iterator[subprocess.Popen[str]]:
    """Run a vehicle until the block ends. Then check that the process exits with 0 on SIGTERM."""
    command = [sys.executable, "-m", "fractus_vehicle", "--home", ",".join(str(part) for part in HOME)]
    for link in links:
        command += ["--listen", link]
    process = subprocess.Popen([*command, *arguments], stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    try:
        line = process.stderr.readline()
        assert "ready for connections" in line, line + process.stderr.read()
        yield process
        assert process.poll() is None, process.stderr.read()
    finally:
        process.terminate()
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            raise
    assert process.returncode == 0, process.stderr.read()


class Client:
    """A pymavlink client. Its timeouts are in real seconds, not in simulated seconds."""

    def __init__(self, address: str, sysid: int = 255, target: int = 1) -> None:
        self.link = mavutil.mavlink_connection(address, source_system=sysid, source_component=190)
        self.target = target
        self.texts: list[str] = []

    def close(self) -> None:
        self.link.close()

    def wait(self, condition: Callable[[Any], bool], timeout_s: float = 20.0) -> Any:
        """Return the first message for which the condition holds. Send heartbeats while waiting."""
        end = time.monotonic() + timeout_s
        while time.monotonic() < end:
            message = self.link.recv_match(blocking=True, timeout=0.2)
            if message is None:
                self.beat()
                continue
            if message.get_type() == "STATUSTEXT":
                self.texts.append(message.text)
            if message.get_type() == "HEARTBEAT":
                self.beat()
            if condition(message):
                return message
        raise TimeoutError(f"last texts: {self.texts[-5:]}")

    def wait_for(self, name: str, timeout_s: float = 10.0) -> Any:
        """Return the next message of a type."""
        return self.wait(lambda message: message.get_type() == name, timeout_s)

    def beat(self) -> None:
        """Send a heartbeat."""
        self.link.mav.heartbeat_send(6, 8, 0, 0, 3)

    def command(self, number: int, *params: float) -> int:
        """Send COMMAND_LONG and return the result."""
        values = [*params, *[0.0] * (7 - len(params))]
        self.link.mav.command_long_send(self.target, 1, number, 0, *values)
        ack = self.wait(lambda message: message.get_type() == "COMMAND_ACK" and message.command == number)
        return int(ack.result)

    def interval(self, message_id: int, rate_hz: float) -> None:
        """Request a stream of a message at a rate in Hz."""
        assert self.command(511, message_id, 1e6 / rate_hz) == 0

    def take_off(self, altitude_m: float) -> None:
        """Arm in GUIDED and climb."""
        assert self.command(176, 1, 4) == 0
        end = time.monotonic() + 20.0
        while self.command(400, 1) != 0:
            assert time.monotonic() < end, self.texts
        assert self.command(22, 0, 0, 0, 0, 0, 0, altitude_m) == 0
        self.interval(33, 10)
        self.wait(lambda m: m.get_type() == "GLOBAL_POSITION_INT" and m.relative_alt > 950 * altitude_m, 30.0)

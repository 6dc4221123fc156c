"""Lockstep mode: another process drives simulated time.

The protocol is line-based over TCP. The driver sends a number of control steps (10 ms each). The simulation receives
pending data on its links, runs the steps, sends its messages, and replies with the number of steps since its start.
Runs with the same seed and input give identical output.
"""

from __future__ import annotations

import socket
from collections.abc import Callable

from fractus_vehicle.links import Hub, LinkError
from fractus_vehicle.simulation import Simulation

MAX_STEPS = 1_000_000
POLL_S = 0.2


class LockstepServer:
    """TCP server that accepts one driver and collects its step requests."""

    def __init__(self, hub: Hub, host: str, port: int) -> None:
        self._hub = hub
        self._driver: socket.socket | None = None
        self._input = b""
        self._requested_steps = 0
        self._listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._listener.bind((host, port))
            self._listener.listen(1)
        except OSError as error:
            self._listener.close()
            raise LinkError(f"lockstep {host}:{port}: {error.strerror or error}") from error
        self._listener.setblocking(False)
        hub.watch(self._listener.fileno(), self._accept)
        hub.add_close(self._close)

    def take(self) -> int:
        """Return the number of steps requested since the last call."""
        steps = self._requested_steps
        self._requested_steps = 0
        return steps

    def answer(self, ticks: int) -> None:
        """Report the number of completed steps to the driver."""
        if self._driver is None:
            return
        try:
            self._driver.sendall(b"%d\n" % ticks)
        except OSError:
            self._drop()

    def _accept(self) -> None:
        try:
            driver, _ = self._listener.accept()
        except (BlockingIOError, ConnectionError):
            return
        self._drop()
        driver.settimeout(1.0)
        self._driver = driver
        self._input = b""
        self._hub.watch(driver.fileno(), self._read)

    def _read(self) -> None:
        if self._driver is None:
            return
        try:
            data = self._driver.recv(4096)
        except OSError:
            data = b""
        if not data:
            self._drop()
            return
        *lines, self._input = (self._input + data).split(b"\n")
        for line in lines:
            if not line.strip().isdigit() or len(line) > 8:
                self._drop()
                return
            self._requested_steps = min(self._requested_steps + int(line), MAX_STEPS)
        if len(self._input) > 16:
            self._drop()

    def _drop(self) -> None:
        if self._driver is not None:
            self._hub.forget(self._driver.fileno())
            self._driver.close()
            self._driver = None

    def _close(self) -> None:
        self._drop()
        self._listener.close()


def run_lockstep(
    simulation: Simulation, hub: Hub, lockstep_server: LockstepServer, stopped: Callable[[], bool]
) -> None:
    """Advance by the requested steps until stopped."""
    while not stopped():
        hub.poll(POLL_S)
        steps = lockstep_server.take()
        if not steps:
            hub.flush()
            continue
        # Poll the links again, because data that the driver sent before its request has arrived by now.
        hub.poll()
        for _ in range(steps):
            simulation.step()
            hub.flush()
        lockstep_server.answer(simulation.ticks)

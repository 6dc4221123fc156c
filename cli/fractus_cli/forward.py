"""`fractus forward`: what a drone's autopilot says, to a ground station that may look and not touch."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

import click

from fractus_cli.tlog_tail import Directory, Folder, Frame, Node, Tail

DEFAULT_TO = "127.0.0.1:14550"
"""Where QGroundControl listens by itself."""

POLL_S = 1.0
"""How often recordings are looked at; the service writes them every 3 s."""

MAX_BEHIND_S = 8.0
"""What is further behind the newest frame is sent at once."""


def _to(_context: click.Context, _option: click.Parameter, text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) <= 65535:
        raise click.BadParameter(f"{text!r} is not HOST:PORT, such as {DEFAULT_TO}")
    return host.removeprefix("[").removesuffix("]"), int(port)


@click.command()
@click.argument("drone", required=False)
@click.option(
    "--recordings",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    metavar="DIRECTORY",
    help="Of a mobility service of this machine, instead of DRONE.",
)
@click.option("--to", callback=_to, default=DEFAULT_TO, show_default=True, metavar="HOST:PORT", help="By UDP.")
@click.option("--context", help="Of the kubeconfig, as kubectl takes it.")
@click.option(
    "--kubeconfig", "config", type=click.Path(exists=True, dir_okay=False), help="Which cluster, as kubectl takes it."
)
def forward(
    *, drone: str | None, recordings: Path | None, to: tuple[str, int], context: str | None, config: str | None
) -> None:
    """Send what the autopilot of DRONE says to a ground station such as QGroundControl.

    It reads what the drone's mobility service records, and is 3 to 5 s behind. Nothing that the ground station sends is
    read, and there is no way from here to the autopilot.
    """
    if (drone is None) == (recordings is None):
        raise click.UsageError("give the name of a drone, or --recordings")
    kubectl = ["kubectl", *(["--context", context] if context else []), *(["--kubeconfig", config] if config else [])]
    directory: Directory = Folder(recordings) if recordings is not None else Node(kubectl, str(drone))
    tail = Tail(directory)
    tail.read()
    with Outlet(*to) as outlet:
        click.echo(f"forward: to {to[0]}:{to[1]} by UDP, read only; drones that stand say nothing")
        Player(tail.read, outlet.send).run()


class Outlet:
    """A socket that sends, and is never read.

    Args:
        host: of the ground station.
        port: where it listens.
    """

    def __init__(self, host: str, port: int) -> None:
        try:
            family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        except socket.gaierror as error:
            raise click.ClickException(f"{host}: {error.strerror}; choose another with --to") from None
        self._socket = socket.socket(family, kind)
        self._socket.connect(address)

    def __enter__(self) -> Outlet:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def send(self, data: bytes) -> None:
        """Send a frame; where no ground station listens at the moment, it is lost."""
        with contextlib.suppress(OSError):
            self._socket.send(data)


class Player:
    """Sends frames as evenly as they were recorded, though they come in bursts.

    Args:
        read: what was recorded since the last call.
        send: takes one frame.
        monotonic_s: a clock.
        pause: waits for some seconds.
    """

    def __init__(
        self,
        read: Callable[[], list[Frame]],
        send: Callable[[bytes], None],
        monotonic_s: Callable[[], float] = time.monotonic,
        pause: Callable[[float], object] = time.sleep,
    ) -> None:
        self._read = read
        self._send = send
        self._now_s = monotonic_s
        self._pause = pause
        self._waiting: deque[Frame] = deque()
        self._problem = ""
        self._lag_s: float | None = None
        """The clock here when a frame is due, less the drone's when it was recorded."""

    def run(self) -> None:
        """Read in a thread, for kubectl takes its time, and send until interrupted."""
        failed: list[Exception] = []

        def feed() -> None:
            try:
                while True:
                    self.look()
                    time.sleep(POLL_S)
            except Exception as error:  # told by the other thread
                failed.append(error)

        threading.Thread(target=feed, daemon=True).start()
        while not failed:
            self.play()
        raise failed[0]

    def look(self) -> None:
        """Take what was recorded; that it cannot be read, be it for a lost link to the cluster, is said once."""
        try:
            self.take(self._read())
        except (click.ClickException, OSError) as error:
            problem = error.message if isinstance(error, click.ClickException) else str(error)
            if problem != self._problem:
                click.echo(f"forward: {problem}; trying again", err=True)
            self._problem = problem
        else:
            self._problem = ""

    def take(self, frames: list[Frame]) -> None:
        """Let frames wait for their moment."""
        self._waiting.extend(frames)

    def play(self) -> None:
        """Send what is due, and wait a little."""
        while self._waiting:
            frame = self._waiting[0]
            now_s = self._now_s()
            behind_s = self._waiting[-1].time_s - frame.time_s
            early_s = frame.time_s + self._lag_s - now_s if self._lag_s is not None else 0.0
            if early_s <= 0 or early_s > MAX_BEHIND_S or behind_s > MAX_BEHIND_S:
                # It came late, is the first, or the drone's clock was set: what follows is as late.
                self._lag_s = now_s - frame.time_s
            elif early_s > 1e-3:
                break
            self._send(self._waiting.popleft().data)
        self._pause(0.02)

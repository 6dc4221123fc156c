"""Follows a vehicle that carries a station, so that the radio knows where it is."""

from __future__ import annotations

import logging
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path

from fractus_agent.redirector.netlink import in_namespace
from fractus_runtime.mavlink_codec import Endpoint, Message
from pymavlink.dialects.v20 import ardupilotmega as mavlink

log = logging.getLogger(__name__)

SYSTEM, COMPONENT = 246, 25
RATE_HZ = 10.0
CONNECT_TIMEOUT_S, READ_TIMEOUT_S = 5.0, 1.0
SILENCE_S = 5.0
ASK_EVERY_S = 5.0
RETRY_S = 1.0

Told = Callable[[float, float, float], None]
"""Takes a position: degrees north and east, metres above mean sea level."""


class Follower:
    """Tells a vehicle's positions, in a thread of its own that ends with the process.

    Args:
        namespace: where its MAVLink server listens.
        address: host and port of that server.
        told: called with each position.
    """

    def __init__(self, namespace: Path, address: tuple[str, int], told: Told) -> None:
        self._namespace = namespace
        self._address = address
        self._told = told
        self._thread = threading.Thread(target=self._run, name="follower", daemon=True)

    def start(self) -> None:
        """Begin to follow; a link that breaks is opened again."""
        self._thread.start()

    def _run(self) -> None:
        said = ""
        while True:
            try:
                with in_namespace(self._namespace, self._connect) as link:
                    said = ""
                    self._follow(link)
            except OSError as error:
                if str(error) != said:
                    said = str(error)
                    log.info("radio: no vehicle (address=%s:%d, error=%s)", *self._address, error)
            time.sleep(RETRY_S)

    def _connect(self) -> socket.socket:
        return socket.create_connection(self._address, timeout=CONNECT_TIMEOUT_S)

    def _follow(self, link: socket.socket) -> None:
        link.settimeout(READ_TIMEOUT_S)
        endpoint = Endpoint(SYSTEM, COMPONENT)
        autopilot: int | None = None
        asked_s, heard_s = 0.0, time.monotonic()
        while time.monotonic() - heard_s < SILENCE_S:
            try:
                data = link.recv(65536)
            except TimeoutError:
                continue
            if not data:
                return
            for message in endpoint.decode(data):
                if message.name == "HEARTBEAT" and message.integer("autopilot") != mavlink.MAV_AUTOPILOT_INVALID:
                    autopilot = message.sysid
                elif message.name == "GLOBAL_POSITION_INT" and message.sysid == autopilot:
                    self._heard(message)
                heard_s = time.monotonic()
            # A restarted autopilot has forgotten what it was asked for.
            if autopilot is not None and time.monotonic() - asked_s > ASK_EVERY_S:
                asked_s = time.monotonic()
                link.sendall(_ask(endpoint, autopilot))

    def _heard(self, message: Message) -> None:
        lat, lon = message.integer("lat"), message.integer("lon")
        if lat or lon:  # zeroes are what an autopilot without a fix says
            self._told(lat / 1e7, lon / 1e7, message.integer("alt") / 1000.0)


def _ask(endpoint: Endpoint, autopilot: int) -> bytes:
    return endpoint.encode(
        "COMMAND_LONG",
        {
            "target_system": autopilot,
            "target_component": 1,
            "command": int(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL),
            "param1": float(mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT),
            "param2": 1e6 / RATE_HZ,
        },
    )


def parse_address(text: str) -> tuple[str, int]:
    """Host and port of `tcp:HOST:PORT`.

    Raises:
        ValueError: it is something else.
    """
    kind, _, rest = text.partition(":")
    host, _, port = rest.rpartition(":")
    if kind != "tcp" or not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise ValueError(f"vehicle {text!r} is not tcp:HOST:PORT")
    return host, int(port)

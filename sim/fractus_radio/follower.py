"""Tracks the position of a vehicle that carries a radio station."""

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

SYSTEM = 246
COMPONENT = 25
RATE_HZ = 10.0
CONNECT_TIMEOUT_S = 5.0
READ_TIMEOUT_S = 1.0
SILENCE_S = 5.0
REQUEST_INTERVAL_S = 5.0
RETRY_S = 1.0

PositionCallback = Callable[[float, float, float], None]
"""Callback for a position: latitude and longitude in degrees, metres above mean sea level."""


class Follower:
    """Reports the positions of a vehicle from a daemon thread.

    Args:
        namespace: Network namespace of the vehicle's MAVLink server.
        address: Host and port of that server.
        on_position: Called with each position.
    """

    def __init__(self, namespace: Path, address: tuple[str, int], on_position: PositionCallback) -> None:
        self._namespace = namespace
        self._address = address
        self._on_position = on_position
        self._thread = threading.Thread(target=self._run, name="follower", daemon=True)

    def start(self) -> None:
        """Start the thread. It reconnects after a connection is lost."""
        self._thread.start()

    def _run(self) -> None:
        last_error = ""
        while True:
            try:
                with in_namespace(self._namespace, self._connect) as link:
                    last_error = ""
                    self._follow(link)
            except OSError as error:
                if str(error) != last_error:
                    last_error = str(error)
                    log.info("radio: cannot connect to vehicle (address=%s:%d error=%s)", *self._address, error)
            time.sleep(RETRY_S)

    def _connect(self) -> socket.socket:
        return socket.create_connection(self._address, timeout=CONNECT_TIMEOUT_S)

    def _follow(self, link: socket.socket) -> None:
        link.settimeout(READ_TIMEOUT_S)
        endpoint = Endpoint(SYSTEM, COMPONENT)
        autopilot: int | None = None
        requested_s = 0.0
        received_s = time.monotonic()
        while time.monotonic() - received_s < SILENCE_S:
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
                    self._handle_position(message)
                received_s = time.monotonic()
            # The request is repeated, because a restart of the autopilot removes it.
            if autopilot is not None and time.monotonic() - requested_s > REQUEST_INTERVAL_S:
                requested_s = time.monotonic()
                link.sendall(_encode_request(endpoint, autopilot))

    def _handle_position(self, message: Message) -> None:
        lat = message.integer("lat")
        lon = message.integer("lon")
        if lat or lon:  # an autopilot without a fix reports zeros
            self._on_position(lat / 1e7, lon / 1e7, message.integer("alt") / 1000.0)


def _encode_request(endpoint: Endpoint, autopilot: int) -> bytes:
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
    """Parse `tcp:HOST:PORT`.

    Raises:
        ValueError: The text has another form.
    """
    kind, _, rest = text.partition(":")
    host, _, port = rest.rpartition(":")
    if kind != "tcp" or not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise ValueError(f"vehicle address {text!r}: expected tcp:HOST:PORT")
    return host, int(port)

"""MAVLink connection to the simulated vehicle of a node: is it armed, and charge its battery."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager

from fractus_agent.redirector.netlink import in_namespace
from fractus_runtime.mavlink_codec import Endpoint, Message
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_cluster.errors import ClusterError
from fractus_cluster.node import Node

_SYSTEM = 245
_TIMEOUT_S = 5.0
_ALL_BATTERIES = 0xFFFF


class VehicleLink:
    """Connection to a vehicle. It sends no heartbeats, so the vehicle's failsafes do not depend on it."""

    def __init__(self, node: str, connection: socket.socket) -> None:
        self._node = node
        self._connection = connection
        self._endpoint = Endpoint(_SYSTEM, mavlink.MAV_COMP_ID_MISSIONPLANNER)
        self._autopilot = 0

    def armed(self) -> bool:
        """Return True if the motors of the vehicle are armed.

        Raises:
            ClusterError: The vehicle sent no heartbeat.
        """
        for message in self._messages("HEARTBEAT"):
            if message.integer("autopilot") != mavlink.MAV_AUTOPILOT_INVALID:
                self._autopilot = message.sysid
                return bool(message.integer("base_mode") & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        raise ClusterError(f"the vehicle of node {self._node} sends no heartbeat; see fractus cluster status")

    def charge(self) -> None:
        """Fill the battery. Call this after `armed`.

        Raises:
            ClusterError: The vehicle did not accept the command.
        """
        command = mavlink.MAV_CMD_BATTERY_RESET
        values = {"target_system": self._autopilot, "command": command, "param1": _ALL_BATTERIES, "param2": 100.0}
        self._connection.sendall(self._endpoint.encode("COMMAND_LONG", values))
        for message in self._messages("COMMAND_ACK"):
            if message.integer("command") == command:
                if message.integer("result") == mavlink.MAV_RESULT_ACCEPTED:
                    return
                break
        raise ClusterError(f"the vehicle of node {self._node} did not charge its battery; repeat the command")

    def _messages(self, name: str) -> Iterator[Message]:
        """Yield the messages of one kind until the timeout."""
        deadline = time.monotonic() + _TIMEOUT_S
        while (left := deadline - time.monotonic()) > 0.0:
            self._connection.settimeout(left)
            try:
                data = self._connection.recv(65536)
            except TimeoutError:
                return
            if not data:
                return
            yield from (message for message in self._endpoint.decode(data) if message.name == name)


@contextmanager
def vehicle_link(node: Node) -> Iterator[VehicleLink]:
    """Connect to the vehicle of a node.

    Raises:
        ClusterError: The node has no vehicle, the vehicle accepts no TCP connections, or the connection failed.
    """
    vehicle = node.spec.vehicle()
    if vehicle is None:
        raise ClusterError(f"node {node.name} has no simulated vehicle; name a drone of the cluster file")
    listen = vehicle[1]
    kind, _, address = listen.partition(":")
    host, _, port = address.rpartition(":")
    if kind != "tcp" or not port.isdigit():
        raise ClusterError(
            f"node {node.name}: its vehicle listens on {listen}; set hardware.vehicle.listen to tcp:HOST:PORT"
        )
    try:
        connection = in_namespace(
            node.wiring.namespace_path(node.name), lambda: socket.create_connection((host, int(port)), _TIMEOUT_S)
        )
    except OSError as error:
        raise ClusterError(
            f"the vehicle of node {node.name} is not reachable ({error.strerror or error}); "
            f"see fractus cluster status, and fractus cluster logs vehicle {node.name}"
        ) from error
    with connection:
        try:
            yield VehicleLink(node.name, connection)
        except OSError as error:
            raise ClusterError(f"the vehicle of node {node.name} closed the connection; repeat the command") from error

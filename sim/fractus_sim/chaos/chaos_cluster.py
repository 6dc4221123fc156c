"""Environment of a chaos run: the embedded cluster with Fractus, and its drone."""

from __future__ import annotations

import json
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

from fractus_cluster.cluster import Cluster
from fractus_cluster.node import Node
from fractus_core.api import Grant
from fractus_core.api.grants import GrantSpec
from fractus_core.policy.decision_types import Home
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_sim.chaos import process_lookup
from fractus_sim.chaos.invariants import Seen
from fractus_sim.errors import ExperimentError
from fractus_sim.testbeds.embedded_cluster import connect_in
from fractus_sim.testbeds.ground_station import OBSERVER_ID, Station, TcpLink
from fractus_sim.testbeds.kube_commands import SYSTEM, Kube, Object

API_TIMEOUT_S = 15.0


@dataclass
class Stage:
    """Targets of faults.

    Attributes:
        drone: Name of the drone's node.
        applied: Set when an Application was applied and the operator begins to reconcile.
    """

    cluster: Cluster
    kube: Kube
    drone: str
    applied: threading.Event = field(default_factory=threading.Event)

    @property
    def node(self) -> Node:
        """Node of the drone."""
        return self.cluster.node(self.drone)

    @property
    def state(self) -> Path:
        """Local directory that is mounted as /var/lib/fractus on the drone's node."""
        return self.node.own_state

    @property
    def control_plane(self) -> Path:
        """Network namespace of the control plane."""
        return self.node.wiring.namespace_path()

    def kubectl(self, *arguments: str, timeout_s: float = API_TIMEOUT_S) -> str:
        """Run kubectl.

        Raises:
            ExperimentError: The command failed or timed out.
        """
        return self.kube.run(f"--request-timeout={timeout_s:.0f}s", *arguments, timeout_s=timeout_s + 5)

    def objects(self, kinds: str, *where: str) -> list[Object]:
        """Return objects of the given kinds.

        Raises:
            ExperimentError: The API server did not respond.
        """
        return list(json.loads(self.kubectl("get", kinds, "-o", "json", *(where or ("-A",))))["items"])

    def system_pod(self, component: str, node: str | None = None) -> Object:
        """Return a running pod of Fractus.

        Raises:
            ExperimentError: No pod is running.
        """
        for pod in self.objects("pods", "-n", SYSTEM, "-l", f"app.kubernetes.io/component={component}"):
            if pod["status"].get("phase") == "Running" and node in {None, pod["spec"].get("nodeName")}:
                return pod
        raise ExperimentError(f"no pod of {component} is running{f' on {node}' if node else ''}")

    def leader(self) -> Object:
        """Return the pod of the leading operator.

        Raises:
            ExperimentError: No operator holds the lease.
        """
        lease = json.loads(self.kubectl("get", "lease", "fractus-operator", "-n", SYSTEM, "-o", "json"))
        name = lease["spec"].get("holderIdentity") or "none"
        return dict(json.loads(self.kubectl("get", "pod", name, "-n", SYSTEM, "-o", "json")))

    def program(self, name: str, node: str | None = None) -> list[int]:
        """Return the processes of a program on a node, or of the control plane."""
        namespace = self.node.wiring.namespace_path(node) if node else self.control_plane
        return process_lookup.of_program(name, namespace)


POLL_S = 0.2
MIN_BATTERY = 0.7
"""Minimum charge of a drone on the ground. Below this, its battery is replaced, because a long run needs several."""
_EVERY_BATTERY = 0xFFFF
_CONNECT_S = 10.0
_JOIN_S = 10.0


class Watch:
    """Observes the vehicle until the end of the context.

    Args:
        namespace: Network namespace of the node.
        port: Port of its vehicle.
        grants: Directory where the agent stores Grants.

    Attributes:
        seen: Telemetry samples in order.
        grants: All Grants observed, by their key in the audit log.
        home: Start position of the vehicle.
        failure: Reason why the connection to the vehicle ended. Empty while connected.
    """

    def __init__(self, namespace: Path, port: int, grants: Path) -> None:
        self.seen: list[Seen] = []
        self.grants: dict[str, GrantSpec] = {}
        self.home: Home | None = None
        self.failure = ""
        self._folder = grants
        self._read: dict[Path, int] = {}
        link = TcpLink(connect_in(namespace, port, _CONNECT_S), "to the vehicle")
        self._station = Station(link, 1, None, own_id=OBSERVER_ID, beats=False)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="watch", daemon=True)

    def __enter__(self) -> Watch:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join(_JOIN_S)
        self._station.close()

    def _watch(self) -> None:
        while not self._over.wait(POLL_S):
            self._read_grants()
            try:
                self._look()
            except ExperimentError as error:
                self.failure = str(error)
                return

    def _look(self) -> None:
        now_s = time.time()
        messages = self._station.poll(time.monotonic(), int(now_s * 1e6))
        state = self._station.state
        if state.heard and not (state.armed or state.flying) and state.battery < MIN_BATTERY:
            self._station.command(mavlink.MAV_CMD_BATTERY_RESET, _EVERY_BATTERY, 100)
        if any(message.name == "GLOBAL_POSITION_INT" for message in messages) and (state.lat or state.lon):
            if self.home is None:
                self.home = Home(state.lat, state.lon, state.amsl_m - state.alt_m)
            self.seen.append(Seen(now_s, state.lat, state.lon, state.flying, state.mode))

    def _read_grants(self) -> None:
        for path in self._folder.glob("*.json"):
            try:
                changed = path.stat().st_mtime_ns
                if self._read.get(path) != changed:
                    spec = Grant.from_body(json.loads(path.read_bytes())).spec
                    self._read[path] = changed
                    self.grants[spec.mission_key] = spec
            except (OSError, ValueError):  # # removed in the meantime
                continue

"""Embedded cluster of chaos runs, with its drone as the target of faults, and the observer of the drone's vehicle."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from fractus_cluster.cluster import Cluster
from fractus_cluster.node import Node
from fractus_cluster.spec import ClusterSpec, DiskHardware, load_spec
from fractus_core.api import Grant
from fractus_core.api.grants import GrantSpec
from fractus_core.policy.decision_types import Home
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_sim.chaos import clock_faults, process_lookup
from fractus_sim.chaos.invariants import TelemetrySample
from fractus_sim.errors import ExperimentError
from fractus_sim.testbeds.embedded_cluster import (
    DEMO_CLUSTER_FILE,
    FractusCluster,
    cluster_errors,
    connect_in,
    install_fractus,
    traffic_example_objects,
)
from fractus_sim.testbeds.ground_station import OBSERVER_ID, Station, TcpLink
from fractus_sim.testbeds.kube_commands import SYSTEM, Kube, Object

CLUSTER = "chaos"
DRONE = "drone-1"
EXAMPLE_IMAGE = "example-traffic-monitoring"
VEHICLE_PORT = 5760
DISK_SIZE = "1Gi"
"""Size of the drone's disk. Recordings use at most half of it and leave 200 MB. Audit logs need a few MB per hour."""

BALLAST = "ballast"
"""File with which a fault fills the disk."""

API_TIMEOUT_S = 15.0
POLL_S = 0.2
MIN_BATTERY = 0.7
"""Charge below which the battery of a drone on the ground is replaced. A long run needs several batteries."""

_ALL_BATTERIES = 0xFFFF
_CONNECT_S = 10.0
_JOIN_S = 10.0


@dataclass
class ChaosTarget:
    """The embedded cluster with Fractus and a drone, as the target of faults.

    Attributes:
        drone: Name of the drone's node.
        applied: Set for a moment after an Application was applied, when the operator begins to reconcile it.
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
        return self.node.fractus_state

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

    def objects(self, kinds: str, *selection: str) -> list[Object]:
        """Return objects of the given kinds.

        Args:
            kinds: Kinds in kubectl notation, comma-separated.
            selection: Options of `kubectl get` that select namespace and labels. Default: all namespaces.

        Raises:
            ExperimentError: The API server did not respond.
        """
        return list(json.loads(self.kubectl("get", kinds, "-o", "json", *(selection or ("-A",))))["items"])

    def system_pod(self, component: str, node: str | None = None) -> Object:
        """Return a running pod of Fractus.

        Raises:
            ExperimentError: No pod is running.
        """
        for pod in self.objects("pods", "-n", SYSTEM, "-l", f"app.kubernetes.io/component={component}"):
            if pod["status"].get("phase") == "Running" and node in {None, pod["spec"].get("nodeName")}:
                return pod
        place = f" on {node}" if node else ""
        raise ExperimentError(f"no pod of {component} is running{place}")

    def leader(self) -> Object:
        """Return the pod of the leading operator.

        Raises:
            ExperimentError: No operator holds the lease.
        """
        lease = json.loads(self.kubectl("get", "lease", "fractus-operator", "-n", SYSTEM, "-o", "json"))
        name = lease["spec"].get("holderIdentity") or "none"
        return dict(json.loads(self.kubectl("get", "pod", name, "-n", SYSTEM, "-o", "json")))

    def program(self, name: str, node: str | None = None) -> list[int]:
        """Return the processes of a program on a node, or in the control plane if no node is given."""
        namespace = self.node.wiring.namespace_path(node) if node else self.control_plane
        return process_lookup.of_program(name, namespace)


def with_disk(spec: ClusterSpec) -> ClusterSpec:
    """Return the cluster specification with a separate disk for the drone."""
    nodes = []
    for node in spec.nodes:
        if node.name == DRONE:
            hardware = node.hardware.model_copy(update={"disk": DiskHardware(size=DISK_SIZE)})
            nodes.append(node.model_copy(update={"hardware": hardware}))
        else:
            nodes.append(node)
    return spec.model_copy(update={"nodes": tuple(nodes)})


@contextmanager
def chaos_cluster(report: Callable[[str], None], *, keep: bool) -> Iterator[ChaosTarget]:
    """Provide a separate cluster with Fractus and a ready drone.

    Args:
        report: Called with progress lines.
        keep: Do not remove the cluster at the end.

    Raises:
        ExperimentError: The cluster or Fractus did not start.
    """
    with cluster_errors():
        spec = with_disk(load_spec(DEMO_CLUSTER_FILE)).model_copy(update={"name": CLUSTER})
        fractus = FractusCluster(spec, report)
    fractus.build_images([EXAMPLE_IMAGE])
    try:
        kube = fractus.start()
        target = ChaosTarget(fractus.cluster, kube, DRONE)
        # A killed run leaves its ballast file.
        (target.state / BALLAST).unlink(missing_ok=True)
        nodes = [node for node in fractus.cluster.nodes if node.spec.node_class != "cloud"]
        with cluster_errors():
            clock_faults.install_library(node.fractus_state for node in nodes)
        install_fractus(kube, traffic_example_objects(), clock_faults.chart_values())
        yield target
    finally:
        if not keep:
            fractus.remove()


class VehicleWatch:
    """Observes the vehicle of the drone until the end of the context.

    The watch records telemetry, reads the Grants on the disk of the node, and replaces a low battery on the ground.

    Attributes:
        samples: Telemetry samples in order.
        grants: All Grants observed, by their key in the audit log.
        home: Start position of the vehicle.
        failure: Reason why the connection to the vehicle ended. Empty while connected.
    """

    def __init__(self, namespace: Path, port: int, grants: Path) -> None:
        """Connect to the vehicle.

        Args:
            namespace: Network namespace of the node.
            port: Port of its vehicle.
            grants: Directory where the agent stores Grants.

        Raises:
            ExperimentError: The vehicle does not accept the connection.
        """
        self.samples: list[TelemetrySample] = []
        self.grants: dict[str, GrantSpec] = {}
        self.home: Home | None = None
        self.failure = ""
        self._grants_folder = grants
        self._grant_versions: dict[Path, int] = {}
        link = TcpLink(connect_in(namespace, port, _CONNECT_S), "to the vehicle")
        self._station = Station(link, 1, None, own_id=OBSERVER_ID, sends_heartbeats=False)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="vehicle-watch", daemon=True)

    def __enter__(self) -> VehicleWatch:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(_JOIN_S)
        self._station.close()

    def _watch(self) -> None:
        while not self._stop.wait(POLL_S):
            self._read_grants()
            try:
                self._poll_vehicle()
            except ExperimentError as error:
                self.failure = str(error)
                return

    def _poll_vehicle(self) -> None:
        now_s = time.time()
        messages = self._station.poll(time.monotonic(), int(now_s * 1e6))
        state = self._station.state
        if state.received and not (state.armed or state.flying) and state.battery < MIN_BATTERY:
            self._station.command(mavlink.MAV_CMD_BATTERY_RESET, _ALL_BATTERIES, 100)
        if any(message.name == "GLOBAL_POSITION_INT" for message in messages) and (state.lat or state.lon):
            if self.home is None:
                self.home = Home(state.lat, state.lon, state.amsl_m - state.alt_m)
            self.samples.append(TelemetrySample(now_s, state.lat, state.lon, state.flying, state.mode))

    def _read_grants(self) -> None:
        for path in self._grants_folder.glob("*.json"):
            # The agent may remove a file during this loop.
            try:
                version = path.stat().st_mtime_ns
                if self._grant_versions.get(path) != version:
                    spec = Grant.from_body(json.loads(path.read_bytes())).spec
                    self._grant_versions[path] = version
                    self.grants[spec.mission_key] = spec
            except (OSError, ValueError):
                continue

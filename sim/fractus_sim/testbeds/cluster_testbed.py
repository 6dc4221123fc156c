"""Experiment mode cluster: Fractus on the embedded Kubernetes cluster, with a simulated vehicle for each drone node."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fractus_cluster.spec import ClusterSpec, NodeSpec, VehicleHardware, load_spec

from fractus_sim.errors import ExperimentError
from fractus_sim.experiment.definition import ClusterPart, Experiment, Program, VehicleSetup
from fractus_sim.testbeds.embedded_cluster import (
    FractusCluster,
    cluster_errors,
    connect_in,
    install_fractus,
    listen_in,
    read_objects,
)
from fractus_sim.testbeds.ground_station import TcpLink
from fractus_sim.testbeds.kube_commands import Kube
from fractus_sim.testbeds.link_tap import LinkTap
from fractus_sim.testbeds.testbed import Moment, Testbed, wind_argument

TICK_S = 0.05
POLL_S = 1.0
CONNECT_S = 10.0
DELETE_TIMEOUT_S = 180.0
BEHIND_TAP_PORT = 5770
"""Port on which the vehicle listens. A link tap listens on the port to which the services connect."""

ENDED = frozenset({"Completed", "Failed", "Invalid"})
MAX_NAME = 30


class ClusterTestbed(Testbed):
    """An embedded cluster with the name of the experiment. It is removed at the end unless it was already running."""

    def __init__(self, experiment: Experiment, folder: Path, base: Path, report: Callable[[str], None]) -> None:
        super().__init__(experiment, folder, base, report)
        if experiment.cluster is None:
            raise ExperimentError("mode cluster needs the field `cluster`")
        self._part: ClusterPart = experiment.cluster
        self._fractus = FractusCluster(_cluster_spec(experiment, base / self._part.file), report)
        self._cluster = self._fractus.cluster
        objects = read_objects(*(base / path for path in self._part.apply))
        self._applications = [body for body in objects if body.get("kind") == "Application"]
        self._environment = [body for body in objects if body.get("kind") != "Application"]
        self._kube: Kube | None = None
        self._watcher = threading.Thread(target=self._watch_phases, name="phases", daemon=True)
        self._stop = threading.Event()
        self._phase: dict[str, str] = {}
        self._began_s = time.monotonic()

    def set_up(self) -> None:
        """Build images, start the cluster, install Fractus, and wait until the drones are ready.

        Raises:
            ExperimentError: A part of the cluster did not start.
        """
        self.at_end(self._take_down)
        self._fractus.build_images(self._part.images)
        self._kube = self._fractus.start()
        with cluster_errors():
            for setup in self.experiment.setups():
                self._attach(setup)
        install_fractus(self._kube, self._environment)
        self._began_s = time.monotonic()

    def tick(self) -> Moment:
        """Sleep for 50 ms."""
        time.sleep(TICK_S)
        return Moment(time.monotonic() - self._began_s, time.time_ns() // 1000)

    def begin(self, program: Program | None = None) -> None:
        """Apply the Applications.

        Raises:
            ExperimentError: The API server rejected an Application.
        """
        self._running_kube().apply(self._applications)
        self._watcher.start()

    @property
    def busy(self) -> bool:
        """True while an Application has not ended."""
        return any(self._phase.get(body["metadata"]["name"]) not in ENDED for body in self._applications)

    def set_link(self, vehicle: str, *, connected: bool) -> None:
        """Cut or restore the uplink of a node. Services and vehicle keep running."""
        node = self._cluster.node(vehicle)
        with cluster_errors():
            if connected:
                node.heal_link()
            else:
                node.cut_link()

    def set_power(self, node: str, *, on: bool) -> None:
        """Power a node on or off. Its vehicle keeps flying."""
        with cluster_errors():
            self._cluster.set_power(node, on=on)

    def collect(self) -> None:
        """Read the audit logs from the disks of the drones."""
        self._stop.set()
        for setup in self.experiment.setups():
            self.read_audit_logs(setup.name, self._cluster.node(setup.name).fractus_state / "audit")

    def _take_down(self) -> None:
        """Remove the cluster. If it was running before, delete only the applied Applications."""
        self._stop.set()
        self._fractus.remove_if_started()
        if self._fractus.was_running and self._kube is not None:
            self._kube.delete(self._applications, DELETE_TIMEOUT_S)

    def _attach(self, setup: VehicleSetup) -> None:
        """Insert link taps between a vehicle and its clients, and connect the observer."""
        node = self._cluster.node(setup.name)
        namespace = node.wiring.namespace_path(setup.name)
        logs = self.folder / "logs"
        port = _autopilot_port(load_spec(self.base / self._part.file), setup.name)

        def connect() -> Any:
            return connect_in(namespace, BEHIND_TAP_PORT, CONNECT_S)

        self.keep(LinkTap(listen_in(namespace, port), connect, logs / f"{setup.name}.tlog"))
        guest = socket.create_server(("127.0.0.1", 0))
        self.keep(LinkTap(guest, connect, logs / f"{setup.name}-guest.tlog"))
        self.endpoints[setup.name] = f"tcp:127.0.0.1:{guest.getsockname()[1]}"
        self.observe(setup, TcpLink(connect(), f"to the vehicle of {setup.name}"))

    def _watch_phases(self) -> None:
        """Record the phases of the Applications. Failed requests are retried."""
        while not self._stop.wait(POLL_S):
            try:
                applications = self._running_kube().objects("applications")
            except ExperimentError:
                continue
            for body in applications:
                name = body["metadata"]["name"]
                phase = (body.get("status") or {}).get("phase", "")
                if phase and self._phase.get(name) != phase:
                    self._phase[name] = phase
                    self.findings.phases.setdefault(name, []).append(phase)

    def _running_kube(self) -> Kube:
        if self._kube is None:
            raise ExperimentError("the cluster is not running")
        return self._kube


def _cluster_spec(experiment: Experiment, path: Path) -> ClusterSpec:
    """Return the cluster specification with the vehicles of the experiment, which listen on `BEHIND_TAP_PORT`.

    Raises:
        ExperimentError: The file cannot be read, or has no vehicle of this name.
    """
    with cluster_errors():
        spec = load_spec(path)
    flying = {node.name for node in spec.nodes if node.vehicle() is not None}
    setups = {setup.name: setup for setup in experiment.setups()}
    for name in setups:
        if name not in flying:
            raise ExperimentError(f"{path} has no drone {name} with a vehicle; available: {', '.join(sorted(flying))}")
    nodes = [_with_vehicle(node, setups[node.name], experiment) if node.name in setups else node for node in spec.nodes]
    return spec.model_copy(update={"name": experiment.name[:MAX_NAME], "nodes": tuple(nodes)})


def _with_vehicle(node: NodeSpec, setup: VehicleSetup, experiment: Experiment) -> NodeSpec:
    """Return the node with the vehicle of the experiment."""
    vehicle = node.vehicle()
    if vehicle is None:
        return node
    home, _, arguments = vehicle
    entry = setup.entry
    options = [
        "--seed", str(experiment.seed), "--sysid", str(setup.system_id), "--ready-after", f"{entry.ready_after:g}", "--throttle", "1500",
        "--wind", wind_argument(experiment),
    ]  # fmt: skip
    for name, value in entry.parameters.items():
        options += ["--param", f"{name}={value:.9g}"]
    if entry.home is not None:
        home = type(home)(lat=entry.home.lat, lon=entry.home.lon, alt=entry.home.alt)
    listen = f"tcp:127.0.0.1:{BEHIND_TAP_PORT}"
    update = {"home": home, "listen": listen, "arguments": (*arguments, *options)}
    hardware = (node.hardware.vehicle or VehicleHardware()).model_copy(update=update)
    return node.model_copy(update={"hardware": node.hardware.model_copy(update={"vehicle": hardware})})


def _autopilot_port(spec: ClusterSpec, name: str) -> int:
    """Return the port to which the services of a node connect for the autopilot."""
    node = next(node for node in spec.nodes if node.name == name)
    vehicle = node.vehicle()
    listen = vehicle[1] if vehicle is not None else ""
    kind, _, rest = listen.partition(":")
    if kind != "tcp":
        raise ExperimentError(f"{name}: the vehicle listens on {listen}; experiments need tcp:HOST:PORT")
    return int(rest.rpartition(":")[2])

"""Experiment mode cluster: Fractus on the embedded Kubernetes cluster, with a simulated vehicle for each drone node."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fractus_cluster.cluster import Cluster
from fractus_cluster.errors import ClusterError
from fractus_cluster.images.build import build_images
from fractus_cluster.spec import ClusterSpec, NodeSpec, VehicleHardware, load_spec

from fractus_sim.demo.demo_clusters import ROOT, documents, install_fractus, kube_of
from fractus_sim.errors import ExperimentError
from fractus_sim.experiment.definition import ClusterPart, Experiment, VehicleSetup
from fractus_sim.interruption import uninterrupted
from fractus_sim.report.audit_logs import read_audit
from fractus_sim.testbeds.embedded_cluster import connect_in, listen_in
from fractus_sim.testbeds.ground_station import TcpLink
from fractus_sim.testbeds.kube_commands import Kube
from fractus_sim.testbeds.link_tap import LinkTap
from fractus_sim.testbeds.mission_watch import wait_ready
from fractus_sim.testbeds.testbed import Moment, Testbed

TICK_S = 0.05
POLL_S = 1.0
CONNECT_S = 10.0
DRONE_READY_S = 180.0
BEHIND_TAP_PORT = 5770
OWN_TARGETS = ("operator", "agent", "mobility", "camera")
ENDED = frozenset({"Completed", "Failed", "Invalid"})
MAX_NAME = 30
AUDIT_LOGS = ("mobility.jsonl", "camera.jsonl")


class ClusterTestbed(Testbed):
    """An embedded cluster named after the experiment, removed at the end unless it was already running."""

    def __init__(self, experiment: Experiment, folder: Path, base: Path, tell: Callable[[str], None]) -> None:
        super().__init__(experiment, folder, base, tell)
        if experiment.cluster is None:
            raise ExperimentError("mode cluster needs the field `cluster`")
        self._part: ClusterPart = experiment.cluster
        self._spec = _spec(experiment, base / self._part.file)
        self._cluster = Cluster(self._spec, report=tell)
        self._was_running = self._cluster.running
        self._applications, self._surroundings = _manifests(self._part, base)
        self._kube: Kube | None = None
        self._watcher = threading.Thread(target=self._watch, name="phases", daemon=True)
        self._stop = threading.Event()
        self._phase: dict[str, str] = {}
        self._began_s = time.monotonic()

    def set_up(self) -> None:
        """Build images, start the cluster, install Fractus, and wait until the drones are ready.

        Raises:
            ExperimentError: A part of the cluster did not start.
        """
        self.at_end(self._take_down)
        with _explained():
            images = build_images(ROOT, targets=(*OWN_TARGETS, *self._part.images), report=self.tell)
            self._cluster.up(images=images)
            self._kube = kube_of(self._cluster, self.tell)
            for setup in self.experiment.setups():
                self._attach(setup)
            install_fractus(self._kube)
            self._kube.apply(self._surroundings)
            wait_ready(self._kube, DRONE_READY_S, lambda _line: None)
        self._began_s = time.monotonic()

    def tick(self) -> Moment:
        """Sleep for 50 ms."""
        time.sleep(TICK_S)
        return Moment(time.monotonic() - self._began_s, time.time_ns() // 1000)

    def begin(self) -> None:
        """Apply the Applications.

        Raises:
            ExperimentError: The API server rejected an Application.
        """
        with _explained():
            self._running_kube().apply(self._applications)
        self._watcher.start()

    @property
    def busy(self) -> bool:
        """True while an Application has not ended."""
        return any(self._phase.get(body["metadata"]["name"]) not in ENDED for body in self._applications)

    def cut_link(self, vehicle: str) -> None:
        """Cut the uplink of a node. Services and vehicle keep running."""
        with _explained():
            self._cluster.node(vehicle).cut_link()

    def heal_link(self, vehicle: str) -> None:
        """Restore the uplink of a node."""
        with _explained():
            self._cluster.node(vehicle).heal_link()

    def power_off(self, node: str) -> None:
        """Power off a node. Its vehicle keeps flying."""
        with _explained():
            self._cluster.set_power(node, on=False)

    def power_on(self, node: str) -> None:
        """Power on a node."""
        with _explained():
            self._cluster.set_power(node, on=True)

    def collect(self) -> None:
        """Read the audit logs from the disks of the drones."""
        self._stop.set()
        for setup in self.experiment.setups():
            folder = self._cluster.node(setup.name).own_state / "audit"
            for name in AUDIT_LOGS:
                if (folder / name).exists():
                    read_audit(folder / name, f"{setup.name}/{name}", self.findings)

    def _take_down(self) -> None:
        """Remove the cluster. If it was running before, delete only the applied Applications."""
        self._stop.set()
        with _explained():
            if not self._was_running:
                with uninterrupted():
                    self._cluster.down()
            elif self._kube is not None:
                self._kube.delete(self._applications, DRONE_READY_S)

    def _attach(self, setup: VehicleSetup) -> None:
        """Insert a link tap between the vehicle and its clients, and connect the observer."""
        node = self._cluster.node(setup.name)
        namespace = node.wiring.namespace_path(setup.name)
        logs = self.folder / "logs"
        port = _port(load_spec(self.base / self._part.file), setup.name)

        def connect() -> Any:
            return connect_in(namespace, BEHIND_TAP_PORT, CONNECT_S)

        self.keep(LinkTap(listen_in(namespace, port), connect, logs / f"{setup.name}.tlog"))
        guest = socket.create_server(("127.0.0.1", 0))
        self.keep(LinkTap(guest, connect, logs / f"{setup.name}-guest.tlog"))
        self.endpoints[setup.name] = f"tcp:127.0.0.1:{guest.getsockname()[1]}"
        self.observe(setup, TcpLink(connect(), f"to the vehicle of {setup.name}"))

    def _watch(self) -> None:
        """Record the phases of the Applications. Failed requests are retried."""
        while not self._stop.wait(POLL_S):
            try:
                found = self._running_kube().objects("applications")
            except ExperimentError:
                continue
            for body in found:
                name = body["metadata"]["name"]
                phase = (body.get("status") or {}).get("phase", "")
                if phase and self._phase.get(name) != phase:
                    self._phase[name] = phase
                    self.findings.phases.setdefault(name, []).append(phase)

    def _running_kube(self) -> Kube:
        if self._kube is None:
            raise ExperimentError("the cluster is not running")
        return self._kube


@contextmanager
def _explained() -> Iterator[None]:
    """Convert errors of the cluster to ExperimentError.

    Raises:
        ExperimentError: A part of the cluster failed.
    """
    try:
        yield
    except (ClusterError, ExperimentError) as error:
        raise ExperimentError(str(error)) from None


def _spec(experiment: Experiment, path: Path) -> ClusterSpec:
    """Return the cluster specification with seed, wind and parameters of its vehicles.

    The vehicles listen behind the link tap.

    Raises:
        ExperimentError: The file cannot be read, or has no vehicle of this name.
    """
    with _explained():
        spec = load_spec(path)
    flying = {node.name for node in spec.nodes if node.vehicle() is not None}
    setups = {setup.name: setup for setup in experiment.setups()}
    for name in setups:
        if name not in flying:
            raise ExperimentError(f"{path} has no drone {name} with a vehicle; available: {', '.join(sorted(flying))}")
    nodes = [_prepared(node, setups[node.name], experiment) if node.name in setups else node for node in spec.nodes]
    return spec.model_copy(update={"name": experiment.name[:MAX_NAME], "nodes": tuple(nodes)})


def _prepared(node: NodeSpec, setup: VehicleSetup, experiment: Experiment) -> NodeSpec:
    found = node.vehicle()
    if found is None:
        return node
    home, _, arguments = found
    wind = experiment.wind
    entry = setup.entry
    given = [
        "--seed", str(experiment.seed), "--sysid", str(setup.system_id), "--ready-after", f"{entry.ready_after:g}", "--throttle", "1500",
        "--wind", f"{wind.speed},{wind.direction},{wind.turbulence}",
    ]  # fmt: skip
    for name, value in entry.parameters.items():
        given += ["--param", f"{name}={value:.9g}"]
    if entry.home is not None:
        home = type(home)(lat=entry.home.lat, lon=entry.home.lon, alt=entry.home.alt)
    listen = f"tcp:127.0.0.1:{BEHIND_TAP_PORT}"
    update = {"home": home, "listen": listen, "arguments": (*arguments, *given)}
    vehicle = (node.hardware.vehicle or VehicleHardware()).model_copy(update=update)
    return node.model_copy(update={"hardware": node.hardware.model_copy(update={"vehicle": vehicle})})


def _port(spec: ClusterSpec, name: str) -> int:
    """Return the port where the services of the node connect to the autopilot."""
    node = next(node for node in spec.nodes if node.name == name)
    found = node.vehicle()
    listen = found[1] if found is not None else ""
    kind, _, rest = listen.partition(":")
    if kind != "tcp":
        raise ExperimentError(f"{name}: the vehicle listens on {listen}; experiments need tcp:HOST:PORT")
    return int(rest.rpartition(":")[2])


def _manifests(part: ClusterPart, base: Path) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return the Applications, and all other objects (applied first)."""
    with _explained():
        every: list[Mapping[str, Any]] = [body for path in part.apply for body in documents(base / path)]
    applications = [dict(body) for body in every if body.get("kind") == "Application"]
    return applications, [dict(body) for body in every if body.get("kind") != "Application"]

"""The embedded cluster: start, update to a description, and removal."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from fractus_cluster import machine, network
from fractus_cluster.binaries import chosen_kubernetes, ensure_binaries
from fractus_cluster.cgroups import cluster_branch
from fractus_cluster.commands import run
from fractus_cluster.disk import unmount_below
from fractus_cluster.errors import ClusterError
from fractus_cluster.images.store import ImageStore
from fractus_cluster.locking import locked
from fractus_cluster.node import Node
from fractus_cluster.nodeconfig import shortfalls
from fractus_cluster.pki import Authority
from fractus_cluster.prerequisites import check_prerequisites, check_root
from fractus_cluster.prerequisites import machine as describe_machine
from fractus_cluster.processes import running
from fractus_cluster.radio import Radio
from fractus_cluster.spec import ClusterSpec, load_spec
from fractus_cluster.startup import CONTROL_PLANE, Startup, claim, wiring_of
from fractus_cluster.state import ClusterRecord, StateDirectory, only_cluster, state_of
from fractus_cluster.vehicle_link import vehicle_link

_LOCK_TIMEOUT_S = 300.0
_API_TIMEOUT_S = 120.0
Report = Callable[[str], None]


def silent(_message: str) -> None:
    """Ignore a progress line."""


@dataclass(frozen=True, slots=True)
class NodeStatus:
    """Status of a node.

    Attributes:
        name: Name.
        node_class: drone, edge or cloud.
        address: Address in the cluster network.
        powered: True if the node is running.
        linked: True if its uplink is up.
        ready: Ready condition in the API server. None if the API server is unavailable.
        vehicle_running: True if its vehicle is running. None without vehicle.
        camera_running: True if its simulated camera is running. None without camera.
    """

    name: str
    node_class: str
    address: str
    powered: bool
    linked: bool
    ready: bool | None
    vehicle_running: bool | None
    camera_running: bool | None


class Cluster:
    """An embedded cluster, as specified by a cluster file. The cluster may be running or not."""

    def __init__(self, spec: ClusterSpec, *, report: Report = silent) -> None:
        """Create a cluster object. This does not start the cluster.

        Args:
            spec: Specification of the cluster.
            report: Called with progress lines.
        """
        self.spec = spec
        self._report = report
        self._state: StateDirectory = state_of(spec.name)

    @classmethod
    def load(cls, source: Path | str | ClusterSpec, *, name: str | None = None, report: Report = silent) -> Cluster:
        """Return the cluster of a file.

        Args:
            source: Cluster file or specification.
            name: Overrides the name in the file.
            report: Called with progress lines.

        Raises:
            ClusterError: The file is missing or invalid.
        """
        spec = source if isinstance(source, ClusterSpec) else load_spec(Path(source))
        if name is not None:
            spec = ClusterSpec.model_validate({**spec.model_dump(by_alias=True), "name": name})
        return cls(spec, report=report)

    @classmethod
    def existing(cls, name: str | None = None, *, report: Report = silent) -> Cluster:
        """Return a cluster that was started before.

        Args:
            name: Name. Optional if there is only one cluster.
            report: Called with progress lines.

        Raises:
            ClusterError: No cluster with this name exists.
        """
        chosen = only_cluster() if name is None else name
        spec = state_of(chosen).read_spec()
        if spec is None:
            raise ClusterError(f"no cluster {chosen}; start one: fractus cluster up FILE")
        return cls(spec, report=report)

    @classmethod
    def bare(cls, name: str, *, report: Report = silent) -> Cluster:
        """Return a cluster that only `down` may be called on.

        Its cluster file may be missing after an interrupted start.
        """
        spec = state_of(name).read_spec()
        return cls(spec or ClusterSpec.placeholder(name), report=report)

    @property
    def name(self) -> str:
        """Name of the cluster."""
        return self.spec.name

    @property
    def kubeconfig(self) -> Path:
        """Kubeconfig of the administrator. It exists while the cluster is up."""
        return self._state.kubeconfig

    @property
    def logs(self) -> Path:
        """Folder of logs: `control-plane/PROGRAM.log` and `NODE/PROGRAM.log`."""
        return self._state.logs

    @property
    def nodes(self) -> list[Node]:
        """Nodes of the cluster.

        Raises:
            ClusterError: The cluster was never started, so its nodes have no addresses.
        """
        record = self._record()
        branch = cluster_branch(self.name)
        wiring = self._wiring(record)
        return [
            Node(spec, record.indexes[spec.name], wiring, self._state, branch, self.spec.world_origin)
            for spec in self.spec.nodes
            if spec.name in record.indexes
        ]

    def node(self, name: str) -> Node:
        """Return a node.

        Raises:
            ClusterError: No node with this name exists.
        """
        for node in self.nodes:
            if node.name == name:
                return node
        raise ClusterError(
            f"cluster {self.name} has no node {name}; its nodes: {', '.join(n.name for n in self.spec.nodes)}"
        )

    def up(self, *, images: Sequence[str] = ()) -> None:
        """Start the cluster, or update a running cluster to its specification.

        This also restarts vehicles and cameras whose arguments changed, restarts processes that have ended, powers nodes
        on, and restores links. Nothing changes if the cluster is up to date.

        Args:
            images: Images in buildah's storage to deliver to every node before it starts pods.

        Raises:
            PrerequisiteError: The machine lacks a requirement.
            ClusterError: A part did not start, and the message names its log. Or a vehicle whose arguments changed is
                armed. Nothing is changed in the second case.
        """
        started = time.monotonic()
        check_root()
        if self._state.read_record() is None or machine.holder(self.name) is None:
            check_prerequisites()
        binaries = ensure_binaries(report=self._report)
        for sentence in (text for node in self.spec.nodes for text in shortfalls(node, describe_machine())):
            self._report(f"note: {sentence}")
        with self._locked():
            known = self.check_vehicles()
            record = claim(self.spec, self._state, chosen_kubernetes(), self._report)
            self._state.write_spec(self.spec)
            startup = self._startup(record)
            startup.start_control_plane(binaries)
            nodes = self.nodes
            store = ImageStore.default(report=self._report)
            fetched = store.fetch(images)
            for name in startup.place_nodes(nodes, binaries, store, fetched):
                if name in known:
                    self._report(f"node {name}: its configuration has changed; restarting it")
            self.radio.start(nodes, self.spec.air)
            with startup.api() as api:
                api.wait_ready(_API_TIMEOUT_S)
                startup.apply_objects(api, nodes)
                startup.let_dns_start()
                since = datetime.now(UTC).replace(microsecond=0)
                started_nodes = {node.name for node in nodes if node.power_on()}
                for node in nodes:
                    self._restart_changed_hardware(node)
                    node.start_hardware()
                startup.write_kubeconfig()
                startup.wait_nodes(api, [(node, since if node.name in started_nodes else None) for node in nodes])
            startup.wait_dns()
            startup.check_hardware(nodes)
            store.deliver(fetched, nodes)
        self._report(f"cluster {self.name} is up: {len(nodes)} nodes, {time.monotonic() - started:.1f} s")

    def down(self) -> None:
        """Remove the cluster and all its resources on the machine. Do nothing if it does not exist.

        Raises:
            ClusterError: A resource could not be removed. Fix the cause and call this again.
        """
        check_root()
        with self._locked(remove=True):
            held = machine.holder(self.name)
            if held is not None and held != self._state.path:
                raise ClusterError(f"cluster {self.name} has its state in {held}; set FRACTUS_STATE={held.parent}")
            branch = cluster_branch(self.name)
            branch.kill_all()
            branch.remove()
            network.unwire(self.name)
            unmount_below(self._state.path)
            if self._state.path.exists():
                shutil.rmtree(self._state.path)
            machine.release(self.name)
        machine.remove_directory()
        self._report(f"cluster {self.name} is down")

    def status(self) -> list[NodeStatus]:
        """Return the status of each node."""
        record = self._record()
        cut = network.links_cut(self._wiring(record))
        ready = self._startup(record).ready_nodes()
        return [
            NodeStatus(
                node.name,
                node.spec.node_class,
                str(node.address),
                node.powered,
                node.index not in cut,
                None if ready is None else ready.get(node.name, False),
                node.vehicle_running,
                node.camera_running,
            )
            for node in self.nodes
        ]

    def charge(self, node: str) -> None:
        """Fill the battery of a drone's vehicle at once.

        Raises:
            ClusterError: The node has no vehicle, or its vehicle is armed or does not answer.
        """
        check_root()
        with vehicle_link(self.node(node)) as link:
            if link.armed():
                raise ClusterError(f"{node} is armed; wait until it has landed and disarmed, then charge it")
            link.charge()

    def set_power(self, node: str, *, on: bool) -> None:
        """Power a node on or off. This does not wait until its kubelet is Ready."""
        check_root()
        with self._locked():
            chosen = self.node(node)
            if not on:
                chosen.power_off()
                return
            chosen.power_on()

    @property
    def radio(self) -> Radio:
        """Simulated radio of the nodes."""
        return Radio(self.name, self._state)

    @property
    def running(self) -> bool:
        """True if the programs of the control plane are running."""
        return running(self._state.process(CONTROL_PLANE)) is not None

    def load_images(self, images: Sequence[str]) -> dict[str, int]:
        """Deliver images to all running nodes.

        Args:
            images: Names in buildah's storage, or paths of OCI or Docker archives.

        Returns:
            Number of new images by node.

        Raises:
            ClusterError: An image does not exist, or a node rejected it.
        """
        store = ImageStore.default(report=self._report)
        return store.deliver(store.fetch(images), [node for node in self.nodes if node.powered])

    def kubectl(
        self, *arguments: str, input_text: str | None = None, timeout_s: float = 60.0, check: bool = True
    ) -> subprocess.CompletedProcess[str]:
        """Run kubectl on the cluster and return its output.

        Raises:
            ClusterError: The command failed (with `check`) or timed out.
        """
        program = ensure_binaries(["kubectl"], report=self._report)["kubectl"]
        environment = {**os.environ, "KUBECONFIG": str(self.kubeconfig)}
        return run([program, *arguments], input_text=input_text, timeout_s=timeout_s, check=check, env=environment)

    def check_vehicles(self) -> set[str]:
        """Check that no vehicle must be restarted while it is armed, and return the names of the existing nodes.

        Raises:
            ClusterError: A vehicle is armed or does not answer.
        """
        previous = self._state.read_spec()
        if previous is None or self._state.read_record() is None:
            return set()
        # The running vehicle listens on the address of the previous cluster file.
        running_nodes = {node.name: node for node in Cluster(previous).nodes}
        for node in self.nodes:
            if "vehicle" not in node.changed_hardware():
                continue
            with vehicle_link(running_nodes[node.name]) as link:
                if link.armed():
                    raise ClusterError(
                        f"node {node.name}: its vehicle has changed in the cluster file, and it is armed; "
                        "wait until it has landed and disarmed, then run this command again"
                    )
        return set(running_nodes)

    def _restart_changed_hardware(self, node: Node) -> None:
        for part, arguments in node.changed_hardware().items():
            after = f"restarting it with {arguments}" if arguments else "removing it"
            self._report(f"node {node.name}: its {part} has changed; {after}")
            node.stop_part(part)

    def _locked(self, *, remove: bool = False) -> AbstractContextManager[None]:
        return locked(
            machine.cluster_lock(self.name),
            timeout_s=_LOCK_TIMEOUT_S,
            what=f"another command is changing cluster {self.name}",
            report=self._report,
            remove=remove,
        )

    def _record(self) -> ClusterRecord:
        record = self._state.read_record()
        if record is None:
            raise ClusterError(f"cluster {self.name} is not running; start it: fractus cluster up FILE")
        return record

    def _wiring(self, record: ClusterRecord) -> network.Wiring:
        return wiring_of(self.name, self._state, record)

    def _startup(self, record: ClusterRecord) -> Startup:
        return Startup(self.name, self._state, self._wiring(record), Authority(self._state.pki))


def print_report(message: str) -> None:
    """Write a progress line to standard error."""
    print(message, file=sys.stderr, flush=True)

"""The embedded cluster itself: bringing it up, keeping it as described, taking it down."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from fractus_kube import BlockingClient, Conflict, KubeError

from fractus_cluster import machine, manifests, network
from fractus_cluster.addressing import Addressing
from fractus_cluster.apiclient import administrating, answers_ready, wait_ready
from fractus_cluster.binaries import Binaries, ensure_binaries
from fractus_cluster.cgroups import Branch, cluster_branch
from fractus_cluster.commands import run
from fractus_cluster.controlplane import (
    CONTROL_PLANE_PROGRAMS,
    DNS_READY_PORT,
    ControlPlaneFiles,
    administrator,
    control_plane_units,
    let_dns_start,
    server_url,
    write_control_plane,
)
from fractus_cluster.errors import ClusterError
from fractus_cluster.images.layout import Image
from fractus_cluster.images.store import ImageStore
from fractus_cluster.images.template import has_storage
from fractus_cluster.locking import locked
from fractus_cluster.node import Node, init_command
from fractus_cluster.nodeconfig import shortfalls
from fractus_cluster.pki import Authority, write_private
from fractus_cluster.prerequisites import check_prerequisites, check_root
from fractus_cluster.prerequisites import machine as describe_machine
from fractus_cluster.processes import kill, read_record, spawn, write_record
from fractus_cluster.spec import ClusterSpec, load_spec
from fractus_cluster.state import Memory, StateDirectory, only_cluster, state_of

_LOCK_TIMEOUT_S = 300.0
_API_TIMEOUT_S = 120.0
_READY_TIMEOUT_S = 90.0
_DNS_TIMEOUT_S = 90.0
_POLL_S = 0.1
_CONFLICTS = 5
_CONTROL_PLANE = "control-plane"
_ENVIRONMENT = {
    "PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin",
    "HOME": "/root",
    "LANG": "C.UTF-8",
}

Report = Callable[[str], None]


def silent(_message: str) -> None:
    """Take a line of progress and drop it."""


@dataclass(frozen=True, slots=True)
class NodeStatus:
    """How a node is.

    Attributes:
        name: Its name.
        node_class: drone, edge or cloud.
        address: Its address on the cluster's network.
        powered: Whether it runs.
        linked: Whether its uplink is up.
        ready: What the API server says of it; None when that cannot be asked.
        vehicle_running: Whether its vehicle runs; None when it has none.
        camera_running: Whether its simulated camera runs; None when it has none.
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
    """A cluster described by a file, whether it is up or not."""

    def __init__(self, spec: ClusterSpec, *, report: Report = silent) -> None:
        """Make a handle on a cluster; nothing happens yet.

        Args:
            spec: What it is to be.
            report: Told about progress, a line at a time.
        """
        self.spec = spec
        self._report = report
        self._state: StateDirectory = state_of(spec.name)

    @classmethod
    def load(cls, source: Path | str | ClusterSpec, *, name: str | None = None, report: Report = silent) -> Cluster:
        """Return the cluster of a file.

        Args:
            source: The file, or the cluster it would describe.
            name: Its name instead of the one in the file.
            report: Told about progress, a line at a time.

        Raises:
            ClusterError: The file is missing or wrong.
        """
        spec = source if isinstance(source, ClusterSpec) else load_spec(Path(source))
        if name is not None:
            spec = ClusterSpec.model_validate({**spec.model_dump(by_alias=True), "name": name})
        return cls(spec, report=report)

    @classmethod
    def existing(cls, name: str | None = None, *, report: Report = silent) -> Cluster:
        """Return a cluster that was brought up before.

        Args:
            name: Its name; may be left out when there is only one.
            report: Told about progress, a line at a time.

        Raises:
            ClusterError: There is none of that name.
        """
        chosen = only_cluster() if name is None else name
        spec = state_of(chosen).read_spec()
        if spec is None:
            raise ClusterError(f"there is no cluster {chosen}; bring one up: fractus cluster up FILE")
        return cls(spec, report=report)

    @classmethod
    def bare(cls, name: str, *, report: Report = silent) -> Cluster:
        """Return a handle that can only take a cluster down, for one whose start was interrupted early."""
        spec = state_of(name).read_spec()
        return cls(spec or ClusterSpec.placeholder(name), report=report)

    @property
    def name(self) -> str:
        """The cluster's name."""
        return self.spec.name

    @property
    def kubeconfig(self) -> Path:
        """The administrator's kubeconfig; there once the cluster is up."""
        return self._state.kubeconfig

    @property
    def logs(self) -> Path:
        """Logs: `control-plane/PROGRAM.log` and `NODE/PROGRAM.log`."""
        return self._state.logs

    @property
    def nodes(self) -> list[Node]:
        """The nodes.

        Raises:
            ClusterError: The cluster was never up, so they have no addresses.
        """
        memory = self._memory()
        branch = cluster_branch(self.name)
        wiring = self._wiring(memory)
        return [
            Node(spec, memory.indexes[spec.name], wiring, self._state, branch, self.spec.world_origin)
            for spec in self.spec.nodes
            if spec.name in memory.indexes
        ]

    def node(self, name: str) -> Node:
        """Return one node.

        Raises:
            ClusterError: There is none of that name.
        """
        for node in self.nodes:
            if node.name == name:
                return node
        raise ClusterError(
            f"cluster {self.name} has no node {name}; it has {', '.join(n.name for n in self.spec.nodes)}"
        )

    def up(self, *, images: Sequence[str] = ()) -> None:
        """Make the cluster be as described, whatever state it is in; a no-op when it is.

        Dead processes are started again, nodes switched on, links healed, dead vehicles and cameras replaced.

        Args:
            images: Images in the machine's store that every node gets before it starts pods.

        Raises:
            PrerequisiteError: The machine lacks something.
            ClusterError: Something did not come up; the message names the log to read.
        """
        started = time.monotonic()
        check_root()
        if self._state.read_memory() is None or machine.holder(self.name) is None:
            check_prerequisites()
        binaries = ensure_binaries(report=self._report)
        for sentence in (text for node in self.spec.nodes for text in shortfalls(node, describe_machine())):
            self._report(f"note: {sentence}")
        with self._locked():
            memory = self._claim()
            self._state.write_spec(self.spec)
            authority = Authority(self._state.pki)
            self._start_control_plane(binaries, authority, memory)
            nodes = self.nodes
            store = ImageStore.default(report=self._report)
            wanted = store.fetch(images)
            self._place_nodes(nodes, binaries, authority, store, wanted)
            with self._api(authority, memory) as api:
                wait_ready(api, _API_TIMEOUT_S)
                self._apply_objects(api, nodes, memory)
                let_dns_start(self._wiring(memory).addressing, self._files())
                since = datetime.now(UTC).replace(microsecond=0)
                started_nodes = {node.name for node in nodes if node.power_on()}
                for node in nodes:
                    node.start_hardware()
                self._write_kubeconfig(authority, memory)
                self._wait_nodes(api, [(node, since if node.name in started_nodes else None) for node in nodes])
            self._wait_dns(memory)
            self._check_hardware(nodes)
            store.deliver(wanted, nodes)
        self._report(f"cluster {self.name} is up: {len(nodes)} nodes, {time.monotonic() - started:.1f} s")

    def down(self) -> None:
        """Take the cluster away with everything that it put on the machine; a no-op when there is none.

        Raises:
            ClusterError: Something could not be removed; call it again when the cause is gone.
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
            if self._state.path.exists():
                shutil.rmtree(self._state.path)
            machine.release(self.name)
        machine.remove_directory()
        self._report(f"cluster {self.name} is down")

    def status(self) -> list[NodeStatus]:
        """Return how each node is."""
        memory = self._memory()
        cut = network.links_cut(self._wiring(memory))
        ready = self._ready_nodes(memory)
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

    def set_power(self, node: str, *, on: bool) -> None:
        """Pull a node's power or give it back; returns before its kubelet is Ready."""
        check_root()
        with self._locked():
            chosen = self.node(node)
            if not on:
                chosen.power_off()
                return
            chosen.power_on()

    @property
    def running(self) -> bool:
        """Whether the control plane's programs run."""
        record = read_record(self._state.process(_CONTROL_PLANE))
        return record is not None and record.alive

    def load_images(self, images: Sequence[str]) -> dict[str, int]:
        """Deliver images to all nodes that are on.

        Args:
            images: Names in buildah's storage, or paths of OCI or Docker archives.

        Returns:
            For each node, how many images were new to it.

        Raises:
            ClusterError: An image does not exist or a node refuses it.
        """
        store = ImageStore.default(report=self._report)
        return store.deliver(store.fetch(images), [node for node in self.nodes if node.powered])

    def kubectl(
        self, *arguments: str, input_text: str | None = None, timeout_s: float = 60.0, check: bool = True
    ) -> subprocess.CompletedProcess[str]:
        """Run kubectl against the cluster to its end and return what it wrote.

        Raises:
            ClusterError: It failed (with `check`) or took too long.
        """
        program = ensure_binaries(["kubectl"], report=self._report)["kubectl"]
        environment = {**os.environ, "KUBECONFIG": str(self.kubeconfig)}
        return run([program, *arguments], input_text=input_text, timeout_s=timeout_s, check=check, env=environment)

    def _locked(self, *, remove: bool = False) -> AbstractContextManager[None]:
        return locked(
            machine.cluster_lock(self.name),
            timeout_s=_LOCK_TIMEOUT_S,
            what=f"another command works on cluster {self.name}",
            report=self._report,
            remove=remove,
        )

    def _memory(self) -> Memory:
        memory = self._state.read_memory()
        if memory is None:
            raise ClusterError(f"cluster {self.name} is not up")
        return memory

    def _wiring(self, memory: Memory) -> network.Wiring:
        return network.Wiring(self.name, Addressing(memory.block), self._state.marks)

    def _branch(self) -> Branch:
        return cluster_branch(self.name)

    def _claim(self) -> Memory:
        """Claim addresses, and remove the nodes that the description has no more."""
        remembered = self._state.read_memory()
        names = [node.name for node in self.spec.nodes]
        block = machine.claim(self.name, self._state.path, remembered.block if remembered else None)
        memory = (remembered or Memory(block, {})).with_nodes(names)
        old_spec = self._state.read_spec()
        if remembered is not None and old_spec is not None:
            gone = [spec for spec in old_spec.nodes if spec.name in remembered.indexes and spec.name not in names]
            for spec in gone:
                self._report(f"removing node {spec.name}")
                index = remembered.indexes[spec.name]
                Node(spec, index, self._wiring(remembered), self._state, self._branch()).remove()
        if memory != remembered:
            self._state.write_memory(memory)
        return memory

    def _files(self) -> ControlPlaneFiles:
        return ControlPlaneFiles(self._state.control_plane, self._state.logs / _CONTROL_PLANE)

    def _start_control_plane(self, binaries: Binaries, authority: Authority, memory: Memory) -> None:
        wiring, files = self._wiring(memory), self._files()
        network.wire_control_plane(wiring)
        units = control_plane_units(binaries, authority, wiring.addressing, files)
        view: dict[str, object] = {"hostname": None, "files": "", "logs": "", "programs": {}, "sysctls": {}}
        config = json.dumps(
            {"view": view, "units": units, "builds": binaries.builds(*CONTROL_PLANE_PROGRAMS)}, indent=1
        )
        path = files.directory / "init.json"
        if self.running and path.exists() and path.read_text() == config:
            return
        self._stop_control_plane()
        files.directory.mkdir(parents=True, exist_ok=True)
        write_control_plane(authority, wiring.addressing, files, cluster=self.name)
        write_private(path, config)
        record = spawn(
            init_command(path, wiring.namespace_path()),
            log=files.logs / "init.log",
            cgroup_files=self._branch().below(_CONTROL_PLANE).create(),
            env=_ENVIRONMENT,
        )
        write_record(self._state.process(_CONTROL_PLANE), record)

    def _stop_control_plane(self) -> None:
        record = read_record(self._state.process(_CONTROL_PLANE))
        if record is not None:
            kill(record)
        self._branch().below(_CONTROL_PLANE).kill_all()

    def _place_nodes(
        self, nodes: list[Node], binaries: Binaries, authority: Authority, store: ImageStore, images: Sequence[Image]
    ) -> None:
        """Wire the nodes and write their files; new ones get their images on disk before they ever start."""
        for node in nodes:
            network.wire_node(node.wiring, node.name, node.index)
            node.write_files(node.files(binaries, authority))
        fresh = [node for node in nodes if not has_storage(node)]
        if fresh:
            template = store.template(images, binaries["pause"])
            with ThreadPoolExecutor(max_workers=2) as pool:
                list(pool.map(template.furnish, fresh))

    def _api(self, authority: Authority, memory: Memory) -> AbstractContextManager[BlockingClient]:
        server = server_url(Addressing(memory.block))
        return administrating(server, authority.credential.certificate, administrator(authority))

    def _apply_objects(self, api: BlockingClient, nodes: list[Node], memory: Memory) -> None:
        place = Addressing(memory.block)
        names = {node.name for node in nodes}
        for present in api.list("/api/v1/nodes"):
            name = present["metadata"]["name"]
            if name not in names and "fractus-sim" in str(present["metadata"].get("managedFields")):
                api.call("DELETE", f"/api/v1/nodes/{name}")
        for node in nodes:
            # Before its kubelet starts, so that no pod is there before labels and taints are.
            _apply_node(api, node, place)
        for path, body in manifests.dns_objects(place.control_plane):
            api.apply(path, body)

    def _write_kubeconfig(self, authority: Authority, memory: Memory) -> None:
        text = authority.kubeconfig(
            administrator(authority), server=server_url(Addressing(memory.block)), cluster=f"fractus-{self.name}"
        )
        if not self.kubeconfig.exists() or self.kubeconfig.read_text() != text:
            write_private(self.kubeconfig, text)

    def _wait_nodes(self, api: BlockingClient, nodes: Sequence[tuple[Node, datetime | None]]) -> None:
        """Wait until every node is Ready, by its word since the given time, and offers its extended resources."""
        deadline = time.monotonic() + _READY_TIMEOUT_S
        waiting = {node.name: (node, since) for node, since in nodes}
        while True:
            for item in api.list("/api/v1/nodes"):
                name = item["metadata"]["name"]
                if name in waiting and manifests.is_ready(item, since=waiting[name][1]):
                    patch = manifests.extended_resources_patch(waiting[name][0].spec, item)
                    if patch:
                        api.merge(*patch)
                    else:
                        del waiting[name]
            if not waiting:
                return
            for node, _ in waiting.values():
                if not node.powered:
                    raise ClusterError(f"node {node.name} did not start; see {self.logs / node.name / 'init.log'}")
            if time.monotonic() > deadline:
                names = ", ".join(waiting)
                raise ClusterError(f"not Ready within {_READY_TIMEOUT_S:.0f} s: {names}; see the logs in {self.logs}")
            time.sleep(_POLL_S)

    def _check_hardware(self, nodes: Sequence[Node]) -> None:
        for node in nodes:
            for name, runs in (("vehicle", node.vehicle_running), ("camera", node.camera_running)):
                if runs is False:
                    log = self.logs / node.name / f"{name}.log"
                    last = log.read_text(errors="replace").splitlines()[-1:] if log.exists() else []
                    raise ClusterError(f"the {name} of node {node.name} ended at once: {' '.join(last)} (see {log})")

    def _wait_dns(self, memory: Memory) -> None:
        address = str(Addressing(memory.block).control_plane)
        deadline = time.monotonic() + _DNS_TIMEOUT_S
        while not answers_ready(address, DNS_READY_PORT):
            if time.monotonic() > deadline:
                log = self.logs / _CONTROL_PLANE / "coredns.log"
                raise ClusterError(f"the cluster's DNS was not ready within {_DNS_TIMEOUT_S:.0f} s; see {log}")
            time.sleep(_POLL_S)

    def _ready_nodes(self, memory: Memory) -> dict[str, bool] | None:
        if not self.running:
            return None
        with self._api(Authority(self._state.pki), memory) as api:
            try:
                items = api.list("/api/v1/nodes")
            except KubeError as error:
                if error.status:
                    raise
                return None
        return {item["metadata"]["name"]: manifests.is_ready(item) for item in items}


def _apply_node(api: BlockingClient, node: Node, place: Addressing) -> None:
    for tries_left in reversed(range(_CONFLICTS)):
        present = api.apply(*manifests.node_object(node.spec, node.index, place))
        patch = manifests.taints_patch(node.spec, present)
        if patch is None:
            return
        try:
            api.merge(*patch)
        except Conflict:
            # The node controller has set a taint of its own meanwhile.
            if not tries_left:
                raise


def print_report(message: str) -> None:
    """Write a line of progress to standard error."""
    print(message, file=sys.stderr, flush=True)

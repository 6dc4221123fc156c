"""Steps that start a cluster. A step changes nothing if its part is up to date."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from datetime import datetime

from fractus_runtime.kubernetes import BlockingClient, Conflict, KubeError

from fractus_cluster import machine, manifests, network
from fractus_cluster.addressing import Addressing
from fractus_cluster.apiclient import administrating, is_ready
from fractus_cluster.binaries import Binaries
from fractus_cluster.cgroups import cluster_branch
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
from fractus_cluster.node import Node, init_command
from fractus_cluster.pki import Authority, write_private
from fractus_cluster.processes import kill_recorded, running, spawn, write_record
from fractus_cluster.spec import ClusterSpec
from fractus_cluster.state import ClusterRecord, StateDirectory
from fractus_cluster.supervisor import ENVIRONMENT

_READY_TIMEOUT_S = 90.0
_DNS_TIMEOUT_S = 90.0
_POLL_S = 0.1
_CONFLICTS = 5
CONTROL_PLANE = "control-plane"

Report = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Startup:
    """Starts the parts of one cluster.

    Attributes:
        cluster: Name.
        state: State directory.
        wiring: Network.
        authority: Certificate authority.
    """

    cluster: str
    state: StateDirectory
    wiring: network.Wiring
    authority: Authority

    def start_control_plane(self, binaries: Binaries) -> None:
        """Start etcd, the API server, controllers, scheduler and DNS. Restart all if their configuration changed."""
        wiring = self.wiring
        files = self._files()
        record_path = self.state.process(CONTROL_PLANE)
        network.wire_control_plane(wiring)
        units = control_plane_units(binaries, self.authority, wiring.addressing, files)
        view: dict[str, object] = {"hostname": None, "files": "", "logs": "", "programs": {}, "sysctls": {}}
        config = json.dumps(
            {"view": view, "units": units, "builds": binaries.builds(*CONTROL_PLANE_PROGRAMS)}, indent=1
        )
        path = files.directory / "init.json"
        if running(record_path) and path.exists() and path.read_text() == config:
            return
        kill_recorded(record_path)
        cgroup = cluster_branch(self.cluster).below(CONTROL_PLANE)
        cgroup.kill_all()
        files.directory.mkdir(parents=True, exist_ok=True)
        write_control_plane(self.authority, wiring.addressing, files, cluster=self.cluster)
        write_private(path, config)
        record = spawn(
            init_command(path, wiring.namespace_path()),
            log=files.logs / "init.log",
            cgroup_files=cgroup.create(),
            env=ENVIRONMENT,
        )
        write_record(record_path, record)

    def place_nodes(
        self, nodes: list[Node], binaries: Binaries, store: ImageStore, images: Sequence[Image]
    ) -> list[str]:
        """Connect the nodes and write their files. Unpack images on the disks of new nodes before they start.

        Returns:
            Names of the nodes whose files changed. They are powered off.
        """
        changed = []
        for node in nodes:
            network.wire_node(node.wiring, node.name, node.index, mobile=node.spec.hardware.uplink is not None)
            if node.write_files(node.files(binaries, self.authority)):
                changed.append(node.name)
        new = [node for node in nodes if not has_storage(node)]
        if new:
            template = store.template(images, binaries["pause"])
            with ThreadPoolExecutor(max_workers=2) as pool:
                list(pool.map(template.copy_to, new))
        return changed

    def api(self) -> AbstractContextManager[BlockingClient]:
        """Return an API server client with administrator rights."""
        server = server_url(self.wiring.addressing)
        return administrating(server, self.authority.credential.certificate, administrator(self.authority))

    def apply_objects(self, api: BlockingClient, nodes: list[Node]) -> None:
        """Create or update the objects of nodes, DNS and storage. Delete the Nodes that are not part of the description."""
        addressing = self.wiring.addressing
        names = {node.name for node in nodes}
        for present in api.list("/api/v1/nodes"):
            name = present["metadata"]["name"]
            if name not in names and "fractus-sim" in str(present["metadata"].get("managedFields")):
                api.call("DELETE", f"/api/v1/nodes/{name}")
        for node in nodes:
            # The kubelet starts later, so no pod is scheduled before labels and taints exist.
            _apply_node(api, node, addressing)
        for path, body in manifests.dns_objects(addressing.control_plane):
            api.apply(path, body)
        apply_volumes(api, nodes)

    def write_kubeconfig(self) -> None:
        """Write the administrator's kubeconfig if it changed."""
        text = self.authority.kubeconfig(
            administrator(self.authority), server=server_url(self.wiring.addressing), cluster=f"fractus-{self.cluster}"
        )
        if not self.state.kubeconfig.exists() or self.state.kubeconfig.read_text() != text:
            write_private(self.state.kubeconfig, text)

    def wait_nodes(self, api: BlockingClient, nodes: Sequence[tuple[Node, datetime | None]]) -> None:
        """Wait until every node is Ready and offers its extended resources.

        Args:
            api: Client of the API server.
            nodes: Nodes, each with a time. Reports of its kubelet before this time are ignored.

        Raises:
            ClusterError: A node did not start, or was not Ready before the timeout.
        """
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
                    raise ClusterError(
                        f"node {node.name} did not start; see {self.state.logs / node.name / 'init.log'}"
                    )
            if time.monotonic() > deadline:
                names = ", ".join(waiting)
                raise ClusterError(
                    f"nodes not Ready within {_READY_TIMEOUT_S:.0f} s: {names}; see the logs in {self.state.logs}"
                )
            time.sleep(_POLL_S)

    def check_hardware(self, nodes: Sequence[Node]) -> None:
        """Check that the vehicles and cameras are running.

        Raises:
            ClusterError: A process has ended.
        """
        for node in nodes:
            for name, is_running in (("vehicle", node.vehicle_running), ("camera", node.camera_running)):
                if is_running is False:
                    log = self.state.logs / node.name / f"{name}.log"
                    last = log.read_text(errors="replace").splitlines()[-1:] if log.exists() else []
                    raise ClusterError(f"the {name} of node {node.name} has ended: {' '.join(last)} (see {log})")

    def let_dns_start(self) -> None:
        """Start the cluster DNS. Call this after `apply_objects`."""
        let_dns_start(self.wiring.addressing, self._files())

    def wait_dns(self) -> None:
        """Wait until DNS responds.

        Raises:
            ClusterError: DNS did not respond before the timeout.
        """
        address = str(self.wiring.addressing.control_plane)
        deadline = time.monotonic() + _DNS_TIMEOUT_S
        while not is_ready(address, DNS_READY_PORT):
            if time.monotonic() > deadline:
                log = self.state.logs / CONTROL_PLANE / "coredns.log"
                raise ClusterError(f"the cluster's DNS was not ready within {_DNS_TIMEOUT_S:.0f} s; see {log}")
            time.sleep(_POLL_S)

    def ready_nodes(self) -> dict[str, bool] | None:
        """Return the readiness of each node, or None if the API server is unavailable."""
        if running(self.state.process(CONTROL_PLANE)) is None:
            return None
        with self.api() as api:
            try:
                items = api.list("/api/v1/nodes")
            except KubeError as error:
                if error.status:
                    raise
                return None
        return {item["metadata"]["name"]: manifests.is_ready(item) for item in items}

    def _files(self) -> ControlPlaneFiles:
        return ControlPlaneFiles(self.state.control_plane, self.state.logs / CONTROL_PLANE)


def wiring_of(cluster: str, state: StateDirectory, record: ClusterRecord) -> network.Wiring:
    """Return the network of a cluster with known addresses."""
    return network.Wiring(cluster, Addressing(record.block), state.marks)


def claim(spec: ClusterSpec, state: StateDirectory, kubernetes: str, report: Report) -> ClusterRecord:
    """Claim addresses for a cluster, and remove its nodes that are no longer part of the specification.

    Raises:
        ClusterError: The cluster was started with another minor version of Kubernetes, or no addresses are free.
    """
    previous = state.read_record()
    if previous is not None and previous.kubernetes != kubernetes:
        raise ClusterError(
            f"cluster {spec.name} runs Kubernetes {previous.kubernetes}; set FRACTUS_KUBERNETES={previous.kubernetes}, "
            f"or remove it before you start it with {kubernetes}: fractus cluster down --name {spec.name}"
        )
    names = [node.name for node in spec.nodes]
    block = machine.claim(spec.name, state.path, previous.block if previous else None)
    record = (previous or ClusterRecord(block, {}, kubernetes)).with_nodes(names)
    old_spec = state.read_spec()
    if previous is not None and old_spec is not None:
        removed = [node for node in old_spec.nodes if node.name in previous.indexes and node.name not in names]
        for node in removed:
            report(f"removing node {node.name}")
            index = previous.indexes[node.name]
            Node(node, index, wiring_of(spec.name, state, previous), state, cluster_branch(spec.name)).remove()
    if record != previous:
        state.write_record(record)
    return record


def apply_volumes(api: BlockingClient, nodes: Sequence[Node]) -> None:
    """Create the volumes of all nodes.

    A volume whose claim was deleted is emptied and can be claimed again. Volumes of removed nodes are deleted.
    """
    api.apply(*manifests.storage_class())
    by_name = {node.name: node for node in nodes}
    for volume in api.list("/api/v1/persistentvolumes"):
        place = manifests.volume_place(volume)
        path = f"/api/v1/persistentvolumes/{volume['metadata']['name']}"
        if place is not None and place[0] not in by_name:
            api.call("DELETE", path)
        elif place is not None and volume.get("status", {}).get("phase") == "Released":
            name, number = place
            shutil.rmtree(by_name[name].volume(number), ignore_errors=True)
            api.merge(path, {"spec": {"claimRef": None}})
    for node in nodes:
        for number in range(1, manifests.VOLUMES_PER_NODE + 1):
            node.volume(number).mkdir(parents=True, exist_ok=True)
            api.apply(*manifests.volume_object(node.name, number))


def _apply_node(api: BlockingClient, node: Node, addressing: Addressing) -> None:
    """Create or update a Node and its taint."""
    for tries_left in reversed(range(_CONFLICTS)):
        present = api.apply(*manifests.node_object(node.spec, node.index, addressing))
        patch = manifests.taints_patch(node.spec, present)
        if patch is None:
            return
        try:
            api.merge(*patch)
        except Conflict:
            # The node controller has added a taint in the meantime.
            if not tries_left:
                raise

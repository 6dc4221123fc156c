"""The state directory of a cluster: where everything is, and what must be remembered between commands."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, replace
from ipaddress import IPv4Network
from pathlib import Path

import yaml
from fractus_runtime.files import write_file

from fractus_cluster.binaries import DEFAULT_KUBERNETES
from fractus_cluster.errors import ClusterError
from fractus_cluster.spec import ClusterSpec, parse_spec


def state_root() -> Path:
    """Return the directory of all clusters' state: FRACTUS_STATE, or below /var/lib."""
    return Path(os.environ.get("FRACTUS_STATE") or "/var/lib/fractus-sim").resolve()


@dataclass(frozen=True, slots=True)
class Memory:
    """What is remembered of a cluster.

    Attributes:
        block: Its addresses.
        indexes: Index of each node; a node keeps its own, so that its addresses never change.
        kubernetes: Minor version of its programs: what a newer one has stored, an older one cannot read.
    """

    block: IPv4Network
    indexes: dict[str, int]
    kubernetes: str = DEFAULT_KUBERNETES

    def with_nodes(self, names: list[str]) -> Memory:
        """Return a memory for the given nodes: those known keep their index, new ones get the lowest free one."""
        kept = {name: index for name, index in self.indexes.items() if name in names}
        free = (index for index in range(len(names) + len(kept) + 1) if index not in kept.values())
        return replace(self, indexes={name: kept[name] if name in kept else next(free) for name in names})


@dataclass(frozen=True, slots=True)
class StateDirectory:
    """Paths of one cluster's state."""

    path: Path

    @property
    def pki(self) -> Path:
        """Keys and certificates."""
        return self.path / "pki"

    @property
    def marks(self) -> Path:
        """Records of network namespaces that are complete."""
        return self.path / "network"

    @property
    def control_plane(self) -> Path:
        """The control plane's files."""
        return self.path / "control-plane"

    @property
    def radio(self) -> Path:
        """The radio's files: `layout.json`, and its socket `control`."""
        return self.path / "radio"

    @property
    def logs(self) -> Path:
        """Logs, a directory each for the control plane and every node."""
        return self.path / "logs"

    @property
    def kubeconfig(self) -> Path:
        """The administrator's kubeconfig."""
        return self.path / "kubeconfig"

    @property
    def spec(self) -> Path:
        """The cluster file as last brought up."""
        return self.path / "cluster.yaml"

    def node(self, name: str) -> Path:
        """Return the directory of a node."""
        return self.path / "nodes" / name

    def process(self, name: str) -> Path:
        """Return the record of a process: `control-plane`, `node.NAME`, `vehicle.NAME`, `camera.NAME` or `radio`."""
        return self.path / "processes" / f"{name}.json"

    def read_memory(self) -> Memory | None:
        """Return what is remembered, or None for a cluster that never was."""
        try:
            content = json.loads((self.path / "memory.json").read_text())
        except FileNotFoundError:
            return None
        return Memory(IPv4Network(content["block"]), content["indexes"], content.get("kubernetes", DEFAULT_KUBERNETES))

    def write_memory(self, memory: Memory) -> None:
        """Remember."""
        content = {"block": str(memory.block), "indexes": memory.indexes, "kubernetes": memory.kubernetes}
        self._write("memory.json", json.dumps(content))

    def read_spec(self) -> ClusterSpec | None:
        """Return the cluster as last brought up, or None."""
        try:
            content = yaml.safe_load(self.spec.read_text())
        except FileNotFoundError:
            return None
        return parse_spec(content, source=str(self.spec))

    def write_spec(self, spec: ClusterSpec) -> None:
        """Keep the cluster file."""
        self._write(self.spec.name, spec.to_yaml())

    def _write(self, name: str, text: str) -> None:
        self.path.mkdir(parents=True, exist_ok=True, mode=0o700)
        write_file(self.path / name, text.encode(), 0o644, durable=False)


def state_of(name: str) -> StateDirectory:
    """Return the state directory of a cluster."""
    return StateDirectory(state_root() / name)


def known_clusters() -> list[str]:
    """Return the names of the clusters that have a state directory."""
    root = state_root()
    if not root.is_dir():
        return []
    return sorted(path.name for path in root.iterdir() if path.is_dir() and not path.name.startswith("."))


def only_cluster() -> str:
    """Return the name of the one cluster there is.

    Raises:
        ClusterError: There is none, or more than one.
    """
    names = known_clusters()
    if len(names) != 1:
        several = f"there are clusters {', '.join(names)}; name one with --name"
        raise ClusterError(several if names else "there is no cluster; bring one up: fractus cluster up FILE")
    return names[0]

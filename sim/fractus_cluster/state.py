"""State directory of a cluster: paths, and data that is kept between commands."""

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
    """Return the state directory of all clusters: FRACTUS_STATE, or /var/lib/fractus-sim."""
    return Path(os.environ.get("FRACTUS_STATE") or "/var/lib/fractus-sim").resolve()


@dataclass(frozen=True, slots=True)
class ClusterRecord:
    """Data of a cluster that is kept between commands.

    Attributes:
        block: Addresses.
        indexes: Index of each node. It is kept so that addresses do not change.
        kubernetes: Minor version of Kubernetes. An older version cannot read the data of a newer version.
    """

    block: IPv4Network
    indexes: dict[str, int]
    kubernetes: str = DEFAULT_KUBERNETES

    def with_nodes(self, names: list[str]) -> ClusterRecord:
        """Return the record with the given nodes. Known nodes keep their index. New nodes get the lowest free index."""
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
        """Records of completely configured network namespaces."""
        return self.path / "network"

    @property
    def control_plane(self) -> Path:
        """Files of the control plane."""
        return self.path / "control-plane"

    @property
    def radio(self) -> Path:
        """Files of the radio: `layout.json` and the socket `control`."""
        return self.path / "radio"

    @property
    def logs(self) -> Path:
        """Logs, with a directory for the control plane and a directory for each node."""
        return self.path / "logs"

    @property
    def kubeconfig(self) -> Path:
        """Kubeconfig of the administrator."""
        return self.path / "kubeconfig"

    @property
    def spec(self) -> Path:
        """Last applied cluster file."""
        return self.path / "cluster.yaml"

    def node(self, name: str) -> Path:
        """Return the directory of a node."""
        return self.path / "nodes" / name

    def process(self, name: str) -> Path:
        """Return the record of a process: `control-plane`, `node.NAME`, `vehicle.NAME`, `camera.NAME` or `radio`."""
        return self.path / "processes" / f"{name}.json"

    def read_record(self) -> ClusterRecord | None:
        """Return the persistent data, or None if the cluster was never started."""
        try:
            content = json.loads((self.path / "memory.json").read_text())
        except FileNotFoundError:
            return None
        return ClusterRecord(
            IPv4Network(content["block"]), content["indexes"], content.get("kubernetes", DEFAULT_KUBERNETES)
        )

    def write_record(self, record: ClusterRecord) -> None:
        """Write the persistent data."""
        content = {"block": str(record.block), "indexes": record.indexes, "kubernetes": record.kubernetes}
        self._write("memory.json", json.dumps(content))

    def read_spec(self) -> ClusterSpec | None:
        """Return the last applied cluster, or None."""
        try:
            content = yaml.safe_load(self.spec.read_text())
        except FileNotFoundError:
            return None
        return parse_spec(content, source=str(self.spec))

    def write_spec(self, spec: ClusterSpec) -> None:
        """Write the cluster file."""
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
    """Return the name of the only cluster.

    Raises:
        ClusterError: There is no cluster, or more than one.
    """
    names = known_clusters()
    if len(names) != 1:
        several = f"there are several clusters: {', '.join(names)}; select one with --name"
        raise ClusterError(several if names else "no cluster; start one: fractus cluster up FILE")
    return names[0]

"""Clusters of the demo: a new embedded cluster, or the user's cluster with nodes assigned to the example's nodes."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from fractus_cluster.spec import load_spec
from fractus_core.api.names import CLASS_LABEL

from fractus_sim.errors import ExperimentError
from fractus_sim.testbeds.embedded_cluster import (
    DEMO_CLUSTER_FILE,
    ROOT,
    SYSTEM_IMAGES,
    FractusCluster,
    cluster_errors,
    traffic_example_objects,
)
from fractus_sim.testbeds.kube_commands import Kube, Object

EXAMPLE_IMAGE = "example-traffic-monitoring"
EXAMPLE_NODES = ("drone-1", "edge-1", "edge-2", "edge-3", "cloud-1")
DEMO_CHART = "fractus-demo"


class DemoCluster(Protocol):
    """A cluster for the demo.

    Attributes:
        disposable: True if the cluster belongs to the demo. The demo may then restart pods, and leaves its objects on
            the cluster because they are removed with the cluster.
    """

    disposable: bool

    def build_images(self) -> None:
        """Build the images of the nodes."""

    def start(self) -> Kube:
        """Start the cluster with images on its nodes, and label its nodes."""

    def create_environment(self, kube: Kube) -> list[str]:
        """Create depot, zones and policies, and on the user's cluster also node descriptions and simulated hardware.

        Returns:
            Releases of charts that were newly installed.
        """

    def remove(self) -> None:
        """Restore the original state of the cluster."""


class DemoEmbeddedCluster:
    """The embedded cluster of examples/clusters/demo.yaml. It is removed at the end unless it was already running."""

    disposable = True

    def __init__(self, report: Callable[[str], None]) -> None:
        with cluster_errors():
            self._cluster = FractusCluster(load_spec(DEMO_CLUSTER_FILE), report)

    def build_images(self) -> None:
        """Build the images with changed content."""
        self._cluster.build_images([EXAMPLE_IMAGE])

    def start(self) -> Kube:
        """Start the cluster."""
        return self._cluster.start()

    def create_environment(self, kube: Kube) -> list[str]:
        """Apply depot, zones and policies. Vehicles are part of the nodes, and agents register them."""
        kube.apply(traffic_example_objects())
        return []

    def remove(self) -> None:
        """Remove the cluster if the demo started it."""
        self._cluster.remove_if_started()


@dataclass
class CurrentCluster:
    """The cluster of KUBECONFIG with loaded images. Its nodes are assigned to the nodes of the example.

    Attributes:
        report: Called with progress lines.
        assignments: Nodes selected by the user, by the name of the example's node.
    """

    report: Callable[[str], None]
    assignments: Mapping[str, str]
    disposable: bool = False
    _assigned: Mapping[str, str] = field(default_factory=dict)

    def build_images(self) -> None:
        """Report which images the administrator of the cluster must have loaded."""
        images = ",".join((*SYSTEM_IMAGES, EXAMPLE_IMAGE, "sim"))
        self.report(f"using images localhost/fractus/{{{images}}}:dev on the nodes")

    def start(self) -> Kube:
        """Connect to the cluster, and assign and label its nodes.

        Raises:
            ExperimentError: kubectl or helm is not installed, or a node of the example cannot be assigned.
        """
        kubectl = shutil.which("kubectl")
        helm = shutil.which("helm")
        if kubectl is None or helm is None:
            raise ExperimentError("kubectl and helm must be on the PATH for --cluster current")
        config = Path(os.environ.get("KUBECONFIG", "~/.kube/config")).expanduser()
        kube = Kube(Path(kubectl), Path(helm), config)
        self._assigned = assign_nodes(kube.objects("nodes"), self.assignments)
        for example, node in self._assigned.items():
            kube.run("label", "node", node, f"{CLASS_LABEL}={node_class(example)}", "--overwrite")
            self.report(f"node {node} is used as {example}")
        return kube

    def create_environment(self, kube: Kube) -> list[str]:
        """Install the chart fractus-demo with the assigned nodes."""
        edges = ",".join(node for example, node in sorted(self._assigned.items()) if node_class(example) == "edge")
        values = (f"drone={self._assigned['drone-1']}", f"edgeNodes={{{edges}}}")
        return [DEMO_CHART] if kube.install(DEMO_CHART, ROOT / "charts" / DEMO_CHART, values) else []

    def remove(self) -> None:
        """Do nothing. Labels remain for the next run."""


def node_class(example: str) -> str:
    """Return drone, edge or cloud from the name of an example node."""
    return example.split("-", maxsplit=1)[0]


def assign_nodes(nodes: Sequence[Object], assignments: Mapping[str, str]) -> dict[str, str]:
    """Assign nodes of the cluster to the nodes of the example: drone-1, edge-1 to edge-3, cloud-1.

    Explicit assignments come first, then equal names, then nodes with the label of the class in order of their names.
    edge-3 is optional because the example only expects its rejection.

    Args:
        nodes: Node objects of the cluster.
        assignments: Explicit assignments: nodes of the cluster by nodes of the example.

    Raises:
        ExperimentError: A node is missing. The message says how to assign it.
    """
    labels = {node["metadata"]["name"]: node["metadata"].get("labels", {}).get(CLASS_LABEL) for node in nodes}
    unknown = sorted(set(assignments.values()) - set(labels))
    if unknown:
        raise ExperimentError(f"--assign: the cluster has no node {unknown[0]}; it has {', '.join(sorted(labels))}")
    assigned = dict(assignments)
    for example in EXAMPLE_NODES:
        if example not in assigned and example in labels:
            assigned[example] = example
    for example in EXAMPLE_NODES:
        if example in assigned:
            continue
        free = sorted(
            name for name, label in labels.items() if label == node_class(example) and name not in assigned.values()
        )
        if free:
            assigned[example] = free[0]
        elif example != "edge-3":
            raise ExperimentError(
                f"no node of this cluster can be used as {example}; assign one with --assign {example}=NODE"
                f" (nodes: {', '.join(sorted(labels))})"
            )
    return assigned

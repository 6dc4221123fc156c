"""The user's cluster for the demo, with nodes assigned to the nodes of the example."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from fractus_core.api.names import CLASS_LABEL

from fractus_sim.errors import ExperimentError
from fractus_sim.testbeds.embedded_cluster import (
    ROOT,
    SYSTEM_IMAGES,
)
from fractus_sim.testbeds.kube_commands import Kube, Object

EXAMPLE_IMAGE = "example-traffic-monitoring"
EXAMPLE_NODES = ("drone-1", "edge-1", "edge-2", "edge-3", "cloud-1")
DEMO_CHART = "fractus-demo"


@dataclass
class CurrentCluster:
    """The user's cluster from KUBECONFIG. Its nodes are used as the nodes of the example.

    Attributes:
        report: Called with progress lines.
        assignments: Nodes selected by the user, by the name of the node in the example.
    """

    report: Callable[[str], None]
    assignments: Mapping[str, str]
    _assigned: Mapping[str, str] = field(default_factory=dict)

    def connect(self) -> Kube:
        """Connect to the cluster, and assign and label its nodes. The administrator must have loaded the images.

        Raises:
            ExperimentError: kubectl or helm is not installed, or a node of the example cannot be assigned.
        """
        kubectl = shutil.which("kubectl")
        helm = shutil.which("helm")
        if kubectl is None or helm is None:
            raise ExperimentError("kubectl and helm must be on the PATH for --cluster current")
        images = ",".join((*SYSTEM_IMAGES, EXAMPLE_IMAGE, "sim"))
        self.report(f"using images localhost/fractus/{{{images}}}:dev on the nodes")
        config = Path(os.environ.get("KUBECONFIG", "~/.kube/config")).expanduser()
        kube = Kube(Path(kubectl), Path(helm), config)
        self._assigned = assign_nodes(kube.objects("nodes"), self.assignments)
        for example, node in self._assigned.items():
            kube.run("label", "node", node, f"{CLASS_LABEL}={node_class(example)}", "--overwrite")
            self.report(f"node {node} is used as {example}")
        return kube

    def create_environment(self, kube: Kube) -> list[str]:
        """Install the chart fractus-demo: node descriptions, simulated hardware, depot, zones and policies.

        Returns:
            Releases of charts that were newly installed.
        """
        edges = ",".join(node for example, node in sorted(self._assigned.items()) if node_class(example) == "edge")
        values = (f"drone={self._assigned['drone-1']}", f"edgeNodes={{{edges}}}")
        return [DEMO_CHART] if kube.install(DEMO_CHART, ROOT / "charts" / DEMO_CHART, values) else []


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

"""Clusters for the demo: a new embedded cluster, or the user's cluster with nodes assigned to the example's nodes."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from fractus_cluster.binaries import ensure_binaries
from fractus_cluster.cluster import Cluster
from fractus_cluster.images.build import build_images
from fractus_core.api.names import CLASS_LABEL
from fractus_core.documents import BadDocument, parse_documents

from fractus_sim.errors import ExperimentError
from fractus_sim.testbeds.kube_commands import Kube, Object

ROOT = Path(__file__).parents[3]
EXAMPLE = ROOT / "examples" / "traffic-monitoring"
TARGETS = ("operator", "agent", "mobility", "camera", "example-traffic-monitoring")
EXAMPLE_NODES = ("drone-1", "edge-1", "edge-2", "edge-3", "cloud-1")
RELEASES = ("fractus-crds", "fractus")
DEMO_CHART = "fractus-demo"
Say = Callable[[str], None]


def documents(path: Path) -> list[Object]:
    """Return the objects of a manifest.

    Raises:
        ExperimentError: The file does not exist or is not YAML.
    """
    try:
        return [body for body in parse_documents(path.read_bytes(), str(path)).values if body]
    except OSError as error:
        raise ExperimentError(f"cannot read {path}: {error.strerror}; run this in a checkout of Fractus") from None
    except BadDocument as error:
        raise ExperimentError(str(error)) from None


def surroundings() -> list[Object]:
    """Return depot, zones and policies of the example for an embedded cluster."""
    return [body for name in ("depot.yaml", "zones.yaml", "policies.yaml") for body in documents(EXAMPLE / name)]


def kube_of(cluster: Cluster, report: Say) -> Kube:
    """Return kubectl and helm for an embedded cluster."""
    programs = ensure_binaries(("kubectl", "helm"), report=report)
    return Kube(programs["kubectl"], programs["helm"], cluster.kubeconfig)


def install_fractus(kube: Kube, values: Sequence[str] = ()) -> None:
    """Install or upgrade the charts of this checkout, with `key=value` settings for the chart fractus."""
    for release in RELEASES:
        kube.install(release, ROOT / "charts" / release, values if release == "fractus" else ())


class DemoCluster(Protocol):
    """A cluster for the demo.

    Attributes:
        disposable: True if the cluster belongs to the demo, so pods may be restarted and objects remain until it is
            removed.
    """

    disposable: bool

    def images(self) -> None:
        """Build the images of the nodes."""

    def up(self) -> Kube:
        """Start the cluster with images on its nodes and labelled nodes."""

    def surroundings(self, kube: Kube) -> list[str]:
        """Create depot, zones and policies, and on other clusters also node descriptions and simulated hardware.

        Returns:
            Releases of charts that were newly installed.
        """

    def down(self) -> None:
        """Restore the original state of the cluster."""


@dataclass
class EmbeddedCluster:
    """A cluster on this machine. It is removed at the end unless it was already running."""

    say: Say
    disposable: bool = True
    built: list[str] = field(default_factory=list)
    _cluster: Cluster | None = None
    _was_running: bool = False

    def images(self) -> None:
        """Build the images with changed content."""
        self.built = build_images(ROOT, targets=TARGETS, report=self.say)

    def up(self) -> Kube:
        """Start the cluster of examples/clusters/demo.yaml."""
        self._cluster = Cluster.load(ROOT / "examples" / "clusters" / "demo.yaml", report=self.say)
        self._was_running = self._cluster.running
        self._cluster.up(images=self.built)
        return kube_of(self._cluster, self.say)

    def surroundings(self, kube: Kube) -> list[str]:
        """Apply depot, zones and policies. Vehicles are part of the nodes, and agents register them."""
        kube.apply(surroundings())
        return []

    def down(self) -> None:
        """Remove the cluster if the demo started it."""
        if self._cluster is not None and not self._was_running:
            self._cluster.down()


@dataclass
class CurrentCluster:
    """The cluster of KUBECONFIG with loaded images. Its nodes are assigned to the nodes of the example."""

    say: Say
    given: Mapping[str, str]
    disposable: bool = False
    _assigned: Mapping[str, str] = field(default_factory=dict)

    def images(self) -> None:
        """Do nothing. The administrator of the cluster loads the images."""
        self.say(f"using images localhost/fractus/{{{','.join((*TARGETS, 'sim'))}}}:dev on the nodes")

    def up(self) -> Kube:
        """Connect to the cluster, and assign and label its nodes."""
        found = [shutil.which(name) for name in ("kubectl", "helm")]
        if None in found:
            raise ExperimentError("kubectl and helm must be on the PATH for --cluster current")
        config = Path(os.environ.get("KUBECONFIG", "~/.kube/config")).expanduser()
        kube = Kube(Path(str(found[0])), Path(str(found[1])), config)
        nodes = kube.objects("nodes")
        self._assigned = assign(nodes, self.given)
        for example, node in self._assigned.items():
            kube.run("label", "node", node, f"{CLASS_LABEL}={class_of(example)}", "--overwrite")
            self.say(f"node {node} is used as {example}")
        return kube

    def surroundings(self, kube: Kube) -> list[str]:
        """Install the chart fractus-demo with the assigned nodes."""
        edges = ",".join(node for example, node in sorted(self._assigned.items()) if class_of(example) == "edge")
        named = (f"drone={self._assigned['drone-1']}", f"edgeNodes={{{edges}}}")
        return [DEMO_CHART] if kube.install(DEMO_CHART, ROOT / "charts" / DEMO_CHART, named) else []

    def down(self) -> None:
        """Do nothing. Labels remain for the next run."""


def class_of(example: str) -> str:
    """Return drone, edge or cloud from the name of an example node."""
    return example.split("-", maxsplit=1)[0]


def assign(nodes: Sequence[Object], given: Mapping[str, str]) -> dict[str, str]:
    """Assign nodes of the cluster to the nodes of the example: drone-1, edge-1 to edge-3, cloud-1.

    Explicit assignments come first, then equal names, then nodes with the label of the class in order of their names.
    edge-3 is optional because the example only expects its rejection.

    Raises:
        ExperimentError: A node is missing. The message says how to assign it.
    """
    names = {node["metadata"]["name"]: node["metadata"].get("labels", {}).get(CLASS_LABEL) for node in nodes}
    unknown = sorted(set(given.values()) - set(names))
    if unknown:
        raise ExperimentError(f"--assign: the cluster has no node {unknown[0]}; it has {', '.join(sorted(names))}")
    assigned = dict(given)
    for example in EXAMPLE_NODES:
        if example not in assigned and example in names:
            assigned[example] = example
    for example in EXAMPLE_NODES:
        if example in assigned:
            continue
        free = sorted(
            name for name, label in names.items() if label == class_of(example) and name not in assigned.values()
        )
        if free:
            assigned[example] = free[0]
        elif example != "edge-3":
            raise ExperimentError(
                f"no node of this cluster can be used as {example}; assign one with --assign {example}=NODE"
                f" (nodes: {', '.join(sorted(names))})"
            )
    return assigned

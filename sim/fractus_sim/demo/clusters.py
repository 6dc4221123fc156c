"""Where the demo runs: an embedded cluster of its own, or the user's with the example's nodes assigned to its own."""

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

from fractus_sim.demo.kube import DemoError, Kube, Object

ROOT = Path(__file__).parents[3]
EXAMPLE = ROOT / "examples" / "traffic-monitoring"
TARGETS = ("operator", "agent", "mobility", "camera", "example-traffic-monitoring")
EXAMPLE_NODES = ("drone-1", "edge-1", "edge-2", "edge-3", "cloud-1")
RELEASES = ("fractus-crds", "fractus")
DEMO_CHART = "fractus-demo"
Say = Callable[[str], None]


def documents(path: Path) -> list[Object]:
    """The objects of a manifest.

    Raises:
        DemoError: there is no such file, or it is not YAML.
    """
    try:
        return [body for body in parse_documents(path.read_bytes(), str(path)).values if body]
    except OSError as error:
        raise DemoError(f"cannot read {path}: {error.strerror}; run this in a checkout of Fractus") from None
    except BadDocument as error:
        raise DemoError(str(error)) from None


def surroundings() -> list[Object]:
    """What the example flies in on an embedded cluster: depot, zones and policies."""
    return [body for name in ("depot.yaml", "zones.yaml", "policies.yaml") for body in documents(EXAMPLE / name)]


def kube_of(cluster: Cluster, report: Say) -> Kube:
    """Kubectl and helm on an embedded cluster."""
    programs = ensure_binaries(("kubectl", "helm"), report=report)
    return Kube(programs["kubectl"], programs["helm"], cluster.kubeconfig)


def install_fractus(kube: Kube, values: Sequence[str] = ()) -> None:
    """Install or upgrade the charts of this checkout, with values of the chart fractus (`key=value`)."""
    for release in RELEASES:
        kube.install(release, ROOT / "charts" / release, values if release == "fractus" else ())


class DemoCluster(Protocol):
    """A cluster that the demo can use.

    Attributes:
        disposable: no one else uses it: pods may be restarted, and it goes away with all that is on it.
    """

    disposable: bool

    def images(self) -> None:
        """Build what the nodes will run."""

    def up(self) -> Kube:
        """Bring it up, with images on its nodes and nodes labelled."""

    def surroundings(self, kube: Kube) -> list[str]:
        """Make what the example flies in: a depot, zones, policies, and nodes' descriptions and hardware where they bring none.

        Returns:
            The releases of charts that were not there before.
        """

    def down(self) -> None:
        """Leave it as it was found."""


@dataclass
class EmbeddedCluster:
    """A cluster on this machine; taken down again unless it ran before."""

    say: Say
    disposable: bool = True
    built: list[str] = field(default_factory=list)
    _cluster: Cluster | None = None
    _was_running: bool = False

    def images(self) -> None:
        """Build the images whose content changed."""
        self.built = build_images(ROOT, targets=TARGETS, report=self.say)

    def up(self) -> Kube:
        """Bring the cluster of examples/clusters/demo.yaml up."""
        self._cluster = Cluster.load(ROOT / "examples" / "clusters" / "demo.yaml", report=self.say)
        self._was_running = self._cluster.running
        self._cluster.up(images=self.built)
        return kube_of(self._cluster, self.say)

    def surroundings(self, kube: Kube) -> list[str]:
        """Depot, zones and policies: vehicles stand beside the nodes, and agents register them."""
        kube.apply(surroundings())
        return []

    def down(self) -> None:
        """Take the cluster down if it was brought up here."""
        if self._cluster is not None and not self._was_running:
            self._cluster.down()


@dataclass
class CurrentCluster:
    """The cluster of KUBECONFIG; images are there, and the example's nodes are assigned to its nodes."""

    say: Say
    given: Mapping[str, str]
    disposable: bool = False
    _assigned: Mapping[str, str] = field(default_factory=dict)

    def images(self) -> None:
        """Nothing: they are loaded by the cluster's operator."""
        self.say(f"expecting images localhost/fractus/{{{','.join((*TARGETS, 'sim'))}}}:dev on the nodes")

    def up(self) -> Kube:
        """Find the cluster, assign and label its nodes."""
        found = [shutil.which(name) for name in ("kubectl", "helm")]
        if None in found:
            raise DemoError("kubectl and helm must be on the PATH for --cluster current")
        config = Path(os.environ.get("KUBECONFIG", "~/.kube/config")).expanduser()
        kube = Kube(Path(str(found[0])), Path(str(found[1])), config)
        nodes = kube.objects("nodes")
        self._assigned = assign(nodes, self.given)
        for example, node in self._assigned.items():
            kube.run("label", "node", node, f"{CLASS_LABEL}={class_of(example)}", "--overwrite")
            self.say(f"{example} is {node}")
        return kube

    def surroundings(self, kube: Kube) -> list[str]:
        """The chart fractus-demo, with nodes as they are assigned."""
        edges = ",".join(node for example, node in sorted(self._assigned.items()) if class_of(example) == "edge")
        named = (f"drone={self._assigned['drone-1']}", f"edgeNodes={{{edges}}}")
        return [DEMO_CHART] if kube.install(DEMO_CHART, ROOT / "charts" / DEMO_CHART, named) else []

    def down(self) -> None:
        """Nothing: labels stay, for the next time."""


def class_of(example: str) -> str:
    """drone, edge or cloud, from the name that a node has in the example."""
    return example.split("-", maxsplit=1)[0]


def assign(nodes: Sequence[Object], given: Mapping[str, str]) -> dict[str, str]:
    """Which node stands for which of the example's: drone-1, edge-1 to edge-3, cloud-1.

    What is given comes first, then equal names, then nodes with the label of the class, by name. edge-3 may be missing:
    it is there to be rejected.

    Raises:
        DemoError: a node is missing; the message says how to name it.
    """
    names = {node["metadata"]["name"]: node["metadata"].get("labels", {}).get(CLASS_LABEL) for node in nodes}
    unknown = sorted(set(given.values()) - set(names))
    if unknown:
        raise DemoError(f"--assign: the cluster has no node {unknown[0]}; it has {', '.join(sorted(names))}")
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
            raise DemoError(
                f"no node of this cluster stands for {example}; name one: --assign {example}=NODE"
                f" (nodes: {', '.join(sorted(names))})"
            )
    return assigned

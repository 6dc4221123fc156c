"""Fractus on an embedded cluster: build images, start the cluster, install the charts, and remove the cluster."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from fractus_agent.redirector.netlink import in_namespace
from fractus_cluster.binaries import ensure_binaries
from fractus_cluster.cluster import Cluster
from fractus_cluster.errors import ClusterError
from fractus_cluster.images.build import build_images
from fractus_cluster.spec import ClusterSpec
from fractus_core.documents import BadDocument, parse_documents

from fractus_sim.errors import ExperimentError
from fractus_sim.interruption import uninterrupted
from fractus_sim.testbeds.kube_commands import Kube, Object
from fractus_sim.testbeds.mission_watch import wait_for_drone

ROOT = Path(__file__).parents[3]
"""Checkout of Fractus that contains the charts, the examples and the Dockerfile."""

TRAFFIC_EXAMPLE = ROOT / "examples" / "traffic-monitoring"
DEMO_CLUSTER_FILE = ROOT / "examples" / "clusters" / "demo.yaml"
CHARTS = ("fractus-crds", "fractus")
SYSTEM_IMAGES = ("operator", "agent", "mobility", "camera")
"""Targets of the Dockerfile that every cluster needs."""

READY_TIMEOUT_S = 180.0


class FractusCluster:
    """An embedded cluster with Fractus.

    Attributes:
        cluster: The embedded cluster.
        was_running: True if the cluster was running before this run.
    """

    def __init__(self, spec: ClusterSpec, report: Callable[[str], None]) -> None:
        self.cluster = Cluster(spec, report=report)
        self.was_running = self.cluster.running
        self._report = report
        self._images: list[str] = []

    def build_images(self, examples: Sequence[str] = ()) -> None:
        """Build the images of Fractus and of the given targets of the Dockerfile.

        Raises:
            ExperimentError: An image cannot be built.
        """
        with cluster_errors():
            self._images = build_images(ROOT, targets=(*SYSTEM_IMAGES, *examples), report=self._report)

    def start(self) -> Kube:
        """Start the cluster with the built images.

        Raises:
            ExperimentError: A part of the cluster did not start.
        """
        with cluster_errors():
            self.cluster.up(images=self._images)
            programs = ensure_binaries(("kubectl", "helm"), report=self._report)
        return Kube(programs["kubectl"], programs["helm"], self.cluster.kubeconfig)

    def remove(self) -> None:
        """Remove the cluster. Signals are deferred until the removal is complete.

        Raises:
            ExperimentError: A part of the cluster cannot be removed.
        """
        with uninterrupted(), cluster_errors():
            self.cluster.down()

    def remove_if_started(self) -> None:
        """Remove the cluster unless it was running before this run."""
        if not self.was_running:
            self.remove()


def install_fractus(
    kube: Kube, objects: Sequence[Object], values: Sequence[str] = (), timeout_s: float = READY_TIMEOUT_S
) -> None:
    """Install the charts of this checkout, apply objects, and wait until a drone is ready.

    Args:
        kube: Cluster.
        objects: Objects that missions need, such as depots, zones and policies.
        values: `key=value` settings for the chart fractus.
        timeout_s: Maximum time until a drone is ready, seconds.

    Raises:
        ExperimentError: A command failed, or no drone was ready before the timeout.
    """
    for chart in CHARTS:
        kube.install(chart, ROOT / "charts" / chart, values if chart == "fractus" else ())
    kube.apply(objects)
    wait_for_drone(kube, timeout_s)


def read_objects(*paths: Path) -> list[Object]:
    """Return the objects of manifest files.

    Raises:
        ExperimentError: A file does not exist or is not YAML.
    """
    objects: list[Object] = []
    for path in paths:
        try:
            objects += [body for body in parse_documents(path.read_bytes(), str(path)).values if body]
        except OSError as error:
            raise ExperimentError(f"cannot read {path}: {error.strerror}; run this in a checkout of Fractus") from None
        except BadDocument as error:
            raise ExperimentError(str(error)) from None
    return objects


def traffic_example_objects() -> list[Object]:
    """Return depot, zones and policies of the traffic monitoring example."""
    return read_objects(*(TRAFFIC_EXAMPLE / name for name in ("depot.yaml", "zones.yaml", "policies.yaml")))


@contextmanager
def cluster_errors() -> Iterator[None]:
    """Convert errors of the embedded cluster.

    Raises:
        ExperimentError: A part of the cluster failed.
    """
    try:
        yield
    except ClusterError as error:
        raise ExperimentError(str(error)) from None


def connect_in(namespace: Path, port: int, timeout_s: float) -> socket.socket:
    """Connect to a loopback port in the network namespace of a node.

    Raises:
        ExperimentError: The namespace cannot be entered, or the connection was refused.
    """
    return _open_in(namespace, lambda: socket.create_connection(("127.0.0.1", port), timeout_s))


def listen_in(namespace: Path, port: int) -> socket.socket:
    """Listen on a loopback port in the network namespace of a node.

    Raises:
        ExperimentError: The namespace cannot be entered, or the port is in use.
    """
    return _open_in(namespace, lambda: socket.create_server(("127.0.0.1", port)))


def _open_in(namespace: Path, open_socket: Callable[[], socket.socket]) -> socket.socket:
    try:
        return in_namespace(namespace, open_socket)
    except OSError as error:
        raise ExperimentError(f"network namespace {namespace.name}: {error.strerror or error}") from None

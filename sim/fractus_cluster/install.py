"""Installation of Fractus on an embedded cluster: images on every node, then charts, until the drones are ready."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from fractus_cluster.binaries import ensure_binaries
from fractus_cluster.cluster import Cluster
from fractus_cluster.commands import run
from fractus_cluster.images.build import build_images

NAMESPACE = "fractus-system"
"""Namespace of the charts. They support no other namespace."""

_TARGETS = ("operator", "agent", "mobility", "camera")
_CHARTS = ("fractus-crds", "fractus")
_READY_TIMEOUT_S = 180

Report = Callable[[str], None]


def install(cluster: Cluster, source: Path, *, report: Report) -> None:
    """Build outdated images, deliver them, install or upgrade the charts, and wait for the drones.

    Args:
        cluster: A running cluster.
        source: Checkout with Dockerfile and charts.
        report: Called with progress lines.

    Raises:
        ClusterError: A step failed. The message contains the step and its output.
    """
    images = build_images(source, targets=_TARGETS, report=report)
    cluster.load_images(images)
    programs = ensure_binaries(("kubectl", "helm"), report=report)
    kubeconfig = ("--kubeconfig", str(cluster.kubeconfig))
    for chart in _CHARTS:
        namespace = ("--namespace", NAMESPACE, "--create-namespace")
        run([programs["helm"], "upgrade", "--install", chart, source / "charts" / chart, *kubeconfig, *namespace])
        report(f"installed {chart}")
    for node in cluster.spec.nodes:
        if node.node_class != "drone":
            continue
        # The object exists only after the agent has registered the drone.
        for state in ("create", "condition=Ready"):
            waiting = ("wait", f"--for={state}", f"drones.fractus.dev/{node.name}", f"--timeout={_READY_TIMEOUT_S}s")
            run([programs["kubectl"], *kubeconfig, *waiting], timeout_s=_READY_TIMEOUT_S + 10)
        report(f"{node.name} is ready")

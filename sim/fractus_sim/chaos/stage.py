"""Environment of a chaos run: the embedded cluster with Fractus, and its drone."""

from __future__ import annotations

import json
import threading
from dataclasses import dataclass, field
from pathlib import Path

from fractus_cluster.cluster import Cluster
from fractus_cluster.node import Node

from fractus_sim.chaos import processes
from fractus_sim.demo.kube import SYSTEM, DemoError, Kube, Object

API_TIMEOUT_S = 15.0


@dataclass
class Stage:
    """Targets of faults.

    Attributes:
        drone: Name of the drone's node.
        applied: Set when an Application was applied and the operator begins to reconcile.
    """

    cluster: Cluster
    kube: Kube
    drone: str
    applied: threading.Event = field(default_factory=threading.Event)

    @property
    def node(self) -> Node:
        """Node of the drone."""
        return self.cluster.node(self.drone)

    @property
    def state(self) -> Path:
        """Local directory that is mounted as /var/lib/fractus on the drone's node."""
        return self.node.own_state

    @property
    def control_plane(self) -> Path:
        """Network namespace of the control plane."""
        return self.node.wiring.namespace_path()

    def kubectl(self, *arguments: str, timeout_s: float = API_TIMEOUT_S) -> str:
        """Run kubectl.

        Raises:
            DemoError: The command failed or timed out.
        """
        return self.kube.run(f"--request-timeout={timeout_s:.0f}s", *arguments, timeout_s=timeout_s + 5)

    def objects(self, kinds: str, *where: str) -> list[Object]:
        """Return objects of the given kinds.

        Raises:
            DemoError: The API server did not respond.
        """
        return list(json.loads(self.kubectl("get", kinds, "-o", "json", *(where or ("-A",))))["items"])

    def system_pod(self, component: str, node: str | None = None) -> Object:
        """Return a running pod of Fractus.

        Raises:
            DemoError: No pod is running.
        """
        for pod in self.objects("pods", "-n", SYSTEM, "-l", f"app.kubernetes.io/component={component}"):
            if pod["status"].get("phase") == "Running" and node in {None, pod["spec"].get("nodeName")}:
                return pod
        raise DemoError(f"no pod of {component} is running{f' on {node}' if node else ''}")

    def leader(self) -> Object:
        """Return the pod of the leading operator.

        Raises:
            DemoError: No operator holds the lease.
        """
        lease = json.loads(self.kubectl("get", "lease", "fractus-operator", "-n", SYSTEM, "-o", "json"))
        name = lease["spec"].get("holderIdentity") or "none"
        return dict(json.loads(self.kubectl("get", "pod", name, "-n", SYSTEM, "-o", "json")))

    def program(self, name: str, node: str | None = None) -> list[int]:
        """Return the processes of a program on a node, or of the control plane."""
        namespace = self.node.wiring.namespace_path(node) if node else self.control_plane
        return processes.of_program(name, namespace)

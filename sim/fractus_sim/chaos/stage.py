"""Where a run takes place: the embedded cluster with Fractus on it, and its drone."""

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
    """What faults act on.

    Attributes:
        drone: name of the node that flies.
        applied: set when an Application was applied: the operator begins to reconcile.
    """

    cluster: Cluster
    kube: Kube
    drone: str
    applied: threading.Event = field(default_factory=threading.Event)

    @property
    def node(self) -> Node:
        """The drone's node."""
        return self.cluster.node(self.drone)

    @property
    def state(self) -> Path:
        """The directory on this machine that is /var/lib/fractus of the drone's node."""
        return self.node.own_state

    @property
    def control_plane(self) -> Path:
        """The control plane's network namespace."""
        return self.node.wiring.namespace_path()

    def kubectl(self, *arguments: str, timeout_s: float = API_TIMEOUT_S) -> str:
        """Run kubectl.

        Raises:
            DemoError: it failed or took too long.
        """
        return self.kube.run(f"--request-timeout={timeout_s:.0f}s", *arguments, timeout_s=timeout_s + 5)

    def objects(self, kinds: str, *where: str) -> list[Object]:
        """Objects of some kinds.

        Raises:
            DemoError: the API server does not answer.
        """
        return list(json.loads(self.kubectl("get", kinds, "-o", "json", *(where or ("-A",))))["items"])

    def system_pod(self, component: str, node: str | None = None) -> Object:
        """A running pod of Fractus.

        Raises:
            DemoError: there is none.
        """
        for pod in self.objects("pods", "-n", SYSTEM, "-l", f"app.kubernetes.io/component={component}"):
            if pod["status"].get("phase") == "Running" and node in {None, pod["spec"].get("nodeName")}:
                return pod
        raise DemoError(f"no pod of {component} runs{f' on {node}' if node else ''}")

    def leader(self) -> Object:
        """The operator's pod that acts.

        Raises:
            DemoError: no one does.
        """
        lease = json.loads(self.kubectl("get", "lease", "fractus-operator", "-n", SYSTEM, "-o", "json"))
        name = lease["spec"].get("holderIdentity") or "none"
        return dict(json.loads(self.kubectl("get", "pod", name, "-n", SYSTEM, "-o", "json")))

    def program(self, name: str, node: str | None = None) -> list[int]:
        """Processes of a program of a node, or of the control plane."""
        namespace = self.node.wiring.namespace_path(node) if node else self.control_plane
        return processes.of_program(name, namespace)

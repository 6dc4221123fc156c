"""Embedded cluster: a real Kubernetes of several nodes on one Linux machine.

    cluster = Cluster.load(Path("examples/clusters/demo.yaml"))
    cluster.up()
    cluster.kubectl("get", "nodes")
    cluster.node("drone-1").power_off()
    cluster.down()

Names are imported when they are used, because the nodes' own first program lives in this package too.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fractus_cluster.cluster import Cluster, NodeStatus
    from fractus_cluster.errors import ClusterError, PrerequisiteError
    from fractus_cluster.node import Node
    from fractus_cluster.spec import ClusterSpec, NodeSpec, load_spec

_HOMES = {
    "Cluster": "cluster",
    "NodeStatus": "cluster",
    "ClusterError": "errors",
    "PrerequisiteError": "errors",
    "Node": "node",
    "ClusterSpec": "spec",
    "NodeSpec": "spec",
    "load_spec": "spec",
}

__all__ = [
    "Cluster",
    "ClusterError",
    "ClusterSpec",
    "Node",
    "NodeSpec",
    "NodeStatus",
    "PrerequisiteError",
    "load_spec",
]


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)

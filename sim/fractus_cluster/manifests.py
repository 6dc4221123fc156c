"""Initial objects of a cluster: its nodes and its DNS. All functions are pure."""

from __future__ import annotations

from datetime import datetime
from ipaddress import IPv4Address
from typing import Any

from fractus_core.api.names import CLASS_LABEL

from fractus_cluster.addressing import DNS_SERVICE, Addressing
from fractus_cluster.spec import NodeSpec

Json = dict[str, Any]

DNS_USER = "fractus-sim:dns"


def node_object(node: NodeSpec, index: int, addressing: Addressing) -> tuple[str, Json]:
    """Return path and content of the Node, which is created before its kubelet so that its labels exist early."""
    pods = str(addressing.pods(index))
    labels = {
        "kubernetes.io/hostname": node.name,
        "kubernetes.io/os": "linux",
        CLASS_LABEL: node.node_class,
        **node.labels,
    }
    return f"/api/v1/nodes/{node.name}", {
        "apiVersion": "v1",
        "kind": "Node",
        "metadata": {"name": node.name, "labels": labels},
        "spec": {"podCIDR": pods, "podCIDRs": [pods]},
    }


def taints_patch(node: NodeSpec, present: Json) -> tuple[str, Json] | None:
    """Return path and merge patch that keep pods off a drone or edge node unless they are meant for such; None when done.

    Taints of others stay; Kubernetes itself keeps some there.

    Args:
        node: The node's part of the cluster file.
        present: Its Node object.
    """
    taints = present["spec"].get("taints", [])
    # NoExecute is also enforced by kubelet, so setting nodeName in a pod does not bypass it.
    wanted = [{"key": CLASS_LABEL, "value": node.node_class, "effect": "NoExecute"}]
    if node.node_class == "cloud":
        wanted = []
    others = [taint for taint in taints if taint["key"] != CLASS_LABEL]
    if len(others) + len(wanted) == len(taints) and all(taint in taints for taint in wanted):
        return None
    metadata = {"resourceVersion": present["metadata"]["resourceVersion"]}
    return f"/api/v1/nodes/{node.name}", {"metadata": metadata, "spec": {"taints": [*others, *wanted]}}


def dns_objects(listen: IPv4Address) -> list[tuple[str, Json]]:
    """Return path and content of the objects that point the well-known DNS address at the DNS of the cluster."""
    metadata = {"name": "kube-dns", "namespace": "kube-system"}
    ports = [{"name": "dns", "port": 53, "protocol": "UDP"}, {"name": "dns-tcp", "port": 53, "protocol": "TCP"}]
    service: Json = {
        "apiVersion": "v1",
        "kind": "Service",
        "metadata": {**metadata, "labels": {"k8s-app": "kube-dns"}},
        "spec": {
            "clusterIP": str(DNS_SERVICE),
            "ports": [{**port, "targetPort": port["port"]} for port in ports],
        },
    }
    endpoints: Json = {
        "apiVersion": "discovery.k8s.io/v1",
        "kind": "EndpointSlice",
        "metadata": {**metadata, "labels": {"kubernetes.io/service-name": "kube-dns"}},
        "addressType": "IPv4",
        "ports": ports,
        "endpoints": [{"addresses": [str(listen)], "conditions": {"ready": True}}],
    }
    role: Json = {
        "apiVersion": "rbac.authorization.k8s.io/v1",
        "kind": "ClusterRole",
        "metadata": {"name": DNS_USER},
        "rules": [
            {"apiGroups": [""], "resources": ["services", "pods", "namespaces"], "verbs": ["list", "watch"]},
            {"apiGroups": ["discovery.k8s.io"], "resources": ["endpointslices"], "verbs": ["list", "watch"]},
        ],
    }
    binding: Json = {
        "apiVersion": "rbac.authorization.k8s.io/v1",
        "kind": "ClusterRoleBinding",
        "metadata": {"name": DNS_USER},
        "roleRef": {"apiGroup": "rbac.authorization.k8s.io", "kind": "ClusterRole", "name": DNS_USER},
        "subjects": [{"apiGroup": "rbac.authorization.k8s.io", "kind": "User", "name": DNS_USER}],
    }
    rbac = "/apis/rbac.authorization.k8s.io/v1"
    return [
        ("/api/v1/namespaces/kube-system/services/kube-dns", service),
        ("/apis/discovery.k8s.io/v1/namespaces/kube-system/endpointslices/kube-dns", endpoints),
        (f"{rbac}/clusterroles/{DNS_USER}", role),
        (f"{rbac}/clusterrolebindings/{DNS_USER}", binding),
    ]


def extended_resources_patch(node: NodeSpec, present: Json) -> tuple[str, Json] | None:
    """Return path and merge patch for a node's extended resources, or None if the node already offers them."""
    wanted = dict(node.extended_resources)
    status = present.get("status", {})
    # Kubelet would update allocatable only at its next heartbeat.
    patch = {
        field: wanted
        for field in ("capacity", "allocatable")
        if any(str(status.get(field, {}).get(name)) != amount for name, amount in wanted.items())
    }
    return (f"/api/v1/nodes/{node.name}/status", {"status": patch}) if patch else None


def is_ready(node: Json, *, since: datetime | None = None) -> bool:
    """Return True if a Node object is Ready.

    Args:
        node: The object.
        since: Ignore conditions that kubelet reported before this time.
    """
    for condition in node.get("status", {}).get("conditions", ()):
        if condition["type"] == "Ready" and condition["status"] == "True":
            return since is None or datetime.fromisoformat(condition["lastHeartbeatTime"]) >= since
    return False

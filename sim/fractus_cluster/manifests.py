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
STORAGE_CLASS = "local"
VOLUMES_PER_NODE = 4
VOLUME_SIZE = "10Gi"
"""Size of a volume that claims can request. It is not enforced."""
VOLUMES = "/var/lib/fractus-volumes"
"""Directory of the volumes on a node."""
_OURS = {"app.kubernetes.io/managed-by": "fractus-sim"}


def node_object(node: NodeSpec, index: int, addressing: Addressing) -> tuple[str, Json]:
    """Return path and content of a Node object. It is created before kubelet starts, so that its labels exist early."""
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
    """Return path and merge patch for the taint of a drone or edge node. Return None if the taint is already set.

    The taint keeps all pods off the node that do not tolerate it. The patch keeps all other taints, because Kubernetes
    sets some itself.

    Args:
        node: Part of the cluster file that describes the node.
        present: Node object on the API server.
    """
    taints = present["spec"].get("taints", [])
    # Unlike NoSchedule, kubelet enforces NoExecute. A pod therefore cannot bypass the taint by setting nodeName.
    taint = [{"key": CLASS_LABEL, "value": node.node_class, "effect": "NoExecute"}]
    if node.node_class == "cloud":
        taint = []
    others = [entry for entry in taints if entry["key"] != CLASS_LABEL]
    if len(others) + len(taint) == len(taints) and all(entry in taints for entry in taint):
        return None
    metadata = {"resourceVersion": present["metadata"]["resourceVersion"]}
    return f"/api/v1/nodes/{node.name}", {"metadata": metadata, "spec": {"taints": [*others, *taint]}}


def dns_objects(listen: IPv4Address) -> list[tuple[str, Json]]:
    """Return path and content of the objects of the cluster DNS: Service, EndpointSlice, and permissions."""
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


def storage_class() -> tuple[str, Json]:
    """Return path and content of the default StorageClass. Its volumes exist already, so it has no provisioner."""
    return f"/apis/storage.k8s.io/v1/storageclasses/{STORAGE_CLASS}", {
        "apiVersion": "storage.k8s.io/v1",
        "kind": "StorageClass",
        "metadata": {
            "name": STORAGE_CLASS,
            "labels": _OURS,
            "annotations": {"storageclass.kubernetes.io/is-default-class": "true"},
        },
        "provisioner": "kubernetes.io/no-provisioner",
        # The scheduler selects a volume on the node of the first pod.
        "volumeBindingMode": "WaitForFirstConsumer",
    }


def volume_object(node: str, number: int) -> tuple[str, Json]:
    """Return path and content of a PersistentVolume: a directory of a node."""
    name = f"{node}-{number}"
    on_node = {"key": "kubernetes.io/hostname", "operator": "In", "values": [node]}
    return f"/api/v1/persistentvolumes/{name}", {
        "apiVersion": "v1",
        "kind": "PersistentVolume",
        "metadata": {"name": name, "labels": _OURS},
        "spec": {
            "storageClassName": STORAGE_CLASS,
            "capacity": {"storage": VOLUME_SIZE},
            "accessModes": ["ReadWriteOnce"],
            "persistentVolumeReclaimPolicy": "Retain",
            "local": {"path": f"{VOLUMES}/{number}"},
            "nodeAffinity": {"required": {"nodeSelectorTerms": [{"matchExpressions": [on_node]}]}},
        },
    }


def volume_place(volume: Json) -> tuple[str, int] | None:
    """Return node and number of a PersistentVolume of `volume_object`, or None if it is a different volume."""
    labels = volume["metadata"].get("labels") or {}
    node, _, number = volume["metadata"]["name"].rpartition("-")
    return (node, int(number)) if labels.items() >= _OURS.items() else None


def extended_resources_patch(node: NodeSpec, present: Json) -> tuple[str, Json] | None:
    """Return path and merge patch for a node's extended resources, or None if the node already offers them."""
    resources = dict(node.extended_resources)
    status = present.get("status", {})
    # The patch also contains `allocatable`, because kubelet would update it only at its next heartbeat.
    patch = {
        field: resources
        for field in ("capacity", "allocatable")
        if any(str(status.get(field, {}).get(name)) != amount for name, amount in resources.items())
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

"""The kinds of objects the operator touches, and where the API server keeps them."""

from __future__ import annotations

from fractus_core.api import (
    API_VERSION,
    Application,
    DeploymentPlan,
    Depot,
    DirectLink,
    Drone,
    EdgeNode,
    Grant,
    NodeGrants,
    Policy,
    Resource,
    Zone,
)
from fractus_runtime.kubernetes import Body, Key, Kind, key_of

__all__ = ["Body", "Key", "Kind", "key_of"]


def _ours(model: type[Resource]) -> Kind:
    return Kind(API_VERSION, model.KIND, model.PLURAL, model.NAMESPACED)


APPLICATION = _ours(Application)
DEPLOYMENT_PLAN = _ours(DeploymentPlan)
GRANT = _ours(Grant)
NODE_GRANTS = _ours(NodeGrants)
DIRECT_LINK = _ours(DirectLink)
DRONE = _ours(Drone)
EDGE_NODE = _ours(EdgeNode)
DEPOT = _ours(Depot)
ZONE = _ours(Zone)
POLICY = _ours(Policy)

NODE = Kind("v1", "Node", "nodes", namespaced=False)
POD = Kind("v1", "Pod", "pods", namespaced=True)
SERVICE = Kind("v1", "Service", "services", namespaced=True)
SERVICE_ACCOUNT = Kind("v1", "ServiceAccount", "serviceaccounts", namespaced=True)
SECRET = Kind("v1", "Secret", "secrets", namespaced=True)
CONFIG_MAP = Kind("v1", "ConfigMap", "configmaps", namespaced=True)
EVENT = Kind("v1", "Event", "events", namespaced=True)
DEPLOYMENT = Kind("apps/v1", "Deployment", "deployments", namespaced=True)
DAEMON_SET = Kind("apps/v1", "DaemonSet", "daemonsets", namespaced=True)
REPLICA_SET = Kind("apps/v1", "ReplicaSet", "replicasets", namespaced=True)
DISRUPTION_BUDGET = Kind("policy/v1", "PodDisruptionBudget", "poddisruptionbudgets", namespaced=True)
NETWORK_POLICY = Kind("networking.k8s.io/v1", "NetworkPolicy", "networkpolicies", namespaced=True)
CONTROLLER_REVISION = Kind("apps/v1", "ControllerRevision", "controllerrevisions", namespaced=True)
ENDPOINT_SLICE = Kind("discovery.k8s.io/v1", "EndpointSlice", "endpointslices", namespaced=True)
ROLE = Kind("rbac.authorization.k8s.io/v1", "Role", "roles", namespaced=True)
ROLE_BINDING = Kind("rbac.authorization.k8s.io/v1", "RoleBinding", "rolebindings", namespaced=True)
SIGNING_REQUEST = Kind("certificates.k8s.io/v1", "CertificateSigningRequest", "certificatesigningrequests", False)

CHILDREN: tuple[Kind, ...] = (
    GRANT,
    DEPLOYMENT_PLAN,
    SERVICE,
    ENDPOINT_SLICE,
    NETWORK_POLICY,
    DISRUPTION_BUDGET,
    DEPLOYMENT,
    DIRECT_LINK,
)
"""What the operator makes for an Application and follows, in the order in which it is applied; Secrets it writes and cannot read."""

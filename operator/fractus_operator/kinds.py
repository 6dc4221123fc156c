"""Kubernetes kinds that the operator reads or writes, with their REST paths."""

from __future__ import annotations

from fractus_core.api import (
    API_VERSION,
    Application,
    ApplicationTemplate,
    DeploymentPlan,
    Depot,
    DirectLink,
    Drone,
    EdgeNode,
    FlightPlan,
    Grant,
    NodeGrants,
    Policy,
    Resource,
    Zone,
)
from fractus_runtime.kubernetes import Body, Key, Kind, key_of

__all__ = ["Body", "Key", "Kind", "key_of"]


def _fractus_kind(model: type[Resource]) -> Kind:
    return Kind(API_VERSION, model.KIND, model.PLURAL, model.NAMESPACED)


APPLICATION = _fractus_kind(Application)
APPLICATION_TEMPLATE = _fractus_kind(ApplicationTemplate)
FLIGHT_PLAN = _fractus_kind(FlightPlan)
DEPLOYMENT_PLAN = _fractus_kind(DeploymentPlan)
GRANT = _fractus_kind(Grant)
NODE_GRANTS = _fractus_kind(NodeGrants)
DIRECT_LINK = _fractus_kind(DirectLink)
DRONE = _fractus_kind(Drone)
EDGE_NODE = _fractus_kind(EdgeNode)
DEPOT = _fractus_kind(Depot)
ZONE = _fractus_kind(Zone)
POLICY = _fractus_kind(Policy)

NODE = Kind("v1", "Node", "nodes", namespaced=False)
NAMESPACE = Kind("v1", "Namespace", "namespaces", namespaced=False)
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
"""Kinds of child objects that the operator creates for an Application and watches, in the order in which it applies them.

Secrets are missing because the operator may write but not read them.
"""

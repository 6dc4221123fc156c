"""The kinds of objects the operator touches, and where the API server keeps them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from fractus_core.api import (
    API_VERSION,
    Application,
    DeploymentPlan,
    Depot,
    Drone,
    EdgeNode,
    Grant,
    Policy,
    Resource,
    Zone,
)

Body = dict[str, Any]
"""An object as the API server gives and takes it."""

Key = tuple[str, str]
"""(namespace, name); the namespace is empty for cluster-scoped objects."""


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of object and its place in the REST API."""

    api_version: str
    name: str
    plural: str
    namespaced: bool

    def path(self, namespace: str = "", name: str = "", subresource: str = "") -> str:
        """Path of a collection (no name), an object, or one of its subresources."""
        root = "/apis/" if "/" in self.api_version else "/api/"
        parts = [root + self.api_version]
        if self.namespaced and namespace:
            parts += ["namespaces", namespace]
        parts += [part for part in (self.plural, name, subresource) if part]
        return "/".join(parts)

    def header(self, name: str, namespace: str = "", **metadata: Any) -> Body:
        """The beginning of an object of this kind."""
        meta: Body = {"name": name, **metadata}
        if self.namespaced:
            meta["namespace"] = namespace
        return {"apiVersion": self.api_version, "kind": self.name, "metadata": meta}


def _ours(model: type[Resource]) -> Kind:
    return Kind(API_VERSION, model.KIND, model.PLURAL, model.NAMESPACED)


APPLICATION = _ours(Application)
DEPLOYMENT_PLAN = _ours(DeploymentPlan)
GRANT = _ours(Grant)
DRONE = _ours(Drone)
EDGE_NODE = _ours(EdgeNode)
DEPOT = _ours(Depot)
ZONE = _ours(Zone)
POLICY = _ours(Policy)

NODE = Kind("v1", "Node", "nodes", namespaced=False)
POD = Kind("v1", "Pod", "pods", namespaced=True)
SERVICE = Kind("v1", "Service", "services", namespaced=True)
SECRET = Kind("v1", "Secret", "secrets", namespaced=True)
CONFIG_MAP = Kind("v1", "ConfigMap", "configmaps", namespaced=True)
LEASE = Kind("coordination.k8s.io/v1", "Lease", "leases", namespaced=True)
EVENT = Kind("v1", "Event", "events", namespaced=True)
DEPLOYMENT = Kind("apps/v1", "Deployment", "deployments", namespaced=True)
ENDPOINT_SLICE = Kind("discovery.k8s.io/v1", "EndpointSlice", "endpointslices", namespaced=True)
SIGNING_REQUEST = Kind("certificates.k8s.io/v1", "CertificateSigningRequest", "certificatesigningrequests", False)

CHILDREN: tuple[Kind, ...] = (GRANT, DEPLOYMENT_PLAN, SECRET, SERVICE, ENDPOINT_SLICE, DEPLOYMENT)
"""What the operator makes for an Application, in the order in which it is applied."""


def key_of(body: Body) -> Key:
    """The key of an object."""
    metadata = body["metadata"]
    return (metadata.get("namespace", ""), metadata["name"])

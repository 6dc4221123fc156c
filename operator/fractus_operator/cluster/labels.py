"""Labels, annotations and names of the objects that Fractus makes."""

from __future__ import annotations

from fractus_core.api import GROUP, Component
from fractus_core.api.names import object_name, shortened

APPLICATION_LABEL = f"{GROUP}/application"
COMPONENT_LABEL = f"{GROUP}/component"
INSTANCE_LABEL = f"{GROUP}/instance"
PLACEMENT_LABEL = f"{GROUP}/placement"
NAMESPACE_LABEL = f"{GROUP}/namespace"
"""On Grants, which are cluster-scoped: the namespace of their application."""

MANAGED_LABEL = "app.kubernetes.io/managed-by"
MANAGED_BY = "fractus"
MANAGED_SELECTOR = f"{MANAGED_LABEL}={MANAGED_BY},{APPLICATION_LABEL}"

SLICE_LABEL = "endpointslice.kubernetes.io/managed-by"
SLICES_BY = "operator.fractus.dev"
"""On EndpointSlices: who sees to them. Kubernetes leaves those alone that have another value than its own."""

DIGEST_ANNOTATION = f"{GROUP}/applied"
"""Digest of what was applied last, so that an unchanged object is not written again."""

CAUSE_ANNOTATION = f"{GROUP}/cause"
"""On Deployments: DIGEST@NODE, of what the manifest says of the component, and the node that it is made for."""

CERTIFICATE_ANNOTATION = f"{GROUP}/certificate"
"""On Deployments: the public half of what is in the Secret of the instance, base64 of the certificate and of its authority's."""

FINISHED_LABEL = f"{GROUP}/finished"
"""On pods that are stopped, and kept for their logs: since when, as FINISHED_FORMAT."""

FINISHED_FORMAT = "%Y%m%dT%H%M%SZ"

FINALIZER = f"{GROUP}/teardown"
DEPOT_LABEL = f"{GROUP}/depot"
GEOHASH_LABEL = f"{GROUP}/geohash"
INTERFACE_LABEL = f"{GROUP}/interface-"
GUARDED_LABEL = f"{GROUP}/guarded"
"""On Nodes: its taint keeps also pods away that name it, so that no admission policy has to look for its name in every pod."""

LEASE_NAME = "fractus-operator"
"""Of the Lease by which one operator acts."""


def is_location_label(name: str) -> bool:
    """Whether a label of a Node says where it is, or that it is guarded: the operator's own."""
    return name in {DEPOT_LABEL, GEOHASH_LABEL, GUARDED_LABEL} or name.startswith(INTERFACE_LABEL)


def secret_name(instance: str) -> str:
    """Name of the Secret of an instance."""
    return f"{instance}-tls"


def service_name(application: str, component: Component) -> str:
    """Name of the Service of a component."""
    return object_name(application, component.slug)


def grant_name(namespace: str, instance: str) -> str:
    """Name of the Grant of an instance: instance names are unique within a namespace, and neither part has a dot."""
    return f"{namespace}.{instance}"


def label_value(text: str) -> str:
    """The text as a label value, which has at most 63 characters; another one for every text."""
    return shortened(text, 63)


def labelled(key: tuple[str, str]) -> tuple[str, str]:
    """The key (namespace, name) of an application as the labels of its objects spell it."""
    return key[0], label_value(key[1])

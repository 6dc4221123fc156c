"""Labels, annotations and names of the objects that Fractus creates, and the metadata that they share."""

from __future__ import annotations

from typing import Any

from fractus_core.api import API_VERSION, GROUP, Application, Component
from fractus_core.api.names import object_name, shortened

from fractus_operator.kinds import Body, Kind

APPLICATION_LABEL = f"{GROUP}/application"
COMPONENT_LABEL = f"{GROUP}/component"
INSTANCE_LABEL = f"{GROUP}/instance"
PLACEMENT_LABEL = f"{GROUP}/placement"
NAMESPACE_LABEL = f"{GROUP}/namespace"
"""Label of cluster-scoped objects: namespace of their Application."""

MANAGED_LABEL = "app.kubernetes.io/managed-by"
MANAGED_BY = "fractus"
MANAGED_SELECTOR = f"{MANAGED_LABEL}={MANAGED_BY},{APPLICATION_LABEL}"

SLICE_LABEL = "endpointslice.kubernetes.io/managed-by"
SLICES_BY = "operator.fractus.dev"
"""Label value of EndpointSlices that the operator manages. Kubernetes ignores slices with a value other than its own."""

SIDECAR = "fractus-mavlink"
"""Name of the sidecar container that connects a MAVLink program to the gateway of its drone."""

DIGEST_ANNOTATION = f"{GROUP}/applied"
"""Annotation with the digest of the object as last applied, so that an unchanged object is not written again."""

CAUSE_ANNOTATION = f"{GROUP}/cause"
"""Annotation of Deployments: DIGEST@NODE, with the digest of the component in the manifest."""

CERTIFICATE_ANNOTATION = f"{GROUP}/certificate"
"""Annotation of Deployments: the public part of the Secret of the instance.

The value is the instance certificate and the CA certificate, each in base64, joined by a dot.
"""

FINISHED_LABEL = f"{GROUP}/finished"
"""Label of stopped pods that are kept for their logs: time of the stop, in FINISHED_FORMAT."""

FINISHED_FORMAT = "%Y%m%dT%H%M%SZ"

FINALIZER = f"{GROUP}/teardown"

LANDING_FINALIZER = f"{GROUP}/landing"
"""Finalizer of FlightPlans whose drones may fly. It keeps the reserved airspace until the landing."""

DEPOT_LABEL = f"{GROUP}/depot"
GEOHASH_LABEL = f"{GROUP}/geohash"
INTERFACE_LABEL = f"{GROUP}/interface-"
GUARDED_LABEL = f"{GROUP}/guarded"
"""Label of Nodes whose taint also keeps away pods that name the Node.

Admission policies then need not search every pod for the name of such a Node.
"""

LEASE_NAME = "fractus-operator"
"""Name of the Lease that the leading operator holds."""


def is_location_label(name: str) -> bool:
    """Return True if the operator manages this label of Nodes."""
    return name in {DEPOT_LABEL, GEOHASH_LABEL, GUARDED_LABEL} or name.startswith(INTERFACE_LABEL)


def secret_name(instance: str) -> str:
    """Return the name of the Secret of an instance."""
    return f"{instance}-tls"


def service_name(application: str, component: Component) -> str:
    """Return the name of the Service of a component."""
    return object_name(application, component.slug)


def grant_name(namespace: str, instance: str) -> str:
    """Return the name of the Grant of an instance.

    The name is unique: instance names are unique within a namespace, and neither part contains a dot.
    """
    return f"{namespace}.{instance}"


def label_value(text: str) -> str:
    """Return the text as a label value of at most 63 characters. Different texts have different values."""
    return shortened(text, 63)


def label_key(key: tuple[str, str]) -> tuple[str, str]:
    """Return the key of an Application with its name as a label value."""
    return key[0], label_value(key[1])


def application_labels(application: Application) -> dict[str, str]:
    """Return the labels that every object of an Application has."""
    return {APPLICATION_LABEL: label_value(application.name), MANAGED_LABEL: MANAGED_BY}


def owned_object(kind: Kind, application: Application, name: str, extra_labels: dict[str, str], **content: Any) -> Body:
    """Return a namespaced object that an Application owns.

    Args:
        kind: Kind of the object.
        application: Owner of the object.
        name: Name of the object.
        extra_labels: Labels in addition to the labels of every object of the Application.
        content: Fields of the object other than its metadata.
    """
    namespace, _ = application.key
    body = kind.header(name, namespace)
    body["metadata"]["labels"] = {**application_labels(application), **extra_labels}
    body["metadata"]["ownerReferences"] = [
        {
            "apiVersion": API_VERSION,
            "kind": Application.KIND,
            "name": application.name,
            "uid": application.metadata.uid or "",
            "controller": True,
            "blockOwnerDeletion": True,
        }
    ]
    return {**body, **content}

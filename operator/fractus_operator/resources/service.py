"""Builders of the Services of components and of the EndpointSlices of hybrid components."""

from __future__ import annotations

from collections.abc import Iterable

from fractus_core.api import Application, Component
from fractus_core.api.plans import DeploymentPlanSpec

from fractus_operator import kinds, labels
from fractus_operator.kinds import Body
from fractus_operator.labels import label_value, owned_object, service_name
from fractus_operator.pods import PodView


def service(application: Application, component: Component) -> Body:
    """Return the Service of a component.

    The Service of a hybrid component has no selector. The operator manages its EndpointSlice.
    """
    spec: Body = {
        "type": "ClusterIP",
        "ports": [
            {"name": p.label, "port": p.port, "targetPort": p.port, "protocol": p.protocol}
            for p in component.container.ports
        ],
    }
    if component.placement != "hybrid":
        spec["selector"] = {
            labels.APPLICATION_LABEL: label_value(application.name),
            labels.COMPONENT_LABEL: component.name,
        }
    name = service_name(application.name, component)
    return owned_object(kinds.SERVICE, application, name, {labels.COMPONENT_LABEL: component.name}, spec=spec)


def endpoint_slice(
    application: Application, component: Component, plan: DeploymentPlanSpec, pods: Iterable[PodView]
) -> Body:
    """Return the EndpointSlice of a hybrid component, with the ready pods of its cloud base.

    Args:
        application: Application of the component.
        component: The hybrid component.
        plan: Plan of the Application.
        pods: Pods of the Application.
    """
    name = service_name(application.name, component)
    ready = endpoints(component.name, plan, pods)
    slice_labels = {
        labels.COMPONENT_LABEL: component.name,
        "kubernetes.io/service-name": name,
        labels.SLICE_LABEL: labels.SLICES_BY,
    }
    return owned_object(
        kinds.ENDPOINT_SLICE,
        application,
        name,
        slice_labels,
        addressType="IPv6" if any(":" in endpoint["addresses"][0] for endpoint in ready) else "IPv4",
        endpoints=ready,
        ports=[{"name": p.label, "port": p.port, "protocol": p.protocol} for p in component.container.ports],
    )


def endpoints(component: str, plan: DeploymentPlanSpec, pods: Iterable[PodView]) -> list[Body]:
    """Return the endpoints of a hybrid component: the pods of its cloud base that take calls."""
    bases = {p.instance for p in plan.placements if p.component == component and p.role == "cloud"}
    return [
        {
            "addresses": [pod.ip],
            "conditions": {"ready": True, "serving": True, "terminating": False},
            "nodeName": pod.node,
            "targetRef": {"kind": "Pod", "namespace": pod.namespace, "name": pod.name},
        }
        for pod in sorted(pods, key=lambda pod: pod.name)
        if pod.instance in bases and pod.takes_calls
    ]

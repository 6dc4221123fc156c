"""From declared relations to NetworkPolicies: who may call a component, and over which path (thesis 8.8)."""

from __future__ import annotations

from fractus_core.api import Application, Component
from fractus_core.api.plans import DeploymentPlanSpec

from fractus_operator.cluster import kinds, labels
from fractus_operator.cluster.kinds import Body
from fractus_operator.cluster.labels import label_value, service_name
from fractus_operator.reconcile.builders import child

LINK_NETWORK = "169.254.0.0/16"
"""Where direct links have their addresses: what comes over one is let through by the node's agent only for its peer."""


def network_policies(application: Application, plan: DeploymentPlanSpec) -> list[Body]:
    """The NetworkPolicies of an application; none for a component that names no caller, which others may call.

    The instances of a hybrid component on edge nodes are reached over direct links alone: callers that have none come to the
    cloud base, whose address is the Service's.
    """
    policies = []
    for component in application.spec.components:
        callers = sorted(application.spec.callers(component.name))
        if not component.container.ports or not callers:
            continue
        called = {labels.APPLICATION_LABEL: label_value(application.name)}
        sender: Body = {
            "podSelector": {
                "matchLabels": called,
                "matchExpressions": [{"key": labels.COMPONENT_LABEL, "operator": "In", "values": callers}],
            }
        }
        selector: Body = {"matchLabels": {**called, labels.COMPONENT_LABEL: component.name}}
        name = service_name(application.name, component)
        placed = (p for p in plan.placements if p.component == component.name and p.placement == "hybrid")
        edges = sorted(p.instance for p in placed if p.role != "cloud")
        if edges:
            at_edge = {"key": labels.INSTANCE_LABEL, "operator": "In", "values": edges}
            selector["matchExpressions"] = [{**at_edge, "operator": "NotIn"}]
            over_links = {"matchLabels": selector["matchLabels"], "matchExpressions": [at_edge]}
            link: Body = {"ipBlock": {"cidr": LINK_NETWORK}}
            policies.append(_policy(application, component, f"{name}.edge", over_links, link))
        policies.append(_policy(application, component, name, selector, sender))
    return policies


def _policy(application: Application, component: Component, name: str, selector: Body, sender: Body) -> Body:
    spec = {"podSelector": selector, "policyTypes": ["Ingress"], "ingress": [{"from": [sender]}]}
    return child(kinds.NETWORK_POLICY, application, name, {labels.COMPONENT_LABEL: component.name}, spec=spec)

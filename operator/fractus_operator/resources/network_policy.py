"""Builders of NetworkPolicies: which components may call a component, and over which path (thesis section 8.8)."""

from __future__ import annotations

from fractus_core.api import Application
from fractus_core.api.plans import DeploymentPlanSpec

from fractus_operator import kinds, labels
from fractus_operator.kinds import Body
from fractus_operator.labels import label_value, owned_object, service_name

LINK_NETWORK = "169.254.0.0/16"
"""Addresses of direct links. The agent of the node accepts traffic over a link only from its peer."""


def network_policies(application: Application, plan: DeploymentPlanSpec) -> list[Body]:
    """Return the NetworkPolicies of an Application.

    A component without declared callers may be called by all, so it has no NetworkPolicy. Instances of a hybrid component
    on edge nodes are reached only over direct links. Callers without a link call the cloud base through its Service.
    """
    policies: list[Body] = []
    for component in application.spec.components:
        callers = sorted(application.spec.callers(component.name))
        if not component.container.ports or not callers:
            continue
        same_application = {labels.APPLICATION_LABEL: label_value(application.name)}
        sender: Body = {
            "podSelector": {
                "matchLabels": same_application,
                "matchExpressions": [{"key": labels.COMPONENT_LABEL, "operator": "In", "values": callers}],
            }
        }
        selector: Body = {"matchLabels": {**same_application, labels.COMPONENT_LABEL: component.name}}
        name = service_name(application.name, component)
        ingress = {name: (selector, sender)}
        placed = (p for p in plan.placements if p.component == component.name and p.placement == "hybrid")
        edges = sorted(p.instance for p in placed if p.role != "cloud")
        if edges:
            at_edge = {"key": labels.INSTANCE_LABEL, "operator": "In", "values": edges}
            selector["matchExpressions"] = [{**at_edge, "operator": "NotIn"}]
            over_links = {"matchLabels": selector["matchLabels"], "matchExpressions": [at_edge]}
            link: Body = {"ipBlock": {"cidr": LINK_NETWORK}}
            ingress = {f"{name}.edge": (over_links, link), **ingress}
        component_label = {labels.COMPONENT_LABEL: component.name}
        for policy_name, (pods, source) in ingress.items():
            spec = {"podSelector": pods, "policyTypes": ["Ingress"], "ingress": [{"from": [source]}]}
            policies.append(owned_object(kinds.NETWORK_POLICY, application, policy_name, component_label, spec=spec))
    return policies

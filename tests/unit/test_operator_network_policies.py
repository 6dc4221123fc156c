"""NetworkPolicies of components. The tests evaluate the policies like a network plug-in."""

from __future__ import annotations

import copy
from ipaddress import ip_address, ip_network
from typing import Any

import pytest
from fractus_core.api import Application
from fractus_operator.resources.deployment import deployment
from fractus_operator.resources.network_policy import network_policies
from test_link_builders import APPLICATION, INPUT, PLAN

Body = dict[str, Any]
PODS = {
    placed.instance: deployment(APPLICATION, placed)["spec"]["template"]["metadata"]["labels"]
    for placed in PLAN.placements
}
STRANGER = {"fractus.dev/application": "other", "fractus.dev/component": "AerialViewer"}


def selects(selector: Body, labels: Body) -> bool:
    required = selector.get("matchLabels", {}).items()
    tests = {"In": lambda value, values: value in values, "NotIn": lambda value, values: value not in values}
    return all(labels.get(key) == value for key, value in required) and all(
        tests[e["operator"]](labels.get(e["key"]), e["values"]) for e in selector.get("matchExpressions", ())
    )


def may_call(application: Application, sender: Body | str, instance: str) -> bool:
    """Return True if a pod with the given labels, or an address, may call an instance."""
    policies = [
        p["spec"] for p in network_policies(application, PLAN) if selects(p["spec"]["podSelector"], PODS[instance])
    ]
    rules = [peer for spec in policies for rule in spec["ingress"] for peer in rule["from"]]
    if isinstance(sender, str):
        blocks = [ip_network(peer["ipBlock"]["cidr"]) for peer in rules if "ipBlock" in peer]
        return not policies or any(ip_address(sender) in block for block in blocks)
    return not policies or any(selects(peer["podSelector"], sender) for peer in rules if "podSelector" in peer)


BASE = "traffic-image-checker"
EDGE = "traffic-image-checker-edge-1"


def test_network_policy_allows_only_callers_to_cloud_base() -> None:
    assert may_call(APPLICATION, PODS["traffic-aerial-viewer"], BASE)
    assert not may_call(APPLICATION, PODS["traffic-navigator"], BASE)
    assert not may_call(APPLICATION, STRANGER, BASE)
    assert not may_call(APPLICATION, "169.254.7.7", BASE)


def test_edge_instances_are_reached_only_over_direct_links() -> None:
    assert may_call(APPLICATION, "169.254.7.7", EDGE)
    assert not may_call(APPLICATION, "10.1.0.7", EDGE)
    assert not may_call(APPLICATION, PODS["traffic-aerial-viewer"], EDGE)
    assert not may_call(APPLICATION, STRANGER, EDGE)


def test_component_without_callers_has_no_network_policy() -> None:
    body = copy.deepcopy(INPUT["application"])
    body["spec"]["components"][0]["container"]["ports"] = [{"port": 9000}]
    application = Application.from_body(body)
    assert may_call(application, STRANGER, "traffic-navigator")
    assert not may_call(application, STRANGER, BASE)


@pytest.mark.parametrize(("field", "component"), [("egress", "Navigator"), ("ingress", "ImageChecker")])
def test_caller_may_be_declared_by_either_component(field: str, component: str) -> None:
    body = copy.deepcopy(INPUT["application"])
    part = next(c for c in body["spec"]["components"] if c["name"] == component)
    part[field] = ["ImageChecker" if field == "egress" else "Navigator"]
    application = Application.from_body(body)
    assert may_call(application, PODS["traffic-navigator"], BASE)
    assert may_call(application, PODS["traffic-aerial-viewer"], BASE)


def test_network_policies_have_different_names() -> None:
    body = copy.deepcopy(INPUT["application"])
    twin = copy.deepcopy(next(c for c in body["spec"]["components"] if c["name"] == "ImageChecker"))
    body["spec"]["components"].append({**twin, "name": "ImageCheckerEdge", "ingress": ["AerialViewer"]})
    names = [p["metadata"]["name"] for p in network_policies(Application.from_body(body), PLAN)]
    assert names == ["traffic-image-checker.edge", "traffic-image-checker", "traffic-image-checker-edge"]

"""DirectLinks built from a plan, compared with a golden file. Run with FRACTUS_GOLDEN=write to update it."""

from __future__ import annotations

import copy
import os
from pathlib import Path
from typing import Any

import pytest
import yaml
from fractus_core.api import Application, Depot, DirectLink, Drone, EdgeNode
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.planning.link_planning import flown_path, plan_links
from fractus_operator.pods import PodView
from fractus_operator.resources.direct_link import direct_links, link_name, retargeted

GOLDEN = Path(__file__).parents[1] / "golden" / "links"
INPUT = yaml.safe_load((GOLDEN / "input.yaml").read_text())
APPLICATION = Application.from_body(INPUT["application"])
PLAN = DeploymentPlanSpec.model_validate(INPUT["plan"])
DRONE = Drone.from_body(INPUT["drone"])
EDGES = {node.name: node for node in map(EdgeNode.from_body, INPUT["edgeNodes"])}
DEPOTS = {depot.name: depot for depot in map(Depot.from_body, INPUT["depots"])}
PLANNED = plan_links(APPLICATION, PLAN, DRONE, EDGES)
PATH = flown_path(APPLICATION.spec, DEPOTS)


def pod(name: str, ip: str | None, *, ready: bool = True, terminating: bool = False) -> PodView:
    labels = {"fractus.dev/instance": "traffic-image-checker-edge-1"}
    return PodView("city", name, "edge-1", labels, {}, ready=ready, finished=False, terminating=terminating, ip=ip)


def links(*pods: PodView, cluster_ip: str | None = "10.96.0.7") -> dict[str, Any]:
    bodies = direct_links(APPLICATION, PLAN, PLANNED, PATH, pods, cluster_ip={"traffic-image-checker": cluster_ip}.get)
    return {body["spec"]["node"]: body for body in bodies}


def target(*pods: PodView) -> object:
    return links(*pods)["edge-1"]["spec"]["services"][0].get("target")


def test_direct_links_match_golden_file() -> None:
    built = list(links(pod("a", "10.1.0.5")).values())
    path = GOLDEN / "expected.yaml"
    if os.environ.get("FRACTUS_GOLDEN") == "write":
        path.write_text(yaml.safe_dump_all(built, sort_keys=False, width=120))
    assert built == list(yaml.safe_load_all(path.read_text()))
    for body in built:
        assert DirectLink.from_body(body).spec.to_dict() == body["spec"]


def test_direct_link_target_is_ready_pod() -> None:
    old = pod("a", "10.1.0.5", terminating=True)
    new = pod("b", "10.1.0.6")
    assert target(old, new) == {"address": "10.1.0.6", "port": 8080}
    assert target(new, pod("c", "10.1.0.7", ready=False), pod("d", None)) == {"address": "10.1.0.6", "port": 8080}
    assert target(old) is None
    assert "target" not in links(pod("b", "10.1.0.6"))["edge-2"]["spec"]["services"][0], (
        "the target is not a pod of another node"
    )


def caller(*pods: PodView) -> object:
    return links(*pods)["edge-1"]["spec"]["services"][0]["callers"]


def test_direct_link_callers_are_pods_on_drone_with_access() -> None:
    def viewer(name: str, ip: str | None, **state: bool) -> PodView:
        state = {"ready": False, "finished": False, "terminating": False} | state
        return PodView("city", name, "drone-1", {"fractus.dev/instance": "traffic-aerial-viewer"}, {}, ip=ip, **state)

    old = viewer("a", "10.2.0.5", terminating=True)
    new = viewer("b", "10.2.0.6")
    assert caller(viewer("a", None)) == [{"instance": "traffic-aerial-viewer"}]
    assert caller(old, new) == [{"instance": "traffic-aerial-viewer", "address": "10.2.0.6"}], (
        "the address of the new pod replaces that of the terminating pod"
    )
    assert caller(old, viewer("b", "10.2.0.6", finished=True)) == [
        {"instance": "traffic-aerial-viewer", "address": "10.2.0.5"}
    ]
    assert retargeted(links(old)["edge-1"]["spec"]["services"], [new])[0]["callers"] == caller(new)


def test_direct_link_has_no_callers_field_when_component_names_no_callers() -> None:
    body = copy.deepcopy(INPUT["application"])
    viewer = next(c for c in body["spec"]["components"] if c["name"] == "AerialViewer")
    del viewer["egress"]
    (first, *_) = direct_links(
        Application.from_body(body), PLAN, PLANNED, PATH, [], cluster_ip={"traffic-image-checker": "10.96.0.7"}.get
    )
    assert "callers" not in first["spec"]["services"][0]


def test_direct_link_is_not_created_without_service_address() -> None:
    assert links(pod("a", "10.1.0.5"), cluster_ip=None) == {}


@pytest.mark.parametrize("other", [
    ("city", "traffic", "drone-1", "edge-2"), ("city", "traffic", "drone-2", "edge-1"), ("city", "b", "drone-1", "edge-1"),
    ("town", "traffic", "drone-1", "edge-1"), ("city", "traffic-drone", "1", "edge-1"), ("city", "traffic", "drone-1-edge", "1"),
])  # fmt: skip
def test_direct_link_names_are_unique(other: tuple[str, str, str, str]) -> None:
    assert link_name("city", "traffic", "drone-1", "edge-1") != link_name(*other)

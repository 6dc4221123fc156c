"""Builders of child objects, compared with golden files. Run with FRACTUS_GOLDEN=write to update them."""

from __future__ import annotations

import copy
import os
from pathlib import Path
from typing import Any

import pytest
import yaml
from fractus_core.api import Application, Drone
from fractus_core.api.grants import ApplicationReference, GrantSpec
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_operator import kinds
from fractus_operator.pods import PodView, parse_pod
from fractus_operator.resources.children import children, deployment_plan
from fractus_operator.resources.deployment import deployment
from fractus_operator.resources.grant import grant
from fractus_operator.resources.secret import tls_secret
from fractus_operator.resources.service import endpoint_slice, service

GOLDEN = Path(__file__).parents[1] / "golden" / "operator"
INPUT = yaml.safe_load((GOLDEN / "input.yaml").read_text())
APPLICATION = Application.from_body(INPUT["application"])
PLAN = DeploymentPlanSpec.model_validate(INPUT["plan"])
DRONE = Drone.from_body(INPUT["drone"])


def _over_mavlink() -> Application:
    """Return the Application with a Navigator that is a MAVLink program."""
    body = copy.deepcopy(INPUT["application"])
    navigator = next(c for c in body["spec"]["components"] if c["name"] == "Navigator")
    used = next(s for s in navigator["services"] if s["service"] == "mobility")
    used["interfaces"] = ["mavlink"]
    return Application.from_body(body)


MAVLINK = _over_mavlink()


def pod(name: str, ip: str | None, *, ready: bool = True, terminating: bool = False) -> PodView:
    labels = {"fractus.dev/instance": "traffic-image-checker"}
    return PodView("city", name, "cloud-1", labels, {}, ready=ready, finished=False, terminating=terminating, ip=ip)


def built() -> dict[str, Any]:
    placed = {p.instance: p for p in PLAN.placements}
    spec = GrantSpec(
        node="drone-1",
        application=ApplicationReference(namespace="city", name="traffic", uid=APPLICATION.metadata.uid or ""),
        component="Navigator",
        instance="traffic-navigator",
        **{"class": "driver"},
    )
    checker = APPLICATION.spec.component("ImageChecker")
    data = {"tls.crt": "Y2VydA==", "tls.key": "a2V5", "ca.crt": "Y2E="}
    objects = {
        f"deployment-{name}": deployment(APPLICATION, p, DRONE if p.node == "drone-1" else None)
        for name, p in placed.items()
    }
    return objects | {
        "deployment-mavlink": deployment(MAVLINK, placed["traffic-navigator"], DRONE, "registry.test/mobility:1"),
        "plan": deployment_plan(APPLICATION, PLAN),
        "grant": grant(APPLICATION, spec),
        "secret": tls_secret(APPLICATION, placed["traffic-navigator"], data),
        "service-hybrid": service(APPLICATION, checker),
        "service-cloud": service(APPLICATION, APPLICATION.spec.component("DataStore")),
        "endpoints": endpoint_slice(
            APPLICATION,
            checker,
            PLAN,
            [
                pod("b", "10.0.0.2"),
                pod("a", "10.0.0.1"),
                pod("c", "10.0.0.3", ready=False),
                pod("d", "10.0.0.4", terminating=True),
                pod("e", None),
            ],
        ),
    }


BUILT = built()


@pytest.mark.parametrize("name", sorted(BUILT))
def test_objects_match_golden_files(name: str) -> None:
    path = GOLDEN / "expected" / f"{name}.yaml"
    if os.environ.get("FRACTUS_GOLDEN") == "write":
        path.parent.mkdir(exist_ok=True)
        path.write_text(yaml.safe_dump(BUILT[name], sort_keys=False, width=120))
    assert BUILT[name] == yaml.safe_load(path.read_text())


def test_every_golden_file_has_an_object() -> None:
    assert {path.stem for path in (GOLDEN / "expected").glob("*.yaml")} == set(BUILT)


@pytest.mark.parametrize("instance", [p.instance for p in PLAN.placements])
def test_pods_have_no_privileges(instance: str) -> None:
    spec = BUILT[f"deployment-{instance}"]["spec"]["template"]["spec"]
    security = spec["containers"][0]["securityContext"]
    assert spec["automountServiceAccountToken"] is False
    assert spec["securityContext"]["runAsNonRoot"] is True
    assert spec["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    assert security["capabilities"] == {"drop": ["ALL"]}
    assert (security["allowPrivilegeEscalation"], security["readOnlyRootFilesystem"]) == (False, True)
    assert "nodeName" not in spec


def test_manifest_cannot_override_system_variables() -> None:
    env = BUILT["deployment-traffic-navigator"]["spec"]["template"]["spec"]["containers"][0]["env"]
    names = [variable["name"] for variable in env]
    assert len(names) == len(set(names))
    assert next(v for v in env if v["name"] == "FRACTUS_NODE")["valueFrom"]["fieldRef"]["fieldPath"] == "spec.nodeName"
    assert {"name": "SPEED", "value": "5"} in env


def test_drone_without_autonomy_limit_tolerates_taints_forever() -> None:
    placed = PLAN.placements[0]
    bare = Drone.from_body({**INPUT["drone"], "spec": {}})
    tolerations = deployment(APPLICATION, placed, bare)["spec"]["template"]["spec"]["tolerations"]
    assert all("tolerationSeconds" not in t for t in tolerations)
    assert {t["key"] for t in tolerations} >= {"node.kubernetes.io/unreachable", "node.kubernetes.io/not-ready"}


def test_disruption_budget_protects_all_instances_on_drone_without_their_controllers() -> None:
    (budget,) = children(APPLICATION, PLAN, [], [], lambda _: DRONE)[kinds.DISRUPTION_BUDGET]
    on_drone = [p for p in PLAN.placements if p.placement == "drone"]
    assert budget["spec"]["minAvailable"] == len(on_drone) > 0
    # Kubernetes looks up controllers, which kept pods do not have, for maxUnavailable and for percentages.
    assert "maxUnavailable" not in budget["spec"]


def test_only_components_with_the_interface_mavlink_get_a_sidecar() -> None:
    for placed in PLAN.placements:
        pod_spec = deployment(MAVLINK, placed, None, "registry.test/mobility:1")["spec"]["template"]["spec"]
        assert ("initContainers" in pod_spec) == (placed.component == "Navigator")


def test_sidecar_that_cannot_start_is_the_problem_of_its_pod() -> None:
    waiting = {"state": {"waiting": {"reason": "ErrImagePull", "message": "not found"}}}
    body = {"metadata": {"namespace": "city", "name": "a"}, "spec": {}, "status": {"initContainerStatuses": [waiting]}}
    assert parse_pod(body).failure.startswith("fractus-mavlink: ErrImagePull: not found; push the image")

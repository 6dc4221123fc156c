"""Running Applications with a problem: policies still reach their Grants, and the Applications keep their drones."""

from __future__ import annotations

import copy
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import pytest
from control_plane import wait_for
from fractus_runtime.kubernetes import KubeError
from operator_world import FRACTUS, OperatorProcess, World, at, fractus_object, navigator, traffic
from test_operator import deployed, end_mission, gone, running

Body = dict[str, Any]
LOW = {"type": "LimitControl", "kind": "altitude", "upperLimit": 15}
UNREADABLE = LOW | {"validFrom": "0000-01-01T00:00:00Z"}
"""Policy with the year 0, which an older release accepted."""


def granted(world: World, namespace: str, instance: str = "traffic-navigator") -> list[str]:
    """Return the names of the policies in a Grant."""
    grant = world.api.get(f"{FRACTUS}/grants/{namespace}.{instance}") or {"spec": {}}
    return [policy["name"] for policy in grant["spec"].get("policies", [])]


def reason(world: World, namespace: str, expected: str, name: str = "traffic") -> Body:
    """Wait until the condition Ready has this reason, and return the condition."""

    def reached() -> Body | None:
        condition = world.condition(namespace, "Ready", name)
        return condition if condition.get("reason") == expected else None

    return wait_for(reached, lambda: f"{expected}, but it is {world.status(namespace, name)}")


@contextmanager
def older_policies(world: World) -> Iterator[None]:
    """Install the kind Policy of an older release, which did not validate times."""
    path = "/apis/apiextensions.k8s.io/v1/customresourcedefinitions/policies.fractus.dev"
    present = world.api.get(path)
    assert present is not None
    older = copy.deepcopy(present["spec"])
    spec = older["versions"][0]["schema"]["openAPIV3Schema"]["properties"]["spec"]
    spec["properties"]["validFrom"] = {"type": "string"}
    spec["x-kubernetes-validations"] = [
        each for each in spec["x-kubernetes-validations"] if "validFrom" not in each["rule"]
    ]
    world.api.merge(path, {"spec": older})
    try:
        yield
    finally:
        world.api.merge(path, {"spec": present["spec"]})


@contextmanager
def refusing(
    world: World, namespace: str, resource: str, operation: str, unless: str, probe: Callable[[], object]
) -> Iterator[None]:
    """Make the API server refuse an operation on the objects of a resource in one namespace.

    Args:
        unless: CEL expression that is true for objects that the API server still accepts.
        probe: Dry run of a request that must be refused. The block starts when the API server refuses it.
    """
    root = "/apis/admissionregistration.k8s.io/v1"
    name = f"refuse-{operation.lower()}-{resource}"
    rule = {"apiGroups": [""], "apiVersions": ["v1"], "resources": [resource], "operations": [operation]}
    place = {"namespaceSelector": {"matchLabels": {"kubernetes.io/metadata.name": namespace}}}
    objects = {
        f"{root}/validatingadmissionpolicies/{name}": (
            "ValidatingAdmissionPolicy",
            {"matchConstraints": {"resourceRules": [rule]}, "validations": [{"expression": unless}]},
        ),
        f"{root}/validatingadmissionpolicybindings/{name}": (
            "ValidatingAdmissionPolicyBinding",
            {"policyName": name, "validationActions": ["Deny"], "matchResources": place},
        ),
    }

    def refused() -> bool:
        try:
            probe()
        except KubeError:
            return True
        return False

    for path, (kind, spec) in objects.items():
        about = {"apiVersion": "admissionregistration.k8s.io/v1", "kind": kind, "metadata": {"name": name}}
        world.api.apply(path, about | {"spec": spec})
    try:
        wait_for(refused, "the API server to refuse the operation")
        yield
    finally:
        for path in objects:
            world.api.delete(path)


def undeletable_secrets(world: World, namespace: str) -> AbstractContextManager[None]:
    """Make the API server refuse deletions of Secrets in a namespace."""
    path = f"/api/v1/namespaces/{namespace}/secrets/traffic-navigator-tls?dryRun=All"
    return refusing(world, namespace, "secrets", "DELETE", "false", lambda: world.api.call("DELETE", path))


def unstoppable_pods(world: World, namespace: str) -> AbstractContextManager[None]:
    """Make the API server refuse pod updates that set activeDeadlineSeconds, with which the operator stops pods."""
    path = f"/api/v1/namespaces/{namespace}/pods/{world.pods(namespace)[0]['metadata']['name']}?dryRun=All"
    stopped = {"spec": {"activeDeadlineSeconds": 1}}
    without = "!has(object.spec.activeDeadlineSeconds)"
    return refusing(world, namespace, "pods", "UPDATE", without, lambda: world.api.merge(path, stopped))


def policy_ready(world: World, name: str) -> Body:
    status = (world.api.get(f"{FRACTUS}/policies/{name}") or {}).get("status") or {}
    return next((c for c in status.get("conditions") or () if c["type"] == "Ready"), {})


def let_in(world: World, body: Body) -> bool:
    """Put an object, unless the API server refuses it."""
    try:
        world.put(body)
    except KubeError:
        return False
    return True


def _infeasible(world: World, namespace: str) -> None:
    manifest = traffic(namespace)
    manifest["spec"]["components"][2]["locations"][0]["center"] = at(50_000, 0)
    world.put(manifest)


def _invalid(world: World, namespace: str) -> None:
    manifest = traffic(namespace)
    manifest["spec"]["components"][0]["controlPoints"][0]["point"] = {"depot": "bse"}
    world.put(manifest)


def _foreign_deployment(world: World, namespace: str) -> None:
    path = f"/apis/apps/v1/namespaces/{namespace}/deployments/traffic-navigator"
    world.api.merge(path, {"metadata": {"ownerReferences": None, "annotations": None}})


def _in_trouble(world: World, namespace: str, trouble: Any) -> None:
    """Run an Application, cause a problem, and wait until its condition Ready reports the problem."""
    running(world, namespace)
    trouble(world, namespace)
    wait_for(
        lambda: world.condition(namespace, "Ready").get("reason") not in (None, "PodsReady", "PodsNotReady"),
        lambda: f"the condition Ready to report the problem: {world.status(namespace)}",
    )


@pytest.mark.parametrize(
    "trouble",
    # Every trouble raises Blocked, after the Grants were refreshed. `make test` runs one case, and another one below.
    [
        pytest.param(_infeasible, marks=pytest.mark.slow),
        pytest.param(_invalid, marks=pytest.mark.slow),
        _foreign_deployment,
    ],
)
def test_policy_change_reaches_grant_of_application_in_trouble(
    world: World, operator: OperatorProcess, namespace: str, trouble: Any
) -> None:
    _in_trouble(world, namespace, trouble)
    world.put(fractus_object("Policy", "low", LOW))
    wait_for(lambda: granted(world, namespace) == ["low"], lambda: f"the policy in the Grant: {operator.log()[-3000:]}")
    world.api.delete(f"{FRACTUS}/policies/low")
    wait_for(lambda: granted(world, namespace) == [], "the removal of the policy from the Grant")


def _without_depot(world: World, namespace: str) -> None:
    world.api.delete(f"{FRACTUS}/depots/base")


@pytest.mark.parametrize(
    "trouble",
    [_infeasible, pytest.param(_invalid, marks=pytest.mark.slow), pytest.param(_without_depot, marks=pytest.mark.slow)],
)
def test_certificate_is_renewed_for_application_in_trouble(
    world: World, operator: OperatorProcess, namespace: str, trouble: Any
) -> None:
    """Certificates expire after a day. An Application may wait longer than that for a node or a correction."""
    _in_trouble(world, namespace, trouble)
    deployment = f"/apis/apps/v1/namespaces/{namespace}/deployments/traffic-navigator"
    secret = f"/api/v1/namespaces/{namespace}/secrets/traffic-navigator-tls"
    before = (world.api.get(secret) or {})["data"]["tls.crt"]
    # The operator treats an unreadable expiry as expired.
    world.api.merge(deployment, {"metadata": {"annotations": {"fractus.dev/certificate": "expired"}}})
    wait_for(lambda: (world.api.get(secret) or {})["data"]["tls.crt"] != before, lambda: operator.log()[-3000:])


def test_refreshed_grant_keeps_previous_version_of_broken_policy(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    school = fractus_object("Zone", "school", {"area": {"circle": {"center": at(30, 30), "radius": 5}}})
    world.put(school)
    fence = {"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": ["school"]}}
    world.put(fractus_object("Policy", "fence", fence))
    world.put(fractus_object("Policy", "odd", LOW))
    running(world, namespace)
    wait_for(lambda: granted(world, namespace) == ["fence", "odd"], "both policies in the Grant")
    world.api.delete(f"{FRACTUS}/zones/school")
    with older_policies(world):
        wait_for(
            lambda: let_in(world, fractus_object("Policy", "odd", UNREADABLE)), "the API server to accept the policy"
        )
    condition = wait_for(
        lambda: policy_ready(world, "odd").get("status") == "False" and policy_ready(world, "odd"),
        "the policy to be Invalid",
    )
    assert (condition["reason"], "validFrom" in condition["message"]) == ("Invalid", True)
    world.put(fractus_object("Policy", "slow", {"type": "LimitControl", "kind": "speed", "upperLimit": 3}))
    wait_for(
        lambda: granted(world, namespace) == ["fence", "odd", "slow"],
        "the new policy in the Grant, in addition to the previous policies",
    )
    assert world.status(namespace)["phase"] == "Waiting"
    # A new Application gets no grant while the scope of the unreadable policy is unknown.
    world.add_drone("drone-2")
    world.put(traffic(namespace, "second"))
    assert "Policy odd" in reason(world, namespace, "PolicyInvalid", "second")["message"]
    assert not world.grants(namespace, "second")
    world.put(school)
    world.put(fractus_object("Policy", "odd", LOW))
    world.phase(namespace, "Deploying", "second")


# -- assignment of the drone --


def test_returning_drone_belongs_to_no_application(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    world.drone_status("drone-1", "flying")
    world.phase(namespace, "Flying")
    end_mission(world, namespace, "Complete", "done")
    world.phase(namespace, "Returning")
    again = traffic(namespace)
    again["spec"]["components"][4]["replicas"] = 2
    again["spec"]["updatePolicy"] = "Immediate"
    world.put(again)

    def queued() -> bool:
        world.end_pods(namespace)
        return bool(world.status(namespace)["phase"] == "Queued")

    wait_for(queued, "the phase Queued")
    world.drone_status("drone-1", "inactive", ready="False")
    # The drone no longer belongs to the Application, so the requirements of the new mission are checked again.
    reason(world, namespace, "NoDrone")
    world.drone_status("drone-1", "inactive")
    world.phase(namespace, "Deploying")


def test_recreated_application_waits_for_drone_of_deleted_one(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    running(world, namespace)
    world.drone_status("drone-1", "flying")
    world.phase(namespace, "Flying")
    world.api.delete(world.path(traffic(namespace)))
    wait_for(lambda: gone(world, namespace), "the Application to be deleted")
    world.put(traffic(namespace))
    world.phase(namespace, "Queued")
    assert not world.grants(namespace)
    world.drone_status("drone-1", "inactive")
    world.phase(namespace, "Deploying")


def test_drone_in_two_plans_stays_with_plan_of_older_grant(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    running(world, namespace)
    world.add_drone("drone-2")
    world.put(traffic(namespace, "second"))
    assert world.phase(namespace, "Deploying", "second")["drone"] == "drone-2"
    path = f"{FRACTUS}/namespaces/{namespace}/deploymentplans/second"
    operator.stop()
    world.api.delete(f"{FRACTUS}/drones/drone-2")
    spec = copy.deepcopy((world.api.get(path) or {})["spec"])
    spec["drone"]["node"] = "drone-1"
    for placed in spec["placements"]:
        placed["node"] = "drone-1" if placed.get("node") == "drone-2" else placed.get("node")
    world.api.merge(path, {"spec": spec})
    operator.start()
    world.phase(namespace, "Queued", "second")
    wait_for(lambda: not world.grants(namespace, "second"), "the Grants of the second Application to be deleted")
    assert {g["spec"]["node"] for g in world.grants(namespace)} >= {"drone-1"}


# -- in the air --


def reconciled(world: World, namespace: str) -> None:
    """Wait for the end of a reconciliation: change the replicas of a Deployment, and wait until they are reset."""
    path = f"/apis/apps/v1/namespaces/{namespace}/deployments/traffic-data-store"
    world.api.merge(path, {"spec": {"replicas": 3}})
    wait_for(
        lambda: (world.api.get(path) or {})["spec"]["replicas"] == 1, "the operator to reset the number of replicas"
    )


def test_deleted_drone_in_flight_keeps_its_grants(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    world.add_drone("drone-2")
    world.drone_status("drone-1", "flying")
    world.phase(namespace, "Flying")
    uids = {g["metadata"]["name"]: g["metadata"]["uid"] for g in world.grants(namespace)}
    world.api.delete(f"{FRACTUS}/drones/drone-1")
    world.api.delete("/api/v1/nodes/drone-1")
    reconciled(world, namespace)
    world.put(fractus_object("Policy", "low", LOW))
    wait_for(lambda: granted(world, namespace) == ["low"], "the policy")
    assert {g["metadata"]["name"]: g["metadata"]["uid"] for g in world.grants(namespace)} == uids
    assert world.status(namespace)["drone"] == "drone-1"


def test_forged_pod_does_not_change_plan(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    labels = {"fractus.dev/application": "traffic", "fractus.dev/instance": "traffic-ground-viewer-edge-2",
              "app.kubernetes.io/managed-by": "fractus"}  # fmt: skip
    pod = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "forged", "namespace": namespace, "labels": labels},
           "spec": {"containers": [{"name": "a", "image": "a"}], "schedulerName": "none"}}  # fmt: skip
    world.api.apply(f"/api/v1/namespaces/{namespace}/pods/forged", pod)
    refused = {"type": "PodScheduled", "status": "False", "reason": "Unschedulable", "message": "no",
               "lastTransitionTime": "2026-01-01T00:00:00Z"}  # fmt: skip
    world.api.merge(f"/api/v1/namespaces/{namespace}/pods/forged/status", {"status": {"conditions": [refused]}})
    reconciled(world, namespace)
    assert "deployments/traffic-ground-viewer-edge-2" in world.children(namespace)
    assert "deployments/traffic-ground-viewer-edge-1" not in world.children(namespace)


def test_refused_teardown_is_retried(world: World, operator: OperatorProcess, namespace: str) -> None:
    running(world, namespace)
    with undeletable_secrets(world, namespace):
        world.api.delete(f"{FRACTUS}/namespaces/{namespace}/applications/traffic")
        wait_for(lambda: "failed temporarily" in operator.log(), "the teardown to fail")
        assert not world.grants(namespace), "the Grants were not deleted before the Secrets"
        assert world.application(namespace) is not None
    wait_for(
        lambda: world.application(namespace) is None, lambda: f"the Application to be deleted: {operator.log()[-3000:]}"
    )
    assert "is cancelled" not in operator.log(), "the deletion of the Application caused a warning"


@pytest.mark.parametrize("restarted", [pytest.param(False, marks=pytest.mark.slow), True], ids=["running", "restarted"])
def test_application_deleted_at_end_of_mission_leaves_no_pods(
    world: World, operator: OperatorProcess, namespace: str, *, restarted: bool
) -> None:
    """The operator changes the owner of finished pods. The user deletes the Application while they have no owner."""
    world.put(traffic(namespace, "traffic", navigator()))
    deployed(world, namespace, pods=1)
    with unstoppable_pods(world, namespace):
        end_mission(world, namespace, "Complete", "done")
        wait_for(
            lambda: all(not pod["metadata"].get("ownerReferences") for pod in world.pods(namespace)),
            "the pod to have no owner",
        )
        if restarted:
            operator.stop(signal.SIGKILL)
        world.api.delete(f"{FRACTUS}/namespaces/{namespace}/applications/traffic")
        if restarted:
            operator.start()
        wait_for(lambda: world.application(namespace) is None, "the Application to be deleted")
        assert not world.pods(namespace)

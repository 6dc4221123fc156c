"""`fractus status`, `explain` and `doctor` on a real API server."""

from __future__ import annotations

import json

import pytest
from chart import path_of, render
from control_plane import ControlPlane, wait_for
from fractus_cli import main
from fractus_cli.reading import GROUP, SYSTEM
from fractus_runtime.kubernetes import KubeError
from operator_world import OperatorProcess, World, traffic


def test_a_deployed_application_is_shown_and_explained(
    control_plane: ControlPlane,
    world: World,
    operator: OperatorProcess,
    namespace: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def run(*arguments: str) -> tuple[int, str]:
        capsys.readouterr()
        code = main.run([*arguments, "--kubeconfig", str(control_plane.kubeconfig)])
        return code, capsys.readouterr().out

    world.put(traffic(namespace))
    world.phase(namespace, "Deploying")
    wait_for(lambda: len(world.grants(namespace)) >= 3, "the grants")
    code, said = run("status", "-n", namespace, "-o", "json")
    seen = json.loads(said)
    assert code == 0
    assert [(a["name"], a["phase"], a["drone"]) for a in seen["applications"]] == [("traffic", "Deploying", "drone-1")]
    assert [d["state"] for d in seen["drones"]] == ["inactive"]
    assert "drone-1" in run("status")[1]
    code, said = run("explain", "traffic", "-n", namespace)
    assert code == 0
    assert "Drone: drone-1" in said
    assert "Navigator: drone-1 (on the drone that flies)" in said
    assert "Policies for " in said
    assert run("explain", "nothing", "-n", namespace)[0] == 1


def test_a_cluster_without_the_charts_is_told_how_to_get_them(
    control_plane: ControlPlane, world: World, capsys: pytest.CaptureFixture[str]
) -> None:
    code = main.run(["doctor", "-o", "json", "--kubeconfig", str(control_plane.kubeconfig)])
    findings = {(f["check"], f["level"]): f for f in json.loads(capsys.readouterr().out)}
    assert code == 2
    assert ("version", "ok") in findings
    assert ("kinds", "ok") in findings
    assert "helm upgrade --install fractus " in findings["operator", "error"]["remedy"]
    assert any("has no taint fractus.dev/class" in f["message"] for f in findings.values())


def test_pods_that_a_policy_would_not_let_be_made_again_are_told(
    control_plane: ControlPlane, world: World, namespace: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Such as those of a network plugin that was there before Fractus; and why pods of services cannot be made."""
    bare: dict[str, object] = {"nodeName": "drone-1", "hostNetwork": True, "tolerations": [{"operator": "Exists"}]}
    bare |= {"containers": [{"name": "cni", "image": "registry.test/cni:1"}]}
    plugin = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "cni", "namespace": namespace}, "spec": bare}
    (guard,) = (
        body
        for body in render()
        if (body["kind"], body["metadata"]["name"]) == ("ValidatingAdmissionPolicy", "fractus-pods")
    )

    def made() -> bool:
        try:
            world.api.apply(f"/api/v1/namespaces/{namespace}/pods/cni", plugin)
        except KubeError as error:
            # The API server goes by the policy of an earlier test for a moment after that is deleted.
            assert "fractus-pod" in str(error), error
            return False
        return True

    wait_for(made, "a pod on a node that no policy protects")
    world.api.apply(path_of(guard), guard)
    try:
        main.run(["doctor", "-o", "json", "--kubeconfig", str(control_plane.kubeconfig)])
    finally:
        world.api.delete(path_of(guard))
        world.api.delete(f"/api/v1/namespaces/{namespace}/pods/cni", grace_s=0)
    found = [f for f in json.loads(capsys.readouterr().out) if f["message"].startswith(f"{namespace}: ")]
    assert [f["level"] for f in found] == ["warning"]
    assert "cni on drone-1" in found[0]["message"]
    assert f"admission.exemptNamespaces={{kube-system,{namespace}}}" in found[0]["remedy"]


def test_the_account_of_helm_test_may_read_what_doctor_reads(
    control_plane: ControlPlane, world: World, chart: None, capsys: pytest.CaptureFixture[str]
) -> None:
    """The chart's pod runs it; more than that its account may not."""
    account = f"system:serviceaccount:{SYSTEM}:fractus-test"
    kubeconfig = control_plane.write_kubeconfig("fractus-test", account, ("system:authenticated",))

    def examined() -> bool:
        code = main.run(["doctor", "-o", "json", "--kubeconfig", str(kubeconfig)])
        said = capsys.readouterr()
        # The authorizer hears of roles by a watch.
        assert not said.err or "Forbidden" in said.err, said.err
        return code == 2 and "operator" in {finding["check"] for finding in json.loads(said.out)}

    wait_for(examined, "doctor by the chart's account")
    (pod,) = (body for body in render() if body["kind"] == "Pod")
    assert pod["spec"]["serviceAccountName"] == "fractus-test"
    assert pod["spec"]["containers"][0]["command"] == ["fractus", "doctor"]
    client = control_plane.as_user("fractus-test-2", account, ("system:authenticated",))
    for path in ("/api/v1/secrets", f"{GROUP}/grants", f"/api/v1/namespaces/{SYSTEM}/secrets"):
        with pytest.raises(KubeError, match="forbidden"):
            client.list(path)

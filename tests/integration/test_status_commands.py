"""`fractus status`, `explain` and `doctor` on a real API server."""

from __future__ import annotations

import json

import pytest
from chart import path_of, render
from control_plane import ControlPlane, wait_for
from fractus_cli import main
from fractus_cli.cluster_reader import GROUP, SYSTEM
from fractus_runtime.kubernetes import KubeError
from operator_world import OperatorProcess, World, traffic


def test_status_and_explain_show_deployed_application(
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
    code, output = run("status", "-n", namespace, "-o", "json")
    summary = json.loads(output)
    assert code == 0
    assert [(a["name"], a["phase"], a["drone"]) for a in summary["applications"]] == [
        ("traffic", "Deploying", "drone-1")
    ]
    assert [d["state"] for d in summary["drones"]] == ["inactive"]
    assert "drone-1" in run("status")[1]
    code, output = run("explain", "traffic", "-n", namespace)
    assert code == 0
    assert "Drone: drone-1" in output
    assert "Navigator: drone-1 (on the selected drone)" in output
    assert "Policies for " in output
    assert run("explain", "nothing", "-n", namespace)[0] == 1


def test_doctor_prints_install_commands_for_cluster_without_charts(
    control_plane: ControlPlane, world: World, capsys: pytest.CaptureFixture[str]
) -> None:
    code = main.run(["doctor", "-o", "json", "--kubeconfig", str(control_plane.kubeconfig)])
    findings = {(f["check"], f["level"]): f for f in json.loads(capsys.readouterr().out)}
    assert code == 2
    assert ("version", "ok") in findings
    assert ("kinds", "ok") in findings
    assert "helm upgrade --install fractus " in findings["operator", "error"]["remedy"]
    assert any("has no taint fractus.dev/class" in f["message"] for f in findings.values())


def test_doctor_warns_about_pods_that_admission_would_reject_on_recreation(
    control_plane: ControlPlane, world: World, namespace: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """For example, a network plugin that was installed before Fractus could not be created again."""
    pod_spec: dict[str, object] = {"nodeName": "drone-1", "hostNetwork": True, "tolerations": [{"operator": "Exists"}]}
    pod_spec |= {"containers": [{"name": "cni", "image": "registry.test/cni:1"}]}
    plugin = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "cni", "namespace": namespace}, "spec": pod_spec}
    (guard,) = (
        body
        for body in render()
        if (body["kind"], body["metadata"]["name"]) == ("ValidatingAdmissionPolicy", "fractus-pods")
    )

    def pod_created() -> bool:
        try:
            world.api.apply(f"/api/v1/namespaces/{namespace}/pods/cni", plugin)
        except KubeError as error:
            # For a moment, the API server still enforces an admission policy that an earlier test has deleted.
            assert "fractus-pod" in str(error), error
            return False
        return True

    wait_for(pod_created, "a pod on a node, created without an admission policy")
    world.api.apply(path_of(guard), guard)
    try:
        main.run(["doctor", "-o", "json", "--kubeconfig", str(control_plane.kubeconfig)])
    finally:
        world.api.delete(path_of(guard))
        world.api.delete(f"/api/v1/namespaces/{namespace}/pods/cni", grace_s=0)
    findings = [f for f in json.loads(capsys.readouterr().out) if f["message"].startswith(f"{namespace}: ")]
    assert [f["level"] for f in findings] == ["warning"]
    assert "cni on drone-1" in findings[0]["message"]
    assert f"admission.exemptNamespaces={{kube-system,{namespace}}}" in findings[0]["remedy"]


def test_helm_test_account_has_exactly_the_permissions_of_doctor(
    control_plane: ControlPlane, world: World, chart: None, capsys: pytest.CaptureFixture[str]
) -> None:
    """The test pod of the chart runs `fractus doctor`. Its account may not read Secrets or Grants."""
    account = f"system:serviceaccount:{SYSTEM}:fractus-test"
    kubeconfig = control_plane.write_kubeconfig("fractus-test", account, ("system:authenticated",))

    def examined() -> bool:
        code = main.run(["doctor", "-o", "json", "--kubeconfig", str(kubeconfig)])
        captured = capsys.readouterr()
        # Until the API server has received the role through its watch, it refuses requests.
        assert not captured.err or "Forbidden" in captured.err, captured.err
        return code == 2 and "operator" in {finding["check"] for finding in json.loads(captured.out)}

    wait_for(examined, "complete findings of doctor with the chart's account")
    (pod,) = (body for body in render() if body["kind"] == "Pod")
    assert pod["spec"]["serviceAccountName"] == "fractus-test"
    assert pod["spec"]["containers"][0]["command"] == ["fractus", "doctor"]
    client = control_plane.as_user("fractus-test-2", account, ("system:authenticated",))
    for path in ("/api/v1/secrets", f"{GROUP}/grants", f"/api/v1/namespaces/{SYSTEM}/secrets"):
        with pytest.raises(KubeError, match="forbidden"):
            client.list(path)

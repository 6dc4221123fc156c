"""`fractus status`, `explain` and `doctor` on a real API server."""

from __future__ import annotations

import json

import pytest
from control_plane import ControlPlane, wait_for
from fractus_cli import main
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

"""NodeGrants object of a node: the operator writes it and copies reports from it, with the rights of the chart."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from chart import operator_token
from control_plane import ControlPlane, wait_for
from fractus_core.api.grants import unpack
from operator_world import FRACTUS, NODE_OBJECTS, NODES, Body, OperatorProcess, World
from test_operator import running

NODE_GRANTS = f"{FRACTUS}/namespaces/{NODES}/nodegrants"


@pytest.fixture
def operator_of_chart(
    control_plane: ControlPlane, world: World, chart: None, tmp_path: Path
) -> Iterator[OperatorProcess]:
    """The operator with the token of its account. The chart's roles and admission policies apply to this account."""
    cluster = {"server": control_plane.server, "certificate-authority": str(control_plane.ca)}
    config = {
        "apiVersion": "v1",
        "kind": "Config",
        "current-context": "operator",
        "clusters": [{"name": "test", "cluster": cluster}],
        "users": [{"name": "operator", "user": {"token": operator_token(world)}}],
        "contexts": [{"name": "operator", "context": {"cluster": "test", "user": "operator"}}],
    }
    kubeconfig = tmp_path / "operator.kubeconfig"
    kubeconfig.write_text(yaml.safe_dump(config))
    process = OperatorProcess(kubeconfig, tmp_path / "operator.log", FRACTUS_LEASE="2")
    process.start()
    yield process
    if process.running:
        process.stop()
    print(process.log())


def carried(world: World, node: str) -> dict[str, Body] | None:
    """Return the Grants in the NodeGrants object of a node, by name, or None if the object does not exist."""
    body = world.api.get(f"{NODE_GRANTS}/{node}")
    return (
        None
        if body is None
        else {g["metadata"]["name"]: g for g in unpack(body["spec"]["packed"], body["spec"]["count"])}
    )


def test_node_grants_object_follows_grants_and_returns_reports(
    world: World, operator_of_chart: OperatorProcess, namespace: str
) -> None:
    wait_for(lambda: carried(world, "drone-1") == {}, "the NodeGrants object of drone-1, without Grants")
    for path in NODE_OBJECTS:
        wait_for(lambda path=path: world.api.get(f"{path}/edge-1"), f"{path} of edge-1")

    name = f"{namespace}.traffic-navigator"
    running(world, namespace)
    grant = world.api.get(f"{FRACTUS}/grants/{name}") or {}
    mine = wait_for(
        lambda: (carried(world, "drone-1") or {}).get(name), "the Grant in the NodeGrants object of its node"
    )
    assert (mine["metadata"]["uid"], mine["spec"]) == (grant["metadata"]["uid"], grant["spec"])
    assert {each["spec"]["node"] for each in (carried(world, "drone-1") or {}).values()} == {"drone-1"}
    assert name not in (carried(world, "edge-1") or {})

    def status() -> Body:
        return (world.api.get(f"{FRACTUS}/grants/{name}") or {}).get("status") or {}

    def report(node: str, phase: str, message: str = "") -> None:
        report_body = {"uid": grant["metadata"]["uid"], "name": name, "phase": phase, "message": message}
        reports = {"observedGeneration": 1, "grants": [report_body | {"observedGeneration": 1}]}
        world.api.merge(f"{NODE_GRANTS}/{node}/status", {"status": reports})

    report("drone-1", "Active")
    wait_for(lambda: status() == {"phase": "Active", "message": "", "observedGeneration": 1}, "the status of the Grant")

    # The restarted operator processes reports that arrived while it did not run.
    operator_of_chart.stop()
    report("edge-1", "Failed", "not its own")
    report("drone-1", "Complete", "flown")
    operator_of_chart.start()
    wait_for(lambda: status().get("phase") == "Complete", "the new status of the Grant after a restart")
    report("drone-1", "Active")
    wait_for(lambda: world.status(namespace).get("phase") in {"Returning", "Completed"}, "the end of the mission")
    assert (status() or {"phase": "Complete"})["phase"] == "Complete", "a later report reverted the phase Complete"

    world.api.delete(f"{FRACTUS}/namespaces/{namespace}/applications/traffic")
    wait_for(lambda: carried(world, "drone-1") == {}, "the removal of the Grants from the NodeGrants object")
    world.api.delete(f"{FRACTUS}/edgenodes/edge-1")
    world.api.delete("/api/v1/nodes/edge-1")
    for path in NODE_OBJECTS:
        wait_for(lambda path=path: world.api.get(f"{path}/edge-1") is None, f"{path} of edge-1 to be removed")
        assert world.api.get(f"{path}/edge-2")

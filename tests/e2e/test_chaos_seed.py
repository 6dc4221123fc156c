"""Missions under seeded faults of the API server, the operator and the link break no invariant."""

from __future__ import annotations

import pytest
from conftest import DRONE
from fractus_cluster.binaries import ensure_binaries
from fractus_cluster.cluster import Cluster
from fractus_sim.chaos.chaos_cluster import Stage, Watch
from fractus_sim.chaos.chaos_run import Task, fly
from fractus_sim.testbeds.kube_commands import Kube as Programs
from kubectl import Kube

pytestmark = pytest.mark.slow

SEED = 7
RUN_S = 75.0
FAULTS = ("operator-kill", "api-down", "etcd-restart", "link-cut", "pod-delete")
VEHICLE_PORT = 5760


@pytest.mark.timeout(900)
def test_no_invariant_breaks(grounded: Kube, cluster: Cluster | None) -> None:
    if cluster is None:
        pytest.skip("faults are made on the embedded cluster")
    programs = ensure_binaries(("kubectl", "helm"), report=print)
    stage = Stage(cluster, Programs(programs["kubectl"], programs["helm"], cluster.kubeconfig), DRONE)
    with Watch(stage.node.wiring.namespace_path(DRONE), VEHICLE_PORT, stage.state / "grants") as watch:
        run = fly(stage, watch, Task(SEED, RUN_S, FAULTS), print)
    assert run.broken == []
    assert "Completed" in {phase for phase, _ in run.ended.values()}
    assert run.flown_s > 30

"""Missions under seeded faults of the API server, the operator and the link break no invariant."""

from __future__ import annotations

import pytest
from conftest import DRONE
from fractus_cluster.binaries import ensure_binaries
from fractus_cluster.cluster import Cluster
from fractus_sim.chaos.chaos_cluster import VEHICLE_PORT, ChaosTarget, VehicleWatch
from fractus_sim.chaos.chaos_run import RunConfig, execute_run
from fractus_sim.testbeds.kube_commands import Kube as Programs
from kubectl import Kube

pytestmark = pytest.mark.slow

SEED = 7
RUN_S = 75.0
FAULTS = ("operator-kill", "api-down", "etcd-restart", "link-cut", "pod-delete")


@pytest.mark.timeout(900)
def test_chaos_run_violates_no_invariant(grounded: Kube, cluster: Cluster | None) -> None:
    if cluster is None:
        pytest.skip("faults need the embedded cluster")
    programs = ensure_binaries(("kubectl", "helm"), report=print)
    target = ChaosTarget(cluster, Programs(programs["kubectl"], programs["helm"], cluster.kubeconfig), DRONE)
    with VehicleWatch(target.node.wiring.namespace_path(DRONE), VEHICLE_PORT, target.state / "grants") as watch:
        run = execute_run(target, watch, RunConfig(SEED, RUN_S, FAULTS), print)
    assert run.violations == []
    assert "Completed" in {phase for phase, _ in run.missions.values()}
    assert run.flown_s > 30

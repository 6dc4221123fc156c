"""The API server fault `api-429` on a real API server."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from chart import path_of
from control_plane import ControlPlane, wait_for
from fractus_cluster.binaries import ensure_binaries
from fractus_runtime.kubernetes import BlockingClient, KubeError
from fractus_sim.chaos.api_server_faults import occupied_request_slot, rate_limit_manifests
from fractus_sim.testbeds.kube_commands import Kube

pytestmark = pytest.mark.slow


def status(client: BlockingClient) -> int:
    """Send a request that no account may make, and return the HTTP status of its refusal."""
    with pytest.raises(KubeError) as refusal:
        client.get("/api/v1/namespaces/default/secrets/any")
    return refusal.value.status


def test_api_server_rejects_only_accounts_of_fractus_with_429(control_plane: ControlPlane) -> None:
    kube = Kube(ensure_binaries(("kubectl",), report=print)["kubectl"], Path("helm"), control_plane.kubeconfig)
    accounts = [
        control_plane.as_user(
            namespace,
            f"system:serviceaccount:{namespace}:any",
            ("system:serviceaccounts", f"system:serviceaccounts:{namespace}"),
        )
        for namespace in ("fractus-system", "fractus-nodes")
    ]
    stranger = control_plane.as_user("stranger", "stranger", ())
    rules = list(yaml.safe_load_all(rate_limit_manifests()))
    try:
        for body in rules:
            control_plane.admin.apply(path_of(body), body)
        with occupied_request_slot(kube):
            wait_for(lambda: all(status(account) == 429 for account in accounts * 3), "429")
            assert status(stranger) == 403
    finally:
        for body in reversed(rules):
            control_plane.admin.delete(path_of(body))
    wait_for(lambda: all(status(account) == 403 for account in accounts), "refusals with 403 instead of 429")
    for client in (*accounts, stranger):
        client.close()

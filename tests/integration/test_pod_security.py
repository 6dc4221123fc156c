"""Pod Security: helm refuses to install into a namespace that would not admit the pods of node services."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator

import pytest
from chart import CHARTS, KUBERNETES, helm
from control_plane import ControlPlane
from operator_world import SYSTEM, World

ENFORCE = "pod-security.kubernetes.io/enforce"
CHART = {"fractus": (), "fractus-demo": ("--set=drone=drone-1",)}


@pytest.fixture
def namespace(world: World) -> Iterator[str]:
    """Path of the namespace fractus-system. The test may set its Pod Security level, which is removed at the end."""
    yield f"/api/v1/namespaces/{SYSTEM}"
    world.api.merge(f"/api/v1/namespaces/{SYSTEM}", {"metadata": {"labels": {ENFORCE: None}}})


def rendered(chart: str, control_plane: ControlPlane, *more: str) -> subprocess.CompletedProcess[str]:
    """Render a chart with access to the API server, like `helm install`."""
    argv = [helm(), "template", chart, str(CHARTS / chart), "-n", SYSTEM, "--kubeconfig", str(control_plane.kubeconfig)]
    argv += [KUBERNETES, *CHART[chart], *more]
    return subprocess.run(argv, capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.parametrize("chart", CHART)
def test_chart_is_refused_in_namespace_with_restrictive_pod_security(
    control_plane: ControlPlane, world: World, namespace: str, chart: str
) -> None:
    for level in ("baseline", "restricted"):
        world.api.merge(namespace, {"metadata": {"labels": {ENFORCE: level}}})
        for verb in ((), ("--is-upgrade",)):
            result = rendered(chart, control_plane, "--dry-run=server", *verb)
            assert result.returncode != 0
            assert f"the namespace {SYSTEM} enforces Pod Security {level}" in result.stderr
            assert f"kubectl label namespace {SYSTEM} {ENFORCE}=privileged --overwrite" in result.stderr
        assert rendered(chart, control_plane).returncode == 0, (
            "the chart was refused, although helm could not look up the namespace"
        )


@pytest.mark.parametrize("chart", CHART)
def test_chart_is_accepted_in_namespace_with_privileged_pod_security(
    control_plane: ControlPlane, world: World, namespace: str, chart: str
) -> None:
    for level in ("privileged", None):
        world.api.merge(namespace, {"metadata": {"labels": {ENFORCE: level}}})
        result = rendered(chart, control_plane, "--dry-run=server")
        assert result.returncode == 0, result.stderr

"""Upgrade of the chart fractus before fractus-crds: a kind that the new release needs is missing."""

from __future__ import annotations

import copy
import subprocess
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from chart import render
from control_plane import ControlPlane, wait_for
from fractus_core.api import ApplicationTemplate, DeploymentPlan, FlightPlan, NodeGrants
from fractus_core.api.crd import crd
from fractus_core.api.model import Resource
from fractus_runtime.kubernetes import KubeError
from operator_world import FRACTUS, NODES, SYSTEM, OperatorProcess, World
from test_uninstall_chart import with_lookups

pytestmark = pytest.mark.slow

CRDS = "/apis/apiextensions.k8s.io/v1/customresourcedefinitions"
OBJECTS = f"{FRACTUS}/namespaces/{NODES}/nodegrants"
LEASE = f"/apis/coordination.k8s.io/v1/namespaces/{SYSTEM}/leases/fractus-operator"


def is_served(world: World, kind: type[Resource]) -> bool:
    return any(each["kind"] == kind.KIND for each in world.api.call("GET", FRACTUS)["resources"])


def is_stored(world: World, kind: type[Resource]) -> bool:
    try:
        return world.api.get(f"{FRACTUS}/{kind.PLURAL}") is not None
    except KubeError:
        # the API server answers "storage is (re)initializing"
        return False


@contextmanager
def without_kind(world: World, kind: type[Resource]) -> Iterator[None]:
    path = f"{CRDS}/{kind.PLURAL}.fractus.dev"
    world.api.delete(path)
    wait_for(lambda: world.api.get(path) is None and not is_served(world, kind), "the kind to be deleted")
    try:
        yield
    finally:
        world.api.apply(path, crd(kind))
        wait_for(lambda: is_served(world, kind) and is_stored(world, kind), "the kind to be served again")


def test_operator_with_missing_kind_leaves_lease_to_previous_release(
    control_plane: ControlPlane, world: World, tmp_path: Path
) -> None:
    """An operator that cannot work without the kind must not replace the operator of the previous release."""
    process = OperatorProcess(control_plane.kubeconfig, tmp_path / "operator.log")

    def healthy() -> bool:
        with suppress(OSError):
            return bool(urllib.request.urlopen(process.health, timeout=5).status == 200)
        return False

    world.api.delete(LEASE)
    try:
        with without_kind(world, NodeGrants):
            process.start()
            wait_for(lambda: "operator: waiting for kinds" in process.log(), process.log)
            assert "upgrade the chart fractus-crds (missing=NodeGrants)" in process.log()
            assert not healthy()
            assert world.api.get(LEASE) is None
        wait_for(healthy, process.log)
        wait_for(lambda: world.api.get(f"{OBJECTS}/drone-1"), process.log)
    finally:
        if process.running:
            process.stop()


@pytest.mark.parametrize("arguments", [(), ("--is-upgrade",)])
@pytest.mark.parametrize("kind", [NodeGrants, ApplicationTemplate, FlightPlan])
def test_chart_is_refused_when_kind_is_missing(world: World, kind: type[Resource], arguments: tuple[str, ...]) -> None:
    assert render(*with_lookups(world, *arguments))
    with without_kind(world, kind), pytest.raises(subprocess.CalledProcessError) as refused:
        render(*with_lookups(world, *arguments))
    assert "install or upgrade the chart fractus-crds first" in refused.value.stderr


def test_chart_is_refused_when_kind_cannot_record_outcomes(world: World) -> None:
    """The API server would refuse the outcome of a mission, and the operator would then not remove its Grants."""
    path = f"{CRDS}/deploymentplans.fractus.dev"
    older = copy.deepcopy(crd(DeploymentPlan))
    del older["spec"]["versions"][0]["schema"]["openAPIV3Schema"]["properties"]["spec"]["properties"]["flown"]
    present = world.api.get(path) or {}
    older["metadata"]["resourceVersion"] = present["metadata"]["resourceVersion"]
    world.api.call("PUT", path, older)
    try:
        with pytest.raises(subprocess.CalledProcessError) as refused:
            render(*with_lookups(world, "--is-upgrade"))
    finally:
        world.api.apply(path, crd(DeploymentPlan))
    assert "DeploymentPlan has no field spec.flown: upgrade the chart fractus-crds first" in refused.value.stderr
    assert render(*with_lookups(world, "--is-upgrade"))

"""Deletion of a namespace in flight: the Applications in it end at once, even if their pods remain."""

from __future__ import annotations

import signal

import pytest
from control_plane import wait_for
from operator_world import OperatorProcess, World, traffic
from test_operator import gone, running


@pytest.mark.parametrize("restarted", [False, True], ids=["running", "restarted"])
def test_deletion_of_namespace_in_flight_revokes_grants_while_pods_remain(
    world: World, operator: OperatorProcess, namespace: str, *, restarted: bool
) -> None:
    """There is no kubelet, so pods with a node remain in the namespace, as on an unreachable node."""
    running(world, namespace)
    world.drone_status("drone-1", "flying")
    world.phase(namespace, "Flying")
    if restarted:
        operator.stop(signal.SIGKILL)
    world.api.delete(f"/api/v1/namespaces/{namespace}")
    if restarted:
        operator.start()
    wait_for(lambda: not world.grants(namespace), lambda: f"the Grants to be deleted: {operator.log()[-3000:]}")
    assert world.api.list(f"/api/v1/namespaces/{namespace}/pods"), "the test needs pods that remain"
    wait_for(lambda: not world.links(namespace), "the direct links to be deleted")


def test_application_created_after_deleted_namespace_of_same_name_is_planned(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    running(world, namespace)
    world.api.delete(f"/api/v1/namespaces/{namespace}")
    wait_for(lambda: not world.grants(namespace), "the Grants to be deleted")
    for pod in world.api.list(f"/api/v1/namespaces/{namespace}/pods"):
        world.api.delete(f"/api/v1/namespaces/{namespace}/pods/{pod['metadata']['name']}", 0)
    wait_for(lambda: world.api.get(f"/api/v1/namespaces/{namespace}") is None, "the namespace to be deleted")
    wait_for(lambda: gone(world, namespace), "the Application and its child objects to be deleted")
    world.api.apply(
        f"/api/v1/namespaces/{namespace}",
        {"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": namespace}},
    )
    world.put(traffic(namespace))
    world.phase(namespace, "Deploying")

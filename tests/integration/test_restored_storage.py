"""The operator when etcd is restored from an older backup, so that resource versions decrease."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from control_plane import ControlPlane, programs, wait_for
from operator_world import FRACTUS, OperatorProcess, World, fresh_namespace, traffic


@pytest.fixture
def plane(tmp_path: Path) -> Iterator[ControlPlane]:
    """A separate control plane, whose storage the test replaces."""
    plane = ControlPlane(programs(), tmp_path / "plane")
    try:
        plane.start()
        yield plane
    finally:
        plane.stop()


def test_operator_restarts_after_etcd_restore(plane: ControlPlane, tmp_path: Path) -> None:
    world = World(plane)
    backup = tmp_path / "backup"
    world.furnish()
    operator = OperatorProcess(plane.kubeconfig, tmp_path / "operator.log")
    operator.start()
    try:
        with fresh_namespace(world, "before") as before, fresh_namespace(world, "after") as after:
            world.put(traffic(before))
            wait_for(lambda: len(world.pods(before)) == 7, operator.log)
            start = plane.stop_storage()
            shutil.copytree(plane.data, backup)
            start()
            for number in range(500):
                note = {"metadata": {"annotations": {"number": str(number)}}}
                world.api.merge("/api/v1/namespaces/default", note)
            world.api.delete(f"{FRACTUS}/namespaces/{before}/applications/traffic")
            wait_for(lambda: world.application(before) is None, operator.log)
            start = plane.stop_storage()
            shutil.rmtree(plane.data)
            shutil.copytree(backup, plane.data)
            start()
            wait_for(lambda: not operator.running, operator.log)
            assert "as after a restore" in operator.log()
            # The kubelet restarts the operator.
            operator.start()
            world.put(traffic(after, "second"))
            wait_for(lambda: world.status(after, "second").get("phase"), operator.log)
            # The operator also reconciles the Application that the backup contains.
            wait_for(lambda: world.status(before).get("drone") == "drone-1" and world.grants(before), operator.log)
    finally:
        if operator.running:
            operator.stop()
